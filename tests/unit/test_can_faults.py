"""What goes wrong with a base, and what becomes of it, in simulated time."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Twist
from fullswarm.drivers.can import odrive
from fullswarm.drivers.can.odrive import AxisState, error_bit
from fullswarm.drivers.can.protocol import Frame
from tests.unit.can_rig import TICK_S, Rig


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_twist_that_is_not_finite_stops_the_robot(bad: float) -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.twist = None
    for twist in (Twist(bad, 0.0), Twist(0.0, bad)):
        with pytest.raises(ValueError, match="finite"):
            rig.gate.command(twist, rig.now)
    rig.step()
    assert struct.unpack("<ff", rig.sent[-1][1].data) == (0.0, 0.0)
    rig.until(lambda: max(rig.speeds()) < 0.01, 0.3)


@pytest.mark.parametrize("side", [0, 1])
def test_an_error_of_one_axis_idles_both(side: int) -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.odrives[side].inject("SPINOUT_DETECTED")
    assert rig.until_state(Lifecycle.FAULT, 0.2) <= 0.12  # one heartbeat
    rig.step()
    assert rig.idle()
    assert "SPINOUT_DETECTED" in rig.session.fault
    assert ("left", "right")[side] in rig.session.fault
    assert rig.applied != STAND
    rig.run(0.1)
    assert rig.applied == STAND


def test_after_an_error_ready_but_never_active() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.odrives[0].inject("DC_BUS_OVER_VOLTAGE")
    rig.until_state(Lifecycle.FAULT, 0.2)
    seen = []
    for _ in range(600):
        rig.step()
        seen.append(rig.session.state)
    assert Lifecycle.ACTIVE not in seen
    assert list(dict.fromkeys(seen)) == [Lifecycle.FAULT, Lifecycle.OPEN, Lifecycle.READY]
    assert seen.index(Lifecycle.OPEN) * TICK_S > 0.9  # a fault stays to be seen
    assert rig.session.fault == ""


def test_leaving_closed_loop_without_an_error_is_a_fault() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.odrives[1].drop_out()
    rig.until_state(Lifecycle.FAULT, 0.2)
    assert "right wheel (node 2) left closed loop" in rig.session.fault
    rig.step()
    assert rig.idle()


def test_an_e_stop_is_never_cleared_from_here() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.odrives[0].receive(odrive.encode(1, odrive.Estop()), rig.now)
    rig.until_state(Lifecycle.FAULT, 0.2)
    rig.sent.clear()
    rig.run(10.0)
    assert rig.session.state is Lifecycle.FAULT
    assert "ESTOP_REQUESTED" in rig.session.fault
    assert rig.session.reading is not None
    assert rig.session.reading.hazards is Hazard.ESTOP_BUTTON
    assert not any(frame.id & 0x1F == 0x18 for _, frame in rig.sent)
    rig.odrives[0].receive(odrive.encode(1, odrive.ClearErrors()), rig.now)
    rig.until_state(Lifecycle.READY, 2.0)


def test_an_e_stop_is_not_cleared_either_if_the_url_names_the_wrong_firmware() -> None:
    rig = Rig("odrive", "firmware=0.5")
    wrong = Rig("odrive", "firmware=0.6").settings
    rig.open(wrong)
    rig.active(Twist(0.3, 0.0))
    for node, axis in enumerate(rig.odrives, start=1):
        axis.receive(odrive.encode(node, odrive.Estop(), "0.5"), rig.now)
    rig.until_state(Lifecycle.FAULT, 0.2)
    rig.run(10.0)
    assert rig.session.state is Lifecycle.FAULT
    assert "with firmware=0.5 in its URL, ESTOP_REQUESTED" in rig.session.fault
    assert all(axis.error for axis in rig.odrives)


def test_an_e_stop_found_at_start_is_not_cleared_either() -> None:
    rig = Rig()
    rig.odrives[1].inject("ESTOP_REQUESTED")
    rig.until_state(Lifecycle.FAULT, 1.0)
    rig.run(5.0)
    assert rig.session.state is Lifecycle.FAULT
    assert rig.odrives[1].error


def test_an_old_error_is_cleared_at_start() -> None:
    rig = Rig()
    rig.odrives[0].inject("WATCHDOG_TIMER_EXPIRED")
    rig.until_state(Lifecycle.READY, 2.0)
    assert rig.session.fault == ""


def test_three_faults_while_driving_latch() -> None:
    rig = Rig()
    for _ in range(3):
        rig.active(Twist(0.3, 0.0))
        rig.odrives[0].inject("DRV_FAULT")
        rig.until_state(Lifecycle.FAULT, 0.2)
    assert "restart the agent" in rig.session.fault
    rig.session.lost("cable out", rig.now)
    assert rig.session.fault.startswith("cable out; before that: left wheel")
    rig.session.linked(rig.now)
    rig.run(10.0)
    assert rig.session.state is Lifecycle.FAULT
    assert "restart the agent" in rig.session.fault
    rig.open(rig.settings)
    rig.until_state(Lifecycle.READY, 2.0)


def test_an_axis_that_refuses_closed_loop() -> None:
    rig = Rig()
    rig.odrives[1].refuses = True
    rig.until_state(Lifecycle.READY, 2.0)
    rig.session.activate(rig.now)
    assert 0.5 <= rig.until_state(Lifecycle.FAULT, 0.7) <= 0.6
    assert "right wheel (node 2) did not enter closed loop" in rig.session.fault
    rig.step()
    assert rig.idle()


@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_lost_heartbeats(make: str) -> None:
    rig = Rig(make, "watchdog=0.5")
    rig.active(Twist(0.3, 0.0))
    rig.wheels[0].faults.unplugged = True
    assert 0.4 <= rig.until_state(Lifecycle.FAULT, 1.3) <= 0.6
    assert "no heartbeat from the left wheel (node 1)" in rig.session.fault
    rig.run(3.0)
    assert rig.session.fault
    assert max(map(abs, rig.speeds())) < 0.01
    rig.wheels[0].faults.unplugged = False
    rig.until_state(Lifecycle.READY, 2.0)
    rig.run(1.0)
    assert rig.session.state is Lifecycle.READY


def test_the_axis_watchdog_stops_a_robot_without_a_driver() -> None:
    rig = Rig("odrive", "watchdog=0.5")
    rig.active(Twist(0.3, 0.0))
    rig.run(2.0)  # fed by set-points
    assert rig.session.state is Lifecycle.ACTIVE
    rig.link = False
    rig.run(0.6)
    assert rig.idle()
    assert all(each.error == error_bit("WATCHDOG_TIMER_EXPIRED", "0.6") for each in rig.odrives)


def test_a_vesc_coasts_after_its_timeout() -> None:
    rig = Rig("vesc")
    rig.active(Twist(0.3, 0.0))
    rig.link = False
    rig.run(0.9)
    assert rig.speeds() == pytest.approx([0.3, 0.3], rel=0.01)
    rig.run(3.0)
    assert max(rig.speeds()) < 0.01


def test_no_motion_is_a_fault() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.odrives[0].faults.silent_motion = True
    rig.until_state(Lifecycle.FAULT, 1.3)
    assert "no motion from the left wheel" in rig.session.fault


def test_encoder_estimates_that_do_not_come_by_themselves_are_asked_for() -> None:
    rig = Rig()
    for each in rig.odrives:
        each.cyclic_motion = False
    rig.active(Twist(0.3, 0.0))
    rig.run(2.0)
    assert rig.session.state is Lifecycle.ACTIVE
    assert rig.session.reading is not None
    assert rig.session.reading.odometry.x_m == pytest.approx(rig.rolled()[0], abs=0.05)


@pytest.mark.parametrize("statuses", [frozenset(), frozenset({5})])
def test_a_vesc_without_status_messages_says_what_to_switch_on(statuses: frozenset[int]) -> None:
    rig = Rig("vesc", statuses=statuses)
    rig.until_state(Lifecycle.FAULT, 4.0)
    assert "CAN status 1 and 5" in rig.session.fault


def test_a_vesc_with_speed_only_counts_by_its_speed() -> None:
    rig = Rig("vesc", statuses=frozenset({1}))
    rig.active(Twist(0.3, 0.0))
    rig.run(2.0)
    reading = rig.session.reading
    assert reading is not None
    assert reading.odometry.x_m == pytest.approx(rig.rolled()[0], rel=0.03)


def test_nobody_there_becomes_a_fault_and_heals() -> None:
    rig = Rig()
    for each in rig.odrives:
        each.faults.unplugged = True
    assert rig.until_state(Lifecycle.FAULT, 4.0) >= 2.9
    assert "node 1" in rig.session.fault
    assert "node 2" in rig.session.fault
    for each in rig.odrives:
        each.faults.unplugged = False
    rig.until_state(Lifecycle.READY, 2.0)


def test_wheels_left_turning_by_a_dead_process_are_stopped_first() -> None:
    rig = Rig()
    for side, each in enumerate(rig.odrives):
        for frame in (*rig.settings.codecs()[side].engage(), odrive.encode(side + 1, odrive.SetVelocity(5.0))):
            each.receive(frame, rig.now)
    rig.until_state(Lifecycle.READY, 2.0)
    assert rig.idle()


def test_someone_else_closing_the_loop_is_undone() -> None:
    rig = Rig()
    rig.until_state(Lifecycle.READY, 2.0)
    rig.odrives[0].receive(odrive.encode(1, odrive.SetState(AxisState.CLOSED_LOOP)), rig.now)
    rig.until(rig.idle, 0.3)
    assert rig.session.state is Lifecycle.READY


def test_a_lost_bus_idles_the_wheels_when_it_is_back() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.link = False
    rig.session.lost("cable out", rig.now)
    rig.run(1.0)
    assert (rig.session.state, rig.session.fault) == (Lifecycle.FAULT, "cable out")
    rig.link = True
    rig.session.linked(rig.now)
    rig.step()
    assert rig.idle()
    assert "waiting for both wheels" in rig.session.fault
    rig.until_state(Lifecycle.READY, 3.0)


@hypothesis_settings(max_examples=30, deadline=None)
@given(
    st.lists(st.builds(Frame, st.integers(0, 0x7F), st.booleans(), st.binary(max_size=9), st.booleans()), max_size=60)
)
def test_rubbish_on_the_bus_never_activates_nor_raises(rubbish: list[Frame]) -> None:
    rig = Rig()
    rig.until_state(Lifecycle.READY, 2.0)
    for frame in rubbish:
        rig.session.received(frame, rig.now)
        rig.step()
        assert rig.session.state is not Lifecycle.ACTIVE
        reading = rig.session.reading
        assert reading is None or math.isfinite(reading.odometry.x_m + reading.twist.linear_m_s)
