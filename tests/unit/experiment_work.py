"""What worker processes may make of a trial; a spawned process imports these by name."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fullswarm.evaluate.experiment import Outcome, Trial, TrialResult
from fullswarm.evaluate.trial_folder import Measurement, Trajectory
from fullswarm.perf.coverage import GridFrame


def answer(trial: Trial) -> Measurement:
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
    pose = np.full((5, trial.cell.robots, 3), trial.seed, np.float32)
    trajectory = Trajectory(
        ids=tuple(f"r{row}" for row in range(trial.cell.robots)),
        time_s=np.arange(5, dtype=np.float64) * 0.2,
        pose=pose,
        touching=np.zeros(pose.shape[:2], bool),
        goals=np.zeros((trial.cell.robots, 2)),
        goal_radius_m=1.0,
        radius_m=np.full(trial.cell.robots, 0.17),
        boxes=np.zeros((0, 5)),
        bounds_m=np.array([0.0, 0.0, 1.0, 1.0]),
    )
    frame = GridFrame(0.0, 0.0, 0.5, 2, 2)
    return Measurement(
        outcome,
        "all arrived",
        {"work.total_m": 1.0},
        {"work.total_m": 1.0},
        {},
        trajectory,
        (frame, np.eye(2, dtype=np.uint8)),
    )


def misbehave(trial: Trial, attempt: int) -> TrialResult:
    """Die with seed 1, hang with seed 2, die with seed 3 the first time, answer otherwise."""
    if trial.seed == 1 or (trial.seed == 3 and attempt == 1):
        os._exit(3)
    if trial.seed == 2:
        threading.Event().wait()
    return TrialResult(seed=trial.seed, outcome=answer(trial).outcome, attempts=attempt)


@dataclass(frozen=True)
class Trouble:
    """Measures as `answer`, but gets into trouble with some seeds; leaves a line in `notes` for each try."""

    notes: Path
    killed: int = -1  # SIGKILL, the first time
    raises: int = -1
    hangs: int = -1  # with a process of its own
    full: int = -1  # the disk takes so little that its files cannot be written
    slow_s: float = 0.0
    late: int = 1_000_000  # this seed and those after it wait until there is a file `notes` + ".go"

    def __call__(self, trial: Trial) -> Measurement:
        first = not self.tries(trial.seed)
        with self.notes.open("a") as file:
            file.write(f"{trial.seed} {os.getpid()}\n")
        if trial.seed == self.killed and first:
            os.kill(os.getpid(), signal.SIGKILL)
        if trial.seed == self.raises:
            raise ValueError("no law of nature")
        if trial.seed == self.hangs:
            child = subprocess.Popen(["sleep", "600"])
            with self.notes.with_suffix(".child").open("w") as file:
                file.write(str(child.pid))
            child.wait()
        hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
        resource.setrlimit(resource.RLIMIT_FSIZE, (400 if trial.seed == self.full else hard, hard))
        threading.Event().wait(self.slow_s)
        while trial.seed >= self.late and not self.notes.with_suffix(".go").exists():
            threading.Event().wait(0.02)
        return answer(trial)

    def tries(self, seed: int | None = None) -> list[int]:
        """Return the processes that tried a seed, or any, in order."""
        if not self.notes.exists():
            return []
        lines = [line.split() for line in self.notes.read_text().splitlines()]
        return [int(pid) for each, pid in lines if seed is None or int(each) == seed]
