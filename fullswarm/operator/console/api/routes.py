"""The table of all operations: path, what they receive, return and need. Routes and document are made of it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from fullswarm.messages import RequestStatus
from fullswarm.operator.console.api import records
from fullswarm.operator.console.api.access import Right
from fullswarm.operator.console.api.acts import Actor
from fullswarm.operator.console.api.reads import Reader

BASE = "/api/v1"

Record = type[msgspec.Struct]


@dataclass(frozen=True, slots=True)
class Operation:
    """One operation.

    Parameters
    ----------
    name
        Unlike any other's, for programs that are made of the document.
    path
        Below `BASE`; a part in braces is passed on by its name.
    summary
        For people.
    right
        What the caller needs.
    returns
        The record of its answer.
    body, query
        The records of what it receives; None: nothing.
    read, act
        What carries it out: one of them. They get the parts of the path, then body or query.
    status
        Of its answer.
    problems
        Statuses of errors beside those of all operations.
    """

    name: str
    path: str
    summary: str
    right: Right
    returns: Record
    body: Record | None = None
    query: Record | None = None
    read: Callable[..., msgspec.Struct] | None = None
    act: Callable[..., Awaitable[msgspec.Struct]] | None = None
    status: int = 200
    problems: tuple[int, ...] = ()

    @property
    def method(self) -> str:
        """The method of HTTP: reading never changes anything."""
        return "GET" if self.act is None else "POST"

    async def carry_out(self, reader: Reader, actor: Actor, parts: dict[str, str], given: Any) -> msgspec.Struct:
        """Return its answer.

        Raises
        ------
        ProblemError
            It failed.
        """
        more = () if given is None else (given,)
        if self.read is not None:
            return self.read(reader, *parts.values(), *more)
        assert self.act is not None  # noqa: S101  (one of them is set)
        return await self.act(actor, *parts.values(), *more)


def _read(name: str, path: str, summary: str, returns: Record, read: Any, **more: Any) -> Operation:
    return Operation(name, path, summary, "read", returns, read=read, **more)


def _change(name: str, path: str, summary: str, returns: Record, body: Record, act: Any, **more: Any) -> Operation:
    more.setdefault("right", "change")
    return Operation(name, path, summary, returns=returns, body=body, act=act, **more)


OPERATIONS: tuple[Operation, ...] = (
    _read("getSwarm", "/swarm", "The swarm as a whole: who is there, groups, hub and core, and who you are.",
          records.SwarmState, Reader.swarm),
    _read("listRobots", "/robots", "All robots: pose, twist, battery, state with reasons, who holds them.",
          records.Robots, Reader.robots),
    _read("getRobot", "/robots/{robot}", "One robot.", records.Robot, Reader.robot, problems=(404,)),
    _change("driveRobot", "/robots/{robot}/twist",
            "Drive a robot that you hold, behind the safety filter, until the twist's time to live ends.",
            records.Driven, records.Twist, Actor.twist, status=202, problems=(404, 409, 503)),
    _read("listBehaviours", "/behaviours", "The behaviours, each with a JSON Schema of its parameters.",
          records.Behaviours, Reader.behaviours, problems=(503,)),
    _read("getBehaviour", "/behaviours/{behaviour}", "One behaviour.", records.Behaviour, Reader.behaviour,
          problems=(404, 503)),
    _change("requestBehaviour", "/requests", "Have robots that you hold run a behaviour behind the safety filter.",
            RequestStatus, records.BehaviourOrder, Actor.request, status=202, problems=(404, 409, 503)),
    _change("checkRequest", "/requests/check", "Ask the core what it says of a request, without sending it.",
            records.Checked, records.BehaviourOrder, Actor.check, problems=(404, 409, 503)),
    _read("getRequest", "/requests/{request}", "The newest status of a request of yours.", RequestStatus,
          Reader.request, problems=(404,)),
    _read("listLeases", "/leases", "Which operator holds which robots.", records.Leases, Reader.leases),
    _change("takeLease", "/leases", "Hold robots for some seconds, or hold them longer: no other operator moves them.",
            records.Leases, records.LeaseTerms, Actor.lease, problems=(404, 409, 503)),
    _change("releaseLease", "/leases/release", "Release robots that you hold.",
            records.Leases, records.Released, Actor.release, problems=(404, 503)),
    _change("stopRobots", "/stop", "Stop robots, whatever they do; needs no lease.", records.Sent, records.StopOrder,
            Actor.stop, right="stop", status=202, problems=(404, 503)),
    _change("engageEstop", "/estop", "Latch the e-stop of robots; needs no lease. Repeated until they confirm.",
            records.Latched, records.EstopOrder, Actor.estop, right="stop", problems=(404, 503)),
    _change("clearEstop", "/estop/clear", "Release the e-stop of robots: look at them first. Operators only.",
            records.Latched, records.ClearOrder, Actor.clear, right="clear", problems=(404, 409, 503)),
    _read("listMissions", "/missions", "Missions with their steps, and what each waits for.", records.Missions,
          Reader.missions),
    _read("getMap", "/map", "The arena and the boxes in it.", records.WorldMap, Reader.map, problems=(503,)),
    _read("listDocks", "/docks", "Charging docks, and robots that wait for one.", records.Docks, Reader.docks),
    _read("getParameters", "/parameters", "Entries of the core's database.", records.Entries, Reader.parameters,
          query=records.ParameterQuery, problems=(503,)),
    _read("getLog", "/log", "The newest lines of the console's log.", records.Log, Reader.log, query=records.LogQuery),
)  # fmt: skip
"""Order matters for those who read the page; a path without braces goes before one that would match it."""
