"""What is kept of one trial: the files of its directory, and what stands in them.

    <out>/trials/<id>/trial.toml        all that is needed to run this trial again, alone
                      result.json       a `Record`: the same bytes whenever and wherever the trial is run
                      provenance.json   a `Provenance`: when, where, with what, how long
                      trajectory.npz    where all bodies were, see `Trajectory`
                      contacts.npz      contacts between bodies, and how near each pair came: `Contacts`
                      coverage.npz      `frame` (5,) origin x, y, cell in m, rows, columns; `covered` (rows, columns)
                                        0 or 1: what the swarm's own summarizer has joined

A directory appears whole or not at all: it is written beside its place and moved there.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from fullswarm.evaluate.experiment.plan import Trial
from fullswarm.evaluate.experiment.results import Outcome

FORMAT = "fullswarm.trial/1"
TRIALS = "trials"
TRIAL_FILE, RESULT_FILE, PROVENANCE_FILE = "trial.toml", "result.json", "provenance.json"
TRAJECTORY_FILE, COVERAGE_FILE, CONTACTS_FILE = "trajectory.npz", "coverage.npz", "contacts.npz"
GRAIN_M = 1e-5
"""Positions in `Contacts` are whole numbers of this."""
ID_HASH = 8
ID_WORDS = 120
"""The hash keeps ids apart; a name of a directory may have 255 letters, also with host and process behind it."""


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``result.json``: what came of a trial."""

    format: str = FORMAT
    id: str
    experiment: str
    trial: Trial
    outcome: Outcome | None  # None: it failed
    failure: str = ""
    end_reason: str = ""  # "all arrived", "time limit", a termination condition's name, or "failed"
    onboard: dict[str, float] = {}  # what the swarm's summarizers say: "work.total_m", "coverage.fraction", …
    truth: dict[str, float] = {}  # the same names where the true bodies tell it too
    per_robot: dict[str, dict[str, float]] = {}  # "onboard work.distance_m" or "truth …" → robot → value


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """``provenance.json``: nothing in it may change a figure."""

    started: str = ""  # ISO 8601, UTC
    wall_s: float = 0.0
    attempts: int = 1
    host: str = ""
    machine: str = ""  # processor and system
    python: str = ""
    fullswarm: str = ""
    git: str = ""  # commit, with "+changes" when the work tree had any; empty outside a repository
    packages: dict[str, str] = {}  # name → version of what computes figures
    configuration: str = ""  # sha256 of trial.toml
    runner: str = "pool"  # pool, dask, live, fleet


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Where all bodies were. In the file: the fields by their names, ids as text."""

    ids: tuple[str, ...]
    time_s: NDArray[np.float64]  # (t,) since the request
    pose: NDArray[np.float32]  # (t, n, 3) m, m, rad
    touching: NDArray[np.bool_]  # (t, n) touched anything since the sample before
    goals: NDArray[np.float64]  # (n, 2)
    goal_radius_m: float
    radius_m: NDArray[np.float64]  # (n,)
    boxes: NDArray[np.float64]  # (k, 5) centre x, y, size x, y, yaw
    bounds_m: NDArray[np.float64]  # (4,)

    def save(self, path: Path) -> None:
        """Write the file."""
        fields = {name: getattr(self, name) for name in self.__slots__ if name != "ids"}
        np.savez_compressed(path, ids=np.array(self.ids), **fields)

    @classmethod
    def load(cls, path: Path) -> Trajectory:
        """Read the file."""
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            fields = {name: file[name] for name in file.files}
        fields["ids"] = tuple(fields["ids"].tolist())
        fields["goal_radius_m"] = float(fields["goal_radius_m"])
        return cls(**fields)


@dataclass(frozen=True, slots=True)
class Contacts:
    """What is needed to count contacts again: in the file, the fields by their names, ids as text.

    Two robots, or a robot and an obstacle, touch in a step when their rims come within `touch_m` anywhere on their
    paths. Step s (from 1) leads from position s - 1 to s of `xy`; a robot that touched nothing in it went straight,
    one that touched went by way of its row in `bend`. Positions are kept for trials with a contact only, in whole
    grains of 10 µm and as changes, which compress well.
    """

    ids: tuple[str, ...]
    radius_m: NDArray[np.float64]  # (n,)
    obstacles: NDArray[np.float64]  # (k, 6) centre x, y, half sizes, yaw, 0: boxes, then walls
    touch_m: float
    step_s: float
    closest_m: NDArray[np.float32]  # (n (n - 1) / 2,) least gap of the pairs (0, 1), (0, 2), …, (1, 2), …; inf: no step
    closest_s: NDArray[np.float64]  # when: the end of the step, since the request
    part_s: NDArray[np.float64]  # (p,) when the parts of a step end, since its start
    xy: NDArray[np.int32]  # (t, n, 2) the first position, then changes from step to step
    bend_step: NDArray[np.int32]  # (b,)
    bend_robot: NDArray[np.int32]  # (b,)
    bend: NDArray[np.int32]  # (b, p, 2) changes from part to part, the first from where the step began

    def save(self, path: Path) -> None:
        """Write the file."""
        fields = {name: getattr(self, name) for name in self.__slots__ if name != "ids"}
        np.savez_compressed(path, ids=np.array(self.ids), **fields)


def trial_id(trial: Trial) -> str:
    """Return the name of a trial's directory: readable, and unlike that of any other trial."""
    cell = trial.cell
    words = (cell.label, cell.scenario, f"n{cell.robots}", cell.engine, cell.limits, f"s{trial.seed}")
    text = re.sub(r"[^A-Za-z0-9_.=]+", "-", "-".join(words)).strip("-.")
    return f"{text[:ID_WORDS].rstrip('-.')}-{hashlib.sha256(msgspec.json.encode(trial)).hexdigest()[:ID_HASH]}"
