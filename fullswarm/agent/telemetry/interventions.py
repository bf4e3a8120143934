"""Publishes what the safety filter changes now, in which direction, and because of what."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fullswarm.agent.motion.robot_controller import StopReason
from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.agent.orders.tasks import Tasks
from fullswarm.agent.safety.barrier import Arena, box_gap
from fullswarm.agent.safety.filter import EXPLAIN, LIMITED, SafetyFilter
from fullswarm.agent.state import AgentState
from fullswarm.bus.base import Bus
from fullswarm.kernels import Array, Index, kernel
from fullswarm.keys import Keys
from fullswarm.messages import Interventions
from fullswarm.runtime import Scheduler

PERIOD_S = 0.2
LEAST_M_S = 0.02
"""A smaller change is not visible."""
NOTHING, ROBOT, OBSTACLE, EDGE = range(4)


class Blamed(NamedTuple):
    """NOTHING, ROBOT, OBSTACLE or EDGE; row of the neighbour or -1; m between the bodies: (k,) each."""

    kind: Index
    which: Index
    gap: Array


@kernel
def weight(away: float, gap_m: float) -> float:
    """Weigh a thing: how straight the change leads `away` from it (a cosine), and how near it is."""
    return (max(away, 0.0) + 0.05) / (0.1 + max(gap_m, 0.0))


@kernel
def blame(
    rows: Index, change: Array, pose: Array, radius: Array, near: Nearby, arena: Arena, reach_m: float,
    blamed: Blamed,
) -> None:  # fmt: skip
    """Find for each of `rows` what the filter most likely keeps it clear of.

    Parameters
    ----------
    change : (n, 2) m/s, velocity let through minus desired
    arena, reach_m : as for ``barrier.half_planes``
    blamed : out
    """
    start, other, places, states, _, _, _ = near
    obstacles, bounds_m = arena
    kind, which, gap = blamed
    for k in range(rows.shape[0]):
        i = rows[k]
        x = pose[i, 0]
        y = pose[i, 1]
        size = math.hypot(change[i, 0], change[i, 1])
        away_x = change[i, 0] / size if size > 0.0 else 0.0
        away_y = change[i, 1] / size if size > 0.0 else 0.0
        best = 0.0
        kind[k] = 0
        which[k] = -1
        for pair in range(start[i], start[i + 1]):
            j = other[pair]
            dx = places[j, 0] - x
            dy = places[j, 1] - y
            distance = math.hypot(dx, dy)
            if not distance > 0.0:  # unknown, or this place
                continue
            between = distance - radius[i] - states[j, 5]
            worth = weight(-(away_x * dx + away_y * dy) / distance, between)
            if worth > best:
                best = worth
                kind[k] = 1
                which[k] = j
                gap[k] = between
        for row in range(obstacles.shape[0]):
            distance, nx, ny = box_gap(x, y, obstacles, row)
            worth = weight(-(away_x * nx + away_y * ny), distance - radius[i])
            if distance < reach_m and worth > best:
                best = worth
                kind[k] = 2
                which[k] = -1
                gap[k] = distance - radius[i]
        for side in range(4):
            sign = -1.0 if side < 2 else 1.0
            between = sign * (bounds_m[side] - (x if side % 2 == 0 else y)) - radius[i]
            worth = weight(-sign * (away_x if side % 2 == 0 else away_y), between)
            if between < reach_m and 1.1 * worth > best:  # walls are obstacles too; the edge is the better answer
                best = worth
                kind[k] = 3
                which[k] = -1
                gap[k] = between


class InterventionReporter:
    """Publishes the interventions of one agent's filter while there are any, then once that there are none."""

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, host: str, ids: Sequence[str], state: AgentState,
        tasks: Tasks, safety: SafetyFilter, neighbour_names: Sequence[str],
    ) -> None:  # fmt: skip
        self._bus, self._scheduler, self._host, self._ids, self._state = bus, scheduler, host, ids, state
        self._tasks, self._filter, self._neighbour_names = tasks, safety, neighbour_names
        self._key = keys.intervention(host)
        self._published = False

    def publish(self) -> None:
        """Publish what the filter changes now; called each `PERIOD_S`."""
        held = self._tasks.any_filtered and self._filter.deviation_m_s.max(initial=0.0) > LEAST_M_S
        rows = self._rows() if held else np.zeros(0, np.int64)
        if not self._published and not len(rows):
            return
        self._published = len(rows) > 0
        change = np.nan_to_num(self._filter.change_m_s[rows])
        message = Interventions(
            host=self._host,
            robots=tuple(self._ids[row] for row in rows.tolist()),
            x_m_s=tuple(change[:, 0].tolist()),
            y_m_s=tuple(change[:, 1].tolist()),
            reasons=tuple(self._reasons(rows)),
            stamp_s=self._scheduler.now_s(),
        )
        self._bus.publish(self._key, message)

    def _rows(self) -> Index:
        """Return the robots that the filter slows down; one that is stopped for another reason is not among them."""
        moving = self._state.stop_reason == StopReason.MOVING
        return np.flatnonzero(self._tasks.filtered & moving & (self._filter.deviation_m_s > LEAST_M_S))

    def _reasons(self, rows: Index) -> list[str]:
        given = self._filter.given
        if given is None or not len(rows):
            return []
        used, state, count = self._filter, self._state, len(rows)
        blamed = Blamed(np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros(count))
        blame.run(rows, used.change_m_s, state.pose, state.radius, given.near, given.arena, used.reach_m, blamed)
        verdicts, names = used.verdict[rows].tolist(), self._neighbour_names
        found = zip(verdicts, blamed.kind.tolist(), blamed.which.tolist(), blamed.gap.tolist(), strict=True)
        return [
            EXPLAIN[verdict] if verdict > LIMITED else _words(what, names[row] if row >= 0 else "", gap_m)
            for verdict, what, row, gap_m in found
        ]


def _words(kind: int, robot: str, gap_m: float) -> str:
    if kind == NOTHING:
        return "something near"
    name = {ROBOT: robot, OBSTACLE: "obstacle", EDGE: "edge of the arena"}[kind]
    return f"{name} at {max(gap_m, 0.0):.2f} m"
