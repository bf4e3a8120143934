"""Memory of a control law: arrays with one row per robot that the agent keeps from call to call.

A law declares it as a dataclass named ``Memory`` in its module and takes it as its third argument:

    @dataclass
    class Memory:
        integral: Array = rows(2)  # (n, 2), zeros at first
        started: Flags = rows(fill=False)  # (n,)

    def velocity(view, params, memory): ...

What a law assigns to a field is written into the rows, so that ``memory.integral = memory.integral + step`` and
``memory.integral += step`` are the same.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import ConfigError

_KEY = "fullswarm rows"


class Rows(NamedTuple):
    """One declared field: what each robot has of it, and what it holds at first."""

    shape: tuple[int, ...]
    fill: float | int | bool

    def new(self, count: int) -> NDArray[Any]:
        """Return the array of `count` robots; of floats, integers or flags as the fill is."""
        return np.full((count, *self.shape), self.fill)

    @property
    def kind(self) -> type:
        """``float``, ``int`` or ``bool``."""
        return type(self.fill)


def rows(*shape: int, fill: float | int | bool = 0.0) -> Any:
    """Declare an array with one row per robot: ``rows()`` is (n,), ``rows(2)`` is (n, 2).

    Parameters
    ----------
    fill : what it holds when the robot starts the behaviour; its type is that of the array
    """
    if not all(isinstance(each, int) and each >= 1 for each in shape):
        raise ConfigError(f"rows{shape}: the sizes must be whole numbers from 1", hint="rows() is one number per robot")
    if type(fill) not in (float, int, bool):
        raise ConfigError(f"rows(fill={fill!r}): the fill must be a float, a whole number or a flag")
    return dataclasses.field(metadata={_KEY: Rows(shape, fill)})


@functools.cache
def declared(kind: type) -> dict[str, Rows]:
    """Return the fields of a declaration.

    Raises
    ------
    ConfigError
        It is no dataclass, or a field was not made by :func:`rows`.
    """
    where = f"{kind.__module__}.{kind.__qualname__}"
    if not dataclasses.is_dataclass(kind):
        raise ConfigError("it is no dataclass", where=where, hint="put @dataclass above it")
    fields = {each.name: each.metadata.get(_KEY) for each in dataclasses.fields(kind)}
    for name, found in fields.items():
        if found is None:
            raise ConfigError(
                f"'{name}' does not say how large it is", where=where, hint=f"{name}: Array = rows(), or rows(2), ..."
            )
    if not fields:
        raise ConfigError("it declares nothing", where=where, hint="count: Array = rows()")
    return {name: found for name, found in fields.items() if found is not None}


def allocate(kind: type, count: int) -> Any:
    """Return a new memory of `count` robots, as declared by the dataclass `kind`."""
    fields = declared(kind)
    made: Any = object.__new__(_writing_rows(kind))
    for name, each in fields.items():
        object.__setattr__(made, name, each.new(count))
    return made


@functools.cache
def _writing_rows(kind: type) -> type:
    """Return `kind` with assignments that write into the arrays, which the agent shares."""

    def assign(self: object, name: str, value: object) -> None:
        if name not in declared(kind):
            known = ", ".join(declared(kind))
            raise AttributeError(f"the memory declares no '{name}' (it has {known}): add it to the dataclass")
        kept = getattr(self, name)
        if value is not kept:
            kept[...] = value

    return type(kind.__name__, (kind,), {"__setattr__": assign, "__module__": kind.__module__})


def copy_row(source: Any, row: int, target: Any, place: int) -> None:
    """Copy what one robot remembers from one memory into another of the same kind."""
    for name in declared(type(source).__mro__[1]):
        getattr(target, name)[place] = getattr(source, name)[row]


def count(memory: Any) -> int:
    """Return of how many robots a memory is; at least one field is declared."""
    return len(getattr(memory, next(iter(declared(type(memory).__mro__[1])))))


def as_lists(memory: Any, row: int) -> dict[str, list[float]]:
    """Return what one robot remembers, each field as a flat list of numbers; flags are 0 and 1."""
    return {
        name: np.ravel(getattr(memory, name)[row]).astype(float).tolist() for name in declared(type(memory).__mro__[1])
    }
