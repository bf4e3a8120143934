"""One e-stop order and who has confirmed it."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from fullswarm.messages import EStop, EStopReceipt
from fullswarm.runtime import Scheduler, Timer

REPEAT_S = 0.1
LISTEN_S = 0.6
"""Health reports come at 2 Hz: after this long every living robot has been heard of."""


class EStopOrder:
    """Repeats an e-stop until every robot concerned has confirmed it or the deadline is over.

    An engaged e-stop is confirmed by a robot that *stands*; a release by a robot that is released.
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
        self.sent = 0
        self.done = False
        self._send, self._scheduler, self._known = send, scheduler, known
        self._deadline_s, self._on_receipt, self._on_done = deadline_s, on_receipt, on_done
        self._began_s = scheduler.now_s()
        self._timer: Timer | None = None

    def start(self) -> None:
        """Send now and go on until done."""
        self._timer = self._scheduler.every(REPEAT_S, self._tick, first_s=REPEAT_S)
        self._repeat()

    def close(self) -> None:
        """Send no more."""
        if self._timer is not None:
            self._timer.cancel()

    @property
    def elapsed_s(self) -> float:
        """Seconds since the first sending."""
        return self._scheduler.now_s() - self._began_s

    def concerned(self) -> tuple[str, ...]:
        """Who must confirm: the robots addressed, or all that are known or have answered."""
        return self.message.robots or tuple(sorted({*self._known(), *self.receipts}))

    def unconfirmed(self) -> tuple[str, ...]:
        """Who has not confirmed yet, silent or still rolling."""
        return tuple(robot for robot in self.concerned() if not self._confirmed(robot))

    def receive(self, receipt: EStopReceipt) -> None:
        """Book a robot's receipt."""
        before = self.receipts.get(receipt.robot)
        self.receipts[receipt.robot] = receipt
        if self._on_receipt is not None and receipt != before:
            self._on_receipt(receipt)
        self._finish_if_done()

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
        everybody_is_known = bool(self.message.robots) or self.elapsed_s >= LISTEN_S
        confirmed = everybody_is_known and self.concerned() != () and not self.unconfirmed()
        # Half a period of slack: the last tick before the deadline must not be lost to rounding.
        if not confirmed and self.elapsed_s < self._deadline_s - REPEAT_S / 2:
            return False
        self.done = True
        self.close()
        if self._on_done is not None:
            self._on_done(self)
        return True
