"""Reads what the core says of a request: whether it runs, has ended or was refused, and which error that is."""

from __future__ import annotations

from fullswarm.errors import FullswarmError, RequestRefused, SafetyStop
from fullswarm.messages import FINAL_PHASES, RequestStatus
from fullswarm.reasons import Code, holds


def refusal(status: RequestStatus) -> FullswarmError:
    """Return the error for a request that the core refused, or robots."""
    if status.refused_by:
        latched = holds(status.code, status.parameters, Code.ESTOP_LATCHED)
        kind = SafetyStop if latched else FullswarmError
        return kind(status.reason, where=status.behaviour)
    # The core's reason mostly ends with what to do; two hints would be one too many.
    known = status.reason.endswith(")") or status.code in (Code.UNFIT, Code.TOO_SLOW, Code.ROLES, Code.SEVERAL)
    hint = "" if known else "`fullswarm behaviours` lists the behaviours"
    return RequestRefused(status.reason or "refused without a reason", where=status.behaviour, hint=hint)


def unconfirmed(status: RequestStatus) -> tuple[str, ...]:
    """Return the robots that are present and have not answered yet."""
    answered = {*status.running, *status.refused_by, *status.missing, *(each.robot for each in status.results)}
    return tuple(robot for robot in status.robots if robot not in answered)


def all_arrived(status: RequestStatus) -> bool:
    """Return whether the behaviour has ended itself on each robot by arriving."""
    return {each.robot for each in status.results if each.outcome == "arrived"} == set(status.robots)


def ended(status: RequestStatus) -> bool:
    """Return whether no robot runs the request any more, or will."""
    return status.phase in FINAL_PHASES


def settled(status: RequestStatus) -> bool:
    """Return whether nothing more is to be expected soon."""
    if ended(status):
        return True
    return bool(status.running or status.refused_by or status.results) and not unconfirmed(status)
