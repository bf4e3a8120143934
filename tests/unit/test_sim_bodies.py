"""Bodies of the world that emulated firmware drives."""

from __future__ import annotations

import math

import pytest

from fullswarm.config import WorldConfig
from fullswarm.simulation.bodies import SteppedBodies, wheels_rolled
from fullswarm.simulation.world import World

BOX = (3.0, 0.0, 1.0, 1.0, 0.0)


class Stepped:
    def __init__(self, *starts: tuple[float, float, float], boxes: tuple[tuple[float, ...], ...] = ()) -> None:
        config = WorldConfig.model_validate(
            {"engine": "kinematic", "rate_hz": 200.0, "substeps": 1, "walls": False, "boxes": boxes,
             "bounds_m": (-10.0, -10.0, 10.0, 10.0), "watchdog_s": 0.1}
        )  # fmt: skip
        ids = [f"r{number}" for number, _ in enumerate(starts)]
        self.world = World(config, ids, starts)
        self.bodies = SteppedBodies(self.world, ids)
        self.body = self.bodies.of["r0"]

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 200)):
            self.bodies.before_step()
            self.world.step()
            self.bodies.after_step()


def test_a_body_has_no_watchdog_and_its_wheels_roll_as_far_as_it_goes() -> None:
    stepped = Stepped((0.0, 0.0, 0.0))
    stepped.body.drive(0.4, 0.0)
    stepped.run(5.0)
    state = stepped.body.state()
    assert state.speed_m_s == pytest.approx(0.4)
    assert state.x_m == pytest.approx(state.rolled_m)
    assert 1.9 < state.x_m < 2.0
    assert wheels_rolled(state, 0.235) == pytest.approx((state.rolled_m, state.rolled_m))


def test_turns_are_counted_beyond_a_half_turn() -> None:
    stepped = Stepped((0.0, 0.0, 3.0))
    stepped.body.drive(0.0, 2.0)
    stepped.run(6.0)
    state = stepped.body.state()
    assert 11.0 < state.turned_rad < 12.0
    assert math.cos(state.heading_rad - 3.0 - state.turned_rad) == pytest.approx(1.0)


def test_a_box_ahead_stops_the_wheels_and_presses_both_halves() -> None:
    stepped = Stepped((0.0, 0.0, 0.0), boxes=(BOX,))
    stepped.body.drive(0.5, 0.0)
    stepped.run(8.0)
    state = stepped.body.state()
    assert state.x_m == pytest.approx(2.5 - 0.17, abs=0.01)
    assert (state.bumps, state.contacts > 0) == ((True, True), True)
    rolled_m = state.rolled_m
    stepped.run(1.0)
    assert stepped.body.state().rolled_m == pytest.approx(rolled_m, abs=0.01)


@pytest.mark.parametrize(("side", "bumps"), [(0.2, (True, False)), (-0.2, (False, True))])
def test_the_half_on_the_other_robots_side_is_pressed(side: float, bumps: tuple[bool, bool]) -> None:
    stepped = Stepped((0.0, 0.0, 0.0), (1.0, side, 0.0))
    stepped.body.drive(0.5, 0.0)
    stepped.run(1.75)
    assert stepped.body.state().bumps == bumps


def test_a_short_touch_presses_the_bumper_until_it_has_sprung_back() -> None:
    stepped = Stepped((0.0, 0.0, 0.0), (1.0, 0.335, math.pi))
    stepped.body.drive(0.5, 0.0)
    stepped.bodies.of["r1"].drive(0.5, 0.0)
    touched, pressed = [], []
    for _ in range(400):
        stepped.run(0.005)
        touched.append(bool(stepped.world.contacts[0]))
        pressed.append(stepped.body.state().contacts > 0)
    assert touched.index(True) == pressed.index(True)
    last = len(touched) - 1 - touched[::-1].index(True)
    assert all(pressed[touched.index(True) : last + 9])
    assert not any(pressed[last + 11 :])


def test_nobody_drives_at_a_speed_that_is_no_number() -> None:
    stepped = Stepped((0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="cannot move"):
        stepped.body.drive(math.nan, 0.0)
