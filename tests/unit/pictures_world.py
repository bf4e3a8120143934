"""Hand-made trajectories: what the pictures of them must show can be said beforehand."""

from __future__ import annotations

import itertools
from pathlib import Path

import msgspec
import numpy as np

from fullswarm.evaluate.experiment.outcomes import Outcome
from fullswarm.evaluate.experiment.plan import Cell, Trial
from fullswarm.evaluate.trial_folder import (
    RESULT_FILE,
    TRAJECTORY_FILE,
    TRIALS,
    Record,
    Trajectory,
    save_arrays,
    trial_id,
)

PERIOD_S = 0.1


def two_robots(seconds: float = 4.0, touches: tuple[tuple[int, int], ...] = ()) -> Trajectory:
    """One drives along y = 2 from x = 1 at 1 m/s to the east, one stands at (8, 8); `touches` are sample, robot."""
    time_s = np.linspace(0.0, seconds, round(seconds / PERIOD_S) + 1, dtype=np.float64)
    pose = np.zeros((len(time_s), 2, 3), np.float32)
    pose[:, 0, 0], pose[:, 0, 1] = 1.0 + time_s, 2.0
    pose[:, 1] = (8.0, 8.0, np.pi / 2)
    touching = np.zeros((len(time_s), 2), np.bool_)
    for sample, robot in touches:
        touching[sample, robot] = True
    return Trajectory(
        ids=("a", "b"),
        time_s=time_s,
        pose=pose,
        touching=touching,
        goals=np.array([(8.0, 8.0), (8.0, 8.0)]),
        goal_radius_m=1.5,
        radius_m=np.array([0.5, 0.5]),
        boxes=np.array([(3.0, 7.0, 2.0, 1.0, np.pi / 2)]),
        bounds_m=np.array([0.0, 0.0, 10.0, 10.0]),
    )


def a_trial(seed: int, robots: int = 4, behaviour: str = "navigate_bc") -> Trial:
    """Return a trial of a cell that is told by size and behaviour."""
    cell = Cell("paper", behaviour, (("map", "given"),), "uniform", robots, "kinematic", "create")
    return Trial(cell, seed, None, (), ())


def write_trial(
    folder: Path,
    trial: Trial,
    *,
    contacts: int = 0,
    failure: str = "",
    at_s: float | None = None,
    trajectory: Trajectory | None = None,
) -> str:
    """Put a trial's directory into an experiment's folder as it is done there; return its id."""
    import os

    name, robots = trial_id(trial), trial.cell.robots
    outcome = Outcome(
        robots=robots, arrived=robots - 1, robot_events=contacts, obstacle_events=0, safe_start=True, simulated_s=30.0
    )
    record = Record(
        id=name,
        experiment="paper",
        trial=trial,
        outcome=None if failure else outcome,
        failure=failure,
        end_reason="failed" if failure else "time limit",
    )
    parts, place = folder / TRIALS, folder / TRIALS / name
    beside = parts / f".{name}.{next(_NUMBERS)}"
    beside.mkdir(parents=True)
    (beside / RESULT_FILE).write_bytes(msgspec.json.encode(record))
    if at_s is not None:
        os.utime(beside / RESULT_FILE, (at_s, at_s))
    if trajectory is not None:
        save_arrays(trajectory, beside / TRAJECTORY_FILE)
    if place.exists():
        place.rename(parts / f".old.{next(_NUMBERS)}")
    beside.rename(place)
    return name


_NUMBERS = itertools.count()
