"""Pose fixes: where motion capture, a camera or the simulator sees the robots. Checked, dated, passed on.

Fixes of all sources are used together, each by its own certainty and dated by its own clock. How late a fix is, is
known without synchronised clocks (:mod:`fullswarm.agent.message_delay`). A source whose fixes do not fit those of
another that is in use cannot move the pose: the fixes of the preferred one count (``fix_order``), and without
preference the robot stands until they agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import structlog
from numpy.typing import NDArray

from fullswarm.agent.pose.anchors import Anchors
from fullswarm.agent.pose.estimator import Estimator
from fullswarm.agent.pose.pose_filter import Distance, Fix, Taken, Verdict
from fullswarm.agent.pose.sources import VAGUE_M, RobotSources, Sightings, Source, judge, rank_of, worst_sigma_m
from fullswarm.agent.state import AgentState
from fullswarm.bus.base import Bus
from fullswarm.config import AgentConfig
from fullswarm.drivers.base import Fleet, Pose
from fullswarm.keys import Keys
from fullswarm.messages import FixSourceReport, PoseFix, PoseSource, RangeFix
from fullswarm.runtime import Scheduler, Timer

log = structlog.get_logger()

WATCH_S = 0.1
REPEAT_S = 5.0
"""The same line about the same robot is logged once in this time."""

REPORTED_S = 10.0
"""So long the health report says that the pose has jumped, and shows a source that has gone silent."""

LEAST_SIGMA = 1.0e-3
"""No source measures better than 1 mm and 1 mrad, whatever it states: a filter would reject the next fix."""
CONFLICT_M, CONFLICT_RAD = 0.1, 0.25
"""Sources that differ by less do not contradict each other: then one of them states too small a sigma."""

LOST = "its fixes have stopped; odometry alone"
REFUSED = "its fixes are refused ({why}); odometry alone"


@dataclass(frozen=True, slots=True)
class PoseHealth:
    """Where a pose comes from and how good it is, for the health report."""

    source: str
    position_sigma_m: float
    heading_sigma_rad: float
    note: str
    sources: tuple[PoseSource, ...] = ()


SENSED = PoseHealth("driver", -1.0, -1.0, "")


class Fixes:
    """Takes the fixes of an agent's robots. Costs nothing while none come.

    Parameters
    ----------
    on_change : called when fixes begin to be used, or no longer are
    vague_m : fixes with a greater sigma are refused

    Attributes
    ----------
    contacts : (n,) bodies that a source sees each robot touch now
    touching : some robot touches something
    unsettled : (n,) fixes come, but the first ones do not agree yet with each other or the start pose, or two sources
        contradict each other
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, config: AgentConfig, estimator: Estimator, fleet: Fleet,
        state: AgentState, on_change: Callable[[], None], vague_m: float = VAGUE_M,
    ) -> None:  # fmt: skip
        self._scheduler, self._config, self._estimator, self._on_change = scheduler, config, estimator, on_change
        self._fleet, self._state, self._vague_m = fleet, state, vague_m
        ids = fleet.ids
        self._row = {robot: row for row, robot in enumerate(ids)}
        self._robots: dict[int, RobotSources] = {}
        self._sightings = Sightings()
        self._anchors = Anchors(config)
        self._timer: Timer | None = None  # from the first fix on
        self.contacts = np.zeros(len(ids), np.int64)
        self.touching = False
        self.unsettled = np.zeros(len(ids), np.bool_)
        self.any_unsettled = False
        robot = ids[0] if len(ids) == 1 else "*"
        self._subscriptions = [
            bus.subscribe(keys.pose_fix(robot), PoseFix, self._on_fix, latest=True),
            bus.subscribe(keys.range_fix(robot), RangeFix, self._on_range),
            bus.subscribe(keys.fix_source(), FixSourceReport, self._on_report, latest=True),
        ]

    def close(self) -> None:
        """Drop the subscriptions and the timer."""
        for subscription in self._subscriptions:
            subscription.close()
        if self._timer is not None:
            self._timer.cancel()

    # ------------------------------------------------------------------ what comes in
    def _on_report(self, report: FixSourceReport) -> None:
        self._sightings.tell(report, self._scheduler.now_s())

    def _source(self, fix: PoseFix | RangeFix, row: int, now_s: float) -> tuple[RobotSources, Source]:
        if self._timer is None:
            self._timer = self._scheduler.every(WATCH_S, self._watch)
        robot = self._robots.setdefault(row, RobotSources())
        source = robot.find(fix.source)
        source.arrived_s, source.sensor = now_s, fix.sensor
        source.rank = rank_of(source.label, self._config.fix_order)
        return robot, source

    def receive(self, fix: PoseFix) -> None:
        """Take a fix of a source on board, as if it had come by the bus."""
        self._on_fix(fix)

    def _on_fix(self, fix: PoseFix) -> None:
        row = self._row.get(fix.robot)
        if row is None:
            return
        now_s = self._scheduler.now_s()
        robot, source = self._source(fix, row, now_s)
        source.marker = fix.marker
        delay_s, refused = judge(fix, source, now_s, self._config)
        if not refused and worst_sigma_m(fix) > self._vague_m:
            refused = (
                f"its sigma, {worst_sigma_m(fix):.2g} m, is too large: beyond {self._vague_m:.2g} m robots could not "
                "stop for each other within the sensing radius"
            )
        if refused:
            self._refuse(robot, source, fix.robot, refused)
            return
        if math.isinf(source.accepted_s):
            log.info("fixes come from a new source", robot=fix.robot, source=fix.source)
        source.stamp_s, source.accepted_s = fix.stamp_s, now_s
        self._touch(row, fix.contacts)
        self._use(row, robot, source, self._dated(fix, robot, source, delay_s, now_s), now_s)

    def _dated(self, fix: PoseFix, robot: RobotSources, source: Source, delay_s: float, now_s: float) -> Fix:
        """Return a fix as the estimator takes it."""
        covariance_m2 = fix.covariance_m2
        if covariance_m2 is not None:
            xx, xy, yy = covariance_m2
            covariance_m2 = xx + LEAST_SIGMA**2, xy, yy + LEAST_SIGMA**2
        return Fix(
            at_s=now_s - delay_s - self._config.fix_latency_s,
            pose=Pose(fix.x_m, fix.y_m, fix.heading_rad),
            position_sigma_m=max(worst_sigma_m(fix), LEAST_SIGMA),
            heading_sigma_rad=min(max(fix.heading_sigma_rad, LEAST_SIGMA), math.pi),
            covariance_m2=covariance_m2,
            source=source.name,
            may_insist=self._may_insist(robot, source, now_s),
        )

    def _may_insist(self, robot: RobotSources, source: Source, now_s: float) -> bool:
        """Tell whether a source may move the pose to its own: no other one that counts as much is in use."""
        others = robot.alive(now_s, self._config.fix_timeout_s)
        return all(other is source or source.rank < other.rank for other in others)

    def _use(self, row: int, robot: RobotSources, source: Source, fix: Fix, now_s: float) -> None:
        """Hand a fix to the estimator and to a driver that wants it.

        A driver that senses the pose makes its own of fixes: fused here as well, they would count twice.
        """
        pose = fix.pose
        if self._senses(row):
            self._settle(row, unsettled=False)  # fixes may have come before the driver knew its pose
        else:
            taken = self._estimator.take(row, fix)
            source.note(taken.residual_m, taken.residual_rad)
            self._compare(row, robot, source, fix, taken, now_s)
            if not self._taken(row, robot, source, taken, now_s):
                return
            pose = taken.pose
        self._fleet.locate(row, pose, fix.position_sigma_m, fix.heading_sigma_rad)
        self._used(row, robot, source, now_s)

    def _taken(self, row: int, robot: RobotSources, source: Source, taken: Taken, now_s: float) -> bool:
        """Note what the estimator made of a fix; tell whether it was used."""
        name = self._fleet.ids[row]
        if taken.verdict is Verdict.PENDING:
            source.refused = taken.verdict.value
            return False
        if taken.verdict in (Verdict.OUTLIER, Verdict.TOO_OLD):
            self._refuse(robot, source, name, taken.verdict.value)
            return False
        if taken.verdict is Verdict.REANCHORED:
            robot.jumped_s, robot.jump_m = now_s, taken.jump_m
            self._log(robot, name, "the pose jumped to the fixes: the robot was carried", jump_m=taken.jump_m)
        return True

    def _compare(self, row: int, robot: RobotSources, source: Source, fix: Fix, taken: Taken, now_s: float) -> None:
        """Hold a robot whose first fixes do not agree, or of which two sources insist on different poses."""
        if taken.verdict is Verdict.PENDING:
            self._settle(row, unsettled=True)
            return
        far = taken.residual_m > CONFLICT_M or abs(taken.residual_rad) > CONFLICT_RAD
        others = [
            other for other in robot.alive(now_s, self._config.fix_timeout_s)
            if other is not source and other.rank == source.rank
        ]  # fmt: skip
        insists = self._estimator.insisted_s(row, source.name, fix.at_s) >= self._config.fix_reanchor_s
        if taken.verdict is Verdict.OUTLIER and far and others and insists:
            if not robot.conflict:
                event = "two sources of fixes contradict each other"
                self._log(robot, self._fleet.ids[row], event, sources=[others[0].label, source.label])
            robot.conflict = _contradiction(others[0], source, taken)
            robot.conflict_by, robot.conflict_s = source.name, now_s
        elif robot.conflict_by == source.name and taken.verdict is not Verdict.OUTLIER:
            robot.conflict = robot.conflict_by = ""
        self._settle(row, unsettled=bool(robot.conflict))

    def _used(self, row: int, robot: RobotSources, source: Source, now_s: float) -> None:
        source.used_s, source.refused = now_s, ""
        robot.lost_by = source.name
        if robot.lost:
            robot.lost = False
            log.info("fixes are used", robot=self._fleet.ids[row], source=source.name)
            self._on_change()

    def _on_range(self, fix: RangeFix) -> None:
        row = self._row.get(fix.robot)
        if row is None:
            return
        now_s = self._scheduler.now_s()
        robot, source = self._source(fix, row, now_s)
        source.marker = f"anchor {fix.anchor}"[:64]
        delay_s, refused = judge(fix, source, now_s, self._config)
        if refused:
            self._refuse(robot, source, fix.robot, refused)
            return
        source.stamp_s, source.accepted_s = fix.stamp_s, now_s
        if self._senses(row):
            return  # a driver that senses its pose has no use for distances
        at_s = now_s - delay_s - self._config.fix_latency_s
        measured = Distance(at_s, fix.x_m, fix.y_m, fix.up_m, fix.distance_m, max(fix.sigma_m, LEAST_SIGMA))
        taken, position = self._anchors.take(row, f"{fix.source} {fix.anchor}", measured, self._estimator)
        source.note(taken.residual_m, math.nan)
        if position is not None:
            found = Fix(
                at_s=position.at_s, pose=Pose(position.x_m, position.y_m, 0.0), position_sigma_m=position.sigma_m,
                heading_sigma_rad=math.pi, covariance_m2=position.covariance_m2, source=source.name,
                may_insist=self._may_insist(robot, source, now_s),
            )  # fmt: skip
            self._use(row, robot, source, found, now_s)
        elif taken.verdict is Verdict.ACCEPTED:
            self._used(row, robot, source, now_s)
        else:
            source.refused = taken.verdict.value

    def _settle(self, row: int, *, unsettled: bool) -> None:
        if unsettled or self.any_unsettled:
            self.unsettled[row] = unsettled
            self.any_unsettled = bool(self.unsettled.any())

    def _refuse(self, robot: RobotSources, source: Source, name: str, why: str) -> None:
        source.refused = why
        self._log(robot, name, f"a fix was refused: {why}", source=source.name)

    def _log(self, robot: RobotSources, name: str, event: str, **more: object) -> None:
        """Log a line, the same one about the same robot once in a while: a source at the timeout comes and goes."""
        now_s = self._scheduler.now_s()
        if now_s - robot.logged_s.get(event, -math.inf) >= REPEAT_S:
            robot.logged_s[event] = now_s
            log.warning(event, robot=name, **more)

    def _touch(self, row: int, contacts: int) -> None:
        if contacts > 0 or self.touching:
            self.contacts[row] = max(contacts, 0)
            self.touching = bool(self.contacts.any())

    def _senses(self, row: int) -> bool:
        reading = self._state.reading
        return reading is not None and math.isfinite(reading.pose[row, 0])

    def touches(self) -> NDArray[np.int64]:
        """Return how many bodies each robot touches now, as it feels itself or as a source sees it, (n,)."""
        reading = self._state.reading
        return self.contacts.copy() if reading is None else np.maximum(reading.contacts, self.contacts)

    # ------------------------------------------------------------------ what is missing
    def _watch(self) -> None:
        """Detect sources that have gone silent, or whose fixes are all refused."""
        now_s, timeout_s = self._scheduler.now_s(), self._config.fix_timeout_s
        for row, robot in self._robots.items():
            if all(now_s - each.accepted_s > timeout_s for each in robot.sources.values()):
                self._touch(row, 0)
                robot.conflict = ""
                self._settle(row, unsettled=False)  # as without fixes: odometry from the start pose
            elif robot.conflict and now_s - robot.conflict_s > timeout_s:
                robot.conflict = ""  # the one that contradicted has gone silent
                self._settle(row, unsettled=False)
            if not robot.lost and now_s - robot.used_s > timeout_s:
                robot.lost = True
                name = self._fleet.ids[row]
                self._log(robot, name, self._problem(robot, name, now_s), source=robot.lost_by)
                self._on_change()

    def _problem(self, robot: RobotSources, name: str, now_s: float) -> str:
        """Return why no fix is used."""
        source = robot.newest
        if source is None or now_s - source.arrived_s > self._config.fix_timeout_s:
            missing = self._sightings.missing(name, now_s, self._config.fix_timeout_s)
            return f"{LOST}: {missing}" if missing else LOST
        return REFUSED.format(why=source.refused)

    # ------------------------------------------------------------------ for the health report
    def health(self, row: int, sensed: bool) -> PoseHealth:
        """Return where robot `row`'s pose comes from; `sensed`: its driver knows it."""
        robot, known = self._robots.get(row), self._estimator.fuses or not sensed
        if robot is None and not known:
            return SENSED  # at once: a lockstep swarm asks for a thousand robots
        sigma_m, sigma_rad = self._estimator.known_sigma(row) if known else (-1.0, -1.0)
        source, now_s = "driver" if sensed else "odometry", self._scheduler.now_s()
        if robot is None:
            note = "" if sensed else self._sightings.missing(self._fleet.ids[row], now_s, self._config.fix_timeout_s)
            return PoseHealth(source, sigma_m, sigma_rad, note)
        note = self._problem(robot, self._fleet.ids[row], now_s) if robot.lost else robot.conflict
        if now_s - robot.jumped_s < REPORTED_S:
            note = note or f"it was carried: its pose jumped by {robot.jump_m:.2f} m to the fixes"
        if source == "driver":
            note = note.replace("; odometry alone", "")
        elif not robot.lost:
            source = "fixes"
        return PoseHealth(source, sigma_m, sigma_rad, note, self._shown(robot, now_s))

    def _shown(self, robot: RobotSources, now_s: float) -> tuple[PoseSource, ...]:
        """Return what operators learn of each source."""
        return tuple(
            PoseSource(
                sensor=each.label[:64],
                marker=each.marker,
                age_s=now_s - each.arrived_s,
                used=now_s - each.used_s <= self._config.fix_timeout_s,
                residual_m=-1.0 if math.isnan(each.residual_m) else each.residual_m,
                residual_rad=-1.0 if math.isnan(each.residual_rad) else each.residual_rad,
                refused=each.refused,
            )
            for each in robot.sources.values()
            if now_s - each.arrived_s < REPORTED_S
        )


def _contradiction(one: Source, other: Source, taken: Taken) -> str:
    """Return in words that two sources see a robot in different poses."""
    turned_rad = abs(taken.residual_rad) if math.isfinite(taken.residual_rad) else 0.0
    return (
        f"{one.label} and {other.label} contradict each other by {taken.residual_m:.2f} m and "
        f"{math.degrees(turned_rad):.0f}°: correct one, or say in agent.fix_order which counts"
    )
