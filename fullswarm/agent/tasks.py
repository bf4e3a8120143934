"""Which robot runs what: one task per robot, grouped so that a law is called once for all robots that run it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fullswarm import registry
from fullswarm.agent import ranges
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Index
from fullswarm.messages import ControlRequest, Value

if TYPE_CHECKING:
    from fullswarm.agent.view import View


CENTRALISED = ""
"""Law name of a task that has no law on board and obeys Command messages."""

HEARING = "hearing_m"


class Params:
    """Parameters of a law as columns, one row per robot: ``params.gain`` (n, 1), ``params.goal`` (n, 2).

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
            width = 1 if type(value) is float else _width(value)
            if column.shape[1] != width:
                return False
            if width == 1:
                column[row, 0] = value  # a number into a place is much cheaper than into a row
            else:
                column[row] = value
        return len(values) == len(self.__dict__)

    def __getattr__(self, name: str) -> Array:
        """Tell which parameter a law misses (only called when it is not there)."""
        raise ConfigError(f"the law needs a parameter '{name}' that the behaviour's record does not give")


def _width(value: Value) -> int:
    """Return how many columns a value takes: a number 1, a point 2, anything else none."""
    if isinstance(value, list):
        return 2 if len(value) == 2 and all(isinstance(each, int | float) for each in value) else 0
    return 1 if isinstance(value, int | float) else 0


def _column(values: list[Value], first: Value) -> object:
    width = _width(first)
    return np.array(values, float).reshape(len(values), width) if width else first


def _kind(name: str, value: Value) -> tuple[str, str]:
    """Return what robots must have in common to share one call of a law: kinds, words, and how far they listen."""
    width = _width(value)
    return name, str(width) if width and name != HEARING else repr(value)


def _alike(one: ControlRequest, other: ControlRequest) -> bool:
    """Tell whether two requests differ by no more than their parameters and their time."""
    return (
        one.law == other.law
        and one.filtered == other.filtered
        and one.centralised == other.centralised
        and one.survives_core == other.survives_core
    )


def _number(value: Value | None, otherwise: float) -> float:
    return float(value) if isinstance(value, int | float) else otherwise


@dataclass(frozen=True, slots=True)
class Task:
    """What one robot was asked to run."""

    request: ControlRequest
    arrived_s: float

    @property
    def law(self) -> str:
        """Name of the law on board, empty for a centralised behaviour."""
        return CENTRALISED if self.request.centralised else self.request.law

    @property
    def lapses_s(self) -> float:
        """When an intent runs out; never for a lasting request."""
        return self.arrived_s + self.request.expires_s if self.request.expires_s > 0 else math.inf


@dataclass(frozen=True, slots=True)
class Group:
    """Robots that run the same law."""

    law: str
    call: Callable[[View, Params], Array]  # the law
    planar: bool  # it wishes planar velocities, not twists
    rows: Index
    params: Params
    hearing_m: float  # 0: the sensing radius


@dataclass(slots=True)
class Tasks:
    """The tasks of n robots, and what the tick needs of them as arrays.

    Attributes
    ----------
    active : (n,) a task is on
    filtered : (n,) it runs behind the safety filter
    lasting : (n,) it is filtered and no intent of a stick
    any_filtered : some task does
    survives_core : (n,) it goes on without the core
    team : (n,) which robots its law counts as neighbours; 0: all that are sensed
    lapses_s : (n,) when it ends by itself; inf
    margin_m, gain_per_s : (n,) settings of the filter: the request's, else the usual ones
    """

    count: int
    usual_margin_m: float
    usual_gain_per_s: float
    gain_limit_per_s: Array  # (n,) what the brakes can follow
    of: list[Task | None] = field(init=False)
    active: NDArray[np.bool_] = field(init=False)
    filtered: NDArray[np.bool_] = field(init=False)
    lasting: NDArray[np.bool_] = field(init=False)
    survives_core: NDArray[np.bool_] = field(init=False)
    team: Index = field(init=False)
    margin_m: Array = field(init=False)
    gain_per_s: Array = field(init=False)
    lapses_s: Array = field(init=False)
    any_filtered: bool = field(init=False, default=False)
    _groups: list[Group] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.of = [None] * self.count
        self.active = np.zeros(self.count, bool)
        self.filtered = np.zeros(self.count, bool)
        self.lasting = np.zeros(self.count, bool)
        self.survives_core = np.zeros(self.count, bool)
        self.team = np.zeros(self.count, np.int64)
        self.margin_m = np.full(self.count, self.usual_margin_m)
        self.gain_per_s = np.minimum(self.usual_gain_per_s, self.gain_limit_per_s)
        self.lapses_s = np.full(self.count, math.inf)

    def enable(self, row: int, task: Task) -> None:
        """Give robot `row` a task in place of the one it has.

        Raises
        ------
        ConfigError
            The robot has no such law, or a parameter is out of range.
        """
        request, before = task.request, self.of[row]
        ranges.check(request)
        alike = before is not None and _alike(before.request, request)
        if not alike and task.law != CENTRALISED:
            registry.law_module(task.law)
        self.of[row] = task
        self.lapses_s[row] = task.lapses_s
        self.team[row] = request.team
        if request.filtered:
            self.lasting[row] = request.expires_s <= 0.0
            self.margin_m[row] = _number(request.parameters.get("safety_margin_m"), self.usual_margin_m)
            gain_per_s = _number(request.parameters.get("barrier_gain_per_s"), self.usual_gain_per_s)
            self.gain_per_s[row] = min(gain_per_s, self.gain_limit_per_s[row])
        if alike and self._renew(row, request):
            return
        self.active[row] = True
        self.filtered[row] = request.filtered
        self.lasting[row] = request.filtered and request.expires_s <= 0.0
        self.survives_core[row] = request.survives_core
        self._groups = None

    def _renew(self, row: int, request: ControlRequest) -> bool:
        """Take new parameters of a running law into its group: what a stick sends twenty times a second."""
        for group in self._groups or ():
            place = 0 if self.count == 1 else int(np.searchsorted(group.rows, row))
            if place < len(group.rows) and group.rows[place] == row:
                same_reach = group.hearing_m == (request.parameters.get(HEARING) or 0.0)
                # By the class: a parameter may be called "update".
                return same_reach and Params.update(group.params, place, request.parameters)
        return False

    def disable(self, row: int) -> None:
        """Take robot `row`'s task away."""
        self.of[row] = None
        self.active[row] = self.filtered[row] = self.lasting[row] = self.survives_core[row] = False
        self.lapses_s[row] = math.inf
        self.team[row] = 0
        self._groups = None

    def groups(self) -> list[Group]:
        """Return the robots with a law on board, grouped by law and kind of parameters."""
        if self._groups is None:
            self.any_filtered = bool(self.filtered.any())
            members: dict[tuple[str, tuple[tuple[str, str], ...]], list[int]] = {}
            for row, task in enumerate(self.of):
                if task is not None and task.law != CENTRALISED:
                    kinds = tuple(sorted(_kind(*each) for each in task.request.parameters.items()))
                    members.setdefault((task.law, kinds), []).append(row)
            self._groups = [self._group(law, rows) for (law, _), rows in members.items()]
        return self._groups

    def _group(self, law: str, rows: list[int]) -> Group:
        parameters = [task.request.parameters for row in rows if (task := self.of[row]) is not None]
        module = registry.law_module(law)
        planar = hasattr(module, "velocity")
        return Group(
            law=law,
            call=module.velocity if planar else module.twist,
            planar=planar,
            rows=np.array(rows, np.int64),
            params=Params(parameters),
            hearing_m=_number(parameters[0].get(HEARING), 0.0),
        )
