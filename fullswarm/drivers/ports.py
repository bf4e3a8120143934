"""Opens the ports that robots are on: serial devices, TCP and UDP, without ever waiting for one that is open.

:class:`Port` is what a :class:`~fullswarm.drivers.linked.LinkedDriver` asks of a port. A serial port that a guardian
process holds is :class:`fullswarm.drivers.guardian.GuardedPort`; a CAN bus is
:class:`fullswarm.drivers.can.port.CanPort`.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import socket
from abc import abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

import serial

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import Pose
from fullswarm.errors import ConfigError, DriverError
from fullswarm.reasons import Code


def _port_errors() -> tuple[type[Exception], ...]:
    try:
        import termios
    except ImportError:  # Windows
        return (OSError,)
    return OSError, termios.error


CONNECT_S = 1.0
SILENT_S = 2.0
PIECE = 512
"""Bytes of a stream handed over at once: a session takes them under a lock that must not be held long."""
STREAM_CHUNK, DATAGRAM_CHUNK = 4096, 65536
DATAGRAMS = 64
"""Datagrams taken at most between two looks at what is due."""

PORT_ERRORS = _port_errors()
"""What a serial port raises that is gone or none; ``SerialException`` is an ``OSError``."""

_NOT_OPENED: tuple[type[Exception], ...] = (ValueError, *PORT_ERRORS)

C = TypeVar("C")
"""What a port carries: bytes, or frames of a bus."""


class Port(Protocol[C]):
    """An open port. Nothing here waits; ``OSError`` means that the port is gone. Derive from it for the defaults."""

    gone_hint: str = "is the robot on, and in this network?"

    @property
    def waits_for(self) -> str:
        """What must happen before the port can be used, for people; empty: nothing."""
        return ""

    @abstractmethod
    def fileno(self) -> int | None:
        """Return what to wait on; None: there is no such thing, and it is read each few milliseconds."""
        ...

    @abstractmethod
    def read(self) -> Sequence[C]:
        """Return what has arrived. Called when the descriptor is readable."""
        ...

    @abstractmethod
    def write(self, chunk: C, /) -> C | None:
        """Send a chunk; return what has not been taken of it, None: nothing is left."""
        ...

    @abstractmethod
    def close(self) -> None:
        """Release the port; closing twice is fine."""
        ...

    def beat(self) -> None:
        """Note that the link thread runs; called at least each 50 ms."""
        return

    def drain(self, timeout_s: float) -> None:
        """Wait until what was taken has left this computer, or for `timeout_s`."""
        del timeout_s

    @property
    def guardable(self) -> int | None:
        """The descriptor on which a guardian can send; None: it cannot, or a guardian holds the port already."""
        return self.fileno()

    @property
    def destination(self) -> tuple[str, int] | None:
        """Host and port to send to; None where the port is connected."""
        return None

    def packed(self, chunk: C) -> bytes:
        """Return a chunk as the bytes to be written to the descriptor."""
        if not isinstance(chunk, bytes):
            raise NotImplementedError("a port that carries no bytes must define how its chunks are packed")
        return chunk


def parse_address(text: str, where: str) -> tuple[str, int]:
    """Return host and port of ``host:port`` (IPv4 or a name); `ConfigError` otherwise."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or ":" in host or not port.isascii() or not port.isdigit() or int(port) > 65535:
        raise ConfigError(f"'{text}' is not an address", where=where, hint="write host:port, e.g. 192.168.7.20:7700")
    return host, int(port)


def parse_mount(text: str, option: str, where: str) -> Pose:
    """Return where on the robot a sensor is, of ``x,y,heading`` in m and rad; `ConfigError` otherwise."""
    try:
        numbers = [float(each) for each in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(math.isfinite(each) and abs(each) < 10.0 for each in numbers):
        hint = f"x,y,heading in m and rad, e.g. {option}=0.1,0,1.571"
        raise ConfigError(f"{option} '{text}' is no place on the robot", where=where, hint=hint)
    return Pose(*numbers)


class SerialPort(Port[bytes]):
    """A serial device, 8N1, for this process alone. Raises as :func:`claim`."""

    gone_hint = "plug it in again"

    def __init__(self, path: str, baud: int, clock: Clock | None = None) -> None:
        self._port = claim(path, baud)
        self._clock = clock or MonotonicClock()

    def fileno(self) -> int:
        """Return the descriptor."""
        descriptor: int = self._port.fileno()
        return descriptor

    def read(self) -> Sequence[bytes]:
        """Return what has arrived, in pieces."""
        return _pieces(os.read(self.fileno(), STREAM_CHUNK))

    def write(self, chunk: bytes) -> bytes | None:
        """Write what goes."""
        return _rest(chunk, lambda: os.write(self.fileno(), chunk))

    def drain(self, timeout_s: float) -> None:
        """Wait for the bytes in the system's buffer."""
        end_s = self._clock.now_s() + timeout_s
        while self._port.out_waiting and self._clock.now_s() < end_s:
            select.select([], [], [], 0.002)

    def set_dtr(self, high: bool) -> None:
        """Set the line DTR, where the device has one."""
        with contextlib.suppress(*PORT_ERRORS):
            self._port.dtr = high

    def close(self) -> None:
        """Release the device."""
        self._port.close()


class TcpPort(Port[bytes]):
    """A TCP client.

    Parameters
    ----------
    silence_s
        A connection without a byte for so long counts as gone: TCP itself would not notice for minutes. None: never.
    """

    def __init__(self, host: str, port: int, *, silence_s: float | None = SILENT_S, clock: Clock | None = None) -> None:
        self._clock, self._silence_s = clock or MonotonicClock(), silence_s
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except OSError as error:
            raise cannot_open(f"tcp {host}:{port}", error) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self._received_s = self._clock.now_s()

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def read(self) -> Sequence[bytes]:
        """Return what has arrived, in pieces."""
        try:
            data = self._socket.recv(STREAM_CHUNK)
        except BlockingIOError:
            return ()
        self._received_s = self._clock.now_s()
        return _pieces(data)

    def write(self, chunk: bytes) -> bytes | None:
        """Send what goes."""
        return _rest(chunk, lambda: self._socket.send(chunk))

    def beat(self) -> None:
        """Give up a connection that has been silent for too long."""
        silent_s = self._clock.now_s() - self._received_s
        if self._silence_s is not None and silent_s > self._silence_s:
            raise OSError(errno.ETIMEDOUT, f"nothing received for {self._silence_s:g} s")

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class UdpPort(Port[bytes]):
    """A UDP socket: connected to a host, or listening for one peer. What cannot be sent is lost, as with UDP itself.

    Parameters
    ----------
    accepts
        Makes it listen: tells whether the sender of a datagram takes the place of the peer. All other strangers are
        ignored.
    """

    def __init__(self, host: str, port: int, *, accepts: Callable[[bytes], bool] | None = None) -> None:
        self._accepts = accepts
        self._peer: tuple[str, int] | None = None
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            (self._socket.connect if accepts is None else self._socket.bind)((host, port))
        except OSError as error:
            self._socket.close()
            raise cannot_open(f"udp {host}:{port}", error) from error

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def read(self) -> Sequence[bytes]:
        """Return the peer's datagrams."""
        taken: list[bytes] = []
        for _ in range(DATAGRAMS):
            try:
                data, sender = self._socket.recvfrom(DATAGRAM_CHUNK)
            except OSError:
                break  # nothing there, or the other end's port is closed: its silence is noticed
            if self._accepts is not None and sender[:2] != self._peer:
                if not self._accepts(data):
                    continue
                self._peer = sender[:2]
            taken.append(data)
        return taken

    def write(self, chunk: bytes) -> None:
        """Send a datagram, if there is a peer."""
        try:
            if self._accepts is None:
                self._socket.send(chunk)
            elif self._peer is not None:
                self._socket.sendto(chunk, self._peer)
        except OSError:
            return

    @property
    def destination(self) -> tuple[str, int] | None:
        """The peer of a listening port, once one was accepted."""
        return self._peer

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _pieces(data: bytes) -> Sequence[bytes]:
    if not data:
        raise OSError(errno.EIO, "the other end hung up")
    return (data,) if len(data) <= PIECE else [data[at : at + PIECE] for at in range(0, len(data), PIECE)]


def _rest(chunk: bytes, write: Callable[[], int]) -> bytes | None:
    try:
        return chunk[write() :] or None
    except BlockingIOError:
        return chunk


# ---------------------------------------------------------------- opening
def claim(path: str, baud: int) -> serial.Serial:
    """Open a serial port for this process alone; reading and writing never block.

    Raises
    ------
    DriverError
        With what to do about it.
    """
    try:
        return serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
    except _NOT_OPENED as error:
        raise cannot_open(path, error) from error


def cannot_open(where: str, error: Exception) -> DriverError:
    """Return what to raise for a port that does not open, with what to do about it."""
    number = getattr(error, "errno", None) or (error.args[0] if error.args else None)  # termios.error has the latter
    if number == errno.ENOTTY or "not configure port" in str(error):
        return DriverError("this is not a serial port", where=where, hint=f"ports now: {_ports()}")
    if number in (errno.EAGAIN, errno.EBUSY):
        by = ", ".join(_holders(where))
        what = f"the port is held{f' by {by}' if by else ''}"
        return DriverError(what, where=where, hint="end that program; one port serves one driver", code=Code.PORT_HELD)
    default = (
        f"the port does not open: {getattr(error, 'strerror', None) or error}",
        "check address, cable and baud rate",
    )
    what, hint = _ADVICE.get(number or 0, default)
    return DriverError(what, where=where, hint=hint.replace("{ports}", _ports()) if "{ports}" in hint else hint)


_MISSING = "there is no such port", "plug the robot in; ports now: {ports}"
_FORBIDDEN = (
    "this user may not use the port",
    "for a serial port run 'sudo usermod -aG dialout $USER' and log in again; ports below 1024 need root",
)
_UNREACHABLE = "cannot connect: the address does not answer", "is the robot on, and in this network?"
_ADVICE = {
    errno.ENOENT: _MISSING,
    errno.ENXIO: _MISSING,
    errno.ENODEV: _MISSING,
    errno.EIO: _MISSING,
    errno.EACCES: _FORBIDDEN,
    errno.EPERM: _FORBIDDEN,
    errno.EADDRINUSE: ("the port is in use", "another program listens there: end it or choose another port"),
    errno.EADDRNOTAVAIL: ("this machine does not have that address", "check the address"),
    errno.ECONNREFUSED: ("cannot connect: no program listens there", "is the robot on, or its emulator running?"),
    errno.ETIMEDOUT: _UNREACHABLE,
    errno.EHOSTUNREACH: _UNREACHABLE,
    errno.ENETUNREACH: _UNREACHABLE,
}
"""What has failed and what to do, by the system's error."""


def _ports() -> str:
    devices = Path("/dev")
    named = sorted(str(each) for each in (devices / "serial" / "by-id").glob("*"))
    found = named or sorted(str(each) for kind in ("ttyUSB*", "ttyACM*", "ttyAMA*") for each in devices.glob(kind))
    return ", ".join(found) or "none"


def _holders(path: str) -> list[str]:
    """Name the processes that have the port open, as far as this user may look."""
    device, holders = Path(path).resolve(), []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(_leads_to(each, device) for each in (process / "fd").iterdir()):
                holders.append(f"{(process / 'comm').read_text().strip()} (pid {process.name})")
        except OSError:
            continue  # it has ended, or belongs to another user
    return holders


def _leads_to(link: Path, device: Path) -> bool:
    try:
        return link.readlink() == device
    except OSError:
        return False
