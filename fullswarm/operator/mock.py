"""The paper's mock publisher (III.A): asks for one behaviour again and again, as an impatient operator would."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from fullswarm.messages import RequestStatus, Value
from fullswarm.operator.client import Asked, Operator
from fullswarm.runtime import Scheduler, Timer


class MockPublisher:
    """Sends `count` separate requests at `rate_hz`; 0 means without end.

    Attributes
    ----------
    sent, answered : int
        Requests sent, and those that the core has answered at least once.
    refused : list of RequestStatus
        Those it refused.
    """

    def __init__(
        self,
        operator: Operator,
        scheduler: Scheduler,
        behaviour: str,
        robots: Iterable[str] = (),
        parameters: Mapping[str, Value] | None = None,
        *,
        rate_hz: float = 1.0,
        count: int = 1,
        on_status: Callable[[RequestStatus], None] | None = None,
        on_answered: Callable[[], None] | None = None,
    ) -> None:
        self.sent = self.answered = 0
        self.refused: list[RequestStatus] = []
        self._operator, self._scheduler = operator, scheduler
        self._behaviour, self._robots, self._parameters = behaviour, tuple(robots), dict(parameters or {})
        self._period_s, self._count = 1.0 / rate_hz, count
        self._on_status, self._on_answered = on_status, on_answered
        self._open: dict[str, Asked] = {}
        self._timer: Timer | None = None

    def start(self) -> None:
        """Send the first request now."""
        self._timer = self._scheduler.every(self._period_s, self._send)
        self._send()

    def stop(self) -> None:
        """Send nothing more and stop repeating what was not answered."""
        if self._timer is not None:
            self._timer.cancel()
        for asked in self._open.values():
            self._operator.forget(asked)
        self._open.clear()

    def _send(self) -> None:
        self.sent += 1
        if self.sent == self._count and self._timer is not None:
            self._timer.cancel()
        asked = self._operator.request(self._behaviour, self._robots, self._parameters, self._receive)
        self._open[asked.request.id] = asked

    def _receive(self, status: RequestStatus) -> None:
        first = self._open.pop(status.request_id, None) is not None
        self.answered += first
        if status.phase == "refused":
            self.refused.append(status)
        if self._on_status is not None:
            self._on_status(status)
        if first and self._count and self.answered == self._count and self._on_answered is not None:
            self._on_answered()
