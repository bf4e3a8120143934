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
from fullswarm.core.roster import STRANGERS, Member, Roster
from fullswarm.keys import ROBOT_ID, Keys
from fullswarm.messages import EStop, EStopReceipt
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler
from fullswarm.store import Store

LATCHED = "estop/"
REMEMBERED = 1024
KEEP_S = 0.1
"""Between two writes to the database."""
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
        self._engaged_s: Recent[tuple[str, str], float] = Recent(4 * REMEMBERED)  # by robot and clock
        self._unkept: dict[str, None] = {}  # robots whose entry in the database is not up to date
        self._write_waits, self._kept_s = False, -math.inf
        self._since_s: dict[str, float] = {}  # of the newest order or receipt
        self._counter = itertools.count(1)
        self._subscriptions = [
            bus.subscribe(keys.estop, EStop, self._ordered),
            bus.subscribe(keys.estop_receipt(), EStopReceipt, self._confirmed),
        ]
        roster.watch(self._reported, lambda _: None)
        roster.watch_forgotten(self._forget)

    def close(self) -> None:
        """Stop recording."""
        self._write()
        for subscription in self._subscriptions:
            subscription.close()

    def _ordered(self, order: EStop) -> None:
        key = (order.id, order.engaged)
        if order.id and key in self._orders:
            return  # a late copy must not overrule what came after it
        self._orders[key] = None
        robots = [robot for robot in self._meant(order) if self._in_force(order, robot)]
        for robot in robots:
            self._note(robot)
            if order.engaged:
                there = self._roster.is_present(robot)
                self._latches[robot] = Latch(order.reason, self._roster.process(robot) if there else "")
            else:
                self._latches.pop(robot, None)
        self._keep(*robots)

    def _meant(self, order: EStop) -> tuple[str, ...]:
        """Return the robots of an order; of unknown ones, which may come later, only so many are remembered."""
        known = dict.fromkeys(self._roster.known())
        if not order.robots:
            return (*known, *(() if order.engaged else [each for each in self._latches if each not in known]))
        if not order.engaged:
            return tuple(robot for robot in dict.fromkeys(order.robots) if robot in self._latches or robot in known)
        room = STRANGERS - sum(each not in known for each in self._latches)
        unknown = [each for each in dict.fromkeys(order.robots) if each not in known and ROBOT_ID.match(each)]
        return (*(each for each in dict.fromkeys(order.robots) if each in known), *unknown[: max(room, 0)])

    def _in_force(self, order: EStop, robot: str) -> bool:
        """Tell whether an order counts for a robot: a release, not after a newer e-stop of its clock."""
        if not order.clock:
            return True
        newest_s = self._engaged_s.get((robot, order.clock), -math.inf)
        if order.engaged:
            self._engaged_s[robot, order.clock] = max(order.stamp_s, newest_s)
        return order.engaged or order.stamp_s >= newest_s

    def _note(self, robot: str) -> None:
        """Note the time of an order or a receipt."""
        now_s = self._scheduler.now_s()
        if len(self._since_s) > STRANGERS and robot not in self._since_s:
            self._since_s = {each: at_s for each, at_s in self._since_s.items() if now_s - at_s < OLD_REPORT_S}
        self._since_s[robot] = now_s

    def _forget(self, robot: str) -> None:
        """Forget a robot that is no longer known; one that is latched stays so, as far as there is room."""
        self._since_s.pop(robot, None)
        if robot not in self._latches:
            self._store.forget(LATCHED + robot)

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
        self._note(robot)
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
        self._note(robot)
        order = EStop(
            id=f"{self._process}-estop-{next(self._counter)}",
            engaged=True,
            robots=(robot,),
            source=self._process,
            reason=latch.reason or "it was engaged before",
        )
        self._bus.publish(self._keys.estop, order)

    def _keep(self, *robots: str) -> None:
        """Keep latches in the database: at once, of a flood what has come of it after `KEEP_S`."""
        now_s = self._scheduler.now_s()
        self._unkept |= dict.fromkeys(robots)
        if now_s - self._kept_s >= KEEP_S:
            self._write()
        elif not self._write_waits:
            self._write_waits = True
            self._scheduler.after(KEEP_S, self._write)

    def _write(self) -> None:
        self._write_waits, self._kept_s = False, self._scheduler.now_s()
        robots, self._unkept = self._unkept, {}
        values = {
            LATCHED + robot: msgspec.to_builtins(self._latches[robot]) if robot in self._latches else None
            for robot in robots
        }
        self._store.keep(values, f"core {self._process}")
