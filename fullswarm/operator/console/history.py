"""What has been lately: trails, curves and the log, each in a ring of fixed size."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal

from fullswarm.messages import Summary
from fullswarm.operator.view import Snapshot

TRAIL_S, TRAIL_RATE_HZ = 60.0, 5.0
CHART_S, CHART_RATE_HZ = 600.0, 2.0
LOG_LENGTH = 200
STEP_M = 0.01
"""A robot that has not come so far leaves no new point."""

CHART_NAMES = ("work_m", "coverage", "collisions")
_VALUES = (("work", "total_m"), ("coverage", "fraction"), ("collisions", "events"))

LogKind = Literal["request", "refused", "stop", "estop", "lease", "link", "fault"]


@dataclass(slots=True)
class Trails:
    """Where each robot was during the last minute."""

    _points: dict[str, deque[tuple[float, float, float]]] = field(default_factory=dict)

    def add(self, seen: Snapshot, now_s: float) -> None:
        """Take a robot's place if it has moved."""
        for row in seen.robots:
            if row.silent or not math.isfinite(row.x_m):
                continue
            points = self._points.setdefault(row.robot, deque(maxlen=int(TRAIL_S * TRAIL_RATE_HZ)))
            if not points or math.hypot(row.x_m - points[-1][1], row.y_m - points[-1][2]) >= STEP_M:
                points.append((now_s, row.x_m, row.y_m))

    def shown(self, now_s: float) -> dict[str, list[list[float]]]:
        """Return robot → places, the oldest first."""
        return {
            robot: [[round(x_m, 2), round(y_m, 2)] for at_s, x_m, y_m in points if now_s - at_s <= TRAIL_S]
            for robot, points in self._points.items()
        }


@dataclass(slots=True)
class Charts:
    """Rows ``[at_s, work_m, coverage, collisions]``; None where it is not known."""

    rows: deque[list[float | None]] = field(default_factory=lambda: deque(maxlen=int(CHART_S * CHART_RATE_HZ)))

    def add(self, summaries: tuple[Summary, ...], now_s: float) -> list[float | None] | None:
        """Return the new row; None as long as there is nothing to draw."""
        by_name = {each.metric: each.values for each in summaries}
        values = [by_name.get(metric, {}).get(key) for metric, key in _VALUES]
        if all(value is None for value in values):
            return None
        row = [round(now_s, 2), *(None if value is None else round(value, 4) for value in values)]
        self.rows.append(row)
        return row


@dataclass(frozen=True, slots=True)
class Entry:
    """A line of the log; `by` is the operator who did it."""

    at_s: float
    clock: str
    kind: LogKind
    text: str
    robots: tuple[str, ...] = ()
    request_id: str = ""
    by: str = ""

    def shown(self, reader: str) -> dict[str, Any]:
        """Return it as operator `reader` sees it."""
        return {
            "at": round(self.at_s, 2),
            "clock": self.clock,
            "kind": self.kind,
            "text": self.text,
            "robots": self.robots,
            "request_id": self.request_id,
            "mine": bool(reader) and self.by == reader,
        }


class Journal:
    """The log. The wall clock is only for its readers."""

    def __init__(self, wall_s: Callable[[], float], on_entry: Callable[[Entry], None]) -> None:
        self.entries: deque[Entry] = deque(maxlen=LOG_LENGTH)
        self._wall_s, self._on_entry = wall_s, on_entry

    def add(
        self,
        at_s: float,
        kind: LogKind,
        text: str,
        robots: tuple[str, ...] = (),
        *,
        request_id: str = "",
        by: str = "",
    ) -> None:
        """Write a line."""
        clock = f"{datetime.fromtimestamp(self._wall_s()):%H:%M:%S}"
        entry = Entry(at_s, clock, kind, text[:500], robots, request_id, by)
        self.entries.append(entry)
        self._on_entry(entry)
