"""Pose fixes: where motion capture, a camera or the simulator sees the robots. Checked, dated, passed on.

A robot follows one source (a process) at a time. Another one takes over when that has been silent for
``fix_timeout_s``; what is left on its way from the old one is then refused. How late a fix is, is known without
synchronised clocks (:mod:`fullswarm.agent.message_delay`).
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import structlog
from numpy.typing import NDArray

from fullswarm.agent.message_delay import MessageDelay
from fullswarm.agent.pose.estimator import Estimator
from fullswarm.agent.pose.pose_filter import Fix, Verdict
from fullswarm.agent.state import AgentState
from fullswarm.bus.base import Bus
from fullswarm.config import AgentConfig
from fullswarm.drivers.base import Fleet, Pose
from fullswarm.keys import Keys
from fullswarm.messages import PoseFix
from fullswarm.runtime import Scheduler, Timer

log = structlog.get_logger()

WATCH_S = 0.1
REPEAT_S = 5.0
"""The same line about the same robot is logged once in this time."""

REPORTED_S = 10.0
"""So long the health report says that the pose has jumped."""

SOURCES = 8
FAR_M = 1.0e6
VAGUE_M = 100.0
LEAST_SIGMA = 1.0e-3
"""No source measures better than 1 mm and 1 mrad, whatever it states: a filter would reject the next fix."""

LOST = "its fixes have stopped; odometry alone"
REFUSED = "its fixes are refused ({why}); odometry alone"


@dataclass(frozen=True, slots=True)
class PoseHealth:
    """Where a pose comes from and how good it is, for the health report."""

    source: str
    position_sigma_m: float
    heading_sigma_rad: float
    note: str


SENSED = PoseHealth("driver", -1.0, -1.0, "")


@dataclass(slots=True)
class FixSource:
    """One robot that an outside source sees."""

    source: str = ""
    stamp_s: float = -math.inf  # of the newest fix taken
    arrived_s: float = -math.inf  # when any fix came last
    accepted_s: float = -math.inf  # when one came in order and in time
    used_s: float = -math.inf  # when one was used last
    lost: bool = True
    refused: str = ""  # why the last one was not used
    jumped_s: float = -math.inf
    jump_m: float = 0.0
    clocks: OrderedDict[str, MessageDelay] = field(default_factory=OrderedDict)
    logged_s: dict[str, float] = field(default_factory=dict)

    def clock(self, source: str) -> MessageDelay:
        """Return what is known of the clock of a source."""
        clock = self.clocks.setdefault(source, MessageDelay())
        self.clocks.move_to_end(source)
        while len(self.clocks) > SOURCES:
            self.clocks.popitem(last=False)
        return clock


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
    unsettled : (n,) fixes come, but the first ones do not agree yet with each other or the start pose
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, config: AgentConfig, estimator: Estimator, fleet: Fleet,
        state: AgentState, on_change: Callable[[], None], vague_m: float = VAGUE_M,
    ) -> None:  # fmt: skip
        self._scheduler, self._config, self._estimator, self._on_change = scheduler, config, estimator, on_change
        self._fleet, self._state, self._vague_m = fleet, state, vague_m
        ids = fleet.ids
        self._row = {robot: row for row, robot in enumerate(ids)}
        self._source_states: dict[int, FixSource] = {}
        self._timer: Timer | None = None  # from the first fix on
        self.contacts = np.zeros(len(ids), np.int64)
        self.touching = False
        self.unsettled = np.zeros(len(ids), np.bool_)
        self.any_unsettled = False
        robot = ids[0] if len(ids) == 1 else "*"
        self._subscription = bus.subscribe(keys.pose_fix(robot), PoseFix, self._on_fix, latest=True)

    def close(self) -> None:
        """Drop the subscription and the timer."""
        self._subscription.close()
        if self._timer is not None:
            self._timer.cancel()

    # ------------------------------------------------------------------ what comes in
    def _on_fix(self, fix: PoseFix) -> None:
        row = self._row.get(fix.robot)
        if row is None:
            return
        if self._timer is None:
            self._timer = self._scheduler.every(WATCH_S, self._watch)
        source_state = self._source_states.setdefault(row, FixSource())
        now_s = self._scheduler.now_s()
        source_state.arrived_s = now_s
        delay_s, refused = _judge(fix, source_state, now_s, self._config)
        if not refused and fix.position_sigma_m > self._vague_m:
            refused = (
                f"its sigma, {fix.position_sigma_m:.2g} m, is too large: beyond {self._vague_m:.2g} m robots could not "
                "stop for each other within the sensing radius"
            )
        if refused:
            self._refuse(source_state, fix, refused)
            return
        if fix.source != source_state.source:
            source_state.source, source_state.refused = fix.source, ""
            log.info("fixes come from a new source", robot=fix.robot, source=fix.source)
        source_state.stamp_s, source_state.accepted_s = fix.stamp_s, now_s
        self._touch(row, fix.contacts)
        self._use(row, source_state, fix, now_s - delay_s - self._config.fix_latency_s, now_s)

    def _use(self, row: int, source_state: FixSource, fix: PoseFix, at_s: float, now_s: float) -> None:
        """Hand a fix to the estimator and to a driver that wants it.

        A driver that senses the pose makes its own of fixes: fused here as well, they would count twice.
        """
        sigma_m = max(fix.position_sigma_m, LEAST_SIGMA)
        sigma_rad = min(max(fix.heading_sigma_rad, LEAST_SIGMA), math.pi)
        pose = Pose(fix.x_m, fix.y_m, fix.heading_rad)
        if self._senses(row):
            self._settle(row, unsettled=False)  # fixes may have come before the driver knew its pose
        else:
            taken = self._estimator.take(row, Fix(at_s, pose, sigma_m, sigma_rad))
            self._settle(row, unsettled=taken.verdict is Verdict.PENDING)
            if taken.verdict is Verdict.PENDING:
                source_state.refused = taken.verdict.value
                return
            if taken.verdict in (Verdict.OUTLIER, Verdict.TOO_OLD):
                self._refuse(source_state, fix, taken.verdict.value)
                return
            pose = taken.pose
            if taken.verdict is Verdict.REANCHORED:
                source_state.jumped_s, source_state.jump_m = now_s, taken.jump_m
                self._log(
                    source_state, fix.robot, "the pose jumped to the fixes: the robot was carried", jump_m=taken.jump_m
                )
        source_state.used_s, source_state.refused = now_s, ""
        self._fleet.locate(row, pose, sigma_m, sigma_rad)
        if source_state.lost:
            source_state.lost = False
            log.info("fixes are used", robot=fix.robot, source=fix.source)
            self._on_change()

    def _settle(self, row: int, *, unsettled: bool) -> None:
        if unsettled or self.any_unsettled:
            self.unsettled[row] = unsettled
            self.any_unsettled = bool(self.unsettled.any())

    def _refuse(self, source_state: FixSource, fix: PoseFix, why: str) -> None:
        source_state.refused = why
        self._log(source_state, fix.robot, f"a fix was refused: {why}", source=fix.source)

    def _log(self, source_state: FixSource, robot: str, event: str, **more: object) -> None:
        """Log a line, the same one about the same robot once in a while: a source at the timeout comes and goes."""
        now_s = self._scheduler.now_s()
        if now_s - source_state.logged_s.get(event, -math.inf) >= REPEAT_S:
            source_state.logged_s[event] = now_s
            log.warning(event, robot=robot, **more)

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
        for row, source_state in self._source_states.items():
            if now_s - source_state.accepted_s > timeout_s:
                self._touch(row, 0)
                self._settle(row, unsettled=False)  # as without fixes: odometry from the start pose
            if not source_state.lost and now_s - source_state.used_s > timeout_s:
                source_state.lost = True
                robot = self._fleet.ids[row]
                self._log(source_state, robot, self._problem(source_state, now_s), source=source_state.source)
                self._on_change()

    def _problem(self, source_state: FixSource, now_s: float) -> str:
        silent = now_s - source_state.arrived_s > self._config.fix_timeout_s
        return LOST if silent else REFUSED.format(why=source_state.refused)

    # ------------------------------------------------------------------ for the health report
    def health(self, row: int, sensed: bool) -> PoseHealth:
        """Return where robot `row`'s pose comes from; `sensed`: its driver knows it."""
        source_state, known = self._source_states.get(row), self._estimator.fuses or not sensed
        if source_state is None and not known:
            return SENSED  # at once: a lockstep swarm asks for a thousand robots
        sigma_m, sigma_rad = self._estimator.known_sigma(row) if known else (-1.0, -1.0)
        source = "driver" if sensed else "odometry"
        if source_state is None:
            return PoseHealth(source, sigma_m, sigma_rad, "")
        now_s = self._scheduler.now_s()
        note = self._problem(source_state, now_s) if source_state.lost else ""
        if now_s - source_state.jumped_s < REPORTED_S:
            note = note or f"it was carried: its pose jumped by {source_state.jump_m:.2f} m to the fixes"
        if source == "driver":
            note = note.replace("; odometry alone", "")
        elif not source_state.lost:
            source = "fixes"
        return PoseHealth(source, sigma_m, sigma_rad, note)


def _judge(fix: PoseFix, source_state: FixSource, now_s: float, config: AgentConfig) -> tuple[float, str]:
    """Return how late a fix is, and why it must not be used; empty when it may be."""
    numbers = fix.x_m + fix.y_m + fix.heading_rad + fix.position_sigma_m + fix.heading_sigma_rad + fix.stamp_s
    if not math.isfinite(numbers) or min(fix.position_sigma_m, fix.heading_sigma_rad) < 0.0:
        return 0.0, "not finite, or a negative sigma"
    if max(abs(fix.x_m), abs(fix.y_m)) > FAR_M or fix.position_sigma_m > VAGUE_M:
        return 0.0, "no place in the world"
    silent = now_s - source_state.accepted_s > config.fix_timeout_s
    if fix.source == source_state.source and fix.stamp_s <= source_state.stamp_s:
        if not silent:
            return 0.0, "out of order"
        source_state.clocks.pop(fix.source, None)  # the same name after a silence, and an earlier time: a new clock
    delay_s = source_state.clock(fix.source).delay_s(fix.source, fix.stamp_s, now_s)
    if fix.source != source_state.source and not silent:
        return delay_s, "another source sees this robot too"
    return delay_s, "too late" if delay_s > config.fix_max_delay_s else ""
