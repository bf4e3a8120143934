"""Bytes in and out: UDP, TCP and serial ports behind one small interface, and the URL that names them."""

from __future__ import annotations

import errno
import os
import select
import socket
import termios
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol
from urllib.parse import parse_qsl, urlsplit

from fullswarm.errors import ConfigError, DriverError, LinkLost, did_you_mean
from fullswarm.reasons import Code

CONNECT_S = 2.0
WRITE_S = 0.2
SCHEMES = ("mavlink+udp", "mavlink+udpout", "mavlink+tcp", "mavlink+serial")
DEFAULT_BAUD = 115200
CHUNK = 65536


@dataclass(frozen=True, slots=True)
class Address:
    """Where the vehicle is: scheme, host and port, or a serial device with its baud rate."""

    scheme: str
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = DEFAULT_BAUD

    def __str__(self) -> str:
        return self.device or f"{self.scheme.removeprefix('mavlink+')} {self.host}:{self.port}"


def parse_url(url: str) -> tuple[Address, dict[str, str]]:
    """Split a driver URL into its address and its options.

    Raises
    ------
    ConfigError
        Unknown scheme, no port, no device or an option twice.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
    except ValueError as error:
        raise ConfigError(f"not a URL: {error}", where=url) from error
    pairs = parse_qsl(parts.query, keep_blank_values=True)
    options = dict(pairs)
    if len(options) != len(pairs):
        raise ConfigError("an option is given twice", where=url)
    if parts.scheme not in SCHEMES:
        raise ConfigError(
            f"'{parts.scheme}' is not a MAVLink link", where=url, hint=did_you_mean(parts.scheme, SCHEMES)
        )
    if parts.scheme == "mavlink+serial":
        if not parts.path.strip("/") or host:
            raise ConfigError("no serial device", where=url, hint="e.g. mavlink+serial:///dev/ttyACM0?baud=115200")
        return Address(parts.scheme, device=parts.path, baud=_baud(options.pop("baud", ""), url)), options
    if not host or not port or parts.path.strip("/"):
        raise ConfigError("host and port are needed", where=url, hint=f"e.g. {parts.scheme}://127.0.0.1:14550")
    return Address(parts.scheme, host=host, port=port), options


def _baud(text: str, url: str) -> int:
    if not text:
        return DEFAULT_BAUD
    if not text.isdecimal() or int(text) <= 0:
        raise ConfigError(f"'{text}' is not a baud rate", where=url, hint="e.g. ?baud=115200")
    return int(text)


class Transport(Protocol):
    """An open port. `receive` and `send` never wait long; both raise LinkLost when the port is gone."""

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        ...

    def receive(self) -> bytes:
        """Return what has arrived; empty when nothing has."""
        ...

    def send(self, data: bytes) -> None:
        """Send one frame; dropped when nobody can take it."""
        ...

    @property
    def peer(self) -> tuple[str, int] | None:
        """Host and port to send to; None where the port is connected, or nobody was heard."""
        ...

    def forget_peer(self) -> None:
        """Let another sender take the place of one that went silent."""
        ...

    def close(self) -> None:
        """Let go of the port."""
        ...


class UdpPort:
    """A UDP socket: listening (talks to the first vehicle that is heard), or connected to a host.

    A listening port keeps to one peer until told to forget it: a second vehicle with the same system id, or a
    stranger, gets neither attention nor frames.
    """

    def __init__(self, address: Address, *, listen: bool, is_vehicle: Callable[[bytes], bool]) -> None:
        self._socket = socket.socket(_family(address), socket.SOCK_DGRAM)
        self._listen, self._is_vehicle = listen, is_vehicle
        self._peer: Any = None
        try:
            self._socket.setblocking(False)
            target = (address.host, address.port)
            self._socket.bind(target) if listen else self._socket.connect(target)
        except OSError as error:
            self._socket.close()
            raise _cannot_open(address, error) from error

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def receive(self) -> bytes:
        """Return one datagram of the peer."""
        try:
            data, sender = self._socket.recvfrom(CHUNK)
        except OSError:
            return b""  # nothing there, or the other end's port is closed: silence will tell
        if not self._listen:
            return data
        if self._peer is None and self._is_vehicle(data):
            self._peer = sender
        return data if sender == self._peer else b""

    def send(self, data: bytes) -> None:
        """Send a datagram, if there is somebody to send to."""
        try:
            if not self._listen:
                self._socket.send(data)
            elif self._peer is not None:
                self._socket.sendto(data, self._peer)
        except OSError:
            return  # as lossy as UDP itself; the vehicle's silence is what counts

    @property
    def peer(self) -> tuple[str, int] | None:
        """The vehicle, once a listening port has heard it."""
        return None if self._peer is None else (self._peer[0], self._peer[1])

    def forget_peer(self) -> None:
        """Listen for a new peer."""
        self._peer = None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpPort:
    """A TCP client."""

    def __init__(self, address: Address) -> None:
        try:
            self._socket = socket.create_connection((address.host, address.port), timeout=CONNECT_S)
        except OSError as error:
            raise _cannot_open(address, error) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)  # with a timeout even a read that must not wait would wait

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def receive(self) -> bytes:
        """Return the bytes that have arrived."""
        try:
            data = self._socket.recv(CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LinkLost(f"the connection broke: {error.strerror or error}") from error
        if not data:
            raise LinkLost("the vehicle closed the connection")
        return data

    def send(self, data: bytes) -> None:
        """Send a whole frame or give the connection up."""
        left = memoryview(data)
        try:
            while left:
                try:
                    left = left[self._socket.send(left) :]
                except BlockingIOError:
                    self._wait_to_send()
        except OSError as error:
            raise LinkLost(f"the connection broke: {error.strerror or error}") from error

    def _wait_to_send(self) -> None:
        poll = select.poll()
        poll.register(self._socket.fileno(), select.POLLOUT)
        if not poll.poll(WRITE_S * 1000):
            raise LinkLost(f"the vehicle has taken nothing for {WRITE_S:g} s")

    @property
    def peer(self) -> tuple[str, int] | None:
        """None: it is connected."""
        return None

    def forget_peer(self) -> None:
        """A TCP connection has one peer."""

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class SerialPort:
    """A serial device, for ourselves alone."""

    def __init__(self, address: Address) -> None:
        import serial  # here, so that a rover on UDP needs no serial port support

        self._lost: tuple[type[Exception], ...] = (serial.SerialException, OSError)
        try:
            self._port = serial.Serial(address.device, address.baud, timeout=0, write_timeout=WRITE_S, exclusive=True)
        except (*self._lost, ValueError, termios.error) as error:  # the last is no OSError
            raise _cannot_open(address, error) from error

    def fileno(self) -> int:
        """Return the device's descriptor."""
        return int(self._port.fileno())

    def receive(self) -> bytes:
        """Return the bytes that have arrived."""
        try:
            return bytes(self._port.read(CHUNK))
        except self._lost as error:
            raise LinkLost("the serial port vanished") from error

    def send(self, data: bytes) -> None:
        """Send a whole frame or give the port up."""
        try:
            self._port.write(data)
        except self._lost as error:
            raise LinkLost("the serial port takes no bytes: unplugged?") from error

    @property
    def peer(self) -> tuple[str, int] | None:
        """None: it is connected."""
        return None

    def forget_peer(self) -> None:
        """A serial line has one peer."""

    def close(self) -> None:
        """Close the device."""
        self._port.close()


def open_transport(address: Address, is_vehicle: Callable[[bytes], bool]) -> Transport:
    """Open the port of `address`; `is_vehicle` says whether a stranger's datagram is our vehicle's.

    Raises
    ------
    DriverError
        The port cannot be had; says what to do.
    """
    if address.scheme == "mavlink+serial":
        return SerialPort(address)
    if address.scheme == "mavlink+tcp":
        return TcpPort(address)
    return UdpPort(address, listen=address.scheme == "mavlink+udp", is_vehicle=is_vehicle)


class Waker:
    """Lets another thread end the link thread's wait."""

    def __init__(self) -> None:
        self._read, self._write = os.pipe()
        os.set_blocking(self._read, False)
        os.set_blocking(self._write, False)

    def wake(self) -> None:
        """End the wait now."""
        try:
            os.write(self._write, b"\0")
        except (BlockingIOError, OSError):
            return  # a full pipe wakes as well; a closed one has nobody to wake

    def wait(self, transport: Transport | None, timeout_s: float) -> None:
        """Return when `transport` has bytes, :meth:`wake` was called, or after `timeout_s`."""
        poll = select.poll()
        poll.register(self._read, select.POLLIN)
        if transport is not None:
            poll.register(transport.fileno(), select.POLLIN)
        if any(ready == self._read for ready, _ in poll.poll(max(0.0, timeout_s) * 1000)):
            os.read(self._read, 4096)

    def close(self) -> None:
        """Close the pipe."""
        os.close(self._read)
        os.close(self._write)


def _family(address: Address) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in address.host else socket.AF_INET


_HINTS = {
    errno.ENOENT: "is it plugged in and powered?",
    errno.EIO: "is it plugged in and powered?",
    errno.EACCES: "may this user open it? (group dialout; ports below 1024 need root)",
    errno.EBUSY: "another program holds it",
    errno.EAGAIN: "another program holds it",
    errno.EADDRINUSE: "another program listens there: end it or choose another port",
    errno.EADDRNOTAVAIL: "this machine does not have that address",
    errno.ECONNREFUSED: "nobody listens there: is the vehicle or its emulator running?",
}


def _cannot_open(address: Address, error: Exception) -> DriverError:
    if isinstance(error, termios.error):
        error = OSError(*error.args)
    number = getattr(error, "errno", None)
    text = getattr(error, "strerror", None) or str(error)
    hint = _HINTS.get(number, "") if number is not None else ""
    code = Code.PORT_HELD if number in (errno.EAGAIN, errno.EBUSY) else Code.NONE
    what = f"cannot open the link: {text}"
    return DriverError(what, where=str(address), hint=hint or "check address and cable", code=code)
