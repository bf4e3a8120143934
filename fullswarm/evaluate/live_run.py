"""One trial on a swarm of real processes that is ready: ask, watch until the end, stop, collect what came of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np
from numpy.typing import NDArray

from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Array
from fullswarm.errors import FullswarmError
from fullswarm.evaluate.experiment.plan import Trial
from fullswarm.evaluate.experiment.record import Trajectory
from fullswarm.evaluate.experiment.results import Outcome
from fullswarm.evaluate.live_swarm import LiveSwarm, TrialHeld
from fullswarm.evaluate.scenarios import Scenario
from fullswarm.evaluate.trial import TrialFailed, parameters
from fullswarm.evaluate.trial_watch import Measurement, finite, joined
from fullswarm.evaluate.witness import Witness
from fullswarm.messages import RequestStatus, Value
from fullswarm.reasons import Code

LOOK_S = 0.1
"""How often it is looked whether the trial is over."""
SAMPLE_S = 0.2
"""Between two rows of the trajectory."""
CONFIRM_S = 5.0
"""How long the swarm may take until every robot runs what it was asked for."""
STAND_S = 3.0
"""How long robots may roll on after a stop."""
ALONE_S = 1.0
"""How long a robot whose agent is dead may take until its own watchdog has stopped it."""
SUMMARY_S = 4.0
"""How long to wait for summaries of what was measured after the stop: sent each other second at least."""
MEASURED_S = 0.6
"""After so long whatever robots measured at the end has been sent: they do it twice a second."""
ALL_ARRIVED, TIME_LIMIT = "all arrived", "time limit"
"""How a robot begins to tell that its law has raised an error."""


class TrialStopped(FullswarmError):
    """Somebody ended the trial before it was over."""


@dataclass(frozen=True, slots=True)
class Asked:
    """What a trial asks of a swarm.

    Attributes
    ----------
    goals : (n, 2) where each robot shall be within the scenario's goal radius
    safe_start : no gap was below the margin at the start
    """

    behaviour: str
    parameters: Mapping[str, Value]
    scenario: Scenario
    goals: Array
    limit_s: float
    safe_start: bool
    limit_reason: str = TIME_LIMIT
    boxes: tuple[tuple[float, float, float, float, float], ...] = ()


def asked_of(
    trial: Trial, scenario: Scenario, goals: Array, config: SwarmConfig, limit: tuple[float, str], safe_start: bool
) -> Asked:
    """Return what a trial asks of the swarm `config`, with the time limit in s and its name of `terms`."""
    return Asked(
        behaviour=trial.cell.behaviour,
        parameters=parameters(trial, scenario, goals),
        scenario=scenario,
        goals=goals,
        limit_s=limit[0],
        limit_reason=limit[1],
        safe_start=safe_start,
        boxes=config.world_or_default.boxes,
    )


def terms(trial: Trial, scenario: Scenario, config: SwarmConfig) -> tuple[SwarmConfig, float, str]:
    """Return the settings with the goal's radius and without `max_execution_s`, the trial's time limit and its name.

    The core's summarizers count from the first measurement, which robots send before anything is asked of them; so
    that limit is kept here.
    """
    judged, limit_s, reason = config.performance, trial.time_limit_s or scenario.time_limit_s, TIME_LIMIT
    if judged.max_execution_s is not None and judged.max_execution_s < limit_s:
        limit_s, reason = judged.max_execution_s, "max_execution_s"
    radius_m = judged.arrive_radius_m or scenario.goal.radius_m
    judged = judged.model_copy(update={"max_execution_s": None, "arrive_radius_m": radius_m})
    return config.model_copy(update={"performance": judged}), limit_s, reason


@dataclass(slots=True)
class Track:
    """Rows of a trajectory, as they are taken."""

    time_s: list[float] = field(default_factory=list)
    pose: list[NDArray[np.float32]] = field(default_factory=list)
    touching: list[NDArray[np.bool_]] = field(default_factory=list)

    def take(self, time_s: float, witness: Witness) -> None:
        """Add a row."""
        self.time_s.append(time_s)
        self.pose.append(witness.pose.astype(np.float32))
        self.touching.append(witness.touched())

    def trajectory(self, ids: tuple[str, ...], asked: Asked, witness: Witness) -> Trajectory:
        """Return all rows."""
        return Trajectory(
            ids=ids,
            time_s=np.array(self.time_s, float),
            pose=np.array(self.pose, np.float32).reshape(-1, len(ids), 3),
            touching=np.array(self.touching, bool).reshape(-1, len(ids)),
            goals=np.array(asked.goals, float),
            goal_radius_m=asked.scenario.goal.radius_m,
            radius_m=np.array(witness.radius_m, float),
            boxes=np.array(asked.boxes, float).reshape(-1, 5),
            bounds_m=np.array(asked.scenario.bounds_m, float),
        )


def drive(swarm: LiveSwarm, asked: Asked, witness: Witness, stopped: Callable[[], bool] = lambda: False) -> Measurement:
    """Run the trial; the robots stand when this returns or raises.

    Parameters
    ----------
    stopped : whether somebody wants it to end now

    Raises
    ------
    TrialFailed
        The request was refused, a robot does not run it, is in FAULT or silent, its law failed, or a process ended.
    TrialHeld
        A robot is held by an e-stop.
    TrialStopped
        `stopped` said so.
    """
    swarm.settle()
    runtime, track, statuses = swarm.runtime, Track(), list[RequestStatus]()
    began_s, over = runtime.now_s(), swarm.summaries.finished()
    look_s = SAMPLE_S if swarm.world is None else swarm.world.world.dt_s
    looking = runtime.every(look_s, witness.look)
    sampling = runtime.every(SAMPLE_S, lambda: track.take(runtime.now_s() - began_s, witness), first_s=0.0)
    try:
        swarm.operator.request(asked.behaviour, (), asked.parameters, statuses.append)
        reason = _watch(swarm, asked, witness, statuses, over, stopped)
        ended_s = runtime.now_s()
        outcome = _outcome(swarm, asked, witness, ended_s - began_s)
        track.take(ended_s - began_s, witness)
        evidence = witness.evidence()
    finally:
        sampling.cancel()
        halt(swarm)
        looking.cancel()
    # The robots measure until they stand, and so does the truth beside it.
    swarm.until(lambda: swarm.summaries.later_than(ended_s + MEASURED_S), SUMMARY_S)
    onboard, truth = swarm.summaries.onboard(), witness.truth
    draws, aside_s = (onboard.get(f"deadlocks.{name}", 0.0) for name in ("draws", "aside_s"))
    return Measurement(
        outcome=msgspec.structs.replace(outcome, deadlocks=int(draws), deadlock_s=round(aside_s, 3)),
        end_reason=reason,
        onboard=onboard,
        truth={} if truth is None else finite(truth.values()),
        per_robot=joined(swarm.summaries.per_robot(), {} if truth is None else truth.per_robot()),
        trajectory=track.trajectory(swarm.config.robots, asked, witness),
        contacts=evidence,
        coverage=swarm.summaries.coverage(),
    )


def _outcome(swarm: LiveSwarm, asked: Asked, witness: Witness, took_s: float) -> Outcome:
    """Return how it is now, at the end."""
    robot_events, obstacle_events = witness.events
    return Outcome(
        robots=len(swarm.config.robots),
        arrived=int(_arrived(witness, asked).sum()),
        robot_events=int(robot_events.sum()),
        obstacle_events=int(obstacle_events.sum()),
        safe_start=asked.safe_start,
        simulated_s=round(took_s, 3),
        above_limits=witness.above_limits,
        pairs_touched=witness.pairs_touched,
        robots_touched=witness.robots_touched,
    )


def halt(swarm: LiveSwarm) -> bool:
    """Tell all robots to stand, and wait until they say that they do; False: not all of them."""
    burst, began_s = swarm.operator.stop(), swarm.runtime.now_s()

    def stand() -> bool:
        dead = swarm.dead()  # whose last word may be that it moves
        if dead and swarm.runtime.now_s() - began_s < ALONE_S:
            return False
        rows = [row for row in swarm.view.snapshot().robots if row.robot not in dead]
        return burst.done and not any(row.health and row.health.moving for row in rows)

    return swarm.serve(stand, STAND_S)  # also for those whose neighbour's process has died


def _watch(
    swarm: LiveSwarm, asked: Asked, witness: Witness, statuses: list[RequestStatus], over: frozenset[str],
    stopped: Callable[[], bool],
) -> str:  # fmt: skip
    """Serve until the trial is over; return why."""
    began_s = swarm.runtime.now_s()
    while True:
        if swarm.until(stopped, LOOK_S):
            raise TrialStopped("it was stopped")
        passed_s = swarm.runtime.now_s() - began_s
        _check(swarm, statuses, passed_s)
        if _arrived(witness, asked).all():
            return ALL_ARRIVED
        finished = swarm.summaries.finished() - over
        if finished:
            return swarm.summaries.reason(min(finished))
        if passed_s >= asked.limit_s:
            return asked.limit_reason


def _check(swarm: LiveSwarm, statuses: list[RequestStatus], passed_s: float) -> None:
    """Raise unless all robots do what was asked, or still has time to begin."""
    for row in swarm.view.snapshot().robots:
        health = row.health
        if health is not None and health.estop:
            raise TrialHeld(f"an e-stop holds the robot: {health.stop_reason}", where=row.robot)
        if health is not None and health.lifecycle == "FAULT":
            raise TrialFailed(f"it is in FAULT: {health.fault or 'without a reason'}", where=row.robot)
        if health is not None and health.stop_code == Code.LAW:
            raise TrialFailed(health.stop_reason, where=row.robot)
        if row.silent:
            raise TrialFailed(f"it has been silent for {row.age_s:.1f} s", where=row.robot)
    newest = statuses[-1] if statuses else None
    if newest is not None and newest.phase in ("refused", "superseded", "ended"):
        raise TrialFailed(f"the request was {newest.phase}: {newest.reason}".rstrip(": "))
    if newest is not None and newest.refused_by:
        raise TrialFailed(f"refused by {', '.join(newest.refused_by)}: {newest.reason}".rstrip(": "))
    if passed_s < CONFIRM_S:
        return
    if newest is None:
        raise TrialFailed(f"the core did not answer within {CONFIRM_S:.0f} s")
    absent = sorted(set(swarm.config.robots) - set(newest.running))
    if absent:
        raise TrialFailed(f"{', '.join(absent)} did not run the behaviour within {CONFIRM_S:.0f} s")


def _arrived(witness: Witness, asked: Asked) -> NDArray[np.bool_]:
    near: NDArray[np.bool_] = np.hypot(*(witness.pose[:, :2] - asked.goals).T) <= asked.scenario.goal.radius_m
    return near  # an unknown pose is not near
