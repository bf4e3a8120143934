"""What an operator sees of one robot, without starting a command for each look."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Self

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.keys import Keys
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Mailbox, Runtime

FRESH_S = 5.0
"""An emulated processor may be ten times slower than ours, and its reports are as much rarer."""
LOOK_S = 0.2


class Watch:
    """A look at a hub; a context manager."""

    def __init__(self, endpoint: str, swarm: str, robot: str) -> None:
        self._runtime = Runtime(MonotonicClock(), Mailbox())
        self._robot = robot
        self._bus = ZenohBus(self._runtime.mailbox, hub=endpoint)
        self._view = FleetView(self._bus, Keys(swarm), self._runtime, [robot])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._view.close()
        self._bus.close()

    @property
    def lifecycle(self) -> str:
        """Where the robot stands; empty: nothing is heard of it."""
        rows = [row for row in self._view.snapshot().robots if row.robot == self._robot and row.age_s < FRESH_S]
        return rows[0].health.lifecycle if rows and rows[0].health is not None else ""

    def until(self, condition: Callable[[], bool], what: str, limit_s: float, story: Callable[[], str]) -> float:
        """Listen until the condition holds; return how long that took, in seconds. Fails with the story if never."""
        began_s = self._runtime.now_s()

        def look() -> None:
            if condition() or self._runtime.now_s() - began_s > limit_s:
                timer.cancel()
                self._runtime.pause()

        timer = self._runtime.every(LOOK_S, look)
        self._runtime.run()
        took_s = self._runtime.now_s() - began_s
        assert condition(), f"waited {took_s:.0f} s for: {what}\n{story()}"
        return took_s
