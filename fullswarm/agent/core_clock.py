"""Measures the difference between this computer's clock and the core's, and with it how late neighbours' states are.

A state counts from the moment at which it was measured, not from its arrival. Two agents share no clock, but both
exchange messages with the core: an agent sends a :class:`~fullswarm.messages.ClockProbe`, the core returns it with its
own time (Cristian 1989; the principle of NTP). The reply with the shortest round trip is taken, because that one waited
least in queues; half of its round trip is the longest possible error of the offset, reached only if one direction takes
all of it. Each state carries its sender's offset, so its receiver knows its age also when some messages take longer
than others, or came through the core.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from fullswarm.bus.base import Bus
from fullswarm.clock import wall_time_s
from fullswarm.keys import Keys
from fullswarm.messages import ClockProbe, ClockReply, RobotStates
from fullswarm.runtime import Scheduler

FIRST_S, PERIOD_S = 0.1, 1.0
"""Seconds between probes: until `ENOUGH` replies have come, and from then on."""
ENOUGH = 5
WINDOW_S = 10.0
"""The shortest round trip of this time and the one before it counts: clocks drift apart."""
LONGEST_S = 2.0
"""A reply later than this says nothing, and no state counts as older by its delay: a robot's silence does the rest."""


class CoreClock:
    """The core's clock as seen by one agent.

    Parameters
    ----------
    assumed_s : delay of a state where it is not measured
    wall_s : this computer's time of day, seconds since 1970

    Attributes
    ----------
    core : name of the core's process; empty: no reply yet
    offset_s : the core's time less this computer's
    round_trip_s : of the reply by which that is known
    wall_offset_s : this computer's time of day less the core's, by the newest reply; None: no reply yet
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, host: str, assumed_s: float,
        wall_s: Callable[[], float] = wall_time_s,
    ) -> None:  # fmt: skip
        self._bus, self._keys, self._scheduler, self._host = bus, keys, scheduler, host
        self._assumed_s, self._wall_s = assumed_s, wall_s
        self.wall_offset_s: float | None = None
        self.core, self.offset_s, self.round_trip_s = "", 0.0, math.inf
        self._before_s = math.inf  # shortest round trip of the window before
        self._before_offset_s = 0.0
        self._recent_s, self._recent_offset_s, self._began_s = math.inf, 0.0, -math.inf
        self._replies = 0
        self._probed_s = -math.inf
        self._subscription = bus.subscribe(keys.clock_reply(host), ClockReply, self._on_reply, latest=True)
        self._timer = scheduler.every(FIRST_S, self._probe, first_s=0.0)

    def close(self) -> None:
        """Drop the subscription and the timer."""
        self._timer.cancel()
        self._subscription.close()

    def delay_s(self, states: RobotStates, now_s: float) -> float:
        """Return how long the states of a host were on their way until `now_s`, in seconds, >= 0."""
        if states.host == self._host:
            delay_s = now_s - states.stamp_s
        elif states.core and states.core == self.core:
            delay_s = now_s + self.offset_s - states.stamp_s - states.offset_s
        else:
            return self._assumed_s
        return min(max(delay_s, 0.0), LONGEST_S)

    def _probe(self) -> None:
        now_s = self._scheduler.now_s()
        if self._replies < ENOUGH or now_s - self._probed_s >= PERIOD_S - 0.5 * FIRST_S:
            self._probed_s = now_s
            self._bus.publish(self._keys.clock_probe(self._host), ClockProbe(host=self._host, sent_s=now_s))

    def _on_reply(self, reply: ClockReply) -> None:
        now_s = self._scheduler.now_s()
        round_trip_s = now_s - reply.sent_s
        if reply.host != self._host or not 0.0 <= round_trip_s <= LONGEST_S:
            return
        self.wall_offset_s = self._wall_s() - reply.wall_s - 0.5 * round_trip_s
        if reply.core != self.core:
            self.core, self._replies = reply.core, 0
            self._before_s = self._recent_s = math.inf
            self._began_s = now_s
        elif now_s - self._began_s > WINDOW_S:
            self._before_s, self._before_offset_s = self._recent_s, self._recent_offset_s
            self._recent_s, self._began_s = math.inf, now_s
        self._replies += 1
        if round_trip_s <= self._recent_s:
            self._recent_s, self._recent_offset_s = round_trip_s, reply.core_s - 0.5 * (reply.sent_s + now_s)
        older = self._before_s < self._recent_s
        self.round_trip_s = self._before_s if older else self._recent_s
        self.offset_s = self._before_offset_s if older else self._recent_offset_s
