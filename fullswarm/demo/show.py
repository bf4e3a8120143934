"""Runs the demonstration: eight robots drive to a goal, flock, and meet, switched by an operator's requests."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from fullswarm.bus.base import OPERATOR, Delivery, SenderBus
from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.messages import BehaviourRequest, EStop, Heartbeat, LeaseRequest, RequestStatus, StopRequest, Value
from fullswarm.operator.client import Operator, PendingRequest
from fullswarm.operator.view import FleetView, RobotRow
from fullswarm.runtime import Scheduler, Timer

LOOK_S = 0.05
STOP_S = 1.0
"""Time at the end for the robots to stop."""


@dataclass(frozen=True, slots=True)
class Act:
    """One request of the show and how much of the time it gets."""

    behaviour: str
    parameters: dict[str, Value]
    share: float


ACTS = (
    Act("move_to_goal_bc", {"goal": [7.0, 7.0], "arrive_radius_m": 1.5}, 0.4),
    Act("flocking_bc", {"cruise_m_s": 0.3}, 0.3),
    Act("rendezvous_bc", {}, 0.3),
)


CIRCLE = [
    [3.63, 2.21],
    [2.81, 3.03],
    [2.81, 4.17],
    [3.63, 4.99],
    [4.77, 2.21],
    [5.59, 3.03],
    [5.59, 4.17],
    [4.77, 4.99],
]
"""A ring of 3 m, its places in the order of the mixed fleet's robots, so that no path crosses another."""

MIXED_ACTS = (
    Act("formation_bc", {"targets": [list(each) for each in CIRCLE], "gain": 2.0}, 0.5),
    Act("move_to_goal_bc", {"goal": [4.9, 4.5], "arrive_radius_m": 1.8, "gain": 2.0}, 0.5),  # rovers keep wide gaps
)
NEAR_M = 0.2
"""A robot has arrived when it is so close to its target, or within the radius that the request names."""


def acts_for(config: SwarmConfig) -> tuple[Act, ...]:
    """Return the acts of a fleet: eight robots of several makes have other ones than eight of one."""
    emulated = sum(robot.emulate is not None for robot in config.robot)
    return MIXED_ACTS if emulated == len(CIRCLE) == len(config.robot) else ACTS


@dataclass(slots=True)
class Sent:
    """A request of the show and its answer."""

    act: Act
    request_id: str
    sent_s: float
    acknowledged_s: float | None = None
    status: RequestStatus | None = None
    confirmed_by: tuple[str, ...] = ()
    arrived: tuple[str, ...] | None = None  # which robots were there when the act was over; None: it has no target

    def document(self) -> dict[str, object]:
        """Return plain values for JSON."""
        status = self.status
        return {
            "id": self.request_id,
            "behaviour": self.act.behaviour,
            "phase": status.phase if status else "unanswered",
            "acknowledged_after_s": None if self.acknowledged_s is None else round(self.acknowledged_s, 4),
            "confirmed_by": sorted(self.confirmed_by),
            "arrived": None if self.arrived is None else list(self.arrived),
            "missing": sorted(status.missing) if status else [],
            "reason": status.reason if status else "",
        }


@dataclass(slots=True)
class Show:
    """Requests one act after the other and keeps the results.

    Parameters
    ----------
    seconds : length of the whole show
    operator : sends the requests; its ids are chosen by the caller, so that a lockstep run repeats to the byte
    yields : whether it leaves the robots to the first other operator that requests anything

    Attributes
    ----------
    yielded_to : the name of that operator; empty: none yet
    """

    bus: SenderBus
    scheduler: Scheduler
    config: SwarmConfig
    operator: Operator
    seconds: float
    acts: tuple[Act, ...] = ACTS
    yields: bool = False
    sent: list[Sent] = field(default_factory=list)
    view: FleetView = field(init=False)
    done: bool = False
    yielded_to: str = ""
    _asked: PendingRequest | None = None
    _timers: list[Timer] = field(default_factory=list)
    _world: tuple[Heartbeat, Heartbeat] | None = None  # the first of the show and the newest

    def __post_init__(self) -> None:
        keys = Keys(self.config.swarm)
        self.view = FleetView(self.bus, keys, self.scheduler, self.config.robots)
        self.bus.subscribe(keys.heartbeat("world"), Heartbeat, self._on_world, latest=True)
        if self.yields:
            self.bus.subscribe(keys.behaviour_request, BehaviourRequest, self._on_request)
            self.bus.subscribe(keys.lease_request, LeaseRequest, self._on_lease)
            self.bus.subscribe_with_sender(keys.stop, StopRequest, self._on_stop)
            self.bus.subscribe_with_sender(keys.estop, EStop, self._on_stop)

    def ready(self) -> bool:
        """Return whether all robots are received and READY and the core is alive."""
        snapshot = self.view.snapshot()
        present = [row for row in snapshot.robots if row.health and row.health.lifecycle in ("READY", "ACTIVE")]
        nodes = {node.node for node in snapshot.nodes if node.age_s < 1.0}
        return len(present) == len(self.config.robots) and {"core", "centralised"} <= nodes

    def start(self) -> None:
        """Set the times of all acts, from now."""
        self._world = None
        time_s = 0.0
        for act in self.acts:
            self._at(time_s, lambda act=act: self._ask(act))  # type: ignore[misc]  # bound per turn
            time_s += act.share * (self.seconds - STOP_S)
            self._at(time_s - LOOK_S, self._look)
        self._at(time_s, self._stop)
        self.scheduler.after(self.seconds, self._end)

    def _at(self, time_s: float, call: Callable[[], None]) -> None:
        if not self.yielded_to:
            self._timers.append(self.scheduler.after(time_s, call))

    def _ask(self, act: Act) -> None:
        now_s = self.scheduler.now_s()

        def on_status(status: RequestStatus) -> None:
            sent.status = status
            if status.phase == "running" and sent.acknowledged_s is None:
                sent.acknowledged_s = self.scheduler.now_s() - now_s
                sent.confirmed_by = status.running

        sent = Sent(act, "", now_s)
        self.sent.append(sent)
        self._asked = self.operator.request(act.behaviour, (), act.parameters, on_status)
        sent.request_id = self._asked.request.id

    def _look(self) -> None:
        """Note which robots have arrived at the targets of the present act."""
        if self.sent:
            self.sent[-1].arrived = _arrived(self.sent[-1].act, self.config.robots, self.view.snapshot().robots)

    def _stop(self) -> None:
        self.operator.stop()

    def _end(self) -> None:
        self.done = True

    # ------------------------------------------------------------------ other operators
    def _on_request(self, request: BehaviourRequest) -> None:
        if request.source != self.operator.source:
            self._yield(request.operator or request.source)

    def _on_lease(self, request: LeaseRequest) -> None:
        if request.hold and request.operator != self.operator.name:
            self._yield(request.operator)

    def _on_stop(self, delivery: Delivery[StopRequest] | Delivery[EStop]) -> None:
        # Robots and the core repeat a stop that still holds. A program that states no name may be an operator's.
        order = delivery.message
        if order.source != self.operator.source and delivery.sender in (OPERATOR, ""):
            self._yield(order.source)

    def _yield(self, operator: str) -> None:
        """Drop what is left of the show, its stop too: the robots are another operator's now."""
        if self.done or self.yielded_to:
            return
        self.yielded_to = operator or "another operator"
        for timer in self._timers:
            timer.cancel()
        if self._asked is not None and self._asked.status is None:
            self.operator.forget(self._asked)  # sent again it would come after what was asked now

    # ------------------------------------------------------------------ results
    def _on_world(self, beat: Heartbeat) -> None:
        same = self._world is not None and self._world[0].process == beat.process
        self._world = (self._world[0] if self._world and same else beat, beat)

    def real_time_factor(self) -> float | None:
        """Return simulated seconds per real second, from the world's own heartbeats; None without them."""
        if self._world is None:
            return None
        first, last = self._world
        steps, seconds = last.sequence - first.sequence, last.stamp_s - first.stamp_s
        return steps / self.config.world_or_default.rate_hz / seconds if seconds > 0 else None

    def summary(self, metric: str, value: str) -> float | None:
        """Return one value of a summarizer; None when it was never received."""
        for summary in self.view.snapshot().summaries:
            if summary.metric == metric and value in summary.values:
                return summary.values[value]
        return None

    def document(self, real_time_factor: float | None) -> dict[str, object]:
        """Return the result of the show as one JSON document."""
        factor = real_time_factor if real_time_factor is None else round(real_time_factor, 3)
        return {
            "swarm": self.config.swarm,
            "seconds": self.seconds,
            "robots": [self._robot(robot) for robot in self.config.robots],
            "requests": [each.document() for each in self.sent],
            "work_m": _rounded(self.summary("work", "total_m")),
            "coverage": _rounded(self.summary("coverage", "fraction")),
            "collisions": _whole(self.summary("collisions", "events")),
            "real_time_factor": factor,
        }

    def _robot(self, robot: str) -> dict[str, object]:
        rows = {row.robot: row for row in self.view.snapshot().robots}
        row = rows.get(robot)
        if row is None or row.health is None:
            return {"id": robot, "driver": "", "make": "", "firmware": "", "state": "MISSING"}
        health = row.health
        return {
            "id": robot,
            "driver": health.driver,
            "make": health.make,
            "model": health.model,
            "firmware": health.firmware,
            "state": health.lifecycle,
            "behaviour": health.behaviour,
            "pose": [_rounded(value) for value in (row.x_m, row.y_m, row.heading_rad)],
            "collisions": health.collisions,
            "fault": health.fault,
        }


def _arrived(act: Act, robots: Sequence[str], rows: Sequence[RobotRow]) -> tuple[str, ...] | None:
    goal, targets, radius_m = (act.parameters.get(name) for name in ("goal", "targets", "arrive_radius_m"))
    places = targets if isinstance(targets, list) else [goal] * len(robots)
    near_m = NEAR_M + (radius_m if isinstance(radius_m, float) else 0.0)
    place_of = dict(zip(robots, places, strict=True))
    found = []
    for row in rows:
        place = place_of.get(row.robot)
        if not isinstance(place, list):
            return None
        x_m, y_m = (float(each) for each in place if isinstance(each, int | float))
        if math.hypot(row.x_m - x_m, row.y_m - y_m) <= near_m:
            found.append(row.robot)
    return tuple(found)


def _rounded(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, 4)


def _whole(value: float | None) -> int | None:
    return None if value is None else int(value)
