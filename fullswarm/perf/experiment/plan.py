"""The trials of an experiment: every cell with every seed, in the order of the file."""

from __future__ import annotations

import fnmatch
from dataclasses import asdict, dataclass
from itertools import product

from fullswarm.config import WorldConfig
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.perf.experiment.model import Experiment, Group, Parameter, Small, parse_seeds

Settings = tuple[tuple[str, Parameter], ...]
"""Names and values; a tuple, so that a cell can be the key of a dictionary."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One combination; its trials differ by the seed alone."""

    group: str
    behaviour: str
    parameters: Settings
    scenario: str
    robots: int
    engine: str
    limits: str
    network: str = ""
    noise_m: float = 0.0
    noise_rad: float = 0.0

    @property
    def label(self) -> str:
        """The behaviour with its parameters, for people."""
        return " ".join((self.behaviour, *(f"{name}={value}" for name, value in self.parameters)))

    def fields(self) -> dict[str, Parameter]:
        """Return what a filter can look at."""
        fields: dict[str, Parameter] = asdict(self)
        del fields["parameters"]
        return {**dict(self.parameters), **fields}


@dataclass(frozen=True, slots=True)
class Trial:
    """What one run needs to know; everything, so that any process can run it."""

    cell: Cell
    seed: int
    time_limit_s: float | None  # None: the scenario's
    body: Settings  # of the world
    agent: Settings  # of the agents

    @property
    def label(self) -> str:
        """Its name in progress and error lines."""
        cell = self.cell
        words = (cell.label, cell.scenario, f"N={cell.robots}", cell.engine, cell.limits, cell.network)
        return " ".join((*filter(None, words), f"seed {self.seed}"))


def plan(
    experiment: Experiment, seeds: tuple[int, ...] | None = None, cells: tuple[str, ...] = (), small: bool = False
) -> list[Trial]:
    """Return the trials.

    Parameters
    ----------
    seeds : instead of the file's
    cells : filters, all of which must hold: a word that any field of a cell equals, or ``field=value``; several
        may stand in one text with commas, ``*`` and ``?`` fit anything
    small : only what the file's table ``[small]`` leaves

    Raises
    ------
    ConfigError
        A filter names no field, or nothing is left.
    """
    shrunk = experiment.small if small else None
    wanted = seeds or parse_seeds(shrunk.seeds if shrunk else experiment.seeds)
    filters = [part.strip() for text in cells for part in text.split(",") if part.strip()]
    trials, names = [], set[str]()
    for group in experiment.groups:
        for cell in _cells(group, shrunk):
            fields = cell.fields()
            names |= fields.keys()
            if all(_fits(fields, each) for each in filters):
                body = tuple(experiment.limits[cell.limits].model_dump().items())
                agent = tuple(group.agent.items())
                few = wanted[: group.seeds_at_most]
                trials += [Trial(cell, seed, group.time_limit_s, body, agent) for seed in few]
    for each in filters:
        field, equals, _ = each.partition("=")
        if equals and field not in names:
            raise ConfigError(f"no cell has a '{field}'", where=f"--cells {each}", hint=did_you_mean(field, names))
    if not trials:
        raise ConfigError(f"no cell of '{experiment.name}' fits", where=f"--cells {','.join(filters)}")
    return trials


def _cells(group: Group, small: Small | None) -> list[Cell]:
    if small and small.groups is not None and group.name not in small.groups:
        return []
    return [
        Cell(
            group=group.name,
            behaviour=behaviour.name,
            parameters=tuple(behaviour.parameters.items()),
            scenario=scenario,
            robots=robots,
            engine=engine,
            limits=limits,
            network=group.network,
            noise_m=group.noise.position_m,
            noise_rad=group.noise.heading_rad,
        )
        for engine, limits, behaviour, scenario, robots in product(
            group.engines, group.limits, group.behaviours, group.scenarios, group.robots
        )
        if small is None or (robots <= small.robots_at_most and engine in small.engines)
    ]


def _fits(fields: dict[str, Parameter], text: str) -> bool:
    name, equals, pattern = text.partition("=")
    if equals:
        return name in fields and fnmatch.fnmatchcase(str(fields[name]), pattern)
    return any(fnmatch.fnmatchcase(str(value), text) for value in fields.values())


def world_of(trial: Trial) -> WorldConfig:
    """Return the world of a trial, still without a scenario."""
    cell = trial.cell
    noise = {"position_m": cell.noise_m, "heading_rad": cell.noise_rad}
    return WorldConfig.model_validate({**dict(trial.body), "engine": cell.engine, "noise": noise, "seed": trial.seed})
