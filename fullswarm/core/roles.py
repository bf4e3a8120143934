"""Decides which robots take part in a request, and which role each of them has.

Robots that a request names and that are unfit for it are a reason to refuse it. Of those that it means without naming
them, by a group or by naming none, the unfit ones are left out. A robot of which nothing is known yet counts as fit: it
decides itself when it gets the request (:mod:`fullswarm.fitness`).

A role is given by the request to robots, to groups (``@name``) and to all its robots with a capability (``+name``), in
this order of precedence; a robot without one gets the first role of the behaviour's record for which it has the
capabilities.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from fullswarm.core.behaviours import Record
from fullswarm.core.groups import MARK, Groups
from fullswarm.errors import RequestRefused, did_you_mean
from fullswarm.fitness import ANYTHING, unfit
from fullswarm.keys import ROBOT_ID
from fullswarm.messages import BehaviourRequest, Needs, RobotProfile
from fullswarm.reasons import Code, Reason, joined

CAPABILITY = "+"

Profiles = Callable[[str], RobotProfile | None]


def select(
    request: BehaviourRequest, robots: Sequence[str], needs: Needs, profile: Profiles
) -> tuple[tuple[str, ...], dict[str, Reason]]:
    """Return the robots that take part, and why others that the request means do not.

    Raises
    ------
    RequestRefused
        A robot that the request names is unfit, or all are.
    """
    if needs == ANYTHING:
        return tuple(robots), {}
    known = {robot: found for robot in robots if (found := profile(robot)) is not None}
    left_out = {robot: why for robot, found in known.items() if (why := unfit(needs, found))}
    fit = tuple(robot for robot in robots if robot not in left_out)
    named = {robot: why for robot, why in left_out.items() if robot in request.robots}
    refused = named or (left_out if not fit else {})
    if refused:
        why = joined(refused)
        raise RequestRefused(why.text, code=why.code, parameters=why.parameters)
    return fit, left_out


def roles_of(
    request: BehaviourRequest, record: Record, robots: Sequence[str], groups: Groups, profile: Profiles,
    present: Callable[[str], bool],
) -> dict[str, str]:  # fmt: skip
    """Return the role of each robot of a request that has one.

    Raises
    ------
    RequestRefused
        The behaviour has no such role, a robot has two or lacks the capabilities for its own, or too few or too many
        have a role; or roles depend on capabilities, and a robot that is present has not said yet what it can do.
    """
    if not request.roles and not record.roles:
        return {}
    by_capability = any(terms.needs for terms in record.roles.values()) or any(
        name.startswith(CAPABILITY) for names in request.roles.values() for name in names
    )
    unknown = [robot for robot in robots if by_capability and present(robot) and profile(robot) is None]
    if unknown:
        raise _refusal(f"{', '.join(unknown)}: not known yet what they can do", "request it again in a second")
    able = {robot: _capabilities(profile(robot)) for robot in robots}
    found = _given(request.roles, record, able, groups)
    for robot in robots:
        if robot in found:
            continue
        for role, terms in record.roles.items():
            full = terms.at_most is not None and list(found.values()).count(role) >= terms.at_most
            if not full and able[robot].issuperset(terms.needs):
                found[robot] = role
                break
    _check(found, record, able, profile)
    return {robot: found[robot] for robot in robots if robot in found}


def _given(
    roles: Mapping[str, Sequence[str]], record: Record, able: Mapping[str, frozenset[str]], groups: Groups
) -> dict[str, str]:
    """Return the roles that a request gives: by name first, then by group, then by capability."""
    check_names(roles, record)
    found: dict[str, str] = {}
    for role, names in roles.items():
        for robot in (each for each in names if each[:1] not in (MARK, CAPABILITY)):
            if robot not in able:
                raise _refusal(f"'{robot}' is to be {role}, but is no robot of the request", did_you_mean(robot, able))
            if found.setdefault(robot, role) != role:
                raise _refusal(f"'{robot}' is to be both {found[robot]} and {role}", "a robot has one role")
    for role, names in roles.items():
        for name in (each for each in names if each.startswith(MARK)):
            for robot in (each for each in groups.expand((name,)) if each in able):
                found.setdefault(robot, role)
    for role, names in roles.items():
        for name in (each.removeprefix(CAPABILITY) for each in names if each.startswith(CAPABILITY)):
            for robot in (each for each, capabilities in able.items() if name in capabilities):
                found.setdefault(robot, role)
    return found


def check_names(roles: Iterable[str], record: Record) -> None:
    """Refuse roles that the behaviour does not have.

    Raises
    ------
    RequestRefused
        It has others, or the name cannot be one.
    """
    for role in roles:
        if not ROBOT_ID.match(role):
            raise _refusal(f"'{role}' cannot name a role", "letters, digits, '-' and '_', 64 at most")
        if record.roles and role not in record.roles:
            raise _refusal(f"'{record.name}' has no role '{role}'", did_you_mean(role, record.roles))


def _check(found: Mapping[str, str], record: Record, able: Mapping[str, frozenset[str]], profile: Profiles) -> None:
    for role, terms in record.roles.items():
        robots = [robot for robot, each in found.items() if each == role]
        lacking = [robot for robot in robots if profile(robot) is not None and not able[robot].issuperset(terms.needs)]
        if lacking:
            raise _refusal(f"{', '.join(lacking)} cannot be {role}", f"it needs {', '.join(terms.needs)}")
        if len(robots) < terms.at_least:
            hint = f"name some with --role {role}=..., or add robots with {', '.join(terms.needs) or 'any capability'}"
            raise _refusal(f"{len(robots)} of {terms.at_least} robots needed can be {role}", hint)
        if terms.at_most is not None and len(robots) > terms.at_most:
            raise _refusal(f"{len(robots)} robots are to be {role}", f"{terms.at_most} at most")


def _capabilities(profile: RobotProfile | None) -> frozenset[str]:
    return frozenset() if profile is None else frozenset(profile.capabilities)


def _refusal(what: str, hint: str) -> RequestRefused:
    return RequestRefused(what, hint=hint, code=Code.ROLES)
