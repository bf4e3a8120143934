"""The lifecycle against the emulated controllers in simulated time: no bus, no thread, no waiting."""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Callable, Sequence

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from fullswarm.clock import SimClock
from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Twist
from fullswarm.drivers.can import odrive, vesc
from fullswarm.drivers.can.emulator import Base, ODriveEmulator, VescEmulator
from fullswarm.drivers.can.machine import BaseMachine
from fullswarm.drivers.can.odrive import AxisState, OdriveCodec
from fullswarm.drivers.can.protocol import Frame, Wheel, WheelCodec
from fullswarm.drivers.can.vesc import VescCodec

BASE_M, LIMIT_M_S = 0.3, 0.5
TICK_S = 0.005
WHEELS = (Wheel(0.05, 10.0, 7), Wheel(0.05, 10.0, 7, sign=-1))


class Wire(list[Frame]):
    """A bus with one listener."""

    def send(self, frame: Frame) -> None:
        self.append(frame)


class Rig:
    """A machine and two emulated controllers in lockstep, 5 ms at a time."""

    def __init__(self, make: str = "odrive", watchdog_s: float | None = None, **vesc_options: object) -> None:
        self.clock = SimClock(100.0)
        self.body = Base(self.clock)
        self.wire = Wire()
        self.sent: list[tuple[float, Frame]] = []
        codecs: tuple[WheelCodec, WheelCodec]
        if make == "odrive":
            codecs = (OdriveCodec(1, WHEELS[0], limit_turn_s=50.0), OdriveCodec(2, WHEELS[1], limit_turn_s=50.0))
            self.odrives = [
                ODriveEmulator(self.wire, side + 1, WHEELS[side], limit_turn_s=50.0, watchdog_s=watchdog_s)
                for side in (0, 1)
            ]
            self.wheels: Sequence[ODriveEmulator | VescEmulator] = self.odrives
        else:
            codecs = (VescCodec(1, WHEELS[0]), VescCodec(2, WHEELS[1]))
            statuses = vesc_options.get("statuses", frozenset({1, 5}))
            assert isinstance(statuses, frozenset)
            self.wheels = [VescEmulator(self.wire, side + 1, WHEELS[side], statuses=statuses) for side in (0, 1)]
        self.machine = BaseMachine(codecs, BASE_M, LIMIT_M_S)
        self.link = True
        self.twist: Twist | None = None  # commanded each 20 ms
        self.applied = STAND
        self._step = 0
        self.machine.opened(self.now)

    @property
    def now(self) -> float:
        return self.clock.now_s()

    def step(self) -> None:
        self._step += 1
        self.clock.advance_to(100.0 + self._step * TICK_S)
        if self._step % 2 == 0:
            travelled = self.body.travelled()
            for wheel, distance in zip(self.wheels, travelled, strict=True):
                wheel.step(distance, self.now)
            self.body.set_wheels(*(wheel.spin.speed_m_s for wheel in self.wheels))
        if not self.link:
            self.wire.clear()
            return
        for frame in self.wire:
            self.machine.receive(frame, self.now)
        self.wire.clear()
        if self.twist is not None and self._step % 4 == 0:
            self.applied = self.machine.command(self.twist, self.now)
        if self._step % 4 == 0 or self.machine.urgent:
            for frame in self.machine.tick(self.now):
                self.sent.append((self.now, frame))
                for wheel in self.wheels:
                    wheel.receive(frame, self.now)

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / TICK_S)):
            self.step()

    def until(self, condition: Callable[[], bool], limit_s: float) -> float:
        """Run until `condition`; return how long it took."""
        start_s = self.now
        while not condition():
            assert self.now - start_s <= limit_s, f"{self.machine.state} {self.machine.fault}"
            self.step()
        return self.now - start_s

    def until_state(self, state: Lifecycle, limit_s: float) -> float:
        return self.until(lambda: self.machine.state is state, limit_s)

    def active(self, twist: Twist | None = None) -> None:
        """Bring the robot to ACTIVE and let it drive."""
        self.until_state(Lifecycle.READY, 2.0)
        self.machine.activate(self.now)
        self.until_state(Lifecycle.ACTIVE, 0.6)
        self.twist = twist
        if twist is not None:
            self.run(0.5)

    def speeds(self) -> list[float]:
        return [wheel.spin.speed_m_s for wheel in self.wheels]

    def idle(self) -> bool:
        return all(each.state is AxisState.IDLE for each in self.odrives)


@pytest.mark.parametrize("make", ["odrive", "vesc"])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_drives_and_counts(make: str, direction: float) -> None:
    rig = Rig(make)
    rig.active(Twist(0.3 * direction, 0.0))
    rig.run(3.0)
    rig.twist = STAND
    rig.run(1.0)
    reading = rig.machine.reading
    assert reading is not None
    true_m = rig.body.travelled()[0]
    assert true_m * direction > 0.9
    assert reading.odometry.x_m == pytest.approx(true_m, rel=0.01)
    one_count_m = 0.05 * math.tau / (10 * 7 * 6) if make == "vesc" else 0.0  # of heading, over the whole way
    assert abs(reading.odometry.y_m) <= 0.001 + 1.1 * one_count_m / BASE_M * abs(true_m)
    assert rig.machine.state is Lifecycle.ACTIVE


@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_turning_in_place_counts_the_angle(make: str) -> None:
    rig = Rig(make)
    rig.active(Twist(0.0, 1.5))
    rig.run(1.0)
    left, right = rig.body.travelled()
    reading = rig.machine.reading
    assert reading is not None
    assert reading.odometry.heading_rad == pytest.approx((right - left) / BASE_M, rel=0.03)
    assert reading.twist.angular_rad_s == pytest.approx(1.5, rel=0.02)


def test_nothing_moves_before_activation() -> None:
    rig = Rig()
    rig.twist = Twist(0.3, 0.0)
    rig.until_state(Lifecycle.READY, 1.0)
    rig.run(1.0)
    assert rig.applied == STAND
    assert rig.idle()
    assert rig.speeds() == [0.0, 0.0]


def test_activation_starts_from_zero() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.machine.deactivate(rig.now)
    rig.twist = None
    rig.until(rig.idle, 1.0)
    rig.machine.activate(rig.now)
    rig.until_state(Lifecycle.ACTIVE, 0.6)
    rig.run(0.5)
    assert rig.speeds() == pytest.approx([0.0, 0.0], abs=1e-6)


def test_saturation_reports_what_is_applied() -> None:
    rig = Rig()
    rig.active(Twist(1.0, 2.0))
    assert max(abs(speed) for speed in rig.speeds()) == pytest.approx(LIMIT_M_S, rel=1e-3)
    assert rig.applied.linear_m_s / rig.applied.angular_rad_s == pytest.approx(0.5, rel=1e-5)


def test_vesc_dead_band_is_reported_and_braked() -> None:
    rig = Rig("vesc")
    rig.active(Twist(0.3, 0.0))
    rig.twist = Twist(0.05, 0.0)  # 668 ERPM
    rig.run(0.2)
    assert rig.applied == STAND
    assert rig.sent[-1][1].id >> 8 == vesc.Command.SET_BRAKE


@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_silence_is_a_stop(make: str) -> None:
    rig = Rig(make)
    rig.active(Twist(0.3, 0.0))
    rig.twist = None
    rig.run(0.25)
    assert min(rig.speeds()) == pytest.approx(0.3, rel=0.01)
    rig.until(lambda: max(rig.speeds()) < 0.01, 0.6)
    assert rig.machine.state is Lifecycle.ACTIVE


def test_set_points_at_50_hz() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.sent.clear()
    rig.run(1.0)
    times = [at for at, frame in rig.sent if frame.id == 1 << 5 | odrive.Command.SET_VELOCITY]
    assert 49 <= len(times) <= 51
    assert max(b - a for a, b in itertools.pairwise(times)) < 0.026


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_twist_that_is_not_finite_stops_the_robot(bad: float) -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.twist = None
    for twist in (Twist(bad, 0.0), Twist(0.0, bad)):
        with pytest.raises(ValueError, match="finite"):
            rig.machine.command(twist, rig.now)
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
    assert "SPINOUT_DETECTED" in rig.machine.fault
    assert ("left", "right")[side] in rig.machine.fault
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
        seen.append(rig.machine.state)
    assert Lifecycle.ACTIVE not in seen
    assert list(dict.fromkeys(seen)) == [Lifecycle.FAULT, Lifecycle.OPEN, Lifecycle.READY]
    assert seen.index(Lifecycle.OPEN) * TICK_S > 0.9  # a fault stays to be seen
    assert rig.machine.fault == ""


def test_leaving_closed_loop_without_an_error_is_a_fault() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.odrives[1].drop_out()
    rig.until_state(Lifecycle.FAULT, 0.2)
    assert "right wheel (node 2) left closed loop" in rig.machine.fault
    rig.step()
    assert rig.idle()


def test_an_e_stop_is_never_cleared_from_here() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.odrives[0].receive(odrive.estop(1), rig.now)
    rig.until_state(Lifecycle.FAULT, 0.2)
    rig.sent.clear()
    rig.run(10.0)
    assert rig.machine.state is Lifecycle.FAULT
    assert "ESTOP_REQUESTED" in rig.machine.fault
    assert rig.machine.reading is not None
    assert rig.machine.reading.hazards is Hazard.ESTOP_BUTTON
    assert not any(frame.id & 0x1F == odrive.Command.CLEAR_ERRORS for _, frame in rig.sent)
    rig.odrives[0].receive(odrive.clear_errors(1), rig.now)
    rig.until_state(Lifecycle.READY, 2.0)


def test_an_e_stop_found_at_start_is_not_cleared_either() -> None:
    rig = Rig()
    rig.odrives[1].inject("ESTOP_REQUESTED")
    rig.until_state(Lifecycle.FAULT, 1.0)
    rig.run(5.0)
    assert rig.machine.state is Lifecycle.FAULT
    assert rig.odrives[1].error


def test_an_old_error_is_cleared_at_start() -> None:
    rig = Rig()
    rig.odrives[0].inject("WATCHDOG_TIMER_EXPIRED")
    rig.until_state(Lifecycle.READY, 2.0)
    assert rig.machine.fault == ""


def test_three_faults_while_driving_latch() -> None:
    rig = Rig()
    for _ in range(3):
        rig.active(Twist(0.3, 0.0))
        rig.odrives[0].inject("DRV_FAULT")
        rig.until_state(Lifecycle.FAULT, 0.2)
    assert "restart the agent" in rig.machine.fault
    rig.run(10.0)
    assert rig.machine.state is Lifecycle.FAULT
    rig.machine.opened(rig.now)
    rig.until_state(Lifecycle.READY, 2.0)


def test_an_axis_that_refuses_closed_loop() -> None:
    rig = Rig()
    rig.odrives[1].refuses = True
    rig.until_state(Lifecycle.READY, 2.0)
    rig.machine.activate(rig.now)
    assert 0.5 <= rig.until_state(Lifecycle.FAULT, 0.7) <= 0.6
    assert "right wheel (node 2) did not enter closed loop" in rig.machine.fault
    rig.step()
    assert rig.idle()


@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_lost_heartbeats(make: str) -> None:
    rig = Rig(make, watchdog_s=0.5)
    rig.active(Twist(0.3, 0.0))
    rig.wheels[0].unplugged = True
    assert 0.85 <= rig.until_state(Lifecycle.FAULT, 1.3) <= 1.1
    assert "no heartbeat from the left wheel (node 1)" in rig.machine.fault
    rig.run(3.0)
    assert rig.machine.fault
    assert max(map(abs, rig.speeds())) < 0.01
    rig.wheels[0].unplugged = False
    rig.until_state(Lifecycle.READY, 2.0)
    rig.run(1.0)
    assert rig.machine.state is Lifecycle.READY


def test_the_axis_watchdog_stops_a_robot_without_a_driver() -> None:
    rig = Rig(watchdog_s=0.5)
    rig.active(Twist(0.3, 0.0))
    rig.run(2.0)  # fed by set-points
    assert rig.machine.state is Lifecycle.ACTIVE
    rig.link = False
    rig.run(0.6)
    assert rig.idle()
    assert all(each.error == odrive.error_bit("WATCHDOG_TIMER_EXPIRED", "0.6") for each in rig.odrives)


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
    rig.odrives[0].mute_motion = True
    rig.until_state(Lifecycle.FAULT, 1.3)
    assert "no motion from the left wheel" in rig.machine.fault


def test_encoder_estimates_that_do_not_come_by_themselves_are_asked_for() -> None:
    rig = Rig()
    for each in rig.odrives:
        each.cyclic_motion = False
    rig.active(Twist(0.3, 0.0))
    rig.run(2.0)
    assert rig.machine.state is Lifecycle.ACTIVE
    assert rig.machine.reading is not None
    assert rig.machine.reading.odometry.x_m == pytest.approx(rig.body.travelled()[0], abs=0.05)


@pytest.mark.parametrize("statuses", [frozenset(), frozenset({5})])
def test_a_vesc_without_status_messages_says_what_to_switch_on(statuses: frozenset[int]) -> None:
    rig = Rig("vesc", statuses=statuses)
    rig.until_state(Lifecycle.FAULT, 4.0)
    assert "CAN status 1 and 5" in rig.machine.fault


def test_a_vesc_with_speed_only_counts_by_its_speed() -> None:
    rig = Rig("vesc", statuses=frozenset({1}))
    rig.active(Twist(0.3, 0.0))
    rig.run(2.0)
    reading = rig.machine.reading
    assert reading is not None
    assert reading.odometry.x_m == pytest.approx(rig.body.travelled()[0], rel=0.03)


def test_nobody_there_becomes_a_fault_and_heals() -> None:
    rig = Rig()
    for each in rig.odrives:
        each.unplugged = True
    assert rig.until_state(Lifecycle.FAULT, 4.0) >= 2.9
    assert "node 1" in rig.machine.fault
    assert "node 2" in rig.machine.fault
    for each in rig.odrives:
        each.unplugged = False
    rig.until_state(Lifecycle.READY, 2.0)


def test_wheels_left_turning_by_a_dead_process_are_stopped_first() -> None:
    rig = Rig()
    for side, each in enumerate(rig.odrives):
        for frame in (*OdriveCodec(side + 1, WHEELS[side]).engage(), odrive.set_velocity(side + 1, 5.0)):
            each.receive(frame, rig.now)
    rig.until_state(Lifecycle.READY, 2.0)
    assert rig.idle()


def test_deactivate_rolls_out_and_lets_go() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.machine.deactivate(rig.now)
    assert rig.machine.state is Lifecycle.READY
    rig.step()
    assert not rig.idle()  # still regulated to zero, which brakes
    rig.until(rig.idle, 0.6)
    assert max(rig.speeds()) < 0.05


def test_someone_else_closing_the_loop_is_undone() -> None:
    rig = Rig()
    rig.until_state(Lifecycle.READY, 2.0)
    rig.odrives[0].receive(odrive.set_state(1, AxisState.CLOSED_LOOP), rig.now)
    rig.until(rig.idle, 0.3)
    assert rig.machine.state is Lifecycle.READY


def test_a_lost_bus_idles_the_wheels_when_it_is_back() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.link = False
    rig.machine.bus_lost("cable out", rig.now)
    rig.run(1.0)
    assert (rig.machine.state, rig.machine.fault) == (Lifecycle.FAULT, "cable out")
    rig.link = True
    rig.machine.bus_back(rig.now)
    rig.step()
    assert rig.idle()
    assert "waiting for both wheels" in rig.machine.fault
    rig.until_state(Lifecycle.READY, 3.0)


def test_leaving_goes_over_zero_to_idle() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.machine.leave(rig.now)
    rig.until(lambda: rig.machine.at_rest, 1.0)
    assert rig.idle()
    rig.machine.activate(rig.now)
    rig.run(0.5)
    assert rig.idle()
    assert odrive.set_state(2, AxisState.IDLE) in rig.machine.closed(rig.now)
    assert rig.machine.state is Lifecycle.CLOSED


@hypothesis_settings(max_examples=30, deadline=None)
@given(
    st.lists(st.builds(Frame, st.integers(0, 0x7F), st.booleans(), st.binary(max_size=9), st.booleans()), max_size=60)
)
def test_rubbish_on_the_bus_never_activates_nor_raises(rubbish: list[Frame]) -> None:
    rig = Rig()
    rig.until_state(Lifecycle.READY, 2.0)
    for frame in rubbish:
        rig.machine.receive(frame, rig.now)
        rig.step()
        assert rig.machine.state is not Lifecycle.ACTIVE
        reading = rig.machine.reading
        assert reading is None or math.isfinite(reading.odometry.x_m + reading.twist.linear_m_s)
