"""The judge of `benchmarks/hostile_mcp.py` finds contacts and e-stops that did not win."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.hostile_mcp import RADIUS_M, SIZE_M, overlaps, standstill_s

APART = [[1.0, 1.0, 0.0], [5.0, 5.0, 0.0]]


@pytest.mark.parametrize(
    ("place", "touches"),
    [
        ((1.0, 1.0 + 2.0 * RADIUS_M + 0.01), False),
        ((1.0, 1.0 + 2.0 * RADIUS_M - 0.01), True),  # the other robot
        ((RADIUS_M + 0.01, 3.0), False),
        ((RADIUS_M - 0.01, 3.0), True),  # the wall
        ((SIZE_M - RADIUS_M + 0.01, 5.0), True),
        ((3.0 + 0.3 + RADIUS_M + 0.01, 3.0), False),
        ((3.0 + 0.3 + RADIUS_M - 0.01, 3.0), True),  # the box
        ((3.0 + 0.3 + 0.1, 3.0 + 0.3 + 0.16), False),  # its corner is round to a disc
    ],
)
def test_it_counts_steps_in_which_bodies_overlap(place: tuple[float, float], touches: bool) -> None:
    poses = np.array([APART, [APART[0], [*place, 0.0]], APART])
    count, least_m = overlaps(poses)
    assert (count, least_m < 0.0) == (int(touches), touches)


def test_it_measures_the_standstill_and_sees_a_robot_that_moves_on() -> None:
    time_s = np.arange(0.0, 10.0, 0.02)
    speed = np.zeros((len(time_s), 2))
    speed[time_s < 3.4, 0] = 0.5
    assert standstill_s(time_s, speed, 3.0, 8.0) == pytest.approx(0.38, abs=0.03)
    assert standstill_s(time_s, speed, 4.0, 8.0) == 0.0
    speed[(time_s > 5.0) & (time_s < 5.1), 1] = 0.1
    assert standstill_s(time_s, speed, 3.0, 8.0) > 2.0, "it moved again while it was latched"
    speed[time_s > 3.0, 1] = 0.1
    assert standstill_s(time_s, speed, 3.0, 8.0) == math.inf
