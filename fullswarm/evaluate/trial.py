"""Runs one trial over any swarm: a request through the whole stack, and a witness that watches the bodies.

The steps are the same in lockstep, through live processes and on real robots: settle, request, watch until the trial
is over, stop, report. What differs is behind the port of ``swarm.py``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.config import AgentConfig, BodyConfig, SwarmConfig
from fullswarm.core.behaviours import all_records, make_record
from fullswarm.errors import FullswarmError
from fullswarm.evaluate.experiment.model import EvidenceMode, robot_place, world_settings
from fullswarm.evaluate.experiment.outcomes import Outcome, TrialResult
from fullswarm.evaluate.experiment.plan import Trial, world_of
from fullswarm.evaluate.provenance import Provenance, provenance
from fullswarm.evaluate.quiet import END_S, Rest, quiet_after_s
from fullswarm.evaluate.scenarios import Scenario, goals_for, spawn, world_config
from fullswarm.evaluate.swarm import SAMPLE_S, Swarm, TrialStopped, joined
from fullswarm.evaluate.trial_folder import (
    FAILED,
    Measurement,
    Record,
    Trajectory,
    launch_text,
    trial_id,
    write_trial,
)
from fullswarm.evaluate.witness import Witness, WorldWitness, in_safe_set
from fullswarm.fitness import ANYTHING, needs_of
from fullswarm.kernels import Array
from fullswarm.messages import Needs, Value
from fullswarm.simulation.world import World

TOLERANCE_S = 1e-9
NUMBERED = re.compile(r"\br\d+\b")
"""A robot in the network conditions of an experiment; a trial's robots have its seed in their names."""
ALL_ARRIVED, ALL_SETTLED, TIME_LIMIT = "all arrived", "arrived or settled", "time limit"


@dataclass(frozen=True, slots=True)
class TrialRequest:
    """What a trial requests of a swarm, and by what it is judged.

    Attributes
    ----------
    goals : (n, 2) where each robot shall be within the scenario's goal radius
    safe_start : no gap was below the margin at the start
    limit_reason : how the result names the end by `limit_s`
    """

    behaviour: str
    parameters: Mapping[str, Value]
    scenario: Scenario
    goals: Array
    limit_s: float
    safe_start: bool
    limit_reason: str = TIME_LIMIT
    boxes: tuple[tuple[float, float, float, float, float], ...] = ()
    team: str = ""
    needs: Needs = ANYTHING
    roles: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # with the names of the swarm's robots


def drive_in_world(
    swarm: Swarm, world: World, trial: Trial, scenario: Scenario, goals: Array, limit: tuple[float, str],
    emulated: bool = False,
) -> Measurement:  # fmt: skip
    """Run a trial on a swarm that is started and whose bodies are all in `world`, with a time limit in s and its name.

    Parameters
    ----------
    emulated : firmware stands between the commands and the bodies
    """
    config = swarm.config
    request = request_of(trial, scenario, goals, config, limit, in_safe_set(world, config.agent.safety_margin_m))
    return drive(swarm, request, world_witness(world, request, config, emulated))


def world_witness(world: World, request: TrialRequest, config: SwarmConfig, emulated: bool) -> WorldWitness:
    """Return a witness of the bodies in `world`."""
    radius_m, cell_m = request.scenario.goal.radius_m, config.performance.coverage_cell_m
    return WorldWitness(world, request.goals, radius_m, cell_m, emulated)


def request_of(
    trial: Trial, scenario: Scenario, goals: Array, config: SwarmConfig, limit: tuple[float, str], safe_start: bool
) -> TrialRequest:
    """Return what a trial requests of the swarm `config`, with the time limit in s and its name in the result."""
    cell, ids = trial.cell, config.robots
    places = {role: [(name, robot_place(name)) for name in names] for role, names in cell.roles}
    return TrialRequest(
        behaviour=cell.behaviour,
        parameters=parameters(trial, scenario, goals),
        scenario=scenario,
        goals=goals,
        limit_s=limit[0],
        limit_reason=limit[1],
        safe_start=safe_start,
        boxes=config.world_or_default.boxes,
        team=cell.team,
        needs=needs_of(dict(cell.needs)),
        roles={
            role: tuple(name if place is None else ids[place] for name, place in names)
            for role, names in places.items()
        },
    )


# ---------------------------------------------------------------------------------------------------- running
def drive(
    swarm: Swarm, request: TrialRequest, witness: Witness, stopped: Callable[[], bool] = lambda: False
) -> Measurement:
    """Run a trial on a swarm that is started; the robots are at standstill when this returns or raises.

    Parameters
    ----------
    stopped : whether the trial shall end now

    Raises
    ------
    TrialFailed
        The request was refused, a robot does not run it, is in FAULT or silent, its behaviour failed or a process
        ended.
    TrialHeld
        A robot is held by an e-stop.
    TrialStopped
        `stopped` returned true.
    """
    swarm.settle()
    track = Track(swarm, request, witness)
    try:
        swarm.request(
            request.behaviour, request.parameters, team=request.team, needs=request.needs, roles=request.roles
        )
        witness.begin()
        track.begin()
        reason = _run(swarm, request, witness, stopped)
        witness.leave_out(swarm.left_out())
        outcome = _outcome(swarm, request, witness)
        track.end()
        trajectory = track.trajectory()
        evidence, nearest = witness.evidence(), witness.nearest()
    finally:
        swarm.stop()
    # The robots measure until they stand, and so does the truth beside it.
    report = swarm.report()
    return Measurement(
        outcome=msgspec.structs.replace(
            outcome,
            quiet_s=quiet_after_s(trajectory),
            deadlocks=report.deadlocks,
            deadlock_s=report.deadlock_s,
            **_per_second(report.onboard, outcome.simulated_s),
            **{name: nearest[key].value for name, key in NEAREST.items() if key in nearest},
        ),
        end_reason=reason,
        onboard=report.onboard,
        truth=witness.values(),
        per_robot=joined(report.per_robot, witness.per_robot()),
        trajectory=trajectory,
        evidence=evidence,
        watched=witness.source,
        approaches=nearest,
        coverage=report.coverage,
        memories=report.memories,
    )


def _run(swarm: Swarm, request: TrialRequest, witness: Witness, stopped: Callable[[], bool]) -> str:
    """Let time pass until the trial is over; return why."""
    rest = Rest()
    while swarm.passed_s < request.limit_s - TOLERANCE_S:
        if swarm.advance(stopped):
            raise TrialStopped("it was stopped")
        if reason := swarm.end_reason():
            return reason
        arrived, left_out = _arrived(swarm, request, witness), swarm.left_out()
        if (arrived | left_out).all():
            return ALL_ARRIVED
        if rest.lasts_s(swarm.passed_s, witness.pose) >= END_S and (arrived | left_out | swarm.settled()).all():
            return ALL_SETTLED
    return request.limit_reason


def _arrived(swarm: Swarm, request: TrialRequest, witness: Witness) -> NDArray[np.bool_]:
    near: NDArray[np.bool_] = np.hypot(*(witness.pose[:, :2] - request.goals).T) <= request.scenario.goal.radius_m
    return near & ~swarm.left_out()  # an unknown pose is not near


def _outcome(swarm: Swarm, request: TrialRequest, witness: Witness) -> Outcome:
    """Return how it is now, at the end."""
    counted, arrived = witness.tally(), _arrived(swarm, request, witness)
    left_out = int(swarm.left_out().sum())
    return Outcome(
        robots=len(swarm.config.robots) - left_out,
        left_out=left_out,
        arrived=int(arrived.sum()),
        settled=int((swarm.settled() & ~arrived).sum()),
        robot_events=int(counted.robot_events.sum()),
        obstacle_events=int(counted.obstacle_events.sum()),
        safe_start=request.safe_start,
        simulated_s=swarm.passed_s,
        above_limits=counted.above_limits,
        pairs_touched=counted.pairs_touched,
        robots_touched=counted.robots_touched,
        mover_events=counted.mover_events,
        mover_hits=counted.mover_hits,
        pushed_events=counted.pushed_events,
    )


NEAREST = {
    "separation_m": "separation.min_m",
    "clearance_m": "clearance.min_m",
    "time_to_contact_s": "time_to_contact.min_s",
}
"""Numbers of the outcome by what came nearest."""
RATES = {
    "reversals_per_s": "smoothness.reversals_mean",
    "speed_variation_m_s2": "smoothness.speed_variation_m_s",
    "turn_variation_rad_s2": "smoothness.turn_variation_rad_s",
}
"""Numbers of the outcome that are sums of the robots' own measurements over the time."""


def _per_second(onboard: Mapping[str, float], time_s: float) -> dict[str, float]:
    """Return the outcome's rates; none that the robots did not measure."""
    return {name: round(onboard[key] / time_s, 5) for name, key in RATES.items() if key in onboard and time_s > 0.0}


class Track:
    """Has the witness sample the bodies, and takes rows of their trajectory: at the request, then each `SAMPLE_S`."""

    def __init__(self, swarm: Swarm, request: TrialRequest, witness: Witness) -> None:
        self._swarm, self._request, self._witness = swarm, request, witness
        self._next_s = 0.0
        self._time_s: list[float] = []
        self._pose: list[NDArray[np.float32]] = []
        self._touching: list[NDArray[np.bool_]] = []

    def begin(self) -> None:
        """Take the first row, and watch."""
        self._sample_if_due()
        self._swarm.watch(self._on_step)

    def end(self) -> None:
        """Take the last row, unless it is taken; the witness goes on sampling."""
        if self._time_s[-1] < self._swarm.seen_s:
            self._take()
        self._next_s = np.inf

    def trajectory(self) -> Trajectory:
        """Return all rows."""
        ids, request = self._swarm.config.robots, self._request
        return Trajectory(
            ids=ids,
            time_s=np.array(self._time_s, float),
            pose=np.array(self._pose, np.float32).reshape(-1, len(ids), 3),
            touching=np.array(self._touching, bool).reshape(-1, len(ids)),
            goals=np.where(self._swarm.left_out()[:, None], np.nan, request.goals),
            goal_radius_m=request.scenario.goal.radius_m,
            radius_m=np.array(self._witness.radius_m, float),
            boxes=np.array(request.boxes, float).reshape(-1, 5),
            bounds_m=np.array(request.scenario.bounds_m, float),
        )

    def _on_step(self) -> None:
        self._witness.sample()
        self._sample_if_due()

    def _sample_if_due(self) -> None:
        if self._swarm.seen_s >= self._next_s - TOLERANCE_S:
            self._take()
            self._next_s += SAMPLE_S * (1 + (self._swarm.seen_s - self._next_s + TOLERANCE_S) // SAMPLE_S)

    def _take(self) -> None:
        self._time_s.append(self._swarm.seen_s)
        self._pose.append(self._witness.pose.astype(np.float32))
        self._touching.append(self._witness.touched())


# ---------------------------------------------------------------------------------------------------- keeping
Measure = Callable[[Trial], Measurement]
"""Runs a trial."""


def attempt(trial: Trial, run: Measure) -> Measurement | str:
    """Return what `run` measures of a trial, or why it failed."""
    try:
        return run(trial)
    except FullswarmError as error:
        return str(error)
    except Exception as error:  # a behaviour or an engine is outside code: one trial must not end the experiment
        return f"{type(error).__name__}: {error}"


@dataclass(frozen=True, slots=True)
class KeepingEvidence:
    """A `Measure` that leaves of a trial's evidence what `mode` keeps.

    Parameters
    ----------
    run : measures a trial; importable by its name
    """

    run: Measure
    mode: EvidenceMode

    def __call__(self, trial: Trial) -> Measurement:
        """Measure a trial."""
        found = self.run(trial)
        return found if found.evidence is None else replace(found, evidence=found.evidence.kept(self.mode))


# ---------------------------------------------------------------------------------------------------- settings
def configure(trial: Trial, scenario: Scenario) -> tuple[SwarmConfig, Array]:
    """Return the fleet of a trial, and the goals (n, 2) of its robots, NaN if the behaviour takes none."""
    world = world_config(scenario, trial.seed, world_of(trial))
    # The seed is part of the names, and what a blocked robot draws depends on its name.
    ids = [f"r{row}s{trial.seed}" for row in range(trial.cell.robots)]
    if trial.bodies:
        world = world.model_copy(update={"bodies": _bodies(trial, ids)})
    poses = spawn(scenario, len(ids), trial.seed, np.array([world.of_body(robot).radius_m for robot in ids]))
    robots = [{"id": robot, "pose": pose} for robot, pose in zip(ids, poses.tolist(), strict=True)]
    config = SwarmConfig.model_validate(
        {
            "world": world.model_dump(),
            "robot": robots,
            "agent": AgentConfig.model_validate(dict(trial.agent)).model_dump(),
            "performance": {"arrive_radius_m": scenario.goal.radius_m, **dict(trial.stop)},
            "network": {
                "conditions": NUMBERED.sub(rf"\g<0>s{trial.seed}", trial.cell.network) or None,
                "seed": trial.seed,
            },
        }
    )
    goals = goals_for(scenario, poses)
    return config, goals if takes_goal(trial.cell.behaviour) else np.full_like(goals, math.nan)


def _bodies(trial: Trial, ids: Sequence[str]) -> dict[str, BodyConfig]:
    """Return the bodies that differ, robot by robot: none takes from the world what is not its own."""
    found = []
    for each in trial.bodies:
        settings = dict(each)
        whole = {"declared_radius_m": settings["radius_m"], "drivetrain": {}, **world_settings(settings)}
        found.append(BodyConfig.model_validate(whole))
    return {robot: found[row % len(found)] for row, robot in enumerate(ids)}


def parameters(trial: Trial, scenario: Scenario, goals: Array) -> dict[str, Any]:
    """Return the parameters of the behaviour's request: the cell's and the goal, one for all or one for each.

    A behaviour whose record takes no goal gets none.
    """
    wanted: dict[str, Any] = trial.cell.requested()
    if np.isfinite(goals).all():
        wanted |= {"targets": goals.tolist()} if scenario.goal.antipodal else {"goal": goals[0].tolist()}
    return wanted


@cache
def takes_goal(behaviour: str) -> bool:
    """Tell whether a behaviour can be sent to a goal; one that nothing is known of is taken to."""
    records = all_records()
    return behaviour not in records or bool({"goal", "targets"} & make_record(behaviour, records).parameters.keys())


def terms(trial: Trial, scenario: Scenario, config: SwarmConfig) -> tuple[SwarmConfig, tuple[float, str]]:
    """Return the settings with the goal's radius and without `max_execution_s`; the trial's time limit in s, its name.

    The core's summarizers count from the first measurement, which robots send before anything is asked of them; so
    that limit is kept here.
    """
    judged, limit_s, reason = config.performance, trial.time_limit_s or scenario.time_limit_s, TIME_LIMIT
    if judged.max_execution_s is not None and judged.max_execution_s < limit_s:
        limit_s, reason = judged.max_execution_s, "max_execution_s"
    radius_m = judged.arrive_radius_m or scenario.goal.radius_m
    judged = judged.model_copy(update={"max_execution_s": None, "arrive_radius_m": radius_m})
    return config.model_copy(update={"performance": judged}), (limit_s, reason)


@dataclass(frozen=True, slots=True)
class Keeper:
    """Runs trials and keeps them: what a worker process does.

    Parameters
    ----------
    out : folder of the results; None: nothing is kept
    run : measures a trial; importable by its name
    """

    out: Path | None
    experiment: str
    run: Measure
    runner: str = "pool"

    def __call__(self, trial: Trial, attempts: int = 1) -> TrialResult:
        """Run a trial; a failure is its result, also when it cannot be kept."""
        result, found, about = perform(trial, self.experiment, attempts, self.run, self.runner)
        if self.out is None:
            return result
        try:
            write_trial(self.out, record_of(trial, self.experiment, found), about, found)
        except OSError as error:
            return not_kept(result, self.out, error)
        return result


def perform(
    trial: Trial, experiment: str, attempts: int, run: Measure, runner: str
) -> tuple[TrialResult, Measurement | str, Provenance]:
    """Run a trial; return its result, all that it measured or why it failed, and where from."""
    started_s, clock = wall_time_s(), MonotonicClock()
    began_s = clock.now_s()
    found = attempt(trial, run)
    wall_s = clock.now_s() - began_s
    about = provenance(started_s, wall_s, attempts, launch_text(trial, experiment), runner)
    return result_of(trial, found, wall_s, attempts), found, about


def result_of(trial: Trial, found: Measurement | str, wall_s: float, attempts: int = 1) -> TrialResult:
    """Return what a report needs of a trial."""
    outcome, failure, end_reason = _end_of(found)
    return TrialResult(
        seed=trial.seed, outcome=outcome, failure=failure, wall_s=wall_s, end_reason=end_reason, attempts=attempts
    )


def record_of(trial: Trial, experiment: str, found: Measurement | str) -> Record:
    """Return ``result.json`` of a trial, or of one that failed."""
    outcome, failure, end_reason = _end_of(found)
    measured = None if isinstance(found, str) else found
    return Record(
        id=trial_id(trial),
        experiment=experiment,
        trial=trial,
        outcome=outcome,
        failure=failure,
        end_reason=end_reason,
        onboard=dict(measured.onboard) if measured else {},
        truth=dict(measured.truth) if measured else {},
        watched=measured.watched if measured else "",
        approaches=dict(measured.approaches) if measured else {},
        per_robot={key: dict(values) for key, values in measured.per_robot.items()} if measured else {},
    )


def _end_of(found: Measurement | str) -> tuple[Outcome | None, str, str]:
    return (None, found, FAILED) if isinstance(found, str) else (found.outcome, "", found.end_reason)


def not_kept(result: TrialResult, out: Path, error: OSError) -> TrialResult:
    """Return the result of a trial whose directory could not be written: it failed, and is run again another time."""
    failure = f"{out}: cannot keep the trial: {error.strerror or error}"
    return msgspec.structs.replace(result, outcome=None, failure=failure, end_reason=FAILED)
