"""What is PX4's own: how it is recognised, its modes and numbers, and the traps of its emulated firmware."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.clock import SimClock
from fullswarm.drivers.base import Lifecycle, Pose, Twist
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink import px4
from fullswarm.drivers.mavlink.codec import Encoder, StationEncoder, StreamParser, decode, dialect
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.mavlink.px4 import AUTOPILOTS, HOLD, MANUAL, OFFBOARD, Px4, Steering
from fullswarm.drivers.mavlink.settings import LIMITS, read_settings
from fullswarm.emulators.mavlink.px4_firmware import Px4Firmware
from fullswarm.errors import ConfigError
from fullswarm.simulation.bodies import FreeBody
from tests.unit.mavlink_bench import Px4Bench

PX4 = AUTOPILOTS[12]


# ---------------------------------------------------------------- which autopilot
def test_an_url_that_says_otherwise_is_told() -> None:
    bench = Px4Bench(autopilot=AUTOPILOTS[3])
    bench.run(2.0, bench.insist)
    assert bench.session.state is Lifecycle.FAULT
    assert "the vehicle runs PX4, but its URL has autopilot=ardupilot" in bench.session.fault
    assert not bench.rover.setpoints


def test_the_url_makes_the_description() -> None:
    driver = MavlinkDriver("mavlink+tcp://127.0.0.1:5760?autopilot=px4&speed=0.4")
    assert (driver.description.make, driver.description.watchdog_s) == ("PX4", 1.0)
    assert driver.description.limits == replace(LIMITS, speed_m_s=0.4, can_reverse=False)
    assert MavlinkDriver("mavlink+tcp://127.0.0.1:5760").description.limits.can_reverse
    origins = ("origin=1", "origin=91,0", "pose=external&origin=1,2", "pose=external&origin=91,0,0")
    for query in ("autopilot=pix4", "pose=gps", *origins, "key=00", "sign_link=1"):
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
