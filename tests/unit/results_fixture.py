"""Results folders for tests: 2 behaviours x 2 scenarios x 2 sizes x 4 seeds, one of them failed."""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path

import msgspec
import numpy as np

from fullswarm.evaluate.experiment import Cell, Outcome, Trial
from fullswarm.evaluate.provenance import Provenance
from fullswarm.evaluate.scenarios import boxes_for, load_scenario, spawn
from fullswarm.evaluate.trial_folder import (
    COVERAGE_FILE,
    PROVENANCE_FILE,
    RESULT_FILE,
    TRAJECTORY_FILE,
    TRIAL_FILE,
    TRIALS,
    Record,
    Trajectory,
    save_arrays,
    trial_id,
)

BEHAVIOURS = ("move_to_goal", "move_to_goal_bc")
SCENARIOS = ("concave", "uniform")
SIZES = (4, 8)
FAILURE = "law raised <ValueError>: no way & no hope"


def a_trial(behaviour: str, scenario: str, robots: int, seed: int, engine: str = "kinematic") -> Trial:
    cell = Cell(
        group="paper",
        behaviour=behaviour,
        parameters=(),
        scenario=scenario,
        robots=robots,
        engine=engine,
        limits="paper",
    )
    return Trial(cell=cell, seed=seed, time_limit_s=None, body=(("radius_m", 0.17),), agent=())


def an_outcome(trial: Trial) -> Outcome:
    """Unfiltered: as many contacts as robots and seed say; filtered: none."""
    robots, bare = trial.cell.robots, not trial.cell.behaviour.endswith("_bc")
    late = trial.cell.scenario == "concave" and trial.seed % 2 == 0
    return Outcome(
        robots=robots,
        arrived=robots - int(late),
        robot_events=robots * bare + trial.seed % 3 * bare,
        obstacle_events=2 * bare * (trial.cell.scenario == "uniform"),
        safe_start=True,
        simulated_s=60.0 if late else 20.0 + trial.seed + robots / 8.0,
    )


def a_record(trial: Trial, failure: str = "") -> Record:
    outcome = None if failure else an_outcome(trial)
    if outcome is None:
        return Record(id=trial_id(trial), experiment="paper", trial=trial, outcome=None, failure=failure)
    work_m = 15.0 + 0.25 * trial.seed
    truth = {
        "work.total_m": work_m * outcome.robots,
        "work.mean_m": work_m,
        "coverage.fraction": 0.05 * math.sqrt(outcome.robots) + 0.001 * trial.seed,
        "collisions.events": float(outcome.events),
    }
    return Record(
        id=trial_id(trial),
        experiment="paper",
        trial=trial,
        outcome=outcome,
        end_reason="all arrived" if outcome.arrived == outcome.robots else "time limit",
        onboard={name: value * 1.01 for name, value in truth.items()},
        truth=truth,
        per_robot={"truth work.distance_m": {f"r{row}": work_m for row in range(outcome.robots)}},
    )


def a_trajectory(trial: Trial, samples: int = 100) -> Trajectory:
    """Straight lines to the goal; `samples` at 5 Hz."""
    scenario = load_scenario(trial.cell.scenario)
    start = spawn(scenario, trial.cell.robots, trial.seed, 0.17)
    goals = np.tile(np.asarray(scenario.goal.centre_m, float), (trial.cell.robots, 1))
    share = np.linspace(0.0, 1.0, samples)[:, None, None]
    pose = np.zeros((samples, trial.cell.robots, 3), np.float32)
    wave = 0.5 * np.sin(8.0 * share + np.arange(trial.cell.robots)[None, :, None])
    pose[:, :, :2] = start[None, :, :2] * (1.0 - share) + goals[None] * share + wave * (1.0 - share)
    touching = np.zeros((samples, trial.cell.robots), bool)
    touching[samples // 2, 0] = not trial.cell.behaviour.endswith("_bc")
    return Trajectory(
        ids=tuple(f"r{row}" for row in range(trial.cell.robots)),
        time_s=0.2 * np.arange(samples, dtype=float),
        pose=pose,
        touching=touching,
        goals=goals,
        goal_radius_m=scenario.goal.radius_m,
        radius_m=np.full(trial.cell.robots, 0.17),
        boxes=np.asarray(scenario.boxes or boxes_for(scenario, trial.seed), float).reshape(-1, 5),
        bounds_m=np.asarray(scenario.bounds_m, float),
    )


def write_trial(out: Path, trial: Trial, failure: str = "", record: Record | None = None, samples: int = 100) -> Path:
    """Write one trial's directory and return it."""
    kept = record or a_record(trial, failure)
    path = out / TRIALS / kept.id
    path.mkdir(parents=True)
    (path / RESULT_FILE).write_bytes(msgspec.json.encode(kept))
    provenance = Provenance(
        started=f"2026-11-21T04:00:{trial.seed:02d}Z",
        wall_s=0.5,
        host="lab",
        python="3.11.2",
        fullswarm="0.1.0",
        git="0123abc",
        packages={"numpy": "2.0.0"},
        configuration="00ff",
    )
    (path / PROVENANCE_FILE).write_bytes(msgspec.json.encode(provenance))
    (path / TRIAL_FILE).write_text(f"seed = {trial.seed}\n")
    if kept.outcome is not None:
        trajectory = a_trajectory(trial, samples)
        save_arrays(trajectory, path / TRAJECTORY_FILE)
        covered = np.zeros((40, 40), np.uint8)
        cells = (trajectory.pose[:, :, :2].reshape(-1, 2) / 0.5).astype(int)
        covered[cells[:, 1].clip(0, 39), cells[:, 0].clip(0, 39)] = 1
        frame = np.array([0.0, 0.0, 0.5, 40, 40])
        np.savez_compressed(path / COVERAGE_FILE, frame=frame, covered=covered)
    return path


def write_folder(
    out: Path,
    behaviours: tuple[str, ...] = BEHAVIOURS,
    scenarios: tuple[str, ...] = SCENARIOS,
    sizes: tuple[int, ...] = SIZES,
    seeds: int = 4,
    samples: int = 100,
) -> Path:
    """Write a results folder and return it; the last seed of the first cell failed."""
    for behaviour, scenario, robots, seed in product(behaviours, scenarios, sizes, range(seeds)):
        first = (behaviour, scenario, robots, seed) == (behaviours[0], scenarios[0], sizes[0], seeds - 1)
        trial = a_trial(behaviour, scenario, robots, seed)
        write_trial(out, trial, FAILURE if first else "", samples=samples)
    return out
