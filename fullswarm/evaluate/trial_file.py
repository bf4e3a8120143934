"""``trial.toml``: all that is needed to run one trial again, alone; it holds the scenario, too."""

from __future__ import annotations

import json
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import tomlkit
from pydantic import ValidationError

from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.model import Parameter
from fullswarm.evaluate.experiment.plan import Cell, Trial, scenario_of
from fullswarm.evaluate.experiment.record import TRIAL_FILE, trial_id
from fullswarm.evaluate.scenarios import Scenario

FORMAT = "fullswarm.launch/1"
HEAD = "# Runs one trial again: fullswarm experiment trial trial.toml\n"

Table = dict[str, Parameter]


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


def launch_text(trial: Trial, experiment: str) -> str:
    """Return the file of a trial; `ConfigError` when its scenario cannot be read."""
    cell = asdict(trial.cell)
    cell["parameters"] = dict(trial.cell.parameters)  # last in the file: a table within a table
    head: dict[str, Any] = {"format": FORMAT, "id": trial_id(trial), "experiment": experiment, "seed": trial.seed}
    if trial.time_limit_s is not None:
        head["time_limit_s"] = trial.time_limit_s
    settings = {name: dict(getattr(trial, name)) for name in ("body", "agent", "stop")}
    try:
        arena = {"scenario": json.loads(trial.arena or _arena(scenario_of(trial)))}
    except ConfigError:
        arena = {"scenario": {"name": trial.cell.scenario}}  # that is why it failed
    return HEAD + tomlkit.dumps({**head, "cell": cell, **settings, **arena})


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
        document = msgspec.convert(tomllib.loads(text), _Document)
        if document.format != FORMAT:
            raise ConfigError(f"format '{document.format}' is not {FORMAT}", where=where)
        cell = {**document.cell, "parameters": list(dict(document.cell.get("parameters", {})).items())}
        trial = Trial(
            cell=msgspec.convert(cell, Cell),
            seed=document.seed,
            time_limit_s=document.time_limit_s,
            body=tuple(document.body.items()),
            agent=tuple(document.agent.items()),
            stop=tuple(document.stop.items()),
            arena=_arena(Scenario.model_validate_json(json.dumps(document.scenario), strict=True)),
        )
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"not valid TOML: {error}", where=where) from error
    except (msgspec.ValidationError, ValidationError, TypeError, ValueError) as error:
        raise ConfigError(f"not the file of a trial: {error}", where=where) from error
    return Launch(document.experiment, trial)


def _arena(scenario: Scenario) -> str:
    return scenario.model_dump_json(exclude_none=True)
