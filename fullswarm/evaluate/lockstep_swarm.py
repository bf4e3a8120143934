"""Runs a trial in lockstep: one process, a simulated clock, the same result each time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fullswarm import output
from fullswarm.bus.base import OPERATOR
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Limits
from fullswarm.evaluate.experiment.outcomes import TrialResult
from fullswarm.evaluate.experiment.plan import Trial, scenario_of
from fullswarm.evaluate.swarm import ALL_ENDED, CHECK_PERIOD_S, Report, Summaries, TrialFailed, left_out_of
from fullswarm.evaluate.trial import TIME_LIMIT, Keeper, configure, drive_in_world
from fullswarm.evaluate.trial_folder import Measurement, recording_of
from fullswarm.fitness import ANYTHING
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import Needs, RequestStatus, Value
from fullswarm.operator.client import Operator

READY_S = 0.49
"""From the start until the request: between two ticks, after all nodes have discovered each other and before the agents
publish their first measurement. So what is measured begins with the request."""
ROOM = 10.0
"""The bodies obey so many times their limits: a command above them would be driven, and is counted."""


class LockstepSwarm:
    """Implements :class:`~fullswarm.evaluate.swarm.Swarm` with :class:`~fullswarm.launch.lockstep.Lockstep`.

    Parameters
    ----------
    record : a new file for a recording of all of it
    """

    def __init__(self, config: SwarmConfig, record: Path | None = None) -> None:
        self._recorder = None
        if record is not None:
            from fullswarm.record.lockstep import LockstepRecorder

            self._recorder = LockstepRecorder(record, config.swarm, on_failure=output.progress)
        self._lockstep = lockstep = Lockstep(config, self._recorder.begin if self._recorder else None)
        if self._recorder is not None:
            self._recorder.record(lockstep)
        self.config, self.world, self._runtime = lockstep.config, lockstep.world, lockstep.runtime
        for row in range(len(self.world.ids)):
            self.world.set_limits(row, widened(Limits(*self.world.limits[row].tolist())))
        self._watcher: Callable[[], None] | None = None
        self._steps = 0
        # From the start, so that it comes after each of the world's steps; a later timer might come before them.
        self._runtime.every(self.world.dt_s, self._on_step)
        numbers = itertools.count()
        bus = lockstep.bus_of(OPERATOR)
        self._operator = Operator(
            bus, lockstep.keys, self._runtime, "experiment", new_id=lambda: f"t{next(numbers)}"
        )  # fmt: skip
        self._summaries = Summaries(lockstep.bus, lockstep.keys, self._runtime.pause)
        self._statuses: list[RequestStatus] = []
        self._began_s = self._deadlock_s = 0.0

    @property
    def passed_s(self) -> float:
        """Simulated time since the request; what a sum of ticks adds is no time."""
        return round(self._runtime.now_s() - self._began_s, 6)

    @property
    def seen_s(self) -> float:
        """Time of the world's steps since the request."""
        return self._steps * self.world.dt_s

    def settle(self) -> None:
        """Let the nodes discover each other."""
        self._runtime.run(READY_S)

    def request(
        self, behaviour: str, parameters: Mapping[str, Value], *, team: str = "", needs: Needs = ANYTHING,
        roles: Mapping[str, Sequence[str]] | None = None,
    ) -> None:  # fmt: skip
        """Request a behaviour of all robots."""
        self._began_s = self._runtime.now_s()
        self._operator.request(behaviour, (), parameters, self._statuses.append, team=team, needs=needs, roles=roles)

    def watch(self, on_step: Callable[[], None]) -> None:
        """Call `on_step` after each step of the world."""
        self._watcher = on_step

    def advance(self, stopped: Callable[[], bool]) -> bool:
        """Let `CHECK_PERIOD_S` pass, less when a termination condition is met."""
        self._runtime.run(CHECK_PERIOD_S)
        now_s = self._runtime.now_s()
        self._deadlock_s += CHECK_PERIOD_S * sum(
            int((agent.deadlocks.sidestep_until_s > now_s).sum()) for agent in self._lockstep.agents
        )  # fmt: skip
        return stopped()

    def end_reason(self) -> str:
        """Return the first termination condition that was met."""
        ended = self._statuses and self._statuses[-1].phase == "ended" and self._statuses[-1].results
        return self._summaries.reason or (ALL_ENDED if ended else "")

    def settled(self) -> NDArray[np.bool_]:
        """Return which robots have settled, (n,)."""
        return np.concatenate([agent.settling.settled for agent in self._lockstep.agents])

    def left_out(self) -> NDArray[np.bool_]:
        """Return which robots do not take part because they are unfit for the request, (n,)."""
        return left_out_of(self.config.robots, self._statuses)

    def stop(self) -> None:
        """Nothing to wait for: no robot moves while no simulated time passes."""

    def report(self) -> Report:
        """Return what the swarm measured; `TrialFailed` unless the request ran on every robot to the end."""
        self._check()
        self._lockstep.report()
        return Report(
            onboard=self._summaries.onboard(),
            per_robot=self._summaries.per_robot(),
            coverage=self._summaries.coverage(),
            memories=self._summaries.memories(),
            deadlocks=sum(int(agent.deadlocks.deadlock_count.sum()) for agent in self._lockstep.agents),
            deadlock_s=round(self._deadlock_s, 3),
        )

    def close(self) -> None:
        """End the operator, all nodes and the world."""
        self._summaries.close()
        self._operator.close()
        self._lockstep.close()
        if self._recorder is not None:
            self._recorder.close()

    def _on_step(self) -> None:
        if self._watcher is not None:
            self._steps += 1
            self._watcher()

    def _check(self) -> None:
        newest = self._statuses[-1] if self._statuses else None
        if newest is None or newest.phase in ("refused", "superseded"):
            raise TrialFailed(f"the core refused: {newest.reason}" if newest else "the core did not answer")
        agents = self._lockstep.agents
        errors = {why.text for agent in agents for why in agent.desired.law_error if why}
        if errors:
            raise TrialFailed("; ".join(sorted(errors)))
        ended = {each.robot for each in newest.results}
        ran = sum(
            task is not None or robot in ended
            for agent in agents
            for robot, task in zip(agent.tasks.ids, agent.tasks.of, strict=True)
        )
        count = len(self.world.ids) - len(newest.left_out)
        if ran < count:
            raise TrialFailed(f"{ran} of {count} robots ran the behaviour to the end")


def widened(limits: Limits) -> Limits:
    """Return limits wider than those of a body, so that a command above what its driver reports is driven."""
    return Limits(
        speed_m_s=ROOM * limits.speed_m_s,
        turn_rad_s=ROOM * limits.turn_rad_s,
        accel_m_s2=limits.accel_m_s2,
        turn_accel_rad_s2=limits.turn_accel_rad_s2,
        can_reverse=limits.can_reverse,
    )


def run_trial(trial: Trial) -> TrialResult:
    """Run a trial and keep nothing of it but its result; whatever goes wrong in it is its result."""
    return Keeper(None, "", measure)(trial)


def measure(trial: Trial, recordings: Path | None = None) -> Measurement:
    """Run a trial in lockstep.

    Parameters
    ----------
    recordings : folder for a recording of the trial; None: it is not recorded

    Raises
    ------
    ConfigError
        Its behaviour, scenario or settings are wrong, or so many robots do not fit.
    TrialFailed
        The core refused the request, or not every robot ran it.
    """
    scenario = scenario_of(trial)
    config, goals = configure(trial, scenario)
    swarm = LockstepSwarm(config, recording_of(trial, recordings))
    try:
        limit = trial.time_limit_s or scenario.time_limit_s, TIME_LIMIT
        return drive_in_world(swarm, swarm.world, trial, scenario, goals, limit)
    finally:
        swarm.close()
