"""The time-of-flight sensors of one robot: a thread that reads them, starts them again, and keeps the newest scans."""

from __future__ import annotations

import contextlib
import math
import threading

import numpy as np

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import RANGES_TIMEOUT_S, RangeScan
from fullswarm.drivers.tof import protocol
from fullswarm.drivers.tof.bus import Bus, NoAnswer, open_bus
from fullswarm.drivers.tof.settings import LABEL, Placed, Settings
from fullswarm.errors import DriverError, MissingExtra

ANEW_S = 0.25
"""A sensor without a new measurement for so long is started again: it may have lost its power."""
FIRST_S = 1.0
"""The first measurement takes longer: the sensor calibrates its receivers."""
REOPEN_S = 2.0
"""A bus on which no sensor measures for so long is opened again."""
RETRY_S, LONGEST_RETRY_S = 0.5, 4.0
POLL_S, EARLY_S = 0.005, 0.01
SIGMA_M = 0.015
"""Standard deviation of a distance, by the data sheet's repeatability with some spare."""


class Beam:
    """The conversation with one sensor; each step makes a few transfers and waits for nothing.

    Attributes
    ----------
    reason : why it measures nothing; empty: it does, or it has just been started
    due_s : when the next step is due
    """

    def __init__(self, placed: Placed, settings: Settings) -> None:
        self._placed, self._settings = placed, settings
        self.reason, self.due_s = "", -math.inf
        self._started = self._warm = False
        self._number: int | None = None
        self._since_s = -math.inf  # the last measurement, or start

    def step(self, bus: Bus, now_s: float) -> float | None:
        """Start the sensor, or return the distance (m) of a new measurement; None: there is none yet."""
        self.due_s = now_s + POLL_S
        if self._started and now_s - self._since_s > (ANEW_S if self._warm else FIRST_S):
            self._started = False
            self.reason = self.reason or "no new measurement: it is started again"
        try:
            if self._placed.channel is not None:
                bus.transfer(self._settings.mux, bytes([1 << self._placed.channel]))
            if self._started:
                return self._measured(bus, now_s)
            self._start(bus, now_s)
        except NoAnswer:
            self.reason = "it does not answer: check its wires and power"
            if not self._started:
                self.due_s = now_s + ANEW_S
        return None

    def _start(self, bus: Bus, now_s: float) -> None:
        model = self._read(bus, protocol.MODEL_ID, 2)
        if model != protocol.MODEL:
            self.reason = f"its model is {model.hex()}: this is no VL53L1X"
            self.due_s = now_s + ANEW_S
        elif self._read(bus, protocol.BOOTED, 1)[0] & 1:
            self._write(bus, *protocol.WARMING)
            self._started, self._warm, self._since_s = True, False, now_s

    def _measured(self, bus: Bus, now_s: float) -> float | None:
        if not self._read(bus, protocol.READY, 1)[0] & 1:
            return None
        settings = self._settings
        if not self._warm:
            self._write(bus, *protocol.WARMED)
            clock, centre = self._read(bus, protocol.CLOCK, 2), self._read(bus, protocol.ROI_CENTRE, 1)
            self._write(bus, *protocol.measuring(settings.mode, settings.roi, clock, centre))
            self._warm, self._since_s = True, now_s
            return None
        result = protocol.decode(self._read(bus, protocol.RESULT, protocol.RESULT_BYTES), settings.mode, settings.max_m)
        self._write(bus, protocol.CLEAR)
        if result.number == self._number:
            return None  # the same as before, or as before it was started again
        self._number = result.number
        if result.distance_m is None:
            self.reason = "it reports that its laser or its receivers have failed"
            return None
        self.reason, self._since_s = "", now_s
        self.due_s = now_s + settings.mode.budget_ms / 1000.0 - EARLY_S
        return result.distance_m

    def _read(self, bus: Bus, register: int, count: int) -> bytes:
        return bus.transfer(self._placed.address, protocol.read_from(register), count)

    def _write(self, bus: Bus, *registers: tuple[int, bytes]) -> None:
        for register, data in registers:
            bus.transfer(self._placed.address, protocol.write_to(register, data))


class TofSensors:
    """The time-of-flight sensors of one robot.

    Attributes
    ----------
    scans : the newest of each sensor, the same tuple until one is newer; empty before the first
    """

    def __init__(self, settings: Settings, clock: Clock | None = None) -> None:
        self.settings, self._clock = settings, clock or MonotonicClock()
        self.scans: tuple[RangeScan, ...] = ()
        self._names = {settings.name_of(each): each for each in settings.sensors}
        self._port_trouble = ""
        self._reasons: dict[str, str] = {}  # by name of the scan; a new one for each change
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def max_m(self) -> float:
        """How far they measure."""
        return self.settings.max_m

    @property
    def trouble(self) -> str:
        """Which of them measures nothing now, why, and what to do; empty: all is well."""
        since_s = self._clock.now_s() - RANGES_TIMEOUT_S
        fresh = {scan.name for scan in self.scans if scan.stamp_s >= since_s}
        missing = [name for name in self._names if name not in fresh]
        if not missing:
            return ""
        keys, reasons = ", ".join(self._names[name].key for name in missing), self._reasons
        noun, verb = ("sensor", "measures") if len(missing) == 1 else ("sensors", "measure")
        waits = f"no measurement for {RANGES_TIMEOUT_S:g} s"
        reason = self._port_trouble or "; ".join(dict.fromkeys(reasons.get(name) or waits for name in missing))
        return f"the {LABEL} {noun} {keys} on {self.settings.where} {verb} nothing: {reason}"

    def start(self) -> None:
        """Read from now on. Starting twice is fine."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=f"tof {self.settings.where}", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop the sensors and release their bus. Closing twice is fine."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(2.0)
            self._thread = None

    # ------------------------------------------------------------ the thread
    def _run(self) -> None:
        retry_s = RETRY_S
        while not self._closing.is_set():
            before = self.scans
            try:
                with contextlib.closing(open_bus(self.settings, self._clock)) as bus:
                    self._serve(bus)
            except (DriverError, MissingExtra) as error:
                self._port_trouble = f"{error.what}; {error.hint}" if error.hint else error.what
            except OSError as error:
                self._port_trouble = f"the bus is gone ({error.strerror or error}): it is opened again"
            if self.scans is not before:
                retry_s = RETRY_S
            if self._closing.wait(retry_s):
                return
            retry_s = min(2.0 * retry_s, LONGEST_RETRY_S)

    def _serve(self, bus: Bus) -> None:
        """Read the sensors until closing, or until the bus is lost: ``OSError``."""
        beams = {name: Beam(each, self.settings) for name, each in self._names.items()}
        found = {scan.name: scan for scan in self.scans}
        self._port_trouble, measured_s = "", self._clock.now_s()
        while not self._closing.wait(POLL_S):
            news = False
            for name, beam in beams.items():
                now_s = self._clock.now_s()
                if now_s < beam.due_s:
                    continue
                distance_m = beam.step(bus, now_s)
                if distance_m is not None:
                    found[name] = self._scan(name, distance_m, now_s)
                    news, measured_s = True, now_s
            self._reasons = {name: beam.reason for name, beam in beams.items()}
            if news:
                self.scans = tuple(found[name] for name in beams if name in found)
            if self._clock.now_s() - measured_s > REOPEN_S:
                self._port_trouble = "; ".join(dict.fromkeys(each.reason for each in beams.values() if each.reason))
                self._port_trouble = self._port_trouble or "no sensor measures"
                return
        self._stop(bus)

    def _stop(self, bus: Bus) -> None:
        """Let the sensors rest."""
        settings = self.settings
        for each in settings.sensors:
            with contextlib.suppress(OSError):
                if each.channel is not None:
                    bus.transfer(settings.mux, bytes([1 << each.channel]))
                bus.transfer(each.address, protocol.write_to(*protocol.STOP))

    def _scan(self, name: str, distance_m: float, now_s: float) -> RangeScan:
        settings = self.settings
        return RangeScan(
            now_s, np.zeros(1), np.array([distance_m]), settings.max_m, self._names[name].at, name, SIGMA_M,
            cone_rad=settings.cone_rad,
        )  # fmt: skip
