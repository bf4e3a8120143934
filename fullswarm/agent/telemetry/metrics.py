"""Samples what robots measure of themselves, ten times a second, and puts it into a message (paper II.F.1).

Arrival and distance to the goal, the gap to the nearest neighbour, time without motion, sidesteps. The measurement also
carries what other parts count: the filter's deviation, energy, deadlines and messages.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from fullswarm.agent.messaging.exchange import Counts
from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.agent.orders.tasks import ARRIVE_M, Task, Tasks, goal_of
from fullswarm.agent.pose.conflicts import Near
from fullswarm.agent.safety.deadlock import Deadlocks
from fullswarm.agent.state import AgentState, Identity
from fullswarm.bus.base import CountingBus
from fullswarm.kernels import Array, kernel
from fullswarm.messages import RobotMeasurement
from fullswarm.runtime import LoopStats

PERIOD_S = 0.1
FRESH_S = 0.3
"""A neighbour whose newest state is older counts for no gap: it may be anywhere."""

# Columns of the goals and of the state, one row per robot.
GOAL_X, GOAL_Y, REACH, ASKED, BUSY = range(5)
ARRIVED, DISTANCE, GAP, ASIDE, ANCHOR_X, ANCHOR_Y, MOVED = range(7)


@kernel
def sample(
    now_s: float,
    dt_s: float,
    pose: Array,
    radius: Array,
    goals: Array,
    sidestep_until_s: Array,
    near: Nearby,
    state: Array,
) -> None:
    """Take one sample, `dt_s` after the last one.

    Parameters
    ----------
    pose, radius : (n, 3), (n,) of the own robots
    goals : (n, 5) goal, its radius, when it was asked for; whether a task is on
    sidestep_until_s : (n,) until when each sidesteps
    state : (n, 7) in and out
    """
    start, other, places, states, _, _, arrival_s = near
    for i in range(pose.shape[0]):
        if sidestep_until_s[i] > now_s:
            state[i, ASIDE] += dt_s
        x = float(pose[i, 0])
        y = float(pose[i, 1])
        if not math.isfinite(x + y):
            continue
        state[i, DISTANCE] = math.hypot(x - goals[i, GOAL_X], y - goals[i, GOAL_Y])  # NaN without a goal
        if state[i, DISTANCE] <= goals[i, REACH]:
            if math.isnan(state[i, ARRIVED]):
                state[i, ARRIVED] = now_s - goals[i, ASKED]
        else:
            state[i, ARRIVED] = math.nan
        way = math.hypot(x - state[i, ANCHOR_X], y - state[i, ANCHOR_Y])
        if not way <= radius[i] or goals[i, BUSY] == 0.0:  # true while there is no anchor
            state[i, ANCHOR_X] = x
            state[i, ANCHOR_Y] = y
            state[i, MOVED] = now_s
        for pair in range(start[i], start[i + 1]):
            j = other[pair]
            if now_s - arrival_s[j] <= FRESH_S:
                gap = math.hypot(x - places[j, 0], y - places[j, 1]) - radius[i] - states[j, 5]
                if gap < state[i, GAP]:  # false for a place that is not known
                    state[i, GAP] = gap


class MetricSampler:
    """Samples the metrics of the robots of one agent.

    Parameters
    ----------
    arrive_radius_m
        Overrides the request's; None: it does not.
    """

    def __init__(
        self, ids: tuple[str, ...], arrive_radius_m: float | None, state: AgentState, tasks: Tasks, near: Near,
        deadlocks: Deadlocks,
    ) -> None:  # fmt: skip
        self._ids, self._arrive_radius_m, self._robots, self._all_tasks = ids, arrive_radius_m, state, tasks
        self._near, self._deadlocks = near, deadlocks
        count = len(ids)
        self._sampled_s = math.inf
        self._tasks: list[Task | None] = [None] * count
        self._of: list[str] = [""] * count  # the request that gave the goal
        self._goals = np.full((count, 5), math.nan)
        self._goals[:, BUSY] = 0.0
        self._state = np.zeros((count, 7))
        self._state[:, [ARRIVED, DISTANCE, ANCHOR_X, ANCHOR_Y, MOVED]] = math.nan
        self._state[:, GAP] = math.inf

    def sample(self, now_s: float) -> None:
        """Take a sample: every `PERIOD_S`, and before a message."""
        dt_s = min(max(now_s - self._sampled_s, 0.0), PERIOD_S)
        self._sampled_s = now_s
        if self._tasks != self._all_tasks.of:
            self._follow()
        robots = self._robots
        sidestep_until_s, near = self._deadlocks.sidestep_until_s, self._near(now_s)
        sample.run(now_s, dt_s, robots.pose, robots.radius, self._goals, sidestep_until_s, near, self._state)

    def message(
        self,
        now_s: float,
        identity: Identity,
        loop: LoopStats,
        traffic: CountingBus,
        broadcasts: Counts,
        counted: Mapping[str, Array],
    ) -> RobotMeasurement:
        """Return the measurement; ``perf/metrics.py`` defines its columns.

        `counted` are the columns of others, (n,) each: the calculators' and the filter's.
        """
        state = self._state
        x, y, heading = self._robots.pose.T.tolist()
        arrived, goal, gap, sidestepping = state[:, :ANCHOR_X].T.tolist()
        still_s = np.where(self._goals[:, BUSY] > 0.0, now_s - state[:, MOVED], math.nan)
        columns = {
            "x_m": x,
            "y_m": y,
            "heading_rad": heading,
            "goal_m": goal,
            "arrived_s": arrived,
            "still_s": still_s.tolist(),
            "gap_m": gap,
            "deadlock_count": self._deadlocks.deadlock_count.tolist(),
            "sidestep_s": sidestepping,
            **{name: column.tolist() for name, column in counted.items()},
        }
        totals = {
            "ticks": float(loop.ticks), "late": float(loop.late), "missed": float(loop.missed),
            "worst_late_s": loop.worst_late_s, "sent": float(traffic.sent), "received": float(traffic.received),
            "broadcasts_sent": float(broadcasts.sent), "broadcasts_received": float(broadcasts.received),
            "broadcasts_dropped": float(broadcasts.dropped),
        }  # fmt: skip
        return RobotMeasurement(
            host=identity.host,
            process=identity.process,
            robots=self._ids,
            columns={name: tuple(values) for name, values in columns.items()},
            totals=totals,
            stamp_s=now_s,
        )

    def _follow(self) -> None:
        """Take over the goals of new tasks. Intents of a stick, and the end of a task, leave the goal as it is."""
        for row, task in enumerate(self._all_tasks.of):
            if task is self._tasks[row]:
                continue
            self._tasks[row] = task
            if row in self._all_tasks.parked:  # it charges: it is neither at its goal nor stalled
                self._goals[row, BUSY], self._goals[row, :2] = 0.0, math.nan
                continue
            lasting = task is not None and task.request.expires_s <= 0.0
            self._goals[row, BUSY] = float(lasting)
            if task is not None and lasting:
                self._aim(row, task)

    def _aim(self, row: int, task: Task) -> None:
        request, goals = task.request, self._goals
        reach_m = self._arrive_radius_m or request.parameters.get("arrive_radius_m")
        goals[row, REACH] = reach_m if isinstance(reach_m, int | float) else ARRIVE_M
        goals[row, :2] = goal_of(request)
        if request.request_id != self._of[row]:  # the same request comes again after a restart of the core
            self._of[row], goals[row, ASKED] = request.request_id, task.arrived_s
            self._state[row, ARRIVED] = math.nan
