"""The robot's ends of real links: a pseudo terminal, UDP, TCP. What is not taken is lost.

Addresses::

    udp://127.0.0.1:14550      sends to a station that listens there
    udpin://127.0.0.1:14551    listens for a station
    tcp://127.0.0.1:5760       serves one station at a time
    pty: or pty:/tmp/rover     a serial device

Port 0 lets the system choose. A port that is plugged in again has its old address.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
import tempfile
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from fullswarm.errors import ConfigError, DriverError
from fullswarm.portability import lock as lock_file

CHUNK = 65536
BURST = 64
"""Chunks taken from a port before the firmware has its turn."""
LATE_BYTES = 4000
"""When this much waits for a reader it loses what follows, as with a real port. A terminal holds up to 4095."""
PTS = "/dev/pts/"
"""Where a link left behind by an emulator leads; any other belongs to another program."""
RATES = (300, 600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)


class Port(Protocol):
    """The robot's end of a link. Not thread-safe."""

    @property
    def address(self) -> str:
        """``host:port`` or the path of a device."""
        ...

    @property
    def rates(self) -> tuple[int, int]:
        """Bits per second of what arrives and of what is sent; 0: takes no time."""
        ...

    def plug(self) -> None:
        """Open it, at its old address if it had one; does nothing when it is open. Raises ``OSError``."""
        ...

    def fileno(self) -> int:
        """Return the descriptor to wait on; -1: there is none now."""
        ...

    def receive(self) -> list[bytes] | None:
        """Return the chunks that have arrived; None when the other side has gone."""
        ...

    def send(self, data: bytes) -> None:
        """Send a chunk."""
        ...

    def drop(self) -> None:
        """End the connection as a restart does; the port stays."""
        ...

    def pull(self) -> None:
        """Unplug it: the other side loses it. Pulling twice is fine."""
        ...

    def close(self) -> None:
        """Release it for good; closing twice is fine."""
        ...


class SocketPort:
    """What UDP and TCP ports have in common: host, port, IPv6 brackets."""

    rates = (0, 0)

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._family = socket.AF_INET6 if ":" in host else socket.AF_INET

    @property
    def address(self) -> str:
        """``host:port`` that the other side opens."""
        return f"[{self._host}]:{self._port}" if ":" in self._host else f"{self._host}:{self._port}"


class UdpPort(SocketPort):
    """Sends to a station that listens, or listens for one."""

    def __init__(self, host: str, port: int, *, listen: bool) -> None:
        super().__init__(host, port)
        self.listens = listen
        self._local: Any = (host, port) if listen else (_own_end(host), 0)
        self._socket: socket.socket | None = None
        self._peer: Any = None if listen else (host, port)

    def plug(self) -> None:
        """Bind the socket."""
        if self._socket is not None:
            return
        self._socket = socket.socket(self._family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(self._local)
        except OSError:
            self.pull()
            raise
        own: int = self._socket.getsockname()[1]
        self._local = (self._local[0], own)
        if self.listens:
            self._port = own

    def fileno(self) -> int:
        """Return the descriptor, -1 while unplugged."""
        return self._socket.fileno() if self._socket else -1

    def receive(self) -> list[bytes]:
        """Return datagrams."""
        chunks: list[bytes] = []
        with contextlib.suppress(OSError):
            while self._socket is not None and len(chunks) < BURST:
                data, sender = self._socket.recvfrom(CHUNK)
                chunks.append(data)
                if self.listens:
                    self._peer = sender
        return chunks

    def send(self, data: bytes) -> None:
        """Send a datagram."""
        if self._socket is not None and self._peer is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._peer)

    def drop(self) -> None:
        """Forget the station that has called."""
        if self.listens:
            self._peer = None

    def pull(self) -> None:
        """Close the socket."""
        self.drop()
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    close = pull


class TcpPort(SocketPort):
    """Serves one station at a time: a second one waits in the queue, as with real firmware."""

    _server: socket.socket | None = None
    _client: socket.socket | None = None

    def plug(self) -> None:
        """Listen."""
        if self._server is None:
            self._server = socket.create_server((self._host, self._port), family=self._family)
            self._server.setblocking(False)
            self._port = self._server.getsockname()[1]

    def fileno(self) -> int:
        """Return the descriptor, -1 while unplugged."""
        end = self._client or self._server
        return end.fileno() if end else -1

    def receive(self) -> list[bytes] | None:
        """Return bytes, after accepting the station that calls."""
        with contextlib.suppress(BlockingIOError):
            if self._client is None:
                if self._server is None:
                    return []
                self._client, _ = self._server.accept()
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                data = self._client.recv(CHUNK)
            except ConnectionError:
                data = b""
            if data:
                return [data]
            self.drop()
            return None
        return []

    def send(self, data: bytes) -> None:
        """Send a chunk, or as much as goes."""
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.send(data)

    def drop(self) -> None:
        """Hang up."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def pull(self) -> None:
        """Hang up and listen no more."""
        self.drop()
        if self._server is not None:
            self._server.close()
            self._server = None

    close = pull


class PtyPort:
    """A serial device. Its path is a link that outlives an unplugging, as ``/dev/serial/by-id`` does.

    Parameters
    ----------
    path
        The link to create; empty puts it into a new folder. A file beside it (``.lock``) says that it is in use.
    notices
        The robot notices when the other side closes the device. Otherwise a descriptor of it stays open here, so that
        a program may close and open it again.

    Raises
    ------
    DriverError
        Something else is at `path`, or another emulator uses it.
    """

    def __init__(self, path: str = "", *, notices: bool = False) -> None:
        self._folder = None if path else tempfile.TemporaryDirectory(prefix="fullswarm-port-")
        self.address = path or str(Path(self._folder.name) / "port" if self._folder else path)
        self.lost = 0  # chunks that no reader took
        self._notices, self._deserted = notices, False
        self._master = self._slave = -1
        self._backlog = bytearray()
        self._lock_file = _lock(self.address)

    def plug(self) -> None:
        """Make the device."""
        if self._master >= 0:
            return
        import tty

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)  # or the terminal echoes what the robot sends back to it
        os.set_blocking(self._master, False)
        link = Path(self.address)
        link.unlink(missing_ok=True)  # of an emulator that was killed
        link.symlink_to(os.ttyname(self._slave))
        if self._notices:
            os.close(self._slave)
            self._slave = -1

    @property
    def rates(self) -> tuple[int, int]:
        """Bits per second of what arrives and of what is sent; 0: takes no time."""
        return 0, 0

    @property
    def baud(self) -> int | None:
        """The rate that the other side has set; 0 for one that no robot has, None when unplugged."""
        import termios

        if self._master < 0:
            return None
        speed = termios.tcgetattr(self._master)[5]
        return next((rate for rate in RATES if getattr(termios, f"B{rate}") == speed), 0)

    def fileno(self) -> int:
        """Return the descriptor; -1 while unplugged, or while no program has the device open."""
        return -1 if self._deserted else self._master

    def receive(self) -> list[bytes] | None:
        """Return bytes."""
        self._write()
        try:
            data = os.read(self._master, CHUNK) if self._master >= 0 else b""
        except BlockingIOError:
            data = b""
        except OSError:  # no program has it open
            self._deserted = True
            self._backlog.clear()
            return None
        self._deserted = False
        return [data] if data else []

    def send(self, data: bytes) -> None:
        """Write a chunk; lost when a late reader has enough waiting for it."""
        waiting = len(self._backlog)
        if self._slave >= 0:
            import fcntl
            import termios

            waiting += struct.unpack("i", fcntl.ioctl(self._slave, termios.FIONREAD, b"\0" * 4))[0]
        if self._master < 0 or waiting >= LATE_BYTES:
            self.lost += 1
            return
        self._backlog += data
        self._write()

    def _write(self) -> None:
        if self._master >= 0 and self._backlog:
            with contextlib.suppress(OSError):
                del self._backlog[: os.write(self._master, self._backlog)]

    def drop(self) -> None:
        """A serial line has no connection."""

    def pull(self) -> None:
        """Remove the device: a program that has it open gets an error."""
        if self._master < 0:
            return
        # The link goes first: the kernel gives the number of the terminal to the next program that asks.
        Path(self.address).unlink(missing_ok=True)
        os.close(self._master)
        if self._slave >= 0:
            os.close(self._slave)
        self._master = self._slave = -1
        self._backlog.clear()

    def close(self) -> None:
        """Remove the device and let other emulators use its path."""
        self.pull()
        if self._lock_file >= 0:
            Path(f"{self.address}.lock").unlink(missing_ok=True)
            os.close(self._lock_file)
            self._lock_file = -1
        if self._folder is not None:
            self._folder.cleanup()


def _lock(path: str) -> int:
    """Claim a path among emulators; the kernel releases it when the process dies. Return the lock's descriptor."""
    link = Path(path)
    ours = link.is_symlink() and str(link.readlink()).startswith(PTS)
    if not ours and (link.exists() or link.is_symlink()):
        raise DriverError("there is something else already", where=path, hint="choose another path for the port")
    try:
        lock = os.open(f"{path}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        hint = "its folder must exist and be writable"
        raise DriverError(f"no port can be made here: {error.strerror}", where=path, hint=hint) from error
    try:
        lock_file(lock, wait=False)
    except OSError as error:
        os.close(lock)
        if error.errno not in (errno.EAGAIN, errno.EACCES):
            raise DriverError(f"the port cannot be locked: {error.strerror}", where=path) from error
        raise DriverError(
            "another emulator uses this path", where=path, hint="end it, or choose another path"
        ) from None
    return lock


def _own_end(host: str) -> str:
    """Return the address from which a host is called."""
    if host.startswith("127.") or host in ("localhost", "::1"):
        return host
    return "::" if ":" in host else ""


def port_at(address: str) -> Port:
    """Return the port that an address (see the module's docstring) names, not yet plugged in.

    Raises
    ------
    ConfigError
        The address is wrong.
    DriverError
        The path of a device cannot be had.
    """
    parts = urlsplit(address)
    host = parts.hostname or "127.0.0.1"
    try:
        number = parts.port or 0
    except ValueError as error:
        raise ConfigError(f"not an address: {error}", where=address) from error
    if parts.scheme == "pty":
        return PtyPort(parts.path)
    if parts.scheme == "tcp":
        return TcpPort(host, number)
    if parts.scheme in ("udp", "udpin"):
        return UdpPort(host, number, listen=parts.scheme == "udpin")
    raise ConfigError("not an address of an emulated robot", where=address, hint="udp://, udpin://, tcp:// or pty:")


def plug(port: Port) -> None:
    """Plug a port in; raises DriverError."""
    try:
        port.plug()
    except OSError as error:
        what = f"cannot open the port: {error.strerror}"
        raise DriverError(what, where=port.address, hint="is it in use?") from error


def make_folder(path: str) -> None:
    """Create the folder of a serial port, which only this user can enter, where it does not exist."""
    folder = Path(path).parent
    if not folder.exists():
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
