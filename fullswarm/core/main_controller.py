"""The main controller (paper II.C.1): looks a request up, refuses or completes it, passes it to the request handler.

Every request gets a status, a refused one too; a repeated one gets its newest status again and nothing else.

A stop may come in three ways: as the message to all, dated as a request, and in the report of a robot that has carried
it out, perhaps while no core was there. Those who keep plans of their own are told before it is carried out, so that a
core that dies in between cannot know a stop that they do not.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
import structlog

from fullswarm.bus import Bus
from fullswarm.core.behaviours import Library, Record
from fullswarm.core.centralised import missing_packages
from fullswarm.core.desired import Order
from fullswarm.core.groups import Groups
from fullswarm.core.leases import Authority
from fullswarm.core.remap import Remapper
from fullswarm.core.request_handler import RequestHandler
from fullswarm.core.request_order import Line, RequestOrder
from fullswarm.core.request_status import StatusBoard
from fullswarm.core.roles import roles_of, select
from fullswarm.core.roster import Roster
from fullswarm.core.teams import NO_TEAM, TeamOf, team_of
from fullswarm.errors import RequestRefused, did_you_mean
from fullswarm.fitness import ANYTHING, both
from fullswarm.keys import Keys
from fullswarm.messages import (
    FINAL_PHASES,
    STOP,
    BehaviourRequest,
    CentralisedRequest,
    EStop,
    Halt,
    Phase,
    RequestStatus,
    StopRequest,
)
from fullswarm.reasons import NONE, Code, Reason, given, joined, reason
from fullswarm.runtime import Scheduler

UNNAMED = "an unnamed operator"
FLOOD = 20
"""Different stops within a second."""
RESENT_S = 2.0
"""An operator repeats a request until it is answered: its last copy comes no later after the answer."""
REPORT_S = 1.0
"""Between two log lines about requests that were sent again."""

log = structlog.get_logger()


class Halted(NamedTuple):
    """A stop or an e-stop, whichever way it came; no `robots`: all.

    `clock` and `ordered_s` are the operator's own clock and time, of a stop that a robot has reported.
    """

    id: str
    robots: tuple[str, ...]
    why: str
    at_s: float
    clock: str = ""
    ordered_s: float = 0.0


class MainController:
    """Turns requests of the operators into orders for the request handler."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        library: Library,
        roster: Roster,
        board: StatusBoard,
        handler: RequestHandler,
        remapper: Remapper,
        groups: Groups,
        authority: Authority,
        request_order: RequestOrder,
        scheduler: Scheduler,
    ) -> None:
        self._groups, self._authority, self._request_order = groups, authority, request_order
        self.library, self._roster, self._board = library, roster, board
        self._handler, self._remapper = handler, remapper
        self._scheduler = scheduler
        self._unnamed = (f"unnamed-{number}" for number in itertools.count(1))
        self._on_stop: list[Callable[[Halted], None]] = []
        self._stops_s: deque[float] = deque(maxlen=FLOOD)
        self._reported_s = -math.inf
        self.version_problem: Callable[[str], Reason] = lambda _: NONE
        """Why the core and a robot cannot work together, see :class:`~fullswarm.bus.versions.VersionWatch`."""
        handler.watch_holders(remapper.narrow)
        handler.watch_halts(self._halted)
        self._subscriptions = [
            bus.subscribe(keys.behaviour_request, BehaviourRequest, self._received),
            bus.subscribe(keys.stop, StopRequest, self._stopped),
            bus.subscribe(keys.estop, EStop, self._emergency),
        ]

    def close(self) -> None:
        """End the subscriptions."""
        for subscription in self._subscriptions:
            subscription.close()

    def watch_stops(self, callback: Callable[[Halted], None]) -> None:
        """Have `callback` called for each stop, and for most of its copies, before it is carried out."""
        self._on_stop.append(callback)

    def knows(self, request_id: str) -> bool:
        """Tell whether a request is held by some robot, or is remembered with its end."""
        return self._handler.holds(request_id) or self._board.get(request_id) is not None

    def check(self, request: BehaviourRequest, robots: Sequence[str]) -> None:
        """Check what a mission will request later.

        Parameters
        ----------
        robots : that `request` means

        Raises
        ------
        RequestRefused
            No such behaviour, one that expires unless it is repeated, or parameters, robots,
            roles or a team that do not fit it.
        """
        record = self.library.get(request.behaviour)
        if record.expires_s > 0.0:
            raise RequestRefused(f"'{request.behaviour}' expires unless it is repeated: it is for sticks")
        _check_packages(record)
        needs = both(self.library.needs(record, request.parameters), request.needs)
        fit, _ = select(request, robots, needs, self._roster.profile)
        self._roles(request, record, fit)
        self.library.resolve(record, request.parameters, fit)
        team_of(request, record, robots, self._groups)

    def _received(self, request: BehaviourRequest) -> None:
        if request.behaviour == STOP and not self.knows(request.id):
            by = request.operator or request.source or UNNAMED
            with contextlib.suppress(RequestRefused):  # `submit` answers that
                self._notify(request.id, self._groups.expand(request.robots), f"stopped by {by}")
        self.submit(request)

    def submit(self, request: BehaviourRequest) -> None:
        """Accept or refuse a request; one that is known gets its newest status again, and nothing else."""
        try:
            if request.behaviour == STOP:
                self._record_stop(request)
            if self.knows(request.id):
                self._report_replay(request)
                self._board.repeat(request.id)
            else:
                self._accept(request)
        except RequestRefused as error:
            text = f"{error.what} ({error.hint})" if error.hint else error.what
            self._refuse(request, given(text, error.code, error.parameters))

    def _report_replay(self, request: BehaviourRequest) -> None:
        """Log a request that ended long ago, once per second: a recorded one is sent again."""
        now_s, status = self._scheduler.now_s(), self._board.get(request.id)
        ended = status is not None and status.phase in FINAL_PHASES and now_s - status.stamp_s > RESENT_S
        if ended and now_s - self._reported_s >= REPORT_S:
            self._reported_s = now_s
            log.warning("request ignored: it has ended, and is sent again", id=request.id, operator=request.operator)

    def _record_stop(self, request: BehaviourRequest | StopRequest | EStop) -> None:
        """Record when a stop or e-stop was sent: what was requested before it must not start robots after it."""
        known = self._roster.known()
        # Robots know no groups: in a stop for all to hear a group is a misspelt name, and no stop is refused for one.
        names = self._groups.expand(request.robots) if isinstance(request, BehaviourRequest) else request.robots
        robots = set(names).intersection(known) if request.robots else known
        self._handler.note_halt(robots, request.id)
        for robot in robots:
            self._request_order.stop(robot, request.id, request.clock or request.source, request.stamp_s)

    def _accept(self, request: BehaviourRequest) -> None:
        if not request.id:
            raise RequestRefused("the request has no id", hint="give each request an id of its own")
        record = self.library.get(request.behaviour)
        robots = self.addressed(request.robots, lenient=record.name == STOP)
        if record.name != STOP:
            for robot in robots:
                if why := self.version_problem(robot):
                    raise RequestRefused(f"{robot}: {why.text}", code=why.code, parameters=why.parameters)
        needs = both(self.library.needs(record, request.parameters), request.needs)
        robots, left_out = select(request, robots, needs, self._roster.profile)
        roles = self._roles(request, record, robots)
        parameters = self.library.resolve(record, request.parameters, robots)
        _check_packages(record)
        if record.name != STOP:  # a stop needs no authority, whichever way it comes
            self._authority.admit(request.operator or request.source or UNNAMED, robots, take=request.take)
        team = team_of(request, record, robots, self._groups)
        overtaken, robots = self._overtaken(request, robots)
        if not robots:
            self._board.publish(_status(request.id, record.name, "superseded", overtaken, request.robots))
            return
        common = _order(request.id, record, _line(request), request.stamp_s, team)
        if needs != ANYTHING:
            common = msgspec.structs.replace(common, needs=needs)
        if not record.centralised and record.expires_s == 0.0:  # what a law asks of its request as a whole
            given_roles = tuple(roles.get(robot, "") for robot in robots) if roles else ()
            common = msgspec.structs.replace(common, members=robots, roles=given_roles)
        orders = dict.fromkeys(robots, common)
        if not record.centralised:  # robots need no parameters of a law that is computed on the base station
            orders = {robot: msgspec.structs.replace(common, parameters=parameters[robot]) for robot in robots}
        if record.centralised:
            self._remapper.start(
                CentralisedRequest(
                    request_id=request.id,
                    behaviour=record.name,
                    law=record.law,
                    enable=True,
                    robots=robots,
                    parameters=parameters[robots[0]],
                    roles={robot: roles[robot] for robot in robots if robot in roles},
                    filtered=record.filtered,
                ),
                lasting=record.expires_s == 0.0,
            )
        why = overtaken or joined(left_out)
        self._handler.submit(orders, why, at_once=record.name == STOP, left_out=tuple(left_out), roles=roles)

    def _roles(self, request: BehaviourRequest, record: Record, robots: Sequence[str]) -> dict[str, str]:
        return roles_of(request, record, robots, self._groups, self._roster.profile, self._roster.is_present)

    def _overtaken(self, request: BehaviourRequest, robots: tuple[str, ...]) -> tuple[Reason, tuple[str, ...]]:
        """Leave out robots with a newer request of the same operator or a newer stop; return why, and the others."""
        line = _line(request)
        found = {robot: self._request_order.note(robot, request.id, line, request.stamp_s) for robot in robots}
        newer = {robot: request_id for robot, request_id in found.items() if request_id}
        if not newer:
            return NONE, robots
        left = tuple(robot for robot in robots if robot not in newer)
        return joined({robot: reason(Code.CAME_FIRST, by=request_id) for robot, request_id in newer.items()}), left

    def addressed(self, robots: Sequence[str], *, lenient: bool = False) -> tuple[str, ...]:
        """Return the robots that a request means; none named: all that are known.

        `lenient` leaves out unknown ones unless all are.
        """
        known = self._roster.known()
        if not known:
            raise RequestRefused("no robot is present", hint="start an agent, or name the robots in the fleet file")
        meant = self._groups.expand(robots)
        unknown = [robot for robot in meant if robot not in known]
        if unknown and not (lenient and len(unknown) < len(meant)):
            names = ", ".join(f"'{robot}'" for robot in unknown)
            plural = "s" if len(unknown) > 1 else ""
            origin = "" if unknown[0] in robots else " in a group"
            raise RequestRefused(f"unknown robot{plural} {names}{origin}", hint=did_you_mean(unknown[0], known))
        return tuple(dict.fromkeys(robot for robot in meant if robot in known)) or known

    def _refuse(self, request: BehaviourRequest, why: Reason) -> None:
        self._board.publish(_status(request.id, request.behaviour, "refused", why, request.robots))

    def _notify(self, stop_id: str, robots: Sequence[str], why: str) -> None:
        self._tell(Halted(stop_id, tuple(robots), why, self._scheduler.now_s()))

    def _tell(self, halted: Halted) -> None:
        for callback in self._on_stop:
            callback(halted)

    def _halted(self, robot: str, halt: Halt, at_s: float) -> None:
        """Carry out a stop that a robot obeys and that no core has received, for this robot."""
        self._handler.note_halt((robot,), halt.id)
        self._request_order.stop(robot, halt.id, halt.clock, halt.ordered_s)
        stop_id = f"{halt.id}@{robot}"  # of its own: other robots may report the same stop
        if self.knows(halt.id) or self.knows(stop_id):
            return
        by = halt.source or UNNAMED
        why = f"e-stop by {by}" if halt.estop else f"stopped by {by}"
        self._tell(Halted(stop_id, (robot,), why, at_s, halt.clock, halt.ordered_s))
        order = self._handler.order_of(robot)
        older = order is not None and order.clock == halt.clock != "" and order.stamp_s < halt.ordered_s
        if older or self._handler.ordered_s(robot) <= at_s:  # not if it was asked for something since
            self._stand(stop_id, (robot,), given("e-stop", Code.ESTOP) if halt.estop else NONE)

    def _stopped(self, request: StopRequest) -> None:
        self._record_stop(request)
        self._notify(request.id, request.robots, f"stopped by {request.source or UNNAMED}")
        self._stand(request.id, request.robots, NONE)

    def _emergency(self, estop: EStop) -> None:
        """Order robots in e-stop to stand: releasing it must not start any."""
        if estop.engaged:
            self._record_stop(estop)
            self._notify(estop.id, estop.robots, f"e-stop by {estop.source or UNNAMED}")
            text = "e-stop" + (f": {estop.reason}" if estop.reason else "")
            self._stand(estop.id, estop.robots, given(text, Code.ESTOP))

    def _flooded(self) -> bool:
        """Tell whether so many stops come that those which change nothing must cost little."""
        now_s = self._scheduler.now_s()
        self._stops_s.append(now_s)
        return len(self._stops_s) == FLOOD and now_s - self._stops_s[0] < 1.0

    def _stand(self, request_id: str, robots: Sequence[str], why: Reason) -> None:
        """Order `robots` to stand, leaving out unknown ones: a stop is never refused for a misspelt name."""
        if not request_id:  # it cannot be distinguished from others, so each one counts
            request_id = next(name for name in self._unnamed if not self.knows(name))
        elif self.knows(request_id):
            self._board.repeat(request_id)
            return
        known = self._roster.known()
        addressed = [robot for robot in dict.fromkeys(robots) if robot in known] if robots else known
        self._handler.note_halt(addressed, request_id)
        if addressed and self._flooded() and all(map(self._handler.stands, addressed)):
            self._board.publish(_status(request_id, STOP, "ended", given("the robots were told to stand before")))
            return
        orders = {robot: Order(request_id=request_id, behaviour=STOP) for robot in addressed}
        if orders:
            self._handler.submit(orders, why, at_once=True)
        else:
            none = "no robot is known" if not robots else f"no robot is named {', '.join(robots)}"
            self._board.publish(_status(request_id, STOP, "ended", given(none)))


def _check_packages(record: Record) -> None:
    if record.centralised and (absent := missing_packages()):
        extra = 'pip install "fullswarm[core]"'
        raise RequestRefused(f"a centralised behaviour needs {', '.join(absent)}", hint=extra)


def _status(request_id: str, behaviour: str, phase: Phase, why: Reason, robots: tuple[str, ...] = ()) -> RequestStatus:
    return RequestStatus(
        request_id=request_id,
        behaviour=behaviour,
        phase=phase,
        reason=why.text,
        code=why.code,
        parameters=dict(why.parameters),
        robots=robots,
    )


def adopted_order(library: Library, remapper: Remapper, request_id: str, behaviour: str) -> Order | None:
    """Return the order for what a robot was found running, as far as it can be known without the request.

    An intent is left to expire. A centralised behaviour needs no parameters on board: its node still has them.
    """
    try:
        record = library.get(behaviour)
    except RequestRefused:
        return None
    if record.expires_s > 0.0:
        return None
    if record.centralised:
        remapper.spare(request_id)
        return _order(request_id, record)
    return Order(request_id=request_id, behaviour=behaviour, adopted=True)


def _line(request: BehaviourRequest) -> Line:
    """Return the operator and the clock whose stamps order this request."""
    return request.operator or request.source, request.clock or request.source


def _order(
    request_id: str,
    record: Record,
    line: Line = ("", ""),
    stamp_s: float = 0.0,
    team: TeamOf = NO_TEAM,
) -> Order:
    """Return what the orders of all robots of a request have in common."""
    return Order(
        request_id=request_id,
        behaviour=record.name,
        law=record.law,
        team=team.number,
        peers=team.peers,
        filtered=record.filtered,
        centralised=record.centralised,
        survives_core=record.survives_core,
        stays=record.finished == "stays",
        expires_s=record.expires_s,
        operator=line[0],
        clock=line[1],
        stamp_s=stamp_s,
    )
