"""Every message on the wire: typed, versioned, immutable. SI units, radians, ENU; stamps are monotonic seconds.

Each struct carries its name and version in the field ``kind`` (``"Command/1"``). A reader refuses an unknown version
or field instead of guessing, and a number that is not finite or beyond any lab's range: the ranges below are checked
while a message is decoded. Stamps order the messages of one sender; the receiver measures ages from the arrival.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

STOP = "stop"
"""The behaviour that enables nothing."""

MOST = 10_000
"""Entries of a list at most: the largest fleet that a file can name."""

Names = Annotated[tuple[str, ...], Meta(max_length=MOST)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
Ordinal = Annotated[int, Meta(ge=-(2**62), le=2**62)]

Stamp = Annotated[float, Meta(ge=-1e10, le=1e10)]  # s
Duration = Annotated[float, Meta(ge=0.0, le=1e10)]  # s
Validity = Annotated[float, Meta(ge=0.0, le=60.0)]  # s that a command or an intent may hold
Metres = Annotated[float, Meta(ge=-1e7, le=1e7)]
Way = Annotated[float, Meta(ge=0.0, le=1e12)]  # m, added up
HalfSize = Annotated[float, Meta(ge=0.0, le=1e5)]  # m
Radius = Annotated[float, Meta(gt=0.0, le=100.0)]  # m
Radians = Annotated[float, Meta(ge=-1e7, le=1e7)]
Speed = Annotated[float, Meta(ge=-1e4, le=1e4)]  # m/s
Turn = Annotated[float, Meta(ge=-1e4, le=1e4)]  # rad/s
Acceleration = Annotated[float, Meta(ge=0.0, le=1e5)]  # m/s²
Sigma = Annotated[float, Meta(ge=0.0, le=1e7)]  # m or rad
KnownSigma = Annotated[float, Meta(ge=-1.0, le=1e7)]  # -1: unknown
Finite = Annotated[float, Meta(ge=-1e300, le=1e300)]

Places = Annotated[tuple[Metres, ...], Meta(max_length=MOST)]
Radii = Annotated[tuple[Radius, ...], Meta(max_length=MOST)]
Angles = Annotated[tuple[Radians, ...], Meta(max_length=MOST)]
Speeds = Annotated[tuple[Speed, ...], Meta(max_length=MOST)]
Turns = Annotated[tuple[Turn, ...], Meta(max_length=MOST)]
Sigmas = Annotated[tuple[Sigma, ...], Meta(max_length=MOST)]
Accelerations = Annotated[tuple[Acceleration, ...], Meta(max_length=MOST)]
Changes = Annotated[tuple[Finite, ...], Meta(max_length=MOST)]  # m/s
Place = tuple[Metres, Metres, Radians]
Box = tuple[Metres, Metres, HalfSize, HalfSize, Radians, HalfSize]

MOST_RAYS, MOST_SENSORS = 2048, 16
"""Rays of a scan, and range sensors of a robot whose scans are shown, at most."""

Value = (
    bool
    | int
    | float
    | str
    | Annotated[list[float | Annotated[list[float], Meta(max_length=MOST)]], Meta(max_length=MOST)]
)
"""A behaviour parameter: flag, number, word, point ``[x, y]`` or list of points.

Its numbers may be anything: the process that carries requests out refuses them, with a reason for the sender.
"""
Parameters = Annotated[dict[str, Value], Meta(max_length=256)]
About = Annotated[dict[str, str], Meta(max_length=MOST)]
"""What a reason is about, by name; see :mod:`fullswarm.reasons`."""

LARGEST = 1e15
"""Of what is measured; a sum of many such numbers is finite."""

Team = Annotated[int, Meta(ge=0, le=0xFFFFFFFF)]
"""Number of a team: robots whose laws count each other as neighbours, of one request or group; 0: of no team."""
Teams = Annotated[tuple[Team, ...], Meta(max_length=MOST)]
AWAY = 0xFFFFFFFF
"""The team of robots whose task is interrupted: no control law counts them; the safety filter does."""

ShortText = Annotated[str, Meta(max_length=64)]
Capabilities = Annotated[tuple[ShortText, ...], Meta(max_length=64)]
Roles = Annotated[dict[ShortText, Names], Meta(max_length=64)]
TeamName = Annotated[str, Meta(max_length=65)]

Phase = Literal["accepted", "scheduled", "running", "superseded", "refused", "ended"]
FINAL_PHASES: frozenset[Phase] = frozenset({"refused", "superseded", "ended"})


class Message(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind",
              tag=lambda name: f"{name}/1"):  # fmt: skip
    """Base of all messages; a subclass with another version overrides ``tag``.

    ``frozen`` and ``kw_only`` are repeated by each subclass: msgspec does not inherit ``kw_only``.
    """


# ---------------------------------------------------------------- operator <-> core
class Needs(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """What a robot must be and be able to do to take part; zero or empty: anything. Part of requests."""

    capabilities: Capabilities = ()  # all of them
    makes: Capabilities = ()  # one of them
    speed_m_s: Annotated[float, Meta(ge=0.0, le=1e4)] = 0.0  # at least
    turn_rad_s: Annotated[float, Meta(ge=0.0, le=1e4)] = 0.0
    accel_m_s2: Acceleration = 0.0
    radius_m: HalfSize = 0.0  # at most
    battery: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0  # charge, at least


class BehaviourRequest(Message, frozen=True, kw_only=True, tag="BehaviourRequest/4"):
    """An operator requests a behaviour (paper II.B). Repeated until answered; `id` makes it exactly-once."""

    id: str
    behaviour: str
    robots: Names = ()  # empty: the whole swarm; "@name": a group of the core's database
    parameters: Parameters = {}
    team: TeamName = ""  # "request", "group", "swarm" or "@name"; empty: as the record says
    needs: Needs = Needs()  # beside those of the behaviour's record
    roles: Roles = {}  # role → robots, "@group", "+capability"
    source: str = ""  # the requesting process: "cli@host:pid"
    operator: str = ""  # the person, for leases: "anna@lab1"
    take: bool = False  # also take the leases that another operator holds
    clock: str = ""  # the clock of `stamp_s`, see `clock_id`; empty: one that only `source` reads
    stamp_s: Stamp = 0.0  # orders the requests of one operator, and all stops, on one clock; others by arrival


class Result(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a behaviour has ended itself on one robot; part of RequestStatus and RobotHealth."""

    request_id: str
    robot: str
    outcome: Literal["arrived", "failed"]
    text: str = ""  # what its control law says of it


class RequestStatus(Message, frozen=True, kw_only=True, tag="RequestStatus/4"):
    """The status of a request; the newest one for an `id` is valid."""

    request_id: str
    behaviour: str
    phase: Phase
    reason: str = ""  # why it was refused or superseded
    code: str = ""  # of the reason, see `fullswarm.reasons`
    parameters: About = {}  # what the reason is about
    robots: Names = ()  # that are to run it
    running: Names = ()  # that have confirmed it
    missing: Names = ()  # addressed, but not present now; they get it when they join
    refused_by: Names = ()  # that refused it, e.g. with a latched e-stop
    left_out: Names = ()  # meant, but unfit for it: the reason says why
    roles: Annotated[dict[str, ShortText], Meta(max_length=MOST)] = {}  # robot → its role, if it has one
    results: Annotated[tuple[Result, ...], Meta(max_length=MOST)] = ()  # of robots whose behaviour has ended itself
    stamp_s: Stamp = 0.0


class StopRequest(Message, frozen=True, kw_only=True, tag="StopRequest/2"):
    """Stop now. Sent to the robots directly and to the core; needs neither a lease nor an answer."""

    id: str
    robots: Names = ()  # empty: all
    source: str = ""
    clock: str = ""  # as in BehaviourRequest: robots tell the core, which may have missed the stop
    stamp_s: Stamp = 0.0


class LeaseRequest(Message, frozen=True, kw_only=True, tag="LeaseRequest/2"):
    """An operator takes, renews or returns leases of robots. Repeated each second while they are held."""

    operator: str
    robots: Names
    hold: bool  # False: return those that `operator` holds
    take: bool = False  # also leases that another operator holds now
    given_by: str = (
        ""  # with `take`: only leases of this operator, who has handed them over; empty: of whoever holds them
    )


class Lease(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The operator that drives a robot; part of Leases."""

    robot: str
    operator: str
    age_s: Duration  # since it was granted
    taken_from: str = ""  # the former holder, if it was taken over


class Leases(Message, frozen=True, kw_only=True):
    """All leases there are, on change and each second. A robot without one accepts requests of every operator."""

    leases: Annotated[tuple[Lease, ...], Meta(max_length=MOST)]
    core: str = ""  # which core process
    sequence: Ordinal = 0


class KnownRobots(Message, frozen=True, kw_only=True):
    """All robots of the fleet file and those that report without being of it; on change, each second and on query."""

    present: Names  # their agents report
    absent: Names  # they do not: no longer, or not yet
    core: str = ""  # which core process
    sequence: Ordinal = 0


class EStop(Message, frozen=True, kw_only=True, tag="EStop/2"):
    """Engage or release the latched emergency stop. Idempotent; releasing is a separate, deliberate act.

    A robot is released only if it has not received a newer engaged one of the same clock; to engage always counts.
    """

    id: str
    engaged: bool
    robots: Names = ()  # empty: all
    source: str = ""
    reason: str = ""
    clock: str = ""  # as in BehaviourRequest; empty: the order is not dated
    stamp_s: Stamp = 0.0


class EStopReceipt(Message, frozen=True, kw_only=True):
    """A robot confirms an e-stop."""

    id: str
    robot: str
    engaged: bool
    rolled_m: Way = 0.0  # from the order's arrival until standing
    standing: bool = False


class Ping(Message, frozen=True, kw_only=True):
    """Sent back by the robot's agent at once, as its pong; has no other effect."""

    id: str
    robot: str


# ---------------------------------------------------------------- missions
Label = Annotated[str, Meta(max_length=64)]
Text = Annotated[str, Meta(max_length=500)]

MissionOp = Literal["check", "start", "pause", "resume", "abort", "confirm", "show"]
MissionPhase = Literal["running", "paused", "done", "failed", "aborted"]
StepPhase = Literal["waiting", "running", "paused", "done", "failed", "skipped"]


class StepConditions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """When a step of a mission is done; what is empty or None is no condition. Part of MissionStep."""

    when: Literal["all", "any"] = "all"  # of the conditions below
    arrived: Literal["", "all", "any"] = ""  # robots that reported "arrived", or are within `within_m` of their goal
    within_m: HalfSize = 0.0  # 0: the behaviour's arrive_radius_m, or a default
    time_s: Duration | None = None  # since the step began; pauses do not count
    metric: Label = ""  # "coverage.fraction >= 0.8"
    confirm: Text = ""  # what an operator is to confirm


class MissionStep(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """One behaviour of a mission, and when it is over; part of MissionTrack."""

    name: Label
    behaviour: Label = ""  # empty: none, the track waits for the conditions
    robots: Names = ()  # empty: the whole swarm; "@name": a group
    parameters: Parameters = {}
    team: TeamName = ""  # as in BehaviourRequest
    needs: Needs = Needs()
    roles: Roles = {}
    done: StepConditions = StepConditions()
    after: Names = ()  # "track/step" of other tracks that must be done before
    fail_after_s: Duration = 0.0  # 0: it may take any time
    on_failed: Literal["pause", "abort", "continue"] = "pause"
    keep_running: bool = False  # its robots go on after it, until another request


class MissionTrack(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Steps that follow one another; the tracks of a mission run at the same time. Part of MissionPlan."""

    name: Label
    steps: Annotated[tuple[MissionStep, ...], Meta(max_length=256)]


class MissionPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole mission, as its file describes it; part of MissionRequest."""

    name: Label
    tracks: Annotated[tuple[MissionTrack, ...], Meta(max_length=64)]


class MissionRequest(Message, frozen=True, kw_only=True, tag="MissionRequest/2"):
    """An operator checks, starts or controls a mission. Repeated until answered; `id` makes it exactly-once."""

    id: Label
    op: MissionOp
    mission: Label = ""  # its id, or its name if only one has it; empty: the only one that has not ended
    plan: MissionPlan | None = None  # for check and start; the started mission's id is `id`
    track: Label = ""  # for confirm: with `step`; empty: the only one that waits
    step: Label = ""
    source: str = ""
    operator: str = ""
    take: bool = False  # take its robots over from the operators that hold them
    clock: str = ""  # as in BehaviourRequest
    stamp_s: Stamp = 0.0


class MissionProblem(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Something wrong with a plan; part of MissionReply."""

    track: Label
    step: Label
    key: Label  # "behaviour", "robots", "parameters", …
    text: str


class MissionReply(Message, frozen=True, kw_only=True):
    """The core's answer to a MissionRequest."""

    id: str
    ok: bool
    mission: str = ""
    reason: str = ""
    code: str = ""  # of the reason, see `fullswarm.reasons`
    problems: Annotated[tuple[MissionProblem, ...], Meta(max_length=MOST)] = ()


MOST_PLACES, MOST_PLACE_POINTS = 16, 64
"""Places of a step that are shown, and points of a place; a behaviour may have more."""


class StepPlace(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A place on the map that a step of a mission names; part of StepStatus. World frame."""

    parameter: Label  # of the behaviour
    kind: Literal["point", "points", "area", "formation"]  # area: opposite corners or all; formation: one per robot
    points: Annotated[tuple[tuple[Metres, Metres], ...], Meta(max_length=MOST_PLACE_POINTS)]


class StepStatus(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One step of a mission as it is now; part of TrackStatus."""

    name: str
    behaviour: str
    phase: StepPhase
    robots: Names = ()
    elapsed_s: Duration = 0.0
    request_id: str = ""  # of its newest request
    waits_for: Annotated[tuple[str, ...], Meta(max_length=64)] = ()  # conditions that do not hold yet, for people
    confirm: str = ""  # what an operator is to confirm now; empty: nothing
    reason: str = ""  # why it failed or is paused
    places: Annotated[
        tuple[StepPlace, ...], Meta(max_length=MOST_PLACES)
    ] = ()  # on the map, as far as its parameters name some


class TrackStatus(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One track of a mission as it is now; part of MissionStatus."""

    name: str
    steps: Annotated[tuple[StepStatus, ...], Meta(max_length=256)]


class MissionStatus(Message, frozen=True, kw_only=True, tag="MissionStatus/2"):
    """A mission as it is now: on change, and each second until some time after its end."""

    mission: str
    name: str
    phase: MissionPhase
    tracks: Annotated[tuple[TrackStatus, ...], Meta(max_length=64)]
    operator: str = ""  # that started or last resumed it
    reason: str = ""  # why it is paused, failed or aborted
    core: str = ""  # which core process
    sequence: Ordinal = 0
    stamp_s: Stamp = 0.0


# ---------------------------------------------------------------- core -> agents
class ControlRequest(Message, frozen=True, kw_only=True, tag="ControlRequest/5"):
    """Enable or disable one behaviour of one robot (paper II.D); `sequence` grows, an older one is ignored."""

    request_id: str
    robot: str
    behaviour: str
    enable: bool
    parameters: Parameters = {}
    filtered: bool = False  # run the law behind the safety filter (`_bc`)
    law: str = ""  # name of the law; behaviours that differ only by the filter share it
    team: Team = 0  # the robots that the law counts as neighbours; 0: all that are sensed
    peers: Names = ()  # the robots that the law counts as neighbours whatever they run; empty: those of `team`
    members: Names = ()  # all robots of the request, in its order; empty for an intent, which is sent too often
    roles: Annotated[tuple[ShortText, ...], Meta(max_length=MOST)] = ()  # of each of `members`; empty: there are none
    needs: Needs | None = None  # the robot refuses the request if it is not fit
    stays: bool = False  # a neighbour of its request after the behaviour has ended itself, until the next request
    centralised: bool = False  # no law on board: apply Command messages of `request_id`
    survives_core: bool = False  # continue when the core's heartbeat is silent
    expires_s: Validity = 0.0  # > 0: the request is an intent that expires this long after its arrival
    halts: Names | None = None  # stops of this robot that the core knows: it ignores a request made without its newest
    core: str = ""  # which core process; sequences of different processes do not compare
    sequence: Ordinal = 0
    stamp_s: Stamp = 0.0


class ControlAck(Message, frozen=True, kw_only=True, tag="ControlAck/2"):
    """A robot's answer to a ControlRequest."""

    request_id: str
    robot: str
    behaviour: str
    enabled: bool
    accepted: bool
    reason: str = ""
    code: str = ""  # of the reason, see `fullswarm.reasons`
    parameters: About = {}
    core: str = ""
    sequence: Ordinal = 0


ChargePhase = Literal["waiting", "going", "docking", "docked", "leaving", "returning"]


class ChargeOrder(Message, frozen=True, kw_only=True):
    """The core interrupts a robot's task so that it charges, or lets it return; repeated until the robot reports it.

    ``wait``: stand where it is; ``go``: drive to the dock and into it; ``leave``: out of it and back to the task;
    ``cancel``: back to the task, from wherever it is. One `id` is one interruption, which ends once.
    """

    id: ShortText
    robot: str
    op: Literal["wait", "go", "leave", "cancel"]
    dock: ShortText = ""
    x_m: Metres = 0.0  # of a robot that is docked there
    y_m: Metres = 0.0
    heading_rad: Radians = 0.0
    approach_m: HalfSize = 0.0  # so far before it the robot lines up
    means: Literal["pose", "own"] = "pose"
    speed_m_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.1  # on the straight way in and out
    idle: bool = False  # also without a task
    halts: Names = ()  # stops of this robot that the core knows: one that has a newer one ignores the order
    core: str = ""
    stamp_s: Stamp = 0.0


class CentralisedRequest(Message, frozen=True, kw_only=True, tag="CentralisedRequest/2"):
    """A request remapped to a centralised behaviour's node (paper II.C.1)."""

    request_id: str
    behaviour: str
    law: str
    enable: bool
    robots: Names = ()
    parameters: Parameters = {}
    roles: Annotated[dict[str, ShortText], Meta(max_length=MOST)] = {}  # robot → its role, if it has one
    filtered: bool = False
    core: str = ""
    sequence: Ordinal = 0


class CentralisedCommands(Message, frozen=True, kw_only=True):
    """A centralised node's commands for its robots; the request handler distributes them (paper II.C.2)."""

    request_id: str
    behaviour: str
    robots: Names
    linear_m_s: Speeds
    angular_rad_s: Turns
    sequence: Ordinal
    stamp_s: Stamp


class Command(Message, frozen=True, kw_only=True):
    """An explicit twist for one robot; valid for `ttl_s` after its arrival."""

    robot: str
    request_id: str
    linear_m_s: Speed
    angular_rad_s: Turn
    ttl_s: Validity
    sequence: Ordinal
    stamp_s: Stamp


class WorldHold(Message, frozen=True, kw_only=True):
    """Hold the simulated world still, or let it go on. Repeated while it is held; robots' orders pass as always."""

    held: bool
    source: str = ""
    stamp_s: Stamp = 0.0


class DockState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One slot of a dock as the core knows it; part of ChargingStatus."""

    dock: ShortText
    x_m: Metres
    y_m: Metres
    heading_rad: Radians
    approach_m: HalfSize
    robot: str = ""  # that has it, or stands in it
    phase: ChargePhase | Literal["free", "blocked", "failed"] = "free"
    reason: str = ""  # why it is blocked or has failed
    code: str = ""  # of the reason, see `fullswarm.reasons`


class ChargingStatus(Message, frozen=True, kw_only=True):
    """The docks, and the robots that wait for one: on change and every 2 s, from a core whose fleet has docks."""

    docks: Annotated[tuple[DockState, ...], Meta(max_length=MOST)]
    waiting: Names = ()  # robots, in the order in which they get a dock
    core: str = ""  # which core process
    sequence: Ordinal = 0
    stamp_s: Stamp = 0.0


class TruePoses(Message, frozen=True, kw_only=True):
    """Where all bodies of the simulated world truly are: for a simulated camera, never for a robot."""

    robots: Names
    x_m: Places
    y_m: Places
    heading_rad: Angles
    speed_m_s: Speeds
    turn_rad_s: Turns
    stamp_s: Stamp


MOST_MESH = 4096
"""Points of a camera's grid at most."""


class FloorMesh(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a picture lies on the floor: a grid of its points, row by row from the upper left; part of CameraPicture.

    World frame; `x_m` and `y_m` are null for a point that is not on the floor, or too far away.
    """

    columns: Annotated[int, Meta(ge=1, le=256)]  # of cells: there is one point more
    rows: Annotated[int, Meta(ge=1, le=256)]
    x_m: Annotated[tuple[Metres | None, ...], Meta(max_length=MOST_MESH)]
    y_m: Annotated[tuple[Metres | None, ...], Meta(max_length=MOST_MESH)]
    # The camera's own place, x, y and height, to draw on a plane above the floor.
    eye_m: tuple[Metres, Metres, Annotated[float, Meta(gt=0.0, le=1e4)]]
    tops_m: HalfSize  # height of the robots' tags


class CameraPicture(Message, frozen=True, kw_only=True, tag="CameraPicture/2"):
    """What a camera sees, small, with what it has found drawn in; twice a second, for people."""

    camera: ShortText
    jpeg: Annotated[bytes, Meta(max_length=500_000)]
    problem: Text = ""
    mesh: FloorMesh | None = None  # null: it is not known where the camera is
    stamp_s: Stamp = 0.0


class PoseFix(Message, frozen=True, kw_only=True, tag="PoseFix/2"):
    """Where a supervisory process sees a robot: motion capture, a camera, the simulator. World frame.

    ``stamp_s`` is the source's own clock: it orders the fixes of one source and shows how late they are. From π on
    ``heading_sigma_rad`` says that the heading was not seen.
    """

    robot: str
    x_m: Metres
    y_m: Metres
    heading_rad: Radians
    position_sigma_m: Sigma  # standard deviation per axis
    heading_sigma_rad: Sigma
    source: str  # unique per process of the source
    stamp_s: Stamp
    contacts: Count = 0  # bodies and obstacles that the source sees the robot touch now
    covariance_m2: tuple[Finite, Finite, Finite] | None = None  # xx, xy, yy; None: the sigma on both axes
    quality: Annotated[float, Meta(ge=0.0, le=1.0)] = 1.0  # of the detection, as the source judges it
    sensor: ShortText = ""  # what the source is, for people: "camera ceiling"
    marker: ShortText = ""  # by what the robot was recognised: "tag 3"


class RangeFix(Message, frozen=True, kw_only=True):
    """How far a robot is from an anchor of known place, measured by radio. Stamped as a :class:`PoseFix`."""

    robot: str
    anchor: ShortText
    x_m: Metres  # of the anchor, world frame
    y_m: Metres
    up_m: Metres  # of the anchor above the robot's own radio
    distance_m: Annotated[float, Meta(ge=0.0, le=1e5)]
    sigma_m: Sigma
    source: str  # unique per process of the source
    stamp_s: Stamp
    sensor: ShortText = ""


class FixSourceReport(Message, frozen=True, kw_only=True):
    """What a source of pose fixes sees and what it does not, every second."""

    source: str  # as in its fixes, without what follows a slash there
    sensor: ShortText
    problem: Text = ""  # why it gives nothing, or less than it should
    robots: Names = ()
    markers: Annotated[tuple[ShortText, ...], Meta(max_length=MOST)] = ()  # by what each is recognised
    unseen_s: Annotated[tuple[KnownSigma, ...], Meta(max_length=MOST)] = ()  # -1: was never seen
    stamp_s: Stamp = 0.0


class ObjectFix(Message, frozen=True, kw_only=True):
    """Where a source outside sees something that is no robot of the fleet and may move: a person, a cart."""

    object: str
    x_m: Metres
    y_m: Metres
    radius_m: Radius  # of a disc that holds it
    source: str = ""
    stamp_s: Stamp = 0.0


class Heartbeat(Message, frozen=True, kw_only=True):
    """A process of the core or a centralised node is alive; with its active requests."""

    node: str
    process: str  # unique per process start
    sequence: Ordinal
    active: Names = ()  # ids of requests
    stamp_s: Stamp = 0.0


class ClockProbe(Message, frozen=True, kw_only=True):
    """An agent asks for the core's time, every second."""

    host: str
    sent_s: Stamp


class ClockReply(Message, frozen=True, kw_only=True, tag="ClockReply/2"):
    """The core's time, at once: half the round trip ago, as nearly as `host` can tell."""

    host: str
    sent_s: Stamp  # of the probe
    core: str  # which core process
    core_s: Stamp
    wall_s: Stamp = 0.0  # the core's time of day, seconds since 1970


class Version(Message, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """Which messages a process speaks, 1 Hz. Its form never changes, so that processes of any release can read it.

    Later releases may add fields; a reader ignores those that it does not know.
    """

    name: ShortText  # of the process: a robot's id, "core", …
    software: ShortText
    kinds: Annotated[dict[ShortText, Annotated[int, Meta(ge=0, le=2**31)]], Meta(max_length=512)]  # → version
    stamp_s: Stamp = 0.0


# ---------------------------------------------------------------- agents -> all
class RobotStates(Message, frozen=True, kw_only=True, tag="RobotStates/3"):
    """Kinematic states of the robots that one host carries: one on board, all of them in lockstep.

    Columns of equal length. World frame; `speed_m_s` along the heading, negative when reversing.
    """

    host: str
    sequence: Ordinal
    stamp_s: Stamp
    robots: Names
    x_m: Places
    y_m: Places
    heading_rad: Angles
    speed_m_s: Speeds
    turn_rad_s: Turns
    radius_m: Radii
    teams: Teams = ()  # of which each is; 0: of none, and empty: none is of any
    # What each can do; empty: unknown, receivers take the sender's robots for robots like their own.
    speed_limit_m_s: Speeds = ()
    turn_limit_rad_s: Turns = ()
    accel_m_s2: Accelerations = ()
    # By how much a stop from full speed takes longer than the acceleration says, dead time included; empty: by nothing.
    stop_extra_m: Sigmas = ()
    stop_extra_s: Sigmas = ()
    own_frame: bool = False  # the poses count from a place of the robot's own, not from the swarm's origin
    sigma_m: Sigmas = ()  # standard deviation of the position along the worse axis; empty: not stated, counts as none
    sigma_rad: Sigmas = ()  # of the heading
    core: str = ""  # the core process by whose clock `stamp_s` + `offset_s` is; empty: the offset is not known
    offset_s: Stamp = 0.0
    aim_x_m: Places = ()  # where each is driving to next, its own place: nowhere; empty: not stated
    aim_y_m: Places = ()


class Reception(Message, frozen=True, kw_only=True):
    """Whose states a host receives directly, 2 Hz and on change; the core relays what is missing.

    `robots`, `x_m`, `y_m`: the host's own robots and where they are, columns of equal length.
    """

    host: str
    robots: Names
    x_m: Places
    y_m: Places
    received: Names = ()  # hosts
    stamp_s: Stamp = 0.0


class Relayed(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """States of one host as the core received them; part of RelayedStates."""

    states: RobotStates
    age_s: Duration  # since their arrival at the core


class RelayedStates(Message, frozen=True, kw_only=True):
    """States that a host does not receive although its robots need them, 10 Hz, from the core."""

    host: str  # the one that they are for
    relayed: Annotated[tuple[Relayed, ...], Meta(max_length=MOST)]
    sequence: Ordinal = 0
    stamp_s: Stamp = 0.0


MOST_NUMBERS = 8
"""Of one value in a shared table."""
LARGEST_STAMP = 2**53
TABLE_BUCKETS = 8
"""Into which the keys of a shared table are divided; each has a number in its digest."""
SAYS_BYTES = 256
"""Of what one robot broadcasts for its behaviour, at most; a number takes 8 bytes."""
SAYS_HZ = 10.0
"""How often one robot broadcasts for its behaviour, at most."""

Hash = Annotated[int, Meta(ge=0, le=2**32 - 1)]


class TableEntry(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """One entry of a shared table with its Lamport stamp; part of TableUpdate."""

    key: ShortText
    value: Finite | ShortText | Annotated[tuple[Finite, ...], Meta(max_length=MOST_NUMBERS)]
    stamp: Annotated[int, Meta(ge=0, le=LARGEST_STAMP)]
    writer: ShortText  # the robot


class TableUpdate(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is new in one robot's replica of the shared table of a request; part of BehaviourBroadcast."""

    robot: str
    team: Team
    law: str
    entries: Annotated[tuple[TableEntry, ...], Meta(max_length=64)] = ()
    digest: Annotated[tuple[Hash, ...], Meta(max_length=TABLE_BUCKETS)] = ()  # of the replica; empty: not stated


class BroadcastValues(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What control laws broadcast of the robots of one team; part of BehaviourBroadcast.

    `fields`: names and how many numbers each has. `values`: the numbers of the first robot, then of the next one. The
    receiver checks that they fit.
    """

    team: Team
    law: str
    robots: Names
    fields: Annotated[dict[str, Annotated[int, Meta(ge=1, le=SAYS_BYTES // 8)]], Meta(max_length=SAYS_BYTES // 8)]
    values: Annotated[tuple[Finite, ...], Meta(max_length=MOST * SAYS_BYTES // 8)]


class BehaviourBroadcast(Message, frozen=True, kw_only=True):
    """What the behaviours of a host's robots broadcast to their neighbours, at most one per tick and grid cell.

    A robot is in it no more often than its behaviour's rate, `SAYS_HZ` at most.
    """

    host: str
    sequence: Ordinal
    stamp_s: Stamp
    values: Annotated[tuple[BroadcastValues, ...], Meta(max_length=MOST)] = ()
    tables: Annotated[tuple[TableUpdate, ...], Meta(max_length=MOST)] = ()


MEMORY_NUMBERS = 64
"""Of what one robot remembers, at most, in a message."""


class RobotMemory(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the control law of one robot remembers; part of BehaviourMemory."""

    robot: str
    behaviour: str
    request_id: str
    fields: Annotated[
        dict[ShortText, Annotated[tuple[Finite | None, ...], Meta(max_length=MEMORY_NUMBERS)]],
        Meta(max_length=MEMORY_NUMBERS),
    ]  # flags are 0 and 1; None: not finite
    left_out: Count = 0  # numbers beyond `MEMORY_NUMBERS`


class BehaviourMemory(Message, frozen=True, kw_only=True):
    """What control laws remember of the robots of one host, 1 Hz while any does, then once empty: for people."""

    host: str
    robots: Annotated[tuple[RobotMemory, ...], Meta(max_length=MOST)] = ()
    stamp_s: Stamp = 0.0


class RobotActuators(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What was asked of the actuators of one robot, in words for people; part of ActuatorReport."""

    robot: str
    values: Annotated[dict[ShortText, ShortText], Meta(max_length=64)]


class ActuatorReport(Message, frozen=True, kw_only=True):
    """What was asked last of the actuators of a host's robots and taken, 1 Hz once there is any: for people."""

    host: str
    robots: Annotated[tuple[RobotActuators, ...], Meta(max_length=MOST)] = ()
    stamp_s: Stamp = 0.0


class FileReload(Message, frozen=True, kw_only=True):
    """What became in one process of a changed file of a behaviour under development (`up --reload`): for people."""

    host: str
    file: Text  # path on the computer of the process
    problem: Text = ""  # why it does not load, and what ran before goes on; empty: it was loaded


ProcessPhase = Literal["starting", "running", "frozen", "ended", "given_up"]
ProcessEnd = Literal["", "exit", "signal", "frozen"]


class ProcessState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One process that a supervisor keeps running; part of ProcessReport."""

    name: ShortText  # "hub", "core", …, a robot's id
    phase: ProcessPhase
    since_s: Duration = 0.0  # in this phase
    starts: Count = 0
    ended: ProcessEnd = ""  # how it ended last: by itself, by a signal, killed as frozen
    code: Annotated[int, Meta(ge=0, le=2**31)] = 0  # of that end: exit code or number of the signal
    text: Text = ""  # what it wrote last, if it was given up


class ProcessReport(Message, frozen=True, kw_only=True):
    """The processes that one supervisor (`up`, `demo`) keeps running, on change and 2 Hz: for people."""

    host: str  # the computer
    processes: Annotated[tuple[ProcessState, ...], Meta(max_length=MOST)]
    stamp_s: Stamp = 0.0


class Interventions(Message, frozen=True, kw_only=True):
    """What the safety filter changes now, at 5 Hz while it changes anything, then once empty. Columns of equal length.

    Allowed velocity minus desired velocity, world frame; `reasons` names what the filter avoids.
    """

    host: str
    robots: Names = ()
    x_m_s: Changes = ()
    y_m_s: Changes = ()
    reasons: Names = ()
    stamp_s: Stamp = 0.0


Disc = tuple[Count, Metres, Metres, HalfSize]


class RobotProfile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What one robot is and what it can do; part of RobotProfiles."""

    robot: str
    make: str
    model: str
    capabilities: Capabilities = ()  # of its make and of the fleet file, see `Description.capabilities`
    radius_m: Radius
    speed_limit_m_s: Speed
    turn_limit_rad_s: Turn
    accel_m_s2: Acceleration
    battery: Annotated[float, Meta(ge=-1.0, le=100.0)] = -1.0  # 0 to 1, a few hundredths old; -1: unknown


class RobotProfiles(Message, frozen=True, kw_only=True):
    """What the robots of one host are: on change, when asked or robots appear, every 5 s; at most once per second."""

    host: str
    process: str
    robots: Annotated[tuple[RobotProfile, ...], Meta(max_length=MOST)]
    stamp_s: Stamp = 0.0


class ReportQuery(Message, frozen=True, kw_only=True):
    """Asks all processes to publish now what they publish seldom: by an operator or a core that has just started.

    Agents: profiles, health, what control laws remember. Core: leases, docks, summaries. Supervisor: its processes.
    """

    source: str = ""


class SearchedDiscs(Message, frozen=True, kw_only=True):
    """Where silent robots can still be, as far as the robots of one host have looked; 2 Hz while there are any.

    Rows: index of the robot in `robots`, x, y, radius (m) of a disc. A robot's centre is in one of its discs; one
    without a disc is nowhere within the place in which it fell silent.
    """

    host: str
    robots: Names
    discs: Annotated[tuple[Disc, ...], Meta(max_length=MOST)] = ()
    stamp_s: Stamp = 0.0


class SeenObstacles(Message, frozen=True, kw_only=True):
    """Static obstacles that the robots of one host have seen, all of them each time, on change and every 2 s.

    Rows as in ``Reading.obstacles``: centre x, y (m), half sizes x, y (m), yaw (rad), corner radius (m).
    """

    host: str
    rows: Annotated[tuple[Box, ...], Meta(max_length=MOST)]
    stamp_s: Stamp


class GridTiles(Message, frozen=True, kw_only=True):
    """Square tiles of the occupancy grid of one host: what has changed, and in turn all that it knows.

    All hosts of a fleet file lay the same grid over the arena. :mod:`fullswarm.maps.tiles` packs and unpacks the cells.
    """

    host: str
    x_min_m: Metres  # lower left corner of the grid
    y_min_m: Metres
    cell_m: Annotated[float, Meta(gt=0.0, le=1000.0)]
    rows: Count  # of cells
    columns: Count
    tiles: Annotated[tuple[Count, ...], Meta(max_length=64)]  # their numbers, row by row
    cells: Annotated[bytes, Meta(max_length=20_000)]  # two bits each: 0 unknown, 1 free, 2 occupied; deflated
    stamp_s: Stamp


class RangeQuery(Message, frozen=True, kw_only=True):
    """Asks robots for the scans of their range sensors; counts for 3 s, so that whoever looks on repeats it.

    A robot that several ask reports at the highest of their rates, and no scan twice.
    """

    source: ShortText  # unique per asker
    robots: Names = ()  # none: all
    rate_hz: Annotated[float, Meta(gt=0.0, le=20.0)] = 5.0


class SensorScan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The newest scan of one range sensor, as rays at equal angles, counter-clockwise; part of RangeReport.

    `distances` are millimetres in two bytes each, the low one first; 65534: nothing within `max_m`; 65535: not
    measured. :mod:`fullswarm.maps.scans` packs and unpacks them.
    """

    sensor: ShortText  # tells the sensors of a robot apart
    mount: Place  # on the robot: x forward, y left, and where the sensor's own x axis points
    robot_at: Place | None  # pose of the robot when the last ray was measured, world frame; None: not known
    first_rad: Radians  # from the sensor's own x axis
    step_rad: Annotated[float, Meta(ge=0.0, le=7.0)]  # 0: a single ray
    distances: Annotated[bytes, Meta(max_length=2 * MOST_RAYS)]
    max_m: Annotated[float, Meta(gt=0.0, le=1e5)]
    cone_rad: Annotated[float, Meta(ge=0.0, le=7.0)] = 0.0  # each ray's full field of view
    duration_s: Validity = 0.0  # from the first ray to the last
    stamp_s: Stamp  # when the last ray was measured


class RangeReport(Message, frozen=True, kw_only=True):
    """The newest scans of one robot's range sensors, while there is a `RangeQuery` for it."""

    robot: str
    scans: Annotated[tuple[SensorScan, ...], Meta(max_length=MOST_SENSORS)]
    stamp_s: Stamp


class Halt(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The newest stop or e-stop that a robot has carried out, while it has started nothing since; part of RobotHealth.

    A core that was down when the stop was sent learns of it here, before it can request anything of the robot.
    """

    id: str  # of the StopRequest or EStop
    source: str = ""
    estop: bool = False
    stamp_s: Stamp = 0.0  # when it was carried out, on the clock of the report's own `stamp_s`
    clock: str = ""  # of the operator's own stamp, as in the order
    ordered_s: Stamp = 0.0  # that stamp


class RobotCharge(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How far a robot is whose task is interrupted so that it charges; part of RobotHealth."""

    id: ShortText  # of the ChargeOrder
    dock: ShortText
    phase: ChargePhase
    since_s: Duration = 0.0  # in this phase


class PoseSource(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """One source of pose fixes as a robot uses it; part of a RobotHealth."""

    sensor: ShortText
    marker: ShortText = ""
    age_s: Duration = 0.0  # since its last fix came
    used: bool = False
    residual_m: KnownSigma = -1.0  # mean distance of its last fixes from the pose before them; -1: unknown
    residual_rad: KnownSigma = -1.0
    refused: Text = ""  # why its last fix was not used


class RobotHealth(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The state of one robot; part of a HealthReport."""

    robot: str
    driver: str  # URL
    make: str
    model: str
    firmware: str
    lifecycle: str  # CLOSED OPEN READY ACTIVE FAULT
    behaviour: str = ""  # empty: none
    request_id: str = ""
    core: str = ""  # which core process gave `sequence`
    sequence: Ordinal = 0  # of the control request that it runs; of an idle robot: of the newest that it has answered
    moving: bool = False
    estop: bool = False
    stop_reason: str = ""  # why it stands although a behaviour is enabled
    stop_code: str = ""  # of `stop_reason`, see `fullswarm.reasons`
    stop_parameters: About = {}
    fault: str = ""
    fault_code: str = ""  # of `fault`, if its driver has one for it
    battery: Annotated[float, Meta(ge=-1.0, le=100.0)] = -1.0  # 0 to 1; -1: unknown
    charging: bool | None = None  # current flows into its battery; None: it does not report that
    charge: RobotCharge | None = None  # None: its task is not interrupted
    contacts: Count = 0  # touching now
    collisions: Count = 0  # since the agent started
    pose_source: str = ""  # driver, odometry, fixes
    position_sigma_m: KnownSigma = -1.0  # standard deviation along the worse axis; -1: unknown
    heading_sigma_rad: KnownSigma = -1.0
    pose_note: str = ""  # fixes lost or refused, sources that contradict each other, a pose that jumped
    pose_sources: Annotated[tuple[PoseSource, ...], Meta(max_length=8)] = ()
    command_m_s: Finite = 0.0  # what its driver was commanded last and took, along the heading
    command_rad_s: Finite = 0.0
    deviation_m_s: Finite = 0.0  # present difference between allowed and desired velocity
    deviation_m: Finite = 0.0  # the same added up over time since the agent started
    filter_note: str = ""  # why the safety filter brakes: not merely limits
    message_note: str = ""  # what is wrong with the broadcasts that its behaviour receives
    message_code: str = ""  # of `message_note`, see `fullswarm.reasons`
    result: Result | None = None  # of the newest request, if the behaviour has ended itself
    halt: Halt | None = None  # None: it has started something since the newest stop


class HealthReport(Message, frozen=True, kw_only=True, tag="HealthReport/10"):
    """Health of all robots of one host, 2 Hz and on change, with its loop statistics."""

    host: str
    process: str
    version: str
    robots: Annotated[tuple[RobotHealth, ...], Meta(max_length=MOST)]
    ticks: Count = 0
    late_ticks: Count = 0  # more than 1 ms late
    missed_ticks: Count = 0  # whole periods skipped
    worst_late_s: Duration = 0.0
    dropped: Annotated[dict[ShortText, Count], Meta(max_length=64)] = {}  # messages, by lane or cause, since the start
    wall_offset_s: Stamp | None = None  # the time of day of this computer less the core's; None: not known
    round_trip_s: KnownSigma = -1.0  # to the core and back, the shortest of the last seconds; -1: not known
    stamp_s: Stamp = 0.0


# ---------------------------------------------------------------- performance (paper II.F)
class CoverageMeasurement(Message, frozen=True, kw_only=True):
    """Cells that the host's robots have covered so far, by a disc of the robot's radius.

    `cells` is the zlib-compressed ``numpy.packbits`` of a (rows, columns) grid, row 0 at `origin_y_m`.
    Cumulative, so that a lost message costs nothing.
    """

    host: str
    robots: Names
    origin_x_m: Metres
    origin_y_m: Metres
    cell_m: Annotated[float, Meta(gt=0.0, le=1e5)]
    rows: Count
    columns: Count
    cells: Annotated[bytes, Meta(max_length=1_000_000)]
    stamp_s: Stamp


class RobotMeasurement(Message, frozen=True, kw_only=True):
    """All that is one number per robot, or per host: ``perf/metrics.py`` defines each name.

    Cumulative since the process started or the newest value, so that a lost message costs nothing. A number that is
    not finite, or beyond `LARGEST`: has none.
    """

    host: str
    process: str  # unique per process start: another one has counted from zero again
    robots: Names
    columns: Annotated[dict[str, tuple[float, ...]], Meta(max_length=256)]  # name → one value per robot
    totals: Annotated[dict[str, float], Meta(max_length=256)] = {}  # name → the host's value
    stamp_s: Stamp


Measurement = CoverageMeasurement | RobotMeasurement


class Summary(Message, frozen=True, kw_only=True):
    """A summarizer's result for the whole swarm (paper II.F.2)."""

    metric: str  # work, coverage, collisions, … see `perf/metrics.py`
    values: dict[str, Finite]  # e.g. total_m, mean_m, max_m; truth_total_m: as a supervisory process measured it
    per_robot: dict[str, Finite] = {}
    finished: bool = False
    reason: str = ""  # which termination condition was met
    stamp_s: Stamp = 0.0


# ---------------------------------------------------------------- certificates
Pem = Annotated[str, Meta(max_length=4096)]


class CertificateRequest(Message, frozen=True, kw_only=True):
    """A process asks for a new certificate with its name and key."""

    name: ShortText
    request: Pem  # PKCS #10, signed with its private key


class CertificateReply(Message, frozen=True, kw_only=True):
    """The answer to a CertificateRequest: the newest certificate, or why there is none."""

    name: ShortText
    certificate: Pem = ""  # X.509 in PEM
    refused: Annotated[str, Meta(max_length=256)] = ""


# ---------------------------------------------------------------- local database (paper II.A)
class ParamRequest(Message, frozen=True, kw_only=True):
    """Read or write a layer's local database. `key` may end in ``*`` for get and history."""

    id: str
    op: Literal["get", "set", "history"]
    key: str
    value: Value | dict[str, object] | None = None
    author: str = ""


class ParamEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One value with its author and time."""

    key: str
    value: Value | dict[str, object] | None
    author: str
    changed: Stamp  # wall-clock seconds since 1970


class ParamReply(Message, frozen=True, kw_only=True):
    """The answer to a ParamRequest."""

    id: str
    ok: bool
    reason: str = ""
    entries: tuple[ParamEntry, ...] = ()


class ParamChanged(Message, frozen=True, kw_only=True):
    """A value of a layer's database was changed."""

    layer: str
    entry: ParamEntry


DRIVING: tuple[type[Message], ...] = (
    ControlRequest, ControlAck, CentralisedRequest, CentralisedCommands, Command, StopRequest, EStop, EStopReceipt,
    ChargeOrder, PoseFix, RangeFix, ObjectFix, Heartbeat, ClockProbe, ClockReply, RobotStates, Reception, RelayedStates,
    BehaviourBroadcast, RobotProfiles, SearchedDiscs, SeenObstacles, GridTiles, HealthReport,
)  # fmt: skip
"""What must be of one version in all processes that drive robots; the rest is shown to people."""


def versions() -> dict[str, int]:
    """Return the messages of `DRIVING` with their versions, as :class:`Version` states them."""
    tags = (str(kind.__struct_config__.tag).partition("/") for kind in DRIVING)
    return {name: int(number) for name, _, number in tags}


FITS: dict[type[Message], Callable[[Any], bool]] = {
    CentralisedCommands: lambda m: len(m.robots) == len(m.linear_m_s) == len(m.angular_rad_s),
    RobotStates: lambda m: (
        len(m.robots) == len(m.x_m) == len(m.y_m) == len(m.heading_rad) == len(m.speed_m_s) == len(m.turn_rad_s)
        == len(m.radius_m)
        and {len(m.teams), len(m.sigma_m), len(m.sigma_rad), len(m.aim_x_m), len(m.aim_y_m)} <= {0, len(m.robots)}
        and len(m.stop_extra_m) == len(m.stop_extra_s) in (0, len(m.robots))
        and len(m.aim_x_m) == len(m.aim_y_m)
        and len(m.speed_limit_m_s) == len(m.turn_limit_rad_s) == len(m.accel_m_s2)
        and (not m.accel_m_s2 or len(m.accel_m_s2) == len(m.robots))
    ),
    Reception: lambda m: len(m.robots) == len(m.x_m) == len(m.y_m),
    TruePoses: lambda m: (
        len(m.robots) == len(m.x_m) == len(m.y_m) == len(m.heading_rad) == len(m.speed_m_s) == len(m.turn_rad_s)
    ),
    CameraPicture: lambda m: (
        m.mesh is None or len(m.mesh.x_m) == len(m.mesh.y_m) == (m.mesh.columns + 1) * (m.mesh.rows + 1)
    ),
    FixSourceReport: lambda m: len(m.robots) == len(m.markers) == len(m.unseen_s),
    Interventions: lambda m: len(m.robots) == len(m.x_m_s) == len(m.y_m_s) == len(m.reasons),
}  # fmt: skip
"""Whether a message's columns fit together, written out because states come a thousand times per second."""
