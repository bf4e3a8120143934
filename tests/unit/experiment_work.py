"""What a worker process may do with a trial; a spawned process imports these by name."""

from __future__ import annotations

import os
import threading

from fullswarm.perf.experiment import Outcome, Trial, TrialResult


def answer(trial: Trial) -> TrialResult:
    """Answer at once; a crowd of 32 with an odd seed collides."""
    events = int(trial.cell.robots == 32 and trial.seed % 2 == 1)
    outcome = Outcome(
        robots=trial.cell.robots,
        arrived=trial.cell.robots,
        robot_events=2 * events,
        obstacle_events=0,
        safe_start=True,
        simulated_s=1.0,
    )
    return TrialResult(seed=trial.seed, outcome=outcome)


def misbehave(trial: Trial) -> TrialResult:
    """Die with seed 1, hang with seed 2, answer otherwise."""
    if trial.seed == 1:
        os._exit(3)
    if trial.seed == 2:
        threading.Event().wait()
    return answer(trial)
