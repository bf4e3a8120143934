"""Reads a lidar: a :class:`.session.LidarSession` on a serial port or a TCP connection. URL: :mod:`.settings`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.lidar.session import LidarSession, ScanHealth, session_of
from fullswarm.drivers.lidar.settings import Settings, parse_url
from fullswarm.drivers.linked import ChunkLog, LinkedDriver
from fullswarm.drivers.ports import Port, SerialPort, TcpPort
from fullswarm.errors import DriverError, LinkLost

FIRST_RETRY_S, LONGEST_RETRY_S = 0.25, 2.0


class LidarPort(SerialPort):
    """A serial device with DTR low: with DTR high the adapter of an RPLIDAR A1 stops the motor."""

    def __init__(self, path: str, baud: int, clock: Clock) -> None:
        super().__init__(path, baud, clock)
        with suppress(OSError):  # a pseudo terminal has no such line
            self._port.dtr = False


class NotConnected(Port[bytes]):
    """Stands for an address until the link thread connects to it: that may take a second, which `open` must not."""

    waits_for = "connecting"

    def fileno(self) -> None:
        """Return nothing to wait on."""

    def read(self) -> Sequence[bytes]:
        """Return nothing."""
        return ()

    def write(self, chunk: bytes) -> bytes | None:
        """Take nothing."""
        return chunk

    def beat(self) -> None:
        """Have the link thread connect."""
        raise LinkLost(self.waits_for)

    def close(self) -> None:
        """Nothing is open."""


class LidarDriver(LinkedDriver[bytes]):
    """A :class:`~fullswarm.drivers.base.Driver` without wheels, whose readings have the newest scan.

    A port that does not open is tried again after 0.25 s, then ever later, at most after 2 s.
    """

    def __init__(self, url: str, *, log: ChunkLog[bytes] | None = None, clock: Clock | None = None) -> None:
        settings, clock = parse_url(url), clock or MonotonicClock()
        self._settings, self._time = settings, clock
        self._own_session: LidarSession | None = None
        self._refused: DriverError | None = None
        self._again_s, self._wait_s = -math.inf, FIRST_RETRY_S
        self._opening = False
        super().__init__(
            url, settings.description, session=self._begin, port=self._open_later, log=log, clock=clock
        )  # fmt: skip

    @property
    def health(self) -> ScanHealth:
        """How well it measures."""
        return ScanHealth() if self._own_session is None else self._own_session.health

    def _begin(self, now_s: float) -> LidarSession:
        self._opening = True  # by the agent, not by the link thread
        self._own_session = session_of(self._settings, now_s)
        return self._own_session

    def _open_later(self) -> Port[bytes]:
        """Open the port, unless that has failed a moment ago."""
        opening, self._opening = self._opening, False
        if opening and not self._settings.path:
            return NotConnected()
        now_s = self._time.now_s()
        if self._refused is not None and now_s < self._again_s:
            raise self._refused
        try:
            port = port_of(self._settings, self._time)
        except DriverError as error:
            self._refused, self._again_s = error, now_s + self._wait_s
            self._wait_s = min(2.0 * self._wait_s, LONGEST_RETRY_S)
            raise
        self._refused, self._wait_s = None, FIRST_RETRY_S
        return port


def port_of(settings: Settings, clock: Clock) -> Port[bytes]:
    """Open the port of a lidar; raises `DriverError`."""
    if settings.path:
        return LidarPort(settings.path, settings.baud, clock)
    return TcpPort(*settings.address, clock=clock)
