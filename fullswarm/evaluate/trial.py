"""One trial: a swarm in lockstep, a request through the whole stack, and a referee that watches the bodies.

The referee looks at the world itself, not at what the robots report: whatever noise or network they suffer from,
a touch is a touch.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.safety.barrier import box_gap
from fullswarm.bus.base import OPERATOR
from fullswarm.clock import MonotonicClock
from fullswarm.config import AgentConfig, SwarmConfig
from fullswarm.drivers.base import Array, Limits
from fullswarm.drivers.sim.world import World
from fullswarm.errors import FullswarmError
from fullswarm.evaluate.approach import Approaches
from fullswarm.evaluate.experiment.plan import Trial, scenario_of, world_of
from fullswarm.evaluate.experiment.record import GRAIN_M, Contacts
from fullswarm.evaluate.experiment.results import Outcome, TrialResult
from fullswarm.evaluate.scenarios import Scenario, goals_for, spawn, world_config
from fullswarm.evaluate.trial_watch import BodyWatch, Measurement, SummaryWatch, finite, joined
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator
from fullswarm.perf.calculators import CollisionCalculator

READY_S = 0.49
"""From the start until the request: between two ticks, after all have heard of each other, before the first measurement
that the agents publish. So what is measured begins with the request."""
LOOK_S = 0.1
"""How often it is looked whether all have arrived."""
ROOM = 10.0
"""The bodies obey so many times their limits: a command above them would be driven, and is counted."""
TOLERANCE = 1e-9


class TrialFailed(FullswarmError):
    """A trial that measured nothing."""


class Referee:
    """Counts contacts and commands above the limits, after each step of the world, and keeps what proves the count.

    Parameters
    ----------
    world : its bodies are watched
    limits : what the robots' drivers say that they can do

    Attributes
    ----------
    pairs : which pairs of robots have touched, as (row, higher row)
    touched : (n,) which robots have touched anything
    """

    def __init__(self, world: World, limits: Limits) -> None:
        count = len(world.ids)
        self._world = world
        self._most = np.array([limits.speed_m_s, limits.turn_rad_s]) * (1.0 + TOLERANCE)
        self.robots, self.obstacles = CollisionCalculator(count), CollisionCalculator(count)
        self.pairs: set[tuple[int, int]] = set()
        self.touched = np.zeros(count, np.bool_)
        self._counts = np.zeros((2, count), np.int64)
        self._steps = 0
        self._approaches = Approaches(world.pose, np.full(count, world.config.radius_m))
        self._xy = [world.pose[:, :2].copy()]
        self._bends: list[tuple[int, NDArray[np.int64], Array]] = []
        self.above_limits = 0

    def look(self) -> None:
        """Take in the last step."""
        world, counts, found = self._world, self._counts, self._world.referee
        self._steps += 1
        self._xy.append(world.pose[:, :2].copy())
        self._approaches.look(self._steps * world.dt_s, world.pose, found.near, found.near_gap_m)
        counts[:] = 0
        if len(found.pairs):
            for first, second in found.pairs.tolist():
                if second >= 0:
                    counts[0, first] += 1
                    counts[0, second] += 1
                    self.pairs.add((min(first, second), max(first, second)))
                else:
                    counts[1, first] += 1
            rows = np.flatnonzero(found.contacts)
            self.touched[rows] = True
            self._bends.append((self._steps, rows, found.path[1:, rows].swapaxes(0, 1).copy()))
        self.robots.update(world.time_s, counts[0])
        self.obstacles.update(world.time_s, counts[1])
        if (np.abs(world.target) > self._most).any():
            self.above_limits += int((np.abs(world.target) > self._most).any(axis=1).sum())

    @property
    def closest_m(self) -> float:
        """The least gap between two robots so far; inf: there is one, or no step yet."""
        return float(self._approaches.least_m.min(initial=np.inf))

    def evidence(self) -> Contacts:
        """Return what is needed to count the contacts again."""
        world, found = self._world, self._world.referee
        bends = [(step, row, way) for step, rows, ways in self._bends for row, way in zip(rows, ways, strict=True)]
        xy = _grains(np.array(self._xy)) if bends else np.zeros((0, len(world.ids), 2), np.int32)
        steps, rows = (np.array([each[column] for each in bends], np.int32) for column in (0, 1))
        ways = _grains(np.array([way for *_, way in bends]).reshape(-1, len(found.part_s), 2))
        starts = xy[steps - 1, rows].reshape(-1, 1, 2)
        return Contacts(
            ids=world.ids,
            radius_m=np.full(len(world.ids), world.config.radius_m),
            obstacles=np.array(world.obstacles),
            touch_m=found.touch_m,
            step_s=world.dt_s,
            closest_m=self._approaches.least_m.astype(np.float32),
            closest_s=np.round(self._approaches.at_s, 6),
            part_s=found.part_s,
            xy=np.diff(xy, axis=0, prepend=np.int32(0)),
            bend_step=steps,
            bend_robot=rows,
            bend=np.diff(ways, axis=1, prepend=starts),
        )


def _grains(at_m: Array) -> NDArray[np.int32]:
    return np.round(at_m / GRAIN_M).astype(np.int32)


Measure = Callable[[Trial], Measurement]
"""Runs a trial."""


def run_trial(trial: Trial) -> TrialResult:
    """Run a trial and keep nothing of it but its result; whatever goes wrong in it is its result."""
    clock = MonotonicClock()
    began_s = clock.now_s()
    found = attempt(trial)
    wall_s = clock.now_s() - began_s
    if isinstance(found, str):
        return TrialResult(seed=trial.seed, outcome=None, failure=found, wall_s=wall_s)
    return TrialResult(seed=trial.seed, outcome=found.outcome, wall_s=wall_s, end_reason=found.end_reason)


def attempt(trial: Trial, run: Measure | None = None) -> Measurement | str:
    """Return what `run`, by default `measure`, makes of a trial, or why it failed."""
    try:
        return (run or measure)(trial)
    except FullswarmError as error:
        return str(error)
    except Exception as error:  # a law or an engine is outside code: one trial must not end the experiment
        return f"{type(error).__name__}: {error}"


def measure(trial: Trial) -> Measurement:
    """Run a trial.

    Raises
    ------
    ConfigError
        Its behaviour, scenario or settings are wrong, or so many robots do not fit.
    TrialFailed
        The core refused the request, or not every robot ran it.
    """
    scenario = scenario_of(trial)
    config, goals = configure(trial, scenario)
    swarm = Lockstep(config)
    try:
        return _run(trial, scenario, config, goals, swarm)
    finally:
        swarm.close()


def configure(trial: Trial, scenario: Scenario) -> tuple[SwarmConfig, Array]:
    """Return the fleet of a trial, and the goals (n, 2) of its robots."""
    world = world_config(scenario, trial.seed, world_of(trial))
    poses = spawn(scenario, trial.cell.robots, trial.seed, world.radius_m)
    # The seed is part of the names, and what a blocked robot draws depends on its name.
    robots = [{"id": f"r{row}s{trial.seed}", "pose": pose} for row, pose in enumerate(poses.tolist())]
    config = SwarmConfig.model_validate(
        {
            "world": world.model_dump(),
            "robot": robots,
            "agent": AgentConfig.model_validate(dict(trial.agent)).model_dump(),
            "performance": {"arrive_radius_m": scenario.goal.radius_m, **dict(trial.stop)},
            "network": {"conditions": trial.cell.network or None, "seed": trial.seed},
        }
    )
    return config, goals_for(scenario, poses)


def _run(trial: Trial, scenario: Scenario, config: SwarmConfig, goals: Array, swarm: Lockstep) -> Measurement:
    world, runtime = swarm.world, swarm.runtime
    limits = world.description.limits
    for row in range(len(world.ids)):
        world.set_limits(row, widened(limits))
    safe = in_safe_set(world, config.agent.safety_margin_m)
    bodies = BodyWatch(world, goals, scenario.goal.radius_m, config.performance.coverage_cell_m)
    referee, watching = Referee(world, limits), False

    def look() -> None:
        if watching:
            referee.look()
            bodies.look()

    # From the start, so that it comes after each of the world's steps; a later timer might come before them.
    runtime.every(world.dt_s, look)
    numbers = itertools.count()
    operator = Operator(swarm.bus_of(OPERATOR), swarm.keys, runtime, "experiment", new_id=lambda: f"t{next(numbers)}")
    summaries = SummaryWatch(swarm, runtime.pause)
    statuses: list[RequestStatus] = []
    try:
        runtime.run(READY_S)
        operator.request(trial.cell.behaviour, (), parameters(trial, scenario, goals), statuses.append)
        referee, watching = Referee(world, limits), True
        bodies.begin()
        limit_s = trial.time_limit_s or scenario.time_limit_s
        began_s, deadlock_s = runtime.now_s(), 0.0
        end_reason = "time limit"
        while runtime.now_s() - began_s < limit_s - TOLERANCE:
            runtime.run(LOOK_S)
            deadlock_s += LOOK_S * sum(int((agent.deadlocks.until_s > runtime.now_s()).sum()) for agent in swarm.agents)
            arrived = np.hypot(*(world.pose[:, :2] - goals).T) <= scenario.goal.radius_m
            if summaries.reason or arrived.all():
                end_reason = summaries.reason or "all arrived"
                break
        check(statuses, swarm)
        swarm.report()
    finally:
        summaries.close()
        operator.close()
    outcome = Outcome(
        robots=len(world.ids),
        arrived=int(arrived.sum()),
        robot_events=int(referee.robots.events.sum()),
        obstacle_events=int(referee.obstacles.events.sum()),
        safe_start=safe,
        simulated_s=round(runtime.now_s() - began_s, 6),  # what a sum of ticks adds is no time
        above_limits=referee.above_limits,
        deadlocks=sum(int(agent.deadlocks.draws.sum()) for agent in swarm.agents),
        deadlock_s=round(deadlock_s, 3),
        pairs_touched=len(referee.pairs),
        robots_touched=int(referee.touched.sum()),
    )
    return Measurement(
        outcome=outcome,
        end_reason=end_reason,
        onboard=summaries.onboard(),
        truth=finite({**bodies.truth.values(), "separation.min_m": referee.closest_m}),
        per_robot=joined(summaries.per_robot(), bodies.truth.per_robot()),
        trajectory=bodies.trajectory(),
        contacts=referee.evidence(),
        coverage=summaries.coverage(),
    )


def widened(limits: Limits) -> Limits:
    """Return limits that a body obeys beyond those that its driver tells."""
    return Limits(
        speed_m_s=ROOM * limits.speed_m_s,
        turn_rad_s=ROOM * limits.turn_rad_s,
        accel_m_s2=limits.accel_m_s2,
        turn_accel_rad_s2=limits.turn_accel_rad_s2,
        can_reverse=limits.can_reverse,
    )


def parameters(trial: Trial, scenario: Scenario, goals: Array) -> dict[str, Any]:
    """Return what the behaviour is asked with: the cell's parameters and the goal, one for all or one for each."""
    wanted: dict[str, Any] = dict(trial.cell.parameters)
    if scenario.goal.antipodal:
        wanted["targets"] = goals.tolist()
    else:
        wanted["goal"] = goals[0].tolist()
    return wanted


def check(statuses: list[RequestStatus], swarm: Lockstep) -> None:
    """Raise `TrialFailed` unless the request ran on every robot to the end."""
    newest = statuses[-1] if statuses else None
    if newest is None or newest.phase in ("refused", "superseded"):
        raise TrialFailed(f"the core refused: {newest.reason}" if newest else "the core did not answer")
    errors = {why.text for agent in swarm.agents for why in agent.wishes.law_error if why}
    if errors:
        raise TrialFailed("; ".join(sorted(errors)))
    ran = sum(task is not None for agent in swarm.agents for task in agent.tasks.of)
    if ran < len(swarm.world.ids):
        raise TrialFailed(f"{ran} of {len(swarm.world.ids)} robots ran the behaviour to the end")


def in_safe_set(world: World, margin_m: float) -> bool:
    """Tell whether every gap between bodies, boxes, walls and the arena's edge is at least the filter's margin."""
    position, radius_m = world.pose[:, :2], world.config.radius_m
    apart = position[:, None] - position[None, :]
    distance = np.hypot(apart[..., 0], apart[..., 1])
    np.fill_diagonal(distance, np.inf)
    if distance.min(initial=np.inf) < 2.0 * radius_m + margin_m:
        return False
    clearance_m = radius_m + margin_m
    x_min, y_min, x_max, y_max = world.config.bounds_m
    inside: NDArray[np.bool_] = (position >= (x_min + clearance_m, y_min + clearance_m)) & (
        position <= (x_max - clearance_m, y_max - clearance_m)
    )
    gaps = (box_gap.run(x, y, world.obstacles, row)[0] for x, y in position for row in range(len(world.obstacles)))
    return bool(inside.all()) and all(gap >= clearance_m for gap in gaps)
