"""The links of sources: a thread that opens a connection, reads it, and opens it again after an error."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol
from urllib.parse import urlsplit

from fullswarm.bus.endpoint import is_loopback
from fullswarm.clock import Clock
from fullswarm.drivers.ports import SerialPort
from fullswarm.errors import ConfigError, DriverError, without_login
from fullswarm.localization.rtcm import Outbox
from fullswarm.localization.sighting import Frame, Refused
from fullswarm.localization.source import Receiver, Seen

CONNECT_S = 2.0
RETRY_S = 1.0
TURN_S = 0.1
"""Longest time between two looks at what is due."""
MAX_DATAGRAM = 65_536
PIECE = 65_536


class HasFileno(Protocol):
    """What `select` can wait for."""

    def fileno(self) -> int:
        """Return the descriptor."""
        ...


class Connection(ABC):
    """One open connection. `OSError` from any method: it is lost."""

    @abstractmethod
    def waits_on(self) -> Sequence[HasFileno]:
        """Return what to wait on."""
        ...

    @abstractmethod
    def read(self, ready: HasFileno, now_s: float) -> Iterable[tuple[str, Frame | bytes | Refused]]:
        """Return (sender, content) of what has arrived."""
        ...

    def turn(self, now_s: float) -> None:
        """Send what is due; called at least each 0.1 s."""
        del now_s

    @abstractmethod
    def close(self) -> None:
        """Release it."""
        ...


class Link:
    """Keeps a connection open on a thread of its own.

    Parameters
    ----------
    connect : opens it; `OSError` or `DriverError`: it cannot now, try again later
    address : for messages
    lost : what a message about a lost connection begins with
    retry_s : time until the next attempt, asked for after each one
    """

    def __init__(
        self,
        connect: Callable[[], Connection],
        address: str,
        clock: Clock,
        *,
        lost: str = "no connection to ",
        retry_s: Callable[[], float] = lambda: RETRY_S,
    ) -> None:
        self._connect, self._lost, self._clock = connect, f"{lost}{address}", clock
        self._retry_s = retry_s
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, receiver: Receiver) -> None:
        """Deliver from now on."""
        self._thread = threading.Thread(target=self._run, args=(receiver,), name="fixes", daemon=True)
        self._thread.start()

    def _run(self, receiver: Receiver) -> None:
        while not self._closing.is_set():
            try:
                with contextlib.closing(self._connect()) as connection:
                    receiver.report("")
                    self._serve(connection, receiver)
            except (OSError, DriverError) as error:
                receiver.report(f"{self._lost}: {_reason(error)}")
            self._closing.wait(self._retry_s())

    def _serve(self, connection: Connection, receiver: Receiver) -> None:
        while not self._closing.is_set():
            connection.turn(self._clock.now_s())
            ready, _, _ = select.select(connection.waits_on(), (), (), TURN_S)
            for each in ready:
                now_s = self._clock.now_s()
                for sender, content in connection.read(each, now_s):
                    receiver.arrive(now_s, sender, content)

    def close(self, wait_s: float | None = None) -> None:
        """Stop delivering; wait for the thread, at most `wait_s`: looking a host up cannot be interrupted."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(wait_s)


class FrameSource:
    """A source whose connection delivers frames, which need no parser.

    Parameters
    ----------
    sensor, hint, address : see :class:`~fullswarm.localization.source.Source`
    """

    def __init__(self, sensor: str, hint: str, address: str, connect: Callable[[], Connection], clock: Clock) -> None:
        self.sensor, self.hint, self.address = sensor, hint, address
        self._link = Link(connect, address, clock)

    def start(self, receiver: Receiver) -> None:
        """Deliver to `receiver` from now on."""
        self._link.start(receiver)

    def read(self, content: bytes) -> Iterable[Seen]:
        """Parse nothing."""
        del content
        return ()

    def close(self) -> None:
        """Stop delivering."""
        self._link.close()


def _reason(error: Exception) -> str:
    if isinstance(error, TimeoutError):
        return str(error) or "no answer"
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)


class ByteStream(Connection):
    """A TCP connection, read as bytes.

    Parameters
    ----------
    outbox : what is to be sent there; what waited before it is opened is too old
    """

    def __init__(self, host: str, port: int, outbox: Outbox | None = None) -> None:
        self._sender, self._outbox = host, outbox
        if outbox is not None:
            outbox.clear()
        self._socket = socket.create_connection((host, port), CONNECT_S)
        self._socket.setblocking(False)

    def waits_on(self) -> Sequence[HasFileno]:
        """Return the socket."""
        return (self._socket,)

    def read(self, ready: HasFileno, now_s: float) -> Iterable[tuple[str, bytes]]:
        """Return what has arrived."""
        del ready, now_s
        data = self._socket.recv(PIECE)
        if not data:
            raise ConnectionResetError("the other side has closed the connection")
        return ((self._sender, data),)

    def turn(self, now_s: float) -> None:
        """Send what waits."""
        del now_s
        if self._outbox is not None:
            self._outbox.send(self._write)

    def _write(self, data: bytes) -> bytes | None:
        with contextlib.suppress(BlockingIOError):
            data = data[self._socket.send(data) :]
        return data or None

    def close(self) -> None:
        """Release it."""
        self._socket.close()


class SerialStream(Connection):
    """A serial device, read as bytes.

    Parameters
    ----------
    outbox : what is to be sent there; what waited before it is opened is too old
    """

    def __init__(self, path: str, baud: int, outbox: Outbox | None = None) -> None:
        self._sender, self._outbox = path, outbox
        if outbox is not None:
            outbox.clear()
        self._port = SerialPort(path, baud)

    def waits_on(self) -> Sequence[HasFileno]:
        """Return the port."""
        return (self._port,)

    def read(self, ready: HasFileno, now_s: float) -> Iterable[tuple[str, bytes]]:
        """Return what has arrived."""
        del ready, now_s
        found = [(self._sender, piece) for piece in self._port.read()]
        if not found:
            raise ConnectionResetError("the device is gone")
        return found

    def turn(self, now_s: float) -> None:
        """Send what waits."""
        del now_s
        if self._outbox is not None:
            self._outbox.send(self._port.write)

    def write(self, data: bytes) -> None:
        """Send bytes to the device."""
        self._port.write(data)

    def close(self) -> None:
        """Release it."""
        self._port.close()


class FileStream(Connection):
    """A file or named pipe, read as bytes from its beginning; at the end of a file it waits for more."""

    def __init__(self, path: str) -> None:
        self._sender = path
        self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self._silent, self._other = os.pipe()  # never readable: a plain file is always readable, also at its end

    def waits_on(self) -> Sequence[HasFileno]:
        """Return what is never ready; the file is read at each turn."""
        return (_Descriptor(self._silent),) if self._at_end() else (_Descriptor(self._descriptor),)

    def _at_end(self) -> bool:
        stat = os.fstat(self._descriptor)
        return stat.st_size > 0 and os.lseek(self._descriptor, 0, os.SEEK_CUR) >= stat.st_size

    def read(self, ready: HasFileno, now_s: float) -> Iterable[tuple[str, bytes]]:
        """Return the next piece."""
        del ready, now_s
        data = os.read(self._descriptor, 512)
        return ((self._sender, data),) if data else ()

    def close(self) -> None:
        """Release it."""
        for each in (self._descriptor, self._silent, self._other):
            os.close(each)


class _Descriptor:
    def __init__(self, number: int) -> None:
        self._number = number

    def fileno(self) -> int:
        return self._number


class DatagramPort(Connection):
    """A UDP port of this machine, open from the beginning, so that a wrong address is an error at once.

    Parameters
    ----------
    where : for messages: "--listen 127.0.0.1:9870"

    Raises
    ------
    ConfigError
        The address is no address, taken, not ours, or not loopback.
    """

    def __init__(self, listen: str, insecure_network: bool, where: str) -> None:
        host, _, port = listen.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise ConfigError("expected HOST:PORT", where=where, hint="like 127.0.0.1:9870")
        if not is_loopback(host) and not insecure_network:
            raise ConfigError(
                "this address is open to the network: any computer there could send the robots wrong poses",
                where=where,
                hint="use 127.0.0.1, or allow it with --insecure-network on a network that you trust",
            )
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host.strip("[]"), int(port)))
        except OSError as error:
            self._socket.close()
            raise ConfigError(
                f"cannot listen there: {error.strerror or error}",
                where=where,
                hint="is another `fullswarm fixes` running? or the address is not of this machine",
            ) from error
        self._socket.setblocking(False)

    @property
    def address(self) -> str:
        """Where it listens, ``host:port``."""
        host, port = self._socket.getsockname()[:2]
        return f"{host}:{port}"

    def waits_on(self) -> Sequence[HasFileno]:
        """Return the socket."""
        return (self._socket,)

    def read(self, ready: HasFileno, now_s: float) -> Iterable[tuple[str, bytes]]:
        """Return one datagram."""
        del ready, now_s
        with contextlib.suppress(OSError):  # an earlier answer could not be delivered; nothing to read
            data, sender = self._socket.recvfrom(MAX_DATAGRAM)
            return ((sender[0], data),)
        return ()

    def close(self) -> None:
        """Release it."""
        self._socket.close()


class _Kept(Connection):
    """A connection that outlives the link's attempts: a port that was opened at the start."""

    def __init__(self, port: DatagramPort) -> None:
        self._port = port

    def waits_on(self) -> Sequence[HasFileno]:
        return self._port.waits_on()

    def read(self, ready: HasFileno, now_s: float) -> Iterable[tuple[str, bytes]]:
        return self._port.read(ready, now_s)

    def close(self) -> None:
        return


class PortLink(Link):
    """The link of a UDP port, which is open from the beginning until the link is closed."""

    def __init__(self, port: DatagramPort, clock: Clock) -> None:
        super().__init__(lambda: _Kept(port), f"udp {port.address}", clock)
        self._port = port

    def close(self, wait_s: float | None = None) -> None:
        """Stop delivering, and release the port."""
        super().close(wait_s)
        self._port.close()


def byte_link(
    url: str,
    baud: str,
    clock: Clock,
    *,
    insecure_network: bool,
    serial: Callable[[str, int], Connection] = SerialStream,
    outbox: Outbox | None = None,
) -> tuple[Link, str]:
    """Return the link of a URL ``x:///dev/...``, ``x+tcp://HOST:PORT``, ``x+udp://`` or ``x+file://``, and its address.

    Parameters
    ----------
    outbox : what is to be sent over a TCP connection; a serial device gets its own by `serial`

    Raises
    ------
    ConfigError
        The URL is none of these.
    """
    parts = urlsplit(url)
    transport = parts.scheme.partition("+")[2]
    if transport == "tcp" and parts.hostname and parts.port:
        host, port = parts.hostname, parts.port
        address = without_login(url)
        return Link(lambda: ByteStream(host, port, outbox), address, clock), address
    if transport == "udp":
        own = DatagramPort(parts.netloc, insecure_network, f"source {without_login(url)}")
        return PortLink(own, clock), f"udp {own.address}"
    if transport == "file" and parts.path:
        return Link(lambda: FileStream(parts.path), parts.path, clock), parts.path
    if not transport and parts.path.startswith("/") and not parts.netloc and baud.isdecimal():
        return Link(lambda: serial(parts.path, int(baud)), parts.path, clock), parts.path
    name = parts.scheme.partition("+")[0]
    hint = f"{name}:///dev/ttyACM0?baud=115200, {name}+tcp://HOST:PORT, {name}+udp://HOST:PORT or {name}+file:///PATH"
    raise ConfigError("no device, address or file", where=f"source {without_login(url)}", hint=hint)
