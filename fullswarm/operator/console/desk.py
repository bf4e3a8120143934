"""One operator at one page: asks, drives, holds robots and stops, in a name of their own."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol

from fullswarm.bus.base import Bus
from fullswarm.clock import clock_id
from fullswarm.errors import did_you_mean
from fullswarm.keys import Keys
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator
from fullswarm.operator.console import frames
from fullswarm.operator.console.frames import Answer
from fullswarm.operator.console.requests import for_page
from fullswarm.operator.console.world import World
from fullswarm.operator.estop import EStopOrder
from fullswarm.operator.leases import LeaseHolder
from fullswarm.operator.teleop import Teleop
from fullswarm.runtime import Scheduler, Timer

DEAD_MAN_S = 0.25
"""After so long without a frame the stick counts as released."""
WATCH_S = 0.05
CLEAR_S = 5.0
"""A forgotten page must not release a robot that comes back tomorrow; an e-stop is pressed without end."""

READ_ONLY = "this console only shows: it was started with --read-only"


class Listener(Protocol):
    """A page's end of the line. It takes frames at once and never blocks."""

    def put(self, kind: str, text: str) -> None:
        """Send a frame; of some kinds only the newest counts."""
        ...


@dataclass(frozen=True, slots=True)
class Place:
    """What all desks share."""

    bus: Bus
    keys: Keys
    scheduler: Scheduler
    world: World
    present: Callable[[], Iterable[str]]  # robots that are there
    end_presses: Callable[[tuple[str, ...]], None]  # no desk shall go on pressing an e-stop that is released
    read_only: bool = False


class Desk:
    """Carries out a page's frames. A reload finds it as it was; driving ends with the line it came by.

    Parameters
    ----------
    session, source, name
        The page's secret; which process asks, unlike any other's; in whose name.
    """

    def __init__(self, place: Place, session: str, source: str, name: str) -> None:
        self.session, self.source, self.name = session, source, name
        self.listeners: list[Listener] = []
        self._place = place
        self._operator = Operator(place.bus, place.keys, place.scheduler, source, name=name, clock=clock_id())
        self._leases = LeaseHolder(place.bus, place.keys, place.scheduler, name, on_lost=self._lost)
        self._teleop = self._new_teleop()
        self._driver: Listener | None = None
        self._drove_s = -math.inf
        self._blocked = ""  # why the dead-man must be let go first; empty: it need not
        self._watch: Timer | None = None
        self._pressed: list[EStopOrder] = []

    # ---------------------------------------------------------------- the line
    def leave(self, listener: Listener) -> None:
        """Take a page's line away; what it drove stops at once."""
        if listener in self.listeners:
            self.listeners.remove(listener)
        if self._driver is listener or not self.listeners:
            self._blocked = ""
            self._let_go()

    def close(self) -> None:
        """Give back the robots, send nothing more."""
        self._let_go()
        self._leases.close()
        self._operator.close()

    def tell(self, kind: str, frame: dict[str, Any]) -> None:
        """Send a frame to this operator's pages."""
        text = frames.encode(frame)
        for listener in tuple(self.listeners):
            listener.put(kind, text)

    # ---------------------------------------------------------------- what a page asks for
    def handle(self, command: frames.Command, listener: Listener) -> Answer:
        """Carry out a frame that came by `listener`."""
        ref = command.ref
        if isinstance(command, frames.Ping):
            return Answer(ref=ref)
        if self._place.read_only:
            return Answer(ref=ref, ok=False, reason=READ_ONLY)
        match command:
            case frames.Drive():
                reason = self._drive(command, listener)
            case frames.Release():
                if self._driver in (None, listener):  # else another window of theirs drives
                    self._blocked = ""
                    self._let_go()
                reason = ""
            case frames.Lease():
                reason = self._lease(command)
            case frames.Request():
                return self._request(command)
            case _:
                return self._halt(command)
        return Answer(ref=ref, ok=not reason, reason=reason)

    def _request(self, command: frames.Request) -> Answer:
        held = False

        def receive(status: RequestStatus) -> None:
            nonlocal held
            # Authority comes with what the core has accepted: a refused request shall hold no robot.
            if command.robots and not held and status.phase in ("accepted", "scheduled", "running"):
                held = True
                self._leases.hold(status.robots)

        asked = self._operator.request(
            command.behaviour, command.robots, command.parameters, receive, take=command.take
        )
        return Answer(ref=command.ref, request_id=asked.request.id)

    def _halt(self, command: frames.Stop | frames.Estop | frames.Clear) -> Answer:
        robots, reason = self._expand(command.robots)
        if reason:
            return Answer(ref=command.ref, ok=False, reason=reason)
        if isinstance(command, frames.Stop):
            self.stopped(robots)
            self._operator.stop(robots)
            return Answer(ref=command.ref)
        engaged = isinstance(command, frames.Estop)
        if engaged:
            self.stopped(robots)
        else:
            self._place.end_presses(robots)
        order = self._operator.estop(
            engaged,
            robots,
            command.reason if isinstance(command, frames.Estop) else "",
            known=self._place.present,
            deadline_s=math.inf if engaged else CLEAR_S,
        )
        self._pressed = [*(each for each in self._pressed if not each.done), order]
        return Answer(ref=command.ref, request_id=order.message.id)

    def end_presses(self, robots: tuple[str, ...]) -> None:
        """Press no e-stop any more that concerns `robots`, none: any: another operator has released them."""
        for order in self._pressed:
            theirs = order.message.robots
            if order.message.engaged and (not robots or not theirs or not set(theirs).isdisjoint(robots)):
                order.close()
        self._pressed = [each for each in self._pressed if not each.message.engaged]

    def stopped(self, robots: tuple[str, ...]) -> None:
        """Note that `robots` (none: all) were stopped: a driver of one must release the dead-man first."""
        mine = self._teleop.robots
        if self._teleop.held and (not robots or not mine or not set(mine).isdisjoint(robots)):
            self._block("stopped while driving")

    def _block(self, why: str) -> None:
        self._blocked = why
        self._teleop.release()

    def _new_teleop(self) -> Teleop:
        def heard(status: RequestStatus) -> None:
            # While it is held: afterwards it is the word on the zeros.
            if status.phase == "refused" and teleop is self._teleop and teleop.held:
                self._block(for_page(status) or "refused without a reason")

        teleop = Teleop(self._operator, self._place.scheduler, on_status=heard)
        return teleop

    # ---------------------------------------------------------------- driving
    def _drive(self, command: frames.Drive, listener: Listener) -> str:
        """Return why not, or nothing."""
        robots, reason = self._expand(command.robots)
        if reason:
            return reason
        world, behaviour = self._place.world, command.behaviour
        if not world.known:
            return "the core has not said yet what behaviours there are"
        if not world.lapses(behaviour):
            return f"{behaviour} does not end by itself when the stick is let go; ask for it instead"
        held = self._leases.held_by_others(robots or self._place.present())
        if held:
            return "; ".join(f"{robot} is held by {operator}" for robot, operator in sorted(held.items()))
        self._drove_s = self._place.scheduler.now_s()
        if self._watch is None:
            self._watch = self._place.scheduler.every(WATCH_S, self._check)
        if self._blocked:
            return f"{self._blocked}: let the dead-man switch go first"
        if self._driver not in (None, listener):
            return "another window of yours drives"
        if self._driver is None or self._teleop.robots != robots:
            if self._teleop.held:
                self._teleop.release()
                self._teleop = self._new_teleop()  # the zeros go on for robots that were let go
            self._teleop.robots = robots
            self._leases.hold(robots)
        self._driver = listener
        self._teleop.hold(behaviour, command.sticks, command.fixed)
        return ""

    def _check(self) -> None:
        if self._place.scheduler.now_s() - self._drove_s >= DEAD_MAN_S:
            self._let_go()

    def _let_go(self) -> None:
        self._driver = None
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None
        if self._teleop.held:
            self._teleop.release()

    # ---------------------------------------------------------------- authority
    def _lease(self, command: frames.Lease) -> str:
        robots, reason = self._expand(command.robots)
        if reason:
            return reason
        if not command.hold:
            self._leases.release(robots or None)
            return ""
        robots = robots or tuple(self._place.present())
        held = self._leases.held_by_others(robots)
        if held and not command.take:
            return "; ".join(f"{robot} is held by {operator}" for robot, operator in sorted(held.items()))
        self._leases.hold(robots, take=command.take)
        return ""

    def _lost(self, robots: tuple[str, ...], operator: str) -> None:
        mine = self._teleop.robots
        if self._teleop.held and (not mine or not set(mine).isdisjoint(robots)):
            self._block(f"{', '.join(robots)} taken over by {operator}")
        self.tell("lost", {"t": "lost", "robots": robots, "by": operator})

    def _expand(self, robots: Iterable[str]) -> tuple[tuple[str, ...], str]:
        """Return the robots with groups written out, or why that cannot be."""
        found: dict[str, None] = {}
        for each in robots:
            if not each.startswith("@"):
                found[each] = None
                continue
            members = self._place.world.group(each[1:])
            if not members:
                hint = did_you_mean(each[1:], self._place.world.shown()["groups"])
                return (), f"no group '{each[1:]}' ({hint})"
            found |= dict.fromkeys(members)
        return tuple(found), ""
