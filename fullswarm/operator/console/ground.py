"""What lies on the map: where the swarm has been, what it has seen, and what the filter holds back."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import MessageError
from fullswarm.keys import TRUTH
from fullswarm.messages import CoverageMeasurement, Interventions, SeenObstacles
from fullswarm.perf.coverage import GridFrame, unpack_bits

MOST_CELLS = 250_000
"""A finer grid is made coarser for the page: it would be megabytes, and finer than a screen."""
INTERVENTION_S = 0.7
"""Three periods of the interventions: an agent that sends nothing more lets its robots drive as desired."""
FARTHEST_M = 1e6
"""An obstacle that is further away or larger than that was not seen."""
SAME_M = 0.05
"""Obstacles that two robots have seen this close together are one."""


@dataclass(slots=True)
class Coverage:
    """The cells that any robot has covered; another grid starts anew."""

    changed: bool = False
    _frame: GridFrame | None = None
    _union: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    _newest: dict[str, bytes] = field(default_factory=dict)

    def add(self, message: CoverageMeasurement) -> None:
        """Join a host's grid; one that does not unpack is left out, as what the supervisor saw is."""
        if message.host == TRUTH or (self._newest.get(message.host) == message.cells and self._frame is not None):
            return
        try:
            frame = GridFrame.of(message)
            bits = unpack_bits(message.cells, frame)
        except MessageError:
            return
        if frame != self._frame:
            self._frame, self._union = frame, np.zeros_like(bits)
            self._newest.clear()
        self._newest[message.host] = message.cells
        union = self._union | bits
        self.changed = self.changed or not np.array_equal(union, self._union)
        self._union = union

    def shown(self) -> dict[str, Any] | None:
        """Return the frame ``coverage``; None: nothing was heard."""
        frame = self._frame
        if frame is None:
            return None
        rows, columns, cell_m, bits = frame.rows, frame.columns, frame.cell_m, self._union
        factor = int(np.ceil(np.sqrt(frame.cells / MOST_CELLS)))
        if factor > 1:
            grid = np.unpackbits(bits, count=frame.cells).reshape(rows, columns)
            grid = np.pad(grid, ((0, -rows % factor), (0, -columns % factor)))
            rows, columns, cell_m = grid.shape[0] // factor, grid.shape[1] // factor, cell_m * factor
            bits = np.packbits(grid.reshape(rows, factor, columns, factor).max(axis=(1, 3)))
        return {
            "t": "coverage",
            "origin": [frame.origin_x_m, frame.origin_y_m],
            "cell_m": cell_m,
            "rows": rows,
            "columns": columns,
            "bits": base64.b64encode(bits.tobytes()).decode(),
        }


@dataclass(slots=True)
class Obstacles:
    """What the robots have seen, each obstacle once."""

    changed: bool = False
    _hosts: dict[str, tuple[tuple[float, ...], ...]] = field(default_factory=dict)

    def add(self, message: SeenObstacles) -> None:
        """Take what one host has seen in place of what it said before.

        Raises
        ------
        MessageError
            A row is not finite, or no obstacle can be so large; the others are taken.
        """
        rows = tuple(row for row in message.rows if all(abs(value) <= FARTHEST_M for value in row))  # NaN is not
        if self._hosts.get(message.host) != rows:
            self._hosts[message.host] = rows
            self.changed = True
        if len(rows) < len(message.rows):
            reason = f"{len(message.rows) - len(rows)} obstacles that cannot be"
            raise MessageError(reason, where=message.host, hint="see the robot's log")

    def shown(self) -> dict[str, Any]:
        """Return the frame ``obstacles``."""
        found: dict[tuple[int, ...], list[float]] = {}
        for rows in self._hosts.values():
            for row in rows:
                found.setdefault(tuple(round(value / SAME_M) for value in row), [round(value, 3) for value in row])
        return {"t": "obstacles", "rows": list(found.values())}


@dataclass(slots=True)
class Holding:
    """Robots that the safety filter holds back now."""

    changed: bool = False
    _robots: dict[str, dict[str, list[Any]]] = field(default_factory=dict)  # by host
    _heard_s: dict[str, float] = field(default_factory=dict)

    def add(self, message: Interventions, now_s: float) -> None:
        """Take what one host changes now."""
        self._heard_s[message.host] = now_s
        columns = zip(message.robots, message.x_m_s, message.y_m_s, message.reasons, strict=False)
        rows = {robot: [robot, round(x, 3), round(y, 3), reason] for robot, x, y, reason in columns}
        if rows or self._robots.get(message.host):
            self._robots[message.host] = rows
            self.changed = True

    def shown(self, now_s: float) -> dict[str, Any]:
        """Return the frame ``filter``: all robots that are held back."""
        for host, heard_s in list(self._heard_s.items()):
            if now_s - heard_s > INTERVENTION_S:
                self._robots.pop(host, None)
                del self._heard_s[host]
        return {"t": "filter", "robots": [row for rows in self._robots.values() for row in rows.values()]}

    def expired(self, now_s: float) -> bool:
        """Return whether a robot is shown as held back that has sent nothing for a while."""
        return any(self._robots.get(host) and now_s - at_s > INTERVENTION_S for host, at_s in self._heard_s.items())
