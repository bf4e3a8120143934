"""Finds the places on the map that a mission's steps name, by the declared kinds of their parameters; pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fullswarm.core.behaviours import Record, resolve
from fullswarm.errors import RequestRefused
from fullswarm.messages import MOST_PLACE_POINTS, StepPlace, Value

METRES, BOUNDS = "m", "world/bounds"
"""A point in another unit is none of the world; what defaults to the arena's bounds is an area."""
FARTHEST_M = 1e7
TARGET, TARGETS = "target", "targets"


def places_of(record: Record, parameters: Mapping[str, Value], robots: Sequence[str]) -> tuple[StepPlace, ...]:
    """Return the places that a request names.

    Parameters
    ----------
    record
        Of the behaviour.
    parameters
        As requested. An area that is not given is the whole arena, and no place.
    robots
        That the request means; a formation has one target for each.
    """
    if record.formation and robots and (targets := _targets(record, parameters, robots)):
        return (StepPlace(parameter=TARGETS, kind="formation", points=targets),)
    found: list[StepPlace] = []
    for name, parameter in record.parameters.items():
        value = parameters.get(name, parameter.default)
        if parameter.unit != METRES or not isinstance(value, list | tuple):
            continue
        points = _points([value] if parameter.type == "point" else value if parameter.type == "points" else ())
        if points:
            area = parameter.type == "points" and parameter.default_from == BOUNDS
            found.append(
                StepPlace(
                    parameter=name,
                    kind="area" if area else "point" if parameter.type == "point" else "points",
                    points=points,
                )
            )
    return tuple(found)


def _targets(record: Record, parameters: Mapping[str, Value], robots: Sequence[str]) -> tuple[tuple[float, float], ...]:
    """Return the targets of a formation; none if its robots are not known yet, or what else it lacks."""
    try:
        complete = resolve(record, parameters, robots)
    except RequestRefused:  # a value that only the core's database has is none of a formation
        return ()
    own = [values.get(TARGET) for values in complete.values()]
    shared = next(iter(complete.values()), {}).get(TARGETS)
    return _points(shared if isinstance(shared, list) else own)


def _points(values: Sequence[object]) -> tuple[tuple[float, float], ...]:
    pairs = (each for each in values if isinstance(each, list | tuple) and len(each) == 2)
    points = [(float(x), float(y)) for x, y in pairs if isinstance(x, int | float) and isinstance(y, int | float)]
    # A number that no message may have would make every receiver refuse the whole status.
    return tuple(each for each in points if all(abs(value) <= FARTHEST_M for value in each))[:MOST_PLACE_POINTS]
