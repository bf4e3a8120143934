"""Who is in e-stop. An agent that was started again has lost its latch, one that was away never got it.

They get it when they are heard, before anybody asks them to move. The agents carry e-stops out by themselves, with or
without a core; this is only the memory that outlives them.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict

import msgspec

from fullswarm.bus import Bus
from fullswarm.core.keep import keep
from fullswarm.core.roster import Member, Roster
from fullswarm.keys import Keys
from fullswarm.messages import EStop
from fullswarm.store import Store

LATCHED = "estop/"
REMEMBERED = 1024


class Latch(msgspec.Struct, frozen=True):
    """One robot's e-stop, as it is kept in the local database."""

    reason: str
    agent: str  # the process that latched it; empty: it was not there


class Latches:
    """Remembers engaged e-stops and engages them again on agents that were started since.

    Parameters
    ----------
    process
        Name of this start of the core; its own orders bear it.
    """

    def __init__(self, bus: Bus, keys: Keys, store: Store, roster: Roster, process: str) -> None:
        self._bus, self._keys, self._store, self._roster, self._process = bus, keys, store, roster, process
        self._orders: OrderedDict[tuple[str, bool], None] = OrderedDict()
        self._latches = {
            entry.key.removeprefix(LATCHED): msgspec.convert(entry.value, Latch) for entry in store.list(LATCHED)
        }
        self._counter = itertools.count(1)
        self._subscription = bus.subscribe(keys.estop, EStop, self._ordered)
        roster.watch(self._reported, lambda _: None)

    def close(self) -> None:
        """Remember nothing more."""
        self._subscription.close()

    def _ordered(self, order: EStop) -> None:
        key = (order.id, order.engaged)
        if order.id and key in self._orders:
            return  # a late copy must not overrule what came after it
        self._orders[key] = None
        while len(self._orders) > REMEMBERED:
            self._orders.popitem(last=False)
        robots = order.robots or (*self._roster.known(), *(() if order.engaged else self._latches))
        for robot in robots:
            if order.engaged:
                there = self._roster.is_present(robot)
                self._latches[robot] = Latch(order.reason, self._roster.process(robot) if there else "")
            else:
                self._latches.pop(robot, None)
        self._keep(*robots)

    def _reported(self, member: Member, restarted: bool) -> None:
        latch = self._latches.get(member.robot)
        if latch is None or member.health is None:
            return
        if member.health.estop:
            if latch.agent == member.process:
                return
            self._latches[member.robot] = Latch(latch.reason, member.process)
        elif latch.agent and not restarted:
            return  # it was there when the order was given; the report may be older
        elif latch.agent == member.process:
            del self._latches[member.robot]  # released while no core was there to hear it
        else:
            self._latches[member.robot] = Latch(latch.reason, member.process)
            order = EStop(
                id=f"{self._process}-estop-{next(self._counter)}",
                engaged=True,
                robots=(member.robot,),
                source=self._process,
                reason=latch.reason or "engaged before its agent was started again",
            )
            self._bus.publish(self._keys.estop, order)
        self._keep(member.robot)

    def _keep(self, *robots: str) -> None:
        values = {
            LATCHED + robot: msgspec.to_builtins(self._latches[robot]) if robot in self._latches else None
            for robot in robots
        }
        keep(self._store, values, f"core {self._process}")
