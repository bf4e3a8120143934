"""The driver's conversation with a rover on its way into motion and out of it: arming, pilots, disarming."""

from __future__ import annotations

import pytest

from fullswarm.drivers.base import STAND, Hazard, Lifecycle
from fullswarm.drivers.mavlink.protocol import Mode, Result
from fullswarm.emulators.mavlink.firmware import Firmware
from tests.unit.mavlink_bench import ArduBench


def test_an_accepted_arm_that_no_heartbeat_shows_is_not_active() -> None:
    bench = ArduBench()
    bench.ready()
    bench.session.activate(bench.now_s)

    def disarm_at_once() -> None:
        bench.rover.armed = False

    bench.run(7.0, disarm_at_once)
    assert bench.session.state is Lifecycle.READY
    assert "did not arm" in bench.session.fault
    assert not bench.rover.setpoints


def test_deactivate_brakes_holds_and_disarms_and_the_next_start_is_from_zero() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.session.deactivate(bench.now_s)
    assert bench.drive() == STAND
    bench.until(lambda: bench.session.state is Lifecycle.READY, 3.0)
    assert (bench.rover.armed, bench.rover.mode) == (False, Mode.HOLD)
    assert bench.body.state().speed_m_s < 0.1
    bench.session.activate(bench.now_s)
    bench.until(lambda: bench.rover.armed)
    fastest = []
    bench.run(1.0, lambda: fastest.append(bench.body.state().speed_m_s))
    assert max(fastest) < 0.1


def test_deactivate_while_arming_ends_disarmed() -> None:
    bench = ArduBench()
    bench.ready()
    bench.session.activate(bench.now_s)
    bench.until(lambda: bench.rover.armed)
    assert bench.session.state is Lifecycle.READY  # armed, but no heartbeat has shown it yet
    bench.session.deactivate(bench.now_s)
    bench.run(3.0)
    assert (bench.rover.armed, bench.rover.mode) == (False, Mode.HOLD)
    assert bench.session.state is Lifecycle.READY


def test_after_a_take_over_a_new_wish_is_honoured() -> None:
    bench = ArduBench()
    bench.active()
    bench.rover.pilot_mode(Mode.HOLD)
    bench.until(lambda: bench.session.state is Lifecycle.READY)
    bench.run(1.5)
    bench.session.activate(bench.now_s)
    bench.until(lambda: bench.session.state is Lifecycle.ACTIVE)


def test_a_rover_disarmed_by_somebody_else_is_not_armed_again() -> None:
    bench = ArduBench()
    bench.active()
    bench.rover.armed = False
    bench.run(4.0, bench.insist)
    assert (bench.rover.armed, "disarmed" in bench.session.fault) == (False, True)


def test_a_rover_left_armed_by_another_run_is_disarmed_before_ready() -> None:
    bench = ArduBench()
    bench.run(0.02)
    bench.rover.mode, bench.rover.armed = Mode.GUIDED, True
    bench.ready()
    assert (bench.rover.armed, bench.rover.mode) == (False, Mode.HOLD)


def test_a_pilot_stays_in_charge_when_nobody_wishes_to_drive_any_more() -> None:
    bench = ArduBench()
    bench.until(lambda: bench.session.state is Lifecycle.ACTIVE, each=bench.insist)
    bench.rover.pilot_mode(Mode.MANUAL)
    bench.until(lambda: bench.session.state is Lifecycle.READY, each=bench.insist)
    bench.session.deactivate(bench.now_s)
    bench.run(0.5)
    reading = bench.session.read()
    assert reading is not None
    assert reading.hazards & Hazard.ESTOP_BUTTON
    assert (bench.rover.mode, bench.rover.armed) == (Mode.MANUAL, True)


def test_a_stop_that_is_said_again_and_again_is_not_begun_anew_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = ArduBench()
    bench.active()
    bench.run(0.5, bench.drive)
    monkeypatch.setattr(Firmware, "request_mode", lambda *_: Result.FAILED)
    bench.run(5.2, lambda: bench.session.deactivate(bench.now_s))
    assert bench.session.state is Lifecycle.FAULT
    assert "does not confirm hold and disarm" in bench.session.fault
