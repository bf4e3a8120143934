"""Publishes what control laws remember, once per second, for recordings and operators."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from fullswarm import memory
from fullswarm.agent.orders.tasks import Tasks
from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import MEMORY_NUMBERS, BehaviourMemory, RobotMemory
from fullswarm.runtime import Scheduler

PERIOD_S = 1.0


class MemoryReporter:
    """Publishes the memory of one agent's robots; nothing while no control law remembers."""

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, host: str, ids: Sequence[str], tasks: Tasks) -> None:
        self._bus, self._keys, self._scheduler, self._host = bus, keys, scheduler, host
        self._ids, self._tasks, self._any = ids, tasks, False

    def publish(self) -> None:
        """Publish what is remembered now; once nothing, when that was published before."""
        robots = tuple(self._robots())
        if robots or self._any:
            message = BehaviourMemory(host=self._host, robots=robots, stamp_s=self._scheduler.now_s())
            self._bus.publish(self._keys.memory(self._host), message)
        self._any = bool(robots)

    def _robots(self) -> Iterator[RobotMemory]:
        for group in self._tasks.groups():
            for place, row in enumerate(group.rows.tolist() if group.memory is not None else ()):
                task = self._tasks.of[row]
                if task is not None:
                    fields, left_out = bounded(memory.as_lists(group.memory, place))
                    request = task.request
                    yield RobotMemory(
                        robot=self._ids[row], behaviour=request.behaviour, request_id=request.request_id,
                        fields=fields, left_out=left_out,
                    )  # fmt: skip


def bounded(fields: dict[str, list[float]]) -> tuple[dict[str, tuple[float | None, ...]], int]:
    """Return what a message may hold of a memory, the first `MEMORY_NUMBERS` numbers, and how many are left out."""
    found: dict[str, tuple[float | None, ...]] = {}
    room, left_out = MEMORY_NUMBERS, 0
    for name, values in fields.items():
        kept = values[:room]
        if kept:
            found[name[:64]] = tuple(each if math.isfinite(each) and abs(each) <= 1e300 else None for each in kept)
        room, left_out = room - len(kept), left_out + len(values) - len(kept)
    return found, left_out
