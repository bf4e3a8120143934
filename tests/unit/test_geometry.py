"""Angles and the unicycle map."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.geometry import unicycle, wrap

angles = st.floats(-1e3, 1e3)


@given(angles)
def test_wrap_keeps_the_direction_and_stays_in_range(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


@given(st.floats(-5, 5), st.floats(-5, 5), angles)
def test_the_map_projects_on_the_heading_and_turns_the_short_way(vx: float, vy: float, heading: float) -> None:
    speed, turn = unicycle(vx, vy, heading, 1.0, 1.0)
    if math.hypot(vx, vy) < 1e-9:
        assert (speed, turn) == (0.0, 0.0)
        return
    assert speed == pytest.approx(vx * math.cos(heading) + vy * math.sin(heading), abs=1e-6)
    assert abs(turn) <= math.pi
    after = heading + turn
    assert math.cos(after) * vy == pytest.approx(math.sin(after) * vx, abs=1e-6)


def test_a_goal_behind_is_told_from_one_ahead() -> None:
    # A one-argument atan2, as the paper prints it, would give 0 for both.
    assert unicycle(1.0, 0.0, 0.0, 1.0, 1.0) == (1.0, 0.0)
    speed, turn = unicycle(-1.0, 0.0, 0.0, 1.0, 1.0)
    assert speed == pytest.approx(-1.0)
    assert abs(turn) == pytest.approx(math.pi)
