"""What is known of the sources that see one robot: how late and how good their fixes are, and what they do not see."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from fullswarm.agent.message_delay import MessageDelay
from fullswarm.config import AgentConfig
from fullswarm.messages import FixSourceReport, PoseFix, RangeFix

MOST = 8
"""Sources per robot, as many as a health report holds; of more, the one that was silent longest is forgotten."""
FAR_M = 1.0e6
VAGUE_M = 100.0
REPORT_GONE_S = 3.0
"""A source that has not reported for so long has ended."""
REPORT_FORGOTTEN_S = 600.0
REPORTS = 32
SMOOTHING = 0.1
"""Share of a new residual in the mean that is reported."""


@dataclass(slots=True)
class Source:
    """One source that sees a robot; times in s on this machine's clock."""

    name: str  # of its process and clock
    sensor: str = ""
    marker: str = ""
    rank: int = 0  # in `AgentConfig.fix_order`; less is preferred
    stamp_s: float = -math.inf  # of the newest that was in order and in time, on its own clock
    arrived_s: float = -math.inf  # when any came last
    accepted_s: float = -math.inf  # when one came in order and in time
    used_s: float = -math.inf  # when one was used last
    refused: str = ""  # why the last one was not used
    residual_m: float = math.nan  # mean of the last ones against the pose before them
    residual_rad: float = math.nan
    clock: MessageDelay = field(default_factory=MessageDelay)

    @property
    def label(self) -> str:
        """What people call it."""
        return self.sensor or self.name

    def note(self, residual_m: float, residual_rad: float) -> None:
        """Add a residual to the mean."""
        self.residual_m = _mean(self.residual_m, residual_m)
        self.residual_rad = _mean(self.residual_rad, abs(residual_rad))


def _mean(mean: float, new: float) -> float:
    if math.isnan(new):
        return mean
    return new if math.isnan(mean) else mean + SMOOTHING * (new - mean)


@dataclass(slots=True)
class RobotSources:
    """All sources that see one robot."""

    sources: OrderedDict[str, Source] = field(default_factory=OrderedDict)
    lost: bool = True  # none of them is used
    lost_by: str = ""  # which one was used last
    conflict: str = ""  # two that contradict each other, and by how much
    conflict_by: str = ""  # the one that is not in use
    conflict_s: float = -math.inf  # when it did so last
    jumped_s: float = -math.inf
    jump_m: float = 0.0
    logged_s: dict[str, float] = field(default_factory=dict)

    def find(self, name: str) -> Source:
        """Return a source by its name; a new one if it is unknown."""
        source = self.sources.get(name)
        if source is None:
            if len(self.sources) >= MOST:
                del self.sources[min(self.sources, key=lambda each: self.sources[each].arrived_s)]
            source = self.sources[name] = Source(name)
        return source

    def alive(self, now_s: float, timeout_s: float) -> Iterator[Source]:
        """Yield the sources of which a fix was used within `timeout_s`."""
        return (each for each in self.sources.values() if now_s - each.used_s <= timeout_s)

    @property
    def used_s(self) -> float:
        """When a fix of any source was used last."""
        return max((each.used_s for each in self.sources.values()), default=-math.inf)

    @property
    def newest(self) -> Source | None:
        """The source of which a fix came last."""
        return max(self.sources.values(), key=lambda each: each.arrived_s, default=None)


def judge(fix: PoseFix | RangeFix, source: Source, now_s: float, config: AgentConfig) -> tuple[float, str]:
    """Return how late a fix is, and why it must not be used; empty when it may be."""
    if refused := _malformed(fix) if isinstance(fix, PoseFix) else _malformed_range(fix):
        return 0.0, refused
    silent = now_s - source.accepted_s > config.fix_timeout_s
    # Distances to several anchors may be measured at once.
    late_s = source.stamp_s - fix.stamp_s
    if late_s > 0.0 or (late_s == 0.0 and isinstance(fix, PoseFix)):
        if not silent:
            return 0.0, "out of order"
        if late_s > config.fix_max_delay_s + now_s - source.accepted_s:
            source.clock = MessageDelay()  # the same name after a silence, and an earlier time: a new clock
    delay_s = source.clock.delay_s(fix.source, fix.stamp_s, now_s)
    return delay_s, "too late" if delay_s > config.fix_max_delay_s else ""


def _malformed(fix: PoseFix) -> str:
    numbers = fix.x_m + fix.y_m + fix.heading_rad + fix.position_sigma_m + fix.heading_sigma_rad + fix.stamp_s
    xx, xy, yy = fix.covariance_m2 or (0.0, 0.0, 0.0)
    if not math.isfinite(numbers + xx + xy + yy) or min(fix.position_sigma_m, fix.heading_sigma_rad) < 0.0:
        return "not finite, or a negative sigma"
    if min(xx, yy, xx * yy - xy * xy) < 0.0:
        return "its covariance is none"
    if max(abs(fix.x_m), abs(fix.y_m)) > FAR_M or worst_sigma_m(fix) > VAGUE_M:
        return "no place in the world"
    return ""


def _malformed_range(fix: RangeFix) -> str:
    numbers = fix.x_m + fix.y_m + fix.up_m + fix.distance_m + fix.sigma_m + fix.stamp_s
    if not math.isfinite(numbers) or fix.sigma_m <= 0.0 or fix.distance_m < 0.0:
        return "not finite, or a sigma or distance below zero"
    if max(abs(fix.x_m), abs(fix.y_m), abs(fix.up_m), fix.distance_m) > FAR_M or fix.sigma_m > VAGUE_M:
        return "no place in the world"
    return ""


def worst_sigma_m(fix: PoseFix) -> float:
    """Return the standard deviation of a fix along its worse axis, m."""
    if fix.covariance_m2 is None:
        return fix.position_sigma_m
    xx, xy, yy = fix.covariance_m2
    return math.sqrt(0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy))


def rank_of(sensor: str, order: Sequence[str]) -> int:
    """Return the place of a sensor in an order of preference; those that are not named come last, alike.

    A name in the order stands for all sensors that begin with it: "camera" for "camera ceiling".
    """
    return next((at for at, name in enumerate(order) if sensor.startswith(name)), len(order))


class Sightings:
    """What sources report of themselves: which markers they do not see, and since when."""

    def __init__(self) -> None:
        self._reports: OrderedDict[str, tuple[float, FixSourceReport]] = OrderedDict()

    def tell(self, report: FixSourceReport, now_s: float) -> None:
        """Take a report in."""
        self._reports[report.source] = now_s, report
        self._reports.move_to_end(report.source)
        if len(self._reports) > REPORTS:
            self._reports.popitem(last=False)

    def missing(self, robot: str, now_s: float, unseen_s: float) -> str:
        """Return what is wrong with the sources of a robot; `unseen_s`: a marker is missed after so long."""
        found = []
        for told_s, report in self._reports.values():
            gone_s = now_s - told_s
            if gone_s > REPORT_FORGOTTEN_S:
                continue
            if gone_s > REPORT_GONE_S:
                found.append(f"{report.sensor} has ended or is not reached since {gone_s:.0f} s")
            elif report.problem:
                found.append(f"{report.sensor}: {report.problem}")
            elif robot in report.robots:
                found.append(_unseen(report, report.robots.index(robot), gone_s, unseen_s))
        return "; ".join(each for each in found if each)


def _unseen(report: FixSourceReport, at: int, gone_s: float, unseen_s: float) -> str:
    marker, since_s = report.markers[at] or "its marker", report.unseen_s[at]
    if since_s < 0.0:
        return f"{report.sensor} has not seen {marker} yet"
    since_s += gone_s
    return f"{report.sensor} has not seen {marker} for {since_s:.0f} s" if since_s > max(unseen_s, 1.0) else ""
