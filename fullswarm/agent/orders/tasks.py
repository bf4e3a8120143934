"""Holds the task of each robot, checked against its behaviour's record, and groups robots by control law.

A control law is called once for all robots that run it.
"""

from __future__ import annotations

import functools
import hashlib
import math
import tomllib
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from fullswarm import memory, registry
from fullswarm.agent.messaging.declaration import RANGE, RATE, layout_of
from fullswarm.agent.view import Params, Shared, View
from fullswarm.config.models import EXPIRES_S, HEARING_M
from fullswarm.config.parameter import FILTER, Parameter
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.kernels import Array, Index
from fullswarm.messages import SAYS_HZ, ControlRequest, Value
from fullswarm.parameters import column_width
from fullswarm.recent import Recent

CENTRALISED = ""
"""Law of a task that has none on board and follows Command messages."""

HEARING = "hearing_m"
TARGET = "target"
"""What the core makes of a formation for each robot."""
EXACT = (HEARING, RANGE, RATE)
"""Parameters that are the same for all robots of one call of a control law."""
LINEAR = "linear"

REMEMBERED = 10_000
"""Robots and behaviours of which it is remembered how often they were started, for other random numbers each time."""
ARRIVE_M = 0.1
"""A robot so near its goal has arrived, when neither the request nor the file says another radius."""


def _kind(name: str, value: Value) -> tuple[str, str]:
    """Return what robots must have in common to share one call of a control law: kinds, texts and hearing range."""
    width = column_width(value)
    return name, str(width) if width and name not in EXACT else repr(value)


def _alike(one: ControlRequest, other: ControlRequest) -> bool:
    """Tell whether two requests differ by no more than their parameters and their time."""
    return (
        one.law == other.law
        and one.filtered == other.filtered
        and one.centralised == other.centralised
        and one.survives_core == other.survives_core
    )


def _continues(before: Task | None, task: Task) -> bool:
    """Tell whether a task goes on with what the robot does: the same request again, or the next frame of a stick."""
    if before is None or before.law != task.law or before.request.behaviour != task.request.behaviour:
        return False
    return stream(before.request) == stream(task.request)


def stream(request: ControlRequest) -> str:
    """Name what goes on over renewed parameters: the request, or all frames of one operator's stick."""
    return f"{request.behaviour} {request.team}" if request.expires_s > 0.0 else request.request_id


def _number(value: Value | None, otherwise: float) -> float:
    return float(value) if isinstance(value, int | float) else otherwise


def goal_of(request: ControlRequest) -> tuple[float, float]:
    """Return the point that a request sends a robot to, its `goal` or `target`; NaN when there is none."""
    point = request.parameters.get("goal", request.parameters.get("target"))
    if not isinstance(point, list) or len(point) != 2:
        return math.nan, math.nan
    x, y = (float(each) if isinstance(each, int | float) else math.nan for each in point)
    return x, y


@dataclass(frozen=True, slots=True)
class Task:
    """What one robot was asked to run."""

    request: ControlRequest
    arrived_s: float

    @property
    def law(self) -> str:
        """Name of the control law on board, empty for a centralised behaviour."""
        return CENTRALISED if self.request.centralised else self.request.law

    @property
    def expires_at_s(self) -> float:
        """When an intent runs out; never for a lasting request."""
        return self.arrived_s + self.request.expires_s if self.request.expires_s > 0 else math.inf


@dataclass(frozen=True, slots=True)
class Parked:
    """A task that is interrupted, with what it goes on with: one row of memory, random numbers, and its age."""

    task: Task
    memory: Any = None
    generator: np.random.Generator | None = None
    since_s: float = math.nan


@dataclass(frozen=True, slots=True)
class Group:
    """Robots that run the same control law."""

    law: str
    call: Callable[[View, Params], Array]  # the control law
    planar: bool  # it returns planar velocities, not twists
    rows: Index
    params: Params
    hearing_m: float  # 0: the sensing radius
    exact: tuple[Value | None, ...]  # the values of `EXACT`
    shared: Shared | None  # the request that all of them run, if the law is called once per request
    memory: Any = None  # as the law's module declares it


@dataclass(slots=True)
class Tasks:
    """The tasks of n robots, and what the tick needs of them as arrays.

    A control law is called once for all robots that run it with the same kinds of parameters. One that remembers,
    broadcasts or asks for its request's members is called once per request, and once per tick: also on board, where
    others are called on each message that concerns them.

    Attributes
    ----------
    parked : by robot, the task that it goes on with once it has charged
    ids, seed : (n,) names of the robots, and the swarm's seed, for random numbers
    since_s : (n,) when each task began; renewed parameters do not count
    index : (n,) place of each robot among its request's members, -1: it is not among them
    active : (n,) a task is on
    filtered : (n,) it runs behind the safety filter
    lasting : (n,) it is filtered and no intent of a stick
    any_filtered : some task does
    survives_core : (n,) it goes on without the core
    team : (n,) which robots its control law counts as neighbours; 0: all that are sensed
    peers : by number of a team, its robots, which count whatever they run
    expires_at_s : (n,) when it ends by itself; inf
    coordinated : (n,) it is lasting, has a goal, and the robot avoids its neighbours in advance
    goal_m, reach_m : (n, 2), (n,) where the robot is to go, NaN for a task without such a point, and within how much of
        it the request counts as carried out
    margin_m, gain_per_s : (n,) settings of the filter: the request's, else the usual ones; a gain of 0: braking barrier
    """

    count: int
    usual_margin_m: float
    usual_gain_per_s: float
    gain_limit_per_s: Array  # (n,) what the brakes can follow
    usual_barrier: str = LINEAR
    usually_coordinated: bool = False
    ids: tuple[str, ...] = ()
    seed: int = 0
    of: list[Task | None] = field(init=False)
    parked: dict[int, Parked] = field(init=False, default_factory=dict)
    active: NDArray[np.bool_] = field(init=False)
    filtered: NDArray[np.bool_] = field(init=False)
    lasting: NDArray[np.bool_] = field(init=False)
    coordinated: NDArray[np.bool_] = field(init=False)
    survives_core: NDArray[np.bool_] = field(init=False)
    team: Index = field(init=False)
    margin_m: Array = field(init=False)
    gain_per_s: Array = field(init=False)
    goal_m: Array = field(init=False)
    reach_m: Array = field(init=False)
    expires_at_s: Array = field(init=False)
    since_s: Array = field(init=False)
    index: Index = field(init=False)
    peers: dict[int, frozenset[str]] = field(init=False, default_factory=dict)
    any_filtered: bool = field(init=False, default=False)
    any_apart: bool = field(init=False, default=False)
    _groups: list[Group] | None = field(init=False, default=None)
    _apart: set[str] = field(init=False, default_factory=set)  # laws that are called once per request
    _remembered: dict[int, tuple[Any, int]] = field(init=False, default_factory=dict)  # robot → memory, its row there
    _generators: dict[int, np.random.Generator] = field(init=False, default_factory=dict)
    _starts: Recent[tuple[int, str], int] = field(init=False, default_factory=lambda: Recent(REMEMBERED))
    _held: set[str] = field(init=False, default_factory=set)  # laws under development, while they are exchanged

    def __post_init__(self) -> None:
        self.of = [None] * self.count
        self.active = np.zeros(self.count, bool)
        self.filtered = np.zeros(self.count, bool)
        self.lasting = np.zeros(self.count, bool)
        self.coordinated = np.zeros(self.count, bool)
        self.survives_core = np.zeros(self.count, bool)
        self.team = np.zeros(self.count, np.int64)
        self.margin_m = np.full(self.count, self.usual_margin_m)
        gain_per_s = np.minimum(self.usual_gain_per_s, self.gain_limit_per_s)
        self.gain_per_s = gain_per_s if self.usual_barrier == LINEAR else np.zeros(self.count)
        self.expires_at_s = np.full(self.count, math.inf)
        self.goal_m = np.full((self.count, 2), math.nan)
        self.reach_m = np.full(self.count, ARRIVE_M)
        self.since_s = np.zeros(self.count)
        self.index = np.full(self.count, -1, np.int64)

    def enable(self, row: int, task: Task) -> None:
        """Give robot `row` a task in place of the one it has.

        Raises
        ------
        ConfigError
            The robot has no such control law, or a parameter is out of range.
        """
        request, before = task.request, self.of[row]
        check(request)
        alike = before is not None and _alike(before.request, request)
        if not alike:
            self._admit(task)
        goes_on = _continues(before, task)
        self.of[row] = task
        if not goes_on:
            self._start(row, task)
        self.expires_at_s[row] = task.expires_at_s
        self.team[row] = request.team
        if request.peers:
            self.peers[request.team] = frozenset(request.peers)
        self.goal_m[row] = goal_of(request)
        self.reach_m[row] = _number(request.parameters.get("arrive_radius_m"), ARRIVE_M)
        if request.filtered:
            self.lasting[row] = request.expires_s <= 0.0
            self.margin_m[row] = _number(request.parameters.get("safety_margin_m"), self.usual_margin_m)
            gain_per_s = _number(request.parameters.get("barrier_gain_per_s"), self.usual_gain_per_s)
            linear = request.parameters.get("barrier", self.usual_barrier) == LINEAR
            self.gain_per_s[row] = min(gain_per_s, self.gain_limit_per_s[row]) if linear else 0.0
        # A law without a goal of its own is about the neighbours: what keeps robots apart in advance would change it.
        has_goal = not math.isnan(self.goal_m[row, 0])
        wanted = request.parameters.get("coordination", self.usually_coordinated) is True
        self.coordinated[row] = wanted and has_goal and request.filtered and request.expires_s <= 0.0
        if alike and (goes_on or task.law not in self._apart) and self._renew(row, request):
            return
        self.active[row] = True
        self.filtered[row] = request.filtered
        self.lasting[row] = request.filtered and request.expires_s <= 0.0
        self.survives_core[row] = request.survives_core
        self._regroup()

    def _admit(self, task: Task) -> None:
        """Note how a control law is to be called; raise ``ConfigError`` for a wrong declaration."""
        if task.law == CENTRALISED:
            return
        module = registry.law_module(task.law)
        if declares(module):
            memory.allocate(module.Memory, 0)
            self._apart.add(task.law)
        if layout_of(module) is not None:
            self._apart.add(task.law)

    # ------------------------------------------------------------------ interruptions
    def asked(self, row: int) -> Task | None:
        """Return the task that was asked of robot `row`: the one that it runs, or that is interrupted."""
        parked = self.parked.get(row)
        return self.of[row] if parked is None else parked.task

    def park(self, row: int) -> None:
        """Interrupt robot `row`'s task: it stands, and remembers what the task needs to go on."""
        task = self.of[row]
        if task is not None:
            kept = Parked(task, self._own_memory(row), self._generators.get(row), float(self.since_s[row]))
            self.disable(row)
            self.parked[row] = kept

    def park_new(self, row: int, task: Task) -> None:
        """Put a task in place of the one that is interrupted; `ConfigError` as from :meth:`enable`."""
        check(task.request)
        self._admit(task)
        before = self.parked.get(row)
        self.parked[row] = (
            replace(before, task=task) if before is not None and _continues(before.task, task) else Parked(task)
        )

    def unpark(self, row: int) -> None:
        """Go on with the interrupted task; `ConfigError` as from :meth:`enable`, then there is none."""
        self.disable(row)
        parked = self.parked.pop(row, None)
        if parked is None:
            return
        self.enable(row, parked.task)
        if not math.isnan(parked.since_s):
            self.since_s[row] = parked.since_s
        if parked.generator is not None:
            self._generators[row] = parked.generator
        kind = None if parked.task.law == CENTRALISED else getattr(registry.law_module(parked.task.law), "Memory", None)
        if parked.memory is not None and kind is type(parked.memory).__mro__[1]:  # else the law was exchanged meanwhile
            self._regroup()
            self._remembered[row] = parked.memory, 0

    def _own_memory(self, row: int) -> Any:
        """Return a copy of what robot `row` remembers, as a memory of one robot; None: nothing."""
        for group in self.groups():
            if group.memory is not None and row in group.rows:
                made = memory.allocate(type(group.memory).__mro__[1], 1)
                memory.copy_row(group.memory, int(np.searchsorted(group.rows, row)), made, 0)
                return made
        return None

    def _start(self, row: int, task: Task) -> None:
        """Begin a task afresh: time, memory and random numbers."""
        key = row, task.request.behaviour
        self._starts[key] = self._starts.get(key, 0) + 1
        self._generators.pop(row, None)
        if task.law in self._apart:
            self._regroup()
        self._remembered.pop(row, None)
        self.since_s[row] = task.arrived_s
        members = task.request.members
        robot = task.request.robot
        self.index[row] = members.index(robot) if robot in members else -1

    def generator(self, row: int) -> np.random.Generator:
        """Return the random number generator of robot `row`'s task; see ``view.Draws``."""
        found, task = self._generators.get(row), self.of[row]
        if found is None and task is not None:
            behaviour = task.request.behaviour
            source = f"{self.seed}/{task.request.robot}/{behaviour}/{self._starts[row, behaviour]}"
            digest = hashlib.sha256(source.encode()).digest()
            found = self._generators[row] = np.random.default_rng(int.from_bytes(digest[:16], "big"))
        if found is None:
            raise ConfigError("a robot without a task has no random numbers")
        return found

    def _regroup(self) -> None:
        """Have the groups made anew; what robots remember stays where it is until then."""
        for group in self._groups or ():
            if group.memory is not None:
                self._remembered |= {row: (group.memory, place) for place, row in enumerate(group.rows.tolist())}
        self._groups = None

    def separate(self, law: str) -> None:
        """Have a control law called once per request from now on."""
        self._apart.add(law)
        self._regroup()

    def _renew(self, row: int, request: ControlRequest) -> bool:
        """Write new parameters of a running control law into its group: a stick sends them twenty times a second."""
        for group in self._groups or ():
            place = bisect_left(group.rows, row)  # NumPy's own search takes ten times as long for a few rows
            if place < len(group.rows) and group.rows[place] == row:
                same_reach = group.exact == tuple(map(request.parameters.get, EXACT))
                # By the class: a parameter may be called "update".
                return same_reach and Params.update(group.params, place, request.parameters)
        return False

    def disable(self, row: int) -> None:
        """Take robot `row`'s task away."""
        self.of[row] = None
        self.active[row] = self.filtered[row] = self.lasting[row] = self.survives_core[row] = False
        self.coordinated[row] = False
        self.expires_at_s[row] = math.inf
        self.team[row] = 0
        self.goal_m[row] = math.nan
        self._regroup()
        self._remembered.pop(row, None)
        self._generators.pop(row, None)

    def hold(self, law: str) -> None:
        """Leave a control law out of the groups: nothing is desired of its robots, so they stop."""
        self._held.add(law)
        self._regroup()

    def release(self, law: str) -> dict[int, ConfigError]:
        """Begin the tasks with a control law anew; return why it was not possible, by robot, whose tasks have ended."""
        self._held.discard(law)
        self._apart.discard(law)  # the law may be another kind now
        refused = {}
        for row in self.rows_with(law):
            task = self.of[row]
            self.disable(row)
            if task is not None:
                try:
                    self.enable(row, task)
                except ConfigError as error:
                    refused[row] = error
        return refused

    def rows_with(self, law: str) -> list[int]:
        """Return the robots that run a control law."""
        return [row for row, task in enumerate(self.of) if task is not None and task.law == law]

    def groups(self) -> list[Group]:
        """Return the robots with a control law on board, grouped by law, kind of parameters and perhaps request."""
        if self._groups is None:
            self.any_filtered = bool(self.filtered.any())
            if self.peers:
                self.peers = {team: robots for team, robots in self.peers.items() if team in self.team}
            members: dict[tuple[str, tuple[tuple[str, str], ...], str], list[int]] = {}
            for row, task in enumerate(self.of):
                if task is not None and task.law != CENTRALISED and task.law not in self._held:
                    kinds = tuple(sorted(_kind(*each) for each in task.request.parameters.items()))
                    apart = stream(task.request) if task.law in self._apart else ""
                    members.setdefault((task.law, kinds, apart), []).append(row)
            self._groups = [self._group(law, rows) for (law, _, _), rows in members.items()]
            self.any_apart = any(group.shared is not None for group in self._groups)
            self._remembered = {}
        return self._groups

    def _group(self, law: str, rows: list[int]) -> Group:
        requests = [task.request for row in rows if (task := self.of[row]) is not None]
        parameters = [each.parameters for each in requests]
        module = registry.law_module(law)
        planar = hasattr(module, "velocity")
        call, kept = module.velocity if planar else module.twist, None
        if declares(module):
            kept = self._memory(module.Memory, rows)
            call = _remembering(call, kept)
        return Group(
            law=law,
            call=call,
            planar=planar,
            rows=np.array(rows, np.int64),
            params=Params(parameters),
            hearing_m=_number(parameters[0].get(HEARING), 0.0),
            exact=tuple(map(parameters[0].get, EXACT)),
            shared=Shared(requests[0].request_id, requests[0].members, requests[0].roles)
            if law in self._apart
            else None,
            memory=kept,
        )

    def _memory(self, kind: type, rows: list[int]) -> Any:
        """Return the memory of some robots: what they remember already, new for the others."""
        before = [self._remembered.get(row) for row in rows]
        whole = before[0][0] if before[0] is not None else None
        if whole is not None and len(rows) == memory.count(whole) and _in_order(before, whole):
            return whole  # kept, not copied: a law that is being called may hold it
        made = memory.allocate(kind, len(rows))
        for place, found in enumerate(before):
            if found is not None:
                memory.copy_row(*found, made, place)
        return made

    def memory_of(self, row: int) -> dict[str, list[float]]:
        """Return what robot `row` remembers, by name; empty: its control law has no memory."""
        for group in self.groups():
            if group.memory is not None and row in group.rows:
                return memory.as_lists(group.memory, int(np.searchsorted(group.rows, row)))
        return {}


def _in_order(found: list[tuple[Any, int] | None], whole: Any) -> bool:
    return all(each is not None and each[0] is whole and each[1] == place for place, each in enumerate(found))


def declares(module: Any) -> bool:
    """Tell whether a control law remembers something from call to call."""
    return getattr(module, "Memory", None) is not None


def _remembering(call: Callable[..., Array], kept: Any) -> Callable[[View, Params], Array]:
    return lambda view, params: call(view, params, kept)


def simulated_only(law: str) -> bool:
    """Tell whether a control law may run on simulated robots alone: its module says so.

    Raises
    ------
    ConfigError
        The robot has no such control law.
    """
    return law != CENTRALISED and bool(getattr(registry.law_module(law), "SIMULATED_ONLY", False))


RECORDS = Path(__file__).parents[2] / "core" / "behaviours.toml"

GREATEST = 1e7
"""Of a number that no record knows: no coordinate, speed or weight is larger."""
LONGEST = 1000
"""Of a text that no record knows, in characters."""

OWN = {
    **FILTER,
    HEARING: Parameter(type="number", unit="m", min=HEARING_M[0], max=HEARING_M[1]),
    RANGE: Parameter(type="number", unit="m", min=HEARING_M[0], max=HEARING_M[1]),
    RATE: Parameter(type="number", unit="1/s", min=0.1, max=SAYS_HZ),
}
"""Parameters that the agent itself reads, whatever the control law."""

Allowed = Mapping[str, tuple[Parameter, ...]]


def check(request: ControlRequest) -> None:
    """Let a request pass that a robot may run.

    Raises
    ------
    ConfigError
        A parameter has another type than its record says, is out of range or in no record of the law, or the request
        would never expire; says which and what is wanted.
    """
    low_s, high_s = EXPIRES_S
    if not math.isfinite(request.stamp_s):  # or an intent would never expire
        raise ConfigError(f"stamp_s = {request.stamp_s} is no time")
    if not low_s <= request.expires_s <= high_s:
        raise ConfigError(f"expires_s = {request.expires_s:g} is outside [{low_s:g}, {high_s:g}] s")
    spans, allowed, fixed = _known(request.law)
    known = bool(allowed or fixed)  # else there is no record of this law here, and the law itself must know
    for name, value in request.parameters.items():
        low, high = spans.get(name) or ((math.inf, -math.inf) if known else (-GREATEST, GREATEST))
        if type(value) is float and low <= value <= high:  # what a stick sends twenty times a second
            continue
        if known and name not in spans and name not in fixed:
            raise ConfigError(
                f"the robot refuses {name}: no behaviour with the control law '{request.law}' has such a parameter",
                hint=did_you_mean(name, (*spans, *fixed)),
            )
        try:
            _fits(name, value, OWN.get(name), allowed.get(name, ()))
        except ValueError as error:
            raise ConfigError(f"the robot refuses {error}") from None


def _fits(name: str, value: Value, own: Parameter | None, allowed: tuple[Parameter, ...]) -> None:
    """Raise the ``ValueError`` of the first record when no record allows the value."""
    if own is not None:
        own.check(name, value)
    elif not allowed:
        _can_be(name, value)
    problem: ValueError | None = None
    for parameter in allowed:
        try:
            parameter.check(name, value)
        except ValueError as error:
            problem = problem or error
        else:
            return
    if problem is not None:
        raise problem


def _can_be(name: str, value: Value | list[float]) -> None:
    """Raise a ``ValueError`` for what cannot be a parameter of any law."""
    if isinstance(value, list):
        for each in value:
            _can_be(name, each)
    elif isinstance(value, str):
        if len(value) > LONGEST:
            raise ValueError(f"{name}: a text of {len(value)} characters is too long (limit: {LONGEST})")
    elif not abs(value) <= GREATEST:
        raise ValueError(f"{name} = {value:g} is not a number within ±{GREATEST:g}")


@functools.cache
def _known(law: str) -> tuple[dict[str, tuple[float, float]], Allowed, frozenset[str]]:
    """Return the ranges of each parameter in a law's records, and what the core may add to them.

    The ranges come twice: of floats that need no further check, and all. What is added: static values, a target.
    """
    allowed: dict[str, tuple[Parameter, ...]] = {}
    for name, parameter in _parameters(law):
        if parameter not in allowed.get(name, ()):
            allowed[name] = (*allowed.get(name, ()), parameter)
    spans = {name: (max(low for low, _ in each), min(high for _, high in each)) for name, each in _spans(allowed)}
    return spans, allowed, frozenset({*_static(law), TARGET} if allowed else _static(law))


def _spans(allowed: Allowed) -> Iterator[tuple[str, list[tuple[float, float]]]]:
    for name in {**allowed, **OWN}:
        own = [OWN[name].span] if name in OWN else []
        yield name, [*own, *(each.span for each in allowed.get(name, ()))]


def _static(law: str) -> Iterator[str]:
    tables = _tables()
    for record in tables.values():
        if law and _inherited(tables, record, "law") == law:
            for each in _lineage(tables, record):
                for table in (each.get("static"), each.get("static_from")):
                    yield from table if isinstance(table, dict) else ()


def _parameters(law: str) -> Iterator[tuple[str, Parameter]]:
    tables = _tables()
    for record in tables.values():
        if law and _inherited(tables, record, "law") == law:
            for name, raw in _merged(tables, record).items():
                try:
                    yield name, Parameter.model_validate(raw)
                except ValidationError:  # the core says what is wrong with it
                    continue


@functools.cache
def _tables() -> dict[str, dict[str, Any]]:
    """Return the records that are installed here; a file that cannot be read says nothing."""
    tables: dict[str, Any] = {}
    for file in (*registry.record_files(), RECORDS):
        try:
            tables |= tomllib.loads(file.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
            continue
    return {name: each for name, each in tables.items() if isinstance(each, dict)}


def read_records_again() -> None:
    """Forget the records that were read: the next request is checked by the files as they are then."""
    _tables.cache_clear()
    _known.cache_clear()


def _lineage(tables: Mapping[str, dict[str, Any]], record: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a record and those that it is like, the nearest first; each once."""
    line = [record]
    while (base := tables.get(str(line[-1].get("like")))) is not None and base not in line:
        line.append(base)
    return line


def _inherited(tables: Mapping[str, dict[str, Any]], record: dict[str, Any], key: str) -> object:
    return next((each[key] for each in _lineage(tables, record) if key in each), None)


def _merged(tables: Mapping[str, dict[str, Any]], record: dict[str, Any]) -> dict[str, Any]:
    merged: dict[str, Any] = {}
    for each in reversed(_lineage(tables, record)):
        parameters = each.get("parameters")
        merged |= parameters if isinstance(parameters, dict) else {}
    return merged
