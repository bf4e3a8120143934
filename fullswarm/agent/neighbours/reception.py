"""Reports whose states an agent receives, and takes in the states that the core relays instead of a cut link."""

from __future__ import annotations

import math
from collections.abc import Sequence

from fullswarm.agent.neighbours.estimates import Neighbours
from fullswarm.agent.state import AgentState
from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import Reception, RelayedStates, RobotStates
from fullswarm.runtime import Scheduler

PERIOD_S = 0.5
MISSED = 5.0
"""A host is not received any more after so many of its state messages did not arrive: by chance, seldom."""
LEAST_S = 0.25
MOST_HOSTS = 1000
"""Hosts that are reported at most."""


class ReceptionReporter:
    """Reports to the core which hosts this agent receives; the core relays the states that are missing.

    Parameters
    ----------
    alone : this agent carries all robots of the swarm, so that there is nothing to receive
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, host: str, ids: Sequence[str], state: AgentState,
        neighbours: Neighbours, state_rate_hz: float, alone: bool,
    ) -> None:  # fmt: skip
        self._bus, self._keys, self._scheduler, self._host = bus, keys, scheduler, host
        self._ids, self._state, self._neighbours = ids, state, neighbours
        self._missed_s = max(LEAST_S, MISSED / state_rate_hz)
        self._direct_s: dict[str, float] = {}
        self._reported: frozenset[str] = frozenset()
        self._report_at_s = -math.inf
        self.alone = alone
        self._subscription = None if alone else bus.subscribe(
            keys.relay(host), RelayedStates, self._on_relayed, latest=True
        )  # fmt: skip

    def note(self, states: RobotStates, now_s: float) -> None:
        """Take note that `states` came directly."""
        if states.host in self._direct_s or len(self._direct_s) < MOST_HOSTS:
            self._direct_s[states.host] = now_s

    def update(self) -> None:
        """Report when it is time, and when a host is new or no longer received; to be called each 0.1 s."""
        if self.alone:
            return
        now_s = self._scheduler.now_s()
        self._direct_s = {host: at_s for host, at_s in self._direct_s.items() if now_s - at_s <= self._missed_s}
        received = frozenset(self._direct_s)
        if now_s < self._report_at_s and received == self._reported:
            return
        self._reported, self._report_at_s = received, now_s + PERIOD_S
        places = self._state.pose[:, :2].tolist()
        known = [row for row, (x_m, y_m) in enumerate(places) if math.isfinite(x_m) and math.isfinite(y_m)]
        report = Reception(
            host=self._host,
            robots=tuple(self._ids[row] for row in known),
            x_m=tuple(places[row][0] for row in known),
            y_m=tuple(places[row][1] for row in known),
            received=tuple(sorted(received - {self._host})),
            stamp_s=now_s,
        )
        self._bus.publish(self._keys.reception(self._host), report)

    def _on_relayed(self, relayed: RelayedStates) -> None:
        now_s = self._scheduler.now_s()
        for each in relayed.relayed:
            if each.states.host != self._host:
                self._neighbours.receive_relayed(each.states, each.age_s, now_s)

    def close(self) -> None:
        """Drop the subscription."""
        if self._subscription is not None:
            self._subscription.close()
