"""The vehicle's ends of real links. Bytes that nobody takes are lost; a port opened again has its old address."""

from __future__ import annotations

import contextlib
import os
import socket
import tempfile
import tty
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from fullswarm.errors import ConfigError, DriverError

CHUNK = 65536


class Port(Protocol):
    """The vehicle's end of a link."""

    url: str

    def open(self) -> None:
        """Open it (again)."""
        ...

    def fileno(self) -> int:
        """Return the descriptor to wait on; -1 while it is closed."""
        ...

    def receive(self) -> bytes:
        """Return what has arrived."""
        ...

    def send(self, data: bytes) -> None:
        """Send one frame."""
        ...

    def drop(self) -> None:
        """Close the connection as a restart does; the port stays."""
        ...

    def close(self) -> None:
        """Let go of the port; closing twice is fine."""
        ...


class UdpPort:
    """Sends to a station that listens, or listens for one."""

    def __init__(self, host: str, port: int, *, listen: bool) -> None:
        self._host, self._port, self._listen = host, port, listen
        self._local: Any = (host, port) if listen else None  # the same one again after a replug
        self._socket: socket.socket | None = None
        self._peer: Any = None if listen else (host, port)
        self.url = ""

    def open(self) -> None:
        """Bind the socket."""
        self._socket = socket.socket(_family(self._host), socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(self._local or (_own_end(self._host), 0))
        except OSError:
            self.close()
            raise
        own: int = self._socket.getsockname()[1]
        self._local = (self._host if self._listen else _own_end(self._host), own)
        host = f"[{self._host}]" if ":" in self._host else self._host
        self.url = f"mavlink+udpout://{host}:{own}" if self._listen else f"mavlink+udp://{host}:{self._port}"

    def fileno(self) -> int:
        """Return the descriptor, -1 while closed."""
        return self._socket.fileno() if self._socket else -1

    def receive(self) -> bytes:
        """Return one datagram."""
        if self._socket is None:
            return b""
        try:
            data, sender = self._socket.recvfrom(CHUNK)
        except OSError:
            return b""
        if self._listen:
            self._peer = sender
        return data

    def send(self, data: bytes) -> None:
        """Send a datagram."""
        if self._socket is not None and self._peer is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._peer)

    def drop(self) -> None:
        """Forget who called."""
        if self._listen:
            self._peer = None

    def close(self) -> None:
        """Close the socket."""
        self.drop()
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class TcpPort:
    """Serves one station at a time: a second one waits in the queue unheard, as with the real firmware."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        self.url = ""

    def open(self) -> None:
        """Listen."""
        self._server = socket.create_server((self._host, self._port), family=_family(self._host))
        self._server.setblocking(False)
        self._port = self._server.getsockname()[1]
        host = f"[{self._host}]" if ":" in self._host else self._host
        self.url = f"mavlink+tcp://{host}:{self._port}"

    def fileno(self) -> int:
        """Return the descriptor, -1 while closed."""
        end = self._client or self._server
        return end.fileno() if end else -1

    def receive(self) -> bytes:
        """Return bytes, after accepting whoever calls."""
        with contextlib.suppress(BlockingIOError):
            if self._client is None:
                if self._server is None:
                    return b""
                self._client, _ = self._server.accept()
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                data = self._client.recv(CHUNK)
            except ConnectionError:
                data = b""
            if not data:
                self.drop()
            return data
        return b""

    def send(self, data: bytes) -> None:
        """Send a frame, or as much as goes."""
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.send(data)

    def drop(self) -> None:
        """Hang up."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def close(self) -> None:
        """Hang up and listen no more."""
        self.drop()
        if self._server is not None:
            self._server.close()
            self._server = None


class PtyPort:
    """A serial device. Its path is a link that outlives an unplugging, as ``/dev/serial/by-id`` does."""

    def __init__(self, path: str = "") -> None:
        self._folder = None if path else tempfile.TemporaryDirectory(prefix="fullswarm-rover-")
        self.device = path or str(Path(self._folder.name) / "tty" if self._folder else path)
        self._master = self._slave = -1
        self.url = f"mavlink+serial://{self.device}"

    def open(self) -> None:
        """Make the device. Our own descriptor of it stays open, so that a station may close and open it again."""
        link = Path(self.device)
        if link.is_symlink():
            link.unlink()  # left by a rover that was killed
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        try:
            link.symlink_to(os.ttyname(self._slave))
        except OSError:
            self.close()
            raise

    def fileno(self) -> int:
        """Return the descriptor, -1 while closed."""
        return self._master

    def receive(self) -> bytes:
        """Return bytes."""
        try:
            return os.read(self._master, CHUNK) if self._master >= 0 else b""
        except OSError:
            return b""

    def send(self, data: bytes) -> None:
        """Write a frame."""
        with contextlib.suppress(OSError):
            if self._master >= 0:
                os.write(self._master, data)

    def drop(self) -> None:
        """A serial line has no connection."""

    def close(self) -> None:
        """Remove the device."""
        if self._master >= 0:
            Path(self.device).unlink(missing_ok=True)
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1

    def __del__(self) -> None:
        if self._folder is not None:
            self._folder.cleanup()


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def _own_end(host: str) -> str:
    """Return the address from which a host is called."""
    if host.startswith("127.") or host in ("localhost", "::1"):
        return host
    return "::" if ":" in host else ""


def open_port(address: str) -> Port:
    """Open the vehicle's end of a link: ``udp://``, ``udpin://`` or ``tcp://`` with host and port, ``pty:/path``.

    Raises
    ------
    ConfigError
        The address is wrong.
    DriverError
        The port cannot be had.
    """
    parts = urlsplit(address)
    host = parts.hostname or "127.0.0.1"
    port: Port
    try:
        number = parts.port or 0
        if parts.scheme == "pty":
            port = PtyPort(parts.path)
        elif parts.scheme == "tcp":
            port = TcpPort(host, number)
        elif parts.scheme in ("udp", "udpin"):
            port = UdpPort(host, number, listen=parts.scheme == "udpin")
        else:
            hint = "udp://, udpin://, tcp:// or pty:"
            raise ConfigError("not an address of an emulated rover", where=address, hint=hint)
    except ValueError as error:
        raise ConfigError(f"not an address: {error}", where=address) from error
    reopen(port, address)
    return port


def reopen(port: Port, where: str) -> None:
    """Open a port (again); raises DriverError."""
    try:
        port.open()
    except OSError as error:
        raise DriverError(f"cannot open the port: {error.strerror}", where=where, hint="is it in use?") from error
