"""A lidar on its port: a thread reads it, opens the port again after an error, and keeps the newest turn."""

from __future__ import annotations

import contextlib
import select
import threading

import numpy as np

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import RANGES_TIMEOUT_S, RangeScan
from fullswarm.drivers.lidar.settings import Settings
from fullswarm.drivers.ports import Port, SerialPort, TcpPort
from fullswarm.errors import DriverError
from fullswarm.kernels import Array

ANEW_S = 2.0
"""One that says nothing for so long is told once more to scan."""
RETRY_S, LONGEST_RETRY_S = 0.5, 4.0
POLL_S = 0.1


class LidarSensor:
    """The lidar of one robot.

    Attributes
    ----------
    scans : the newest, the same tuple until there is a newer one; empty before the first
    """

    def __init__(self, settings: Settings, clock: Clock | None = None) -> None:
        self.settings, self._clock = settings, clock or MonotonicClock()
        self.scans: tuple[RangeScan, ...] = ()
        self._codec = settings.kind.codec(settings.baud)
        self._port_trouble, self._measured = "", 1.0
        self._turned_s: float | None = None
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def max_m(self) -> float:
        """How far it is believed."""
        return self.settings.max_m

    @property
    def trouble(self) -> str:
        """Why nothing is measured now, and what to do; empty: all is well."""
        label, where = self.settings.kind.label, self.settings.where
        if not self.scans or self._clock.now_s() - self.scans[0].stamp_s > RANGES_TIMEOUT_S:
            noise = f", {self._codec.bad} bytes were none of its packets" if self._codec.bad else ""
            reason = self._port_trouble or f"no turn for {RANGES_TIMEOUT_S:g} s{noise}: has it power, and does it turn?"
            return f"the {label} on {where} measures nothing: {reason}"
        if self._measured < self.settings.least:
            return (
                f"the {label} on {where} is covered: {100.0 * self._measured:.0f} % of its rays measure something; "
                "where nothing is in its range write least=0 in its URL"
            )
        return ""

    def start(self) -> None:
        """Read from now on. Starting twice is fine."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=f"lidar {self.settings.where}", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop the lidar and release its port. Closing twice is fine."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(2.0)
            self._thread = None

    # ------------------------------------------------------------ the thread
    def _run(self) -> None:
        retry_s = RETRY_S
        while not self._closing.is_set():
            try:
                with contextlib.closing(self._open()) as port:
                    before = self.scans
                    try:
                        self._serve(port)
                    finally:
                        if self.scans is not before:
                            retry_s = RETRY_S
                        with contextlib.suppress(OSError):
                            port.write(self._codec.end())
            except DriverError as error:
                self._port_trouble = f"{error.what}; {error.hint}" if error.hint else error.what
            except OSError as error:
                self._port_trouble = f"the port is gone ({error.strerror or error}): plug it in again"
            if self._closing.wait(retry_s):
                return
            retry_s = min(2.0 * retry_s, LONGEST_RETRY_S)

    def _open(self) -> Port[bytes]:
        settings = self.settings
        if not settings.path:
            return TcpPort(settings.host, settings.port, silence_s=None, clock=self._clock)
        port = SerialPort(settings.path, self._codec.baud, self._clock)
        port.set_dtr(False)  # an RPLIDAR A1's motor stands while it is high
        return port

    def _serve(self, port: Port[bytes]) -> None:
        """Read the port until closing, or until it is lost: ``OSError``."""
        poll = select.poll()
        poll.register(port.fileno() or 0, select.POLLIN)
        self._port_trouble = ""
        port.write(self._codec.begin())
        asked_s = self._clock.now_s()
        while not self._closing.is_set():
            if poll.poll(1000.0 * POLL_S):
                for chunk in port.read():
                    for turn in self._codec.take(chunk):
                        self._turned(turn.angles_rad, turn.distances_m)
            now_s = self._clock.now_s()
            if now_s - max(asked_s, self._turned_s or asked_s) > ANEW_S:
                asked_s = now_s
                port.write(self._codec.begin())

    def _turned(self, angles_rad: Array, distances_m: Array) -> None:
        """Keep a turn whose last ray was measured now."""
        settings, now_s = self.settings, self._clock.now_s()
        before_s, self._turned_s = self._turned_s, now_s
        far = distances_m > settings.max_m
        measured = np.where(far, np.inf, distances_m)
        self._measured = float(np.mean(~np.isnan(measured)))
        duration_s = 0.0 if before_s is None else min(now_s - before_s, RANGES_TIMEOUT_S)
        self.scans = (
            RangeScan(
                now_s, -angles_rad if settings.flipped else angles_rad, measured, settings.max_m, settings.at,
                settings.name, settings.kind.sigma_m, duration_s,
            ),
        )  # fmt: skip
