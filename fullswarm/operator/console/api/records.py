"""What the operations receive and return, as records: they check what comes, and the OpenAPI document is made of them.

Units are in the names of fields: ``_m``, ``_m_s``, ``_rad``, ``_rad_s``, ``_s``. The frame is east-north-up. What is
unknown is null. Texts are for people, codes for programs.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from fullswarm.messages import DockState, EStopReceipt, MissionProblem, MissionStatus, TeamName, Value
from fullswarm.operator.console.tokens import Role

MOST_ROBOTS = 1024
LONGEST_LEASE_S = 600.0
LONGEST_TTL_S = 1.0
FULL_M_S, FULL_RAD_S = 5.0, 10.0
"""Bounds of a twist; a robot's own limits are lower."""
FASTEST_HZ, SLOWEST_HZ = 20.0, 0.1

RobotId = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,64}$")]
Member = Annotated[str, Meta(pattern="^@?[A-Za-z0-9_-]{1,64}$", description="a robot, or @ and a group")]
Word = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,64}$")]
Members = Annotated[tuple[Member, ...], Meta(max_length=MOST_ROBOTS)]
SomeMembers = Annotated[tuple[Member, ...], Meta(min_length=1, max_length=MOST_ROBOTS)]
Given = Annotated[dict[Word, Value], Meta(max_length=64)]
Speed = Annotated[float, Meta(ge=-FULL_M_S, le=FULL_M_S, description="m/s, forward positive")]
Turn = Annotated[float, Meta(ge=-FULL_RAD_S, le=FULL_RAD_S, description="rad/s, left positive")]
Ttl = Annotated[float, Meta(gt=0.0, le=LONGEST_TTL_S, description="s until the robot is stopped, unless renewed")]


# ---------------------------------------------------------------- received
class LeaseTerms(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Robots to hold, for how long, and what becomes of them when that time ends without being renewed."""

    robots: SomeMembers
    seconds: Annotated[float, Meta(ge=1.0, le=LONGEST_LEASE_S)] = 60.0
    take: bool = False
    """Also take robots over from operators that hold them; not for drivers."""
    stop_at_end: bool = True
    """Stop the robots when the time ends; false: what they do goes on."""


class Released(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Robots to release; none: all that you hold. What they do goes on."""

    robots: Members = ()


class BehaviourOrder(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A behaviour for robots that you hold."""

    behaviour: Word
    robots: SomeMembers
    parameters: Given = {}
    team: TeamName = ""
    """Which robots count as neighbours: request, group, swarm or @group; empty: as the behaviour's record says."""
    roles: Annotated[dict[Word, SomeMembers], Meta(max_length=16)] = {}


class StopOrder(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Robots to stop; none: all. Needs no lease."""

    robots: Members = ()


class EstopOrder(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Robots whose e-stop is to be latched; none: all. Needs no lease."""

    robots: Members = ()
    reason: Annotated[str, Meta(max_length=200)] = ""


class ClearOrder(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Robots whose e-stop is to be released; none: all."""

    robots: Members = ()


class Twist(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Speed and turn rate in the robot's own frame, for a short time."""

    linear_m_s: Speed
    angular_rad_s: Turn = 0.0
    ttl_s: Ttl = 0.3


class ParameterQuery(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which entries of the core's database."""

    key: Annotated[str, Meta(max_length=200, description="a key; * at its end matches any ending")] = "*"


class LogQuery(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How many lines of the log."""

    limit: Annotated[int, Meta(ge=1, le=200, description="the newest lines")] = 50


# ---------------------------------------------------------------- returned
class Reason(msgspec.Struct, frozen=True, kw_only=True):
    """A reason: its code for programs, its text for people; both empty: there is none."""

    code: str = ""
    text: str = ""
    parameters: dict[str, str] = {}


class Pose(msgspec.Struct, frozen=True, kw_only=True):
    """Where a robot is, in the world frame."""

    x_m: float | None
    y_m: float | None
    heading_rad: float | None


class Motion(msgspec.Struct, frozen=True, kw_only=True):
    """How a robot moves now, in its own frame."""

    linear_m_s: float | None
    angular_rad_s: float | None


class Robot(msgspec.Struct, frozen=True, kw_only=True):
    """A robot as last received."""

    robot: str
    age_s: float
    """Since its last message arrived."""
    silent: bool
    pose: Pose
    twist: Motion
    radius_m: float | None
    state: str
    """In words for people."""
    attention: bool
    why: str
    advice: str
    held_by: str
    """The operator that holds it; empty: none."""
    driven_until_s: float | None
    """Seconds that your twist still counts; null: you do not drive it."""
    battery: float | None
    """0 to 1."""
    charging: bool | None
    make: str
    model: str
    lifecycle: str
    """CLOSED, OPEN, READY, ACTIVE or FAULT; empty: no health report yet."""
    moving: bool
    estop: bool
    touching: int
    behaviour: str
    request_id: str
    stop: Reason
    """Why it stands although it has something to do."""
    fault: Reason


class Robots(msgspec.Struct, frozen=True, kw_only=True):
    """All robots by id, and those of the fleet file or addressed by a request that the console has never received."""

    robots: tuple[Robot, ...]
    missing: tuple[str, ...]


class You(msgspec.Struct, frozen=True, kw_only=True):
    """Who calls."""

    operator: str
    role: Role


class SwarmState(msgspec.Struct, frozen=True, kw_only=True):
    """The swarm as a whole."""

    swarm: str
    version: str
    you: You
    hub_connected: bool
    core_age_s: float | None
    """Since the core was last received; null: never."""
    robots: tuple[str, ...]
    silent: tuple[str, ...]
    missing: tuple[str, ...]
    groups: dict[str, tuple[str, ...]]


class Behaviour(msgspec.Struct, frozen=True, kw_only=True):
    """A behaviour that can be requested."""

    behaviour: str
    summary: str
    safety_filter: bool
    available: bool
    """Whether programs may request it: it is behind the safety filter, or does not move robots."""
    parameters: dict[str, Any]
    """A JSON Schema of the request's parameters."""


class Behaviours(msgspec.Struct, frozen=True, kw_only=True):
    """All behaviours by name."""

    behaviours: tuple[Behaviour, ...]


class Missions(msgspec.Struct, frozen=True, kw_only=True):
    """Missions that run or have ended lately."""

    missions: tuple[MissionStatus, ...]


class Box(msgspec.Struct, frozen=True, kw_only=True):
    """A box that the robots know as an obstacle."""

    x_m: float
    y_m: float
    size_x_m: float
    size_y_m: float
    heading_rad: float


class WorldMap(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of the ground."""

    bounds_m: tuple[float, float, float, float] | None
    """x_min, y_min, x_max, y_max."""
    boxes: tuple[Box, ...]
    sensing_radius_m: float | None


class Docks(msgspec.Struct, frozen=True, kw_only=True):
    """Charging docks, and robots that wait for one, the next one first."""

    docks: tuple[DockState, ...]
    waiting: tuple[str, ...]


class Entries(msgspec.Struct, frozen=True, kw_only=True):
    """Entries of the core's database by key."""

    parameters: dict[str, Any]


class LogLine(msgspec.Struct, frozen=True, kw_only=True):
    """A line of the console's log."""

    clock: str
    kind: str
    text: str
    robots: tuple[str, ...]
    request_id: str
    by: str


class Log(msgspec.Struct, frozen=True, kw_only=True):
    """The newest lines of the console's log, the oldest of them first."""

    lines: tuple[LogLine, ...]


class Lease(msgspec.Struct, frozen=True, kw_only=True):
    """A robot that an operator holds."""

    robot: str
    operator: str
    age_s: float
    mine: bool
    ends_in_s: float | None
    """Until your lease ends unless you renew it; null: it is not yours."""


class Leases(msgspec.Struct, frozen=True, kw_only=True):
    """Which operator holds which robots."""

    leases: tuple[Lease, ...]


class Checked(msgspec.Struct, frozen=True, kw_only=True):
    """What the core says of a request that was not sent."""

    accepted: bool
    problems: tuple[MissionProblem, ...]
    latched: tuple[str, ...]
    """Robots whose e-stop is latched: they would refuse."""


class Sent(msgspec.Struct, frozen=True, kw_only=True):
    """A stop that is being sent."""

    robots: tuple[str, ...]
    """None: all."""


class Driven(msgspec.Struct, frozen=True, kw_only=True):
    """A twist that was passed on."""

    robot: str
    ttl_s: float


class Latched(msgspec.Struct, frozen=True, kw_only=True):
    """An e-stop, or its release, with the robots' receipts."""

    engaged: bool
    confirmed: bool
    receipts: tuple[EStopReceipt, ...]
    unconfirmed: tuple[str, ...]
    """Robots that have not confirmed yet; an e-stop is repeated until they do."""


# ---------------------------------------------------------------- frames of the stream
class Hello(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="hello"):
    """The first frame of a client that cannot set the header Authorization."""

    token: Annotated[str, Meta(max_length=512)]


class Subscribe(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="subscribe"
):
    """Which robots' states to send, and how often; a further one replaces it."""

    robots: Members = ()
    """None: all."""
    rate_hz: Annotated[float, Meta(ge=SLOWEST_HZ, le=FASTEST_HZ)] = 5.0


class Twists(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="twists"):
    """Twists for robots that you hold. They end with `ttl_s`, and with the connection."""

    sequence: Annotated[int, Meta(ge=0, le=2**53, description="grows; a frame that is not newer is ignored")]
    twists: Annotated[dict[RobotId, tuple[Speed, Turn]], Meta(min_length=1, max_length=16)]
    """robot → speed and turn rate"""
    ttl_s: Ttl = 0.3


class Release(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="release"):
    """End driving: the robots stop."""


class States(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag="states"):
    """The states of the robots; each has the newest, and none is sent late."""

    sequence: int
    connected: bool
    """Whether the hub answers."""
    robots: tuple[Robot, ...]


class Accepted(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag="accepted"):
    """Twists were passed on."""

    sequence: int


class Refused(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag="refused"):
    """A frame that was not carried out, or not for all robots."""

    status: int
    detail: str
    where: str = ""
    hint: str = ""
    code: str = ""
    sequence: int | None = None


FromClient = Subscribe | Twists | Release
FRAMES: dict[Literal["client", "server"], tuple[type[msgspec.Struct], ...]] = {
    "client": (Hello, Subscribe, Twists, Release),
    "server": (States, Accepted, Refused),
}
