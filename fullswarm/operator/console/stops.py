"""Tracks the e-stops and stops of all operators: which robots have confirmed, are at standstill or silent."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from fullswarm.messages import EStop, EStopReceipt, StopRequest
from fullswarm.operator.estop import EStopOrder
from fullswarm.operator.view import RobotRow, Snapshot
from fullswarm.runtime import Scheduler

STOP_WATCH_S = 10.0
REMEMBERED = 256

Seen = OrderedDict[tuple[str, bool], None]


def _is_new(order: EStop | StopRequest, engaged: bool, seen: Seen) -> bool:
    """Return whether this is the first copy of an operator's order, and note it in `seen`.

    Robots repeat stops that still hold, and a core repeats latches: those are not operators' orders.
    """
    key = (order.id, engaged)
    if key in seen or order.robots == (order.source,) or order.source.startswith("core-"):
        return False
    seen[key] = None
    while len(seen) > REMEMBERED:
        seen.popitem(last=False)
    return True


@dataclass(slots=True)
class EStopTracker:
    """The newest e-stop order and its receipts.

    Parameters
    ----------
    known
        Returns all robots that are present: an order to all concerns them.
    name_of
        Returns the name of a source for people.
    """

    scheduler: Scheduler
    known: Callable[[], Iterable[str]]
    name_of: Callable[[str], str] = str
    order: EStopOrder | None = None
    _seen: Seen = field(default_factory=OrderedDict)
    _sent: dict[str, Any] | None = None

    def add_order(self, order: EStop) -> bool:
        """Process an order; return whether it is a new one of an operator. Copies of an older one change nothing."""
        if not _is_new(order, order.engaged, self._seen):
            return False
        # Never started: its sender repeats it, here it only collects the receipts.
        self.order = EStopOrder(
            order, send=lambda: None, scheduler=self.scheduler, known=self.known, deadline_s=math.inf
        )
        return True

    def add_receipt(self, receipt: EStopReceipt) -> None:
        """Process a receipt; those of other orders are ignored."""
        if self.order is not None and (receipt.id, receipt.engaged) == (
            self.order.message.id,
            self.order.message.engaged,
        ):
            self.order.receive(receipt)

    def changed_frame(self) -> dict[str, Any] | None:
        """Return the frame ``estop`` if it has changed."""
        frame = self.shown()
        if frame == self._sent:
            return None
        self._sent = frame
        return frame

    def shown(self) -> dict[str, Any] | None:
        """Return the frame ``estop``; None: there was none."""
        order = self.order
        if order is None:
            return None
        return {
            "t": "estop",
            "id": order.message.id,
            "engaged": order.message.engaged,
            "done": order.confirmed(),
            "receipts": [
                {
                    "robot": robot,
                    "standing": receipt.standing,
                    "rolled_m": round(receipt.rolled_m, 3),
                    "after_s": round(order.confirmed_s.get(robot, order.answered_s[robot]), 3),
                    "engaged": receipt.engaged,
                }
                for robot, receipt in sorted(order.receipts.items())
            ],
            "waiting": list(order.unconfirmed()),
            "silent": list(order.silent()),
            "reason": order.message.reason,
            "operator": self.name_of(order.message.source),
        }


@dataclass(slots=True)
class StopTracker:
    """Which robots are at standstill since the newest stop. A stop is not acknowledged: health reports show it."""

    order: StopRequest | None = None
    began_s: float = 0.0
    _sent: dict[str, Any] | None = None
    _seen: Seen = field(default_factory=OrderedDict)

    def add_order(self, order: StopRequest, now_s: float) -> bool:
        """Process an order; return whether it is a new one of an operator."""
        if not _is_new(order, True, self._seen):
            return False
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
