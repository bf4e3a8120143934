"""An emulated ArduPilot rover behind a real port: the driver cannot tell it from the firmware's own simulator.

Addresses::

    udp://127.0.0.1:14550      sends to a station that listens there (driver: mavlink+udp)
    udpin://127.0.0.1:14551    listens for a station (driver: mavlink+udpout)
    tcp://127.0.0.1:5760       serves one station at a time (driver: mavlink+tcp)
    pty:                       a serial device, named by `device` (driver: mavlink+serial)

Port 0 lets the system choose; `url` then names the driver's end.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import socket
import threading
import tty
from typing import Any, Protocol, Self
from urllib.parse import urlsplit

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.mavlink.body import Body, UnicycleBody
from fullswarm.drivers.mavlink.codec import StreamParser
from fullswarm.drivers.mavlink.firmware import Firmware, SetpointRecord
from fullswarm.errors import ConfigError, DriverError

LOOP_WAIT_MS = 5
CHUNK = 65536


class Port(Protocol):
    """The vehicle's end of a link; bytes that nobody takes are lost."""

    url: str

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
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
        """Let go of the port."""
        ...


class _Udp:
    def __init__(self, host: str, port: int, *, listen: bool) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._peer: Any = None if listen else (host, port)
        self.url = f"mavlink+udp://{host}:{port}"
        if listen:
            try:
                self._socket.bind((host, port))
            except OSError:
                self._socket.close()
                raise
            self.url = f"mavlink+udpout://{host}:{self._socket.getsockname()[1]}"
        self._listen = listen

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self) -> bytes:
        try:
            data, sender = self._socket.recvfrom(CHUNK)
        except OSError:
            return b""
        if self._listen:
            self._peer = sender
        return data

    def send(self, data: bytes) -> None:
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._peer)

    def drop(self) -> None:
        if self._listen:
            self._peer = None

    def close(self) -> None:
        self._socket.close()


class _Tcp:
    def __init__(self, host: str, port: int) -> None:
        self._server = socket.create_server((host, port))
        self._server.setblocking(False)
        self._client: socket.socket | None = None
        self.url = f"mavlink+tcp://{host}:{self._server.getsockname()[1]}"

    def fileno(self) -> int:
        # One client at a time: a second one waits in the queue unheard, as with the real firmware.
        return (self._client or self._server).fileno()

    def receive(self) -> bytes:
        with contextlib.suppress(BlockingIOError):
            if self._client is None:
                self._client, _ = self._server.accept()
                self._client.setblocking(False)
            try:
                data = self._client.recv(CHUNK)
            except ConnectionError:
                data = b""
            if not data:
                self.drop()
            return data
        return b""

    def send(self, data: bytes) -> None:
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.send(data)

    def drop(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def close(self) -> None:
        self.drop()
        self._server.close()


class _Pty:
    def __init__(self) -> None:
        # Our own descriptor of the device stays open, so that a station may close and open it again.
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)
        self.url = f"mavlink+serial://{self.device}"

    def fileno(self) -> int:
        return self._master

    def receive(self) -> bytes:
        try:
            return os.read(self._master, CHUNK)
        except OSError:
            return b""

    def send(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            os.write(self._master, data)

    def drop(self) -> None:
        """A serial line has no connection."""

    def close(self) -> None:
        os.close(self._master)
        os.close(self._slave)


def open_port(address: str) -> Port:
    """Open the vehicle's end of a link (see the module's docstring).

    Raises
    ------
    ConfigError
        The address is wrong.
    DriverError
        The port cannot be had.
    """
    parts = urlsplit(address)
    host = parts.hostname or "127.0.0.1"
    try:
        port = parts.port or 0
        if parts.scheme == "pty":
            return _Pty()
        if parts.scheme == "tcp":
            return _Tcp(host, port)
        if parts.scheme in ("udp", "udpin"):
            return _Udp(host, port, listen=parts.scheme == "udpin")
    except ValueError as error:
        raise ConfigError(f"not an address: {error}", where=address) from error
    except OSError as error:
        raise DriverError(f"cannot open the port: {error.strerror}", where=address, hint="is it in use?") from error
    raise ConfigError("not an address of an emulated rover", where=address, hint="udp://, udpin://, tcp:// or pty:")


class RoverEmulator:
    """A rover that runs from :meth:`start` to :meth:`stop`, or as a context manager.

    Parameters
    ----------
    address
        See the module's docstring; or an open port.
    body
        What it drives; default: a kinematic unicycle.
    system
        Its system id.
    boot_s
        Power-on to armable (real: 42.4 s).
    """

    def __init__(
        self,
        address: str | Port,
        body: Body | None = None,
        *,
        system: int = 1,
        boot_s: float = 0.2,
        clock: Clock | None = None,
    ) -> None:
        self._port = open_port(address) if isinstance(address, str) else address
        self.url = self._port.url
        self.body: Body = body or UnicycleBody()
        self.firmware = Firmware(self.body, system=system, boot_s=boot_s)
        self._clock = clock or MonotonicClock()
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._muted = False
        self._thread: threading.Thread | None = None

    def start(self) -> Self:
        """Power on."""
        self._stopping.clear()
        self.firmware.power_on(self._clock.now_s())
        self._thread = threading.Thread(target=self._run, name=f"rover emulator {self.url}", daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """Power off and let go of the port; stopping twice is fine."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._port.close()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def setpoints(self) -> list[SetpointRecord]:
        """A copy of the set-points that arrived since the start (the newest 20 000)."""
        with self._lock:
            return list(self.firmware.setpoints)

    def pilot_mode(self, mode: int) -> None:
        """Turn the pilot's mode switch."""
        with self._lock:
            self.firmware.pilot_mode(mode, self._clock.now_s())

    def reboot(self) -> None:
        """Restart the autopilot; the connection drops."""
        with self._lock:
            self._port.drop()
            self.firmware.power_on(self._clock.now_s())

    def mute(self, muted: bool = True) -> None:
        """Break the radio: nothing gets through either way."""
        self._muted = muted

    def _run(self) -> None:
        parser = StreamParser()
        while not self._stopping.is_set():
            poll = select.poll()
            poll.register(self._port.fileno(), select.POLLIN)
            data = self._port.receive() if poll.poll(LOOP_WAIT_MS) else b""
            with self._lock:
                now_s = self._clock.now_s()
                for message in [] if self._muted else parser.feed(data):
                    self.firmware.receive(message, now_s)
                if now_s >= self.firmware.reboot_due_s:
                    self._port.drop()
                    self.firmware.power_on(now_s)
                frames = self.firmware.tick(now_s)
            for frame in [] if self._muted else frames:
                self._port.send(frame)
