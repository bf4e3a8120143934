"""Authority: who drives which robots (decision 17). A robot without a lease obeys every operator.

Leases are kept in memory only. They expire soon after the last renewal by their holder, repeated each second: so a core
that is started again has them a second later, and an operator who is gone holds nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from fullswarm.bus import Bus
from fullswarm.bus.report_query import ReportsOnQuery
from fullswarm.errors import RequestRefused
from fullswarm.keys import Keys
from fullswarm.messages import Lease, LeaseRequest, Leases
from fullswarm.reasons import Code
from fullswarm.runtime import Scheduler, Timer

EXPIRE_S = 3.0
"""A lease ends this long after its last renewal: two of three renewals may be lost."""
PUBLISH_S = 1.0
CHECK_S = 0.1
LONGEST_NAME = 128
"""A longer name of an operator is refused: it would be sent with each of their leases every second."""
HINT = "to take over: `--take` in a shell, the button in the console"
NAMED = 5
"""Most robots of one holder that a refusal names."""

Expand = Callable[[Sequence[str]], Iterable[str]]


@dataclass(slots=True)
class Held:
    """One robot's lease."""

    operator: str
    granted_s: float
    renewed_s: float
    taken_from: str = ""


class Authority:
    """Grants, renews and ends leases, and publishes them.

    Parameters
    ----------
    process
        Name of this start of the core.
    expand
        Turns the names of a lease request into robots; leaves out unknown ones.
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, process: str, expand: Expand) -> None:
        self._bus, self._keys, self._scheduler = bus, keys, scheduler
        self._process, self._expand = process, expand
        self._held: dict[str, Held] = {}
        self._sequence = 0
        self._expiry: Timer | None = None  # runs only while there are leases
        self._timer = scheduler.every(PUBLISH_S, self.report, first_s=0.0)
        self._on_query = ReportsOnQuery(bus, keys, scheduler, self.report)
        self._subscription = bus.subscribe(keys.lease_request, LeaseRequest, self._requested)

    def holder(self, robot: str) -> str:
        """Return the operator who holds `robot`; empty: none does."""
        held = self._held.get(robot)
        return held.operator if held else ""

    def admit(self, operator: str, robots: Iterable[str], *, take: bool) -> None:
        """Let a request of `operator` pass, which renews their leases; with `take` they get those of others.

        Raises
        ------
        RequestRefused
            Another operator holds one of `robots`, and it is not to be taken: then nothing has changed.
        """
        if not self._held:
            return
        self._drop_expired()
        found = [(robot, self._held[robot]) for robot in robots if robot in self._held]
        others = [(robot, held) for robot, held in found if held.operator != operator]
        if others and not take:
            holders = {robot: held.operator for robot, held in others}
            raise RequestRefused(_who_holds(others), hint=HINT, code=Code.HELD, parameters=holders)
        now_s = self._scheduler.now_s()
        for robot, held in found:
            if held.operator == operator:
                held.renewed_s = now_s
            else:
                self._held[robot] = Held(operator[:LONGEST_NAME], now_s, now_s, held.operator)
        if others:
            self.report()

    def close(self) -> None:
        """Stop granting."""
        self._on_query.close()
        self._subscription.close()
        self._timer.cancel()
        if self._expiry is not None:
            self._expiry.cancel()

    def _requested(self, request: LeaseRequest) -> None:
        if not request.operator or len(request.operator) > LONGEST_NAME:
            return
        self._drop_expired()
        robots = self._expand(request.robots)
        changed = self._grant(request, robots) if request.hold else self._give_back(request.operator, robots)
        if changed:
            self._watch()
            self.report()

    def _grant(self, request: LeaseRequest, robots: Iterable[str]) -> bool:
        now_s, changed = self._scheduler.now_s(), False
        for robot in robots:
            held = self._held.get(robot)
            if held is not None and held.operator == request.operator:
                held.renewed_s = now_s
            elif held is None or (request.take and request.given_by in ("", held.operator)):
                taken_from = held.operator if held else ""
                self._held[robot] = Held(request.operator, now_s, now_s, taken_from)
                changed = True
        return changed

    def _give_back(self, operator: str, robots: Iterable[str]) -> bool:
        given = [robot for robot in robots if self.holder(robot) == operator]
        for robot in given:
            del self._held[robot]
        return bool(given)

    def _drop_expired(self) -> None:
        """End what was not renewed: by its time, not by the time of this check."""
        oldest_s = self._scheduler.now_s() - EXPIRE_S
        expired = [robot for robot, held in self._held.items() if held.renewed_s <= oldest_s]
        for robot in expired:
            del self._held[robot]
        if expired:
            self._watch()
            self.report()

    def _watch(self) -> None:
        """Check for expired leases while there are any."""
        if self._held and self._expiry is None:
            self._expiry = self._scheduler.every(CHECK_S, self._drop_expired)
        elif not self._held and self._expiry is not None:
            self._expiry.cancel()
            self._expiry = None

    def report(self) -> None:
        """Publish the leases."""
        self._sequence += 1
        now_s = self._scheduler.now_s()
        leases = tuple(
            Lease(robot=robot, operator=held.operator, age_s=now_s - held.granted_s, taken_from=held.taken_from)
            for robot, held in self._held.items()
        )
        self._bus.publish(self._keys.leases, Leases(leases=leases, core=self._process, sequence=self._sequence))


def _who_holds(others: Iterable[tuple[str, Held]]) -> str:
    """Name every holder with their robots: ``r3 is held by anna@lab, r4 and r5 are held by bob@lab``."""
    by_holder: dict[str, list[str]] = {}
    for robot, held in others:
        by_holder.setdefault(held.operator, []).append(robot)
    return ", ".join(f"{_names(robots)} held by {operator}" for operator, robots in by_holder.items())


def _names(robots: Sequence[str]) -> str:
    if len(robots) == 1:
        return f"{robots[0]} is"
    if len(robots) > NAMED:
        return f"{', '.join(robots[:NAMED])} and {len(robots) - NAMED} more are"
    return f"{', '.join(robots[:-1])} and {robots[-1]} are"
