"""`fullswarm experiment replay`: find a trial, then draw or film it."""

from __future__ import annotations

import difflib
import fnmatch
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from fullswarm import output
from fullswarm.clock import Clock, MonotonicClock
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.pictures import FILM_ENDINGS, STILL_ENDINGS, Film, write_film, write_still
from fullswarm.evaluate.trial_folder import RESULT_FILE, TRAJECTORY_FILE, TRIALS, Record, Trajectory

TELL_S = 2.0
"""How often progress is told."""
NAMED = 5
"""So many trials are named when the choice is not clear."""


@dataclass(frozen=True, slots=True)
class Replay:
    """What the command line says. `trial` is the beginning of an id, or a pattern with ``*``."""

    folder: Path
    to: Path
    film: Film
    trial: str = ""


def replay(wanted: Replay, clock: Clock | None = None) -> int:
    """Write the picture or film, print its path, return 0.

    Raises
    ------
    ConfigError
        No such trial, or several; it left no trajectory; the ending of `to`, a time or a number is wrong.
    MissingExtra
        What draws or films is not installed.
    """
    kind = wanted.to.suffix.lower()
    known = (*STILL_ENDINGS, *FILM_ENDINGS)
    if kind not in known:
        raise ConfigError(
            f"cannot make a '{wanted.to.suffix or wanted.to.name}'", where="--to", hint=f"it ends in {', '.join(known)}"
        )
    if not wanted.to.absolute().parent.is_dir():
        raise ConfigError("no such folder", where=str(wanted.to.absolute().parent))
    place = find_trial(wanted.folder, wanted.trial)
    record = read_record(place)
    trajectory = read_trajectory(place, record)
    caption = wanted.film.caption or (record.trial.label if record else place.name)
    settings = replace(wanted.film, caption=caption)
    if kind in STILL_ENDINGS:
        write_still(
            trajectory,
            wanted.to,
            caption=caption,
            width_px=settings.width_px,
            from_s=settings.from_s,
            until_s=settings.until_s,
        )
    else:
        write_film(trajectory, wanted.to, settings, _Teller(clock or MonotonicClock()))
    output.data(str(wanted.to))
    return 0


class _Teller:
    """Tells on stderr how many frames there are."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._told_s = clock.now_s()

    def __call__(self, done: int, of: int) -> None:
        now_s = self._clock.now_s()
        if now_s - self._told_s >= TELL_S or done == of:
            self._told_s = now_s
            output.progress(f"{done} of {of} frames")


def find_trial(folder: Path, wanted: str = "") -> Path:
    """Return a trial's directory: `folder` itself, or the one in an experiment's folder whose id begins so.

    Raises
    ------
    ConfigError
        There is none, or more than one.
    """
    if not folder.is_dir():
        raise ConfigError("no such folder", where=str(folder))
    trials = folder / TRIALS
    if not trials.is_dir():
        if (folder / TRAJECTORY_FILE).exists() or (folder / RESULT_FILE).exists():
            return folder
        raise ConfigError(
            "neither a trial's folder nor an experiment's",
            where=str(folder),
            hint=f"a trial's holds {TRAJECTORY_FILE}, an experiment's {TRIALS}/",
        )
    names = sorted(each.name for each in trials.iterdir() if each.is_dir() and not each.name.startswith("."))
    if wanted in names:
        return trials / wanted
    found = [name for name in names if fnmatch.fnmatchcase(name, f"{wanted}*")]
    if len(found) == 1:
        return trials / found[0]
    where = f"--trial {wanted}" if wanted else str(folder)
    if not found:
        near = did_you_mean(wanted, names) if len(names) <= NAMED else _near(wanted, names)
        raise ConfigError("no such trial", where=where, hint=near)
    some = ", ".join(found[:NAMED]) + (", …" if len(found) > NAMED else "")
    raise ConfigError(f"{len(found)} trials fit", where=where, hint=f"name one with --trial: {some}")


def _near(wanted: str, names: list[str]) -> str:
    """Return a hint that does not name hundreds."""
    near = difflib.get_close_matches(wanted, names, n=1, cutoff=0.4)
    return f"did you mean '{near[0]}'?" if near else f"there are {len(names)}, the first is '{names[0]}'"


def read_record(place: Path) -> Record | None:
    """Return what came of a trial; None when that cannot be read: its picture does not need it."""
    try:
        return msgspec.json.decode((place / RESULT_FILE).read_bytes(), type=Record)
    except (OSError, msgspec.DecodeError, ValueError):  # ValueError: not UTF-8
        return None


def read_trajectory(place: Path, record: Record | None = None) -> Trajectory:
    """Return where all bodies were.

    Raises
    ------
    ConfigError
        The trial left no trajectory, or the file is damaged.
    """
    path = place / TRAJECTORY_FILE
    try:
        if path.exists() and not zipfile.is_zipfile(path):
            raise ValueError("cut off, or another file")
        return Trajectory.load(path)
    except FileNotFoundError as error:
        failed = f"it failed: {record.failure}" if record is not None and record.failure else ""
        raise ConfigError(f"the trial left no {TRAJECTORY_FILE}", where=str(place), hint=failed) from error
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ConfigError(f"not a trajectory: {error}", where=str(path)) from error
