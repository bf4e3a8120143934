"""Drives a Create: a :class:`.session.Session` on a serial port. URL: :mod:`.settings`.

Beyond the contract a Create sings, lights its lamps, shows four characters, looks for its dock and reports its battery.
Those commands need Safe mode, so they raise ``DriverError`` unless the driver is ACTIVE.
"""

from __future__ import annotations

from collections.abc import Sequence

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import STAND
from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.senses import Power
from fullswarm.drivers.create_oi.session import PARK, Brc, Session
from fullswarm.drivers.create_oi.settings import describe, parse_url
from fullswarm.drivers.guardian import Attempts, GuardedPort
from fullswarm.drivers.linked import ChunkLog, LinkedDriver
from fullswarm.drivers.ports import Port, SerialPort
from fullswarm.errors import DriverError

SONG = 0
"""The song that :meth:`CreateDriver.sing` overwrites."""


class CreateDriver(LinkedDriver[bytes]):
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
        self, url: str, *, log: ChunkLog[bytes] | None = None, brc: Brc | None = None, clock: Clock | None = None
    ) -> None:
        settings, clock = parse_url(url), clock or MonotonicClock()
        self._settings, self._brc = settings, brc
        self._own_session = Session(settings, brc=brc)
        attempts = Attempts(clock)

        def port() -> Port[bytes]:
            # The Open Interface has no watchdog, so the guardian alone holds the port: see decision 14.
            if self.guarded:
                return GuardedPort(settings.path, settings.baud, PARK, clock, attempts)
            return SerialPort(settings.path, settings.baud, clock)

        super().__init__(
            url, describe(settings.generation),
            session=self._begin, port=port, guardian=settings.guardian, log=log, clock=clock,
        )  # fmt: skip

    def _begin(self, now_s: float) -> Session:
        del now_s
        self._own_session = Session(self._settings, brc=self._brc)
        return self._own_session

    @property
    def blocked(self) -> str:
        """Why the robot left ACTIVE by itself, or why activate() had no effect; stays until it is ACTIVE again."""
        return self._own_session.blocked

    @property
    def power(self) -> Power | None:
        """The battery and what charges it; None before the first reading."""
        return self._own_session.power

    @property
    def docking(self) -> bool:
        """The robot looks for its dock by itself."""
        return self._own_session.docking

    @property
    def docked(self) -> bool:
        """The robot stands on its Home Base, which has power."""
        found = self._own_session.power
        return found is not None and found.on_dock

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
        self.command(STAND)  # what follows needs a command within 0.3 s, as any motion does
        self.do(self._own_session.dock)

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
        self._send(protocol.song(SONG, lengths) + protocol.play(SONG), "sing")
        return sum(length for _, length in lengths) / 64.0

    def set_lamps(self, bits: int, colour: int = 0, intensity: int = 255) -> None:
        """Light lamps and the power lamp; see :func:`.protocol.leds` for the numbers and what raises."""
        self._send(protocol.leds(bits, colour, intensity), "light its lamps")

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
        self._send(protocol.digit_leds(text.upper().ljust(4)), "show a text")

    def _send(self, data: bytes, what: str) -> None:
        self.do(lambda _: self._own_session.send(data, what))
