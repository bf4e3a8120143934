"""Which robots are in e-stop: a second memory, for agents that lost their own latch or never got the order.

A robot that reports no latch although it should be latched gets the order again, before any request to move. The agents
carry e-stops out by themselves, with or without a core. Any message may be lost, so a latch is forgotten only when its
release was received, from the operator or in a robot's receipt, or when an agent that had confirmed the latch reports
that it is gone.
"""

from __future__ import annotations

import itertools
import math

import msgspec

from fullswarm.bus import Bus
from fullswarm.core.roster import Member, Roster
from fullswarm.keys import Keys
from fullswarm.messages import EStop, EStopReceipt
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler
from fullswarm.store import Store

LATCHED = "estop/"
REMEMBERED = 1024
OLD_REPORT_S = 1.0
"""A report that arrives within this time of an order or a receipt may be older; also the period of repeated orders."""


class Latch(msgspec.Struct, frozen=True):
    """One robot's e-stop, as it is kept in the local database."""

    reason: str
    agent: str  # the process that latched it; empty: the robot was absent
    held: bool = False  # that process has confirmed it


class Latches:
    """Remembers engaged e-stops and engages them again on robots that are not latched.

    Parameters
    ----------
    process
        Name of this start of the core; marks its own orders.
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, store: Store, roster: Roster, process: str) -> None:
        self._bus, self._keys, self._scheduler = bus, keys, scheduler
        self._store, self._roster, self._process = store, roster, process
        self._orders: Recent[tuple[str, bool], None] = Recent(REMEMBERED)
        self._latches = {
            entry.key.removeprefix(LATCHED): msgspec.convert(entry.value, Latch) for entry in store.list(LATCHED)
        }
        self._since_s: dict[str, float] = {}  # of the newest order or receipt
        self._counter = itertools.count(1)
        self._subscriptions = [
            bus.subscribe(keys.estop, EStop, self._ordered),
            bus.subscribe(keys.estop_receipt(), EStopReceipt, self._confirmed),
        ]
        roster.watch(self._reported, lambda _: None)

    def close(self) -> None:
        """Stop recording."""
        for subscription in self._subscriptions:
            subscription.close()

    def _ordered(self, order: EStop) -> None:
        key = (order.id, order.engaged)
        if order.id and key in self._orders:
            return  # a late copy must not overrule what came after it
        self._orders[key] = None
        robots = order.robots or (*self._roster.known(), *(() if order.engaged else self._latches))
        for robot in robots:
            self._since_s[robot] = self._scheduler.now_s()
            if order.engaged:
                there = self._roster.is_present(robot)
                self._latches[robot] = Latch(order.reason, self._roster.process(robot) if there else "")
            else:
                self._latches.pop(robot, None)
        self._keep(*robots)

    def _confirmed(self, receipt: EStopReceipt) -> None:
        """Record what a robot did, perhaps by an order that did not reach this core."""
        robot, latch = receipt.robot, self._latches.get(receipt.robot)
        if latch is None:
            return  # a latch that is new here will be in the robot's next report
        if receipt.engaged:
            process = self._roster.process(robot)
            if latch.held and latch.agent == process:
                return
            self._latches[robot] = Latch(latch.reason, process, held=True)
        elif (receipt.id, False) in self._orders:
            return
        else:
            del self._latches[robot]
        self._since_s[robot] = self._scheduler.now_s()
        self._keep(robot)

    def _reported(self, member: Member, restarted: bool) -> None:
        del restarted
        robot, latch = member.robot, self._latches.get(member.robot)
        if member.health is None or (latch is None and not member.health.estop):
            return
        old = self._scheduler.now_s() - self._since_s.get(robot, -math.inf) < OLD_REPORT_S
        if latch is None:
            if old:
                return  # it has just been released
            self._latches[robot] = Latch("", member.process, held=True)
        elif member.health.estop:
            held = Latch(latch.reason, member.process, held=True)
            if latch == held:
                return
            self._latches[robot] = held
        elif latch.agent != member.process:
            self._again(robot, latch, member.process)  # another process, or one that was away
        elif old:
            return
        elif latch.held:
            del self._latches[robot]  # released by an order that did not reach this core
        else:
            self._again(robot, latch, member.process)
        self._keep(robot)

    def _again(self, robot: str, latch: Latch, process: str) -> None:
        """Repeat the order; the next reports show whether it arrived."""
        self._latches[robot] = Latch(latch.reason, process)
        self._since_s[robot] = self._scheduler.now_s()
        order = EStop(
            id=f"{self._process}-estop-{next(self._counter)}",
            engaged=True,
            robots=(robot,),
            source=self._process,
            reason=latch.reason or "it was engaged before",
        )
        self._bus.publish(self._keys.estop, order)

    def _keep(self, *robots: str) -> None:
        values = {
            LATCHED + robot: msgspec.to_builtins(self._latches[robot]) if robot in self._latches else None
            for robot in robots
        }
        self._store.keep(values, f"core {self._process}")
