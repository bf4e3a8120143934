"""Every command result, and signing, as measured on the real firmware."""

from __future__ import annotations

import math

import pytest

from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.drivers.mavlink.protocol import Mode
from tests.unit.mavlink_wire import COMPANION, STRANGER, Wire

ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4


# ---------------------------------------------------------------- commands
@pytest.mark.parametrize("mode", [15, 4, 0, 5, 3, 1, 11])
def test_modes_are_accepted_and_told_at_once(mode: int) -> None:
    wire = Wire()
    wire.run(0.3)
    assert wire.command(176, 1, mode) == ACCEPTED
    wire.run(0.06)
    assert wire.of("HEARTBEAT")[-1].custom_mode == mode


@pytest.mark.parametrize(
    ("values", "result", "text"),
    [
        ((0, 15), DENIED, ""), ((1, 99), FAILED, "No such mode 99"), ((1, 10), FAILED, "Flight mode change failed"),
        ((1, 16), FAILED, "Flight mode change failed"), ((217, 15), ACCEPTED, ""),
        ((1, 15, math.nan, math.nan), ACCEPTED, ""),
    ],
)  # fmt: skip
def test_mode_requests_that_are_odd(values: tuple[float, ...], result: int, text: str) -> None:
    wire = Wire()
    assert wire.command(176, *values) == result
    assert not text or text in wire.texts
    assert not wire.rover.armed


def test_guided_without_a_position_fails_while_armed() -> None:
    wire = Wire()
    wire.command(400, 1)
    wire.rover.located = False
    assert wire.command(176, 1, Mode.GUIDED) == FAILED
    assert "Flight mode change failed" in wire.texts
    wire.command(400, 0)
    assert wire.command(176, 1, Mode.GUIDED) == ACCEPTED


def test_the_legacy_set_mode_has_no_answer() -> None:
    wire = Wire()
    wire.send("SET_MODE", 1, 1, Mode.HOLD)
    wire.run(0.1)
    assert wire.rover.mode == Mode.HOLD
    assert not wire.of("COMMAND_ACK")


@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.HOLD, Mode.GUIDED, Mode.LOITER])
def test_arming_twice_is_accepted_and_the_bit_comes_with_the_next_heartbeat(mode: Mode) -> None:
    wire = Wire()
    wire.command(176, 1, mode)
    wire.run(0.2)
    beats = len(wire.of("HEARTBEAT"))
    wire.until(lambda: len(wire.of("HEARTBEAT")) > beats)
    assert wire.command(400, 1) == ACCEPTED
    wire.run(0.5)
    assert not wire.of("HEARTBEAT")[-1].base_mode & 128
    wire.run(0.5)
    assert wire.of("HEARTBEAT")[-1].base_mode & 128
    assert wire.command(400, 1) == ACCEPTED
    assert wire.command(400, 2) == UNSUPPORTED


@pytest.mark.parametrize("mode", [Mode.RTL, Mode.SMART_RTL])
def test_modes_that_are_not_armable(mode: Mode) -> None:
    wire = Wire()
    wire.command(176, 1, mode)
    assert wire.command(400, 1) == FAILED
    assert "Arm: Mode not armable" in wire.texts
    assert wire.command(400, 1, 2989) == ACCEPTED
    assert wire.command(400, 0, 21196) == ACCEPTED


def test_base_modes_and_status() -> None:
    wire = Wire()
    seen = []
    for mode, armed in ((Mode.MANUAL, 0), (Mode.GUIDED, 0), (Mode.GUIDED, 1), (Mode.HOLD, 1)):
        wire.command(176, 1, mode)
        wire.command(400, armed)
        wire.run(1.1)
        beat = wire.of("HEARTBEAT")[-1]
        seen.append((beat.base_mode, beat.system_status))
    assert seen == [(65, 4), (9, 4), (137, 4), (129, 4)]


def test_disarming_at_speed_has_no_check() -> None:
    wire = Wire().moving(2.0)
    assert wire.command(400, 0) == ACCEPTED
    assert (wire.rover.armed, wire.rover.mode) == (False, Mode.GUIDED)


def test_not_while_armed() -> None:
    wire = Wire().guided()
    assert wire.command(246, 1) == FAILED
    assert wire.command(241, 1) == FAILED
    wire.command(400, 0)
    assert wire.command(241, 1) == ACCEPTED


def test_reposition() -> None:
    wire = Wire()
    place = {"latitude": -353_632_621, "longitude": 1_491_653_374}  # about 9 m to the east
    assert wire.command(192, 0, 1) == UNSUPPORTED
    assert wire.command_int(192, -1, 0, **place) == DENIED
    assert wire.command_int(192, -1, 1, **place) == ACCEPTED  # switches the mode, even disarmed
    assert wire.rover.mode == Mode.GUIDED
    assert wire.command(178, 0, 1.0) == ACCEPTED  # on the way to a place
    wire.command(400, 1)
    assert wire.command_int(192, -1, 0, **place) == ACCEPTED
    wire.until(lambda: bool(wire.of("MISSION_ITEM_REACHED")), 40.0)
    wire.run(2.0)
    assert (wire.state.x_m, wire.state.y_m) == pytest.approx((9.08, 0.0), abs=0.4)


def test_change_speed_fails_in_hold_and_with_a_velocity() -> None:
    wire = Wire()
    wire.command(176, 1, Mode.HOLD)
    assert wire.command(178, 0, 1.0) == FAILED
    wire.guided().drive(0.5)
    assert wire.command(178, 0, 1.0) == FAILED


@pytest.mark.parametrize("command", [31010, 22, 60001, 519, 213, 43000, 43002])
def test_unsupported(command: int) -> None:
    assert Wire().command(command, 1) == UNSUPPORTED


def test_to_whom_and_from_whom() -> None:
    wire = Wire()
    assert wire.command(176, 1, 4, target=(2, 1)) is None
    for target in ((0, 0), (1, 0), (1, 50)):
        assert wire.command(176, 1, 4, target=target) == ACCEPTED
    for source in (COMPANION, STRANGER, (254, 190)):
        assert wire.command(176, 1, 4, source=source) == ACCEPTED  # the answer names the sender (see Wire)
    assert wire.command(176, 1, 4, source=(1, 1)) is None
    assert wire.command(176, 1, 4, port=1) == ACCEPTED  # and goes to the asking port (see Wire)


def test_a_version_1_command_is_answered_in_version_2() -> None:
    wire = Wire()
    message = dialect().MAVLink_command_long_message(1, 1, 176, 0, 1, 4, 0, 0, 0, 0, 0)
    frame = message.pack(dialect().MAVLink(None, 255, 190), force_mavlink1=True)
    assert frame[0] == 0xFE
    wire.feed(frame)
    wire.run(0.1)
    assert wire.of("COMMAND_ACK")[-1].result == ACCEPTED
    assert {frame[0] for _, frame in wire.frames[1:]} == {0xFD}


@pytest.mark.parametrize(
    ("message", "result"), [(148, 0), (242, 0), (32, 0), (60_000, 4), (300, 4), (397, 4)]
)  # fmt: skip
def test_request_message(message: int, result: int) -> None:
    wire = Wire()
    assert wire.command(512, message) == result
    if message == 148:
        version = wire.of("AUTOPILOT_VERSION")[-1]
        assert (version.flight_sw_version, bytes(version.flight_custom_version)) == (0x040603FF, b"3fc7011a")
        assert not version.capabilities & 32
    assert wire.command(520, 1) == ACCEPTED
    assert wire.command(410) == ACCEPTED


def test_a_trap_in_message_interval_and_revival() -> None:
    wire = Wire(traps_floats=True)
    assert wire.command(511, 30, 1e5, math.nan) is None
    assert wire.rover.aborted
    wire.rover.power_on(wire.now_s)
    wire.run(0.5)
    assert wire.command(512, 148, math.nan) == ACCEPTED
    assert wire.command(400, 1, math.nan) == ACCEPTED


# ---------------------------------------------------------------- signing
KEY, OTHER = bytes(range(32)), bytes(32 * [7])


class Signer:
    """pymavlink as a station that signs."""

    def __init__(self, wire: Wire, key: bytes = KEY, link_id: int = 5, timestamp: int = 1_000_000_000) -> None:
        self.wire, self.start_s = wire, wire.now_s
        self.mav = dialect().MAVLink(None, 255, 190)
        signing = self.mav.signing
        signing.secret_key, signing.link_id, signing.sign_outgoing = key, link_id, True
        signing.timestamp = timestamp

    def hold(self, port: int) -> bool:
        """Ask for HOLD; tell whether that was answered."""
        before = len(self.wire.of("COMMAND_ACK", port))
        message = dialect().MAVLink_command_long_message(1, 1, 176, 0, 1, 4, 0, 0, 0, 0, 0)
        self.wire.feed(message.pack(self.mav), port)
        self.wire.run(0.1)
        return len(self.wire.of("COMMAND_ACK", port)) > before


def signed_wire(timestamp: int = 1_000_000_000) -> Wire:
    wire = Wire()
    wire.send("SETUP_SIGNING", 1, 1, [*KEY], timestamp)
    wire.run(0.1)
    return wire


def test_setting_up_signing() -> None:
    wire = Wire().guided()
    wire.send("SETUP_SIGNING", 1, 1, [*KEY], 1_000_000_000)
    wire.run(0.1)
    assert "ERROR: Won't setup signing when armed" in wire.texts
    wire.command(400, 0)
    wire.frames.clear()
    wire.send("SETUP_SIGNING", 1, 1, [*KEY], 1_000_000_000)
    wire.run(1.5)
    for port in (0, 1):
        frames = [frame for at, frame in wire.frames if at == port]
        assert frames
        assert all(frame[2] & 1 and frame[-13] == port for frame in frames)  # signed, link id is the channel
        checker = dialect().MAVLink(None)
        checker.signing.secret_key = KEY
        assert all(checker.decode(bytearray(frame)) for frame in frames)  # raises on a bad signature
    wire.send("SETUP_SIGNING", 1, 1, [0] * 32, 0)
    wire.run(0.02)
    wire.frames.clear()
    wire.run(1.5)
    assert not any(frame[2] & 1 for _, frame in wire.frames)


def test_whom_it_believes_when_it_signs() -> None:
    wire = signed_wire()
    assert wire.command(176, 1, 4) == ACCEPTED  # the first port is trusted
    assert wire.command(176, 1, 4, port=1) is None
    assert Signer(wire, OTHER).hold(0)
    assert not Signer(wire, OTHER).hold(1)
    good = Signer(wire, timestamp=1_000_100_000)
    assert good.hold(1)
    assert good.hold(1)
    minutes = 60 * 100_000
    assert not Signer(wire, link_id=6, timestamp=1_000_100_000 - 5 * minutes).hold(1)
    assert Signer(wire, link_id=7, timestamp=1_000_100_000 + 60 * minutes).hold(1)  # an hour ahead
    assert not Signer(wire, link_id=7, timestamp=1_000_200_000).hold(1)  # now, on the same link
    assert not Signer(wire, link_id=8, timestamp=1_000_200_000).hold(1)  # its own clock has jumped, too


def test_the_key_outlives_a_restart() -> None:
    wire = signed_wire()
    wire.rover.power_on(wire.now_s, again=True)
    wire.run(0.5)
    assert wire.command(176, 1, 4, port=1) is None
    assert Signer(wire, timestamp=2_000_000_000).hold(1)


# ---------------------------------------------------------------- poses from outside
def test_a_rover_without_gps_is_located_by_odometry_in_the_right_frames_only() -> None:
    wire = Wire(settle_s=0.0)
    wire.rover.parameters |= {"VISO_TYPE": 1.0, "EK3_SRC1_POSXY": 6.0, "EK3_SRC1_YAW": 6.0}
    wire.rover.set_gps(False)
    wire.rover.power_on(wire.now_s)
    wire.run(0.5)

    def tell(frame: int = 20, child: int = 12) -> None:
        half = math.pi / 4  # looks east
        q = [math.cos(half), 0, 0, math.sin(half)]
        wire.send("ODOMETRY", 0, frame, child, 3.0, 7.0, 0, q, 0, 0, 0, 0, 0, 0, [math.nan] * 21, [math.nan] * 21, 0, 0)

    wire.run(1.0, tell)
    assert not wire.of("LOCAL_POSITION_NED")  # no origin yet
    wire.send("SET_GPS_GLOBAL_ORIGIN", 1, -353632621, 1491652374, 584000)
    wire.run(2.0, tell)
    where = wire.of("LOCAL_POSITION_NED")[-1]
    # The filter's jitter is 0.3 mm.
    assert (where.x, where.y) == (pytest.approx(3.0, abs=2e-3), pytest.approx(7.0, abs=2e-3))
    assert wire.of("GPS_GLOBAL_ORIGIN")
    wire.run(9.0, lambda: tell(frame=1))
    assert not wire.count(2.0)["LOCAL_POSITION_NED"]
