"""Makes the metrics of a swarm at each scrape: names and units by Prometheus' conventions.

https://prometheus.io/docs/practices/naming: base units in the name, ``_total`` for what only grows (until a process is
started again), ``_ratio`` from 0 to 1. A number that is not known has no sample. Labels come from fixed sets, or are
names of which `newest.py` keeps a bounded number.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import get_args

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from fullswarm import __version__
from fullswarm.exporter.newest import PROCESSES_S, SwarmNode
from fullswarm.keys import ROBOT_ID, TRUTH
from fullswarm.messages import ChargePhase, HealthReport, Phase, ProcessPhase, RobotHealth
from fullswarm.perf.metrics import METRICS, SHAPE, SHAPE_DOC
from fullswarm.reasons import Code
from fullswarm.runtime import Lane

OTHER = "other"
LIFECYCLES = ("CLOSED", "OPEN", "READY", "ACTIVE", "FAULT")
CODES = frozenset(str(each) for each in Code)
DROPS = frozenset({*(lane.name.lower() for lane in Lane), "rate"})
LONGEST_LABEL = 64
MOST_PROCESSES = 256
"""Of one supervisor."""
QUANTITIES: dict[str, frozenset[str]] = {
    **{name: frozenset(metric.quantities) for name, metric in METRICS.items()},
    SHAPE: frozenset(SHAPE_DOC),
    "coverage": frozenset({"fraction", "area_m2", "cells", "refused_hosts"}),
}
MEASURED = f"{TRUTH}_"
"""How a summary's quantity begins that a supervisory process measured."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A number of each robot, or of each agent."""

    name: str
    doc: str
    read: Callable[..., float | None]
    counter: bool = False


def _known(value: float) -> float | None:
    return value if value >= 0.0 else None


def _flag(value: bool | None) -> float | None:
    return None if value is None else float(value)


def _of_health() -> tuple[Reading, ...]:
    def reading(name: str, doc: str, read: Callable[[RobotHealth], float | None], *, counter: bool = False) -> Reading:
        return Reading(f"fullswarm_robot_{name}", doc, read, counter)

    return (
        reading("moving", "1 while it moves.", lambda h: float(h.moving)),
        reading("estop", "1 while its e-stop is latched.", lambda h: float(h.estop)),
        reading("charging", "1 while current flows into its battery.", lambda h: _flag(h.charging)),
        reading("battery_ratio", "Charge of its battery, 0 to 1.", lambda h: _known(h.battery)),
        reading("contacts", "Bodies that it touches now.", lambda h: float(h.contacts)),
        reading(
            "collisions_total", "Contacts begun since its agent started.", lambda h: float(h.collisions), counter=True
        ),
        reading(
            "position_sigma_meters", "Standard deviation of its position along the worse axis.",
            lambda h: _known(h.position_sigma_m),
        ),
        reading("heading_sigma_radians", "Standard deviation of its heading.", lambda h: _known(h.heading_sigma_rad)),
        reading(
            "filter_deviation_meters_per_second", "Difference of allowed and desired velocity now.",
            lambda h: h.deviation_m_s,
        ),
        reading(
            "filter_deviation_meters_total", "The same, added up over time since its agent started.",
            lambda h: h.deviation_m, counter=True,
        ),
    )  # fmt: skip


def _of_agents() -> tuple[Reading, ...]:
    def reading(name: str, doc: str, read: Callable[[HealthReport], float | None], *, counter: bool = False) -> Reading:
        return Reading(f"fullswarm_agent_{name}", doc, read, counter)

    return (
        reading("ticks_total", "Periods of its loop since it started.", lambda r: float(r.ticks), counter=True),
        reading("late_ticks_total", "Periods begun more than 1 ms late.", lambda r: float(r.late_ticks), counter=True),
        reading("missed_ticks_total", "Periods skipped.", lambda r: float(r.missed_ticks), counter=True),
        reading("worst_tick_delay_seconds", "The latest period since it started.", lambda r: r.worst_late_s),
        reading(
            "core_round_trip_seconds", "To the core and back, the shortest lately.", lambda r: _known(r.round_trip_s)
        ),
        reading("wall_clock_offset_seconds", "Time of day there less the core's.", lambda r: r.wall_offset_s),
    )  # fmt: skip


HEALTH, AGENTS = _of_health(), _of_agents()
COLUMNS = {
    "x_m": ("x_meters", "Estimated position along x, world frame.", False),
    "y_m": ("y_meters", "Estimated position along y, world frame.", False),
    "goal_m": ("goal_distance_meters", "Distance to its goal or target.", False),
    "gap_m": ("least_gap_meters", "Smallest gap to a neighbour so far.", False),
    "distance_m": ("distance_meters_total", "Distance travelled.", True),
    "energy_j": ("energy_joules_total", "What driving cost.", True),
    "deadlock_count": ("deadlocks_total", "How often it was found blocked and stepped aside.", True),
    "reversals": ("reversals_total", "Changes of sign of a wheel's commanded speed, mean of both wheels.", True),
}
"""Columns of the measurements → name, text, whether it only grows."""
TOTALS = {
    "sent": ("sent_messages_total", "Messages that it published."),
    "received": ("received_messages_total", "Messages that it took in."),
}


class SwarmCollector(Collector):
    """Yields the metrics of what a :class:`SwarmNode` keeps."""

    def __init__(self, swarm: str, node: SwarmNode) -> None:
        self._swarm, self._node = swarm, node

    def describe(self) -> Iterable[Metric]:
        """Describe nothing: the registry need not collect to check names."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """Yield all families."""
        yield from self._exporter()
        yield from self._robots()
        yield from self._robot_states()
        yield from self._measured()
        yield from self._agents()
        yield from self._processes()
        yield from self._core()

    def _exporter(self) -> Iterator[Metric]:
        node = self._node
        info = GaugeMetricFamily("fullswarm_swarm_info", "The swarm that is observed.", labels=("swarm", "version"))
        info.add_metric((self._swarm, __version__), 1.0)
        yield info
        yield GaugeMetricFamily(
            "fullswarm_exporter_hub_connected", "1 while this exporter is connected to the hub.", float(node.connected)
        )
        yield CounterMetricFamily(
            "fullswarm_exporter_received_messages_total", "Messages that this exporter took in.", node.received
        )
        yield CounterMetricFamily(
            "fullswarm_exporter_refused_messages_total", "Messages that it did not keep for their names.", node.refused
        )

    # ------------------------------------------------------------------ robots
    def _robots(self) -> Iterator[Metric]:
        rows = list(self._node.robots.items())
        yield _family(
            "fullswarm_robot_last_message_age_seconds",
            "Since its last health report came.",
            ("robot",),
            (((robot,), age_s) for robot, age_s, _ in rows),
        )
        info = ("robot", "host", "make", "model", "firmware")
        yield _family(
            "fullswarm_robot_info",
            "What the robot is.",
            info,
            (((robot, *map(_short, (host, h.make, h.model, h.firmware))), 1.0) for robot, _, (h, host) in rows),
        )
        for each in HEALTH:
            samples = (((robot,), each.read(h)) for robot, _, (h, _) in rows)
            yield _family(each.name, each.doc, ("robot",), samples, counter=each.counter)
        filtered, begun = self._node.filtered, self._node.interventions
        yield _family(
            "fullswarm_robot_filter_active",
            "1 while the safety filter changes its motion.",
            ("robot",),
            (((robot,), float(robot in filtered)) for robot, _, _ in rows),
        )
        yield _family(
            "fullswarm_robot_filter_interventions_total", "How often it began to, since this exporter started.",
            ("robot",), (((robot,), float(begun.get(robot, 0))) for robot, _, _ in rows), counter=True,
        )  # fmt: skip

    def _robot_states(self) -> Iterator[Metric]:
        rows = list(self._node.robots.items())
        yield _family(
            "fullswarm_robot_lifecycle",
            "1 for the state in which its driver is.",
            ("robot", "state"),
            (((robot, each), float(h.lifecycle == each)) for robot, _, (h, _) in rows for each in LIFECYCLES),
        )
        yield _family(
            "fullswarm_robot_behaviour",
            "1 for the behaviour that it runs; no sample: none.",
            ("robot", "behaviour"),
            (
                ((robot, h.behaviour if ROBOT_ID.match(h.behaviour) else OTHER), 1.0)
                for robot, _, (h, _) in rows
                if h.behaviour
            ),
        )
        yield _family(
            "fullswarm_robot_fault",
            "1 while its driver reports a fault, by code.",
            ("robot", "code"),
            (((robot, _code(h.fault_code)), 1.0) for robot, _, (h, _) in rows if h.fault),
        )
        yield _family(
            "fullswarm_robot_stopped",
            "1 while it stands although a behaviour is enabled, by code of the reason.",
            ("robot", "code"),
            (((robot, _code(h.stop_code)), 1.0) for robot, _, (h, _) in rows if h.stop_reason),
        )
        yield _family(
            "fullswarm_robot_charge_phase",
            "1 for the phase of its charge; no sample: it does not go to charge.",
            ("robot", "phase"),
            (((robot, h.charge.phase), 1.0) for robot, _, (h, _) in rows if h.charge is not None),
        )

    def _measured(self) -> Iterator[Metric]:
        messages = [message for _, _, message in self._node.measured.items()]
        there = {robot for robot, _, _ in self._node.robots.items()}
        for column, (name, doc, counter) in COLUMNS.items():
            samples = (
                ((robot,), value if abs(value) < math.inf else None)
                for message in messages if column in message.columns
                for robot, value in zip(message.robots, message.columns[column], strict=False)
                if robot in there  # the supervisory process of a world measures the same robots
                and message.host != TRUTH
            )  # fmt: skip
            yield _family(f"fullswarm_robot_{name}", doc, ("robot",), samples, counter=counter)
        for total, (name, doc) in TOTALS.items():
            found = (((message.host,), message.totals.get(total)) for message in messages if message.host != TRUTH)
            yield _family(f"fullswarm_agent_{name}", doc, ("host",), found, counter=True)

    # ------------------------------------------------------------------ processes
    def _agents(self) -> Iterator[Metric]:
        rows = list(self._node.hosts.items())
        yield _family(
            "fullswarm_agent_last_message_age_seconds",
            "Since its last health report came.",
            ("host",),
            (((host,), age_s) for host, age_s, _ in rows),
        )
        yield _family(
            "fullswarm_agent_info", "Software of the agent.", ("host", "version"),
            (((host, _short(report.version)), 1.0) for host, _, report in rows),
        )  # fmt: skip
        for each in AGENTS:
            samples = (((host,), each.read(report)) for host, _, report in rows)
            yield _family(each.name, each.doc, ("host",), samples, counter=each.counter)
        dropped: Counter[tuple[str, str]] = Counter()
        for host, _, report in rows:
            for cause, count in report.dropped.items():
                dropped[host, cause if cause in DROPS else OTHER] += count
        yield _family(
            "fullswarm_agent_dropped_messages_total", "Messages that it dropped, by lane or cause.", ("host", "cause"),
            ((each, float(count)) for each, count in dropped.items()), counter=True,
        )  # fmt: skip

    def _processes(self) -> Iterator[Metric]:
        nodes = list(self._node.nodes.items())
        yield _family(
            "fullswarm_node_heartbeat_age_seconds",
            "Since the last heartbeat of a process of the core or the world.",
            ("node",),
            (((node,), age_s) for node, age_s, _ in nodes),
        )
        yield _family(
            "fullswarm_node_active_requests",
            "Requests that it works on.",
            ("node",),
            (((node,), float(len(beat.active))) for node, _, beat in nodes),
        )
        states = [
            (host, state)
            for host, age_s, report in self._node.supervisors.items()
            if age_s <= PROCESSES_S
            for state in report.processes[:MOST_PROCESSES]
        ]
        yield _family(
            "fullswarm_process_phase",
            "1 for the phase of a process that a supervisor keeps running.",
            ("host", "process", "phase"),
            (
                ((host, state.name, phase), float(state.phase == phase))
                for host, state in states
                for phase in get_args(ProcessPhase)
            ),
        )
        yield _family(
            "fullswarm_process_starts_total", "How often its supervisor has started it.", ("host", "process"),
            (((host, state.name), float(state.starts)) for host, state in states), counter=True,
        )  # fmt: skip

    # ------------------------------------------------------------------ core
    def _core(self) -> Iterator[Metric]:
        node = self._node
        yield _family(
            "fullswarm_requests_total",
            "Requests that have come to a phase, since this exporter started.",
            ("phase",),
            (((phase,), float(node.requests[phase])) for phase in get_args(Phase)),
            counter=True,
        )
        if node.leases is not None:
            yield GaugeMetricFamily("fullswarm_leases", "Robots that an operator holds.", len(node.leases.leases))
        if node.docks is not None:
            phases = Counter(each.phase for each in node.docks.docks)
            kinds = (*get_args(ChargePhase), "free", "blocked", "failed")
            yield _family(
                "fullswarm_docks",
                "Slots of docks by what happens there.",
                ("phase",),
                (((phase,), float(phases[phase])) for phase in kinds),
            )
            yield GaugeMetricFamily(
                "fullswarm_docks_waiting_robots", "Robots that wait for a dock.", len(node.docks.waiting)
            )
        yield _family(
            "fullswarm_summary", "The newest summaries of the swarm; units are in the quantities' names.",
            ("metric", "quantity"),
            (
                ((metric, quantity), value)
                for metric, _, summary in node.summaries.items()
                for quantity, value in sorted(summary.values.items())
                if quantity.removeprefix(MEASURED) in QUANTITIES[metric]
            ),
        )  # fmt: skip


def _family(
    name: str, doc: str, labels: Sequence[str], samples: Iterable[tuple[Sequence[str], float | None]],
    *, counter: bool = False,
) -> Metric:  # fmt: skip
    """Return a family of the samples that have a value; of two with the same labels the first counts.

    A counter has no negative value, whatever a message says: Prometheus would refuse the whole scrape.
    """
    kind: type[CounterMetricFamily | GaugeMetricFamily] = CounterMetricFamily if counter else GaugeMetricFamily
    family, seen = kind(name, doc, labels=labels), set()
    for values, value in samples:
        if value is not None and (value >= 0.0 or not counter) and (key := tuple(values)) not in seen:
            seen.add(key)
            family.add_metric(key, value)
    return family


def _short(text: str) -> str:
    return text[:LONGEST_LABEL]


def _code(code: str) -> str:
    return code if code in CODES and code else OTHER
