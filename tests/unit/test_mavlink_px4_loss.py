"""PX4 when something is lost or refused: the link, the position, the wheel to a pilot, arming, parameters."""

from __future__ import annotations

import itertools

from fullswarm.drivers.base import STAND, Hazard, Lifecycle
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import FrameSigner
from fullswarm.drivers.mavlink.px4 import HOLD, MANUAL, OFFBOARD
from fullswarm.emulators.mavlink.px4_firmware import Px4Firmware
from tests.unit.mavlink_bench import Px4Bench


def test_a_lost_link_is_a_stop_of_its_own_after_a_second_and_a_fault_that_heals_to_ready() -> None:
    bench = Px4Bench()
    bench.active()
    bench.run(2.0, bench.drive)
    bench.cut = True
    bench.run(0.9, bench.drive)
    assert bench.rover.mode == OFFBOARD
    bench.run(0.9, bench.drive)
    assert (bench.rover.mode, bench.body.state().speed_m_s) == (HOLD, 0.0)
    bench.until(lambda: bench.session.state is Lifecycle.FAULT, 4.0, bench.drive)
    assert bench.session.fault
    bench.run(3.0, bench.drive)
    bench.cut = False
    seen: set[Lifecycle] = set()
    since_s = bench.now_s
    bench.until(lambda: bench.session.state is Lifecycle.READY, 5.0, lambda: seen.add(bench.session.state))
    assert Lifecycle.ACTIVE not in seen
    assert not bench.rover.armed
    assert bench.now_s - since_s < 3.5  # disarmed first; a heartbeat a second is all that PX4 gives
    assert bench.drive() == STAND


def test_a_reboot_is_a_fault_and_everything_is_asked_again() -> None:
    bench = Px4Bench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.rover.power_on(bench.now_s)
    bench.until(lambda: bench.session.state is Lifecycle.FAULT, 3.0, bench.drive)
    bench.ready()
    stamps = set()
    bench.run(1.0, lambda: stamps.add(getattr(bench.session.read(), "stamp_s", 0.0)))
    assert len(stamps) > 15  # 10 Hz unasked


def test_a_lost_position_is_a_fault_with_a_stop() -> None:
    bench = Px4Bench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.rover.located = False
    bench.until(lambda: bench.session.state is Lifecycle.FAULT, 2.0, bench.drive)
    bench.until(lambda: not bench.rover.armed, 4.0, bench.drive)
    assert "position" in bench.session.fault


def test_a_pilot_is_not_fought() -> None:
    bench = Px4Bench()
    bench.until(lambda: bench.session.state is Lifecycle.ACTIVE, each=bench.insist)
    bench.rover.pilot_mode(MANUAL)
    bench.until(lambda: bench.session.state is Lifecycle.READY, 2.0, bench.insist)
    assert "MANUAL" in bench.session.fault
    assert "OFFBOARD" in bench.session.fault
    reading = bench.session.read()
    assert reading is not None
    assert reading.hazards & Hazard.ESTOP_BUTTON
    bench.run(4.0, bench.insist)
    assert (bench.rover.mode, bench.rover.armed) == (MANUAL, True)


def test_a_refused_arm_is_told_in_the_firmware_s_words() -> None:
    bench = Px4Bench()
    bench.ready()
    bench.rover.refuse_arm = "High Accelerometer Bias, and a text that is longer than a single chunk"
    bench.until(lambda: bench.session.fault != "", each=bench.insist)
    assert f"Arming denied: {bench.rover.refuse_arm}" in bench.session.fault
    assert bench.session.state is Lifecycle.READY
    bench.until(lambda: bench.rover.mode == HOLD, 5.0)


def test_a_long_timeout_of_its_own_keeps_it_open() -> None:
    bench = Px4Bench()
    bench.rover.parameters["COM_OF_LOSS_T"] = (60.0, p.PARAM_REAL32)
    bench.run(4.0, bench.insist)
    assert bench.session.state is Lifecycle.OPEN
    assert "COM_OF_LOSS_T" in bench.session.why


def test_a_vehicle_that_signs_and_does_not_answer_wants_a_key() -> None:
    bench = Px4Bench()
    bench.deaf = True
    bench.run(8.0)
    assert bench.session.why == "COM_OBL_RC_ACT=5 is not confirmed: the vehicle does not answer"
    bench = Px4Bench()
    bench.deaf = True
    bench.rover = Px4Firmware(bench.body, signer=FrameSigner(bytes(32), 0, itertools.count(1).__next__))
    bench.rover.power_on(100.0)
    bench.run(1.0)
    assert "it signs its messages: give its key with ?sign_key=" in bench.session.why
