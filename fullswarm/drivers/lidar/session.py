"""The conversation with a lidar as a state machine: time and bytes in, time and bytes out.

A scan is passed on when its turn is complete. READY while scans come; FAULT when none has come for 0.5 s, until the
next. Damaged packets leave gaps, damaged nodes drop their turn: nothing that was damaged becomes a point.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import structlog

from fullswarm.drivers.base import RANGES_TIMEOUT_S, STAND, Lifecycle, Pose, RangeScan, Reading, Twist
from fullswarm.drivers.lidar import protocol
from fullswarm.drivers.lidar.protocol import Answer, Gap, LdParser, Parser, Point, RplidarParser, Turns
from fullswarm.drivers.lidar.settings import Settings
from fullswarm.drivers.linked import LinkSession
from fullswarm.reasons import Code, Reason, given

SHORTEST_TURN_S, LONGEST_TURN_S = 0.03, 1.0
"""A turn that arrived faster has waited in a buffer: when it was measured is not known."""
SMOOTHING = 0.2
REPORT_S = 10.0
DAMAGE_PER_S = 1.0
"""More damage than this is logged."""

_log = structlog.get_logger("fullswarm.drivers")


class ScanHealth(NamedTuple):
    """How well a lidar measures.

    Attributes
    ----------
    rate_hz : complete scans per second, smoothed; 0 before the second one
    invalid : share of the newest scan's rays that measured nothing
    damaged : packets or nodes dropped since open(), because their checksum or check bits are wrong
    """

    rate_hz: float = 0.0
    invalid: float = 0.0
    damaged: int = 0


class LidarSession(LinkSession[bytes]):
    """One lidar that sends by itself: an LD06 or LD19."""

    def __init__(self, settings: Settings, now_s: float) -> None:
        self._settings = settings
        self._parser: Parser = self._new_parser()
        self._turns = Turns()
        self._scan_s = self._reported_s = now_s
        self._rate_hz = self._invalid = 0.0
        self._damaged_before = self._damaged_reported = 0
        self._blind = ""

    def _new_parser(self) -> Parser:
        return LdParser()

    @property
    def health(self) -> ScanHealth:
        """How well it measures."""
        return ScanHealth(self._rate_hz, self._invalid, self._damaged_before + self._parser.damaged)

    def trouble(self, now_s: float) -> Reason:
        """Return why there are no scans."""
        del now_s
        return given(self.fault, Code.RANGES)

    # ------------------------------------------------------------ the link
    def linked(self, now_s: float) -> None:
        """Begin anew."""
        self._begin(now_s)
        self._scan_s = now_s

    def _begin(self, now_s: float) -> None:
        del now_s
        self._forget()

    def _forget(self) -> None:
        """Drop what has arrived and is not complete."""
        self._damaged_before += self._parser.damaged
        self._parser = self._new_parser()
        self._turns.clear()

    def received(self, chunk: bytes, now_s: float) -> None:
        """Take bytes; pass on each scan that they complete."""
        for each in self._parser.feed(chunk):
            if isinstance(each, Point):
                done = self._turns.add(each, now_s)
                if done is not None:
                    self._take(*done, now_s)
            elif isinstance(each, Gap):
                self._turns.clear()
            else:
                self._answered(each, now_s)

    def _answered(self, answer: Answer, now_s: float) -> None:
        del answer, now_s

    def _take(self, points: list[Point], duration_s: float, now_s: float) -> None:
        """Make a scan of a complete turn."""
        if not SHORTEST_TURN_S <= duration_s <= LONGEST_TURN_S:
            return
        settings, model = self._settings, self._settings.model
        measured = np.array(points)
        angles_rad = np.radians(measured[:, 0]) * (1.0 if settings.upside_down else -1.0)
        distances_m = measured[:, 1]
        distances_m[distances_m > settings.max_m] = math.inf
        distances_m[distances_m < model.near_m] = math.nan
        self._invalid = float(np.isnan(distances_m).mean())
        if self._invalid > 1.0 - settings.least_valid:
            self._blind = f"{self._invalid:.0%} of its rays measure nothing: is it covered? valid=0 for open fields"
            return
        scan = RangeScan(
            now_s, angles_rad, distances_m, settings.max_m, settings.mount, settings.scheme, model.sigma_m, duration_s
        )
        interval_s = now_s - self._scan_s
        if self.reading is not None and interval_s > 0.0:
            rate_hz = self._rate_hz or 1.0 / interval_s
            self._rate_hz = (1.0 - SMOOTHING) * rate_hz + SMOOTHING / interval_s
        self._scan_s, self._blind = now_s, ""
        self.reading = Reading(now_s, Pose(0.0, 0.0, 0.0), STAND, ranges=(scan,))
        self.state, self.fault = Lifecycle.READY, ""

    def tick(self, now_s: float) -> Iterable[bytes]:
        """Watch for silence."""
        if now_s - self._scan_s > RANGES_TIMEOUT_S:
            silent = f"no complete scan for {RANGES_TIMEOUT_S:g} s: check power, cable and baud rate, and that it turns"
            self.state, self.fault = Lifecycle.FAULT, self._blind or silent
        if now_s - self._reported_s >= REPORT_S:
            damaged = self.health.damaged
            if damaged - self._damaged_reported > DAMAGE_PER_S * (now_s - self._reported_s):
                _log.warning("the lidar's data are damaged", lidar=self._settings.scheme, **self.health._asdict())
            self._reported_s, self._damaged_reported = now_s, damaged
        return ()

    # ------------------------------------------------------------ it has no wheels
    def activate(self, now_s: float) -> None:
        """Stay READY."""

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Do nothing."""
        del twist, now_s
        return STAND

    def final_stop(self) -> Iterable[bytes]:
        """Send nothing: it has no commands."""
        return ()


ANSWER_S, SPIN_UP_S, QUIET_S = 1.0, 3.0, 0.1
LONGEST_RETRY_S = 8.0


class RplidarSession(LidarSession):
    """An RPLIDAR: it is stopped, asked for its state, its motor started, then it scans.

    Whatever is not answered in time begins anew, each time after a longer pause.
    """

    def __init__(self, settings: Settings, now_s: float) -> None:
        self._out: list[bytes] = []
        self._info = self._defect = ""
        self._asked = False
        self._due_s = math.inf  # of the next step, or of giving up on an answer
        self._retry_s = ANSWER_S
        super().__init__(settings, now_s)

    def _new_parser(self) -> Parser:
        return RplidarParser()

    @property
    def firmware(self) -> str:
        """Its model number and firmware, as it reports them."""
        return self._info

    def linked(self, now_s: float) -> None:
        """Begin anew."""
        self._retry_s, self._defect = ANSWER_S, ""
        super().linked(now_s)

    def _begin(self, now_s: float) -> None:
        """Stop it: nodes of an earlier scan would hide its answers."""
        super()._begin(now_s)
        self._out, self._asked, self._due_s = [protocol.STOP], False, now_s + QUIET_S

    def _answered(self, answer: Answer, now_s: float) -> None:
        if answer.kind == protocol.INFO and len(answer.payload) == 20:
            model, minor, major, hardware = answer.payload[:4]
            self._info = f"model {model:#04x}, firmware {major}.{minor:02d}, hardware {hardware}"
            self._out.append(protocol.GET_HEALTH)
            self._due_s = now_s + self._retry_s
        elif answer.kind == protocol.HEALTH and len(answer.payload) == 3 and self._info:
            if answer.payload[0] >= protocol.HEALTH_ERROR:
                number = int.from_bytes(answer.payload[1:], "little")
                self._defect = f"it reports a defect, error {number}: it is reset; if that does not help, replace it"
                self._out.append(protocol.RESET)
                self._due_s = now_s + self._retry_s
                return
            self._defect = ""
            self._out += [protocol.motor(protocol.PWM), protocol.SCAN]
            self._due_s = now_s + SPIN_UP_S

    def _take(self, points: list[Point], duration_s: float, now_s: float) -> None:
        super()._take(points, duration_s, now_s)
        self._retry_s, self._due_s = ANSWER_S, now_s + SPIN_UP_S

    def tick(self, now_s: float) -> Iterable[bytes]:
        """Do what is due, and watch for silence."""
        if now_s >= self._due_s:
            if self._asked:
                self._retry_s = min(2.0 * self._retry_s, LONGEST_RETRY_S)
                self._begin(now_s)
            else:
                self._forget()
                self._asked, self._due_s = True, now_s + self._retry_s
                self._out.append(protocol.GET_INFO)
        super().tick(now_s)
        if self._defect and self.state is Lifecycle.FAULT:
            self.fault = self._defect
        out, self._out = self._out, []
        return out

    def next_due_s(self, now_s: float) -> float:
        """Return when :meth:`tick` has something to do."""
        return now_s if self._out else min(self._due_s, super().next_due_s(now_s))

    def final_stop(self) -> Iterable[bytes]:
        """Stop the scan and the motor."""
        return (protocol.STOP, protocol.motor(0))


def session_of(settings: Settings, now_s: float) -> LidarSession:
    """Return a new session for a lidar."""
    return (RplidarSession if settings.scheme == "rplidar" else LidarSession)(settings, now_s)
