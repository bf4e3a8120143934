"""The driver's conversation with a rover in trouble: links cut, position or attitude lost, restarts."""

from __future__ import annotations

import pytest

from fullswarm.drivers.base import STAND, Lifecycle
from fullswarm.drivers.mavlink.protocol import Mode
from tests.unit.mavlink_bench import ArduBench


def test_after_a_cut_it_is_ready_within_two_seconds_never_active_and_disarmed_first() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.cut = True
    bench.until(lambda: bench.session.lifecycle is Lifecycle.FAULT, 1.5, bench.drive)
    bench.run(4.0, bench.drive)
    assert "no heartbeat" in bench.session.fault
    bench.cut = False
    back_s, seen = bench.now_s, set()
    bench.until(lambda: bench.session.lifecycle is Lifecycle.READY, 2.0, lambda: seen.add(bench.session.lifecycle))
    assert Lifecycle.ACTIVE not in seen
    assert bench.now_s - back_s < 2.0
    assert (bench.rover.armed, bench.drive()) == (False, STAND)


def test_position_lost_is_a_fault_with_a_stop_and_comes_back_ready() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.rover.located = False
    bench.until(lambda: bench.session.lifecycle is Lifecycle.FAULT, 1.2, bench.drive)
    bench.until(lambda: not bench.rover.armed and bench.rover.mode == Mode.HOLD, 5.0, bench.drive)
    bench.rover.located = True
    bench.ready()
    bench.run(1.0, bench.drive)
    assert bench.session.lifecycle is Lifecycle.READY


def test_attitude_lost_while_driving_is_a_fault_although_heartbeats_go_on() -> None:
    bench = ArduBench()
    bench.active()

    def drive_without_attitude() -> None:
        bench.rover.set_interval(30, -1.0, bench.now_s)
        bench.drive()

    bench.until(lambda: bench.session.lifecycle is Lifecycle.FAULT, 1.3, drive_without_attitude)
    assert "position or attitude" in bench.session.fault
    bench.until(lambda: bench.rover.mode == Mode.HOLD, 5.0, drive_without_attitude)


def test_a_link_lost_for_long_stops_the_rover_by_its_own_failsafe_and_comes_back_ready() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.cut = True
    bench.until(lambda: bench.session.lifecycle is Lifecycle.FAULT, 3.5, bench.drive)
    bench.run(8.0, bench.drive)
    assert bench.rover.failsafe
    assert (bench.rover.mode, bench.rover.armed) == (Mode.HOLD, True)
    assert bench.body.state().speed_m_s < 0.05
    bench.cut = False
    bench.until(lambda: bench.session.lifecycle is Lifecycle.READY, each=bench.drive)
    assert (bool(bench.rover.failsafe), bool(bench.rover.armed)) == (False, False)


def test_a_restart_is_a_fault_and_the_rates_are_asked_again() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(2.0, bench.drive)
    before = bench.session.reading()
    assert before is not None
    bench.rover.power_on(bench.now_s)
    bench.until(lambda: bench.session.lifecycle is Lifecycle.FAULT, 2.5, bench.drive)
    bench.ready()
    stamps = set()
    bench.run(1.0, lambda: stamps.add(getattr(bench.session.reading(), "stamp_s", 0.0)))
    assert len(stamps) > 15
    after = bench.session.reading()
    assert after is not None
    assert after.odometry.x_m == pytest.approx(before.odometry.x_m, abs=0.3)
