"""Operations that change something: leases, requests, twists, stops and e-stops.

Requests and twists need a lease of the caller, and a behaviour behind the safety filter. Stops need neither.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fullswarm.config.mission_file import read_mission
from fullswarm.errors import ConfigError, RequestRefused
from fullswarm.messages import BehaviourRequest, MissionProblem, MissionReply, RequestStatus
from fullswarm.operator.console.api import records
from fullswarm.operator.console.api.access import Access
from fullswarm.operator.console.api.problems import ProblemError, of_error
from fullswarm.operator.console.api.programs import Program, Programs
from fullswarm.operator.console.api.reads import Reader, available
from fullswarm.operator.console.api.twists import BEHAVIOUR
from fullswarm.operator.estop import EStopOrder
from fullswarm.reasons import Code

ANSWER_S = 5.0
"""For the core."""
CONFIRM_S = 2.0
"""For robots to confirm an e-stop; it is repeated after that."""


class Changes:
    """Lets calls wait for what messages of the bus change."""

    def __init__(self) -> None:
        self._waiting: set[asyncio.Future[None]] = set()

    def notify(self) -> None:
        """Have all that wait look again."""
        for future in tuple(self._waiting):
            if not future.done():
                future.set_result(None)

    async def until(self, ready: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until something is the case; return False when it is not in time."""
        try:
            async with asyncio.timeout(timeout_s):
                while not ready():
                    future = asyncio.get_running_loop().create_future()
                    self._waiting.add(future)
                    try:
                        await future
                    finally:
                        self._waiting.discard(future)
        except TimeoutError:
            return ready()
        return True


@dataclass(frozen=True, slots=True)
class Actor:
    """What one program may change.

    Parameters
    ----------
    wake
        Called after something was sent: timers may have been set.
    """

    reader: Reader
    program: Program
    programs: Programs
    changes: Changes
    wake: Callable[[], None]

    # ---------------------------------------------------------------- leases
    async def lease(self, terms: records.LeaseTerms) -> records.Leases:
        """Hold robots for some seconds, or hold them longer.

        Raises
        ------
        ProblemError
            409: another operator holds one, and none of those that are new is held; 403: a driver takes none over;
            503: the core does not answer.
        """
        Access.check_role(self.program.admitted, takes=terms.take)
        robots = self.reader.expanded(terms.robots)
        self._check_holders(robots, take=terms.take)
        before = set(self.program.held())
        self.program.hold(robots, terms.seconds, take=terms.take, stop_at_end=terms.stop_at_end)
        self.wake()
        new = set(robots) - before

        def settled() -> bool:
            return not new.isdisjoint(self.program.refused) or set(robots) <= set(self.program.held())

        answered = await self.changes.until(settled, ANSWER_S)
        refused = new.intersection(self.program.refused)
        if refused or not answered:
            holders = {robot: self.program.refused[robot] for robot in refused}
            self.program.release(new)
            self.wake()
            raise _held(holders) if holders else no_core()
        return self.reader.leases()

    async def release(self, given: records.Released) -> records.Leases:
        """Release robots; return what is held after that."""
        robots = self.reader.expanded(given.robots) or self.program.asked()
        self.program.release(robots)
        self.wake()
        await self.changes.until(lambda: set(self.program.leases.held()).isdisjoint(robots), 1.0)
        return self.reader.leases()

    def _check_holders(self, robots: tuple[str, ...], *, take: bool) -> None:
        holders = self.reader.gateway.view.snapshot().holders
        others = {
            robot: holders[robot] for robot in robots if holders.get(robot, self.program.name) != self.program.name
        }
        if others and not take:
            raise _held(others)

    def _check_lease(self, robots: tuple[str, ...]) -> None:
        free = sorted(set(robots).difference(self.program.held()))
        if not free:
            return
        self._check_holders(robots, take=False)
        names = ", ".join(free[:20])
        raise ProblemError(
            409, f"you do not hold {names}", where="lease", hint="POST /api/v1/leases first", code="held"
        )

    # ---------------------------------------------------------------- requests
    async def request(self, order: records.BehaviourOrder) -> RequestStatus:
        """Have robots run a behaviour; return the core's first answer.

        Raises
        ------
        ProblemError
            409: a robot is not held, or the core refuses; 403: the behaviour is not behind the safety filter;
            404: there is no such behaviour or robot; 422: parameters are wrong; 503: the core does not answer.
        """
        robots = self._checked(order)
        asked = BehaviourRequest(
            id="", behaviour=order.behaviour, robots=robots, parameters=order.parameters, team=order.team,
            roles=order.roles,
        )  # fmt: skip
        pending = self.program.request(asked)
        self.wake()
        if not await self.changes.until(lambda: pending.status is not None, ANSWER_S) or pending.status is None:
            self.program.withdraw(pending)
            raise no_core()
        if pending.status.phase == "refused":
            raise refused(pending.status)
        return pending.status

    async def check(self, order: records.BehaviourOrder) -> records.Checked:
        """Ask the core what it says of a request, without sending it. Raises as :meth:`request`."""
        robots = self._checked(order)
        problems = await self._problems(order, robots)
        latched = tuple(each.robot for each in self.reader.some_robots(frozenset(robots)) if each.estop)
        return records.Checked(accepted=not problems, problems=problems, latched=latched)

    def _checked(self, order: records.BehaviourOrder) -> tuple[str, ...]:
        """Return the robots of a request that may be sent."""
        self.reader.behaviour(order.behaviour)
        record = self.reader.world.record(order.behaviour) or {}
        if record.get("expires_s"):
            hint = "POST /api/v1/robots/ROBOT/twist, or the stream"
            raise ProblemError(422, f"'{order.behaviour}' is an intent of a stick", where="behaviour", hint=hint)
        if not available(record):
            hint = f"request {order.behaviour}_bc" if self.reader.world.record(f"{order.behaviour}_bc") else ""
            raise ProblemError(403, f"'{order.behaviour}' runs without the safety filter", where="behaviour", hint=hint)
        robots = self.reader.expanded(order.robots)
        self._check_lease(robots)
        return robots

    async def _problems(self, order: records.BehaviourOrder, robots: tuple[str, ...]) -> tuple[MissionProblem, ...]:
        """Have the core check a mission of one step, by the checks of requests."""
        step: dict[str, Any] = {
            "name": "request", "behaviour": order.behaviour, "robots": list(robots), "done": {"time_s": 1.0},
            "parameters": order.parameters,
        }  # fmt: skip
        try:
            plan = read_mission({"name": "check", "steps": [step]}).plan
        except ConfigError as error:
            return (MissionProblem(track="", step="", key="request", text=error.what),)
        replies: list[MissionReply] = []

        def receive(reply: MissionReply) -> None:
            replies.append(reply)
            self.changes.notify()

        pending = self.program.missions.ask("check", receive, plan=plan)
        self.wake()
        if not await self.changes.until(lambda: bool(replies), ANSWER_S):
            self.program.missions.forget(pending)
            raise no_core()
        reply = replies[0]
        if reply.ok or reply.problems:
            return reply.problems
        return (MissionProblem(track="", step="", key="request", text=reply.reason),)

    # ---------------------------------------------------------------- twists
    async def twist(self, robot: str, twist: records.Twist) -> records.Driven:
        """Drive a robot until the twist's time to live ends; raises as :meth:`drive`."""
        self.drive(robot, twist.linear_m_s, twist.angular_rad_s, twist.ttl_s, "http")
        return records.Driven(robot=robot, ttl_s=twist.ttl_s)

    def drive(self, robot: str, linear_m_s: float, angular_rad_s: float, ttl_s: float, owner: object) -> None:
        """Pass a twist on, from the connection `owner`.

        Raises
        ------
        ProblemError
            404: there is no such robot; 409: it is not held, was stopped, or another connection drives it.
        """
        self.reader.expanded((robot,))
        self._check_lease((robot,))
        record = self.reader.world.record(BEHAVIOUR)
        if record is None or not record.get("filtered"):
            hint = "its record is in the core's behaviours"
            raise ProblemError(409, f"there is no '{BEHAVIOUR}' behind the safety filter", where=BEHAVIOUR, hint=hint)
        try:
            self.program.twists.drive(robot, linear_m_s, angular_rad_s, ttl_s, owner)
        except RequestRefused as error:
            raise of_error(error) from None
        self.wake()

    # ---------------------------------------------------------------- stops
    async def stop(self, order: records.StopOrder) -> records.Sent:
        """Stop robots, whatever they do, whichever operator holds them.

        Raises
        ------
        ProblemError
            404: there is no such robot.
        """
        robots = self.reader.expanded(order.robots)
        self.program.stop(robots)
        self.wake()
        return records.Sent(robots=robots)

    async def estop(self, order: records.EstopOrder) -> records.Latched:
        """Latch the e-stop of robots; return the receipts of those that confirm soon.

        Raises
        ------
        ProblemError
            404: there is no such robot; 429: too many different choices of robots are repeated.
        """
        robots = self.reader.expanded(order.robots)
        made = self.program.engage(robots, order.reason)
        if made is None:
            hint = "no robots: all of them, which is never refused"
            raise ProblemError(429, "too many e-stops are repeated", where="robots", hint=hint, retry_s=1.0)
        return await self._confirmed(made)

    async def clear(self, order: records.ClearOrder) -> records.Latched:
        """Release the e-stop of robots; return the receipts.

        Raises
        ------
        ProblemError
            404: there is no such robot; 409: a robot was latched again meanwhile.
        """
        robots = self.reader.expanded(order.robots)
        self.programs.end_estops(robots)
        made = self.program.clear(robots)
        found = await self._confirmed(made)
        if made.overruled_by:
            raise ProblemError(409, f"{made.overruled_by} was latched again", where="estop", code=Code.ESTOP_LATCHED)
        return found

    async def _confirmed(self, order: EStopOrder) -> records.Latched:
        self.wake()
        confirmed = await self.changes.until(lambda: order.confirmed() or bool(order.overruled_by), CONFIRM_S)
        return records.Latched(
            engaged=order.message.engaged,
            confirmed=confirmed and not order.overruled_by,
            receipts=tuple(order.receipts[robot] for robot in sorted(order.receipts)),
            unconfirmed=order.unconfirmed(),
        )


def refused(status: RequestStatus) -> ProblemError:
    """Return the answer for a request that the core refused."""
    number = 422 if status.code == Code.PARAMETERS else 409
    reason = status.reason or "refused without a reason"
    return ProblemError(number, reason, where=status.behaviour, code=status.code)


def no_core() -> ProblemError:
    """Return the answer for a core that is silent."""
    hint = "is it running? see `fullswarm status`; then call again"
    return ProblemError(503, f"the core did not answer within {ANSWER_S:g} s", where="core", hint=hint, retry_s=1.0)


def _held(holders: dict[str, str]) -> ProblemError:
    text = "; ".join(f"{robot} is held by {operator}" for robot, operator in sorted(holders.items())[:20])
    hint = "ask that operator; an operator's token takes over with `take`"
    return ProblemError(409, text, where="lease", hint=hint, code=Code.HELD)
