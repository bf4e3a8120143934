"""What every law must hold: a function of each robot's own view and memory, finite whatever the neighbours do."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any

import numpy as np

from fullswarm import memory, registry
from fullswarm.agent.messaging.declaration import Layout, layout_of
from fullswarm.agent.messaging.received import Heard, Received
from fullswarm.agent.messaging.table import Merge, ReplicatedTable, SharedTable
from fullswarm.agent.neighbours.profiles import ProfileTable
from fullswarm.agent.view import Context, Params, Shared, View
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Index
from fullswarm.messages import RobotProfile, Value

Bounds = tuple[float, float, float, float]
Rows = list[dict[str, Value]]

TOLERANCE = 1e-9
"""How much two ways to the same answer may differ, relative to its size above 1."""
STRANGERS = 3
"""Neighbours that another agent carries."""
RADIUS_M = 0.17
TICKS = 4
"""How often a law with memory is called for one answer, the first time with new memory."""
DT_S = 0.02
MERGED = ((0.0, 1.0), (0.0, -2.0), (1.5, 0.0), (-1.0, 3.0))
"""Values that merges are tried on."""


def check_behaviour(
    module_or_name: ModuleType | str,
    parameters: Mapping[str, Value],
    *,
    robots: int = 6,
    seeds: Iterable[int] = range(20),
    bounds: Bounds = (0.0, 0.0, 10.0, 10.0),
    roles: Sequence[str] = (),
    capabilities: Sequence[str] = (),
) -> None:
    """Check a law on random swarms: some, no, all and coincident neighbours, a robot on its own goal.

    A law with memory is asked four times in a row, with memory that is new for each check. One that broadcasts receives
    random values of what it declares from its neighbours, and its shared table begins empty; what a robot broadcasts
    and writes must follow from its own view, as its answer, and a merge must not depend on order or repetition. Whether
    robots agree over a network is for a test in lockstep.

    Parameters
    ----------
    module_or_name
        The law's module, or the name it is registered under.
    parameters
        What its record gives it, defaults included. Floats and points are varied by 1 % from robot to robot.
    robots
        How many robots one call serves.
    seeds
        One random swarm each.
    bounds
        x_min, y_min, x_max, y_max of the arena, m.
    roles
        Roles of the robots, in turn; none: no robot has one.
    capabilities
        What every second robot can do.

    Raises
    ------
    AssertionError
        The law breaks a rule; names it and the remedy.
    ConfigError
        No law of that name is registered.
    """
    law = _Law(module_or_name)
    law.check_merges()
    rows = [{name: _varied(value, row) for name, value in parameters.items()} for row in range(robots)]
    for seed in seeds:
        rng = np.random.default_rng(seed)
        for plain in _scenes(rng, rows, bounds):
            scene = replace(plain, roles=tuple(roles), capabilities=tuple(capabilities))
            answer = _check_answer(law, scene)
            _check_single(law, scene, answer)
            if scene.permutable:
                _check_permuted(law, scene, answer, rng)
                _check_missing(law, scene, answer)
            law.demand(
                np.array_equal(law.ask(scene), answer),
                f"it remembers something from call to call ({scene.what}): declare it as Memory, and read no clock",
            )


@dataclass(frozen=True)
class _Scene:
    """What n robots sense at one moment; arrays as in :class:`~fullswarm.agent.view.View`."""

    what: str
    rows: Rows
    position: Array
    heading: Array
    start: Index
    other: Index
    predicted: Array
    states: Array
    bounds: Bounds
    ids: tuple[str, ...]  # of all robots that are checked
    own: Index  # which of them these are
    names: tuple[str, ...]  # of `states`
    permutable: bool = True  # no two neighbours are equally near, so that their order cannot matter
    roles: tuple[str, ...] = ()
    capabilities: tuple[str, ...] = ()

    def context(self, air: _Air | None = None) -> Context:
        """Return what they know beside positions; their random numbers begin anew."""
        count = len(self.ids)
        made = Context.of(np.zeros((count, 2)), np.zeros(count), self.names)
        made.ids, made.state.twist = self.ids, np.linspace((0.0, -0.5), (0.3, 0.5), count)
        made.since_s = np.linspace(-5.0, 0.0, count)
        generators = {row: np.random.default_rng(row) for row in range(count)}
        made.generator = generators.__getitem__
        made.profiles = _Profiles(self)
        if air is not None:
            made.channel = lambda _: _Channel(air, self)
        return made

    def view(self, context: Context | None = None) -> View:
        """Return a view of copies."""
        near = self.start.copy(), self.other.copy()
        return View(
            self.position.copy(),
            self.heading.copy(),
            np.full(len(self.position), RADIUS_M),
            lambda: near,
            self.predicted.copy(),
            self.states.copy(),
            self.bounds,
            context=context or self.context(),
            rows=self.own,
            shared=Shared("check", self.ids, tuple(itertools.islice(itertools.cycle(self.roles), len(self.ids)))),
        )

    def only(self, row: int) -> _Scene:
        """Return what robot `row` alone would sense: nothing is left of the others but its neighbours."""
        near = self.other[self.start[row] : self.start[row + 1]]
        return replace(
            self,
            rows=self.rows[row : row + 1],
            position=self.position[row : row + 1],
            heading=self.heading[row : row + 1],
            start=np.array([0, len(near)]),
            other=np.arange(len(near)),
            predicted=self.predicted[near],
            states=self.states[near],
            own=self.own[row : row + 1],
            names=tuple(self.names[each] for each in near.tolist()),
        )

    def shuffled(self, rng: np.random.Generator) -> _Scene:
        """Return the same with the neighbours of each robot, and all received states, in another order."""
        order = rng.permutation(len(self.states))
        moved_to = np.argsort(order)
        edges = [rng.permutation(self.other[a:b]) for a, b in zip(self.start[:-1], self.start[1:], strict=True)]
        return replace(
            self,
            other=moved_to[np.concatenate(edges)],
            predicted=self.predicted[order],
            states=self.states[order],
            names=tuple(self.names[each] for each in order.tolist()),
        )


class _Profiles:
    """What the robots of a scene are and can do; see ``View``."""

    def __init__(self, scene: _Scene) -> None:
        profiles = {
            robot: RobotProfile(
                robot=robot, make="check", model="", capabilities=scene.capabilities if place % 2 == 0 else (),
                radius_m=RADIUS_M, speed_limit_m_s=0.5, turn_limit_rad_s=4.0, accel_m_s2=1.0, battery=0.1 * (place % 9),
            )
            for place, robot in enumerate(scene.ids)
        }  # fmt: skip
        self.own = tuple(profiles.values())
        self.table = ProfileTable()
        for row, robot in enumerate(scene.names):
            if robot in profiles:  # nothing is known of the others
                self.table.put(row, profiles[robot])


@dataclass
class _Air:
    """What robots broadcast and write in a row of calls, by name."""

    layout: Layout | None
    merges: Mapping[str, Merge]
    said: dict[str, Array] = field(default_factory=dict)
    tables: dict[str, ReplicatedTable] = field(default_factory=dict)

    def of(self, robot: str) -> tuple[list[float], list[Any]]:
        """Return what a robot has broadcast last, and its table."""
        said, table = self.said.get(robot), self.tables.get(robot)
        return [] if said is None else said.tolist(), [] if table is None else table.items()


class _Channel:
    """What the robots of a scene broadcast and receive through; see ``View``."""

    def __init__(self, air: _Air, scene: _Scene) -> None:
        self._air, self._scene = air, scene

    def say(self, fields: dict[str, Any]) -> None:
        """Keep values."""
        layout = self._layout("say")
        values = np.empty((len(self._scene.own), layout.width))
        layout.write(fields, values)
        for row, each in zip(self._scene.own.tolist(), values, strict=True):
            self._air.said[self._scene.ids[row]] = each

    @property
    def heard(self) -> Heard:
        """Values that are random and the same for each sender, of the neighbours that run the request."""
        scene, received = self._scene, Received(self._layout("heard"), 10.0)
        table = np.array([_random_values(received.layout, name) for name in scene.names])
        table = table.reshape(len(scene.names), received.layout.width)
        received.put(np.arange(len(table)), table, 0.0)
        kept = [row for row, sender in enumerate(scene.other.tolist()) if scene.names[sender] in scene.ids]
        of = np.repeat(np.arange(len(scene.position)), np.diff(scene.start))[kept]
        senders = scene.other[kept]
        offset = scene.predicted[senders] - scene.position[of]
        age_s = np.full(len(of), 0.1)
        distance = np.hypot(offset[:, 0], offset[:, 1])
        return Heard(len(scene.position), of, offset, distance, senders, received, age_s, scene.names, scene.ids)

    @property
    def table(self) -> SharedTable:
        """A table per robot, which begins empty and receives nothing."""
        return SharedTable(self._replica)

    def _replica(self, row: int) -> ReplicatedTable:
        robot = self._scene.ids[int(self._scene.own[row])]
        return self._air.tables.setdefault(robot, ReplicatedTable(robot, self._air.merges))

    def _layout(self, what: str) -> Layout:
        if self._air.layout is None:
            raise ConfigError(f"view.{what}: the law declares no class Says")
        return self._air.layout


def _random_values(layout: Layout, name: str) -> Array:
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    values = rng.uniform(-2.0, 2.0, layout.width)
    for key, found in layout.fields.items():
        if found.kind is not float:
            values[layout.columns[key]] = rng.integers(0, 2, layout.widths[key])
    return values


class _Law:
    """A law's function, called with checks.

    Attributes
    ----------
    air : what was broadcast and written in the last call
    """

    def __init__(self, module_or_name: ModuleType | str) -> None:
        named = isinstance(module_or_name, str)
        module = registry.law_module(module_or_name) if isinstance(module_or_name, str) else module_or_name
        self._name = f"law '{module_or_name}'" if named else f"law '{module.__name__.rpartition('.')[2]}'"
        function = getattr(module, "velocity", None) or getattr(module, "twist", None)
        if not callable(function):
            raise AssertionError(
                f"{self._name} has neither velocity(view, params) nor twist(view, params): define one of them"
            )
        self._function: Callable[..., Array] = function
        self._memory: type | None = getattr(module, "Memory", None)
        self._merges: Mapping[str, Merge] = getattr(module, "MERGE", {})
        try:
            self._layout = layout_of(module)
        except ConfigError as error:
            raise AssertionError(f"{self._name}: {error.what} ({error.where}); {error.hint}") from error
        self.air = _Air(self._layout, self._merges)

    def check_merges(self) -> None:
        """Check that each merge of the table gives the same in whatever order and however often values arrive."""
        for key, merge in self._merges.items():
            for a, b, c in itertools.product(MERGED, repeat=3):
                try:
                    fine = (
                        merge(a, b) == merge(b, a)
                        and merge(a, a) == a
                        and merge(merge(a, b), c) == merge(a, merge(b, c))
                    )
                except Exception as error:  # outside code: whatever it raises is what this check is for
                    raise AssertionError(
                        f"{self._name}: the merge of '{key}' raises {type(error).__name__}: {error}; values of robots "
                        "are numbers, or tuples of the same length"
                    ) from error
                self.demand(
                    fine,
                    f"the merge of '{key}' depends on order or repetition, for example of {a}, {b} and {c}; use min or "
                    "max",
                )

    def demand(self, fulfilled: bool, otherwise: str) -> None:
        """Raise ``AssertionError`` with the law's name and `otherwise` unless `fulfilled`."""
        if not fulfilled:
            raise AssertionError(f"{self._name}: {otherwise}")

    def ask(self, scene: _Scene, view: View | None = None, params: Params | None = None) -> Array:
        """Return a copy of the law's answer, (n, 2), after a check of its shape."""
        count = len(scene.position)
        try:
            with np.errstate(all="ignore"):
                answer = self._answer(scene, view, params or Params(scene.rows))
        except ConfigError as error:
            lacks = "; add it to the parameters of this check" if "needs a parameter" in error.what else ""
            raise AssertionError(f"{self._name}: {error.what}{lacks}") from error
        except Exception as error:  # outside code: whatever it raises is what this check is for
            raise AssertionError(
                f"{self._name}: raises {type(error).__name__}: {error} for {count} robots, {scene.what}; a law must "
                "answer for any number of robots, and take the others from the edges of its view alone"
            ) from error
        self.demand(
            isinstance(answer, np.ndarray) and answer.shape == (count, 2),
            f"answers {_form(answer)} for {count} robots; return an array of shape ({count}, 2), one row per robot",
        )
        self.demand(
            np.issubdtype(answer.dtype, np.floating), f"answers {answer.dtype}, not floats; make it `.astype(float)`"
        )
        self.demand(
            bool(np.isfinite(answer).all()),
            f"answers NaN or infinity, {scene.what}; hold divisors away from zero, e.g. np.maximum(distance, 1e-6)",
        )
        return answer.copy()

    def _answer(self, scene: _Scene, view: View | None, params: Params) -> Array:
        """Return the law's answer, of the last of some calls in a row if it remembers."""
        self.air = _Air(self._layout, self._merges)
        context = scene.context(self.air)
        if view is None:
            view = scene.view(context)
        else:
            view.context.channel = context.channel
        if self._memory is None:
            return self._function(view, params)
        kept, context = memory.allocate(self._memory, len(scene.position)), view.context
        answer = self._function(view, params, kept)
        for tick in range(1, TICKS):
            context.now_s = tick * DT_S
            answer = self._function(scene.view(context), params, kept)
        return answer


def _demand_same(law: _Law, robot: str, air: _Air, why: str) -> None:
    """Compare what a robot broadcast and wrote in two ways to ask."""
    (said, table), (said_before, table_before) = law.air.of(robot), air.of(robot)
    law.demand(_alike(said, said_before), f"{robot} broadcasts {said_before} and {said}: {why}")
    law.demand(_alike(table, table_before), f"{robot} writes {table_before} and {table} into the table: {why}")


def _alike(one: Any, other: Any) -> bool:
    """Compare nested lists of texts and numbers."""
    if isinstance(one, list | tuple):
        return (
            isinstance(other, list | tuple)
            and len(one) == len(other)
            and all(_alike(*each) for each in zip(one, other, strict=True))
        )
    if isinstance(one, str) or isinstance(other, str):
        return bool(one == other)
    return bool(np.isclose(one, other, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True))


def _check_answer(law: _Law, scene: _Scene) -> Array:
    """Return the answer, the same twice and without harm to what was given."""
    view, params = scene.view(), Params(scene.rows)
    before = {name: np.copy(value) for name, value in _given(view, params).items()}
    answer = law.ask(scene, view, params)
    for name, value in _given(view, params).items():
        law.demand(
            np.array_equal(value, before[name]),
            f"modifies {name}; work on a copy, other laws and the filter read it too",
        )
    law.demand(
        np.array_equal(law.ask(scene), answer),
        f"answers the same question differently ({scene.what}); declare what it remembers as Memory, take random "
        "numbers from view.random and the time from view.time_s",
    )
    return answer


def _check_single(law: _Law, scene: _Scene, answer: Array) -> None:
    """One call for n robots must equal n calls for one robot each."""
    law.ask(scene)
    together = law.air
    for row, robot in enumerate(scene.ids):
        alone = law.ask(scene.only(row))[0]
        _demand_same(law, robot, together, f"among others and by itself ({scene.what}); a law must not mix robots")
        law.demand(
            _same(alone, answer[row]),
            f"robot {row} gets {answer[row]} among others and {alone} by itself ({scene.what}); a law must not mix "
            "robots except through their neighbours: no mean over view.position, no params.gain[0] for all",
        )


def _check_permuted(law: _Law, scene: _Scene, answer: Array, rng: np.random.Generator) -> None:
    law.ask(scene)
    before = law.air
    shuffled = law.ask(scene.shuffled(rng))
    for robot in scene.ids:
        _demand_same(law, robot, before, f"the order of the neighbours changes it ({scene.what})")
    law.demand(
        _same(shuffled, answer),
        f"the order of the neighbours changes the answer ({scene.what}); they come in any order, fold them with "
        "view.sum or a maximum",
    )


def _check_missing(law: _Law, scene: _Scene, answer: Array) -> None:
    """A parameter must be read by ``params.name``, which raises ConfigError if it is not there."""
    for name in scene.rows[0]:
        rows = [{key: value for key, value in row.items() if key != name} for row in scene.rows]
        try:
            without = law.ask(scene, params=Params(rows))
        except AssertionError as error:
            if isinstance(error.__cause__, ConfigError):
                continue
            raise AssertionError(f"{error} (without the parameter '{name}'; read it as params.{name})") from error
        law.demand(
            _same(without, answer),
            f"without the parameter '{name}' it answers something else; read it as params.{name}, which raises "
            "ConfigError, and give the default in the behaviour's record",
        )


def _scenes(rng: np.random.Generator, rows: Rows, bounds: Bounds) -> Iterator[_Scene]:
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    count = len(rows)
    position = rng.uniform(low, high, (count, 2))
    states = np.zeros((count + STRANGERS, 6))
    states[:, :2] = np.concatenate([position, rng.uniform(low, high, (STRANGERS, 2))])
    states[:, 2] = rng.uniform(-np.pi, np.pi, len(states))
    states[:, 3:5] = rng.uniform(-0.5, 0.5, (len(states), 2))
    states[:, 5] = RADIUS_M
    span = float(np.hypot(*(high - low)))
    some = _sensed("some neighbours", rows, position, states, rng.uniform(0.1, 0.5) * span, bounds)
    yield some
    yield _sensed("no neighbours", rows, position, states, -1.0, bounds)
    yield _sensed("all robots neighbours", rows, position, states, 2.0 * span, bounds)
    together = states.copy()
    together[:, :2] = position[0]
    at_one_place = np.repeat(position[:1], count, axis=0)
    name = "neighbours at the robot's own place"
    yield replace(_sensed(name, rows, at_one_place, together, 1.0, bounds), permutable=False)
    for key, value in rows[0].items():
        if _is_point(value):
            arrived = np.array([row[key] for row in rows], float)
            states_there = states.copy()
            states_there[:count, :2] = arrived
            name = f"robots exactly on their parameter '{key}'"
            yield replace(_sensed(name, rows, arrived, states_there, span, bounds), permutable=False)


def _sensed(what: str, rows: Rows, position: Array, states: Array, reach_m: float, bounds: Bounds) -> _Scene:
    """Return the scene in which each robot senses all others within `reach_m`; robot i is row i of `states`."""
    distance = np.linalg.norm(states[None, :, :2] - position[:, None], axis=2)
    near = distance <= reach_m
    near[np.arange(len(position)), np.arange(len(position))] = False
    start = np.concatenate([[0], np.cumsum(near.sum(axis=1))])
    predicted = np.ascontiguousarray(states[:, :2])
    ids = tuple(f"r{row + 1}" for row in range(len(position)))
    names = (*ids, *(f"s{row + 1}" for row in range(len(states) - len(position))))
    return _Scene(
        what, rows, position, states[: len(position), 2], start, np.nonzero(near)[1], predicted, states, bounds,
        ids, np.arange(len(position)), names,
    )  # fmt: skip


def _given(view: View, params: Params) -> dict[str, Any]:
    names = ("position", "heading", "radius", "start", "other", "of", "offset", "distance", "neighbour_heading")
    given = {f"view.{name}": getattr(view, name) for name in (*names, "neighbours")}
    return given | {f"params.{name}": value for name, value in vars(params).items()}


def _varied(value: Value, row: int) -> Value:
    if isinstance(value, float):
        return value * (1.0 + 0.01 * row)
    if isinstance(value, list) and _is_point(value):
        return [float(each) + 0.01 * row for each in value if isinstance(each, int | float)]
    return value


def _is_point(value: Value) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(isinstance(each, int | float) for each in value)


def _same(one: Array, other: Array) -> bool:
    return bool(np.allclose(one, other, rtol=TOLERANCE, atol=TOLERANCE))


def _form(answer: object) -> str:
    return f"shape {answer.shape}" if isinstance(answer, np.ndarray) else f"a {type(answer).__name__}"
