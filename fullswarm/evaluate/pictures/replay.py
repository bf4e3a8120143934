"""`fullswarm experiment replay`: find a trial, then draw or film it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from fullswarm import output
from fullswarm.clock import Clock
from fullswarm.errors import ConfigError
from fullswarm.evaluate.pictures import FILM_ENDINGS, STILL_ENDINGS, Film, write_film, write_still
from fullswarm.evaluate.results.folder import find_trial
from fullswarm.evaluate.trial_folder import (
    read_record,
    read_trajectory,
)

"""How often progress is printed."""


@dataclass(frozen=True, slots=True)
class Replay:
    """The options of the command line. `trial` is the beginning of an id, or a pattern with ``*``."""

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
    trajectory = read_trajectory(place)
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
        with output.Progress("frames", clock=clock) as progress:
            write_film(trajectory, wanted.to, settings, progress.parts)
    output.data(str(wanted.to))
    return 0
