"""Watches the bodies of a trial: through their world where it is simulated, else by pose fixes and reports.

A world knows where bodies are and which of them touch, whatever noise or network faults are injected. Of real robots
the same referee judges the newest poses, `REPORTED_HZ` times a second: of fixes where something sees them, else of
their estimators. Contacts that their bumpers report are counted too; which kind they were is inferred from the distance
to the nearest robot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.safety.barrier import box_gap
from fullswarm.bus.base import Bus
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Limits
from fullswarm.evaluate.swarm import Numbers, finite
from fullswarm.evaluate.trial_folder import GRAIN, Approach, Evidence
from fullswarm.kernels import Array, Index
from fullswarm.keys import Keys
from fullswarm.messages import HealthReport, PoseFix, RobotHealth, RobotStates
from fullswarm.perf.calculators import CollisionCalculator
from fullswarm.perf.truth import Truth
from fullswarm.simulation.approaches import SPAN, Approaches
from fullswarm.simulation.contacts import ContactReferee, Solids
from fullswarm.simulation.obstacles import static_obstacles, with_trigonometry
from fullswarm.simulation.world import World

TOLERANCE = 1e-9
ENDLESS = Limits(speed_m_s=np.inf, turn_rad_s=np.inf, accel_m_s2=np.inf, turn_accel_rad_s2=np.inf)
NEAR_M = 0.1
"""A robot whose bumper is pressed has met another one when the gap between their estimated poses is below this."""
USUAL_RADIUS_M = 0.17
"""Of a robot that has not reported its radius yet."""
FIX_S = 0.25
"""A pose fix that is older does not show where a robot is now: what it reports itself counts."""
REPORTED_HZ = 20.0
"""How often poses of real robots are judged: as often as they report them."""
FAR_M = 1e6
NOWHERE = 2e9  # grains, of a pose that is not known
EVENT_S = 0.25  # without contact, before another one is an event of its own
STILL_M_S = 1e-3
WALLS = ("west wall", "east wall", "south wall", "north wall")


class Bodies(Protocol):
    """n bodies and the referee of their steps; `World` is one."""

    ids: tuple[str, ...]
    dt_s: float
    pose: Array  # (n, 3)
    target: Array  # (n, 2) commands, m/s and rad/s
    radius_m: Array  # (n,)
    obstacles: Array  # (k, 6) rows of ``Reading.obstacles``: boxes, then four walls or none
    referee: ContactReferee


@dataclass(frozen=True, slots=True)
class Standard:
    """What the motion of a trial is held against, and what it is known from.

    Attributes
    ----------
    limits : (n, 2) m/s, rad/s that each robot's driver states; inf: its commands are not seen
    goals : (n, 2), each reached within `goal_radius_m`
    walls : the last four obstacles are the arena's walls
    source, engine : as in `Evidence`
    """

    limits: Array
    goals: Array
    goal_radius_m: float
    walls: bool
    source: str = "world"
    engine: str = ""

    @classmethod
    def of_world(cls, world: World, goals: Array, goal_radius_m: float, emulated: bool = False) -> Standard:
        """Return that of a simulated world; `emulated`: firmware stands between the commands and the bodies."""
        stated = [ENDLESS if emulated else each.limits for each in world.descriptions]
        return cls(
            limits=np.array([(each.speed_m_s, each.turn_rad_s) for each in stated], float).reshape(-1, 2),
            goals=np.array(goals, float),
            goal_radius_m=goal_radius_m,
            walls=world.config.walls,
            engine=world.config.engine,
        )


class TwoKinds:
    """Counts contact events of n robots in two kinds; a contact is of the kind of its first step.

    Attributes
    ----------
    kinds : the events of each
    """

    def __init__(self, count: int) -> None:
        self.kinds = CollisionCalculator(count), CollisionCalculator(count)
        self._counts = np.zeros((2, count), np.int64)
        self._second = np.zeros(count, np.bool_)
        self._since_s = np.full(count, -np.inf)

    def sample(self, time_s: float, rows: Index, second: NDArray[np.bool_]) -> None:
        """Take in one step: a robot's row (m,) for each thing that it touches, and whether that is of the second kind.

        A robot that begins to touch things of both kinds at once has touched one of the second.
        """
        new = time_s - self._since_s[rows] > EVENT_S
        self._second[rows[new]] = False
        self._second[rows[new & second]] = True
        self._since_s[rows] = time_s
        self._counts[:] = 0
        np.add.at(self._counts, (self._second[rows].astype(np.int64), rows), 1)
        for kind, counts in zip(self.kinds, self._counts, strict=True):
            kind.update(time_s, counts)


class MoverContacts:
    """Counts contacts of n robots with movers, by what brought them about.

    Attributes
    ----------
    own, hit : the robot moved towards the mover when they touched; it stood or went away, and the mover came
    """

    def __init__(self, count: int) -> None:
        self._contacts = TwoKinds(count)
        self.hit, self.own = self._contacts.kinds

    def sample(self, time_s: float, found: ContactReferee) -> None:
        """Take in one step. What the robot did is judged before anything was pushed in it."""
        rows, others = found.pairs[found.pairs[:, 1] < -found.fixed].T
        way = found.path[1, rows] - found.path[0, rows]
        towards = found.solids.obstacles[-1 - others, :2] - found.path[0, rows]
        speed = (way * towards).sum(axis=1) / np.maximum(np.hypot(*towards.T), 1e-9) / found.part_s[0]
        self._contacts.sample(time_s, rows, speed > STILL_M_S)


class RobotContacts:
    """Counts contacts of n robots with each other, apart those of a pair of which a mover pushes one.

    Attributes
    ----------
    own, pushed : neither of the two had been touched by a mover for `EVENT_S` when they met; the others
    """

    def __init__(self, count: int) -> None:
        self._contacts = TwoKinds(count)
        self.own, self.pushed = self._contacts.kinds
        self._mover_s = np.full(count, -np.inf)

    def sample(self, time_s: float, pairs: Index, by_mover: Index) -> None:
        """Take in one step: pairs (m, 2) of robots that touch, and the rows of those that a mover touches."""
        self._mover_s[by_mover] = time_s
        pushed = time_s - self._mover_s[pairs].max(axis=1) <= EVENT_S
        self._contacts.sample(time_s, pairs.ravel(), np.repeat(pushed, 2))


class Referee:
    """Counts contacts and commands above the limits after each step, and keeps what proves the count.

    Attributes
    ----------
    pairs : which pairs of robots have touched, as (row, higher row)
    touched : (n,) which robots have touched anything
    """

    def __init__(self, bodies: Bodies, standard: Standard) -> None:
        count = len(bodies.ids)
        self._bodies, self._standard = bodies, standard
        self._most = standard.limits * (1.0 + TOLERANCE)
        self.obstacles = CollisionCalculator(count)
        self.robots, self.movers = RobotContacts(count), MoverContacts(count)
        self.pairs: set[tuple[int, int]] = set()
        self.touched = np.zeros(count, np.bool_)
        self._counts, self._touching = np.zeros(count, np.int64), False
        self._steps = 0
        solids = bodies.referee.solids
        fixed = Solids(solids.obstacles[: bodies.referee.fixed], solids.radius)
        self._approaches = Approaches(fixed, bodies.referee.touch_m, bodies.dt_s)
        # The steps of the present span: row 0 is where it began.
        self._row = 0
        self._pose, self._command = np.zeros((SPAN + 1, count, 3)), np.zeros((SPAN + 1, count, 2))
        self._pose[0], self._command[0] = bodies.pose, bodies.target
        self._near: list[tuple[int, Index, Array]] = []
        self._motion = [_grains(self._pose[:1], self._command[:1])]  # (t, n, 5) x, y, heading, command
        self._bends: list[tuple[int, NDArray[np.int64], Array]] = []
        self._above: list[Array] = []
        self._movers: list[NDArray[np.float64]] = []

    def sample(self) -> None:
        """Take in the last step."""
        bodies, found = self._bodies, self._bodies.referee
        self._steps += 1
        time_s = self._steps * bodies.dt_s
        self._row += 1
        self._pose[self._row], self._command[self._row] = bodies.pose, bodies.target
        if len(found.near):
            near, gap_m = found.near, found.near_gap_m
            if found.fixed < len(found.solids.obstacles):  # how near a mover comes is its doing
                fixed = near[:, 1] >= -found.fixed
                near, gap_m = near[fixed], gap_m[fixed]
            self._near.append((self._row, near.copy(), gap_m.copy()))
        if found.fixed < len(found.solids.obstacles):
            self._movers.append(found.solids.obstacles[found.fixed :, :2].copy())
        if len(found.pairs) or self._touching:
            self._count(time_s)
        if self._row == SPAN:
            self._end_span()

    def _count(self, time_s: float) -> None:
        """Take in the contacts of the last step, or that there is none any more."""
        counts, found = self._counts, self._bodies.referee
        counts[:] = 0
        self._touching = len(found.pairs) > 0
        pairs, touched = found.pairs, found.contacts
        by_mover = pairs[:0, 0]
        if found.fixed < len(found.solids.obstacles):
            self.movers.sample(time_s, found)
            by_mover = pairs[pairs[:, 1] < -found.fixed, 0]
            pairs = pairs[pairs[:, 1] >= -found.fixed]
            touched = np.bincount(pairs[pairs >= 0], minlength=len(touched))
        robots = pairs[pairs[:, 1] >= 0]
        if len(pairs):
            self.pairs.update((min(pair), max(pair)) for pair in robots.tolist())
            np.add.at(counts, pairs[pairs[:, 1] < 0, 0], 1)
            self.touched |= touched > 0
        if self._touching:  # also what a mover pushes: its way through the step is no straight one
            rows = np.flatnonzero(found.contacts)
            self._bends.append((self._steps, rows, found.path[1:, rows].swapaxes(0, 1).copy()))
        self.robots.sample(time_s, robots, by_mover)
        self.obstacles.update(time_s, counts)

    def _end_span(self) -> None:
        """Take in the steps of the present span, and begin a new one."""
        steps, pose, command = self._row, self._pose[: self._row + 1], self._command[: self._row + 1]
        if not steps:
            return
        first = self._steps - steps
        entries = [np.column_stack([np.full(len(near), row), near]) for row, near, _ in self._near]
        gaps = [each for _, _, each in self._near]
        if entries:
            self._approaches.take(first, pose, np.concatenate(entries), np.concatenate(gaps))
        else:
            self._approaches.take(first, pose, np.zeros((0, 3), np.int64), np.zeros(0))
        self._motion.append(_grains(pose[1:], command[1:]))
        above = np.abs(command[1:]) > self._most
        if above.any():
            rows, robots = np.nonzero(above.any(axis=2))
            self._above.append(np.column_stack([rows + first + 1, robots, command[rows + 1, robots]]))
        self._pose[0], self._row = pose[-1], 0
        self._near.clear()

    @property
    def above_limits(self) -> int:
        """How many commands were above the limits so far."""
        self._end_span()
        return sum(map(len, self._above))

    @property
    def approaches(self) -> Approaches:
        """How near they came so far."""
        self._end_span()
        return self._approaches

    def rehearse(self) -> None:
        """Do once all that is done in a trial, so that no kernel is compiled while robots drive."""
        self.sample()
        self._count(0.0)
        self._end_span()

    def evidence(self) -> Evidence:
        """Return what is needed to count everything again."""
        bodies, found, standard, nearest = self._bodies, self._bodies.referee, self._standard, self.approaches.nearest
        motion = np.concatenate(self._motion)
        places = np.array(self._movers).reshape(len(self._movers), len(found.solids.obstacles) - found.fixed, 2)
        movers: NDArray[np.int32] = np.round(places / GRAIN).astype(np.int32)
        bends = [(step, row, way) for step, rows, ways in self._bends for row, way in zip(rows, ways, strict=True)]
        steps, rows = (np.array([each[column] for each in bends], np.int32) for column in (0, 1))
        ways = np.round(np.array([way for *_, way in bends]).reshape(-1, len(found.part_s), 2) / GRAIN).astype(np.int32)
        starts = motion[steps - 1, rows, :2].reshape(-1, 1, 2)
        motion = np.diff(motion, axis=0, prepend=np.int32(0))
        return Evidence(
            source=standard.source,
            engine=standard.engine,
            ids=bodies.ids,
            radius_m=bodies.radius_m.copy(),
            obstacles=np.array(bodies.obstacles),
            limits=standard.limits.copy(),
            goals=np.array(standard.goals, float),
            goal_radius_m=standard.goal_radius_m,
            touch_m=found.touch_m,
            step_s=bodies.dt_s,
            part_s=found.part_s,
            closest_m=nearest.gap.astype(np.float32),
            closest_s=np.round(nearest.at, 6),
            wall_m=nearest.wall_gap.astype(np.float32),
            wall_s=np.round(nearest.wall_at, 6),
            soonest=np.array([*nearest.soonest, *nearest.who], float),
            xy=motion[:, :, :2],
            heading=motion[:, :, 2],
            command=motion[:, :, 3:],
            above=np.concatenate([np.zeros((0, 4)), *self._above]),
            mover_radius_m=found.solids.obstacles[found.fixed :, 6].copy(),
            mover_xy=np.diff(movers, axis=0, prepend=np.int32(0)),
            bend_step=steps,
            bend_robot=rows,
            bend=np.diff(ways, axis=1, prepend=starts),
        )

    def values(self) -> dict[str, float]:
        """Return how near the robots came; what never came near anything is left out."""
        nearest = self.approaches.nearest
        return finite(
            {
                "separation.min_m": float(nearest.gap.min(initial=np.inf)),
                "clearance.min_m": float(nearest.wall_gap.min(initial=np.inf)),
                "time_to_contact.min_s": float(nearest.soonest[0]),
            }
        )

    def per_robot(self) -> dict[str, dict[str, float]]:
        """Return the same by robot."""
        ids, near = self._bodies.ids, self.approaches
        columns = {"separation.gap_m": near.apart_m, "clearance.gap_m": near.clear_m}
        return {name: finite(dict(zip(ids, each.tolist(), strict=True))) for name, each in columns.items()}

    def nearest(self) -> dict[str, Approach]:
        """Return what came nearest, and soonest to a contact, with when and who."""
        nearest, count, found = self.approaches.nearest, len(self._bodies.ids), dict[str, Approach]()
        if np.isfinite(nearest.gap).any():
            pair = int(nearest.gap.argmin())
            first, second = (int(rows[pair]) for rows in np.triu_indices(count, 1))
            found["separation.min_m"] = self._approach(nearest.gap[pair], nearest.at[pair], first, second)
        if np.isfinite(nearest.wall_gap).any():
            row, k = divmod(int(nearest.wall_gap.argmin()), nearest.wall_gap.shape[1])
            found["clearance.min_m"] = self._approach(nearest.wall_gap[row, k], nearest.wall_at[row, k], row, -1 - k)
        if np.isfinite(nearest.soonest[0]):
            first, second = nearest.who.tolist()
            found["time_to_contact.min_s"] = self._approach(nearest.soonest[0], nearest.soonest[1], first, second)
        return found

    def _approach(self, value: float, at_s: float, row: int, other: int) -> Approach:
        ids = self._bodies.ids
        name = ids[other] if other >= 0 else self._obstacle(-1 - other)
        return Approach(value=float(value), at_s=round(float(at_s), 6), who=(ids[row], name))

    def _obstacle(self, k: int) -> str:
        boxes = len(self._bodies.obstacles) - len(WALLS) * self._standard.walls
        return WALLS[k - boxes] if k >= boxes else f"box {k}"


def _grains(pose: Array, command: Array) -> NDArray[np.int32]:
    """Return poses (t, n, 3) and commands (t, n, 2) in whole grains, commands rounded towards zero, (t, n, 5)."""
    grains = np.concatenate([np.round(pose / GRAIN), np.trunc(command / GRAIN)], axis=2)
    grains[np.isnan(grains)] = NOWHERE
    return grains.astype(np.int32)


class ContactTally(NamedTuple):
    """What a witness counts."""

    robot_events: Index  # (n,) contacts with robots, one for each of the two, but `pushed_events`
    obstacle_events: Index  # (n,)
    pairs_touched: int | None  # pairs of robots that have touched; None: not known
    robots_touched: int  # robots that have touched anything
    above_limits: int  # commands beyond the actuators' limits; 0 where they cannot be seen
    mover_events: int = 0  # contacts with movers towards which the robot moved
    mover_hits: int = 0  # movers that touched a robot that stood or went away
    pushed_events: int = 0  # contacts of two robots of which a mover pushed one


class Witness(Protocol):
    """Watches n bodies."""

    def leave_out(self, rows: NDArray[np.bool_]) -> None:
        """Take their goals from robots that take no part, (n,)."""
        ...

    def begin(self) -> None:
        """Count from now on."""
        ...

    def sample(self) -> None:
        """Take in what has happened since the last call."""
        ...

    def touched(self) -> NDArray[np.bool_]:
        """Return which robots have touched anything since this was asked last, (n,)."""
        ...

    @property
    def pose(self) -> Array:
        """Where they are now, (n, 3) m, m, rad; NaN: unknown."""
        ...

    @property
    def radius_m(self) -> Array:
        """Their sizes, (n,)."""
        ...

    def tally(self) -> ContactTally:
        """Return what has been counted so far."""
        ...

    def evidence(self) -> Evidence:
        """Return what is needed to count everything again."""
        ...

    @property
    def source(self) -> str:
        """What it sees, as in `Evidence`."""
        ...

    def nearest(self) -> Mapping[str, Approach]:
        """Return what came nearest, and soonest to a contact."""
        ...

    def values(self) -> Numbers:
        """Return the true numbers of the swarm; none where the robots' own data is all there is."""
        ...

    def per_robot(self) -> Mapping[str, Numbers]:
        """Return the same by robot."""
        ...


class WorldWitness:
    """Watches the bodies of a simulated world; to be called after each of its steps.

    Parameters
    ----------
    goals : (n, 2), each reached within `goal_radius_m`
    cell_m : of the true coverage grid
    emulated : firmware stands between the commands and the bodies, so commands are not seen here
    """

    source = "world"

    def __init__(self, world: World, goals: Array, goal_radius_m: float, cell_m: float, emulated: bool = False) -> None:
        self._world, self._steps = world, 0
        self._standard = Standard.of_world(world, goals, goal_radius_m, emulated)
        self._touched = np.zeros(len(world.ids), bool)
        about = world.ids, self.radius_m, goals, goal_radius_m, world.config.bounds_m, cell_m
        # Kernels are compiled when they first run: not while robots drive in a world that this process steps.
        Truth(*about).sample(0.0, world.pose, world.twist, world.dt_s, world.contacts)
        Referee(world, self._standard).rehearse()
        self.truth: Truth = Truth(*about)
        self._referee = Referee(world, self._standard)

    def leave_out(self, rows: NDArray[np.bool_]) -> None:
        """Take their goals from robots that take no part, (n,)."""
        self._standard.goals[rows] = np.nan
        self.truth.leave_out(rows)

    def begin(self) -> None:
        """Watch from where the bodies are now."""
        self._referee = Referee(self._world, self._standard)

    def sample(self) -> None:
        """Take in one step of the world."""
        world = self._world
        self._steps += 1
        self._referee.sample()
        self.truth.sample(self._steps * world.dt_s, world.pose, world.twist, world.dt_s, world.contacts)
        self._touched |= world.contacts > 0

    def touched(self) -> NDArray[np.bool_]:
        """Return which robots have touched anything since this was asked last."""
        found, self._touched = self._touched, np.zeros(len(self._touched), bool)
        return found

    @property
    def pose(self) -> Array:
        """The true poses."""
        return self._world.pose

    @property
    def radius_m(self) -> Array:
        """The true sizes."""
        return self._world.radius_m

    def tally(self) -> ContactTally:
        """Return what the referee has counted."""
        found = self._referee
        return ContactTally(
            robot_events=found.robots.own.events,
            obstacle_events=found.obstacles.events,
            pairs_touched=len(found.pairs),
            robots_touched=int(found.touched.sum()),
            above_limits=found.above_limits,
            mover_events=int(found.movers.own.events.sum()),
            mover_hits=int(found.movers.hit.events.sum()),
            pushed_events=int(found.robots.pushed.events.sum()),
        )

    def evidence(self) -> Evidence:
        """Return the referee's."""
        return self._referee.evidence()

    def nearest(self) -> dict[str, Approach]:
        """Return the referee's."""
        return self._referee.nearest()

    def values(self) -> dict[str, float]:
        """Return the true numbers; gaps are the referee's, which looks into each step."""
        return finite({**self.truth.values(), **self._referee.values()})

    def per_robot(self) -> dict[str, dict[str, float]]:
        """Return the same by robot."""
        return {**self.truth.per_robot(), **self._referee.per_robot()}


class ReportedBodies:
    """Real robots as bodies that a referee can judge: their newest poses, in steps of `dt_s`.

    A pose may be as old as the period of its fixes or states. So two bodies may be nearer than it seems by their speeds
    times that age, besides the error of the poses.
    """

    def __init__(self, config: SwarmConfig) -> None:
        world, count = config.world_or_default, len(config.robots)
        self.ids, self.dt_s = tuple(config.robots), 1.0 / REPORTED_HZ
        self.pose = np.full((count, 3), np.nan)
        self.target = np.zeros((count, 2))
        self.obstacles = static_obstacles(world)
        radius_m = np.full(count, USUAL_RADIUS_M)
        self.referee = ContactReferee(world, with_trigonometry(self.obstacles), radius_m, np.array([self.dt_s]))
        self.radius_m = self.referee.radius_m
        self.referee.path[:] = np.nan

    def step(self) -> None:
        """Let the referee judge the ways from the poses of the last step to those of now."""
        path = self.referee.path
        path[0] = path[1]
        path[1] = self.pose[:, :2]
        known: NDArray[np.bool_] = np.isfinite(path[0, :, 0] + path[1, :, 0])
        moved = np.where(known, np.hypot(*(path[1] - path[0]).T), 0.0)
        # Where a robot is not known, it is far from all others.
        seen = np.where(known[:, None], path[0], FAR_M * (1.0 + np.arange(len(known)))[:, None])
        self.referee.look_ahead(seen, float(moved.max(initial=0.0)))
        self.referee.judge()


class ReportedWitness:
    """Watches real robots from the moment it is made, by pose fixes and by their states and health reports.

    Parameters
    ----------
    now_s : time of this process
    goals : (n, 2), each reached within `goal_radius_m`; without it none is known
    """

    def __init__(
        self, bus: Bus, config: SwarmConfig, now_s: Callable[[], float], goals: Array | None = None,
        goal_radius_m: float = 0.0,
    ) -> None:  # fmt: skip
        count = len(config.robots)
        self._rows = {robot: row for row, robot in enumerate(config.robots)}
        self._bodies, self._now_s = ReportedBodies(config), now_s
        self._pose, self._radius_m = self._bodies.pose, self._bodies.radius_m
        self._fixed_s = np.full(count, -np.inf)
        self._only_fixes = True
        self._began_s, self._steps = now_s(), 0
        self._standard = Standard(
            limits=np.full((count, 2), np.inf),
            goals=np.full((count, 2), np.nan) if goals is None else np.array(goals, float),
            goal_radius_m=goal_radius_m,
            walls=config.world_or_default.walls,
        )
        self._bodies.step()
        Referee(self._bodies, self._standard).rehearse()
        self._referee = Referee(self._bodies, self._standard)
        self._touched = np.zeros(count, bool)
        self._reported = np.full(count, -1, np.int64)  # collisions in the newest report; -1: none yet
        self._events = np.zeros((2, count), np.int64)
        keys = Keys(config.swarm)
        self._subscriptions = [
            bus.subscribe(keys.state(), RobotStates, self._on_states, latest=True),
            bus.subscribe(keys.pose_fix(), PoseFix, self._on_fix),
            bus.subscribe(keys.health(), HealthReport, self._on_health),
        ]

    def leave_out(self, rows: NDArray[np.bool_]) -> None:
        """Take their goals from robots that take no part, (n,)."""
        self._standard.goals[rows] = np.nan

    def begin(self) -> None:
        """Forget the contacts from before."""
        self._events[:] = 0
        self._touched[:] = False
        self._only_fixes = True
        self._bodies.step()
        self._referee = Referee(self._bodies, self._standard)
        self._began_s, self._steps = self._now_s(), 0

    def sample(self) -> None:
        """Judge the ways of the steps that have ended since the last call."""
        now_s = self._now_s()
        while (self._steps + 1) * self._bodies.dt_s <= now_s - self._began_s:
            self._steps += 1
            self._only_fixes &= bool((now_s - self._fixed_s <= FIX_S).all())
            self._bodies.step()
            self._referee.sample()
            self._touched |= self._bodies.referee.contacts > 0

    def touched(self) -> NDArray[np.bool_]:
        """Return which robots have touched anything since this was asked last."""
        found, self._touched = self._touched, np.zeros(len(self._touched), bool)
        return found

    @property
    def source(self) -> str:
        """Where all poses since `begin` are from."""
        return "fixes" if self._only_fixes else "reported"

    @property
    def pose(self) -> Array:
        """The newest fixes and estimates."""
        return self._pose

    @property
    def radius_m(self) -> Array:
        """What their drivers report."""
        return self._radius_m

    def tally(self) -> ContactTally:
        """Return what was counted, by bumpers or from poses, whichever saw more of a robot's contacts.

        A bumper does not tell the pair: what it met is inferred from what was near at the time.
        """
        judged = self._referee
        robots = np.maximum(self._events[0], judged.robots.own.events)
        obstacles = np.maximum(self._events[1], judged.obstacles.events)
        return ContactTally(robots, obstacles, len(judged.pairs), int(((robots > 0) | (obstacles > 0)).sum()), 0)

    def evidence(self) -> Evidence:
        """Return the poses that were judged; what bumpers reported is not in it."""
        return replace(self._referee.evidence(), source=self.source)

    def nearest(self) -> dict[str, Approach]:
        """Return what came nearest by these poses."""
        return self._referee.nearest()

    def values(self) -> dict[str, float]:
        """Return how near they came by these poses."""
        return self._referee.values()

    def per_robot(self) -> dict[str, dict[str, float]]:
        """Return the same by robot."""
        return self._referee.per_robot()

    def close(self) -> None:
        """Subscribe to nothing more."""
        for subscription in self._subscriptions:
            subscription.close()

    def _on_states(self, states: RobotStates) -> None:
        columns = zip(states.robots, states.x_m, states.y_m, states.heading_rad, states.radius_m, strict=False)
        for robot, x_m, y_m, heading_rad, radius_m in columns:
            row = self._rows.get(robot)
            if row is not None:
                if self._radius_m[row] != radius_m:
                    self._radius_m[row] = radius_m
                    self._bodies.referee.allocate(len(self._bodies.referee.candidates.pairs))
                if self._now_s() - self._fixed_s[row] > FIX_S:
                    self._pose[row] = x_m, y_m, heading_rad

    def _on_fix(self, fix: PoseFix) -> None:
        row = self._rows.get(fix.robot)
        if row is not None:
            self._pose[row], self._fixed_s[row] = (fix.x_m, fix.y_m, fix.heading_rad), self._now_s()

    def _on_health(self, report: HealthReport) -> None:
        for health in report.robots:
            row = self._rows.get(health.robot)
            if row is not None:
                self._book(row, health)

    def _book(self, row: int, health: RobotHealth) -> None:
        new = health.collisions - self._reported[row] if self._reported[row] >= 0 else 0
        self._reported[row] = health.collisions
        self._touched[row] |= health.contacts > 0 or new > 0
        if new > 0:
            self._events[0 if self._beside_another(row) else 1, row] += new

    def _beside_another(self, row: int) -> bool:
        apart_m = np.hypot(*(self._pose[:, :2] - self._pose[row, :2]).T) - self._radius_m - self._radius_m[row]
        apart_m[row] = np.inf
        return bool((apart_m < NEAR_M).any())  # a pose that is not known is not near


def in_safe_set(world: World, margin_m: float) -> bool:
    """Return whether every gap between bodies, boxes, walls and the arena's edge is at least the filter's margin."""
    position, radius_m = world.pose[:, :2], world.radius_m
    apart = position[:, None] - position[None, :]
    distance = np.hypot(apart[..., 0], apart[..., 1])
    np.fill_diagonal(distance, np.inf)
    if (distance < radius_m[:, None] + radius_m[None, :] + margin_m).any():
        return False
    clearance_m = (radius_m + margin_m)[:, None]
    low, high = np.array(world.config.bounds_m).reshape(2, 2)
    inside: NDArray[np.bool_] = (position >= low + clearance_m) & (position <= high - clearance_m)
    return bool(inside.all()) and all(
        box_gap.run(x, y, world.obstacles, row)[0] >= each_m + margin_m
        for (x, y), each_m in zip(position, radius_m, strict=True)
        for row in range(len(world.obstacles))
    )
