from __future__ import annotations

import os
import tty
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
import serial

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.can import probe as can_bus
from fullswarm.drivers.create_oi import probe as create
from fullswarm.drivers.create_oi.driver import CreateDriver
from fullswarm.drivers.create_oi.protocol import (
    CREATE1,
    CREATE2,
    PACKETS,
    Generation,
    Mode,
    Op,
    StreamParser,
    simple,
    stream,
)
from fullswarm.drivers.mavlink import probe as mavlink
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.probe import ask
from fullswarm.drivers.probe.line import Line
from fullswarm.emulators.can.emulator import EmulatedBase
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from fullswarm.emulators.create_oi.firmware import Quirks
from fullswarm.emulators.mavlink.emulator import Px4Emulator, RoverEmulator
from fullswarm.errors import ConfigError
from fullswarm.simulation.bodies import BodyState
from tests.waiting import until

CLOCK = MonotonicClock()
BODY = "left=1&right=2&wheel_radius=0.05&base=0.3"


# ---------------------------------------------------------------- Create
@pytest.mark.parametrize(("generation", "left"), [(CREATE1, Mode.PASSIVE), (CREATE2, Mode.OFF)])
def test_a_create_that_was_off_is_found_and_sleeps_again(generation: Generation, left: Mode) -> None:
    with CreateEmulator(generation) as robot:
        robot.set_battery(0.5)
        asked = ask.ask_serial(robot.port)
        (found,) = asked.robots
        assert found.url == robot.url
        assert found.make == "iRobot"
        assert found.battery == pytest.approx(0.5, abs=0.01)
        assert robot.body.state() == BodyState()  # nothing was told to the wheels
        assert found.note == "it was off"
        until(lambda: robot.mode is left)  # a Create 1 has no command for it
        driver = CreateDriver(found.url)
        assert driver.description.model in (generation.label, CREATE2.label)


def test_a_roomba_that_reports_its_mode_one_too_high_gets_the_option() -> None:
    with CreateEmulator(quirks=Quirks(mode_offset=1)) as robot:
        (found,) = ask.ask_serial(robot.port).robots
        assert found.url == f"{robot.url}&mode_offset=1"
        CreateDriver(found.url)


@contextmanager
def client(robot: CreateEmulator) -> Iterator[serial.Serial]:
    """Somebody else's program on the port."""
    with serial.Serial(robot.port, robot.generation.baud, timeout=0.5) as port:
        yield port


def test_a_create_in_safe_mode_with_a_stream_is_left_so() -> None:
    with CreateEmulator() as robot:
        with client(robot) as port:
            port.write(simple(Op.START) + simple(Op.SAFE) + stream([PACKETS[35].id]))
            until(lambda: robot.mode is Mode.SAFE)
            until(lambda: port.in_waiting > 20)
        (found,) = ask.ask_serial(robot.port).robots
        assert found.note == "mode SAFE"
        assert robot.mode is Mode.SAFE
        with client(robot) as port:
            until(lambda: bool(StreamParser().feed(port.read(64))))


def test_a_held_port_is_not_touched_and_its_holder_named() -> None:
    with CreateEmulator() as robot, closing(CreateDriver(robot.url)) as driver:
        driver.open()
        until(lambda: driver.state == "READY")
        asked = ask.ask_serial(robot.port)
        assert asked.robots == ()
        assert "held by" in asked.problem
        assert f"pid {os.getpid()}" in asked.problem
        assert driver.state == "READY"


class Tape:
    """A port that nobody is at; keeps what was written."""

    def __init__(self) -> None:
        self.written = b""

    def spell(self, data: bytes) -> None:
        self.written += data

    def gather(self, duration_s: float, size: int | None = None) -> bytes:
        del duration_s, size
        return b""


def heard_at_half_rate(byte: int) -> int:
    """Return the least that a receiver may make of one byte sent at twice its rate.

    It samples in the middle of its own bits, which is a border between two of the sender's: either may count.
    """
    line = [0, *((byte >> bit) & 1 for bit in range(8)), *[1] * 16]  # start, data, stop and rest, in sender's bits
    return sum((line[2 * bit + 2] & line[2 * bit + 3]) << bit for bit in range(8))


def test_at_twice_the_rate_every_byte_is_no_command() -> None:
    tape = Tape()
    assert create.ask(tape, "/dev/x", 115200, b"") is None
    assert tape.written
    asked_when_awake = bytes([142, 35, 142, 6, 142, 100, 150, 0, 150, 1, 173])
    for byte in tape.written + asked_when_awake:
        assert heard_at_half_rate(byte) > max(Op)


@pytest.fixture
def silent_port() -> Iterator[tuple[int, str]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


def test_echo_and_garbage_are_no_robot(silent_port: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
    master, path = silent_port
    monkeypatch.setattr(create, "ANSWER_S", 0.02)
    with Line(path, CLOCK) as line:
        os.write(master, bytes(range(256)) * 4)
        assert create.ask(line, path, 115200, b"") is None


def test_a_silent_port_says_so(silent_port: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mavlink, "HEARTBEAT_S", 0.1)
    monkeypatch.setattr(create, "ANSWER_S", 0.02)
    asked = ask.ask_serial(silent_port[1])
    assert asked.robots == ()
    assert "switched on" in asked.problem


def test_a_missing_port_says_so(tmp_path: Path) -> None:
    assert "no such port" in ask.ask_serial(str(tmp_path / "ttyUSB9")).problem


# ---------------------------------------------------------------- MAVLink
def test_rovers_over_udp_tell_version_and_battery() -> None:
    address = "udp://127.0.0.1:14873"
    with RoverEmulator(address) as robot, RoverEmulator(address, system=2):
        asked = mavlink.ask_udp("127.0.0.1", 14873, CLOCK)
    assert [each.url for each in asked.robots] == [robot.url, f"{robot.url}?sysid=2"]
    for found in asked.robots:
        assert (found.make, found.model) == ("ArduPilot", "Rover")
        assert found.firmware.count(".") == 2
        assert found.battery is not None
        assert "each its own" in found.note
        MavlinkDriver(found.url)


def test_a_rover_on_a_serial_port_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(create, "ANSWER_S", 0.02)
    with RoverEmulator("pty:") as robot:
        path = robot.url.removeprefix("mavlink+serial://").partition("?")[0]
        (found,) = ask.ask_serial(path).robots
        assert (found.make, found.url) == ("ArduPilot", f"mavlink+serial://{path}?baud=115200")


def test_a_rover_over_tcp_is_asked_by_its_url() -> None:
    with RoverEmulator("tcp://127.0.0.1:0", system=7) as robot:
        (found,) = ask.ask_url(robot.url).robots
        assert found.url == f"{robot.url}?sysid=7"
    assert "cannot connect" in ask.ask_url(robot.url).problem


def test_a_px4_rover_is_named_in_its_url() -> None:
    with Px4Emulator("tcp://127.0.0.1:0") as robot:
        (found,) = ask.ask_url(robot.url).robots
        assert (found.make, found.url) == ("PX4", f"{robot.url}?autopilot=px4")
        assert MavlinkDriver(found.url).description.make == "PX4"


def test_a_udp_port_without_a_rover_or_in_use_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mavlink, "HEARTBEAT_S", 0.1)
    with mavlink.UdpLink("127.0.0.1", 14874):
        problem = mavlink.ask_udp("127.0.0.1", 14874, CLOCK).problem
        assert "held by" in problem
        assert f"(pid {os.getpid()})" in problem
    assert "no heartbeat" in mavlink.ask_udp("127.0.0.1", 14874, CLOCK).problem


# ---------------------------------------------------------------- CAN
@pytest.mark.parametrize("firmware", ["0.5", "0.6"])
def test_two_odrives_are_one_base(firmware: str, tmp_path: Path) -> None:
    port = tmp_path / "can"
    with EmulatedBase(f"can+odrive://{port}?interface=slcan&{BODY}&firmware={firmware}"):
        (found,) = can_bus.ask_channel(f"slcan:{port}", CLOCK).robots
    assert (found.make, found.model) == ("ODrive", "nodes 1 and 2")
    assert found.firmware.startswith(firmware)
    assert "left=1&right=2" in found.url
    assert ("firmware=0.5" in found.url) is (firmware == "0.5")
    assert "node 1 IDLE" in found.note
    with pytest.raises(ConfigError, match="wheel_radius"):
        ask.ask_url(found.url)  # the sizes of the robot are its owner's to fill in


def test_a_base_of_a_fleet_whose_wheel_is_silent_is_named(tmp_path: Path) -> None:
    port = tmp_path / "can"
    with EmulatedBase(f"can+odrive://{port}?interface=slcan&{BODY}"):
        asked = ask.ask_url(f"can+odrive://{port}?interface=slcan&{BODY.replace('right=2', 'right=5')}")
        assert ask.ask_url(f"can+odrive://{port}?interface=slcan&{BODY}").robots
    assert asked.robots == ()
    assert "node 5 is silent; received: 1, 2" in asked.problem


def test_two_vescs_answer_pings(tmp_path: Path) -> None:
    port = tmp_path / "can"
    with EmulatedBase(f"can+vesc://{port}?interface=slcan&{BODY}&pole_pairs=7&gear=10") as robot:
        (found,) = can_bus.ask_channel(f"slcan:{port}@500000", CLOCK).robots
        assert robot.body.state().rolled_m == 0.0
    assert (found.make, found.model) == ("VESC", "nodes 1 and 2")
    assert found.url.startswith(f"can+vesc://{port}?interface=slcan&bitrate=500000&left=1&right=2")


def test_an_empty_bus_says_so() -> None:
    asked = can_bus.ask_channel("virtual:nobody", CLOCK)
    assert asked.robots == ()
    assert "powered" in asked.problem


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("can0", "can+odrive://can0?interface=socketcan&"),
        ("slcan:/dev/ttyACM0@500000", "can+odrive:///dev/ttyACM0?interface=slcan&bitrate=500000&"),
        ("udp_multicast:239.1.1.1:4000", "can+odrive://239.1.1.1?interface=udp_multicast&port=4000&"),
    ],
)
def test_channels_are_written_short(text: str, url: str) -> None:
    assert can_bus.channel_url(text).startswith(url)


@pytest.mark.parametrize("text", ["", "slcan:", "kvaser:0"])
def test_a_channel_that_makes_no_sense_is_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        can_bus.channel_url(text)


def test_what_cannot_be_asked_says_so() -> None:
    assert "cannot be asked" in ask.ask_url("sim://r1").problem
