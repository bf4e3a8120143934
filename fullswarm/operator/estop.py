"""Repeats one e-stop order until the robots have confirmed it."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from fullswarm.messages import EStop, EStopReceipt
from fullswarm.runtime import Scheduler, Timer

REPEAT_S = 0.1
MOST = 1000
"""Robots whose receipts are kept; of those that are known, all are."""
LISTEN_S = 0.6
"""Health reports come at 2 Hz: after this long every running robot has been received."""
OUTAGE_LISTEN_S = 3.0
"""The same after the hub was unreachable: robots that had lost it look for it every half second."""


class EStopOrder:
    """Repeats an e-stop until every robot concerned has confirmed it or the deadline is over.

    A robot confirms an engaged e-stop at standstill, and a release when it is released.

    Attributes
    ----------
    receipts : robot → its newest receipt
    answered_s, confirmed_s : robot → seconds from the first sending to its first answer, and to its confirmation
    overruled_by : robot that was latched again after this order had released it; the release is sent no longer then
    """

    def __init__(
        self,
        message: EStop,
        *,
        send: Callable[[], None],
        scheduler: Scheduler,
        known: Callable[[], Iterable[str]],
        deadline_s: float,
        on_receipt: Callable[[EStopReceipt], None] | None = None,
        on_done: Callable[[EStopOrder], None] | None = None,
    ) -> None:
        self.message = message
        self.receipts: dict[str, EStopReceipt] = {}
        self.answered_s: dict[str, float] = {}
        self.confirmed_s: dict[str, float] = {}
        self.overruled_by = ""
        self.sent = 0
        self.done = False
        self._all_known_s = LISTEN_S
        self._send, self._scheduler, self._known = send, scheduler, known
        self._deadline_s, self._on_receipt, self._on_done = deadline_s, on_receipt, on_done
        self._began_s = scheduler.now_s()
        self._timer: Timer | None = None

    def start(self) -> None:
        """Send now and repeat until done."""
        self._timer = self._scheduler.every(REPEAT_S, self._tick, first_s=REPEAT_S)
        self._repeat()

    def hub_returned(self) -> None:
        """Wait for robots that have yet to come back before all are taken for known."""
        self._all_known_s = self.elapsed_s + OUTAGE_LISTEN_S

    def close(self) -> None:
        """Send no more."""
        if self._timer is not None:
            self._timer.cancel()

    @property
    def elapsed_s(self) -> float:
        """Seconds since the first sending."""
        return self._scheduler.now_s() - self._began_s

    def concerned(self) -> tuple[str, ...]:
        """Return the robots that must confirm: those addressed, or all that are known or have answered."""
        return self.message.robots or tuple(sorted({*self._known(), *self.receipts}))

    def unconfirmed(self) -> tuple[str, ...]:
        """Return the robots that have not confirmed, silent or still decelerating."""
        return tuple(robot for robot in self.concerned() if not self._confirmed(robot))

    def silent(self) -> tuple[str, ...]:
        """Return the robots that have not answered."""
        return tuple(robot for robot in self.unconfirmed() if robot not in self.receipts)

    def decelerating(self) -> tuple[str, ...]:
        """Return the robots that have answered, but not confirmed."""
        return tuple(robot for robot in self.unconfirmed() if robot in self.receipts)

    def confirmed(self) -> bool:
        """Return whether all robots are known and have confirmed."""
        all_known = bool(self.message.robots) or self.elapsed_s >= self._all_known_s
        return all_known and self.concerned() != () and not self.unconfirmed()

    def receive(self, receipt: EStopReceipt) -> None:
        """Process a robot's receipt, of this order or of another one."""
        if receipt.id != self.message.id:
            self._note_other(receipt)
            return
        before = self.receipts.get(receipt.robot)
        if before is None and len(self.receipts) >= MOST and receipt.robot not in self.concerned():
            return
        # Copies arrive late and out of order: a robot at standstill does not move again.
        if before == receipt or (before is not None and before.standing and not receipt.standing):
            return
        self.receipts[receipt.robot] = receipt
        self.answered_s.setdefault(receipt.robot, self.elapsed_s)
        if self._confirmed(receipt.robot):
            self.confirmed_s.setdefault(receipt.robot, self.elapsed_s)
        if self._on_receipt is not None:
            self._on_receipt(receipt)
        self._finish_if_done()

    def _note_other(self, receipt: EStopReceipt) -> None:
        """End a release when a robot that it had released is latched again: the newer e-stop takes precedence."""
        if receipt.engaged and not self.message.engaged and not self.done and self._confirmed(receipt.robot):
            self.overruled_by = receipt.robot
            self._finish()

    def _confirmed(self, robot: str) -> bool:
        receipt = self.receipts.get(robot)
        if receipt is None or receipt.engaged != self.message.engaged:
            return False
        return receipt.standing or not receipt.engaged

    def _tick(self) -> None:
        if not self._finish_if_done():
            self._repeat()

    def _repeat(self) -> None:
        self.sent += 1
        self._send()

    def _finish_if_done(self) -> bool:
        if self.done:
            return True
        # Half a period of slack: the last tick before the deadline must not be lost to rounding.
        if not self.confirmed() and self.elapsed_s < self._deadline_s - REPEAT_S / 2:
            return False
        self._finish()
        return True

    def _finish(self) -> None:
        self.done = True
        self.close()
        if self._on_done is not None:
            self._on_done(self)


def end_released(orders: Iterable[EStopOrder], robots: tuple[str, ...]) -> list[EStopOrder]:
    """Close the e-stops that concern `robots` (none: all), which are released; return the orders that go on."""
    kept = []
    for order in orders:
        theirs = order.message.robots
        if order.message.engaged and (not robots or not theirs or not set(theirs).isdisjoint(robots)):
            order.close()
        else:
            kept.append(order)
    return kept
