"""The driver's conversation with a rover that drives: setpoints, stops, and what it tells meanwhile."""

from __future__ import annotations

import pytest

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Twist
from tests.unit.mavlink_bench import STEP_S, ArduBench


def test_setpoints_go_out_at_20_hz_while_commanded_and_zero_after_300_ms() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, bench.drive)
    count = len(bench.rover.setpoints)
    bench.run(1.0, bench.drive)
    assert 18 <= len(bench.rover.setpoints) - count <= 22
    silent_s = bench.now_s
    bench.run(1.0)
    after = [record for record in bench.rover.setpoints if record.at_s > silent_s]
    zeros = [record.at_s - silent_s for record in after if record.speed_m_s == 0.0]
    assert 0.25 < zeros[0] < 0.4
    assert len(zeros) > 10  # said again and again
    assert bench.session.state is Lifecycle.ACTIVE


def test_a_stop_does_not_wait_for_its_turn() -> None:
    bench = ArduBench()
    bench.active()
    bench.until(lambda: bench.rover.setpoints[-1].speed_m_s == 0.5, each=bench.drive)
    bench.drive(0.0)
    bench.run(2 * STEP_S)
    assert bench.rover.setpoints[-1].speed_m_s == 0.0


def test_clipping_is_told_and_the_vehicle_s_own_limit_is_known() -> None:
    bench = ArduBench()
    assert bench.drive() == STAND
    bench.rover.parameters["WP_SPEED"] = 0.25
    bench.active()
    assert bench.drive(-9.0, 9.0) == Twist(-0.25, 2.0)


def test_spin_uses_the_turn_mask() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(1.0, lambda: bench.drive(0.0, 0.6))
    assert bench.rover.setpoints[-1].mask == 1535
    assert bench.body.state().turn_rad_s == pytest.approx(0.6)
    reading = bench.session.read()
    assert reading is not None
    assert reading.twist.angular_rad_s == pytest.approx(0.6, abs=0.05)


def test_reverse_is_a_negative_speed_in_any_direction() -> None:
    bench = ArduBench()
    bench.active()
    bench.run(2.0, lambda: bench.drive(0.0, 0.8))
    bench.run(1.0, lambda: bench.drive(-0.5))
    reading = bench.session.read()
    assert reading is not None
    assert reading.twist.linear_m_s == pytest.approx(-0.5, abs=0.05)


def test_the_vehicle_s_warnings_can_be_read() -> None:
    bench = ArduBench()
    bench.ready()
    bench.rover.text("Battery 1 low voltage 10.21V used 2100 mAh, and this is a second chunk")
    bench.rover.text("EKF3 IMU0 is using GPS", severity=6)
    bench.run(0.1)
    texts = bench.session.texts(bench.now_s)
    assert texts == ["Battery 1 low voltage 10.21V used 2100 mAh, and this is a second chunk"]
    assert bench.session.texts(bench.now_s + 60.0) == []


def test_the_safety_switch_is_an_emergency_stop() -> None:
    bench = ArduBench()
    bench.active()
    for pressed in (True, False):
        bench.rover.safety = pressed
        bench.run(0.6)
        reading = bench.session.read()
        assert reading is not None
        assert bool(reading.hazards & Hazard.ESTOP_BUTTON) is pressed
        assert bool(reading.hazards & Hazard.MOTORS_OFF) is pressed
