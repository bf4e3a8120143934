"""A cable to break: a relay between a driver and its device that is pulled, muted, fed with noise, cut in mid-frame.

With it any emulator, and any real robot on a serial port or UDP, has most of a :class:`~fullswarm.testing.Rig`::

    with AcmeEmulator() as robot, serial_wire(robot.port, 115200) as wire:
        rig = Rig(make=lambda: AcmeDriver(f"acme://{wire.port}"), unplug=wire.unplug, replug=wire.replug,
                  mute=wire.mute, garbage=wire.garbage, cut=wire.cut, ...)

A device that vanishes by itself (an emulator that is unplugged) takes the driver's end of the wire along.
"""

from __future__ import annotations

import os
import select
import socket
import tempfile
import threading
from pathlib import Path
from typing import Protocol, Self

import serial

from fullswarm.drivers.ports import PORT_ERRORS

POLL_S = 0.02
CHUNK = 65536


class _Ends(Protocol):
    """Both ends of one kind of link, used under the wire's lock."""

    port: str

    def plug(self) -> bool:
        """Open what is not open; False if the device is not there."""
        ...

    def pull(self) -> None:
        """Let the driver see that the link is gone."""
        ...

    def descriptors(self) -> tuple[int, int]:
        """Return the driver's and the device's descriptor; -1: not there."""
        ...

    def receive(self, device: bool) -> bytes:
        """Return what came from one end; ``OSError`` when it is gone."""
        ...

    def send(self, data: bytes, device: bool) -> None:
        """Send it to one end."""
        ...

    def close(self) -> None:
        """Close both ends."""
        ...


class Wire:
    """A relay with a thread of its own; a context manager. Made by :func:`serial_wire` and :func:`udp_wire`.

    Attributes
    ----------
    port
        The driver's end: the path of a serial port, or a UDP port's number.
    """

    def __init__(self, ends: _Ends) -> None:
        self._ends, self.port = ends, ends.port
        self._lock = threading.Lock()  # guards the switches and the driver's end
        self._plugged, self._muted, self._cut = True, False, False
        self._there = self._ends.plug()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="wire", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def unplug(self) -> None:
        """Pull it."""
        with self._lock:
            self._plugged = self._there = False
            self._ends.pull()

    def replug(self) -> None:
        """Put it back."""
        with self._lock:
            self._plugged = True
            self._there = self._ends.plug()

    def mute(self, muted: bool) -> None:
        """Lose all that the device sends, and nothing that the driver sends."""
        with self._lock:
            self._muted = muted

    def garbage(self, data: bytes) -> None:
        """Say this to the driver."""
        with self._lock:
            if self._there:
                self._ends.send(data, device=False)

    def cut(self) -> None:
        """Lose the second half of the next chunk that the device sends."""
        with self._lock:
            self._cut = True

    def close(self) -> None:
        """End the thread and let go of both ends. Closing twice is fine."""
        self._closing.set()
        self._thread.join()
        self._ends.close()

    # ------------------------------------------------------------ the wire's thread
    def _run(self) -> None:
        while not self._closing.is_set():
            with self._lock:
                if self._plugged and not self._there:
                    self._there = self._ends.plug()
                ends = self._ends.descriptors()
            poll = select.poll()
            for each in ends:
                if each >= 0:
                    poll.register(each, select.POLLIN)
            ready = {number for number, _ in poll.poll(POLL_S * 1e3)}
            with self._lock:
                # The other thread may have pulled the wire meanwhile, and descriptors are reused.
                if ends == self._ends.descriptors():
                    self._carry(ends[0] in ready, ends[1] in ready)

    def _carry(self, from_driver: bool, from_device: bool) -> None:
        try:
            from_driver_data = self._ends.receive(device=False) if from_driver else b""
            from_device_data = self._ends.receive(device=True) if from_device else b""
            if self._cut and from_device_data:
                self._cut, from_device_data = False, from_device_data[: len(from_device_data) // 2]
            if from_driver_data and self._there:
                self._ends.send(from_driver_data, device=True)
            if from_device_data and self._there and not self._muted:
                self._ends.send(from_device_data, device=False)
        except OSError:
            self._there = False
            self._ends.pull()


def serial_wire(device: str, baud: int) -> Wire:
    """Return a wire between a driver and the serial port of its device; the driver's end keeps its name."""
    return Wire(_SerialEnds(device, baud))


def udp_wire(device: str) -> Wire:
    """Return a wire between a driver that sends to ``127.0.0.1:port`` and a device that listens at ``host:port``."""
    host, _, port = device.rpartition(":")
    return Wire(_UdpEnds((host, int(port))))


class _SerialEnds:
    def __init__(self, device: str, baud: int) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="wire-")
        self.port = str(Path(self._folder.name) / "port")
        self._path, self._baud = device, baud
        self._device: serial.Serial | None = None
        self._master = self._slave = -1

    def plug(self) -> bool:
        try:
            if self._device is None:
                self._device = serial.Serial(self._path, self._baud, timeout=0, write_timeout=0, exclusive=True)
        except PORT_ERRORS:
            return False
        if self._master < 0:
            import tty

            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)  # or the terminal echoes what is written into it
            os.set_blocking(self._master, False)
            Path(self.port).symlink_to(os.ttyname(self._slave))
        return True

    def pull(self) -> None:
        if self._master >= 0:
            Path(self.port).unlink()
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1
        if self._device is not None:
            self._device.close()
            self._device = None

    def descriptors(self) -> tuple[int, int]:
        return self._master, -1 if self._device is None else int(self._device.fileno())

    def receive(self, device: bool) -> bytes:
        data = os.read(self.descriptors()[device], CHUNK)
        if device and not data:
            raise OSError("hung up")
        return data

    def send(self, data: bytes, device: bool) -> None:
        try:
            os.write(self.descriptors()[device], data)
        except BlockingIOError:
            return  # a reader that is late loses what follows, as with a real port's buffer

    def close(self) -> None:
        self.pull()
        self._folder.cleanup()


class _UdpEnds:
    def __init__(self, device: tuple[str, int]) -> None:
        self._driver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._driver.bind(("127.0.0.1", 0))
        self._device = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._device.connect(device)
        for each in (self._driver, self._device):
            each.setblocking(False)
        self.port = str(self._driver.getsockname()[1])
        self._peer: tuple[str, int] | None = None

    def plug(self) -> bool:
        return True

    def pull(self) -> None:
        """It is not visible that a datagram has nowhere to go; the wire loses them."""

    def descriptors(self) -> tuple[int, int]:
        return self._driver.fileno(), self._device.fileno()

    def receive(self, device: bool) -> bytes:
        try:
            if device:
                return self._device.recv(CHUNK)
            data, self._peer = self._driver.recvfrom(CHUNK)
        except OSError:
            return b""  # the other end's port is closed: the silence will show it
        return data

    def send(self, data: bytes, device: bool) -> None:
        try:
            if device:
                self._device.send(data)
            elif self._peer is not None:
                self._driver.sendto(data, self._peer)
        except OSError:
            return  # as lossy as UDP itself

    def close(self) -> None:
        self._driver.close()
        self._device.close()
