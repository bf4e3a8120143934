"""Lists the numbers of a robot that can be charted: title, unit, meaning, and where each is read.

A further number is a line in `FIELDS`; the page learns of it by the frame ``catalogue``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fullswarm.operator.view import RobotRow
from fullswarm.perf.shape import squared_distances

Source = Literal["row", "health", "swarm"]
"""Where a field is read: an attribute of `RobotRow` or `RobotHealth`, or calculated from all robots."""
Table = NDArray[np.float64]

MOST_NEIGHBOURS = 300
"""With more robots the distance to the nearest is not calculated: all pairs are compared."""


@dataclass(frozen=True, slots=True)
class Field:
    """A number of each robot.

    Attributes
    ----------
    scale : factor from the value to its unit: 100 for a share in %
    signed : whether values below zero are known ones; else they mean that it is unknown
    """

    title: str
    unit: str
    doc: str
    source: Source
    attribute: str = ""
    scale: float = 1.0
    signed: bool = True


FIELDS = {
    "speed": Field("Speed", "m/s", "speed along the heading, as estimated", "row", "speed_m_s"),
    "turn": Field("Turn rate", "rad/s", "turn rate, as estimated; positive: counter-clockwise", "row", "turn_rad_s"),
    "x": Field("Position x", "m", "estimated position, to the east", "row", "x_m"),
    "y": Field("Position y", "m", "estimated position, to the north", "row", "y_m"),
    "heading": Field("Heading", "rad", "estimated heading, from -π to π; 0: along x", "row", "heading_rad"),
    "age": Field("Age of data", "s", "time since its last message arrived", "row", "age_s"),
    "round_trip": Field(
        "Round trip", "s", "from its computer to the core and back, the shortest lately", "row", "round_trip_s",
        signed=False,
    ),
    "command": Field("Commanded speed", "m/s", "speed that its driver was commanded last", "health", "command_m_s"),
    "command_turn": Field(
        "Commanded turn rate", "rad/s", "turn rate that its driver was commanded last", "health", "command_rad_s"
    ),
    "battery": Field("Battery", "%", "charge of its battery", "health", "battery", scale=100.0, signed=False),
    "contacts": Field("Contacts", "", "bodies that it touches now", "health", "contacts"),
    "collisions": Field("Collisions of a robot", "", "contacts begun since its agent started", "health", "collisions"),
    "deviation": Field(
        "Deviation", "m/s", "difference between allowed and desired velocity: what the safety filter changes now",
        "health", "deviation_m_s",
    ),
    "deviation_sum": Field(
        "Deviation, total", "m", "the deviation added up over time since its agent started", "health", "deviation_m"
    ),
    "position_sigma": Field(
        "Uncertainty of position", "m", "standard deviation of the position along the worse axis", "health",
        "position_sigma_m", signed=False,
    ),
    "nearest": Field(
        "Nearest robot", "m",
        f"distance to the centre of the nearest other robot; not calculated with more than {MOST_NEIGHBOURS} robots",
        "swarm",
    ),
}  # fmt: skip
"""Name on the wire and in the page's address → the field. In the order of their sources."""

NAMES = tuple(FIELDS)
_PLACE = {name: number for number, name in enumerate(NAMES)}
_ROW = tuple(each.attribute for each in FIELDS.values() if each.source == "row")
_HEALTH = tuple(each.attribute for each in FIELDS.values() if each.source == "health")
_of_row, _of_health = attrgetter(*_ROW), attrgetter(*_HEALTH)
_NO_HEALTH = (math.nan,) * len(_HEALTH)
_UNSIGNED = [_PLACE[name] for name, each in FIELDS.items() if not each.signed]
_OLD = [_PLACE[name] for name in NAMES if name != "age"]


def read(rows: Sequence[RobotRow]) -> Table:
    """Return the fields of robots, (robots, fields); NaN where a value is unknown, infinite or of a silent robot.

    The age of a silent robot is known.
    """
    table = np.full((len(rows), len(NAMES)), math.nan)
    if not rows:
        return table
    last = len(_ROW) + len(_HEALTH)
    table[:, :last] = [(*_of_row(row), *(_NO_HEALTH if row.health is None else _of_health(row.health))) for row in rows]
    silent = [number for number, row in enumerate(rows) if row.silent]
    if silent:
        table[np.ix_(silent, _OLD)] = math.nan
    for place in _UNSIGNED:
        column = table[:, place]
        column[column < 0.0] = math.nan
    table[~np.isfinite(table)] = math.nan
    table[:, _PLACE["nearest"]] = _nearest_m(table[:, _PLACE["x"]], table[:, _PLACE["y"]])
    return table


def _nearest_m(x_m: Table, y_m: Table) -> Table:
    """Return the distance of each robot (n,) to the nearest other one, m; NaN without one, or for too many robots."""
    found = np.full(len(x_m), math.nan)
    there = np.flatnonzero(np.isfinite(x_m) & np.isfinite(y_m))
    if 1 < len(there) <= MOST_NEIGHBOURS:
        places = np.column_stack([x_m[there], y_m[there]])
        with np.errstate(over="ignore", invalid="ignore"):  # a hostile position may be as far as 1e300 m
            found[there] = np.sqrt(squared_distances(places, places, among=True)[0])
    return found
