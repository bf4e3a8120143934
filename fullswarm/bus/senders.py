"""Who sent a message, as a partition names processes: a robot's id, core, centralised, operator, world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fullswarm.messages import (
    BehaviourRequest,
    CentralisedCommands,
    CentralisedRequest,
    Command,
    ControlRequest,
    EStop,
    Message,
    ParamChanged,
    ParamReply,
    ParamRequest,
    PoseFix,
    RequestStatus,
    StopRequest,
    Summary,
)

CORE, CENTRALISED, OPERATOR, WORLD = "core", "centralised", "operator", "world"
PROCESSES = (CORE, CENTRALISED, OPERATOR, WORLD)
"""What a process that is not a robot's agent is called."""


def _stopper(order: StopRequest | EStop) -> str:
    """A robot tells of a stop that still holds under its own name, a core under that of its process."""
    if order.robots == (order.source,):
        return order.source
    return CORE if order.source.startswith(f"{CORE}-") else OPERATOR


def _always(name: str) -> Callable[[Any], str]:
    return lambda _: name


_SENDER: dict[type[Message], Callable[[Any], str]] = {
    **dict.fromkeys((BehaviourRequest, ParamRequest), _always(OPERATOR)),
    **dict.fromkeys((RequestStatus, CentralisedRequest, ControlRequest, Command, Summary), _always(CORE)),
    **dict.fromkeys((ParamReply, ParamChanged), _always(CORE)),
    **dict.fromkeys((StopRequest, EStop), _stopper),
    CentralisedCommands: _always(CENTRALISED),
    PoseFix: _always(WORLD),  # motion capture stands where the world does in simulation
}


def sender_of(message: Message) -> str:
    """Return the name of the process that published `message`; empty for a message that does not tell.

    What an agent publishes carries its host or its robot, a heartbeat its node.
    """
    known = _SENDER.get(type(message))
    if known is not None:
        return known(message)
    for field in ("host", "node", "robot"):
        name = getattr(message, field, None)
        if isinstance(name, str):
            return name
    return ""
