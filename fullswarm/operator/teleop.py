"""Driving by hand: a stream of short-lived intents, and zero at its end."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Asked, Operator
from fullswarm.runtime import Scheduler, Timer

BEHAVIOUR = "drive"
RATE_HZ = 20.0
ZERO_FRAMES = 3
"""Zeros sent on release: one may be lost, and the intent lapses by itself anyway."""
REMEMBERED_FRAMES = 20
"""Frames whose answer may still come; the core's word on older ones concerns nobody."""


class Teleop:
    """Streams the intent ``drive`` at 20 Hz while the stick is held.

    `linear` and `angular` are the sticks, -1 to 1: shares of the robot's full speed and turn rate.
    """

    def __init__(
        self,
        operator: Operator,
        scheduler: Scheduler,
        robots: Iterable[str] = (),
        *,
        on_status: Callable[[RequestStatus], None] | None = None,
    ) -> None:
        self.linear = self.angular = 0.0
        self._operator, self._scheduler, self._robots = operator, scheduler, tuple(robots)
        self._on_status = on_status
        self._recent: deque[Asked] = deque()
        self._timer: Timer | None = None

    def hold(self, linear: float, angular: float) -> None:
        """Set the sticks; the first call starts the stream."""
        self.linear, self.angular = linear, angular
        if self._timer is None:
            self._timer = self._scheduler.every(1.0 / RATE_HZ, self._send)
            self._send()

    def release(self, on_done: Callable[[], None] | None = None) -> None:
        """Send zero a few times, then end the stream."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self.linear = self.angular = 0.0
        self._zero(ZERO_FRAMES, on_done)

    def _zero(self, left: int, on_done: Callable[[], None] | None) -> None:
        self._send()
        if left > 1:
            self._scheduler.after(1.0 / RATE_HZ, lambda: self._zero(left - 1, on_done))
        elif on_done is not None:
            on_done()

    def _send(self) -> None:
        if len(self._recent) >= REMEMBERED_FRAMES:
            self._operator.forget(self._recent.popleft())
        sticks = {"linear": self.linear, "angular": self.angular}
        self._recent.append(
            # The next frame replaces this one, so nothing is sent twice.
            self._operator.request(BEHAVIOUR, self._robots, sticks, self._on_status, resend=False)
        )
