"""Names the silent robots that a robot waits for: where they are is not known well enough to pass them."""

from __future__ import annotations

import math

from fullswarm.agent.neighbours.estimates import Neighbours
from fullswarm.agent.orders.tasks import Tasks
from fullswarm.agent.safety.filter import SafetyFilter
from fullswarm.agent.state import AgentState
from fullswarm.reasons import NONE, Code, Reason, reason

LEAST_M_S = 0.02
"""The filter holds a robot when it takes more than this off the desired velocity."""
NEAR_M = 0.3
"""A robot waits at a silent one's disc when the gap is smaller."""


class Waiting:
    """Finds out what robots that stand at the discs of silent ones wait for."""

    def __init__(self, state: AgentState, tasks: Tasks, safety: SafetyFilter, neighbours: Neighbours) -> None:
        self._state, self._tasks, self._filter, self._neighbours = state, tasks, safety, neighbours

    def reason(self, row: int, now_s: float) -> Reason:
        """Return which silent robots the robot `row` stands at; false if it waits for none."""
        held = self._tasks.filtered[row] and self._filter.deviation_m_s[row] > LEAST_M_S
        table, given = self._neighbours, self._filter.given
        if not held or not table.silent or given is None or not self._state.at_standstill[row]:
            return NONE
        x, y, _ = self._state.pose[row].tolist()
        start, other = given.near.start, given.near.other
        heard = table.heard(now_s)
        names = [
            table.names[at] for at in other[start[row] : start[row + 1]].tolist()
            if not heard[at] and self._gap_m(row, at, x, y) < NEAR_M
        ]  # fmt: skip
        return reason(Code.SILENT, robots=", ".join(sorted(names))) if names else NONE

    def _gap_m(self, row: int, at: int, x: float, y: float) -> float:
        table = self._neighbours
        away_m = math.hypot(table.places[at, 0] - x, table.places[at, 1] - y)
        return away_m - float(self._state.radius[row] + table.states[at, 5] + table.spread_m[at])
