"""Answers agents that ask for the core's time."""

from __future__ import annotations

from collections.abc import Callable

from fullswarm.bus.base import Bus
from fullswarm.clock import wall_time_s
from fullswarm.keys import Keys
from fullswarm.messages import ClockProbe, ClockReply
from fullswarm.runtime import Scheduler


class ClockServer:
    """Returns each probe with the core's present time; see ``agent/core_clock.py``."""

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, process: str, wall_s: Callable[[], float] = wall_time_s
    ) -> None:
        self._wall_s = wall_s
        self._bus, self._keys, self._scheduler, self._process = bus, keys, scheduler, process
        self._subscription = bus.subscribe(keys.clock_probe(), ClockProbe, self._on_probe, latest=True)

    def close(self) -> None:
        """Drop the subscription."""
        self._subscription.close()

    def _on_probe(self, probe: ClockProbe) -> None:
        reply = ClockReply(
            host=probe.host, sent_s=probe.sent_s, core=self._process, core_s=self._scheduler.now_s(),
            wall_s=self._wall_s(),
        )  # fmt: skip
        self._bus.publish(self._keys.clock_reply(probe.host), reply)
