"""Keeps the newest of what a swarm reports, for metrics: bounded, whatever names others invent."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

from fullswarm.bus.base import Bus
from fullswarm.keys import ROBOT_ID, Keys
from fullswarm.messages import (
    ChargingStatus,
    HealthReport,
    Heartbeat,
    Interventions,
    Leases,
    ProcessReport,
    RequestStatus,
    RobotHealth,
    RobotMeasurement,
    Summary,
)
from fullswarm.perf.metrics import METRICS
from fullswarm.recent import Names, Recent
from fullswarm.runtime import Scheduler

GONE_S = 60.0
"""What has been silent for so long is shown no more (default)."""
MOST_ROBOTS, MOST_HOSTS, MOST_NODES, MOST_REQUESTS = 2000, 2000, 64, 4096
SWEEP_S = 5.0
FILTERING_S = 1.0
"""The safety filter reports at 5 Hz while it changes anything."""
LEASES_S, DOCKS_S, PROCESSES_S = 3.0, 6.0, 3.0
"""After so long without a report nothing is known: three in a row were lost."""
SUMMARIES = frozenset({*METRICS, "coverage"})

V = TypeVar("V")


class Newest(Generic[V]):
    """The newest value under each name, with its arrival. At most `most` names; see :class:`~fullswarm.recent.Names`.

    Attributes
    ----------
    strange : messages under names that no robot or process can have
    """

    def __init__(self, most: int, now_s: Callable[[], float], gone_s: float) -> None:
        self.strange = 0
        self._now_s, self._gone_s = now_s, gone_s
        self._values: dict[str, tuple[float, V]] = {}
        self._names = Names(most, self._forget, least_s=gone_s)

    def put(self, name: str, value: V) -> None:
        """Keep a value, unless there is no room for its name."""
        now_s = self._now_s()
        if not ROBOT_ID.match(name):
            self.strange += 1
        elif self._names.admit(name, now_s):
            self._values[name] = now_s, value

    @property
    def refused(self) -> int:
        """Messages that were not kept because of their names."""
        return self.strange + self._names.refused

    def items(self) -> Iterator[tuple[str, float, V]]:
        """Yield name, age in s and value of those that are not gone."""
        now_s = self._now_s()
        for name, (arrival_s, value) in sorted(self._values.items()):
            if now_s - arrival_s <= self._gone_s:
                yield name, now_s - arrival_s, value

    def sweep(self) -> None:
        """Forget what is gone."""
        now_s = self._now_s()
        self._names.sweep(now_s)
        for name in [name for name, (arrival_s, _) in self._values.items() if now_s - arrival_s > self._gone_s]:
            del self._values[name]

    def _forget(self, name: str) -> None:
        self._values.pop(name, None)


class SwarmNode:
    """Collects what the metrics are made of.

    Attributes
    ----------
    robots : by robot, its health and its host
    hosts : by host, the health report that its agent sent
    measured : by host
    nodes : processes with a heartbeat
    supervisors : by host
    summaries : by metric
    interventions : by robot, how often the safety filter began to change its motion
    requests : by phase, how many requests have come to it
    received : messages taken in
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, gone_s: float = GONE_S) -> None:
        now_s = scheduler.now_s
        self._bus, self._scheduler = bus, scheduler
        self.robots: Newest[tuple[RobotHealth, str]] = Newest(MOST_ROBOTS, now_s, gone_s)
        self.hosts: Newest[HealthReport] = Newest(MOST_HOSTS, now_s, gone_s)
        self.measured: Newest[RobotMeasurement] = Newest(MOST_HOSTS, now_s, gone_s)
        self.nodes: Newest[Heartbeat] = Newest(MOST_NODES, now_s, gone_s)
        self.supervisors: Newest[ProcessReport] = Newest(MOST_NODES, now_s, gone_s)
        self.interventions: Recent[str, int] = Recent(MOST_ROBOTS)
        self.summaries: Newest[Summary] = Newest(len(SUMMARIES), now_s, gone_s)
        self._all: tuple[Newest[Any], ...] = (
            self.robots, self.hosts, self.measured, self.nodes, self.supervisors, self.summaries,
        )  # fmt: skip
        self.requests: Counter[str] = Counter()
        self.received = 0
        self._filtering: Recent[str, tuple[float, frozenset[str]]] = Recent(MOST_HOSTS)  # by host
        self._phases: Recent[str, str] = Recent(MOST_REQUESTS)
        self._leases: tuple[float, Leases] | None = None
        self._docks: tuple[float, ChargingStatus] | None = None
        self._subscriptions = [
            bus.subscribe(keys.health(), HealthReport, self._on_health),
            bus.subscribe(keys.measurement("robots"), RobotMeasurement, self._on_measurement, latest=True),
            bus.subscribe(keys.heartbeat(), Heartbeat, self._on_heartbeat, latest=True),
            bus.subscribe(keys.processes(), ProcessReport, self._on_processes, latest=True),
            bus.subscribe(keys.summary(), Summary, self._on_summary, latest=True),
            bus.subscribe(keys.behaviour_status, RequestStatus, self._on_status),
            bus.subscribe(keys.intervention(), Interventions, self._on_interventions, latest=True),
            bus.subscribe(keys.leases, Leases, self._on_leases, latest=True),
            bus.subscribe(keys.charging_status, ChargingStatus, self._on_docks, latest=True),
        ]
        self._timer = scheduler.every(SWEEP_S, self._sweep)

    # ------------------------------------------------------------------ what is known now
    @property
    def connected(self) -> bool:
        """Whether the hub is connected."""
        return self._bus.connected()

    @property
    def refused(self) -> int:
        """Messages that were not kept because of their names."""
        return sum(each.refused for each in self._all)

    @property
    def filtered(self) -> frozenset[str]:
        """Robots whose motion the safety filter changes now."""
        now_s = self._scheduler.now_s()
        fresh = (robots for arrival_s, robots in self._filtering.values() if now_s - arrival_s <= FILTERING_S)
        return frozenset().union(*fresh)

    @property
    def leases(self) -> Leases | None:
        """All leases; None: no core reports them."""
        return _fresh(self._leases, self._scheduler.now_s(), LEASES_S)

    @property
    def docks(self) -> ChargingStatus | None:
        """The docks; None: there are none, or no core reports them."""
        return _fresh(self._docks, self._scheduler.now_s(), DOCKS_S)

    def close(self) -> None:
        """Unsubscribe."""
        self._timer.cancel()
        for each in self._subscriptions:
            each.close()

    # ------------------------------------------------------------------ what comes
    def _on_health(self, report: HealthReport) -> None:
        self.received += 1
        self.hosts.put(report.host, report)
        for each in report.robots:
            self.robots.put(each.robot, (each, report.host))

    def _on_measurement(self, message: RobotMeasurement) -> None:
        self.received += 1
        self.measured.put(message.host, message)

    def _on_heartbeat(self, beat: Heartbeat) -> None:
        self.received += 1
        self.nodes.put(beat.node, beat)

    def _on_processes(self, report: ProcessReport) -> None:
        self.received += 1
        self.supervisors.put(report.host, report)

    def _on_summary(self, summary: Summary) -> None:
        self.received += 1
        if summary.metric in SUMMARIES:
            self.summaries.put(summary.metric, summary)

    def _on_status(self, status: RequestStatus) -> None:
        self.received += 1
        if self._phases.get(status.request_id) != status.phase:
            self._phases[status.request_id] = status.phase
            self.requests[status.phase] += 1

    def _on_interventions(self, message: Interventions) -> None:
        self.received += 1
        now_s = self._scheduler.now_s()
        arrival_s, before = self._filtering.get(message.host, (now_s, frozenset()))
        robots = frozenset(message.robots)
        for robot in robots - (before if now_s - arrival_s <= FILTERING_S else frozenset()):
            self.interventions[robot] = self.interventions.get(robot, 0) + 1
        self._filtering[message.host] = now_s, robots

    def _on_leases(self, leases: Leases) -> None:
        self.received += 1
        self._leases = self._scheduler.now_s(), leases

    def _on_docks(self, status: ChargingStatus) -> None:
        self.received += 1
        self._docks = self._scheduler.now_s(), status

    def _sweep(self) -> None:
        for each in self._all:
            each.sweep()


def _fresh(kept: tuple[float, V] | None, now_s: float, within_s: float) -> V | None:
    return None if kept is None or now_s - kept[0] > within_s else kept[1]
