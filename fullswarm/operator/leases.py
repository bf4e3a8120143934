"""Holds robots: the operator's side of the leases that the core keeps."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import Lease, LeaseRequest, Leases
from fullswarm.runtime import Scheduler

RENEW_S = 1.0
SETTLE_S = 1.5
"""A report of the core counts as its answer once this much time has passed since the request; an earlier one may have
been sent before it arrived. The core reports each second."""
GROUP = "@"

LossHandler = Callable[[tuple[str, ...], str], None]


@dataclass(slots=True)
class Claim:
    """A robot, or a group, that this operator wants to hold."""

    asked_s: float
    take: bool  # until the core has granted it: the request that takes it over may be lost
    held: bool = False  # as the core reports
    of_group: bool = False  # not named by an operator
    given_by: str = ""  # who has handed it over: taken from this operator only


class LeaseHolder:
    """Renews one operator's leases and reports when one is lost.

    After a loss or a refusal the robot must be requested again, deliberately: nothing is waited for.

    Parameters
    ----------
    name
        The operator's, as in `Operator.name`.
    on_change
        Called with all leases whenever an operator holds what they did not hold before.
    on_lost
        Called with (robots, operator that took them) when another operator took over what was held here: once per loss.
    on_refused
        Called with (robots, operator that holds them) when they were requested in vain.

    Attributes
    ----------
    leases : robot → lease, as last received
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        name: str,
        *,
        on_change: Callable[[dict[str, Lease]], None] | None = None,
        on_lost: LossHandler | None = None,
        on_refused: LossHandler | None = None,
    ) -> None:
        self._bus, self._keys, self._scheduler, self.name = bus, keys, scheduler, name
        self._on_change, self._on_lost, self._on_refused = on_change, on_lost, on_refused
        self.leases: dict[str, Lease] = {}
        self._wanted: dict[str, Claim] = {}
        self._core, self._sequence = "", -1
        self._past: deque[str] = deque(maxlen=8)  # earlier cores: their reports may still be on the way
        self._subscription = bus.subscribe(keys.leases, Leases, self._on_leases)
        self._timer = scheduler.every(RENEW_S, self._renew)

    def held(self) -> tuple[str, ...]:
        """Return the robots that this operator holds, as the core reports."""
        return tuple(robot for robot, lease in self.leases.items() if lease.operator == self.name)

    def wanted(self) -> tuple[str, ...]:
        """Return what this operator holds or has requested, groups as they were named."""
        return tuple(self._wanted)

    @property
    def received(self) -> bool:
        """Whether the core has reported the leases."""
        return self._sequence >= 0

    def held_by_others(self, robots: Iterable[str]) -> dict[str, str]:
        """Return robot → operator for those of `robots` that another operator holds."""
        found = {robot: self.leases[robot].operator for robot in robots if robot in self.leases}
        return {robot: operator for robot, operator in found.items() if operator != self.name}

    def hold(self, robots: Iterable[str], *, take: bool = False, given_by: str = "") -> None:
        """Ask for the leases of `robots` ("@name": of a group) and keep them.

        Parameters
        ----------
        take
            Also from the operators that hold them.
        given_by
            With `take`: only from this operator, who has handed them over.
        """
        robots, now_s = tuple(robots), self._scheduler.now_s()
        for robot in robots:
            claim = self._wanted.get(robot)
            if claim is None or not claim.held:
                self._wanted[robot] = Claim(now_s, take, given_by=given_by)
        if robots:
            self._ask(robots, hold=True, take=take, given_by=given_by)

    def forget(self, robots: Iterable[str]) -> None:
        """Renew the leases of `robots` no longer, without returning them: another operator gets them next."""
        for robot in robots:
            self._wanted.pop(robot, None)

    def release(self, robots: Iterable[str] | None = None) -> None:
        """Release `robots`; None: all. With a group all its robots are released: only the core knows its members."""
        given = tuple(self._wanted) if robots is None else tuple(robots)
        if any(name.startswith(GROUP) for name in given):
            given += tuple(robot for robot, claim in self._wanted.items() if claim.of_group and robot not in given)
        for robot in given:
            self._wanted.pop(robot, None)
        if given:
            self._ask(given, hold=False)

    def close(self) -> None:
        """Release all robots and unsubscribe."""
        self.release()
        self._timer.cancel()
        self._subscription.close()

    def _ask(self, robots: tuple[str, ...], *, hold: bool, take: bool = False, given_by: str = "") -> None:
        request = LeaseRequest(operator=self.name, robots=robots, hold=hold, take=take, given_by=given_by)
        self._bus.publish(self._keys.lease_request, request)

    def _renew(self) -> None:
        wanted: dict[tuple[bool, str], list[str]] = {}
        for robot, claim in self._wanted.items():
            wanted.setdefault((claim.take, claim.given_by), []).append(robot)
        for (take, given_by), robots in wanted.items():
            self._ask(tuple(robots), hold=True, take=take, given_by=given_by)

    def _on_leases(self, message: Leases) -> None:
        restarted = self.received and message.core != self._core
        if self._is_old(message):
            return
        if restarted:  # it has no leases: no other operator may come first by chance
            self._renew()
        before, self.leases = self.leases, {lease.robot: lease for lease in message.leases}
        self._adopt_groups()
        lost, refused = self._compare()
        for notify, found in ((self._on_lost, lost), (self._on_refused, refused)):
            if notify is not None:
                for operator, robots in found.items():
                    notify(tuple(robots), operator)
        changed = {robot: lease.operator for robot, lease in before.items()} != {
            robot: lease.operator for robot, lease in self.leases.items()
        }
        if changed and self._on_change is not None:
            self._on_change(self.leases)

    def _is_old(self, message: Leases) -> bool:
        """Return whether something newer was received before; else note the core in charge."""
        if message.core in self._past or (message.core == self._core and message.sequence <= self._sequence):
            return True
        if message.core != self._core:
            self._past.append(self._core)
        self._core, self._sequence = message.core, message.sequence
        return False

    def _adopt_groups(self) -> None:
        """Claim the robots of a granted group one by one: each can be lost alone, and none is claimed again later."""
        now_s = self._scheduler.now_s()
        groups = {name: claim for name, claim in self._wanted.items() if name.startswith(GROUP)}
        if not groups:
            return
        for robot in self.held():
            self._wanted.setdefault(robot, Claim(now_s, take=False, of_group=True))
        for name, claim in groups.items():
            if now_s - claim.asked_s >= SETTLE_S:
                del self._wanted[name]

    def _compare(self) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
        """Return what was lost and what was refused, by the operator that has it; claim it no more."""
        now_s = self._scheduler.now_s()
        lost: dict[str, list[str]] = {}
        refused: dict[str, list[str]] = {}
        for robot, claim in tuple(self._wanted.items()):
            lease = self.leases.get(robot)
            if lease is None:
                continue  # the core was restarted, or has not received it yet
            if lease.operator == self.name:
                claim.held, claim.take, claim.given_by = True, False, ""
            elif claim.held or now_s - claim.asked_s >= SETTLE_S:
                del self._wanted[robot]
                (lost if claim.held else refused).setdefault(lease.operator, []).append(robot)
        return lost, refused
