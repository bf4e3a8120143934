"""What the page's map draws: trails, goals, obstacles seen, covered cells, and robots that the filter holds back."""

from __future__ import annotations

import base64
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import MessageError
from fullswarm.keys import TRUTH
from fullswarm.messages import BehaviourRequest, CoverageMeasurement, Interventions, SeenObstacles
from fullswarm.operator.view import SILENT_S, Pose
from fullswarm.perf.coverage import GridFrame, unpack_bits
from fullswarm.recent import Names, Recent

TRAIL_S, TRAIL_RATE_HZ = 60.0, 5.0
STEP_M = 0.01
"""A robot that has moved less leaves no new point."""


@dataclass(slots=True)
class Trails:
    """The positions of each robot during the last minute."""

    _points: dict[str, deque[tuple[float, float, float]]] = field(default_factory=dict)

    def add(self, poses: Sequence[Pose], now_s: float) -> None:
        """Add the positions of robots that have moved."""
        if len(self._points) > len(poses):
            there = {robot for robot, *_ in poses}
            self._points = {robot: points for robot, points in self._points.items() if robot in there}
        for robot, x_m, y_m, _, _, age_s in poses:
            if age_s > SILENT_S:
                continue
            points = self._points.setdefault(robot, deque(maxlen=int(TRAIL_S * TRAIL_RATE_HZ)))
            if not points or math.hypot(x_m - points[-1][1], y_m - points[-1][2]) >= STEP_M:
                points.append((now_s, x_m, y_m))

    def shown(self, now_s: float) -> dict[str, list[list[float]]]:
        """Return robot → positions, the oldest first."""
        return {
            robot: [[round(x_m, 2), round(y_m, 2)] for at_s, x_m, y_m in points if now_s - at_s <= TRAIL_S]
            for robot, points in self._points.items()
        }

    def stamped(self) -> dict[str, list[list[float]]]:
        """Return robot → ``[at_s, x_m, y_m]``, the oldest first."""
        return {
            robot: [[round(at_s, 2), round(x_m, 2), round(y_m, 2)] for at_s, x_m, y_m in points]
            for robot, points in self._points.items()
        }


REMEMBERED = 64
_GOALS = ("goal", "centre")
_RADIUS = "arrive_radius_m"


class Goals:
    """The goal of each robot, as far as its behaviour has one.

    The core's orders are complete, also after a start in mid-run. Only a centralised behaviour keeps its parameters
    elsewhere: then they are taken from the request, if that was received.
    """

    def __init__(self) -> None:
        self._requests: Recent[str, BehaviourRequest] = Recent(REMEMBERED)

    def add(self, request: BehaviourRequest) -> None:
        """Remember a request."""
        self._requests[request.id] = request

    def shown(self, orders: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
        """Return robot → its goal, of those that have one."""
        found = {}
        for robot, order in orders.items():
            request_id = str(order.get("request_id", ""))
            request = self._requests.get(request_id)
            own = order.get("parameters")
            parameters = {**(request.parameters if request else {}), **(own if isinstance(own, dict) else {})}
            goal = next((point for name in _GOALS if (point := _point(parameters.get(name)))), None)
            target = _point(parameters.get("target"))
            if goal is None and target is None:
                continue
            radius = parameters.get(_RADIUS)
            found[robot] = {
                "behaviour": order.get("behaviour", ""),
                "request_id": request_id,
                "goal": goal,
                "target": target,
                "radius_m": radius if isinstance(radius, int | float) else None,
            }
        return found


def _point(value: object) -> list[float] | None:
    if isinstance(value, list | tuple) and len(value) == 2 and all(isinstance(each, int | float) for each in value):
        return [float(each) for each in value]
    return None


MOST_CELLS = 250_000
"""A finer grid is made coarser for the page: it would be megabytes, and finer than a screen."""
INTERVENTION_S = 0.7
"""Three periods of the interventions: an agent that sends no more has stopped to correct its robots."""
FARTHEST_M = 1e6
"""Obstacles that are further away or larger are measurement errors."""
MOST_HOSTS, MOST_ROWS = 1000, 1000
"""Hosts, and obstacles of each, that are shown at most."""
SAME_M = 0.05
"""Obstacles that two robots report this close together are one."""


@dataclass(slots=True)
class Coverage:
    """The cells that any robot has covered; another grid replaces them."""

    changed: bool = False
    _frame: GridFrame | None = None
    _union: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    _newest: Recent[str, bytes] = field(default_factory=lambda: Recent(MOST_HOSTS))

    def add(self, message: CoverageMeasurement) -> None:
        """Merge a host's grid; one that does not unpack is ignored, and so is the supervisor's."""
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
        """Return the frame ``coverage``; None: nothing was received."""
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
    """The obstacles that the robots have detected, each once; those of a host that is gone for long are forgotten."""

    changed: bool = False
    _hosts: dict[str, tuple[tuple[float, ...], ...]] = field(default_factory=dict)
    _names: Names = field(init=False)

    def __post_init__(self) -> None:
        self._names = Names(MOST_HOSTS, self._forget)

    def _forget(self, host: str) -> None:
        if self._hosts.pop(host, None):
            self.changed = True

    def sweep(self, now_s: float) -> None:
        """Forget hosts that have been silent for long; to be called now and then."""
        self._names.sweep(now_s)

    def add(self, message: SeenObstacles, now_s: float) -> None:
        """Replace the obstacles of one host; those beyond `MOST_ROWS` are left out.

        Raises
        ------
        MessageError
            A row is not finite or too large; the others are taken.
        """
        if not self._names.admit(message.host, now_s):
            return
        sent = message.rows[:MOST_ROWS]
        rows = tuple(row for row in sent if all(abs(value) <= FARTHEST_M for value in row))  # NaN is not
        if self._hosts.get(message.host) != rows:
            self._hosts[message.host] = rows
            self.changed = True
        if len(rows) < len(sent):
            reason = f"{len(sent) - len(rows)} obstacles that are not finite or too large"
            raise MessageError(reason, where=message.host, hint="see the robot's log")

    def shown(self) -> dict[str, Any]:
        """Return the frame ``obstacles``."""
        found: dict[tuple[int, ...], list[float]] = {}
        for rows in self._hosts.values():
            for row in rows:
                found.setdefault(tuple(round(value / SAME_M) for value in row), [round(value, 3) for value in row])
        return {"t": "obstacles", "rows": list(found.values())}


@dataclass(slots=True)
class HeldBack:
    """The robots that the safety filter holds back now."""

    changed: bool = False
    _robots: dict[str, dict[str, list[Any]]] = field(default_factory=dict)  # by host
    _received_s: dict[str, float] = field(default_factory=dict)

    def add(self, message: Interventions, now_s: float) -> None:
        """Replace the interventions of one host."""
        if message.host not in self._received_s and len(self._received_s) >= MOST_HOSTS:
            return
        self._received_s[message.host] = now_s
        columns = zip(message.robots, message.x_m_s, message.y_m_s, message.reasons, strict=False)
        rows = {robot: [robot, round(x, 3), round(y, 3), reason] for robot, x, y, reason in columns}
        if rows or self._robots.get(message.host):
            self._robots[message.host] = rows
            self.changed = True

    def shown(self, now_s: float) -> dict[str, Any]:
        """Return the frame ``filter``: all robots that are held back."""
        for host, received_s in list(self._received_s.items()):
            if now_s - received_s > INTERVENTION_S:
                self._robots.pop(host, None)
                del self._received_s[host]
        return {"t": "filter", "robots": [row for rows in self._robots.values() for row in rows.values()]}

    def expired(self, now_s: float) -> bool:
        """Return whether a robot is shown as held back that has sent nothing for a while."""
        return any(self._robots.get(host) and now_s - at_s > INTERVENTION_S for host, at_s in self._received_s.items())
