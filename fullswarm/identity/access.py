"""Defines who may publish and who may receive each key, and makes the hub's access list of it.

A key on the wire is ``<swarm>/<sender>/<rest>``. A certificate lets its holder publish under its own name only, and
there only the keys that its role may publish. What is not in `TOPICS` is refused: to publish, to receive, to query.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass

from fullswarm.identity.credentials import ROLES, Grant, Role
from fullswarm.keys import ANY, TRUTH
from fullswarm.messages import (
    ActuatorReport,
    BehaviourBroadcast,
    BehaviourMemory,
    BehaviourRequest,
    CameraPicture,
    CentralisedCommands,
    CentralisedRequest,
    CertificateReply,
    CertificateRequest,
    ChargeOrder,
    ChargingStatus,
    ClockProbe,
    ClockReply,
    Command,
    ControlAck,
    ControlRequest,
    CoverageMeasurement,
    EStop,
    EStopReceipt,
    FileReload,
    FixSourceReport,
    GridTiles,
    HealthReport,
    Heartbeat,
    Interventions,
    KnownRobots,
    LeaseRequest,
    Leases,
    Message,
    MissionReply,
    MissionRequest,
    MissionStatus,
    ObjectFix,
    ParamChanged,
    ParamReply,
    ParamRequest,
    Ping,
    PoseFix,
    ProcessReport,
    RangeFix,
    RangeQuery,
    RangeReport,
    Reception,
    RelayedStates,
    ReportQuery,
    RequestStatus,
    RobotMeasurement,
    RobotProfiles,
    RobotStates,
    SearchedDiscs,
    SeenObstacles,
    StopRequest,
    Summary,
    TruePoses,
    Version,
    WorldHold,
)

OWN = "<own>"
"""In place of the chunk in angle brackets: only the holder's own name."""

Rights = dict[Role, str]
"""Role → what the restricted chunk may be: `ANY`, `OWN`, or one name. A role that is missing has no right."""


def _any(*roles: Role) -> Rights:
    return dict.fromkeys(roles, ANY)


def _own(*roles: Role) -> Rights:
    return dict.fromkeys(roles, OWN)


_OWN_ROBOT = _own("robot")
_CLIENTS: tuple[Role, ...] = tuple(role for role in ROLES if role != "hub")
_CORE_BEATS: Rights = {"robot": "core"}
_TRUTH: Rights = {"world": TRUTH}
_CORE = _any("core")
_OPERATORS = _any("operator", "console")
_PEOPLE = _any("operator", "console", "observer")
_NEIGHBOURS = _any("robot", "observer")


@dataclass(frozen=True)
class Topic:
    """The keys of one pattern, and the rights of each role.

    Parameters
    ----------
    key
        After the sender's chunk. ``*`` is one chunk. ``<host>`` is one chunk that the field `host` of the message
        repeats; the first such chunk is the restricted one: `publish` and `receive` say what it may be.
    messages
        Types that are sent there.
    publish, receive
        Which roles may, for which chunk.
    """

    key: str
    messages: tuple[type[Message], ...]
    publish: Rights
    receive: Rights

    @functools.cached_property
    def fields(self) -> tuple[tuple[int, str], ...]:
        """Index of each chunk in angle brackets and the field that repeats it; the restricted one first."""
        chunks = enumerate(self.key.split("/"))
        return tuple((index, chunk[1:-1]) for index, chunk in chunks if chunk.startswith("<"))

    def expression(self, restricted: str = ANY) -> str:
        """Return the key expression with `restricted` in the restricted chunk."""
        chunks = self.key.split("/")
        for number, (index, _) in enumerate(self.fields):
            chunks[index] = ANY if number else restricted
        return "/".join(chunks)


TOPICS: tuple[Topic, ...] = (
    Topic("behaviour/request", (BehaviourRequest,), _OPERATORS | _CORE, _PEOPLE | _CORE),
    Topic("behaviour/status", (RequestStatus,), _CORE, _PEOPLE),
    Topic("behaviour/<behaviour>/control_request", (CentralisedRequest,), _CORE, _any("centralised", "observer")),
    Topic("behaviour/<behaviour>/commands", (CentralisedCommands,), _any("centralised"), _any("core", "observer")),
    Topic(
        "robot/<robot>/behaviour/<behaviour>/control_requests",
        (ControlRequest,),
        _CORE,
        _OWN_ROBOT | _any("observer"),
    ),
    Topic("robot/<robot>/ack", (ControlAck,), _OWN_ROBOT, _any("core", "observer")),
    Topic("robot/<robot>/command", (Command,), _CORE, _OWN_ROBOT | _any("observer")),
    Topic("robot/<robot>/charge", (ChargeOrder,), _CORE, _OWN_ROBOT | _any("observer")),
    Topic("charging/status", (ChargingStatus,), _CORE, _PEOPLE),
    Topic("robot/<robot>/pose_fix", (PoseFix,), _any("source", "world") | _OWN_ROBOT, _OWN_ROBOT | _PEOPLE),
    Topic("robot/<robot>/range_fix", (RangeFix,), _any("source") | _OWN_ROBOT, _OWN_ROBOT | _PEOPLE),
    Topic("fix_source/*", (FixSourceReport,), _any("source", "world", "robot"), _any("robot") | _PEOPLE),
    Topic("object/*", (ObjectFix,), _any("source"), _any("robot") | _PEOPLE),
    Topic("world/hold", (WorldHold,), _OPERATORS, _any("world", "observer")),
    Topic("world/poses", (TruePoses,), _any("world"), _any("source")),
    Topic("camera/*", (CameraPicture,), _any("source"), _PEOPLE),
    Topic("state/*/<host>", (RobotStates,), _OWN_ROBOT, _any("robot", "core", "centralised", "world") | _PEOPLE),
    Topic("broadcast/*/<host>", (BehaviourBroadcast,), _OWN_ROBOT, _NEIGHBOURS),
    Topic("profile/*/<host>", (RobotProfiles,), _OWN_ROBOT, _any("robot", "core", "centralised") | _PEOPLE),
    Topic(
        "report/query",
        (ReportQuery,),
        _OPERATORS | _any("core", "centralised"),
        _any("core", "centralised", "world") | _NEIGHBOURS,
    ),
    Topic("reception/<host>", (Reception,), _OWN_ROBOT, _any("core", "observer")),
    Topic("relay/<host>", (RelayedStates,), _CORE, _OWN_ROBOT | _any("observer")),
    Topic("searched/<host>", (SearchedDiscs,), _OWN_ROBOT, _NEIGHBOURS),
    Topic("obstacles/<host>", (SeenObstacles,), _OWN_ROBOT, _any("robot") | _PEOPLE),
    Topic("grid/<host>", (GridTiles,), _OWN_ROBOT, _any("robot") | _PEOPLE),
    Topic("range/query", (RangeQuery,), _OPERATORS, _NEIGHBOURS),
    Topic("range/report/<robot>", (RangeReport,), _OWN_ROBOT, _PEOPLE),
    Topic("health/<host>", (HealthReport,), _OWN_ROBOT, _any("core", "source") | _PEOPLE),
    Topic(
        "heartbeat/<node>",
        (Heartbeat,),
        _own("core", "centralised", "world"),
        _CORE_BEATS | _CORE | _PEOPLE,
    ),
    Topic("processes/<host>", (ProcessReport,), _CORE, _PEOPLE),
    Topic(
        "version/<name>",
        (Version,),
        _own("robot", "core", "centralised", "world"),
        _any("robot", "core", "centralised", "world") | _PEOPLE,
    ),
    Topic("clock/<host>/probe", (ClockProbe,), _OWN_ROBOT, _any("core", "observer")),
    Topic("clock/<host>/reply", (ClockReply,), _CORE, _OWN_ROBOT | _any("observer")),
    Topic("lease/request", (LeaseRequest,), _OPERATORS, _CORE | _PEOPLE),
    Topic("lease/holders", (Leases,), _CORE, _PEOPLE),
    Topic("roster", (KnownRobots,), _CORE, _PEOPLE),
    Topic("mission/request", (MissionRequest,), _OPERATORS, _any("core", "observer")),
    Topic("mission/reply/<id>", (MissionReply,), _CORE, _PEOPLE),
    Topic("mission/status", (MissionStatus,), _CORE, _PEOPLE),
    Topic("memory/<host>", (BehaviourMemory,), _OWN_ROBOT, _PEOPLE),
    Topic("actuators/<host>", (ActuatorReport,), _OWN_ROBOT, _PEOPLE),
    Topic("reload/<host>", (FileReload,), _own("robot", "core", "centralised"), _PEOPLE),
    Topic("intervention/<host>", (Interventions,), _OWN_ROBOT, _PEOPLE),
    Topic("stop", (StopRequest,), _OPERATORS, _any("robot", "core") | _PEOPLE),
    Topic("estop", (EStop,), _OPERATORS | _CORE, _any("robot", "core") | _PEOPLE),
    Topic("estop/receipt/<robot>", (EStopReceipt,), _OWN_ROBOT, _CORE | _PEOPLE),
    Topic("robot/<robot>/ping", (Ping,), _OPERATORS, _OWN_ROBOT),
    Topic("robot/<robot>/pong", (Ping,), _OWN_ROBOT, _PEOPLE),
    Topic(
        "measurement/*/<host>",
        (CoverageMeasurement, RobotMeasurement),
        _OWN_ROBOT | _TRUTH,
        _CORE | _PEOPLE,
    ),
    Topic("summary/<metric>", (Summary,), _CORE, _CORE | _PEOPLE),
    Topic("identity/<name>/renew", (CertificateRequest,), _own(*_CLIENTS), _CORE),
    Topic("identity/<name>/certificate", (CertificateReply,), _CORE, _own(*_CLIENTS)),
    Topic("params/*/request", (ParamRequest,), _OPERATORS, _CORE),
    Topic("params/*/reply/<id>", (ParamReply,), _CORE, _OPERATORS),
    Topic("params/<layer>/changed", (ParamChanged,), _CORE, _PEOPLE),
)
"""Every key, and who may what. The page docs/explanation-who-may-what.md shows it; a test compares the two."""


def topic_of(rest: str) -> Topic | None:
    """Return the topic of a key without its swarm and sender; None: there is no such key."""
    chunks = rest.split("/")
    for topic in TOPICS:
        pattern = topic.key.split("/")
        if len(pattern) == len(chunks) and all(
            mine in (ANY, its) or mine.startswith("<") for mine, its in zip(pattern, chunks, strict=True)
        ):
            return topic
    return None


# ---------------------------------------------------------------- the hub's access list
ACCESS_KEY = "hub/access"
"""The hub answers queries of this key to every certificate of its list: a client learns that it has been admitted."""


def _publishes(swarm: str, name: str, role: Role) -> list[str]:
    """Return what the holder of a certificate may publish."""
    rights = ((topic, topic.publish.get(role)) for topic in TOPICS)
    return [f"{swarm}/{name}/{topic.expression(name if chunk == OWN else chunk)}" for topic, chunk in rights if chunk]


def _receives(swarm: str, name: str, role: Role) -> list[str]:
    """Return what the holder of a certificate may receive."""
    rights = ((topic, topic.receive.get(role)) for topic in TOPICS)
    return [f"{swarm}/{ANY}/{topic.expression(name if chunk == OWN else chunk)}" for topic, chunk in rights if chunk]


def rules(swarm: str, grants: Iterable[Grant]) -> dict[str, object]:
    """Return zenoh's ``access_control`` for a hub of `swarm` whose valid certificates are `grants`.

    Whatever no rule names is denied: other keys, queries, deletions, liveliness, the hub's administration, and every
    certificate that no grant names.
    """
    listed: list[dict[str, object]] = [
        _rule("common-interest", "egress", ["declare_subscriber"], [f"{swarm}/**"]),
        _rule("common-query", "ingress", ["query"], [ACCESS_KEY]),
        _rule("common-reply", "egress", ["reply"], [ACCESS_KEY]),
    ]
    common = [each["id"] for each in listed]
    subjects: list[dict[str, object]] = []
    policies: list[dict[str, object]] = []
    for grant in grants:
        subject, mine = grant.common_name, list(common)
        subjects.append({"id": subject, "cert_common_names": [grant.common_name]})
        publishes, receives = (each(swarm, grant.name, grant.role) for each in (_publishes, _receives))
        for rule in (
            _rule(f"{subject}-publish", "ingress", ["put"], publishes),
            _rule(f"{subject}-subscribe", "ingress", ["declare_subscriber"], receives),
            _rule(f"{subject}-receive", "egress", ["put"], receives),
        ):
            if rule["key_exprs"]:
                listed.append(rule)
                mine.append(rule["id"])
        policies.append({"rules": mine, "subjects": [subject]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": listed,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, object]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}


# ---------------------------------------------------------------- for people
def table() -> str:
    """Return `TOPICS` as a table in Markdown: a row per key, who may publish it, who may receive it."""
    head = ("| key after `<swarm>/<sender>/` | may publish | may receive |", "|---|---|---|")
    rows = (f"| `{each.key}` | {_words(each.publish)} | {_words(each.receive)} |" for each in TOPICS)
    return "\n".join((*head, *rows))


def _words(rights: Rights) -> str:
    shown = {ANY: "", OWN: " (own)"}
    listed = ((role, rights[role]) for role in ROLES if role in rights)
    return ", ".join(role + shown.get(chunk, f" (`{chunk}`)") for role, chunk in listed)
