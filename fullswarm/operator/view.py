"""Collects what a swarm publishes: the newest of everything, with its age."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace

import msgspec

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import (
    ActuatorReport,
    BehaviourMemory,
    ChargingStatus,
    DockState,
    HealthReport,
    Heartbeat,
    KnownRobots,
    Lease,
    Leases,
    ProcessReport,
    ProcessState,
    ReportQuery,
    RequestStatus,
    RobotHealth,
    RobotMemory,
    RobotProfile,
    RobotProfiles,
    RobotStates,
    Summary,
)
from fullswarm.recent import Names, Recent
from fullswarm.runtime import Scheduler

SILENT_S = 0.8
"""A health report and 15 states are missing: the robot, its link or its hub is lost. People read it within a second."""

CHARGING_S = 6.0
"""Docks of an older status are not shown: three in a row were lost, or the core is not there."""
LEASES_S = 3.0
"""The core reports them each second; older ones may have expired. The same holds for which robots it knows."""

ASK_FIRST_S, ASK_S = 0.02, 0.5
"""When all are asked to report, after the subscriptions; then between two queries while profiles are missing."""

MEMORY_S = 3.0
"""What a control law remembers, and what it asks of actuators, is reported each second; older: it has ended."""

STRANGERS, MOST_NODES, MOST_METRICS = 1000, 64, 256
"""Robots that are not expected, hosts, processes with a heartbeat, and metrics that are kept at most."""
PROCESSES_S = 3.0
"""A supervisor reports twice a second; an older report says nothing of now."""

AGAIN_S = 30.0
"""How long a restart is shown."""

Pose = tuple[str, float, float, float, float, float]
"""``(robot, x_m, y_m, heading_rad, speed_m_s, age_s)``: a robot's pose and speed, and the age of its newest message."""

_NO_STATE = (math.nan,) * 6


@dataclass(frozen=True, slots=True)
class RobotRow:
    """One robot as last received; NaN where nothing has been received yet."""

    robot: str
    age_s: float  # since its last message arrived
    x_m: float
    y_m: float
    heading_rad: float
    speed_m_s: float
    health: RobotHealth | None  # None: only its states have been received
    turn_rad_s: float = math.nan
    radius_m: float = math.nan
    host: str = ""  # that carries it; empty: no health report yet
    version: str = ""  # of the software there
    wall_offset_s: float | None = None  # the time of day there less the core's; None: not known
    round_trip_s: float = -1.0  # from there to the core and back; -1: not known
    profile: RobotProfile | None = None  # None: not received yet
    memory: RobotMemory | None = None  # None: its control law remembers nothing
    actuators: Mapping[str, str] = field(default_factory=dict)  # what was asked of each last, in words
    dropped: Mapping[str, int] = field(default_factory=dict)  # messages that its agent has dropped, by lane or cause

    @property
    def silent(self) -> bool:
        """Whether its last message is too old."""
        return self.age_s > SILENT_S


@dataclass(frozen=True, slots=True)
class NodeRow:
    """A process of the core, or a centralised behaviour's node."""

    node: str
    age_s: float
    active: tuple[str, ...]
    process: str = field(default="", compare=False)  # another one: it was started again


@dataclass(frozen=True, slots=True)
class ProcessRow:
    """A process that a supervisor keeps running on `host`."""

    host: str
    age_s: float  # of the report
    state: ProcessState

    @property
    def text(self) -> str:
        """What is wrong with it, or was until lately; empty: nothing."""
        state, since = self.state, f"{self.state.since_s + self.age_s:.0f} s"
        ended = {
            "": "",
            "exit": f"ended with exit code {state.code}",
            "signal": f"was killed by signal {state.code}",
            "frozen": "was frozen and was killed",
        }[state.ended]
        if state.phase == "given_up":
            return f"{state.name} ended and is not started again: {state.text}"
        if state.phase == "frozen":
            return f"{state.name} is frozen since {since}"
        if state.phase == "ended":
            return f"{state.name} {ended or 'has ended'}"
        if ended and (state.phase == "starting" or state.since_s + self.age_s <= AGAIN_S):
            what = "is starting again" if state.phase == "starting" else f"runs again since {since}"
            return f"{state.name} {ended} and {what}"
        return ""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The swarm at one moment."""

    swarm: str
    connected: bool
    robots: tuple[RobotRow, ...] = ()  # by id
    nodes: tuple[NodeRow, ...] = ()
    summaries: tuple[Summary, ...] = ()  # by metric
    request: RequestStatus | None = None  # the newest of all requests
    missing: tuple[str, ...] = ()  # expected, addressed, or known to the core, but never received here
    leases: tuple[Lease, ...] = ()
    docks: tuple[DockState, ...] = ()  # none: the fleet file has none, or no core is there
    waiting: tuple[str, ...] = ()  # robots that wait for a dock, the next one first
    processes: tuple[ProcessRow, ...] = ()  # of supervisors that report; robots' own computers have none

    @property
    def holders(self) -> dict[str, str]:
        """Robot → operator that holds it."""
        return {lease.robot: lease.operator for lease in self.leases}

    def only(self, robots: Iterable[str]) -> Snapshot:
        """Return the same of these robots alone; what concerns all of them stays."""
        chosen = frozenset(robots)
        return replace(
            self,
            robots=tuple(row for row in self.robots if row.robot in chosen),
            missing=tuple(robot for robot in self.missing if robot in chosen),
            leases=tuple(lease for lease in self.leases if lease.robot in chosen),
        )

    @property
    def silent(self) -> tuple[str, ...]:
        """Robots that have been received, but not lately."""
        return tuple(row.robot for row in self.robots if row.silent)

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON; what is unknown is None."""
        return {
            "swarm": self.swarm,
            "connected": self.connected,
            "robots": [{**_robot_as_dict(row), "held_by": self.holders.get(row.robot, "")} for row in self.robots],
            "nodes": [asdict(node) for node in self.nodes],
            "processes": [
                {"host": row.host, "age_s": row.age_s, "note": row.text, **msgspec.to_builtins(row.state)}
                for row in self.processes
            ],
            "summaries": {each.metric: msgspec.to_builtins(each) for each in self.summaries},
            "request": msgspec.to_builtins(self.request),
            "docks": [msgspec.to_builtins(each) for each in self.docks],
            "waiting_for_docks": list(self.waiting),
            "missing": list(self.missing),
            "silent": list(self.silent),
        }


class FleetView:
    """Collects what the swarm publishes. Ages count from arrival, on this side's clock.

    A robot that is not expected is forgotten when it has been silent for long; see :class:`~fullswarm.recent.Names`.

    Attributes
    ----------
    states_received : messages with states so far
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, expected: Iterable[str] = ()) -> None:
        self._bus, self._keys, self._scheduler = bus, keys, scheduler
        self._expected = tuple(expected)
        self.states_received = 0
        self._health: dict[str, tuple[float, RobotHealth, HealthReport]] = {}
        self._states: dict[str, tuple[float, tuple[float, ...]]] = {}
        self._profiles: dict[str, RobotProfile] = {}
        self._memories: dict[str, tuple[float, dict[str, RobotMemory]]] = {}  # by host
        self._actuators: dict[str, tuple[float, dict[str, dict[str, str]]]] = {}  # by host
        self._nodes: dict[str, tuple[float, Heartbeat]] = {}
        self._summaries: Recent[str, Summary] = Recent(MOST_METRICS)
        self._robots = Names(STRANGERS, self._forget_robot, self._expected)
        self._hosts = Names(STRANGERS, self._forget_host)
        self._node_names = Names(MOST_NODES, self._forget_node)
        self._request: RequestStatus | None = None
        self._leases: tuple[float, tuple[Lease, ...]] = (-math.inf, ())
        self._known: tuple[float, KnownRobots] | None = None
        self._counted_s = math.inf  # since when a core has said which robots there are
        self._processes: dict[str, tuple[float, ProcessReport]] = {}  # by host
        self._charging: tuple[float, ChargingStatus] | None = None
        self._subscriptions = [
            bus.subscribe(keys.health(), HealthReport, self._on_health, latest=True),
            bus.subscribe(keys.state(), RobotStates, self._on_states, latest=True),
            bus.subscribe(keys.profile(), RobotProfiles, self._on_profiles),
            bus.subscribe(keys.memory(), BehaviourMemory, self._on_memory, latest=True),
            bus.subscribe(keys.actuators(), ActuatorReport, self._on_actuators, latest=True),
            bus.subscribe(keys.heartbeat(), Heartbeat, self._on_heartbeat, latest=True),
            bus.subscribe(keys.summary(), Summary, self._on_summary, latest=True),
            bus.subscribe(keys.behaviour_status, RequestStatus, self._on_status),
            bus.subscribe(keys.leases, Leases, self._on_leases, latest=True),
            bus.subscribe(keys.known_robots, KnownRobots, self._on_known, latest=True),
            bus.subscribe(keys.charging_status, ChargingStatus, self._on_charging, latest=True),
            bus.subscribe(keys.processes(), ProcessReport, self._on_processes, latest=True),
        ]

        self._asked = False
        self._asking = scheduler.every(ASK_S, self._ask, first_s=ASK_FIRST_S)

    def _ask(self) -> None:
        """Ask for profiles that have not been received: their agents send them seldom otherwise."""
        for names in (self._robots, self._hosts, self._node_names):
            names.sweep(self._scheduler.now_s())
        if not self._asked or not self._profiles.keys() >= self._health.keys():
            self._asked = True
            self._bus.publish(self._keys.report_query, ReportQuery(source="operator"))

    def complete(self) -> bool:
        """Tell whether all is known of each robot that is expected, received or reports to a core, and its leases."""
        robots = {*self.present(), *(self._known[1].present if self._known else ())}
        tables = (self._states, self._health, self._profiles)
        return bool(robots) and all(table.keys() >= robots for table in tables) and (
            (self._known is None and "core" not in self._nodes)
            or ("core" in self._nodes and math.isfinite(self._leases[0]))
        )  # fmt: skip

    def counted(self) -> bool:
        """Tell whether a core has said which robots there are: then nothing has to be waited for that may yet come."""
        return self._known is not None

    def received(self) -> int:
        """Return of how many robots, processes and metrics something has been received."""
        tables = (self._states, self._health, self._profiles, self._nodes, self._processes, self._summaries)
        return sum(len(table) for table in tables)

    def robots(self) -> tuple[str, ...]:
        """Return the robots that have been received so far, by id."""
        return tuple(sorted({*self._health, *self._states}))

    def present(self) -> tuple[str, ...]:
        """Return which robots must obey an order now: the robots expected and those received."""
        return tuple(sorted({*self._expected, *self.robots()}))

    def quiet(self) -> frozenset[str]:
        """Return the robots and processes that are silent now, and "hub" if that is gone; cheaper than a snapshot."""
        latest_s = self._scheduler.now_s() - SILENT_S
        found = {node for node, (arrived_s, _) in self._nodes.items() if arrived_s < latest_s}
        for robot in self._health.keys() | self._states.keys():
            tables = self._health.get(robot), self._states.get(robot)
            if all(each is None or each[0] < latest_s for each in tables):
                found.add(robot)
        return frozenset(found if self._bus.connected() else {*found, "hub"})

    def poses(self) -> list[Pose]:
        """Return the robots whose pose has been received, by id; cheaper than a snapshot, for many times a second."""
        now_s, found = self._scheduler.now_s(), list[Pose]()
        for robot in sorted(self._states):
            arrived_s, (x_m, y_m, heading_rad, speed_m_s, _, _) = self._states[robot]
            health = self._health.get(robot)
            if health is not None and health[0] > arrived_s:
                arrived_s = health[0]
            if math.isfinite(x_m):
                found.append((robot, x_m, y_m, heading_rad, speed_m_s, now_s - arrived_s))
        return found

    def snapshot(self) -> Snapshot:
        """Return the swarm as it is known now."""
        now_s = self._scheduler.now_s()
        received = self.robots()
        charging = self._charging[1] if self._charging and now_s - self._charging[0] <= CHARGING_S else None
        addressed = self._request.missing if self._request is not None else ()
        return Snapshot(
            swarm=self._keys.swarm,
            connected=self._bus.connected(),
            robots=tuple(self._row(robot, now_s) for robot in received),
            nodes=tuple(
                NodeRow(node, now_s - arrived_s, beat.active, beat.process)
                for node, (arrived_s, beat) in sorted(self._nodes.items())
            ),
            summaries=tuple(self._summaries[metric] for metric in sorted(self._summaries)),
            request=self._request,
            missing=tuple(sorted({*self._expected, *addressed, *self._known_to_core(now_s)}.difference(received))),
            leases=self._leases[1] if now_s - self._leases[0] <= LEASES_S else (),
            docks=() if charging is None else charging.docks,
            waiting=() if charging is None else charging.waiting,
            processes=tuple(
                ProcessRow(host, now_s - arrived_s, state)
                for host, (arrived_s, report) in sorted(self._processes.items())
                if now_s - arrived_s <= PROCESSES_S
                for state in report.processes
            ),
        )

    def _known_to_core(self, now_s: float) -> tuple[str, ...]:
        """Return robots that a core knows and that should have been received: what is not there is missing."""
        if self._known is None or now_s - self._known[0] > LEASES_S:
            return ()
        known = self._known[1]
        return (*known.absent, *(known.present if now_s - self._counted_s > SILENT_S else ()))

    def close(self) -> None:
        """Unsubscribe."""
        self._asking.cancel()
        for subscription in self._subscriptions:
            subscription.close()

    def _forget_robot(self, robot: str) -> None:
        for table in (self._health, self._states, self._profiles):
            table.pop(robot, None)

    def _forget_host(self, host: str) -> None:
        self._memories.pop(host, None)
        self._actuators.pop(host, None)
        self._processes.pop(host, None)

    def _forget_node(self, node: str) -> None:
        self._nodes.pop(node, None)

    def _row(self, robot: str, now_s: float) -> RobotRow:
        state_s, (x_m, y_m, heading_rad, speed_m_s, turn_rad_s, radius_m) = self._states.get(
            robot, (-math.inf, _NO_STATE)
        )
        health_s, health, report = self._health.get(robot, (-math.inf, None, None))
        return RobotRow(
            robot=robot,
            age_s=now_s - max(health_s, state_s),
            x_m=x_m,
            y_m=y_m,
            heading_rad=heading_rad,
            speed_m_s=speed_m_s,
            health=health,
            turn_rad_s=turn_rad_s,
            radius_m=radius_m,
            host="" if report is None else report.host,
            version="" if report is None else report.version,
            dropped={} if report is None else report.dropped,
            wall_offset_s=None if report is None else report.wall_offset_s,
            round_trip_s=-1.0 if report is None else report.round_trip_s,
            profile=self._profiles.get(robot),
            memory=self._memory("" if report is None else report.host, robot, now_s),
            actuators=self._actuators_of("" if report is None else report.host, robot, now_s),
        )

    def _memory(self, host: str, robot: str, now_s: float) -> RobotMemory | None:
        arrived_s, found = self._memories.get(host, (-math.inf, {}))
        return found.get(robot) if now_s - arrived_s <= MEMORY_S else None

    def _actuators_of(self, host: str, robot: str, now_s: float) -> Mapping[str, str]:
        arrived_s, found = self._actuators.get(host, (-math.inf, {}))
        return found.get(robot, {}) if now_s - arrived_s <= MEMORY_S else {}

    def _on_profiles(self, message: RobotProfiles) -> None:
        now_s = self._scheduler.now_s()
        self._profiles |= {each.robot: each for each in message.robots if self._robots.admit(each.robot, now_s)}

    def _on_memory(self, message: BehaviourMemory) -> None:
        if not self._hosts.admit(message.host, self._scheduler.now_s()):
            return
        self._memories[message.host] = self._scheduler.now_s(), {each.robot: each for each in message.robots}

    def _on_actuators(self, message: ActuatorReport) -> None:
        if not self._hosts.admit(message.host, self._scheduler.now_s()):
            return
        self._actuators[message.host] = self._scheduler.now_s(), {each.robot: each.values for each in message.robots}

    def _on_health(self, report: HealthReport) -> None:
        now_s = self._scheduler.now_s()
        for health in report.robots:
            if self._robots.admit(health.robot, now_s):
                self._health[health.robot] = now_s, health, report

    def _on_states(self, states: RobotStates) -> None:
        now_s = self._scheduler.now_s()
        self.states_received += 1
        kinematics = (states.x_m, states.y_m, states.heading_rad, states.speed_m_s, states.turn_rad_s, states.radius_m)
        for robot, state in zip(states.robots, zip(*kinematics, strict=False), strict=False):
            if self._robots.admit(robot, now_s):
                self._states[robot] = now_s, state

    def _on_heartbeat(self, beat: Heartbeat) -> None:
        if not self._node_names.admit(beat.node, self._scheduler.now_s()):
            return
        self._nodes[beat.node] = self._scheduler.now_s(), beat

    def _on_summary(self, summary: Summary) -> None:
        self._summaries[summary.metric] = summary

    def _on_status(self, status: RequestStatus) -> None:
        self._request = status

    def _on_processes(self, message: ProcessReport) -> None:
        if self._hosts.admit(message.host, self._scheduler.now_s()):
            self._processes[message.host] = self._scheduler.now_s(), message

    def _on_charging(self, status: ChargingStatus) -> None:
        self._charging = self._scheduler.now_s(), status

    def _on_leases(self, message: Leases) -> None:
        self._leases = self._scheduler.now_s(), message.leases

    def _on_known(self, message: KnownRobots) -> None:
        self._known = self._scheduler.now_s(), message
        self._counted_s = min(self._counted_s, self._known[0])


def natural(name: str) -> tuple[str, int, str]:
    """Return a key that sorts r2 before r10."""
    head = name.rstrip("0123456789")
    digits = name[len(head) :]
    return head, int(digits) if digits else -1, name


def _robot_as_dict(row: RobotRow) -> dict[str, object]:
    numbers = {
        name: value if math.isfinite(value := float(getattr(row, name))) else None
        for name in ("age_s", "x_m", "y_m", "heading_rad", "speed_m_s")
    }
    health = {} if row.health is None else msgspec.to_builtins(row.health)
    more: dict[str, object] = {
        "capabilities": [] if row.profile is None else list(row.profile.capabilities),
        "memory": {} if row.memory is None else {name: list(values) for name, values in row.memory.fields.items()},
        "actuators": dict(row.actuators),
        "dropped": dict(row.dropped),
        "wall_offset_s": row.wall_offset_s,
        "round_trip_s": None if row.round_trip_s < 0.0 else row.round_trip_s,
    }
    return {"robot": row.robot, "silent": row.silent, **numbers, **health, **more}


def memory_text(memory: RobotMemory | None) -> str:
    """Return what a robot's control law remembers in one line; empty: nothing."""
    if memory is None:
        return ""
    fields = (
        f"{name} {' '.join('-' if each is None else f'{each:.4g}' for each in values)}"
        for name, values in memory.fields.items()
    )
    more = f", and {memory.left_out} more numbers" if memory.left_out else ""
    return ", ".join(fields) + more
