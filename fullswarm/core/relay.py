"""Passes on the states of robots to neighbours that do not receive them: a cut link between two robots.

Agents report which hosts they receive (``Reception``, 2 Hz and on change). Where a robot should receive another one and
does not, the core subscribes to that one's states and sends the newest to the one that misses them, ten times a second,
with their age. While no link is cut only the reports are sent, so the traffic per robot does not grow with the swarm.
Nothing is stored: a core that is started again knows all after one report of each host.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from fullswarm.bus import Bus
from fullswarm.bus.base import Subscription
from fullswarm.keys import ANY, ROBOT_ID, WHOLE_SWARM_CELL, Keys, cell_of, cells_within
from fullswarm.messages import Reception, Relayed, RelayedStates, RobotStates
from fullswarm.recent import Names
from fullswarm.runtime import Scheduler

RELAY_S = 0.1
PRESENT_S = 2.0
"""A host without a report for so long is not asked for, and gets nothing."""
KEEP_S = 2.0
"""A subscription to a host's states outlasts the need by so much: links that are cut now and then cost no new ones."""
MOST_HOSTS = 1000
"""Hosts at most; see :class:`~fullswarm.recent.Names`."""
MOST_STATES = 64
"""Messages of one sequence, one per grid cell, that are passed on at most."""
OLDEST_S = 1.0
"""Older states are not passed on: the robot is silent, which its neighbours know by themselves."""


@dataclass(slots=True)
class _Host:
    """One host: its newest report, the hosts that it misses, and its states while another host misses them."""

    report: Reception
    received_s: float
    missing: tuple[str, ...] = ()
    needed_s: float = -math.inf
    subscription: Subscription | None = None
    states: list[RobotStates] = field(default_factory=list)  # of one sequence: one per grid cell
    states_s: float = -math.inf


class StateRelay:
    """Relays states between hosts that do not receive each other.

    Parameters
    ----------
    sensing_m, cell_m : as in the agents' settings; who needs whose states follows from them

    Attributes
    ----------
    relayed : states passed on since the start
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, sensing_m: float, cell_m: float) -> None:
        self._bus, self._keys, self._scheduler = bus, keys, scheduler
        self._sensing_m, self._cell_m = sensing_m, cell_m
        self._hosts: dict[str, _Host] = {}
        self._names = Names(MOST_HOSTS, self._forget)
        self._free: list[int] = []  # rows of forgotten hosts
        self._place = np.full((16, 2), math.nan)  # of each host's first robot, to look at few hosts only
        self._extent_m = np.zeros(16)
        self._row: dict[str, int] = {}
        self._sequence = self.relayed = 0
        self._subscription = bus.subscribe(keys.reception(), Reception, self._on_report, latest=True)
        self._timer = scheduler.every(RELAY_S, self._relay)

    def missing(self, host: str) -> tuple[str, ...]:
        """Return the hosts whose states `host` needs and does not receive."""
        found = self._hosts.get(host)
        return found.missing if found else ()

    def close(self) -> None:
        """End all subscriptions."""
        self._timer.cancel()
        self._subscription.close()
        for host in self._hosts.values():
            if host.subscription is not None:
                host.subscription.close()
        self._hosts.clear()

    # ------------------------------------------------------------------ which host misses which
    def _on_report(self, report: Reception) -> None:
        now_s = self._scheduler.now_s()
        host = self._hosts.get(report.host)
        if host is None:
            if not report.robots or not ROBOT_ID.match(report.host) or not self._names.admit(report.host, now_s):
                return
            host = self._hosts[report.host] = _Host(report, now_s)
        else:
            self._names.admit(report.host, now_s)
        host.report, host.received_s = report, now_s
        self._locate(report)
        if len(report.robots):
            host.missing = tuple(self._missed(report, now_s))
            for name in host.missing:
                self._need(name, now_s)

    def _forget(self, name: str) -> None:
        host = self._hosts.pop(name)
        if host.subscription is not None:
            host.subscription.close()
        row = self._row.pop(name)
        self._place[row] = math.nan
        self._free.append(row)

    def _locate(self, report: Reception) -> None:
        row = self._row.get(report.host)
        if row is None:
            row = self._row[report.host] = self._free.pop() if self._free else len(self._row)
        if row == len(self._place):
            self._place = np.vstack([self._place, np.full_like(self._place, math.nan)])
            self._extent_m = np.concatenate([self._extent_m, np.zeros_like(self._extent_m)])
        if report.robots:
            x_m, y_m = np.array(report.x_m), np.array(report.y_m)
            self._place[row] = x_m[0], y_m[0]
            self._extent_m[row] = float(np.hypot(x_m - x_m[0], y_m - y_m[0]).max())

    def _missed(self, report: Reception, now_s: float) -> list[str]:
        """Return the hosts that should be received there, by place, and are not."""
        row, received = self._row[report.host], {report.host, *report.received}
        away_m = np.hypot(*(self._place - self._place[row]).T) - self._extent_m - self._extent_m[row]
        # No cell that an agent subscribes to is farther away; without cells every host receives all.
        reach_m = 1.5 * (self._sensing_m + 1.5 * self._cell_m) if self._cell_m > 0.0 else math.inf
        near = set(np.flatnonzero(away_m <= reach_m).tolist())
        names = (name for name, other in self._row.items() if other in near and name not in received)
        return [
            name for name in names
            if now_s - self._hosts[name].received_s <= PRESENT_S and self._needs(report, self._hosts[name].report)
        ]  # fmt: skip

    def _needs(self, report: Reception, other: Reception) -> bool:
        """Tell whether a host subscribes to a cell in which a robot of the other one is."""
        if self._cell_m <= 0.0:
            return True
        subscribed: set[str] = set()
        for x_m, y_m in zip(report.x_m, report.y_m, strict=True):
            subscribed |= cells_within(x_m, y_m, self._sensing_m, self._cell_m)
        return any(cell_of(*at, self._cell_m) in subscribed for at in zip(other.x_m, other.y_m, strict=True))

    # ------------------------------------------------------------------ passing on
    def _need(self, name: str, now_s: float) -> None:
        host = self._hosts[name]
        host.needed_s = now_s
        if host.subscription is None:

            def keep(states: RobotStates) -> None:
                newest = host.states[0] if host.states else None
                if newest is None or states.sequence != newest.sequence:
                    host.states = []
                if len(host.states) < MOST_STATES:
                    host.states.append(states)
                host.states_s = self._scheduler.now_s()

            cell = WHOLE_SWARM_CELL if self._cell_m <= 0.0 else ANY
            host.subscription = self._bus.subscribe(self._keys.state(cell, name), RobotStates, keep, latest=True)

    def _relay(self) -> None:
        now_s = self._scheduler.now_s()
        self._names.sweep(now_s)
        for name, host in self._hosts.items():
            if host.missing and now_s - host.received_s <= PRESENT_S:
                self._send(name, host.missing, now_s)
        for host in self._hosts.values():
            if host.subscription is not None and now_s - host.needed_s > KEEP_S:
                host.subscription.close()
                host.subscription, host.states = None, []

    def _send(self, name: str, missing: tuple[str, ...], now_s: float) -> None:
        found = tuple(
            Relayed(states=states, age_s=now_s - self._hosts[other].states_s)
            for other in missing if other in self._hosts for states in self._of(other, now_s)
        )  # fmt: skip
        if not found:
            return
        self._sequence += 1
        self.relayed += len(found)
        message = RelayedStates(host=name, relayed=found, sequence=self._sequence, stamp_s=now_s)
        self._bus.publish(self._keys.relay(name), message)

    def _of(self, name: str, now_s: float) -> list[RobotStates]:
        host = self._hosts[name]
        return host.states if now_s - host.states_s <= OLDEST_S else []
