"""What holds for ArduPilot and PX4 alike: pilots, refused arms, lost positions, restarts, non-finite set-points."""

from __future__ import annotations

import math

import pytest

from fullswarm.drivers.base import Hazard, Lifecycle, Twist
from fullswarm.drivers.mavlink import px4
from fullswarm.drivers.mavlink.protocol import Mode
from tests.unit.mavlink_bench import STEP_S, ArduBench, Px4Bench

Autopilot = type[ArduBench] | type[Px4Bench]
BOTH = pytest.mark.parametrize("autopilot", [ArduBench, Px4Bench])


@BOTH
@pytest.mark.parametrize("bad", [Twist(math.nan, 0.0), Twist(0.0, math.inf)])
def test_non_finite_is_refused_and_stops(autopilot: Autopilot, bad: Twist) -> None:
    bench = autopilot()
    bench.active()
    bench.run(1.0, bench.drive)
    with pytest.raises(ValueError, match="finite"):
        bench.gate.command(bad, bench.now_s)
    bench.run(2 * STEP_S)
    # PX4 takes a velocity of exactly zero for a direction.
    assert bench.setpoint_m_s < 0.002
    assert isinstance(bench, Px4Bench) or bench.setpoint_m_s == 0.0


@pytest.mark.parametrize(
    ("autopilot", "mode", "name"),
    [
        (ArduBench, Mode.MANUAL, "MANUAL"),
        (ArduBench, Mode.HOLD, "HOLD"),
        (ArduBench, Mode.LOITER, "LOITER"),
        (Px4Bench, px4.MANUAL, "MANUAL"),
    ],
)
def test_a_pilot_keeps_control_until_it_is_given_back(autopilot: Autopilot, mode: int, name: str) -> None:
    bench = autopilot()
    bench.until(lambda: bench.session.state is Lifecycle.ACTIVE, each=bench.insist)
    bench.run(1.0, bench.insist)
    bench.pilot(mode)
    bench.until(lambda: bench.session.state is Lifecycle.READY, 0.2 if autopilot is ArduBench else 2.0, bench.insist)
    assert name in bench.session.fault
    assert bench.session.autopilot.mode_name(bench.DRIVEN) in bench.session.fault
    reading = bench.session.read()
    assert reading is not None
    assert reading.hazards & Hazard.ESTOP_BUTTON
    count = len(bench.rover.setpoints)
    bench.run(5.0, bench.insist)
    assert (bench.rover.mode, bench.rover.armed) == (mode, True)
    assert len(bench.rover.setpoints) == count
    if autopilot is ArduBench:
        bench.pilot(bench.DRIVEN)
    else:  # OFFBOARD cannot be switched on without a stream of set-points: a new request takes it back
        bench.session.deactivate(bench.now_s)
        bench.run(1.5)
    bench.until(lambda: bench.session.state is Lifecycle.ACTIVE, each=bench.insist)
    after = bench.session.read()
    assert after is not None
    assert not after.hazards & Hazard.ESTOP_BUTTON


@pytest.mark.parametrize(
    ("autopilot", "words"),
    [(ArduBench, "Arm: Throttle (RC3) is not neutral"), (Px4Bench, "Arming denied: High Accelerometer Bias")],
)
def test_a_refused_arm_is_reported_in_the_firmware_s_words_and_not_tried_all_the_time(
    autopilot: Autopilot, words: str
) -> None:
    bench = autopilot()
    bench.ready()
    verb, _, reason = words.partition(": ")
    bench.rover.refuse_arm = f"{reason}, and a text that is longer than a single chunk"
    bench.run(5.0, bench.insist)
    assert f"{verb}: {bench.rover.refuse_arm}" in bench.session.fault
    assert bench.session.state is Lifecycle.READY
    assert 2 <= sum(text.startswith(verb) for text in bench.texts) <= 6
    assert not any(record.armed for record in bench.rover.setpoints)
    bench.rover.refuse_arm = ""
    bench.until(lambda: bench.session.state is Lifecycle.ACTIVE, each=bench.insist)
    assert bench.session.fault == ""


@BOTH
def test_a_lost_position_is_a_fault_with_a_stop_and_comes_back_ready(autopilot: Autopilot) -> None:
    bench = autopilot()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.rover.located = False
    bench.until(lambda: bench.session.state is Lifecycle.FAULT, 1.2 if autopilot is ArduBench else 2.0, bench.drive)
    assert "position" in bench.session.fault
    bench.until(lambda: not bench.rover.armed and bench.rover.mode == bench.HOLD, 4.0, bench.drive)
    bench.rover.located = True
    bench.ready()
    bench.run(1.0, bench.drive)
    assert bench.session.state is Lifecycle.READY


@BOTH
def test_a_restart_is_a_fault_and_everything_is_requested_again(autopilot: Autopilot) -> None:
    bench = autopilot()
    bench.active()
    bench.run(2.0, bench.drive)
    before = bench.session.read()
    assert before is not None
    bench.rover.power_on(bench.now_s)
    bench.until(lambda: bench.session.state is Lifecycle.FAULT, 2.5 if autopilot is ArduBench else 3.0, bench.drive)
    bench.ready()
    stamps = set()
    bench.run(1.0, lambda: stamps.add(getattr(bench.session.read(), "stamp_s", 0.0)))
    assert len(stamps) > 15  # 10 Hz without a request
    after = bench.session.read()
    assert after is not None
    assert after.odometry.x_m == pytest.approx(before.odometry.x_m, abs=0.3)
