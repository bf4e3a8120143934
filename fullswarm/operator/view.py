"""What an operator can see of a swarm: the newest of everything, with its age."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass

import msgspec

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import HealthReport, Heartbeat, RequestStatus, RobotHealth, RobotStates, Summary
from fullswarm.runtime import Scheduler

SILENT_S = 2.0
"""Four health reports lost: the robot, its link or its hub is gone."""

_NO_STATE = (math.nan, math.nan, math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class RobotRow:
    """One robot as last heard; NaN where nothing has been heard yet."""

    robot: str
    age_s: float  # since its last message arrived
    x_m: float
    y_m: float
    heading_rad: float
    speed_m_s: float
    health: RobotHealth | None  # None: only its states have been heard

    @property
    def silent(self) -> bool:
        """Whether it has not been heard for too long."""
        return self.age_s > SILENT_S


@dataclass(frozen=True, slots=True)
class NodeRow:
    """A process of the core, or a centralised behaviour's node."""

    node: str
    age_s: float
    active: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The swarm at one moment."""

    swarm: str
    connected: bool
    robots: tuple[RobotRow, ...] = ()  # by id
    nodes: tuple[NodeRow, ...] = ()
    summaries: tuple[Summary, ...] = ()  # by metric
    request: RequestStatus | None = None  # the newest of all requests
    missing: tuple[str, ...] = ()  # expected or addressed, but never heard

    @property
    def silent(self) -> tuple[str, ...]:
        """Robots that have been heard, but not lately."""
        return tuple(row.robot for row in self.robots if row.silent)

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON; what is unknown is None."""
        return {
            "swarm": self.swarm,
            "connected": self.connected,
            "robots": [_robot_as_dict(row) for row in self.robots],
            "nodes": [asdict(node) for node in self.nodes],
            "summaries": {each.metric: msgspec.to_builtins(each) for each in self.summaries},
            "request": msgspec.to_builtins(self.request),
            "missing": list(self.missing),
            "silent": list(self.silent),
        }


class FleetView:
    """Collects what the swarm publishes. Ages count from arrival, on this side's clock."""

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, expected: Iterable[str] = ()) -> None:
        self._bus, self._keys, self._scheduler = bus, keys, scheduler
        self._expected = tuple(expected)
        self._health: dict[str, tuple[float, RobotHealth]] = {}
        self._states: dict[str, tuple[float, tuple[float, float, float, float]]] = {}
        self._nodes: dict[str, tuple[float, Heartbeat]] = {}
        self._summaries: dict[str, Summary] = {}
        self._request: RequestStatus | None = None
        self._subscriptions = [
            bus.subscribe(keys.health(), HealthReport, self._on_health),
            bus.subscribe(keys.state(), RobotStates, self._on_states, latest=True),
            bus.subscribe(keys.heartbeat(), Heartbeat, self._on_heartbeat, latest=True),
            bus.subscribe(keys.summary(), Summary, self._on_summary, latest=True),
            bus.subscribe(keys.behaviour_status, RequestStatus, self._on_status),
        ]

    def robots(self) -> tuple[str, ...]:
        """Return who has been heard so far, by id."""
        return tuple(sorted({*self._health, *self._states}))

    def present(self) -> tuple[str, ...]:
        """Return who must obey an order now: the robots expected and those heard."""
        return tuple(sorted({*self._expected, *self.robots()}))

    def snapshot(self) -> Snapshot:
        """Return the swarm as it is known now."""
        now_s = self._scheduler.now_s()
        heard = self.robots()
        addressed = self._request.missing if self._request is not None else ()
        return Snapshot(
            swarm=self._keys.swarm,
            connected=self._bus.connected(),
            robots=tuple(self._row(robot, now_s) for robot in heard),
            nodes=tuple(
                NodeRow(node, now_s - arrived_s, beat.active) for node, (arrived_s, beat) in sorted(self._nodes.items())
            ),
            summaries=tuple(self._summaries[metric] for metric in sorted(self._summaries)),
            request=self._request,
            missing=tuple(sorted({*self._expected, *addressed}.difference(heard))),
        )

    def close(self) -> None:
        """Hear nothing more."""
        for subscription in self._subscriptions:
            subscription.close()

    def _row(self, robot: str, now_s: float) -> RobotRow:
        health_s, health = self._health.get(robot, (-math.inf, None))
        state_s, state = self._states.get(robot, (-math.inf, _NO_STATE))
        return RobotRow(robot, now_s - max(health_s, state_s), *state, health)

    def _on_health(self, report: HealthReport) -> None:
        now_s = self._scheduler.now_s()
        for health in report.robots:
            self._health[health.robot] = now_s, health

    def _on_states(self, states: RobotStates) -> None:
        now_s = self._scheduler.now_s()
        columns = zip(states.robots, states.x_m, states.y_m, states.heading_rad, states.speed_m_s, strict=False)
        for robot, *state in columns:
            x_m, y_m, heading_rad, speed_m_s = state
            self._states[robot] = now_s, (x_m, y_m, heading_rad, speed_m_s)

    def _on_heartbeat(self, beat: Heartbeat) -> None:
        self._nodes[beat.node] = self._scheduler.now_s(), beat

    def _on_summary(self, summary: Summary) -> None:
        self._summaries[summary.metric] = summary

    def _on_status(self, status: RequestStatus) -> None:
        self._request = status


def _robot_as_dict(row: RobotRow) -> dict[str, object]:
    numbers = {
        name: value if math.isfinite(value := float(getattr(row, name))) else None
        for name in ("age_s", "x_m", "y_m", "heading_rad", "speed_m_s")
    }
    health = {} if row.health is None else msgspec.to_builtins(row.health)
    return {"robot": row.robot, "silent": row.silent, **numbers, **health}
