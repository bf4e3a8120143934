"""The wires to break: what they carry, lose and say, on a real pseudo-terminal and on real sockets."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial

from fullswarm.testing import Wire, serial_wire, udp_wire

SOON_S, NEVER_S = 2.0, 0.1


class Device:
    """A serial device whose port can vanish, under a name of its own."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "device"
        self.plug()

    def plug(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path.symlink_to(os.ttyname(self.slave))

    def vanish(self) -> None:
        self.path.unlink()
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    made = Device(tmp_path)
    yield made
    with contextlib.suppress(FileNotFoundError):
        made.vanish()


@pytest.fixture
def wire(device: Device) -> Iterator[Wire]:
    with serial_wire(str(device.path), 115200) as made:
        yield made


def hear(descriptor: int, count: int, limit_s: float = SOON_S) -> bytes:
    """Return what comes until `count` bytes are there or time is up."""
    heard, end_s = b"", time.monotonic() + limit_s
    while len(heard) < count and select.select([descriptor], [], [], max(0.0, end_s - time.monotonic()))[0]:
        heard += os.read(descriptor, count - len(heard))
    return heard


def eventually(true: Callable[[], bool]) -> bool:
    end_s = time.monotonic() + SOON_S
    while not true() and time.monotonic() < end_s:
        select.select([], [], [], 0.01)
    return true()


def hung_up(descriptor: int) -> bool:
    try:
        return os.write(descriptor, b"x") < 0
    except OSError as error:
        return error.errno == errno.EIO


def test_a_serial_wire_carries_both_ways_and_does_what_it_is_told(device: Device, wire: Wire) -> None:
    with serial.Serial(wire.port, 115200, timeout=0, exclusive=True) as driver:
        driver.write(b"go")
        assert hear(device.master, 2) == b"go"
        os.write(device.master, bytes(range(256)))
        assert hear(driver.fileno(), 256) == bytes(range(256))
        wire.garbage(b"\xff\x00")
        assert hear(driver.fileno(), 2) == b"\xff\x00"
        wire.cut()
        os.write(device.master, b"12345678")
        assert hear(driver.fileno(), 8, NEVER_S) == b"1234"
        wire.mute(True)
        os.write(device.master, b"lost")
        driver.write(b"heard")
        assert hear(device.master, 5) == b"heard"
        assert hear(driver.fileno(), 4, NEVER_S) == b""
        wire.mute(False)
        os.write(device.master, b"back")
        assert hear(driver.fileno(), 4) == b"back"


def test_a_pulled_serial_wire_hangs_up_and_comes_back_under_its_name(device: Device, wire: Wire) -> None:
    with serial.Serial(wire.port, 115200, timeout=0) as driver:
        wire.unplug()
        assert not Path(wire.port).exists()
        assert eventually(lambda: hung_up(driver.fileno()))
    os.write(device.master, b"nobody hears this")
    wire.garbage(b"nor this")
    wire.replug()
    with serial.Serial(wire.port, 115200, timeout=0) as driver:
        driver.write(b"again")
        assert hear(device.master, 5) == b"again"


def test_a_device_that_vanishes_takes_the_drivers_end_along(device: Device, wire: Wire) -> None:
    assert Path(wire.port).exists()
    device.vanish()
    assert eventually(lambda: not Path(wire.port).exists())
    device.plug()
    assert eventually(lambda: Path(wire.port).exists())
    with serial.Serial(wire.port, 115200, timeout=0) as driver:
        os.write(device.master, b"here")
        assert hear(driver.fileno(), 4) == b"here"


def test_a_udp_wire_loses_what_is_said_while_it_is_pulled() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as driver,
    ):
        device.bind(("127.0.0.1", 0))
        with udp_wire(f"127.0.0.1:{device.getsockname()[1]}") as wire:
            driver.connect(("127.0.0.1", int(wire.port)))
            driver.send(b"go")
            device.settimeout(SOON_S)
            data, peer = device.recvfrom(10)
            assert data == b"go"
            wire.cut()
            device.sendto(b"12345678", peer)
            assert hear(driver.fileno(), 4) == b"1234"
            wire.unplug()
            device.sendto(b"lost", peer)
            driver.send(b"lost")
            wire.garbage(b"lost")
            assert hear(driver.fileno(), 4, NEVER_S) == b""
            wire.replug()
            device.sendto(b"back", peer)
            assert hear(driver.fileno(), 4) == b"back"
            driver.send(b"on")
            assert device.recv(10) == b"on"
            wire.close()
