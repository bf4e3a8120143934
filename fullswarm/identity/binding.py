"""Checks that a message is its sender's: the fields that name a host, robot or operator must match the sender's name.

The hub's access list restricts keys; what a message contains only its receiver can see. The hub guarantees the sender's
chunk of a key only when it is secured. Without certificates the check finds mistakes, not attackers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from fullswarm.identity.access import OWN, Topic, topic_of
from fullswarm.identity.credentials import FIXED, Role
from fullswarm.identity.folder import certificate_name
from fullswarm.keys import ANY
from fullswarm.messages import (
    ActuatorReport,
    BehaviourBroadcast,
    BehaviourMemory,
    BehaviourRequest,
    CoverageMeasurement,
    EStop,
    HealthReport,
    Interventions,
    LeaseRequest,
    Message,
    MissionRequest,
    Reception,
    RobotMeasurement,
    RobotProfiles,
    RobotStates,
)

Check = Callable[[Message], str]
"""Returns why a message does not fit its sender; empty: it does."""


def _health(message: HealthReport) -> Iterable[str]:
    for each in message.robots:
        yield each.robot
        if each.result is not None:
            yield each.result.robot


def _broadcast(message: BehaviourBroadcast) -> Iterable[str]:
    for values in message.values:
        yield from values.robots
    for table in message.tables:
        yield table.robot


ROBOTS: dict[type[Message], Callable[[Any], Iterable[str]]] = {
    RobotStates: lambda m: m.robots,
    Reception: lambda m: m.robots,
    Interventions: lambda m: m.robots,
    CoverageMeasurement: lambda m: m.robots,
    RobotMeasurement: lambda m: m.robots,
    HealthReport: _health,
    RobotProfiles: lambda m: (each.robot for each in m.robots),
    BehaviourMemory: lambda m: (each.robot for each in m.robots),
    ActuatorReport: lambda m: (each.robot for each in m.robots),
    BehaviourBroadcast: _broadcast,
}
"""What a robot's agent reports of robots: each of them must be the sender."""

OPERATORS: frozenset[type[Message]] = frozenset({BehaviourRequest, LeaseRequest, MissionRequest})
"""Types with a field `operator`: a person at a computer, ``anna@lab1``, or empty; must be the sender."""

SPEAKS_FOR_OTHERS: frozenset[str] = frozenset({"core", "console"})
"""Senders that may name any operator: the core in the steps of missions, the console after its own check of tokens."""

MAY_NOT_RELEASE: frozenset[str] = frozenset({"core"})
"""Senders that may engage an e-stop, and never release one: the core repeats orders for robots that come back."""


def roles_of(sender: str) -> tuple[Role, ...]:
    """Return the roles that a sender of this name can have; a receiver does not see certificates."""
    return (sender,) if sender in FIXED else ("robot", "operator", "observer", "source")  # type: ignore[return-value]


def may_publish(topic: Topic, rest: str, sender: str) -> bool:
    """Tell whether one of the sender's possible roles may publish this key of `topic`."""
    restricted = rest.split("/")[topic.fields[0][0]] if topic.fields else ANY
    for role in roles_of(sender):
        allowed = topic.publish.get(role)
        if allowed == ANY or (allowed is not None and restricted == (sender if allowed == OWN else allowed)):
            return True
    return False


def check_of(rest: str, sender: str, *, secured: bool) -> Check | None:
    """Return the check of messages that `sender` publishes on a key; None: all fit. The caller keeps it per key.

    Parameters
    ----------
    rest
        The key without its swarm and its sender.
    sender
        Its name; empty: it states none.
    secured
        The hub guarantees the name: check every field. Otherwise only that what robots report of themselves comes
        from the robot, if the sender states a name at all.
    """
    topic = topic_of(rest)
    is_report = topic is not None and topic.publish.get("robot") == OWN
    if not secured and (not sender or not is_report):
        return None
    if topic is None or not may_publish(topic, rest, sender):
        refusal = f"'{sender}' may not publish '{rest}'"
        return lambda _: refusal
    chunks = rest.split("/")
    fields = tuple((name, chunks[index]) for index, name in topic.fields)
    own = is_report and chunks[topic.fields[0][0]] == sender
    return lambda message: _refusal(message, sender, fields, own)


def _refusal(message: Message, sender: str, fields: tuple[tuple[str, str], ...], own: bool) -> str:
    kind = type(message)
    for name, chunk in fields:
        if getattr(message, name) != chunk:
            return f"{name} is '{getattr(message, name):.64}' in the message and '{chunk}' in its key"
    robots = ROBOTS.get(kind) if own else None
    if robots is not None:
        for robot in robots(message):
            if robot != sender:
                return f"'{sender}' reports the robot '{robot:.64}'"
    if kind in OPERATORS and sender not in SPEAKS_FOR_OTHERS:
        operator: str = message.operator  # type: ignore[attr-defined]
        if operator and sender not in (certificate_name(operator), operator.partition("@")[0]):
            return f"'{sender}' names the operator '{operator:.64}'"
    if isinstance(message, EStop) and not message.engaged and sender in MAY_NOT_RELEASE:
        return f"'{sender}' may not release an e-stop"
    return ""
