"""What a control law gets: its robots, the neighbours they sense, the arena, its parameters. Arrays over n robots.

Neighbours come as a list of pairs sorted by robot: pair e means that robot ``of[e]`` senses a neighbour at
``offset[e]``. A control law works on pairs and adds them up with :meth:`View.sum`, so one line of NumPy serves one
robot on board and a thousand in a trial.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fullswarm import profiles
from fullswarm.agent.messaging.received import Heard
from fullswarm.agent.messaging.table import SharedTable
from fullswarm.agent.motion.actuation import Actuation
from fullswarm.agent.neighbours.profiles import ProfileTable
from fullswarm.agent.state import AgentState
from fullswarm.drivers.base import NO_OBSTACLES, FleetReading
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Flags, Index, kernel
from fullswarm.messages import RobotProfile
from fullswarm.parameters import Params as Params  # a law's module imports both from here
from fullswarm.reasons import Reason


def nothing_known(_row: int, _source: str) -> Array:
    """Return no obstacles."""
    return NO_OBSTACLES


def none_standing(_row: int) -> Array:
    """Return no obstacles."""
    return NO_OBSTACLES


class Channel(Protocol):
    """What the robots of one call of a control law broadcast and receive through; see ``messaging.exchange``."""

    def say(self, fields: dict[str, Any]) -> None:
        """Broadcast values; see :meth:`View.say`."""
        ...

    @property
    def heard(self) -> Heard:
        """What they have received."""
        ...

    @property
    def table(self) -> SharedTable:
        """The shared table of their request."""
        ...


class KnownProfiles(Protocol):
    """What robots are and can do; see ``neighbours.profiles``."""

    @property
    def own(self) -> Sequence[RobotProfile]:
        """(n,) of the own robots."""
        ...

    @property
    def table(self) -> ProfileTable:
        """Of the robots received."""
        ...


Words = NDArray[np.str_]
Outcome = Literal["arrived", "failed"]


class Shared(NamedTuple):
    """The request that all robots of one call of a control law run."""

    request_id: str
    members: tuple[str, ...]
    roles: tuple[str, ...] = ()  # of each of the members; empty: the request gives none


class Ending(NamedTuple):
    """A control law ends its behaviour on one robot; see :meth:`View.finish`."""

    row: int
    outcome: Outcome
    text: str


class RequestsDiffer(Exception):
    """A control law asks for what belongs to one request, but was called for the robots of several.

    The agent then calls it again, once per request, from then on always so.
    """


def _seeded_by_row(row: int) -> np.random.Generator:
    return np.random.default_rng(row)


@dataclass(slots=True)
class Context:
    """What an agent knows beside positions; one object for all calls, kept up to date by ``DesiredMotion``.

    Attributes
    ----------
    ids : (n,) of the own robots
    names : (m,) ids of the robots received
    state : the own robots' poses, twists and readings
    since_s : (n,) when each robot's request was enabled
    index : (n,) place of each among the members of its request; -1: it is not among them
    contacts : returns how many bodies each robot touches, (n,)
    generator : returns the random number generator of a robot's task
    profiles : what robots are and can do; None: unknown
    channel : returns what the robots of a call, by rows (None: all), broadcast and receive through; None: nothing does
    now_s, dt_s : time of this tick, and since the one before, s
    """

    ids: tuple[str, ...]
    names: Sequence[str]
    state: AgentState
    since_s: Array
    index: Index
    contacts: Callable[[], Index]
    generator: Callable[[int], np.random.Generator] = _seeded_by_row
    channel: Callable[[Index | None], Channel] | None = None
    profiles: KnownProfiles | None = None
    now_s: float = 0.0
    dt_s: float = 0.02
    _own: Words | None = field(default=None, init=False)
    _received: Words | None = field(default=None, init=False)
    _names_then: Sequence[str] = field(default=(), init=False)  # a row may be given to another robot

    @staticmethod
    def of(position: Array, heading: Array, names: Sequence[str]) -> Context:
        """Return a context in which nothing but positions is known, for a view by itself; robots are r1, r2, ..."""
        count = len(position)
        none, flags, whole = np.zeros(count), np.zeros(count, bool), np.zeros(count, np.int64)
        state = AgentState(
            radius=none, pose=np.column_stack([position, heading]), estop=flags, stop_reason=whole,
            battery_low=flags, at_standstill=flags, standstill_since_s=none,
        )  # fmt: skip
        state.reading = FleetReading(
            stamp_s=none, pose=state.pose, odometry=np.zeros((count, 3)), twist=state.twist,
            hazards=np.zeros(count, np.uint8), contacts=whole, battery=np.full(count, -1.0), obstacles=NO_OBSTACLES,
            position_sigma_m=np.full(count, math.nan),
        )  # fmt: skip
        ids = tuple(f"r{row + 1}" for row in range(count))
        return Context(ids, names or ids, state, none, np.arange(count), lambda: whole)

    @property
    def own(self) -> Words:
        """Ids of the own robots, (n,)."""
        if self._own is None:
            self._own = np.array(self.ids)
        return self._own

    @property
    def received(self) -> Words:
        """Ids of the robots received, (m,)."""
        if self._received is None or self._names_then != self.names:
            self._received, self._names_then = np.array(self.names, np.str_), list(self.names)
        return self._received

    @property
    def reading(self) -> FleetReading:
        """The newest of the drivers; a law is not called before there is one."""
        reading = self.state.reading
        if reading is None:
            raise ConfigError("the drivers have read nothing yet")
        return reading


class Draws:
    """Random numbers of n robots, each from a generator of its own: one robot's do not depend on the others'.

    A generator starts anew with each request, from the swarm's seed, the robot, the behaviour and how often the robot
    has started it. So a seed gives the same numbers in lockstep and live.
    """

    def __init__(self, generators: list[np.random.Generator]) -> None:
        self.generators = generators

    def uniform(self, low: float | Array = 0.0, high: float | Array = 1.0, *shape: int) -> Array:
        r"""Return numbers in [low, high), (n,) or (n, \*shape)."""
        return low + (high - low) * np.array([each.random(shape) for each in self.generators])

    def normal(self, mean: float | Array = 0.0, sigma: float | Array = 1.0, *shape: int) -> Array:
        r"""Return normally distributed numbers, (n,) or (n, \*shape)."""
        return mean + sigma * np.array([each.standard_normal(shape) for each in self.generators])

    def integers(self, low: int, high: int, *shape: int) -> Index:
        r"""Return whole numbers in [low, high), (n,) or (n, \*shape)."""
        return np.array([each.integers(low, high, shape or None) for each in self.generators], np.int64)


class View:
    """The world as n robots sense it at one moment. World frame, SI units.

    Parameters
    ----------
    position : (n, 2) m
    heading : (n,) rad
    radius : (n,) m, footprints
    near : finds the neighbours when they are first used: ``start`` (n + 1,), pairs of robot i are
        ``start[i]:start[i + 1]``, and ``other`` (e or more,), rows of the neighbours in `states` and `predicted`
    predicted : (m, 2) m, positions of all robots received, predicted to now
    states : (m, 6) x, y, heading, speed, turn rate, radius as received
    bounds_m : x_min, y_min, x_max, y_max of the arena
    known : ``known(row, source)`` returns the static obstacles (k, 6) that a robot knows, see `ObstacleMap`
    speed_limit : (n,) m/s; None: there is none
    aims : (m, 2) m, where the robots received say that they are driving to, see `Neighbours`; None: none says
    margin_m : (n,) m, the gap that the safety filter keeps where it runs; None: none
    standing : ``standing(row)`` returns the robots at standstill that are not on their way, as obstacles (k, 6), `row`
        itself left out
    context : what else the agent knows; None: nothing, with default values
    rows : rows of these robots in `context`; None: all, in its order
    shared : the request that all of them run; None: of several

    Attributes
    ----------
    endings : out: see `finish`
    aim : (n, 2) m, out: where the control law is driving to next, for the neighbours; None or NaN: it does not say
    blocked : out: by robot, why the control law knows no way
    """

    actuations: tuple[Actuation, ...] = ()  # out: see `actuate`

    def __init__(
        self,
        position: Array,
        heading: Array,
        radius: Array,
        near: Callable[[], tuple[Index, Index]],
        predicted: Array,
        states: Array,
        bounds_m: tuple[float, float, float, float],
        known: Callable[[int, str], Array] = nothing_known,
        speed_limit: Array | None = None,
        aims: Array | None = None,
        margin_m: Array | None = None,
        standing: Callable[[int], Array] = none_standing,
        context: Context | None = None,
        rows: Index | None = None,
        shared: Shared | None = None,
    ) -> None:
        self.speed_limit = np.full(len(position), math.inf) if speed_limit is None else speed_limit
        self.position, self.heading, self.radius = position, heading, radius
        self.bounds_m = bounds_m
        self.known, self.standing = known, standing
        self.aims = np.full((len(states), 2), math.nan) if aims is None else aims
        self.margin_m = np.zeros(len(position)) if margin_m is None else margin_m
        self.aim: Array | None = None
        self.blocked: dict[int, Reason] = {}
        self.endings: list[Ending] = []
        self._near = near
        self._predicted, self._states = predicted, states
        self._known, self._rows, self._shared = context, rows, shared
        # Filled when first asked for. Plain slots: functools.cached_property takes a lock on Python 3.11.
        self._lists: tuple[Index, Index] | None = None
        self._described: tuple[Index, Array, Array, Array] | None = None
        self._heard: Heard | None = None

    def _neighbours(self) -> tuple[Index, Index]:
        if self._lists is None:
            start, other = self._near()
            self._lists = start, other[: start[-1]]
        return self._lists

    @property
    def start(self) -> Index:
        """Pairs of robot i are ``start[i]:start[i + 1]``, (n + 1,)."""
        return self._neighbours()[0]

    @property
    def other(self) -> Index:
        """Row of each pair's neighbour among the robots received, (e,)."""
        return self._neighbours()[1]

    def _pairs(self) -> tuple[Index, Array, Array, Array]:
        if self._described is None:
            start, other = self._neighbours()
            count = len(other)
            found = np.empty(count, np.int64), np.empty((count, 2)), np.empty(count), np.empty(count)
            describe.run(self.position, start, other, self._predicted, self._states, *found)
            self._described = found
        return self._described

    @property
    def of(self) -> Index:
        """Robot of each pair, (e,)."""
        return self._pairs()[0]

    @property
    def offset(self) -> Array:
        """From the robot to its neighbour, ``d_ij = p_j - p_i`` of the paper, (e, 2) m."""
        return self._pairs()[1]

    @property
    def distance(self) -> Array:
        """Length of `offset`, (e,) m."""
        return self._pairs()[2]

    @property
    def neighbour_heading(self) -> Array:
        """Heading of the neighbour, (e,) rad."""
        return self._pairs()[3]

    @property
    def neighbour_radius(self) -> Array:
        """Footprint of the neighbour, (e,) m."""
        radius: Array = self._states[self.other, 5]
        return radius

    @property
    def neighbours(self) -> Array:
        """How many neighbours each robot senses, (n, 1)."""
        return (self.start[1:] - self.start[:-1]).astype(float)[:, None]

    def actuate(self, robots: int | Index | NDArray[np.bool_] | Sequence[int], name: str, value: object) -> None:
        """Ask for the state of an actuator that the make declares, see :mod:`fullswarm.drivers.actuators`.

        A value is a state: ask for it each time, it is sent once. The robot's driver checks it; what it refuses is
        logged with the reason, and the robot drives on. It is passed on while the robot may drive.

        Parameters
        ----------
        robots : which, as one row, rows (k,) or flags (n,)
        """
        chosen = np.asarray(robots)
        rows = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen.ravel()
        self.actuations = (*self.actuations, *(Actuation(int(row), name, value) for row in rows))

    @property
    def predicted(self) -> Array:
        """Positions of all robots received, predicted to now, (m, 2) m; `other` names its rows."""
        return self._predicted

    @property
    def states(self) -> Array:
        """States of all robots as received, (m, 6)."""
        return self._states

    def sum(self, values: Array) -> Array:
        """Add up values of pairs (e, 2) over the neighbours of each robot: (n, 2)."""
        total = np.empty((len(self.position), 2))
        fold.run(self.start, values, total)
        return total

    # ------------------------------------------------------------------ who, when, what else is known: on demand
    @property
    def context(self) -> Context:
        """What the agent knows beside positions."""
        if self._known is None:
            names = [f"r{row + 1}" for row in range(len(self._states))]
            self._known = Context.of(self.position, self.heading, names)
        return self._known

    def _own(self, column: Any) -> Any:
        """Return these robots' rows of a column of all own robots."""
        return column if self._rows is None else column[self._rows]

    @property
    def time_s(self) -> Array:
        """Since the robot was given its request, (n,) s."""
        elapsed: Array = self.context.now_s - self._own(self.context.since_s)
        return elapsed

    @property
    def dt_s(self) -> float:
        """Since the control laws were called before, s; at most two periods."""
        return self.context.dt_s

    @property
    def id(self) -> Words:
        """Names of the robots, (n,)."""
        found: Words = self._own(self.context.own)
        return found

    @property
    def neighbour_id(self) -> Words:
        """Name of each pair's neighbour, (e,)."""
        found: Words = self.context.received[self.other]
        return found

    def shared(self) -> Shared:
        """Return the request that all these robots run.

        Raises
        ------
        RequestsDiffer
            They run several; leave it to the agent, which then calls the law once per request.
        """
        if self._known is not None and self._shared is None:
            raise RequestsDiffer
        return self._shared or Shared("", self.context.ids)

    @property
    def members(self) -> tuple[str, ...]:
        """Names of the robots of the request, in its order; empty for what a stick asks for."""
        return self.shared().members

    @property
    def index(self) -> Index:
        """Place of each robot among `members`, (n,); -1: it is not among them."""
        found: Index = self._own(self.context.index)
        return found

    @property
    def neighbour_index(self) -> Index:
        """Place of each pair's neighbour among `members`, (e,); -1: it is not among them."""
        place = _places(self.members)
        names = self.context.names
        return np.array([place.get(names[row], -1) for row in self.other.tolist()], np.int64)

    @property
    def neighbour_velocity(self) -> Array:
        """Velocity of the neighbour as received, world frame, (e, 2) m/s."""
        velocity = np.empty((len(self.other), 2))
        move.run(self.other, self._states, velocity)
        return velocity

    @property
    def twist(self) -> Array:
        """Measured speed and turn rate, (n, 2) m/s and rad/s."""
        found: Array = self._own(self.context.state.twist)
        return found

    @property
    def odometry(self) -> Array:
        """Pose by wheels or gyro since the driver was opened, (n, 3) m and rad; starts at zero, and drifts."""
        found: Array = self._own(self.context.reading.odometry)
        return found

    @property
    def battery(self) -> Array:
        """Charge, (n,) 0 to 1; -1: unknown."""
        found: Array = self._own(self.context.reading.battery)
        return found

    @property
    def hazards(self) -> NDArray[np.uint8]:
        """Bits of :class:`~fullswarm.drivers.base.Hazard` that the robot senses, (n,)."""
        found: NDArray[np.uint8] = self._own(self.context.reading.hazards)
        return found

    @property
    def contacts(self) -> Index:
        """How many bodies the robot touches, as it feels itself or a source outside sees it, (n,)."""
        found: Index = self._own(self.context.contacts())
        return found

    @property
    def role(self) -> Words:
        """Role of the robot in its request, (n,); empty: it has none."""
        return self._roles(self.index)

    @property
    def neighbour_role(self) -> Words:
        """Role of the neighbour in the same request, (e,); empty: it has none, or runs another request."""
        return self._roles(self.neighbour_index)

    def _roles(self, places: Index) -> Words:
        roles = self.shared().roles
        if not roles:
            return np.full(len(places), "", np.str_)
        return np.array((*roles, ""), np.str_)[places]  # -1, no place, is the last one

    # ------------------------------------------------------------------ what robots are and can do
    def _profiles(self) -> profiles.Known:
        known = self.context.profiles
        if known is None:
            return [None] * len(self.position)
        return known.own if self._rows is None else [known.own[row] for row in self._rows.tolist()]

    def _their_profiles(self) -> profiles.Known:
        known = self.context.profiles
        return [None] * len(self.other) if known is None else known.table.at(self.other)

    @property
    def make(self) -> Words:
        """Make of the robot, (n,), as its driver states it: ``iRobot``, ``sim``, ..."""
        return profiles.makes(self._profiles())

    def can(self, capability: str) -> Flags:
        """Tell which robots (n,) have a capability: an actuator's name, "bumps", or one of the fleet file."""
        return profiles.having(self._profiles(), capability)

    @property
    def neighbour_make(self) -> Words:
        """Make of the neighbour, (e,); empty: not received yet."""
        return profiles.makes(self._their_profiles())

    def neighbour_can(self, capability: str) -> Flags:
        """Tell which neighbours (e,) are known to have a capability; see :meth:`can`."""
        return profiles.having(self._their_profiles(), capability)

    @property
    def neighbour_battery(self) -> Array:
        """Charge of the neighbour, (e,) 0 to 1, some seconds old; -1: unknown."""
        return profiles.charges(self._their_profiles())

    @property
    def neighbour_limits(self) -> Array:
        """Greatest speed, turn rate and acceleration of the neighbour, (e, 3) m/s, rad/s, m/s²; NaN: unknown."""
        return profiles.limits(self._their_profiles())

    @property
    def random(self) -> Draws:
        """Random numbers of each robot; see :class:`Draws`."""
        self.shared()
        rows = range(len(self.position)) if self._rows is None else self._rows.tolist()
        return Draws([self.context.generator(row) for row in rows])

    # ------------------------------------------------------------------ messages between the robots of a request
    def _channel(self) -> Channel:
        self.shared()
        if self.context.channel is None:
            raise ConfigError(
                "there is nothing here to broadcast through", hint="give the view a context with a channel"
            )
        return self.context.channel(self._rows)

    def say(self, **fields: Any) -> None:
        """Broadcast to the neighbours what the law's class ``Says`` declares, at its rate: 10 Hz at most.

        The newest values count. A robot with a NaN among its values broadcasts nothing.

        Parameters
        ----------
        fields : all that is declared, each of its shape (n, ...) or one number for all robots
        """
        self._channel().say(fields)

    @property
    def heard(self) -> Heard:
        """What was received from robots that run the same request and are within range now, as pairs."""
        if self._heard is None:
            self._heard = self._channel().heard
        return self._heard

    @property
    def table(self) -> SharedTable:
        """The shared key-value table of the request, as each robot knows it by now."""
        return self._channel().table

    def finish(self, robots: Index | NDArray[np.bool_] | Sequence[int], outcome: Outcome, text: str = "") -> None:
        """End the behaviour on some robots with a result: they stand, and operators and missions see it.

        Parameters
        ----------
        robots : which, as rows (k,) or as flags (n,)
        outcome : "arrived" or "failed"
        text : one sentence for people; of what failed, why
        """
        if outcome not in ("arrived", "failed"):
            raise ValueError(f"finish: the outcome must be 'arrived' or 'failed', not {outcome!r}")
        chosen = np.asarray(robots)
        rows = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
        self.endings += [Ending(int(row), outcome, text[:LONGEST_TEXT]) for row in rows.ravel()]

    def select(self, rows: Index, shared: Shared | None = None) -> View:
        """Return the view of a part of the robots, `rows` (k,) ascending; `shared`: the request that they all run."""

        def near() -> tuple[Index, Index]:
            start = np.concatenate([[0], np.cumsum((self.start[1:] - self.start[:-1])[rows])])
            others = [self.other[self.start[row] : self.start[row + 1]] for row in rows]
            return start, np.concatenate(others)

        return View(
            self.position[rows],
            self.heading[rows],
            self.radius[rows],
            near,
            self._predicted,
            self._states,
            self.bounds_m,
            lambda row, source: self.known(int(rows[row]), source),
            self.speed_limit[rows],
            self.aims,
            self.margin_m[rows],
            lambda row: self.standing(int(rows[row])),
            self._known,
            rows if self._rows is None else self._rows[rows],
            shared or self._shared,
        )


LONGEST_TEXT = 200
"""Characters of the text of a result."""


@functools.lru_cache(maxsize=64)
def _places(members: tuple[str, ...]) -> dict[str, int]:
    """Return the place of each name."""
    return {name: place for place, name in enumerate(members)}


@kernel
def describe(
    position: Array, start: Index, other: Index, predicted: Array, states: Array, of: Index, offset: Array,
    distance: Array, heading: Array,
) -> None:  # fmt: skip
    """Fill the robot of each pair (e,), offset (e, 2), distance (e,) and the neighbour's heading (e,)."""
    for i in range(position.shape[0]):
        for pair in range(start[i], start[i + 1]):
            row = other[pair]
            dx = predicted[row, 0] - position[i, 0]
            dy = predicted[row, 1] - position[i, 1]
            of[pair] = i
            offset[pair, 0] = dx
            offset[pair, 1] = dy
            distance[pair] = math.sqrt(dx * dx + dy * dy)
            heading[pair] = states[row, 2]


@kernel
def move(other: Index, states: Array, velocity: Array) -> None:
    """Fill the velocities (e, 2) of the robots in rows `other` (e,) of the states."""
    for pair in range(other.shape[0]):
        row = other[pair]
        velocity[pair, 0] = states[row, 3] * math.cos(states[row, 2])
        velocity[pair, 1] = states[row, 3] * math.sin(states[row, 2])


@kernel
def fold(start: Index, values: Array, total: Array) -> None:
    """Add up values of pairs (e, 2) per robot into `total` (n, 2)."""
    for i in range(total.shape[0]):
        x = 0.0
        y = 0.0
        for pair in range(start[i], start[i + 1]):
            x += values[pair, 0]
            y += values[pair, 1]
        total[i, 0] = x
        total[i, 1] = y
