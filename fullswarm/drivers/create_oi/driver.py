"""The HAL driver of the Create: a :class:`.session.Session` on a serial port, under one lock.

URL: ``create:///dev/ttyUSB0?model=create2``; ``model`` is ``create1``, ``roomba500`` or ``create2`` (default),
``baud`` overrides the model's rate, ``mode_offset=1`` is for firmware that reports its mode one too high.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from urllib.parse import parse_qsl, unquote, urlsplit

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import Description, Lifecycle, Limits, Reading, Twist
from fullswarm.drivers.create_oi.protocol import BAUD_CODES, CREATE2, GENERATIONS, TOP_MM_S, Generation
from fullswarm.drivers.create_oi.session import PARK, Session
from fullswarm.drivers.link import ByteLog, SerialLink
from fullswarm.errors import ConfigError, did_you_mean

ACCEL_M_S2 = 1.0
"""What the wheels do without slipping on a lab floor; the robot itself takes any step."""

SLOWEST_BAUD = 19200


@dataclass(frozen=True, slots=True)
class Settings:
    """What a URL says."""

    path: str
    generation: Generation = CREATE2
    baud: int = CREATE2.baud
    mode_offset: int = 0


def parse_url(url: str) -> Settings:
    """Read a driver URL.

    Raises
    ------
    ConfigError
        Another scheme, no path, an unknown option or a value that does not fit.
    """
    parts = urlsplit(url)
    path = unquote(parts.path)
    if parts.scheme != "create" or parts.netloc or not path.startswith("/") or path == "/":
        raise ConfigError("this names no serial port", where=url, hint="write create:///dev/ttyUSB0?model=create2")
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    for name in options.keys() - {"model", "baud", "mode_offset"}:
        hint = did_you_mean(name, ("model", "baud", "mode_offset"))
        raise ConfigError(f"unknown option '{name}'", where=url, hint=hint)
    model = options.get("model", CREATE2.name)
    if model not in GENERATIONS:
        raise ConfigError(f"unknown model '{model}'", where=url, hint=did_you_mean(model, GENERATIONS))
    generation = GENERATIONS[model]
    rates = tuple(rate for rate in BAUD_CODES.values() if rate >= SLOWEST_BAUD)
    baud = _choice(url, "baud", options.get("baud", str(generation.baud)), rates)
    return Settings(path, generation, baud, _choice(url, "mode_offset", options.get("mode_offset", "0"), (0, 1)))


def _choice(url: str, name: str, text: str, choices: tuple[int, ...]) -> int:
    for each in choices:
        if text == str(each):
            return each
    raise ConfigError(f"{name} '{text}' will not do", where=url, hint=f"one of {', '.join(map(str, choices))}")


def describe(generation: Generation) -> Description:
    """Return what is known of a generation before connecting."""
    top_m_s, base_m = TOP_MM_S / 1000.0, generation.wheel_base_m
    return Description(
        make="iRobot",
        model=generation.label,
        radius_m=generation.radius_m,
        limits=Limits(top_m_s, 2.0 * top_m_s / base_m, ACCEL_M_S2, 2.0 * ACCEL_M_S2 / base_m),
        senses_bumps=True,
        watchdog_s=None,
    )


class CreateDriver:
    """A :class:`~fullswarm.drivers.base.Driver` for iRobot Create 1, Create 2 and Roomba 500 and 600.

    Parameters
    ----------
    url
        See the module. Raises ``ConfigError`` if it does not fit; touches nothing.
    log
        Sees every byte, on the link thread.
    """

    def __init__(self, url: str, *, log: ByteLog | None = None, clock: Clock | None = None) -> None:
        self.url = url
        self._settings = parse_url(url)
        self.description = describe(self._settings.generation)
        self._clock = clock or MonotonicClock()
        self._log = log
        self._lock = threading.Lock()
        self._link: SerialLink | None = None
        self._session = self._new_session()

    @property
    def state(self) -> Lifecycle:
        """Where the driver stands."""
        return self._session.state

    @property
    def fault(self) -> str:
        """Why it is in FAULT and what to do; empty otherwise."""
        with self._lock:
            return self._session.fault

    @property
    def blocked(self) -> str:
        """Why the robot left ACTIVE by itself, or why activate() had no effect; empty when neither."""
        with self._lock:
            return self._session.blocked

    @property
    def firmware(self) -> str:
        """Always empty: the Open Interface tells its version only on a reset."""
        return ""

    def open(self) -> None:
        """Claim the port and call the robot. Raises ``DriverError`` with what to do; opening twice is fine."""
        if self._link is not None:
            return
        settings, session = self._settings, self._new_session()
        served = _Served(session, self._lock, self._clock)
        link = SerialLink(settings.path, settings.baud, served, last_words=PARK, log=self._log, clock=self._clock)
        session.send = link.send
        link.open()
        self._link, self._session = link, session

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

    def _new_session(self) -> Session:
        settings = self._settings
        return Session(settings.generation, settings.baud, settings.path, mode_offset=settings.mode_offset)


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
