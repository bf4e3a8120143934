"""The body that firmware stands on."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.drivers.base import Pose
from fullswarm.emulators.base import FaultyWire, LinkFaults
from fullswarm.simulation.bodies import FreeBody, drive_wheels, wheels_rolled
from fullswarm.testing import FakeClock

SPEED = st.floats(-2.0, 2.0)


def test_it_drives_an_exact_circle() -> None:
    clock = FakeClock(0.0)
    body = FreeBody(Pose(1.0, 2.0, 0.0), clock)
    body.drive(0.5, 1.0)
    clock.advance_to(math.pi)
    state = body.state()
    assert (state.x_m, state.y_m) == pytest.approx((1.0, 3.0))
    assert abs(state.heading_rad) == pytest.approx(math.pi)
    assert (state.rolled_m, state.turned_rad) == pytest.approx((math.pi / 2, math.pi))


@given(SPEED, SPEED, st.floats(0.1, 1.0), st.floats(0.0, 10.0))
def test_wheels_roll_as_they_are_driven(left: float, right: float, base_m: float, seconds: float) -> None:
    clock = FakeClock(0.0)
    body = FreeBody(clock=clock)
    drive_wheels(body, left, right, base_m)
    clock.advance_to(seconds)
    assert wheels_rolled(body.state(), base_m) == pytest.approx((left * seconds, right * seconds), abs=1e-9)


def test_a_push_rolls_and_a_press_is_felt() -> None:
    body = FreeBody(clock=FakeClock(0.0))
    body.push(-1.0, 0.0)
    body.press(left=True, right=False)
    state = body.state()
    assert (state.x_m, state.rolled_m) == (-1.0, -1.0)
    assert (state.bumps, state.contacts) == ((True, False), 1)
    assert (state.speed_m_s, state.turn_rad_s) == (0.0, 0.0)


def test_a_good_link_changes_nothing() -> None:
    link = FaultyWire(LinkFaults())
    link.put(b"one", 0.0)
    link.put(b"two", 0.0)
    assert link.due(0.0) == [b"one", b"two"]
    assert link.due(9.0) == []


def test_a_bad_link_drops_mangles_and_delays() -> None:
    faults = LinkFaults(drop=0.3, corrupt=0.5, delay_s=0.2)
    link = FaultyWire(faults, seed=1)
    for _ in range(1000):
        link.put(b"\0\0\0\0", 1.0)
    assert link.due(1.1) == []
    arrived = link.due(1.2)
    assert 600 < len(arrived) < 800
    mangled = [each for each in arrived if each != b"\0\0\0\0"]
    assert all(sum(byte.bit_count() for byte in each) == 1 for each in mangled)
    assert 0.4 < len(mangled) / len(arrived) < 0.6
    link.put(b"late", 2.0)
    link.clear()
    assert link.due(9.0) == []
