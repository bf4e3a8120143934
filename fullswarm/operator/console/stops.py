"""Tracks the e-stops and stops of all operators: which robots have confirmed, are at standstill or silent."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from fullswarm.messages import EStop, EStopReceipt, StopRequest
from fullswarm.operator.estop import LISTEN_S
from fullswarm.operator.view import RobotRow, Snapshot

STOP_WATCH_S = 10.0
REMEMBERED = 256


def by_operator(order: EStop | StopRequest) -> bool:
    """Return whether an operator sent the order: robots repeat stops that still hold, and a core repeats latches."""
    return order.robots != (order.source,) and not order.source.startswith("core-")


@dataclass(slots=True)
class EStopTracker:
    """The newest e-stop order and its receipts.

    Parameters
    ----------
    known
        All robots that are present: an order to all concerns them.
    name_of
        The name of a source for people.
    """

    known: Callable[[], Iterable[str]]
    name_of: Callable[[str], str] = str
    order: EStop | None = None
    began_s: float = 0.0
    receipts: dict[str, tuple[EStopReceipt, float]] = field(default_factory=dict)
    _seen: OrderedDict[tuple[str, bool], None] = field(default_factory=OrderedDict)
    _sent: dict[str, Any] | None = None

    def add_order(self, order: EStop, now_s: float) -> bool:
        """Process an order; return whether it is a new one of an operator. Copies of an older one change nothing."""
        key = (order.id, order.engaged)
        if key in self._seen or not by_operator(order):
            return False
        self._seen[key] = None
        while len(self._seen) > REMEMBERED:
            self._seen.popitem(last=False)
        self.order, self.began_s = order, now_s
        self.receipts = {}
        return True

    def add_receipt(self, receipt: EStopReceipt, now_s: float) -> None:
        """Process a receipt; those of other orders are ignored."""
        if self.order is None or receipt.id != self.order.id or receipt.engaged != self.order.engaged:
            return
        before = self.receipts.get(receipt.robot)
        if before is not None and (before[0] == receipt or (before[0].standing and not receipt.standing)):
            return
        self.receipts[receipt.robot] = receipt, now_s - self.began_s

    def changed_frame(self, now_s: float) -> dict[str, Any] | None:
        """Return the frame ``estop`` if it has changed."""
        frame = self.shown(now_s)
        if frame == self._sent:
            return None
        self._sent = frame
        return frame

    def shown(self, now_s: float) -> dict[str, Any] | None:
        """Return the frame ``estop``; None: there was none."""
        order = self.order
        if order is None:
            return None
        concerned = order.robots or tuple(sorted({*self.known(), *self.receipts}))
        waiting = [robot for robot in concerned if not self._done(robot)]
        all_known = bool(order.robots) or now_s - self.began_s >= LISTEN_S
        return {
            "t": "estop",
            "id": order.id,
            "engaged": order.engaged,
            "done": all_known and bool(concerned) and not waiting,
            "receipts": [
                {
                    "robot": robot,
                    "standing": receipt.standing,
                    "rolled_m": round(receipt.rolled_m, 3),
                    "after_s": round(after_s, 3),
                    "engaged": receipt.engaged,
                }
                for robot, (receipt, after_s) in sorted(self.receipts.items())
            ],
            "waiting": waiting,
            "silent": [robot for robot in waiting if robot not in self.receipts],
            "reason": order.reason,
            "operator": self.name_of(order.source),
        }

    def _done(self, robot: str) -> bool:
        known = self.receipts.get(robot)
        return known is not None and (known[0].standing or not known[0].engaged)


@dataclass(slots=True)
class StopTracker:
    """Which robots are at standstill since the newest stop. A stop is not acknowledged: health reports show it."""

    order: StopRequest | None = None
    began_s: float = 0.0
    _sent: dict[str, Any] | None = None
    _seen: OrderedDict[str, None] = field(default_factory=OrderedDict)

    def add_order(self, order: StopRequest, now_s: float) -> bool:
        """Process an order; return whether it is a new one of an operator."""
        if order.id in self._seen or not by_operator(order):
            return False
        self._seen[order.id] = None
        while len(self._seen) > REMEMBERED:
            self._seen.popitem(last=False)
        self.order, self.began_s, self._sent = order, now_s, None
        return True

    def changed_frame(self, seen: Snapshot, now_s: float) -> dict[str, Any] | None:
        """Return the frame ``stop`` if it has changed and is not over. A robot that is silent may move on."""
        order = self.order
        if order is None:
            return None
        rows = {row.robot: row for row in seen.robots}
        standing: list[str] = []
        moving: list[str] = []
        silent: list[str] = []
        for robot in order.robots or rows:
            row = rows.get(robot)
            (silent if row is None or row.silent else moving if _moves(row) else standing).append(robot)
        done = bool(standing) and not moving and not silent
        frame = {
            "t": "stop",
            "robots": order.robots,
            "standing": standing,
            "moving": moving,
            "silent": silent,
            "done": done,
        }
        if done or now_s - self.began_s > STOP_WATCH_S:
            self.order = None
        if frame == self._sent:
            return None
        self._sent = frame
        return frame


def _moves(row: RobotRow) -> bool:
    return row.health is None or row.health.moving
