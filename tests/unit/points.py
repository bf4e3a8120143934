"""Points that move exactly as a control law desires, with perfect broadcasts and tables: for closed forms of laws."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm import memory
from fullswarm.agent.messaging.declaration import layout_of
from fullswarm.agent.messaging.received import Heard, Received
from fullswarm.agent.messaging.table import ReplicatedTable, SharedTable
from fullswarm.agent.view import Context, Params, Shared, View
from fullswarm.kernels import Array

DT_S = 0.02


class Points:
    """Points at `position` (n, 2), each of which senses the others within `reach_m`; their speed has no limit.

    Attributes
    ----------
    lost : rows that the others do not sense any more, and that do not move
    ended : what the law has ended itself with, by row
    """

    def __init__(
        self, law: ModuleType, position: Array, parameters: Mapping[str, Any], *, dt_s: float = DT_S,
        reach_m: float = 1e3, bounds: tuple[float, float, float, float] = (-100.0, -100.0, 100.0, 100.0),
    ) -> None:  # fmt: skip
        self.law, self.position, self.dt_s, self.reach_m, self.bounds = law, position.copy(), dt_s, reach_m, bounds
        count = len(position)
        self.heading, self.moved, self.time_s = np.zeros(count), np.zeros((count, 2)), 0.0
        self.params = Params([dict(parameters) for _ in range(count)])
        self.lost: list[int] = []
        self.ended: dict[int, str] = {}
        self._context = Context.of(position, self.heading, [f"r{row + 1}" for row in range(count)])
        self._generators = {row: np.random.default_rng(row) for row in range(count)}
        self._context.generator = self._generators.__getitem__
        self._context.channel = lambda rows: self
        self._layout = layout_of(law)
        self._said = np.full((count, 0 if self._layout is None else self._layout.width), np.nan)
        self._aired = self._said.copy()
        self._tables = [ReplicatedTable(f"r{row + 1}", getattr(law, "MERGE", {})) for row in range(count)]
        kind = getattr(law, "Memory", None)
        self.memory: Any = None if kind is None else memory.allocate(kind, count)

    # ------------------------------------------------------------------ broadcasts and tables: one step old, none lost
    def say(self, fields: dict[str, Any]) -> None:
        """Broadcast with the next step."""
        assert self._layout is not None
        self._layout.write(fields, self._said)

    @property
    def heard(self) -> Heard:
        """What the points within reach said in the last step."""
        assert self._layout is not None
        received = Received(self._layout, 10.0)
        received.put(np.arange(len(self.position)), self._aired, self.time_s)
        of, sender = np.nonzero(self._near() & ~np.isnan(self._aired).any(axis=1))
        offset = self.position[sender] - self.position[of]
        names = self._context.ids
        distance, age = np.linalg.norm(offset, axis=1), np.zeros(len(of))
        return Heard(len(self.position), of, offset, distance, sender, received, age, names, names)

    @property
    def table(self) -> SharedTable:
        """The table as each point knows it."""
        return SharedTable(self._tables.__getitem__)

    def _exchange(self) -> None:
        self._aired = self._said.copy()
        for row, other in zip(*np.nonzero(self._near()), strict=True):
            self._tables[row].receive(self._tables[other]._entries.values())

    def _near(self) -> NDArray[np.bool_]:
        near: NDArray[np.bool_] = np.linalg.norm(self.position[:, None] - self.position, axis=2) <= self.reach_m
        near[np.diag_indices(len(near))] = False
        gone = [*self.lost, *self.ended]
        near[:, gone] = near[gone] = False
        return near

    # ------------------------------------------------------------------ motion
    def view(self) -> View:
        """Return what they sense now."""
        near = self._near()
        start = np.concatenate([[0], np.cumsum(near.sum(axis=1))])
        other = np.nonzero(near)[1]
        speed = np.linalg.norm(self.moved, axis=1)
        states = np.column_stack([self.position, self.heading, speed, 0.0 * speed, np.full(len(speed), 0.17)])
        context = self._context
        context.now_s, context.dt_s = self.time_s, self.dt_s
        context.state.pose, context.state.twist = np.column_stack([self.position, self.heading]), states[:, 3:5]
        return View(
            self.position.copy(), self.heading.copy(), states[:, 5], lambda: (start, other), self.position.copy(),
            states, self.bounds, context=context, shared=Shared("points", context.ids),
        )  # fmt: skip

    def step(self, count: int = 1) -> Array:
        """Let them move; return the last velocities (n, 2) m/s."""
        for _ in range(count):
            view = self.view()
            given = (view, self.params) if self.memory is None else (view, self.params, self.memory)
            self.moved = self.law.velocity(*given)
            self.ended |= {each.row: each.text for each in view.endings}
            self.moved[self.lost + list(self.ended)] = 0.0
            self.heading = np.where(
                np.linalg.norm(self.moved, axis=1) > 1e-9, np.arctan2(*self.moved.T[::-1]), self.heading
            )
            self._exchange()
            self.position = self.position + self.dt_s * self.moved
            self.time_s += self.dt_s
        return self.moved
