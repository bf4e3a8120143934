"""Lists what is measured of a swarm besides coverage: one line per column, one per quantity.

A column is a number per robot (or per host) that an agent publishes at its measurement rate, see
`RobotMeasurement`; a quantity joins a column of all robots to one number of the swarm. A new metric needs a column
that some calculator fills (``agent/telemetry/metrics.py`` says which array) and its record here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fullswarm.keys import TRUTH

Restart = Literal["add", "least", "most", "newest"]
"""What becomes of a robot's value when its agent is started again: counters add up, extremes stay, states do not."""

Rule = Literal["sum", "mean", "max", "min", "share", "rms", "count", "positive"]
"""How robots' values become the swarm's; robots without a number are left out. share: of robots that have one;
count: how many have one; positive: how many have one above zero."""

OFTEN_S, SELDOM_S = 1.0, 5.0
"""How often summaries are sent. Most seldom: so many metrics are reported at a time, and at the end anyway."""


@dataclass(frozen=True, slots=True)
class Column:
    """A number per robot, or one per host."""

    unit: str
    doc: str
    restart: Restart = "newest"
    per_host: bool = False


@dataclass(frozen=True, slots=True)
class Metric:
    """Quantities that are summarized together."""

    doc: str
    quantities: dict[str, tuple[Rule, str]]  # name of the quantity → rule, column
    per_robot: str = ""  # the column that is shown per robot
    period_s: float = SELDOM_S


COLUMNS = {
    "x_m": Column("m", "estimated position"),
    "y_m": Column("m", "estimated position"),
    "heading_rad": Column("rad", "estimated heading"),
    "goal_m": Column("m", "distance to the goal or target that it was given; none without one"),
    "arrived_s": Column("s", "from the request until it last entered its goal's disc; none outside it"),
    "settled": Column(
        "", "1 while it stands as near to its goal as it can get, outside the goal's disc; none otherwise"
    ),
    "still_s": Column("s", "since it last moved by more than its radius; none without a task"),
    "gap_m": Column("m", "smallest gap to a neighbour so far: between centres, less both radii", "least"),
    "distance_m": Column("m", "distance travelled", "add"),
    "events": Column("", "contacts begun; two robots that meet count one each", "add"),
    "deadlock_count": Column("", "how often it was found blocked and stepped aside", "add"),
    "sidestep_s": Column("s", "time spent on stepping aside", "add"),
    "no_way": Column("", "1 while it knows no way to where it is to drive, else 0"),
    "deviation_m": Column("m", "distance between desired and filtered motion, added up over time", "add"),
    "reversals": Column("", "how often a wheel's commanded speed changed its sign, mean of both wheels", "add"),
    "speed_variation_m_s": Column("m/s", "total variation of the commanded speed", "add"),
    "turn_variation_rad_s": Column("rad/s", "total variation of the commanded turn rate", "add"),
    "delay_s": Column("s", "longest delay of the states that it receives from others, from measurement to arrival"),
    "energy_j": Column("J", "what driving cost, see `perf/calculators.py`", "add"),
    "ticks": Column("", "control periods and other timers run", "add", per_host=True),
    "late": Column("", "of them later than 1 ms", "add", per_host=True),
    "missed": Column("", "whole periods skipped", "add", per_host=True),
    "worst_late_s": Column("s", "the latest of them", "most", per_host=True),
    "sent": Column("", "messages published by the agent", "add", per_host=True),
    "received": Column("", "messages that the agent took in", "add", per_host=True),
    "broadcasts_sent": Column("", "broadcasts of its robots' behaviours, one per robot and time", "add", per_host=True),
    "broadcasts_received": Column("", "those of others that it took in", "add", per_host=True),
    "broadcasts_dropped": Column("", "those that it dropped, beyond their senders' rates", "add", per_host=True),
}

LOOP: dict[str, tuple[Rule, str]] = {
    "ticks": ("sum", "ticks"),
    "late": ("sum", "late"),
    "missed": ("sum", "missed"),
    "worst_late_s": ("max", "worst_late_s"),
    "sent": ("sum", "sent"),
    "received": ("sum", "received"),
}

SHAPE = "shape"

METRICS = {
    "work": Metric(
        "Distance travelled",
        {
            "total_m": ("sum", "distance_m"),
            "mean_m": ("mean", "distance_m"),
            "max_m": ("max", "distance_m"),
            "robots": ("count", "distance_m"),
        },
        "distance_m",
        OFTEN_S,
    ),
    "collisions": Metric(
        "Contacts with robots and obstacles",
        {
            "events": ("sum", "events"),
            "robots_touched": ("positive", "events"),
            "max_events": ("max", "events"),
            "robots": ("count", "events"),
        },
        "events",
        OFTEN_S,
    ),
    "arrival": Metric(
        "Which robots are at their goals, and since when, counted from the request; which settled as near as possible",
        {
            "fraction": ("share", "arrived_s"),
            "mean_s": ("mean", "arrived_s"),
            "last_s": ("max", "arrived_s"),
            "settled": ("count", "settled"),
        },
        "arrived_s",
    ),
    "separation": Metric("Smallest gap between two robots", {"min_m": ("min", "gap_m")}, "gap_m"),
    "deadlocks": Metric(
        "Robots that blocked each other",
        {"deadlock_count": ("sum", "deadlock_count"), "sidestep_s": ("sum", "sidestep_s")},
        "deadlock_count",
    ),
    "ways": Metric("Robots that know no way to their goals", {"blocked": ("positive", "no_way")}, "no_way"),
    "filter": Metric(
        "How much the safety filter changed",
        {"total_m": ("sum", "deviation_m"), "mean_m": ("mean", "deviation_m"), "max_m": ("max", "deviation_m")},
        "deviation_m",
    ),
    "smoothness": Metric(
        "How often wheels reverse, and how much the set-points change, since the start",
        {
            "reversals_mean": ("mean", "reversals"),
            "reversals_max": ("max", "reversals"),
            "speed_variation_m_s": ("mean", "speed_variation_m_s"),
            "turn_variation_rad_s": ("mean", "turn_variation_rad_s"),
        },
        "reversals",
    ),
    "network": Metric(
        "How late the states of other robots arrive",
        {"delay_mean_s": ("mean", "delay_s"), "delay_max_s": ("max", "delay_s")},
        "delay_s",
    ),
    "energy": Metric(
        "What driving cost",
        {"total_j": ("sum", "energy_j"), "mean_j": ("mean", "energy_j"), "max_j": ("max", "energy_j")},
        "energy_j",
    ),
    "broadcasts": Metric(
        "What behaviours broadcast to neighbours",
        {
            "sent": ("sum", "broadcasts_sent"),
            "received": ("sum", "broadcasts_received"),
            "dropped": ("sum", "broadcasts_dropped"),
        },
    ),
    "loop": Metric("Deadlines and messages of the agents", LOOP),
    "formation": Metric("Root mean square distance to the targets", {"error_m": ("rms", "goal_m")}, "goal_m"),
    SHAPE: Metric("The swarm's shape, see `SHAPE_DOC`", {}),
}

SHAPE_DOC = {
    "order": "length of the mean heading vector: 1 when all look one way",
    "spacing_m": "mean distance to the nearest neighbour",
    "diameter_m": "largest distance of two robots",
    "voronoi_m2": "mean over the arena of the squared distance to the nearest robot (Lloyd's cost over the area)",
}
"""The swarm's shape now, from x_m, y_m and heading_rad of all robots: see `perf/shape.py`."""

COVERAGE_DOC = {
    "fraction": ("%", "share of the arena that was covered by any robot so far"),
    "area_m2": ("m²", "area that was covered by any robot so far"),
    "cells": ("", "cells of the grid that were covered by any robot so far"),
    "refused_hosts": ("", "hosts whose grid differs from the others' and is left out"),
}
"""Unit and meaning of what ``coverage`` has, see `perf/coverage.py`."""
_SHAPE_UNITS = {"order": "", "spacing_m": "m", "diameter_m": "m", "voronoi_m2": "m²"}
_RULES = {
    "sum": "sum over all robots", "mean": "mean of all robots", "max": "largest of all robots",
    "min": "smallest of all robots", "share": "share of the robots that have one", "rms": "root mean square",
    "count": "robots that have one", "positive": "robots that have one above zero",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Quantity:
    """What a number of a summary is: its unit (% for a share from 0 to 1) and meaning."""

    unit: str
    doc: str


def describe(metric: str, quantity: str) -> Quantity | None:
    """Return what a quantity of a summary is; None: it is in no table here."""
    if quantity.startswith(f"{TRUTH}_"):
        found = describe(metric, quantity.removeprefix(f"{TRUTH}_"))
        return found and Quantity(found.unit, f"{found.doc}; as a supervisory process measured it")
    if metric == "coverage" and quantity in COVERAGE_DOC:
        return Quantity(*COVERAGE_DOC[quantity])
    if metric == SHAPE and quantity in SHAPE_DOC:
        return Quantity(_SHAPE_UNITS[quantity], SHAPE_DOC[quantity])
    if metric not in METRICS or quantity not in METRICS[metric].quantities:
        return None
    rule, name = METRICS[metric].quantities[quantity]
    unit = {"share": "%", "count": "", "positive": ""}.get(rule, COLUMNS[name].unit)
    return Quantity(unit, f"{METRICS[metric].doc}. {_RULES[rule].capitalize()}: {COLUMNS[name].doc}")
