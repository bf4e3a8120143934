"""Writes and reads the directory of one trial: its files, and what they contain.

    <out>/trials/<id>/trial.toml        all that is needed to run this trial again, alone; it holds the scenario, too
                      result.json       a `Record`: the same bytes whenever and wherever the trial is run
                      provenance.json   a `Provenance`: when, where, with what, how long
                      trajectory.npz    where all bodies were, see `Trajectory`
                      evidence.npz      how near bodies came, and by the `EvidenceMode` how they moved: `Evidence`
                      coverage.npz      `frame` (5,) origin x, y, cell in m, rows, columns; `covered` (rows, columns)
                                        0 or 1: what the swarm's own summarizer has joined
                      memory.npz        what control laws remembered, see `Memories`; absent if none does

A directory appears whole or not at all: it is written beside its place and moved there.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import socket
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import msgspec
import numpy as np
import tomlkit
from numpy.typing import NDArray
from pydantic import ValidationError

from fullswarm.clock import wall_time_s
from fullswarm.config.toml_errors import parse_toml
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.model import EvidenceMode, Parameter
from fullswarm.evaluate.experiment.outcomes import Outcome, TrialResult
from fullswarm.evaluate.experiment.plan import Cell, Trial, scenario_of
from fullswarm.evaluate.provenance import Provenance
from fullswarm.evaluate.scenarios import Scenario
from fullswarm.evaluate.swarm import Coverage, Memories, Numbers
from fullswarm.files import replacing
from fullswarm.perf.coverage import GridFrame

FORMAT = "fullswarm.trial/1"
TRIALS = "trials"
TRIAL_FILE, RESULT_FILE, PROVENANCE_FILE = "trial.toml", "result.json", "provenance.json"
TRAJECTORY_FILE, COVERAGE_FILE, EVIDENCE_FILE = "trajectory.npz", "coverage.npz", "evidence.npz"
MEMORY_FILE = "memory.npz"
GRAIN = 1e-5
"""Positions, headings and commands in `Evidence` are whole numbers of this (m, rad, m/s, rad/s)."""
EVIDENCE_FORMAT = "fullswarm.evidence/1"
ID_HASH = 8
ID_WORDS = 120
"""The hash keeps ids apart; a name of a directory may have 255 letters, also with host and process behind it."""


class Approach(msgspec.Struct, frozen=True, kw_only=True):
    """What came nearest, or soonest to a contact, in a trial."""

    value: float  # m, or s
    at_s: float  # the end of the step in which it was, since the request
    who: tuple[str, str]  # a robot, and a robot or an obstacle


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``result.json``: what came of a trial."""

    format: str = FORMAT
    id: str
    experiment: str
    trial: Trial
    outcome: Outcome | None  # None: it failed
    failure: str = ""
    end_reason: str = ""  # "all arrived", "time limit", a termination condition's name, or "failed"
    onboard: dict[str, float] = {}  # from the swarm's summarizers: "work.total_m", "coverage.fraction", …
    truth: dict[str, float] = {}  # the same names where it is known of the true bodies too
    watched: str = "world"  # what contacts, `truth` and `approaches` are from, see `Evidence.source`
    approaches: dict[str, Approach] = {}  # of "separation.min_m", "clearance.min_m" and "time_to_contact.min_s"
    per_robot: dict[str, dict[str, float]] = {}  # "onboard work.distance_m" or "truth …" → robot → value


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

    @classmethod
    def load(cls, path: Path) -> Trajectory:
        """Read the file.

        Raises
        ------
        ConfigError
            There is none, or it is damaged.
        """
        with _arrays(path, "trajectory") as kept:
            ids, goal_radius_m = tuple(kept.pop("ids").tolist()), float(kept.pop("goal_radius_m"))
            return cls(ids=ids, goal_radius_m=goal_radius_m, **kept)


@dataclass(frozen=True, slots=True)
class Evidence:
    """What is needed to count contacts, arrivals and commands again: in the file, the fields by their names.

    Two bodies, or a body and an obstacle, touch in a step when their rims come within `touch_m` anywhere on their
    paths. Step s (from 1) leads from row s - 1 to row s of `xy`; a body that touched nothing in it went straight, or
    on an arc that its headings tell; one that touched went by way of its row in `bend`. `xy` to `bend` are kept by
    the `EvidenceMode`, in whole grains and as changes, which compress well.
    """

    source: str  # "world": the bodies themselves; "fixes", "reported": poses of real robots, by fixes or by themselves
    engine: str  # its name; empty: real robots
    ids: tuple[str, ...]
    radius_m: NDArray[np.float64]  # (n,)
    obstacles: NDArray[np.float64]  # (k, 6) centre x, y, half sizes, yaw, 0: boxes, then walls
    limits: NDArray[np.float64]  # (n, 2) m/s, rad/s that commands are held against; inf: commands are not seen
    goals: NDArray[np.float64]  # (n, 2)
    goal_radius_m: float
    touch_m: float
    step_s: float
    part_s: NDArray[np.float64]  # (p,) when the parts of a step end, since its start
    closest_m: NDArray[np.float32]  # (n (n - 1) / 2,) least gap of the pairs (0, 1), (0, 2), …, (1, 2), …; inf: no step
    closest_s: NDArray[np.float64]  # when: the end of the step, since the request
    wall_m: NDArray[np.float32]  # (n, k) the same for bodies and obstacles
    wall_s: NDArray[np.float64]
    soonest: NDArray[np.float64]  # (4,) least time to contact in s (inf: none), when, row, and other row or -1-k
    xy: NDArray[np.int32]  # (t, n, 2) the first position, then changes from step to step
    heading: NDArray[np.int32]  # (t, n) likewise
    command: NDArray[np.int32]  # (t, n, 2) m/s, rad/s likewise, rounded towards zero; row s was obeyed in step s
    above: NDArray[np.float64]  # (a, 4) the commands above the limits, not rounded: step, robot, m/s, rad/s
    mover_radius_m: NDArray[np.float64]  # (m,) of bodies that no agent commands
    mover_xy: NDArray[np.int32]  # (t, m, 2) likewise, each in the same place throughout a step; row 0: in the first
    bend_step: NDArray[np.int32]  # (b,)
    bend_robot: NDArray[np.int32]  # (b,)
    bend: NDArray[np.int32]  # (b, p, 2) changes from part to part, the first from where the step began
    format: str = EVIDENCE_FORMAT

    @property
    def has_contact(self) -> bool:
        """Whether anything touched."""
        return len(self.bend) > 0

    def kept(self, mode: EvidenceMode) -> Evidence:
        """Return what a trial keeps of it."""
        if mode == "always" or (mode == "contacts" and self.has_contact):
            return self
        motion = ("xy", "heading", "command", "above", "mover_xy", "bend_step", "bend_robot", "bend")
        return replace(self, **{name: getattr(self, name)[:0] for name in motion})


def arrays_of(kept: Trajectory | Evidence) -> dict[str, NDArray[Any]]:
    """Return what the file of a trajectory or of evidence holds."""
    return {name: np.asarray(getattr(kept, name)) for name in kept.__slots__}


def save_arrays(kept: Trajectory | Evidence, path: Path) -> None:
    """Write the file of a trajectory or of evidence."""
    np.savez_compressed(path, **arrays_of(kept))  # type: ignore[arg-type]  # no array is called allow_pickle


def digest_of(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return a hash of arrays and their names, whatever file they are in."""
    found = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        found.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def trial_id(trial: Trial) -> str:
    """Return the name of a trial's directory: readable, and unlike that of any other trial."""
    cell = trial.cell
    words = (cell.label, cell.scenario, f"n{cell.robots}", cell.engine, cell.limits, f"s{trial.seed}")
    text = re.sub(r"[^A-Za-z0-9_.=]+", "-", "-".join(words)).strip("-.")
    whole = msgspec.to_builtins(trial)
    for name in ("team", "needs", "roles"):  # unsaid, they leave the names of trials as they were without them
        if not whole["cell"][name]:
            del whole["cell"][name]
    return f"{text[:ID_WORDS].rstrip('-.')}-{hashlib.sha256(msgspec.json.encode(whole)).hexdigest()[:ID_HASH]}"


LAUNCH_FORMAT = "fullswarm.launch/1"
HEAD = "# Runs one trial again: fullswarm experiment trial trial.toml\n"

Table = dict[str, Parameter]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Launch:
    """What a trial's file holds."""

    experiment: str
    trial: Trial


class _Document(msgspec.Struct, forbid_unknown_fields=True):
    """The tables of the file; `body`, `agent` and `stop` are settings of world, agents and summarizers."""

    format: str
    id: str
    experiment: str
    seed: int
    cell: dict[str, Any]
    body: Table
    scenario: dict[str, Any]
    time_limit_s: float | None = None
    agent: Table = {}
    stop: Table = {}
    sight: Table = {}
    bodies: list[Table] = []


def launch_text(trial: Trial, experiment: str) -> str:
    """Return the file of a trial; `ConfigError` when its scenario cannot be read."""
    cell = asdict(trial.cell)
    # Last in the file: tables within a table; TOML has lists, no tuples.
    cell["parameters"] = trial.cell.requested()
    for name in ("needs", "roles"):
        if given := cell.pop(name):
            cell[name] = {key: list(value) if isinstance(value, tuple) else value for key, value in given}
    head: dict[str, Any] = {
        "format": LAUNCH_FORMAT,
        "id": trial_id(trial),
        "experiment": experiment,
        "seed": trial.seed,
    }
    if trial.time_limit_s is not None:
        head["time_limit_s"] = trial.time_limit_s
    settings = {name: dict(getattr(trial, name)) for name in ("body", "agent", "stop", "sight")}
    try:
        arena = {"scenario": json.loads(trial.arena or _arena(scenario_of(trial)))}
    except ConfigError:
        arena = {"scenario": {"name": trial.cell.scenario}}  # that is why it failed
    bodies = {"bodies": [dict(each) for each in trial.bodies]} if trial.bodies else {}
    return HEAD + tomlkit.dumps({**head, "cell": cell, **settings, **bodies, **arena})


def load_trial(path: Path) -> Launch:
    """Read a trial from its file, or from the directory that holds one.

    Raises
    ------
    ConfigError
        No such file, or it is not that of a trial.
    """
    path = path / TRIAL_FILE if path.is_dir() else path
    try:
        return parse_trial(path.read_text("utf-8"), str(path))
    except OSError as error:
        raise ConfigError(
            f"cannot read the trial: {error.strerror or error}",
            where=str(path),
            hint="name a trial.toml, or the folder that holds it: FOLDER/trials/ID of `fullswarm experiment run --out`",
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigError("the trial is not UTF-8 text", where=str(path)) from error


def parse_trial(text: str, where: str) -> Launch:
    """Return the trial that TOML `text` describes; `ConfigError` as `load_trial`."""
    try:
        document = msgspec.convert(parse_toml(text, where), _Document)
        if document.format != LAUNCH_FORMAT:
            raise ConfigError(f"format '{document.format}' is not {LAUNCH_FORMAT}", where=where)
        cell = {name: list(dict(document.cell.get(name, {})).items()) for name in ("parameters", "needs", "roles")}
        trial = Trial(
            cell=msgspec.convert({**document.cell, **cell}, Cell),
            seed=document.seed,
            time_limit_s=document.time_limit_s,
            body=tuple(document.body.items()),
            agent=tuple(document.agent.items()),
            stop=tuple(document.stop.items()),
            sight=tuple(document.sight.items()),
            bodies=tuple(tuple(each.items()) for each in document.bodies),
            arena=_arena(Scenario.model_validate_json(json.dumps(document.scenario), strict=True)),
        )
    except (msgspec.ValidationError, ValidationError, TypeError, ValueError) as error:
        raise ConfigError(f"not the file of a trial: {error}", where=where) from error
    return Launch(document.experiment, trial)


def _arena(scenario: Scenario) -> str:
    return scenario.model_dump_json(exclude_none=True)


def recording_of(trial: Trial, folder: Path | None) -> Path | None:
    """Return the new file for a recording of a trial in a folder, made if missing; one of an earlier try is removed."""
    if folder is None:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{trial_id(trial)}.mcap"
    for each in (path, *folder.glob(f"{path.stem}.*{path.suffix}")):
        each.unlink(missing_ok=True)
    return path


FAILED, OLD = "failed", ".old"
OLD_S = 86400.0
"""Parts of directories of another machine are removed when they are older."""
Files = Mapping[str, bytes]


# ---------------------------------------------------------------------------------------------------- writing
def write_trial(out: Path, record: Record, about: Provenance, found: Measurement | str | None = None) -> Path:
    """Write the directory of a trial and return it; one with an outcome stays as it is, a failed one is replaced.

    Raises
    ------
    OSError
        The disk is full or not writable; nothing is left of it.
    """
    with _beside(out, record.id) as folder:
        fill(folder, record, about, found)
    return out / TRIALS / record.id


def fill(folder: Path, record: Record, about: Provenance, found: Measurement | str | None = None) -> None:
    """Write the files of a trial into a folder."""
    (folder / TRIAL_FILE).write_text(launch_text(record.trial, record.experiment), "utf-8")
    (folder / RESULT_FILE).write_bytes(_pretty(record))
    if isinstance(found, Measurement) and found.evidence is not None:
        about = msgspec.structs.replace(about, evidence=digest_of(arrays_of(found.evidence)))
    (folder / PROVENANCE_FILE).write_bytes(_pretty(about))
    if not isinstance(found, Measurement):
        return
    for file, kept in ((TRAJECTORY_FILE, found.trajectory), (EVIDENCE_FILE, found.evidence)):
        if kept is not None:
            save_arrays(kept, folder / file)
    if found.memories is not None:
        np.savez_compressed(folder / MEMORY_FILE, **asdict(found.memories))
    if found.coverage is not None:
        frame, covered = found.coverage
        numbers = np.array([frame.origin_x_m, frame.origin_y_m, frame.cell_m, frame.rows, frame.columns])
        np.savez_compressed(folder / COVERAGE_FILE, frame=numbers, covered=covered)


def files_of(record: Record, about: Provenance, found: Measurement | str | None) -> Files:
    """Return the files of a trial, for a machine that shares no disk with the folder of the results."""
    with TemporaryDirectory() as path:
        fill(Path(path), record, about, found)
        return {each.name: each.read_bytes() for each in sorted(Path(path).iterdir())}


def write_files(out: Path, name: str, files: Files) -> None:
    """Write the directory of trial `name`; as `write_trial`."""
    with _beside(out, name) as folder:
        for file, data in files.items():
            (folder / file).write_bytes(data)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a new file that takes the place of `path` at the end; `ConfigError` if it cannot be written."""
    try:
        with replacing(path) as part:
            yield part
    except OSError as error:
        raise ConfigError(f"cannot write: {error.strerror or error}", where=str(path)) from error


@contextmanager
def _beside(out: Path, name: str) -> Iterator[Path]:
    """Yield a folder that takes the place of trial `name` at the end, or is gone if anything goes wrong."""
    place = out / TRIALS / name
    folder = place.with_name(f".{name}-{socket.gethostname()}-{os.getpid()}")
    old = folder.with_name(f"{folder.name}{OLD}")
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        yield folder
        if place.exists():
            kept = read_record(place)
            if kept is not None and kept.outcome is not None:
                return
            place.rename(old)  # one directory cannot replace another in one step; cut off here, the trial runs again
        folder.rename(place)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def _pretty(value: msgspec.Struct) -> bytes:
    return msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"


# ---------------------------------------------------------------------------------------------------- reading
def decode(path: Path, kind: type[T]) -> T:
    """Return what a JSON file holds.

    Raises
    ------
    ConfigError
        It cannot be read, or holds something else.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except OSError as error:
        raise ConfigError(f"cannot read {path.name}: {error.strerror or error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path.name}: {error}") from error


def read_record(folder: Path) -> Record | None:
    """Return the record of a trial's directory; None: there is none that can be read, so the trial is to be run."""
    try:
        return decode(folder / RESULT_FILE, Record)
    except ConfigError:
        return None


def read_kept(out: Path, trial: Trial) -> TrialResult | None:
    """Return the result of a trial that has an outcome in this folder already."""
    folder = out / TRIALS / trial_id(trial)
    record = read_record(folder) if folder.is_dir() else None
    if record is None or record.outcome is None or record.trial != trial:
        return None
    about = read_provenance(out, trial)
    return TrialResult(
        seed=trial.seed,
        outcome=record.outcome,
        wall_s=about.wall_s,
        end_reason=record.end_reason,
        attempts=about.attempts,
    )


def read_provenance(out: Path, trial: Trial) -> Provenance:
    """Return where a trial's figures come from; empty when that cannot be read."""
    try:
        return decode(out / TRIALS / trial_id(trial) / PROVENANCE_FILE, Provenance)
    except ConfigError:
        return Provenance()


def read_trajectory(folder: Path) -> Trajectory:
    """Return where all bodies of a trial were; `ConfigError` as `Trajectory.load`, with why the trial failed."""
    record = read_record(folder)
    if not (folder / TRAJECTORY_FILE).exists():
        failed = f"it failed: {record.failure}" if record is not None and record.failure else ""
        raise ConfigError(f"the trial left no {TRAJECTORY_FILE}", where=str(folder), hint=failed)
    return Trajectory.load(folder / TRAJECTORY_FILE)


def read_coverage(folder: Path) -> Coverage:
    """Return the grid that the robots of a trial have covered.

    Raises
    ------
    ConfigError
        There is none, or it is damaged.
    """
    with _arrays(folder / COVERAGE_FILE, "coverage grid") as file:
        x_m, y_m, cell_m, rows, columns = file["frame"].tolist()
        return GridFrame(x_m, y_m, cell_m, int(rows), int(columns)), file["covered"]


def read_memories(folder: Path) -> Memories:
    """Return what the control laws of a trial remembered.

    Raises
    ------
    ConfigError
        None remembered anything, or the file is damaged.
    """
    with _arrays(folder / MEMORY_FILE, "recording of memories") as file:
        return Memories(**file)


def read_evidence(folder: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a trial's evidence, by their names in `Evidence`.

    Raises
    ------
    ConfigError
        There is none, it is damaged, or other code has written it.
    """
    with _arrays(folder / EVIDENCE_FILE, "file of evidence") as file:
        if str(file.get("format", "")) != EVIDENCE_FORMAT:
            raise ValueError(f"format '{file.get('format', '')}' is not {EVIDENCE_FORMAT}")
        for name in sorted({each.name for each in fields(Evidence)} - file.keys()):
            raise ValueError(f"it has no array '{name}'")
        return file


@contextmanager
def _arrays(path: Path, what: str) -> Iterator[dict[str, Any]]:
    """Yield the arrays of an NPZ file; what is wrong with it or with them is a `ConfigError`."""
    if not path.exists():
        raise ConfigError(f"this trial has no {what}", where=str(path))
    try:
        if not zipfile.is_zipfile(path):  # NumPy would leave a broken archive open
            raise ValueError("cut off, or another file")
        with np.load(path, allow_pickle=False) as file:
            yield {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ConfigError(f"not a {what}: {error}", where=str(path), hint="run the trial again") from error


def sweep(out: Path) -> int:
    """Remove what dead processes left half-written; return how many.

    Raises
    ------
    ConfigError
        The folder cannot be made or read.
    """
    try:
        (out / TRIALS).mkdir(parents=True, exist_ok=True)
        found = [each for each in (out / TRIALS).iterdir() if each.name.startswith(".") and _is_dead(each)]
    except OSError as error:
        raise ConfigError(f"cannot use the folder: {error.strerror or error}", where=str(out)) from error
    for each in found:
        shutil.rmtree(each, ignore_errors=True)
    return len(found)


def _is_dead(folder: Path) -> bool:
    name, _, pid = folder.name.removesuffix(OLD).rpartition("-")
    if not name.endswith(f"-{socket.gethostname()}") or not pid.isdecimal():
        with suppress(OSError):
            return wall_time_s() - folder.stat().st_mtime > OLD_S
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return int(pid) == os.getpid()


@dataclass(frozen=True, slots=True)
class Measurement:
    """All that one trial measured: what a results folder keeps of it."""

    outcome: Outcome
    end_reason: str = ""
    onboard: Numbers = field(default_factory=dict)
    truth: Numbers = field(default_factory=dict)
    per_robot: Mapping[str, Numbers] = field(default_factory=dict)
    trajectory: Trajectory | None = None
    coverage: Coverage | None = None  # the swarm's own
    memories: Memories | None = None
    evidence: Evidence | None = None
    watched: str = "world"
    approaches: Mapping[str, Approach] = field(default_factory=dict)
