"""Drives by hand: streams short-lived intents, and zero at the end."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping

from fullswarm.messages import RequestStatus, Value
from fullswarm.operator.client import Operator, PendingRequest
from fullswarm.runtime import Scheduler, Timer

BEHAVIOUR = "drive"
RATE_HZ = 20.0
LEAST_S = 0.02
"""The least time between frames: a moved stick is sent then, not with the next period."""
ZERO_FRAMES = 3
"""Zeros sent on release: one may be lost, and the intent expires by itself anyway."""
REMEMBERED_FRAMES = 20
"""Frames whose answer may still arrive; answers to older ones are ignored."""


class Teleop:
    """Streams an intent at 20 Hz while a stick is held.

    Attributes
    ----------
    robots : those driven; none: the whole swarm
    take : whether the frames take robots over from their holders; for the first ones, see `drive`
    """

    def __init__(
        self,
        operator: Operator,
        scheduler: Scheduler,
        robots: Iterable[str] = (),
        *,
        on_status: Callable[[RequestStatus], None] | None = None,
    ) -> None:
        self.robots, self.take = tuple(robots), False
        self._operator, self._scheduler, self._on_status = operator, scheduler, on_status
        self._behaviour, self._sticks = BEHAVIOUR, dict[str, float]()
        self._fixed: dict[str, Value] = {}
        self._sent: tuple[str, dict[str, float]] | None = None  # behaviour and sticks of the newest frame
        self._recent: deque[PendingRequest] = deque()
        self._sent_s = -math.inf
        self._timer: Timer | None = None

    @property
    def held(self) -> bool:
        """Whether the stream is on."""
        return self._timer is not None

    def hold(self, behaviour: str, sticks: Mapping[str, float], fixed: Mapping[str, Value] | None = None) -> None:
        """Set the intent; the first call starts the stream.

        Parameters
        ----------
        behaviour
            One that expires by itself, such as ``drive`` or ``move_left_bc``.
        sticks
            Its parameters that stand for sticks, shares of full rate, -1 to 1; zero on release.
        fixed
            Other parameters.
        """
        self._behaviour, self._sticks, self._fixed = behaviour, dict(sticks), dict(fixed or {})
        if self._timer is None:
            self._timer = self._scheduler.every(1.0 / RATE_HZ, self._send)
            self._send()
        elif (behaviour, self._sticks) != self._sent and self._scheduler.now_s() - self._sent_s >= LEAST_S:
            self._send()

    def release(self, on_done: Callable[[], None] | None = None) -> None:
        """Send zero a few times, then end the stream."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._sticks = dict.fromkeys(self._sticks, 0.0)
        self._zero(ZERO_FRAMES, on_done)

    def _zero(self, left: int, on_done: Callable[[], None] | None) -> None:
        if self.held:  # driving again
            left = 0
        else:
            self._send()
        if left > 1:
            self._scheduler.after(1.0 / RATE_HZ, lambda: self._zero(left - 1, on_done))
        elif on_done is not None:
            on_done()

    def _send(self) -> None:
        if len(self._recent) >= REMEMBERED_FRAMES:
            self._operator.forget(self._recent.popleft())
        self._sent_s, self._sent = self._scheduler.now_s(), (self._behaviour, dict(self._sticks))
        self._recent.append(
            # The next frame replaces this one, so nothing is sent twice.
            self._operator.request(
                self._behaviour,
                self.robots,
                {**self._fixed, **self._sticks},
                self._on_status,
                resend=False,
                take=self.take,
            )
        )
