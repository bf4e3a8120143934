"""Decides which robots the control laws of a request count as neighbours; the safety filter counts all in any case.

==========  ============================================================================================
request     robots that run the same request (the default)
group       robots of the request's group, whatever they run: the groups that the request names (``@name``) with the
            robots that it names, or else the only group that holds all its robots
@name       robots of that group, whatever they run
swarm       all robots
==========  ============================================================================================

What a request says counts before what the behaviour's record says.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import NamedTuple

from fullswarm.core.behaviours import Record
from fullswarm.core.groups import MARK, Groups
from fullswarm.errors import RequestRefused
from fullswarm.messages import AWAY, BehaviourRequest

REQUEST, GROUP, SWARM = "request", "group", "swarm"


class TeamOf(NamedTuple):
    """The team of a request: its number in the robots' states, and its robots if they count whatever they run."""

    number: int
    peers: tuple[str, ...] = ()


NO_TEAM = TeamOf(0)


def team_of(request: BehaviourRequest, record: Record, robots: Sequence[str], groups: Groups) -> TeamOf:
    """Return the team of a request for `robots`.

    Raises
    ------
    RequestRefused
        Its team is none, or not for this behaviour, or it is not clear which group is meant.
    """
    team = request.team or record.team
    if request.team and record.centralised and team != REQUEST:
        raise RequestRefused(
            f"team '{team}': a centralised behaviour always has the robots of its request as neighbours",
            hint="leave the team out",
        )
    if team == SWARM:
        return NO_TEAM
    if team == REQUEST:
        # Each frame of a stick is a request of its own: its team is all robots that one operator steers with one
        # behaviour.
        frame = record.name, request.source, *request.robots
        return TeamOf(_number(*frame) if record.expires_s > 0.0 else _number(request.id))
    if record.expires_s > 0.0:
        raise RequestRefused(
            f"team '{team}': '{record.name}' is for sticks, whose requests are sent too often to name a group",
            hint=f"{REQUEST} or {SWARM}",
        )
    if team == GROUP:
        named = _named(request, robots, groups)
    elif team.startswith(MARK):
        named = (team,)
    else:
        raise RequestRefused(f"there is no team '{team}'", hint=f"{REQUEST}, {GROUP}, {SWARM} or {MARK}NAME")
    peers = tuple(dict.fromkeys(groups.expand(named)))
    return TeamOf(_number(GROUP, *sorted(named)), peers)


def _named(request: BehaviourRequest, robots: Sequence[str], groups: Groups) -> tuple[str, ...]:
    """Return the group that a request is for, with the robots that it names beside it."""
    if any(each.startswith(MARK) for each in request.robots):
        return request.robots
    holding = groups.holding(robots)
    if len(holding) == 1:
        return (MARK + holding[0],)
    names = ", ".join(MARK + each for each in holding)
    what = f"several groups hold all its robots: {names}" if holding else "no group holds all its robots"
    raise RequestRefused(f"team 'group': {what}", hint=f"name one: team {MARK}NAME")


def _number(*parts: str) -> int:
    number = zlib.crc32(" ".join(parts).encode())
    return 1 if number in (0, AWAY) else number
