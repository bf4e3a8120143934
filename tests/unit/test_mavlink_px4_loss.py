"""PX4 when something is lost or refused: the link, the position, the wheel to a pilot, arming, parameters."""

from __future__ import annotations

import itertools

from fullswarm.drivers.base import STAND, Lifecycle
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import FrameSigner
from fullswarm.drivers.mavlink.px4 import HOLD, OFFBOARD
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
