"""Reads what a control law declares to broadcast: the dataclass ``Says`` of its module, made of `rows` like ``Memory``.

@dataclass
class Says:
    estimate: Array = rows(2)
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm import memory
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array
from fullswarm.messages import SAYS_BYTES, SAYS_HZ

RESERVED = frozenset({"of", "sender", "index", "age_s", "distance", "offset", "count", "sum"})
"""Names that `Heard` has itself."""
NUMBER_BYTES = 8

RANGE, RATE = "says_m", "says_hz"
"""Parameters of a behaviour: how far its robots' broadcasts are taken in, and how often each sends at most."""


@dataclass(frozen=True, slots=True)
class Layout:
    """The fields of a declaration as columns of one array (n, width)."""

    fields: dict[str, memory.Rows]
    columns: dict[str, slice]
    widths: dict[str, int]
    width: int

    def write(self, values: dict[str, Any], out: Array) -> None:
        """Write fields of n robots into `out` (n, width).

        Raises
        ------
        ConfigError
            A field is missing, unknown, not finite in a robot's row that has other numbers, or of another shape.
        """
        if values.keys() != self.fields.keys():
            raise ConfigError(
                f"view.say({', '.join(values)}): declared are {', '.join(self.fields)}", hint="say all of them"
            )
        for name, value in values.items():
            shape = (len(out), *self.fields[name].shape)
            given = np.asarray(value, float)
            if given.size != math.prod(shape) and given.ndim:
                raise ConfigError(f"view.say({name}=...): the shape is {given.shape}, declared is {shape}")
            out[:, self.columns[name]] = given.reshape(len(out), -1) if given.ndim else given

    def read(self, name: str, table: Array) -> NDArray[Any]:
        """Return one field of rows of values (e, width)."""
        found = self.fields[name]
        numbers = table[:, self.columns[name]]
        if found.kind is not float:
            numbers = np.rint(numbers).astype(found.kind)
        return numbers.reshape(len(table), *found.shape)


def layout_of(module: Any) -> Layout | None:
    """Return how a control law's broadcasts are laid out; None: it declares none.

    Raises
    ------
    ConfigError
        The declaration is wrong, or larger than `SAYS_BYTES`.
    """
    says = getattr(module, "Says", None)
    return None if says is None else _layout(says)


@functools.cache
def _layout(says: type) -> Layout:
    fields = memory.declared(says)
    where = f"{says.__module__}.{says.__qualname__}"
    taken = sorted(RESERVED & fields.keys())
    if taken:
        raise ConfigError(f"'{taken[0]}' is a name of `view.heard` itself", where=where, hint="give it another name")
    columns, widths, width = {}, {}, 0
    for name, found in fields.items():
        widths[name] = math.prod(found.shape)
        columns[name] = slice(width, width + widths[name])
        width += widths[name]
    if width * NUMBER_BYTES > SAYS_BYTES:
        raise ConfigError(
            f"a robot would broadcast {width * NUMBER_BYTES} bytes", where=where,
            hint=f"{SAYS_BYTES} at most: {SAYS_BYTES // NUMBER_BYTES} numbers",
        )  # fmt: skip
    return Layout(fields, columns, widths, width)


def rate_hz(parameters: dict[str, Any]) -> float:
    """Return how often a robot with these parameters may broadcast."""
    given = parameters.get(RATE)
    return min(float(given), SAYS_HZ) if isinstance(given, int | float) else SAYS_HZ


def range_m(parameters: dict[str, Any]) -> float:
    """Return the declared range of broadcasts; 0: that within which neighbours are sensed."""
    given = parameters.get(RANGE)
    return float(given) if isinstance(given, int | float) else 0.0
