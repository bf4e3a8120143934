"""PX4: what we send it, and the driver's conversation with the emulated firmware in simulated time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.clock import SimClock
from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Limits, Pose, Twist
from fullswarm.drivers.body import FreeBody
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink import px4
from fullswarm.drivers.mavlink.codec import (
    Encoder,
    FrameSigner,
    StationEncoder,
    StreamParser,
    decode,
    decoded_ids,
    dialect,
)
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.mavlink.px4 import AUTOPILOTS, HOLD, MANUAL, OFFBOARD, Px4, Steering
from fullswarm.drivers.mavlink.px4_firmware import Px4Firmware
from fullswarm.drivers.mavlink.session import Session
from fullswarm.drivers.mavlink.settings import Options, read_settings
from fullswarm.errors import ConfigError

STEP_S = 0.01
LIMITS = Limits(1.0, 2.0, 1.0, 2.0)
PX4 = AUTOPILOTS[12]


class Bench:
    """Session and firmware with a wire between them that may be cut."""

    def __init__(self, **options: Any) -> None:
        self.clock = SimClock(100.0)
        self.body = FreeBody(Pose(0.0, 0.0, 0.7), self.clock)
        self.rover = Px4Firmware(self.body)
        self.rover.power_on(100.0)
        self.session = Session(Options(1, LIMITS, "bench", **options), 100.0)
        self.texts: list[str] = []
        self.cut = self.deaf = False
        self._down, self._up = StreamParser(decoded_ids()), StreamParser()

    @property
    def now_s(self) -> float:
        return self.clock.now_s()

    def step(self) -> None:
        self.clock.advance_to(self.now_s + STEP_S)
        for frame in self.rover.tick(self.now_s):
            for message in [] if self.cut else self._down.feed(frame):
                received = decode(message)
                if received is not None and isinstance(received.body, p.StatusText):
                    self.texts.append(received.body.text)
                self.session.receive(message, self.now_s)
        for frame in self.session.tick(self.now_s):
            for message in [] if self.cut or self.deaf else self._up.feed(frame):
                self.rover.receive(message, self.now_s)

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
        self.session.activate(self.now_s)
        self.drive()

    def ready(self) -> None:
        self.until(lambda: self.session.lifecycle is Lifecycle.READY)

    def active(self) -> None:
        self.ready()
        self.session.activate(self.now_s)
        self.until(lambda: self.session.lifecycle is Lifecycle.ACTIVE)


# ---------------------------------------------------------------- into motion and out of it
def test_it_is_recognised_and_driven_in_offboard() -> None:
    bench = Bench()
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
    reading = bench.session.reading()
    assert reading is not None
    assert reading.twist.linear_m_s == pytest.approx(0.5, abs=0.02)
    assert not any("invalid" in text or "unsupported" in text for text in bench.texts)
    bench.session.deactivate(bench.now_s)
    bench.until(lambda: bench.session.lifecycle is Lifecycle.READY, 4.0)
    assert (bench.rover.mode, bench.rover.armed) == (HOLD, False)
    assert bench.body.state().speed_m_s < 0.1


def test_standing_active_it_neither_creeps_nor_turns_to_the_north() -> None:
    bench = Bench()
    bench.active()
    bench.run(5.0, lambda: bench.drive(0.0))
    state = bench.body.state()
    assert math.hypot(state.x_m, state.y_m) < 0.02
    assert state.heading_rad == pytest.approx(0.7, abs=1e-3)


@pytest.mark.parametrize("turn", [0.1, -0.3, 0.8, -1.5, 2.0])
def test_it_turns_on_the_spot_at_the_rate_that_was_asked(turn: float) -> None:
    bench = Bench()
    bench.active()
    assert bench.drive(0.0, turn) == Twist(0.0, turn)
    bench.run(2.0, lambda: bench.drive(0.0, turn))
    begin, since_s = bench.body.state().turned_rad, bench.now_s
    bench.run(1.0, lambda: bench.drive(0.0, turn))
    assert (bench.body.state().turned_rad - begin) / (bench.now_s - since_s) == pytest.approx(turn, rel=0.1)
    assert abs(bench.body.state().rolled_m) < 0.02


@pytest.mark.parametrize(("speed", "turn"), [(0.5, 0.25), (0.5, -0.25), (0.8, 0.6), (0.3, 1.9)])
def test_what_is_said_to_be_applied_is_what_it_does(speed: float, turn: float) -> None:
    bench = Bench()
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
    bench = Bench()
    bench.active()
    assert bench.drive(-0.5) == STAND
    assert bench.drive(-0.5, 0.4) == Twist(0.0, 0.4)
    bench.run(1.0, lambda: bench.drive(-0.5))
    assert abs(bench.body.state().rolled_m) < 0.01


@pytest.mark.parametrize("bad", [Twist(math.nan, 0.0), Twist(0.0, math.inf)])
def test_non_finite_is_refused_and_stops(bad: Twist) -> None:
    bench = Bench()
    bench.active()
    bench.run(1.0, bench.drive)
    with pytest.raises(ValueError, match="finite"):
        bench.session.command(bad, bench.now_s)
    bench.run(2 * STEP_S)
    assert bench.rover.setpoints[-1].forward_m_s < 0.002


def test_silence_of_the_agent_is_a_stop_but_no_loss_of_offboard() -> None:
    bench = Bench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.run(3.0)
    assert bench.body.state().speed_m_s < 0.01
    assert (bench.session.lifecycle, bench.rover.mode) == (Lifecycle.ACTIVE, OFFBOARD)


# ---------------------------------------------------------------- loss
def test_a_lost_link_is_a_stop_of_its_own_after_a_second_and_a_fault_that_heals_to_ready() -> None:
    bench = Bench()
    bench.active()
    bench.run(2.0, bench.drive)
    bench.cut = True
    bench.run(0.9, bench.drive)
    assert bench.rover.mode == OFFBOARD
    bench.run(0.9, bench.drive)
    assert (bench.rover.mode, bench.body.state().speed_m_s) == (HOLD, 0.0)
    bench.until(lambda: bench.session.lifecycle is Lifecycle.FAULT, 4.0, bench.drive)
    assert bench.session.fault
    bench.run(3.0, bench.drive)
    bench.cut = False
    seen: set[Lifecycle] = set()
    since_s = bench.now_s
    bench.until(lambda: bench.session.lifecycle is Lifecycle.READY, 5.0, lambda: seen.add(bench.session.lifecycle))
    assert Lifecycle.ACTIVE not in seen
    assert not bench.rover.armed
    assert bench.now_s - since_s < 3.5  # disarmed first; a heartbeat a second is all that PX4 gives
    assert bench.drive() == STAND


def test_a_reboot_is_a_fault_and_everything_is_asked_again() -> None:
    bench = Bench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.rover.power_on(bench.now_s)
    bench.until(lambda: bench.session.lifecycle is Lifecycle.FAULT, 3.0, bench.drive)
    bench.ready()
    stamps = set()
    bench.run(1.0, lambda: stamps.add(getattr(bench.session.reading(), "stamp_s", 0.0)))
    assert len(stamps) > 15  # 10 Hz unasked


def test_a_lost_position_is_a_fault_with_a_stop() -> None:
    bench = Bench()
    bench.active()
    bench.run(1.0, bench.drive)
    bench.rover.located = False
    bench.until(lambda: bench.session.lifecycle is Lifecycle.FAULT, 2.0, bench.drive)
    bench.until(lambda: not bench.rover.armed, 4.0, bench.drive)
    assert "position" in bench.session.fault


def test_a_pilot_is_not_fought() -> None:
    bench = Bench()
    bench.until(lambda: bench.session.lifecycle is Lifecycle.ACTIVE, each=bench.insist)
    bench.rover.pilot_mode(MANUAL)
    bench.until(lambda: bench.session.lifecycle is Lifecycle.READY, 2.0, bench.insist)
    assert "MANUAL" in bench.session.fault
    assert "OFFBOARD" in bench.session.fault
    reading = bench.session.reading()
    assert reading is not None
    assert reading.hazards & Hazard.ESTOP_BUTTON
    bench.run(4.0, bench.insist)
    assert (bench.rover.mode, bench.rover.armed) == (MANUAL, True)


def test_a_refused_arm_is_told_in_the_firmware_s_words() -> None:
    bench = Bench()
    bench.ready()
    bench.rover.refuse_arm = "High Accelerometer Bias, and a text that is longer than a single chunk"
    bench.until(lambda: bench.session.fault != "", each=bench.insist)
    assert f"Arming denied: {bench.rover.refuse_arm}" in bench.session.fault
    assert bench.session.lifecycle is Lifecycle.READY
    bench.until(lambda: bench.rover.mode == HOLD, 5.0)


def test_a_long_timeout_of_its_own_keeps_it_open() -> None:
    bench = Bench()
    bench.rover.parameters["COM_OF_LOSS_T"] = (60.0, p.PARAM_REAL32)
    bench.run(4.0, bench.insist)
    assert bench.session.lifecycle is Lifecycle.OPEN
    assert "COM_OF_LOSS_T" in bench.session.why


def test_a_vehicle_that_signs_and_does_not_answer_wants_a_key() -> None:
    bench = Bench()
    bench.deaf = True
    bench.run(8.0)
    assert bench.session.why == "COM_OBL_RC_ACT=5 is not confirmed: the vehicle does not answer"
    bench = Bench()
    bench.deaf = True
    bench.rover = Px4Firmware(bench.body, signer=FrameSigner(bytes(32), 0, itertools.count(1).__next__))
    bench.rover.power_on(100.0)
    bench.run(1.0)
    assert "it signs its messages: give its key with ?sign_key=" in bench.session.why


# ---------------------------------------------------------------- which autopilot
def test_an_url_that_says_otherwise_is_told() -> None:
    bench = Bench(autopilot=AUTOPILOTS[3])
    bench.run(2.0, bench.insist)
    assert bench.session.lifecycle is Lifecycle.FAULT
    assert "the vehicle runs PX4, but the URL says autopilot=ardupilot" in bench.session.fault
    assert not bench.rover.setpoints


def test_the_url_makes_the_description() -> None:
    driver = MavlinkDriver("mavlink+tcp://127.0.0.1:5760?autopilot=px4&speed=0.4")
    assert (driver.description.make, driver.description.watchdog_s) == ("PX4", 1.0)
    assert driver.description.limits == Limits(0.4, 2.0, 1.0, 2.0, can_reverse=False)
    assert MavlinkDriver("mavlink+tcp://127.0.0.1:5760").description.limits.can_reverse
    for query in ("autopilot=pix4", "pose=gps", "origin=1,2,3", "pose=external&origin=91,0,0", "key=00", "sign_link=1"):
        with pytest.raises(ConfigError):
            MavlinkDriver(f"mavlink+tcp://127.0.0.1:5760?{query}")
    assert read_settings("u", "w", {"autopilot": "px4"}).options.autopilot is PX4


@pytest.mark.parametrize(
    ("mode", "name"), [(OFFBOARD, "OFFBOARD"), (HOLD, "HOLD"), (MANUAL, "MANUAL"), (5 << 24 | 4 << 16, "RETURN")]
)
def test_modes_have_names(mode: int, name: str) -> None:
    assert PX4.mode_name(mode) == name
    assert Px4().mode_name(99 << 16) == "mode 0x630000"


# ---------------------------------------------------------------- numbers
@given(st.floats(0.0, 1.0), st.floats(-3.0, 3.0), st.floats(1.0, 10.0), st.floats(0.05, 1.0))
def test_steering_never_asks_for_more_than_it_drives(speed: float, turn: float, gain: float, angle: float) -> None:
    steering = Steering(gain, 0.8 * angle, math.pi)
    applied = steering.limited(Twist(speed, turn))
    assert 0.0 <= applied.linear_m_s <= speed
    assert abs(applied.angular_rad_s) <= abs(turn)
    if applied.linear_m_s > 0.0:
        assert abs(steering.lead(applied.angular_rad_s)) <= 0.8 * angle + 1e-9
    assert steering.limited(applied) == applied or applied.linear_m_s > 0.0


@given(st.integers(-(2**31), 2**31 - 1))
def test_integers_travel_bytewise(value: int) -> None:
    station = StationEncoder(255, 190, 1)
    (sent,) = StreamParser().feed(station.set_parameter("COM_OBL_RC_ACT", value, p.PARAM_INT32, bytewise=True))
    raw = bytes(sent.get_msgbuf())[10:14]
    quieted = value & 0x7F800000 == 0x7F800000 and value & 0x7FFFFF and not value & 0x400000
    assert quieted or int.from_bytes(raw, "little", signed=True) == value  # a signalling NaN may not survive a float
    frame = Encoder(1, 1).pack(dialect().MAVLink_param_value_message(b"X", 0.0, p.PARAM_INT32, 1, 0))
    told = bytearray(frame)
    told[10:14] = value.to_bytes(4, "little", signed=True)
    body = bytes(told[1:-2]) + bytes((dialect().MAVLink_param_value_message.crc_extra,))
    told[-2:] = dialect().x25crc(body).crc.to_bytes(2, "little")
    (message,) = StreamParser().feed(bytes(told))
    received = decode(message)
    assert received is not None
    assert isinstance(received.body, p.Parameter)
    assert received.body.bytewise == value


def test_estimator_flags_are_not_those_of_ardupilot() -> None:
    for flags, good in ((831, True), (11 | 1024, True), (11 | 128, False), (3, False)):
        message = dialect().MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, 0, 0)
        received = decode(StreamParser().feed(Encoder(1, 1).pack(message))[0])
        assert received is not None
        assert isinstance(received.body, p.EkfStatus)
        assert received.body.good is good


# ---------------------------------------------------------------- the firmware's own traps
def test_the_emulated_firmware_takes_velocity_vectors_only() -> None:
    rover = Px4Firmware(FreeBody(Pose(0.0, 0.0, 0.0), SimClock()))
    rover.power_on(0.0)
    station = StationEncoder(255, 190, 1)
    spin = station.drive(0.0, 0.5)
    rover.receive(StreamParser().feed(spin)[0], 1.0)
    frames = b"".join(rover.tick(1.0))
    texts = [m.text for m in StreamParser().feed(frames) if m.get_type() == "STATUSTEXT"]
    assert texts == ["SET_POSITION_TARGET_LOCAL_NED invalid"]
    mode = station.set_mode(6)
    rover.receive(StreamParser().feed(mode)[0], 1.0)
    acks = [m.result for m in StreamParser().feed(b"".join(rover.tick(1.0))) if m.get_type() == "COMMAND_ACK"]
    assert acks == [p.Result.TEMPORARILY_REJECTED]  # no stream, no OFFBOARD


@given(
    st.sampled_from([176, 400, 511, 512, 60001]),
    st.lists(st.one_of(st.floats(width=32), st.sampled_from([1.0, 4.0, 6.0])), min_size=7, max_size=7),
    st.floats(width=32),
    st.sampled_from(["COM_OBL_RC_ACT", "RO_YAW_P", "none"]),
)
def test_no_command_breaks_the_emulated_firmware(command: int, values: list[float], value: float, name: str) -> None:
    rover = Px4Firmware(FreeBody(Pose(0.0, 0.0, 0.0), SimClock()))
    rover.power_on(0.0)
    station = Encoder(255, 190)
    for kind in (p.PARAM_REAL32, p.PARAM_INT32):
        setting = dialect().MAVLink_param_set_message(1, 1, name.encode(), value, kind)
        rover.receive(StreamParser().feed(station.pack(setting))[0], 1.0)
    long = dialect().MAVLink_command_long_message(1, 1, command, 0, *values)
    rover.receive(StreamParser().feed(station.pack(long))[0], 1.0)
    assert rover.tick(1.02)


def test_a_zero_velocity_would_turn_it_to_the_north() -> None:
    clock = SimClock()
    body = FreeBody(Pose(0.0, 0.0, 0.0), clock)
    rover = Px4Firmware(body)
    rover.power_on(0.0)
    zero, station = StationEncoder(255, 190, 1).velocity(0.0, 0.0), StationEncoder(255, 190, 1)
    for index in range(400):
        clock.advance_to(1.0 + index * 0.01)
        frame = {150: station.set_mode(px4.MainMode.OFFBOARD), 160: station.arm(True)}.get(index, zero)
        rover.receive(StreamParser().feed(frame)[0], clock.now_s())
        rover.tick(clock.now_s())
    assert body.state().heading_rad == pytest.approx(math.pi / 2, abs=0.05)


# ---------------------------------------------------------------- poses from outside
ORIGIN = p.Origin(52.5163, 13.3777, 34.0)


def locating(bench: Bench, every_s: float = 0.1, jump_s: float = math.inf) -> Callable[[], None]:
    """Return what hands the session the body's true pose again and again, from `jump_s` on a metre aside."""
    due_s = [bench.now_s]

    def look() -> None:
        if bench.now_s >= due_s[0]:
            due_s[0] += every_s
            state = bench.body.state()
            x_m = state.x_m + (1.0 if bench.now_s >= jump_s else 0.0)
            assert bench.session.locate(Pose(x_m, state.y_m, state.heading_rad), 0.02, 0.01, bench.now_s)

    return look


def indoors(**options: Any) -> Bench:
    bench = Bench(external=True, **options)
    bench.rover.gps = False
    bench.rover.parameters["EKF2_EV_CTRL"] = (9, p.PARAM_INT32)
    return bench


def test_fixes_become_odometry_and_make_it_ready() -> None:
    bench = indoors(origin=ORIGIN)
    bench.run(3.0)
    assert bench.session.lifecycle is Lifecycle.OPEN
    assert "no pose fix has come in yet" in bench.session.why
    look = locating(bench)
    bench.until(lambda: bench.session.lifecycle is Lifecycle.READY, 4.0, look)
    assert bench.rover.origin == (525163000, 133777000, 34000)
    bench.session.activate(bench.now_s)
    bench.until(lambda: bench.session.lifecycle is Lifecycle.ACTIVE, 5.0, look)

    def drive() -> None:
        look()
        bench.drive(0.5, 0.2)

    bench.run(2.0, drive)
    state, fix = bench.body.state(), bench.rover.fixes[-1]
    assert (fix.frame_id, fix.child_frame_id, fix.reset_counter) == (20, 12, 0)
    assert (fix.x, fix.y) == (pytest.approx(state.y_m, abs=0.06), pytest.approx(state.x_m, abs=0.06))  # north, east
    yaw = 2.0 * math.atan2(fix.q[3], fix.q[0])
    assert math.cos(p.heading_from_yaw(yaw) - state.heading_rad) == pytest.approx(1.0, abs=1e-3)
    covariance = fix.pose_covariance
    assert all(0.02**2 <= covariance[index] <= 0.031**2 for index in (0, 6, 11))  # at most 10 ms old, at 1 m/s
    assert all(0.01**2 <= covariance[index] <= 0.031**2 for index in (15, 18, 20))
    assert math.isnan(fix.velocity_covariance[0])
    assert not math.isfinite(fix.vx)  # PX4 passes over what is no number


def test_slow_fixes_are_repeated_with_growing_doubt_and_stale_ones_are_not() -> None:
    bench = indoors()
    look = locating(bench, every_s=0.8)
    bench.run(4.0, look)
    since_s, count = bench.now_s, len(bench.rover.fixes)
    bench.run(2.4, look)
    assert len(bench.rover.fixes) - count >= 4 * (bench.now_s - since_s)
    assert len({fix.pose_covariance[0] for fix in bench.rover.fixes}) == 4
    bench.run(1.2)
    count = len(bench.rover.fixes)
    bench.run(2.0)
    assert len(bench.rover.fixes) == count
    assert "no pose fix has come in for" in bench.session.why


def test_a_jump_of_the_fixes_is_told_once() -> None:
    bench = indoors()
    look = locating(bench, jump_s=bench.now_s + 3.0)
    bench.run(5.0, look)
    assert [fix.reset_counter for fix in bench.rover.fixes if fix.reset_counter not in (0, 1)] == []
    assert bench.rover.fixes[-1].reset_counter == 1


def test_a_heading_that_was_not_seen_is_the_vehicle_s_own() -> None:
    bench = indoors()
    for _ in range(200):
        bench.session.locate(Pose(1.0, 2.0, math.nan), 0.05, math.pi, bench.now_s)
        bench.run(0.02)
    fix = bench.rover.fixes[-1]
    assert p.heading_from_yaw(2.0 * math.atan2(fix.q[3], fix.q[0])) == pytest.approx(0.7, abs=1e-3)
    assert fix.pose_covariance[20] > 9.0
    assert fix.reset_counter == 0


def test_an_origin_that_is_set_already_stays_and_is_told() -> None:
    bench = indoors(origin=ORIGIN)
    bench.rover.origin = (1, 2, 3)
    bench.run(3.0, locating(bench))
    assert bench.rover.origin == (1, 2, 3)
    assert any("origin was set" in text for text in bench.session.texts(bench.now_s))


def test_without_the_parameters_for_it_it_is_not_ready() -> None:
    bench = indoors()
    bench.rover.parameters["EKF2_EV_CTRL"] = (1, p.PARAM_INT32)
    bench.run(4.0, locating(bench))
    assert bench.session.lifecycle is Lifecycle.OPEN
    assert "EKF2_EV_CTRL" in bench.session.why


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("VISO_TYPE", None, "VISO_TYPE"), ("VISO_TYPE", 0.0, "reboot"), ("EK3_SRC1_POSXY", 3.0, "POSXY"),
        ("EK3_SRC1_VELXY", 6.0, "no velocity"), ("EK3_SRC1_YAW", 1.0, ""), ("EK3_SRC1_YAW", 6.0, ""),
    ],
)  # fmt: skip
def test_ardupilot_s_parameters_are_checked(name: str, value: float | None, word: str) -> None:
    fit = {"VISO_TYPE": 1.0, "EK3_SRC1_POSXY": 6.0, "EK3_SRC1_VELXY": 0.0, "EK3_SRC1_YAW": 6.0} | {name: value}
    found = [(check.needed, check.unfit(fit[check.name])) for check in AUTOPILOTS[3].pose_checks]
    assert [text for needed, text in found if needed and text] == ([text for _, text in found if text] if word else [])
    assert word in "".join(text for needed, text in found if needed)
    assert any(text and not needed for needed, text in found) is (name == "EK3_SRC1_YAW" and value == 1.0)


def test_without_being_asked_for_fixes_are_not_taken() -> None:
    bench = Bench()
    assert not bench.session.locate(Pose(0.0, 0.0, 0.0), 0.1, 0.1, bench.now_s)
    bench = indoors()
    for pose, sigma_m, sigma_rad in (
        (Pose(math.nan, 0.0, 0.0), 0.1, 0.1), (Pose(0.0, 0.0, math.inf), 0.1, 0.1), (Pose(0.0, 0.0, 0.0), 0.0, 0.1),
        (Pose(0.0, 0.0, 0.0), 0.1, math.nan),
    ):  # fmt: skip
        bench.session.locate(pose, sigma_m, sigma_rad, bench.now_s)
    bench.run(1.0)
    assert not bench.rover.fixes
    MavlinkDriver("mavlink+tcp://127.0.0.1:5760").locate(Pose(0.0, 0.0, 0.0), 0.1, 0.1)  # closed: nothing happens
