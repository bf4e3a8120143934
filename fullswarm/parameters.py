"""Parameters of a request as a control law reads them, columns with one row per robot; and the goals in them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fullswarm.errors import ConfigError
from fullswarm.kernels import Array
from fullswarm.messages import Value

Goals = tuple[tuple[float, float], ...]


class Params:
    """Parameters of a control law as columns, one row per robot: ``params.gain`` (n, 1), ``params.goal`` (n, 2).

    Words and lists of points come as they are, from the first robot of the group.
    """

    def __init__(self, rows: list[dict[str, Value]]) -> None:
        for name, first in rows[0].items():
            self.__dict__[name] = _column([row[name] for row in rows], first)  # whatever its name

    def update(self, row: int, values: dict[str, Value]) -> bool:
        """Write one robot's new values into the columns; False if a value is no number or point, or not as before."""
        for name, value in values.items():
            column = self.__dict__.get(name)
            if not isinstance(column, np.ndarray):
                return False
            width = 1 if type(value) is float else column_width(value)
            if column.shape[1] != width:
                return False
            if width == 1:
                column[row, 0] = value  # a number into a place is much cheaper than into a row
            else:
                column[row] = value
        return len(values) == len(self.__dict__)

    def __getattr__(self, name: str) -> Array:
        """Report which parameter the control law misses (only called when it is not there)."""
        raise ConfigError(f"the law needs a parameter '{name}' that the behaviour's record does not give")


def column_width(value: Value) -> int:
    """Return how many columns a value takes: a number 1, a point 2, anything else none."""
    if isinstance(value, list):
        return 2 if len(value) == 2 and all(isinstance(each, int | float) for each in value) else 0
    return 1 if isinstance(value, int | float) else 0


def _column(values: list[Value], first: Value) -> object:
    width = column_width(first)
    return np.array(values, float).reshape(len(values), width) if width else first


def goals_of(parameters: Mapping[str, Value]) -> Goals:
    """Return where a robot shall be, m: its target, the goal of all, or any target of an assigned formation."""
    for name in ("target", "goal"):
        if (point := _point(parameters.get(name))) is not None:
            return (point,)
    targets = parameters.get("targets")
    points = map(_point, targets) if isinstance(targets, list) else ()
    return tuple(point for point in points if point is not None)


def _point(value: object) -> tuple[float, float] | None:
    if isinstance(value, list) and len(value) == 2 and all(isinstance(each, int | float) for each in value):
        return float(value[0]), float(value[1])
    return None
