"""Every message on the wire: typed, versioned, immutable. SI units, radians, ENU; stamps are monotonic seconds.

Each struct carries its name and version in the field ``kind`` (``"Command/1"``). A reader refuses an unknown version
or field instead of guessing. Stamps order the messages of one sender; the receiver measures ages from the arrival.
"""

from __future__ import annotations

from typing import Literal

import msgspec

Value = bool | int | float | str | list[float | list[float]]
"""A behaviour parameter: flag, number, word, point ``[x, y]`` or list of points."""

Phase = Literal["accepted", "scheduled", "running", "superseded", "refused", "ended"]


class Message(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind",
              tag=lambda name: f"{name}/1"):  # fmt: skip
    """Base of all messages; a subclass with another version overrides ``tag``.

    ``frozen`` and ``kw_only`` are repeated by each subclass: msgspec does not hand ``kw_only`` down.
    """


# ---------------------------------------------------------------- operator <-> core
class BehaviourRequest(Message, frozen=True, kw_only=True, tag="BehaviourRequest/2"):
    """An operator asks for a behaviour (paper II.B). Sent again until answered; `id` makes it exactly-once."""

    id: str
    behaviour: str
    robots: tuple[str, ...] = ()  # empty: the whole swarm; "@name": a group of the core's database
    parameters: dict[str, Value] = {}
    source: str = ""  # which process asks: "cli@host:pid"; its stamps order its requests
    operator: str = ""  # in whose name, for leases: "anna@lab1"
    take: bool = False  # take the robots over from who holds them
    stamp_s: float = 0.0


class RequestStatus(Message, frozen=True, kw_only=True):
    """What became of a request; the newest one for an `id` holds."""

    request_id: str
    behaviour: str
    phase: Phase
    reason: str = ""  # why it was refused or superseded
    robots: tuple[str, ...] = ()  # who shall run it
    running: tuple[str, ...] = ()  # who confirmed
    missing: tuple[str, ...] = ()  # addressed, but not present now; they get it when they join
    refused_by: tuple[str, ...] = ()  # who said no, e.g. latched e-stop
    stamp_s: float = 0.0


class StopRequest(Message, frozen=True, kw_only=True):
    """Stand still now. Goes to the robots directly and to the core; needs neither authority nor an answer."""

    id: str
    robots: tuple[str, ...] = ()  # empty: all
    source: str = ""


class LeaseRequest(Message, frozen=True, kw_only=True):
    """An operator takes, keeps or gives back the authority over robots. Said again each second while it is held."""

    operator: str
    robots: tuple[str, ...]
    hold: bool  # False: give back what `operator` holds of them
    take: bool = False  # also from who holds them now


class Lease(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Who drives a robot; part of Leases."""

    robot: str
    operator: str
    age_s: float  # since it was granted
    taken_from: str = ""  # who held it before and did not give it back


class Leases(Message, frozen=True, kw_only=True):
    """All leases there are, on change and each second. A robot without one obeys every operator."""

    leases: tuple[Lease, ...]
    core: str = ""  # which core process
    sequence: int = 0


class EStop(Message, frozen=True, kw_only=True):
    """Engage or release the latched emergency stop. Idempotent; releasing is a separate, deliberate act."""

    id: str
    engaged: bool
    robots: tuple[str, ...] = ()  # empty: all
    source: str = ""
    reason: str = ""


class EStopReceipt(Message, frozen=True, kw_only=True):
    """A robot confirms an e-stop."""

    id: str
    robot: str
    engaged: bool
    rolled_m: float = 0.0  # from the order's arrival until standing
    standing: bool = False


class Ping(Message, frozen=True, kw_only=True):
    """Sent back by the robot's agent at once, as its pong; nothing else comes of it."""

    id: str
    robot: str


# ---------------------------------------------------------------- core -> agents
class ControlRequest(Message, frozen=True, kw_only=True):
    """Enable or disable one behaviour of one robot (paper II.D); `sequence` grows, an older one is ignored."""

    request_id: str
    robot: str
    behaviour: str
    enable: bool
    parameters: dict[str, Value] = {}
    filtered: bool = False  # run the law behind the safety filter (`_bc`)
    law: str = ""  # name of the law; behaviours that differ only by the filter share it
    centralised: bool = False  # no law on board: obey Command messages of `request_id`
    survives_core: bool = False  # go on when the core's heartbeat is silent
    expires_s: float = 0.0  # > 0: the request is an intent that lapses this long after its arrival
    core: str = ""  # which core process; sequences of different processes do not compare
    sequence: int = 0
    stamp_s: float = 0.0


class ControlAck(Message, frozen=True, kw_only=True):
    """A robot's answer to a ControlRequest."""

    request_id: str
    robot: str
    behaviour: str
    enabled: bool
    accepted: bool
    reason: str = ""
    core: str = ""
    sequence: int = 0


class CentralisedRequest(Message, frozen=True, kw_only=True):
    """A request remapped to a centralised behaviour's node (paper II.C.1)."""

    request_id: str
    behaviour: str
    law: str
    enable: bool
    robots: tuple[str, ...] = ()
    parameters: dict[str, Value] = {}
    filtered: bool = False
    core: str = ""
    sequence: int = 0


class CentralisedCommands(Message, frozen=True, kw_only=True):
    """A centralised node's commands for its robots; the request handler hands them out (paper II.C.2)."""

    request_id: str
    behaviour: str
    robots: tuple[str, ...]
    linear_m_s: tuple[float, ...]
    angular_rad_s: tuple[float, ...]
    sequence: int
    stamp_s: float


class Command(Message, frozen=True, kw_only=True):
    """An explicit twist for one robot; valid for `ttl_s` after its arrival."""

    robot: str
    request_id: str
    linear_m_s: float
    angular_rad_s: float
    ttl_s: float
    sequence: int
    stamp_s: float


class PoseFix(Message, frozen=True, kw_only=True):
    """Where a supervisory process sees a robot: motion capture, a camera, the simulator. World frame.

    ``stamp_s`` is the source's own clock: it orders the fixes of one source and tells how late they are.
    """

    robot: str
    x_m: float
    y_m: float
    heading_rad: float
    position_sigma_m: float  # standard deviation per axis
    heading_sigma_rad: float
    source: str  # unique per process of the source
    stamp_s: float
    contacts: int = 0  # bodies and obstacles that the source sees the robot touch now


class Heartbeat(Message, frozen=True, kw_only=True):
    """A process of the core or a centralised node is alive, and what it has in hand."""

    node: str
    process: str  # unique per process start
    sequence: int
    active: tuple[str, ...] = ()  # request ids in hand
    stamp_s: float = 0.0


# ---------------------------------------------------------------- agents -> everybody
class RobotStates(Message, frozen=True, kw_only=True, tag="RobotStates/2"):
    """Kinematic states of the robots that one host carries: one on board, all of them in lockstep.

    Columns of equal length. World frame; `speed_m_s` along the heading, negative when reversing.
    """

    host: str
    sequence: int
    stamp_s: float
    robots: tuple[str, ...]
    x_m: tuple[float, ...]
    y_m: tuple[float, ...]
    heading_rad: tuple[float, ...]
    speed_m_s: tuple[float, ...]
    turn_rad_s: tuple[float, ...]
    radius_m: tuple[float, ...]
    own_frame: bool = False  # the poses count from a place of the robot's own, not from the swarm's origin


class Interventions(Message, frozen=True, kw_only=True):
    """What the safety filter changes now, 5 Hz while it changes anything, then once empty. Columns of equal length.

    Velocity let through minus velocity wished, world frame; `reasons` says what it keeps clear of.
    """

    host: str
    robots: tuple[str, ...] = ()
    x_m_s: tuple[float, ...] = ()
    y_m_s: tuple[float, ...] = ()
    reasons: tuple[str, ...] = ()
    stamp_s: float = 0.0


class SeenObstacles(Message, frozen=True, kw_only=True):
    """Static obstacles that the robots of one host have seen, all of them each time, on change and every 2 s.

    Rows as in ``Reading.obstacles``: centre x, y (m), half sizes x, y (m), yaw (rad), corner radius (m).
    """

    host: str
    rows: tuple[tuple[float, float, float, float, float, float], ...]
    stamp_s: float


class RobotHealth(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How one robot is; part of a HealthReport."""

    robot: str
    driver: str  # URL
    make: str
    model: str
    firmware: str
    lifecycle: str  # CLOSED OPEN READY ACTIVE FAULT
    behaviour: str = ""  # empty: none
    request_id: str = ""
    core: str = ""  # which core process gave `sequence`
    sequence: int = 0  # of the newest control request obeyed
    moving: bool = False
    estop: bool = False
    stop_reason: str = ""  # why it stands although a behaviour is on
    fault: str = ""
    battery: float = -1.0  # 0 to 1; -1: unknown
    contacts: int = 0  # touching now
    collisions: int = 0  # since the agent started
    pose_source: str = ""  # driver, odometry, fixes
    position_sigma_m: float = -1.0  # standard deviation along the worse axis; -1: unknown
    heading_sigma_rad: float = -1.0
    pose_note: str = ""  # fixes lost or refused, a pose that jumped
    deviation_m_s: float = 0.0  # how far the safety filter holds its velocity from the wished one now
    deviation_m: float = 0.0  # the same added up over time since the agent started
    filter_note: str = ""  # why the safety filter brakes: not merely limits


class HealthReport(Message, frozen=True, kw_only=True):
    """Health of all robots of one host, 2 Hz and on change, with its loop statistics."""

    host: str
    process: str
    version: str
    robots: tuple[RobotHealth, ...]
    ticks: int = 0
    late_ticks: int = 0  # more than 1 ms late
    missed_ticks: int = 0  # whole periods skipped
    worst_late_s: float = 0.0
    stamp_s: float = 0.0


# ---------------------------------------------------------------- performance (paper II.F)
class WorkMeasurement(Message, frozen=True, kw_only=True):
    """Distance travelled per robot since the agent started, in metres."""

    host: str
    robots: tuple[str, ...]
    distance_m: tuple[float, ...]
    stamp_s: float


class CollisionMeasurement(Message, frozen=True, kw_only=True):
    """Contact events per robot since the agent started (a new one after >= 0.25 s without)."""

    host: str
    robots: tuple[str, ...]
    events: tuple[int, ...]
    stamp_s: float


class CoverageMeasurement(Message, frozen=True, kw_only=True):
    """Cells that the host's robots have covered so far, by a disc of the robot's radius.

    `cells` is the zlib-compressed ``numpy.packbits`` of a (rows, columns) grid, row 0 at `origin_y_m`.
    Cumulative, so that a lost message costs nothing.
    """

    host: str
    robots: tuple[str, ...]
    origin_x_m: float
    origin_y_m: float
    cell_m: float
    rows: int
    columns: int
    cells: bytes
    stamp_s: float


class RobotMeasurement(Message, frozen=True, kw_only=True):
    """All that is one number per robot, or per host: what each name means stands in ``perf/metrics.py``.

    Cumulative since the process started or the newest value, so that a lost message costs nothing; NaN: has none.
    """

    host: str
    process: str  # unique per process start: another one has counted from zero again
    robots: tuple[str, ...]
    columns: dict[str, tuple[float, ...]]  # name → one value per robot
    totals: dict[str, float] = {}  # name → the host's value
    stamp_s: float


Measurement = WorkMeasurement | CollisionMeasurement | CoverageMeasurement | RobotMeasurement


class Summary(Message, frozen=True, kw_only=True):
    """A summarizer's result for the whole swarm (paper II.F.2)."""

    metric: str  # work, coverage, collisions, … see `perf/metrics.py`
    values: dict[str, float]  # e.g. total_m, mean_m, max_m; truth_total_m: as a supervisory process saw it
    per_robot: dict[str, float] = {}
    finished: bool = False
    reason: str = ""  # which termination condition was met
    stamp_s: float = 0.0


# ---------------------------------------------------------------- local database (paper II.A)
class ParamRequest(Message, frozen=True, kw_only=True):
    """Read or write a layer's local database. `key` may end in ``*`` for get and history."""

    id: str
    op: Literal["get", "set", "history"]
    key: str
    value: Value | dict[str, object] | None = None
    author: str = ""


class ParamEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One value with where it came from."""

    key: str
    value: Value | dict[str, object] | None
    author: str
    changed: float  # wall-clock seconds since 1970


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
