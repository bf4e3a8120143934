"""The HAL driver of the Create: a :class:`.session.Session` on a serial port, under one lock. URL: :mod:`.settings`.

Beyond the contract a Create sings, lights its lamps, shows four characters, looks for its dock and tells of its
battery. Those commands need Safe mode, so they raise ``DriverError`` unless the driver is ACTIVE.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import Lifecycle, Reading, Twist
from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.senses import Power
from fullswarm.drivers.create_oi.session import PARK, Session
from fullswarm.drivers.create_oi.settings import describe, parse_url
from fullswarm.drivers.create_oi.waking import Brc
from fullswarm.drivers.guardian import Attempts, GuardedPort
from fullswarm.drivers.link import ByteLog, PlainPort, Port, SerialLink
from fullswarm.errors import DriverError

SONG = 0
"""The song that :meth:`CreateDriver.sing` overwrites."""


class CreateDriver:
    """A :class:`~fullswarm.drivers.base.Driver` for iRobot Create 1, Create 2 and Roomba 500 and 600.

    Parameters
    ----------
    url
        See :mod:`.settings`. Raises ``ConfigError`` if it does not fit; touches nothing.
    log
        Sees every byte, on the link thread.
    brc
        Pulls the robot's BRC pin low (True) or lets it go (False): wakes it and keeps it awake. On the link thread;
        must return at once.
    """

    def __init__(
        self, url: str, *, log: ByteLog | None = None, brc: Brc | None = None, clock: Clock | None = None
    ) -> None:
        self.url = url
        self._settings = parse_url(url)
        self.description = describe(self._settings.generation)
        self._clock = clock or MonotonicClock()
        self._log, self._brc = log, brc
        self._lock = threading.Lock()
        self._link: SerialLink | None = None
        self._session = Session(self._settings, brc=brc)
        self._guarded = bool(self._settings.guardian)
        self._attempts = Attempts(self._clock)

    @property
    def state(self) -> Lifecycle:
        """Where the driver stands."""
        return self._session.state

    @property
    def fault(self) -> str:
        """Why it is in FAULT, or why it is no longer or not yet ACTIVE; empty when nobody asks for motion."""
        with self._lock:
            return self._session.trouble(self._clock.now_s())

    @property
    def fault_code(self) -> str:
        """The :class:`~fullswarm.reasons.Code` of `fault` where the robot's own sensors are the cause; else empty."""
        with self._lock:
            return self._session.trouble_code(self._clock.now_s())

    @property
    def blocked(self) -> str:
        """Why the robot left ACTIVE by itself, or why activate() had no effect; stays until it is ACTIVE again."""
        with self._lock:
            return self._session.blocked

    @property
    def firmware(self) -> str:
        """Interface and generation, and the version if the robot was heard starting; empty until it answers."""
        with self._lock:
            return self._session.firmware

    @property
    def power(self) -> Power | None:
        """The battery and what charges it; None before the first reading."""
        with self._lock:
            return self._session.power

    @property
    def docking(self) -> bool:
        """The robot looks for its dock by itself."""
        return self._session.docking

    def guard(self) -> None:
        """Have the port held by a guardian from the next `open` on, unless the URL says ``guardian=0``."""
        self._guarded = self._settings.guardian is not False

    def open(self) -> None:
        """Claim the port and call the robot. Raises ``DriverError`` with what to do; opening twice is fine."""
        if self._link is not None:
            return
        settings, session = self._settings, Session(self._settings, brc=self._brc)
        served = _Served(session, self._lock, self._clock)
        link = SerialLink(
            settings.path, settings.baud, served,
            opener=self._open_port, last_words=PARK, log=self._log, clock=self._clock,
        )  # fmt: skip
        session.send = link.send
        link.open()
        self._link, self._session = link, session

    def _open_port(self, path: str, baud: int) -> Port:
        # The Open Interface has no watchdog: see decision 14.
        if self._guarded:
            return GuardedPort(path, baud, PARK, self._clock, self._attempts)
        return PlainPort(path, baud)

    def activate(self) -> None:
        """Ask for Safe mode; ACTIVE when the robot confirms it, some 30 ms later. See `blocked` if it does not."""
        with self._lock:
            self._session.activate(self._clock.now_s())

    def deactivate(self) -> None:
        """Stop the wheels and go back to Passive mode; withdraws an activation under way."""
        with self._lock:
            self._session.deactivate(self._clock.now_s())

    def read(self) -> Reading | None:
        """Return the newest reading; None before the first."""
        with self._lock:
            return self._session.reading

    def command(self, twist: Twist) -> Twist:
        """Turn the wheels; return what they were told in whole mm/s. Expires after 0.3 s.

        Raises
        ------
        ValueError
            Not finite; the robot stops.
        """
        with self._lock:
            return self._session.command(twist, self._clock.now_s())

    def close(self) -> None:
        """Stop the wheels, leave the robot in Passive mode, let go of the port. Closing twice is fine."""
        link, self._link = self._link, None
        if link is None:
            return
        with self._lock:
            self._session.deactivate(self._clock.now_s())
        link.close()
        with self._lock:
            self._session.closed()

    # ------------------------------------------------------------ what only a Create can
    def dock(self) -> None:
        """Let the robot look for its dock; it drives by itself then, and stays ACTIVE until it is there (READY).

        `command()` applies zero meanwhile, but has to be called: without it for 0.3 s, or by `deactivate()`, the
        robot stops.

        Raises
        ------
        DriverError
            Not ACTIVE.
        """
        with self._lock:
            self._session.dock(self._clock.now_s())

    def sing(self, notes: Sequence[tuple[int, float]]) -> float:
        """Play up to 16 notes (MIDI 31 to 127, or 0 for a rest; seconds up to 3.98); return how long it takes in s.

        Raises
        ------
        DriverError
            Not ACTIVE.
        ValueError
            Other notes.
        """
        lengths = [(pitch, round(64.0 * duration_s)) for pitch, duration_s in notes]
        self._tell(protocol.song(SONG, lengths) + protocol.play(SONG), "sing")
        return sum(length for _, length in lengths) / 64.0

    def set_lamps(self, bits: int, colour: int = 0, intensity: int = 255) -> None:
        """Light lamps and the power lamp; see :func:`.protocol.leds` for the numbers and what raises."""
        self._tell(protocol.leds(bits, colour, intensity), "light its lamps")

    def show(self, text: str) -> None:
        """Show up to four characters.

        Raises
        ------
        DriverError
            Not ACTIVE, or a Create 1, which has no digits.
        ValueError
            Longer, or not printable ASCII.
        """
        if self._settings.generation is protocol.CREATE1:
            raise DriverError("a Create 1 has no digits to show", where=self._settings.path, hint="use set_lamps()")
        self._tell(protocol.digit_leds(text.upper().ljust(4)), "show a text")

    def _tell(self, data: bytes, what: str) -> None:
        with self._lock:
            self._session.tell(data, what)


@dataclass(frozen=True, slots=True)
class _Served:
    """Hands the link's events to the session, under the driver's lock."""

    session: Session
    lock: threading.Lock
    clock: Clock

    def linked(self) -> None:
        with self.lock:
            self.session.linked(self.clock.now_s())

    def received(self, data: bytes) -> None:
        with self.lock:
            self.session.received(data, self.clock.now_s())

    def tick(self) -> None:
        with self.lock:
            self.session.tick(self.clock.now_s())

    def lost(self, reason: str) -> None:
        with self.lock:
            self.session.lost(reason)
