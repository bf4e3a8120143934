"""The driver's conversation against the emulated firmware, in memory and in simulated time."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import pytest

from fullswarm.clock import SimClock
from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Limits, Twist
from fullswarm.drivers.body import FreeBody
from fullswarm.drivers.mavlink.codec import StreamParser, decode
from fullswarm.drivers.mavlink.firmware import Firmware
from fullswarm.drivers.mavlink.protocol import Mode, StatusText
from fullswarm.drivers.mavlink.session import Options, Session

STEP_S = 0.01
LIMITS = Limits(1.0, 2.0, 1.0, 2.0)


class Bench:
    """Session and firmware with a wire between them that may lose frames."""

    def __init__(self, boot_s: float = 0.2, loss: float = 0.0, loop_hz: float = 50.0) -> None:
        self._clock = SimClock(100.0)
        self.body = FreeBody(clock=self._clock)
        self.rover = Firmware(self.body, boot_s=boot_s, loop_hz=loop_hz)
        self.rover.power_on(self.now_s)
        self.session = Session(Options(1, LIMITS, "bench"), self.now_s)
        self.texts: list[str] = []
        self.cut = False
        self._loss, self._random = loss, random.Random(1)
        self._down, self._up = StreamParser(), StreamParser()

    @property
    def now_s(self) -> float:
        return self._clock.now_s()

    def step(self) -> None:
        self._clock.advance_to(self.now_s + STEP_S)
        for frame in self.rover.tick(self.now_s):
            for message in self._pass(frame, self._down):
                received = decode(message)
                if received is not None and isinstance(received.body, StatusText):
                    self.texts.append(received.body.text)
                self.session.receive(message, self.now_s)
        for frame in self.session.tick(self.now_s):
            for message in self._pass(frame, self._up):
                self.rover.receive(message, self.now_s)

    def _pass(self, frame: bytes, parser: StreamParser) -> list[object]:
        if self.cut or self._random.random() < self._loss:
            return []
        return parser.feed(frame)

    def run(self, duration_s: float, each: Callable[[], object] | None = None) -> None:
        for _ in range(round(duration_s / STEP_S)):
            if each is not None:
                each()
            self.step()

    def until(
        self, condition: Callable[[], bool], timeout_s: float = 10.0, each: Callable[[], object] | None = None
    ) -> None:
        end_s = self.now_s + timeout_s
        while not condition():
            assert self.now_s < end_s, f"waited in vain: {self.session.lifecycle} {self.session.fault}"
            self.run(STEP_S, each)

    def drive(self, speed_m_s: float = 0.5, turn_rad_s: float = 0.0) -> Twist:
        return self.session.command(Twist(speed_m_s, turn_rad_s), self.now_s)

    def insist(self) -> None:
        """Do what an agent does whose behaviour is on."""
        self.session.activate(self.now_s)
        self.drive()

    def ready(self) -> None:
        self.until(lambda: self.session.lifecycle is Lifecycle.READY, 60.0)

    def active(self) -> None:
        self.ready()
        self.session.activate(self.now_s)
        self.until(lambda: self.session.lifecycle is Lifecycle.ACTIVE)


# ---------------------------------------------------------------- start
def test_a_real_boot_takes_its_time_and_early_acks_are_not_believed() -> None:
    bench = Bench(boot_s=42.4)
    bench.run(41.0, bench.insist)
    assert bench.session.lifecycle is Lifecycle.OPEN
    assert "position" in bench.session.why
    assert not bench.rover.armed
    bench.ready()
    assert bench.now_s - 100.0 == pytest.approx(42.4, abs=1.5)
    assert not bench.rover.setpoints


def test_no_vehicle_is_a_fault_after_three_seconds_and_heals() -> None:
    bench = Bench()
    bench.cut = True
    bench.run(3.2)
    assert bench.session.lifecycle is Lifecycle.FAULT
    assert "no heartbeat from system 1" in bench.session.fault
    bench.cut = False
    bench.ready()
    assert bench.session.fault == ""


def test_rates_are_asked_within_the_cap_and_lowered_when_denied() -> None:
    bench = Bench(loop_hz=20.0)  # cap 16 Hz
    bench.ready()
    bench.run(1.0)
    stamps = set()
    bench.run(2.0, lambda: stamps.add(getattr(bench.session.reading(), "stamp_s", 0.0)))
    assert 17 <= len(stamps) <= 22  # 10 Hz
    assert any("too fast" in text for text in bench.texts)


def test_lost_frames_only_cost_time() -> None:
    bench = Bench(loss=0.3)
    bench.until(lambda: bench.session.lifecycle is Lifecycle.ACTIVE, 60.0, bench.insist)
    bench.run(2.0, bench.drive)
    assert bench.body.state().speed_m_s > 0.4
    assert all(record.armed for record in bench.rover.setpoints)
    bench.session.deactivate(bench.now_s)
    bench.until(lambda: not bench.rover.armed and bench.rover.mode == Mode.HOLD)


@pytest.mark.parametrize(("name", "value"), [("SYSID_MYGCS", 250.0)])
def test_a_failsafe_that_would_not_watch_us_keeps_it_open(name: str, value: float) -> None:
    bench = Bench()
    bench.rover.parameters[name] = value
    bench.run(4.0)
    assert bench.session.lifecycle is Lifecycle.OPEN
    assert name in bench.session.why


def test_without_the_failsafe_parameter_it_is_never_ready() -> None:
    bench = Bench()
    del bench.rover.parameters["FS_GCS_ENABLE"]
    bench.run(6.0, bench.insist)
    assert bench.session.lifecycle is Lifecycle.OPEN
    assert "FS_GCS_ENABLE=1 is not confirmed: the vehicle does not answer" in bench.session.why


# ---------------------------------------------------------------- driving
def test_setpoints_go_out_at_20_hz_while_commanded_and_zero_after_300_ms() -> None:
    bench = Bench()
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
    assert bench.session.lifecycle is Lifecycle.ACTIVE


def test_a_stop_does_not_wait_for_its_turn() -> None:
    bench = Bench()
    bench.active()
    bench.until(lambda: bench.rover.setpoints[-1].speed_m_s == 0.5, each=bench.drive)
    bench.drive(0.0)
    bench.run(2 * STEP_S)
    assert bench.rover.setpoints[-1].speed_m_s == 0.0


def test_clipping_is_told_and_the_vehicle_s_own_limit_is_known() -> None:
    bench = Bench()
    assert bench.drive() == STAND
    bench.rover.parameters["WP_SPEED"] = 0.25
    bench.active()
    assert bench.drive(-9.0, 9.0) == Twist(-0.25, 2.0)


@pytest.mark.parametrize("bad", [Twist(math.nan, 0.0), Twist(0.0, math.inf)])
def test_non_finite_is_refused_and_stops(bad: Twist) -> None:
    bench = Bench()
    bench.active()
    bench.run(0.5, bench.drive)
    with pytest.raises(ValueError, match="finite"):
        bench.session.command(bad, bench.now_s)
    bench.run(2 * STEP_S)
    assert bench.rover.setpoints[-1].speed_m_s == 0.0


def test_spin_uses_the_turn_mask() -> None:
    bench = Bench()
    bench.active()
    bench.run(1.0, lambda: bench.drive(0.0, 0.6))
    assert bench.rover.setpoints[-1].mask == 1535
    assert bench.body.state().turn_rad_s == pytest.approx(0.6)
    reading = bench.session.reading()
    assert reading is not None
    assert reading.twist.angular_rad_s == pytest.approx(0.6, abs=0.05)


def test_reverse_is_a_negative_speed_in_any_direction() -> None:
    bench = Bench()
    bench.active()
    bench.run(2.0, lambda: bench.drive(0.0, 0.8))
    bench.run(1.0, lambda: bench.drive(-0.5))
    reading = bench.session.reading()
    assert reading is not None
    assert reading.twist.linear_m_s == pytest.approx(-0.5, abs=0.05)


def test_rates_that_were_forgotten_are_asked_again() -> None:
    bench = Bench()
    bench.ready()
    for message in (30, 32):
        bench.rover.set_interval(message, 0.0, bench.now_s)  # back to 1 Hz
    bench.run(5.0)
    stamps = set()
    bench.run(1.0, lambda: stamps.add(getattr(bench.session.reading(), "stamp_s", 0.0)))
    assert len(stamps) > 15


def test_the_name_of_the_station_s_parameter_from_4_7_on_is_known() -> None:
    bench = Bench()
    bench.rover.parameters["MAV_GCS_SYSID"] = 250.0
    bench.run(4.0)
    assert "MAV_GCS_SYSID is 250" in bench.session.why


def test_after_a_cut_it_is_ready_within_two_seconds_never_active_and_disarmed_first() -> None:
    bench = Bench()
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


def test_the_vehicle_s_warnings_can_be_read() -> None:
    bench = Bench()
    bench.ready()
    bench.rover.text("Battery 1 low voltage 10.21V used 2100 mAh, and this is a second chunk")
    bench.rover.text("EKF3 IMU0 is using GPS", severity=6)
    bench.run(0.1)
    texts = bench.session.texts(bench.now_s)
    assert texts == ["Battery 1 low voltage 10.21V used 2100 mAh, and this is a second chunk"]
    assert bench.session.texts(bench.now_s + 60.0) == []


def test_the_safety_switch_is_an_emergency_stop() -> None:
    bench = Bench()
    bench.active()
    for pressed in (True, False):
        bench.rover.safety = pressed
        bench.run(0.6)
        reading = bench.session.reading()
        assert reading is not None
        assert bool(reading.hazards & Hazard.ESTOP_BUTTON) is pressed


# ---------------------------------------------------------------- into motion and out of it
def test_an_accepted_arm_that_no_heartbeat_shows_is_not_active() -> None:
    bench = Bench()
    bench.ready()
    bench.session.activate(bench.now_s)

    def disarm_at_once() -> None:
        bench.rover.armed = False

    bench.run(7.0, disarm_at_once)
    assert bench.session.lifecycle is Lifecycle.READY
    assert "did not arm" in bench.session.fault
    assert not bench.rover.setpoints


def test_deactivate_brakes_holds_and_disarms_and_the_next_start_is_from_zero() -> None:
    bench = Bench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.session.deactivate(bench.now_s)
    assert bench.drive() == STAND
    bench.until(lambda: bench.session.lifecycle is Lifecycle.READY, 3.0)
    assert (bench.rover.armed, bench.rover.mode) == (False, Mode.HOLD)
    assert bench.body.state().speed_m_s < 0.1
    bench.session.activate(bench.now_s)
    bench.until(lambda: bench.rover.armed)
    fastest = []
    bench.run(1.0, lambda: fastest.append(bench.body.state().speed_m_s))
    assert max(fastest) < 0.1


def test_deactivate_while_arming_ends_disarmed() -> None:
    bench = Bench()
    bench.ready()
    bench.session.activate(bench.now_s)
    bench.until(lambda: bench.rover.armed)
    assert bench.session.lifecycle is Lifecycle.READY  # armed, but no heartbeat has shown it yet
    bench.session.deactivate(bench.now_s)
    bench.run(3.0)
    assert (bench.rover.armed, bench.rover.mode) == (False, Mode.HOLD)
    assert bench.session.lifecycle is Lifecycle.READY


def test_a_refused_arm_is_told_in_the_firmware_s_words_and_not_hammered() -> None:
    bench = Bench()
    bench.ready()
    bench.rover.refuse_arm = "Throttle (RC3) is not neutral"
    bench.run(5.0, bench.insist)
    assert "Arm: Throttle (RC3) is not neutral" in bench.session.fault
    assert bench.session.lifecycle is Lifecycle.READY
    assert 2 <= sum(text.startswith("Arm:") for text in bench.texts) <= 6
    assert not bench.rover.setpoints
    bench.rover.refuse_arm = ""
    bench.until(lambda: bench.session.lifecycle is Lifecycle.ACTIVE, each=bench.insist)
    assert bench.session.fault == ""


@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.HOLD, Mode.LOITER])
def test_a_pilot_is_not_fought_until_he_hands_back(mode: Mode) -> None:
    bench = Bench()
    bench.until(lambda: bench.session.lifecycle is Lifecycle.ACTIVE, each=bench.insist)
    bench.run(1.0, bench.insist)
    bench.rover.pilot_mode(mode, bench.now_s)
    bench.run(0.2, bench.insist)
    assert bench.session.lifecycle is Lifecycle.READY
    assert mode.name in bench.session.fault
    reading = bench.session.reading()
    assert reading is not None
    assert reading.hazards & Hazard.ESTOP_BUTTON
    count = len(bench.rover.setpoints)
    bench.run(5.0, bench.insist)
    assert (bench.rover.mode, bench.rover.armed) == (mode, True)
    assert len(bench.rover.setpoints) == count
    bench.rover.pilot_mode(Mode.GUIDED, bench.now_s)
    bench.until(lambda: bench.session.lifecycle is Lifecycle.ACTIVE, each=bench.insist)
    after = bench.session.reading()
    assert after is not None
    assert not after.hazards & Hazard.ESTOP_BUTTON


def test_after_a_take_over_a_new_wish_is_honoured() -> None:
    bench = Bench()
    bench.active()
    bench.rover.pilot_mode(Mode.HOLD, bench.now_s)
    bench.until(lambda: bench.session.lifecycle is Lifecycle.READY)
    bench.run(1.5)
    bench.session.activate(bench.now_s)
    bench.until(lambda: bench.session.lifecycle is Lifecycle.ACTIVE)


def test_a_rover_disarmed_by_somebody_else_is_not_armed_again() -> None:
    bench = Bench()
    bench.active()
    bench.rover.armed = False
    bench.run(4.0, bench.insist)
    assert (bench.rover.armed, "disarmed" in bench.session.fault) == (False, True)


def test_a_rover_left_armed_by_another_run_is_disarmed_before_ready() -> None:
    bench = Bench()
    bench.run(0.02)
    bench.rover.mode, bench.rover.armed = Mode.GUIDED, True
    bench.ready()
    assert (bench.rover.armed, bench.rover.mode) == (False, Mode.HOLD)


# ---------------------------------------------------------------- faults
def test_position_lost_is_a_fault_with_a_stop_and_comes_back_ready() -> None:
    bench = Bench()
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
    bench = Bench()
    bench.active()

    def drive_without_attitude() -> None:
        bench.rover.set_interval(30, -1.0, bench.now_s)
        bench.drive()

    bench.until(lambda: bench.session.lifecycle is Lifecycle.FAULT, 1.3, drive_without_attitude)
    assert "position or attitude" in bench.session.fault
    bench.until(lambda: bench.rover.mode == Mode.HOLD, 5.0, drive_without_attitude)


def test_a_link_lost_for_long_stops_the_rover_by_its_own_failsafe_and_comes_back_ready() -> None:
    bench = Bench()
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
    bench = Bench()
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
