"""The driver of an Acme Scout: ``acme://192.168.7.20:7700``. One thread owns the connection; one lock, held briefly."""

from __future__ import annotations

import select
import socket
import threading
from urllib.parse import urlsplit

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import STAND, Description, Lifecycle, Reading, Twist
from fullswarm.drivers.guardian import Guardian, StopPlan
from fullswarm.errors import ConfigError, DriverError

from fullswarm_acme.protocol import WATCHDOG_S, drive, line
from fullswarm_acme.session import LIMITS, Session

PORT = 7700
CONNECT_S, WRITE_S, AGAIN_S = 1.0, 0.2, 0.3
TICK_S = 0.01
DEAF_S = 2.0
"""A connection without a word for so long is opened anew: TCP itself would not notice for minutes."""
CHUNK = 4096
STOP = line(drive(STAND))
PLAN = StopPlan(((0.0, STOP), (0.05, STOP), (0.1, STOP)), leave=((1.0, line("DISABLE")),))
"""What the guardian sends when this process is killed or paused: the robot itself would drive on for a second."""


class AcmeDriver:
    """A :class:`~fullswarm.drivers.base.Driver` for an Acme Scout.

    Raises
    ------
    ConfigError
        The URL is none of a Scout.
    """

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        self.url, self._address = url, _address(url)
        self.description = Description(
            "Acme", "Scout", radius_m=0.2, limits=LIMITS, senses_bumps=True, watchdog_s=WATCHDOG_S
        )
        self._clock = clock or MonotonicClock()
        self._lock = threading.Lock()  # guards the session
        self._session = self._new_session()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._guardian: Guardian | None = None

    @property
    def state(self) -> Lifecycle:
        """Where the driver stands; not READY before its guardian watches."""
        state, guardian = self._session.state, self._guardian
        return Lifecycle.OPEN if state is Lifecycle.READY and guardian is not None and guardian.trouble else state

    @property
    def fault(self) -> str:
        """Why it is in FAULT and what to do; empty otherwise."""
        return self._session.fault

    @property
    def firmware(self) -> str:
        """What the robot says it runs."""
        return self._session.firmware

    def guard(self) -> None:
        """Have a guardian from the next `open` on."""
        self._guardian = self._guardian or Guardian(self._clock)

    def open(self) -> None:
        """Connect and greet; ``DriverError`` if nobody answers there. Opening twice is fine."""
        if self._thread is not None:
            return
        try:
            link = self._connect()
        except OSError as error:
            raise DriverError(
                f"cannot connect: {error.strerror or error}",
                where=self.url,
                hint="is the robot on, in your network, and at this address?",
            ) from error
        self._session = self._new_session()
        self._session.linked()
        self._closing.clear()
        self._thread = threading.Thread(target=self._run, args=(link,), name=f"link {self.url}", daemon=True)
        self._thread.start()

    def activate(self) -> None:
        """Ask for motors on; ACTIVE when the robot shows it."""
        with self._lock:
            if self.state is Lifecycle.READY:
                self._session.activate()

    def deactivate(self) -> None:
        """ACTIVE → READY, motors off."""
        with self._lock:
            self._session.deactivate()

    def read(self) -> Reading | None:
        """Return the newest reading; None before the first."""
        return self._session.reading

    def command(self, twist: Twist) -> Twist:
        """Take a set-point; return what the robot is told. ``ValueError`` if not finite, and a stop."""
        with self._lock:
            return self._session.command(twist, self._clock.now_s())

    def close(self) -> None:
        """Zero, motors off, hang up. Closing twice is fine."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._closing.set()
            thread.join()

    # ------------------------------------------------------------ the link's thread
    def _run(self, link: socket.socket | None) -> None:
        while not self._closing.is_set():
            try:
                link = link or self._connect()
                self._serve(link)
            except OSError as error:
                with self._lock:
                    self._session.lost(f"the link is gone ({error.strerror or error}); trying again")
                if self._guardian is not None:
                    self._guardian.release()
                if link is not None:
                    link.close()
                    link = None
                self._closing.wait(AGAIN_S)
        with self._lock:
            last_words = self._session.closed()
        if self._guardian is not None:
            self._guardian.release()
        if link is not None:
            _say_and_close(link, last_words)

    def _serve(self, link: socket.socket) -> None:
        """Talk until closing; ``OSError`` when the link is gone or deaf."""
        began_s = self._clock.now_s()
        guardian = self._guardian
        if guardian is not None:
            guardian.watch(link.fileno())
            guardian.stop_with(PLAN)
        with self._lock:
            self._session.linked()
        while not self._closing.is_set():
            data = b""
            if select.select([link], [], [], TICK_S)[0]:
                data = link.recv(CHUNK)
                if not data:
                    raise ConnectionResetError("it hung up")
            if guardian is not None:
                stopped = guardian.beat()
                if self._session.state is Lifecycle.ACTIVE and (stopped or guardian.trouble):
                    raise ConnectionAbortedError(guardian.trouble or "the guardian stopped it: this process was paused")
            now_s = self._clock.now_s()
            with self._lock:
                self._session.received(data, now_s)
                said = self._session.tick(now_s)
                silent_s = min(self._session.silent_for_s(now_s), now_s - began_s)
            if silent_s > DEAF_S:
                raise TimeoutError(f"no word for {DEAF_S} s")
            if said:
                link.sendall(said)

    def _connect(self) -> socket.socket:
        link = socket.create_connection(self._address, timeout=CONNECT_S)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.settimeout(WRITE_S)
        return link

    def _new_session(self) -> Session:
        host, port = self._address
        return Session(f"{host}:{port}")


def _say_and_close(link: socket.socket, last_words: bytes) -> None:
    try:
        link.sendall(last_words)
    except OSError:
        return  # the robot's own watchdog has to stop it
    finally:
        link.close()


def _address(url: str) -> tuple[str, int]:
    try:
        parts = urlsplit(url)
        port = parts.port or PORT
    except ValueError as error:
        raise ConfigError(f"not a URL: {error}", where=url) from error
    if parts.scheme != "acme" or not parts.hostname or parts.path or parts.query:
        raise ConfigError("this names no Acme robot", where=url, hint=f"write acme://192.168.7.20:{PORT}")
    return parts.hostname, port
