"""Runs `fullswarm try`: one file as a behaviour in lockstep, shown in a window or as a picture, with its metrics."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fullswarm import output, registry
from fullswarm.errors import BehaviourFailed, ConfigError
from fullswarm.evaluate.pictures import FILM_ENDINGS, STILL_ENDINGS
from fullswarm.lab.lab import Lab
from fullswarm.lab.request import LabRequest
from fullswarm.lab.window import open_window, show
from fullswarm.messages import Value
from fullswarm.units import unit_of

SHOWN = {
    "arrival.fraction": "share of the robots that are at their goals",
    "formation.error_m": "distance to the goals, root mean square",
    "work.mean_m": "way of a robot, mean",
    "work.max_m": "longest way of a robot",
    "coverage.fraction": "share of the arena that was driven over",
    "collisions.events": "contacts begun",
    "separation.min_m": "smallest gap between two robots",
    "filter.mean_m": "how far the safety filter changed a robot's motion, mean",
    "deadlocks.deadlock_count": "times that a robot stepped aside",
    "energy.mean_j": "energy of a robot, mean",
    "shape.order": "alignment of the headings, 0 to 1",
    "shape.spacing_m": "distance to the nearest robot, mean",
    "shape.diameter_m": "extent of the swarm",
}
"""What is printed of the metrics, and what it means."""


@dataclass(frozen=True)
class Tryout:
    """The options of the command line.

    Attributes
    ----------
    behaviour : the path of a Python file, or the name of a behaviour
    fleet : a fleet file; None: `robots` in an arena of `size_m` by `size_m`
    speed : simulated seconds per second, in a window or a film; 0: twice real time, or what fits into 15 s
    """

    behaviour: str
    parameters: Mapping[str, Value]
    robots: int = 6
    size_m: float = 8.0
    fleet: Path | None = None
    seed: int = 0
    seconds: float = 20.0
    speed: float = 0.0
    save: Path | None = None
    filtered: bool = True
    twist: bool = False
    as_json: bool = False

    @property
    def file(self) -> Path | None:
        """The file, if it is one."""
        return Path(self.behaviour) if self.behaviour.endswith(".py") else None


def run(wanted: Tryout) -> int:
    """Run it and print the metrics; return 0.

    Raises
    ------
    ConfigError
        The file is missing, does not load, has no control law, or its control law raised an error: names its line. Or
        an option is wrong.
    MissingExtra
        What draws is not installed.
    """
    if wanted.save is not None:
        _check(wanted.save)
    with _lab(wanted) as lab:
        request = _request(lab, wanted)
        caption = f"{request.behaviour}, {len(lab.robots)} robots, seed {wanted.seed}"
        window = open_window(f"fullswarm try {wanted.behaviour}") if wanted.save is None else None
        try:
            if window is not None:
                show(window, lab, wanted.seconds, wanted.speed or 2.0, caption)
            else:
                lab.run(wanted.seconds)
        except BehaviourFailed as failed:
            raise _in_words(failed, lab.time_s, wanted) from failed
        if window is None:
            place = wanted.save or Path(f"{request.behaviour}.png")
            _draw(lab, place, caption, wanted.speed)
            output.progress(f"wrote {place}")
        _print(lab, request, as_json=wanted.as_json)
    return 0


def _check(place: Path) -> None:
    known = (*STILL_ENDINGS, *FILM_ENDINGS)
    if place.suffix.lower() not in known:
        raise ConfigError(
            f"cannot make a '{place.suffix or place.name}'", where="--save", hint=f"it ends in {', '.join(known)}"
        )
    if not place.absolute().parent.is_dir():
        raise ConfigError("no such folder", where=str(place.absolute().parent))


def _lab(wanted: Tryout) -> Lab:
    if wanted.fleet is not None:
        return Lab(wanted.fleet, seed=wanted.seed)
    return Lab(robots=wanted.robots, bounds=(0.0, 0.0, wanted.size_m, wanted.size_m), seed=wanted.seed)


def _request(lab: Lab, wanted: Tryout) -> LabRequest:
    parameters: dict[str, Any] = {**wanted.parameters}
    for name in ("behaviour", "robots", "filtered", "twist"):
        if name in parameters:
            raise ConfigError(f"no parameter can be called '{name}'", where="parameters", hint="options begin with --")
    if wanted.file is None:
        return lab.request(
            wanted.behaviour, filtered=None if wanted.filtered else False, twist=wanted.twist, **parameters
        )
    sys.path.insert(0, str(wanted.file.absolute().parent))  # as for `python FILE.py`: it may import its neighbours
    return lab.request(wanted.file, filtered=wanted.filtered, twist=wanted.twist, **parameters)


def _in_words(failed: BehaviourFailed, time_s: float, wanted: Tryout) -> ConfigError:
    """Return the failure of a control law with the line of its file."""
    cause = failed.__cause__
    where = registry.line_of(cause, wanted.file.absolute()) if wanted.file is not None and cause else wanted.behaviour
    what = (
        cause.what if isinstance(cause, ConfigError) else f"{type(cause).__name__}: {cause}" if cause else failed.what
    )
    return ConfigError(what, where=where, hint=f"after {time_s:.3g} s")


def _draw(lab: Lab, place: Path, caption: str, speed: float) -> None:
    if place.suffix.lower() in FILM_ENDINGS:
        lab.animate(caption, speed=speed).save(place)
    else:
        lab.plot(caption).save(place)


def _print(lab: Lab, request: LabRequest, *, as_json: bool) -> None:
    metrics = lab.metrics
    results = {robot: {"outcome": each.outcome, "text": each.text} for robot, each in request.result.items()}
    if as_json:
        output.data_json({"time_s": lab.time_s, "metrics": metrics, "results": results})
        return
    with_goals = "formation.error_m" in metrics
    table = output.plain_table("metric", "", numbers=("value",))
    table.add_column("")
    for name, text in SHOWN.items():
        if name in metrics and (with_goals or name != "arrival.fraction"):
            table.add_row(name, text, f"{metrics[name]:.3g}", unit_of(name))
    output.data_table(table)
    for robot, each in results.items():
        output.data(f"{robot}: {each['outcome']}{', ' if each['text'] else ''}{each['text']}")
