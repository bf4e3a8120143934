"""PX4 driven in OFFBOARD, in simulated time: into motion, along what was asked, and out of it."""

from __future__ import annotations

import itertools
import math

import pytest

from fullswarm.drivers.base import STAND, Lifecycle, Twist
from fullswarm.drivers.mavlink.px4 import HOLD, OFFBOARD
from tests.unit.mavlink_bench import Px4Bench


def test_it_is_recognised_and_driven_in_offboard() -> None:
    bench = Px4Bench()
    bench.active()
    assert (bench.session.firmware, bench.rover.mode, bench.rover.armed) == ("PX4 1.16.0", OFFBOARD, True)
    assert bench.rover.parameters["COM_OBL_RC_ACT"][0] == 5
    before = [record for record in bench.rover.setpoints if not record.armed]
    assert {(record.mask, record.frame) for record in before} == {(3527, 8)}
    assert max(math.hypot(record.forward_m_s, record.left_m_s) for record in before) < 0.002
    gaps = [b.at_s - a.at_s for a, b in itertools.pairwise(before)]
    assert before[0].mode != OFFBOARD
    assert max(gaps) <= 0.1  # far above 2 Hz before, through the mode and through arming
    bench.run(2.0, bench.drive)
    assert bench.body.state().speed_m_s == pytest.approx(0.5, abs=0.01)
    assert bench.body.state().heading_rad == pytest.approx(0.7, abs=0.01)
    reading = bench.session.read()
    assert reading is not None
    assert reading.twist.linear_m_s == pytest.approx(0.5, abs=0.02)
    assert not any("invalid" in text or "unsupported" in text for text in bench.texts)
    bench.session.deactivate(bench.now_s)
    bench.until(lambda: bench.session.state is Lifecycle.READY, 4.0)
    assert (bench.rover.mode, bench.rover.armed) == (HOLD, False)
    assert bench.body.state().speed_m_s < 0.1


def test_standing_active_it_neither_creeps_nor_turns_to_the_north() -> None:
    bench = Px4Bench()
    bench.active()
    bench.run(5.0, lambda: bench.drive(0.0))
    state = bench.body.state()
    assert math.hypot(state.x_m, state.y_m) < 0.02
    assert state.heading_rad == pytest.approx(0.7, abs=1e-3)


@pytest.mark.parametrize("turn", [0.1, -0.3, 0.8, -1.5, 2.0])
def test_it_turns_on_the_spot_at_the_rate_that_was_asked(turn: float) -> None:
    bench = Px4Bench()
    bench.active()
    assert bench.drive(0.0, turn) == Twist(0.0, turn)
    bench.run(2.0, lambda: bench.drive(0.0, turn))
    begin, since_s = bench.body.state().turned_rad, bench.now_s
    bench.run(1.0, lambda: bench.drive(0.0, turn))
    assert (bench.body.state().turned_rad - begin) / (bench.now_s - since_s) == pytest.approx(turn, rel=0.1)
    assert abs(bench.body.state().rolled_m) < 0.02


@pytest.mark.parametrize(("speed", "turn"), [(0.5, 0.25), (0.5, -0.25), (0.8, 0.6), (0.3, 1.9)])
def test_what_is_said_to_be_applied_is_what_it_does(speed: float, turn: float) -> None:
    bench = Px4Bench()
    bench.active()
    applied = bench.drive(speed, turn)
    assert applied.angular_rad_s * turn > 0.0
    if applied.linear_m_s:
        assert applied.angular_rad_s / applied.linear_m_s == pytest.approx(turn / speed)
    bench.run(2.5, lambda: bench.drive(speed, turn))
    begin, since_s = bench.body.state(), bench.now_s
    bench.run(2.0, lambda: bench.drive(speed, turn))
    end, passed_s = bench.body.state(), bench.now_s - since_s
    assert (end.rolled_m - begin.rolled_m) / passed_s == pytest.approx(applied.linear_m_s, rel=0.05, abs=0.01)
    assert (end.turned_rad - begin.turned_rad) / passed_s == pytest.approx(applied.angular_rad_s, rel=0.15)


def test_it_does_not_reverse_and_says_so() -> None:
    bench = Px4Bench()
    bench.active()
    assert bench.drive(-0.5) == STAND
    assert bench.drive(-0.5, 0.4) == Twist(0.0, 0.4)
    bench.run(1.0, lambda: bench.drive(-0.5))
    assert abs(bench.body.state().rolled_m) < 0.01


def test_silence_of_the_agent_is_a_stop_but_no_loss_of_offboard() -> None:
    bench = Px4Bench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.run(3.0)
    assert bench.body.state().speed_m_s < 0.01
    assert (bench.session.state, bench.rover.mode) == (Lifecycle.ACTIVE, OFFBOARD)
