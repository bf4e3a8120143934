"""The trials of an experiment: every cell with every seed, in the order of the file."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import Any, TypeVar, get_args

import msgspec

from fullswarm.agent.safety.startup import check_stopping
from fullswarm.bus.network_faults import parse_network
from fullswarm.config import EngineName, SwarmConfig, WorldConfig
from fullswarm.drivers.sim.settings import describe
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.experiment.model import (
    Experiment,
    Group,
    Parameter,
    Requested,
    Small,
    parse_seeds,
    world_settings,
)
from fullswarm.evaluate.scenarios import Scenario, load_scenario
from fullswarm.fitness import ANYTHING, needs_of
from fullswarm.messages import Needs

T = TypeVar("T")
Settings = tuple[tuple[str, Parameter], ...]
"""Names and values; a tuple, so that a cell can be the key of a dictionary."""
Parameters = tuple[tuple[str, Requested], ...]
NeedsTable = tuple[tuple[str, float | tuple[str, ...]], ...]
"""What differs from `Needs()`, in the order of its fields."""
Roles = tuple[tuple[str, tuple[str, ...]], ...]
"""Roles and who has them: r0, r1, … or +capability."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One combination; its trials differ by the seed alone."""

    group: str
    behaviour: str
    parameters: Parameters
    scenario: str
    robots: int
    engine: str
    limits: str
    network: str = ""
    noise_m: float = 0.0
    noise_rad: float = 0.0
    collisions_expected: bool = False
    team: str = ""  # as in a request: empty: as the behaviour's record says
    needs: NeedsTable = ()
    roles: Roles = ()

    @property
    def label(self) -> str:
        """The behaviour with its parameters and the other terms of its request, for people."""
        terms = {"team": self.team} if self.team else {}
        words = (*self.parameters, *terms.items(), *self._terms())
        return " ".join((self.behaviour, *(f"{name}={_words(value)}" for name, value in words)))

    def _terms(self) -> tuple[tuple[str, float | tuple[str, ...]], ...]:
        """Return needs and roles, each with a name of its own."""
        needs = ((f"needs.{name}", value) for name, value in self.needs)
        return (*needs, *((f"roles.{role}", names) for role, names in self.roles))

    def requested(self) -> dict[str, Any]:
        """Return the parameters as a request and a TOML file have them: points are lists."""
        found: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(dict(self.parameters)))
        return found

    def fields(self) -> dict[str, Requested | tuple[str, ...]]:
        """Return what a filter can match."""
        plain = (name for name in self.__slots__ if name not in ("parameters", "needs", "roles"))
        return {**dict(self.parameters), **{name: getattr(self, name) for name in plain}, **dict(self._terms())}


def _words(value: Requested | tuple[float, float] | tuple[str, ...]) -> str:
    """Return a value for people; of points ``3 16, 9 4``, of names ``r0 r1``."""
    if not isinstance(value, tuple):
        return str(value)
    points = any(isinstance(each, tuple) for each in value)
    words = (f"{each:g}" if isinstance(each, int | float) else _words(each) for each in value)
    return (", " if points else " ").join(words)


@dataclass(frozen=True, slots=True)
class Trial:
    """What one run needs to know; everything, so that any process can run it."""

    cell: Cell
    seed: int
    time_limit_s: float | None  # None: the scenario's
    body: Settings  # of the world
    agent: Settings  # of the agents
    stop: Settings = ()  # termination conditions, as in a fleet file's table [performance]
    bodies: tuple[Settings, ...] = ()  # which the robots have in turn, where they differ; the first is `body`
    sight: Settings = ()  # of the world, where it differs from the usual one
    arena: str = ""  # the scenario as JSON: its file may change or be elsewhere; empty: the cell's, by its name

    @property
    def label(self) -> str:
        """Its name in progress and error lines."""
        cell = self.cell
        words = (cell.label, cell.scenario, f"N={cell.robots}", cell.engine, cell.limits, cell.network)
        return " ".join((*filter(None, words), f"seed {self.seed}"))


def differ_by_group(cells: Iterable[Cell]) -> bool:
    """Tell whether some cells differ by their group alone: by settings of agents, ends or time limits."""
    distinct = {(each.group, replace(each, group="", collisions_expected=False)) for each in cells}
    return len({each for _, each in distinct}) < len(distinct)


def plan(
    experiment: Experiment,
    seeds: tuple[int, ...] | None = None,
    cells: tuple[str, ...] = (),
    small: bool = False,
    engine: str | None = None,
) -> list[Trial]:
    """Return the trials.

    Parameters
    ----------
    seeds : instead of the file's
    cells : filters, all of which must hold: a word that any field of a cell equals, or ``field=value``; several
        may stand in one text with commas, ``*`` and ``?`` fit anything
    small : only what the file's table ``[small]`` leaves
    engine : instead of all groups' engines

    Raises
    ------
    ConfigError
        A filter names no field, nothing is left, a scenario's file is wrong, the engine is unknown, or the robots of a
        group cannot stop in time.
    """
    if engine is not None and engine not in get_args(EngineName):
        raise ConfigError(
            f"unknown engine '{engine}'", where="--engine", hint=did_you_mean(engine, get_args(EngineName))
        )
    shrunk = experiment.small if small else None
    wanted = seeds or parse_seeds(shrunk.seeds if shrunk else experiment.seeds)
    filters = [part.strip() for text in cells for part in text.split(",") if part.strip()]
    trials, names, arena = [], set[str](), cache(arena_of)
    for group in experiment.groups:
        stop = tuple(group.stop.model_dump(exclude_defaults=True).items())
        sight = tuple(group.sight.model_dump(exclude_defaults=True).items())
        for cell in _cells(group, shrunk, engine):
            fields = cell.fields()
            names |= fields.keys()
            if all(fits(fields, each) for each in filters):
                bodies = _bodies(experiment, cell.limits)
                agent = tuple(group.agent.items())
                few = wanted[: group.seeds_at_most]
                mixed = bodies if len(bodies) > 1 else ()
                settings = group.time_limit_s, bodies[0], agent, stop, mixed, sight, arena(cell.scenario)
                trials += [Trial(cell, seed, *settings) for seed in few]
    for each in filters:
        field, equals, _ = each.partition("=")
        if equals and field not in names:
            raise ConfigError(f"no cell has a '{field}'", where=f"--cells {each}", hint=did_you_mean(field, names))
    for first in {(each.cell.group, each.cell.limits): each for each in trials if each.cell.robots > 1}.values():
        _check_stopping(first)
    if not trials:
        raise ConfigError(f"no cell of '{experiment.name}' fits", where=f"--cells {','.join(filters)}")
    return trials


def _check_stopping(trial: Trial) -> None:
    """Refuse a trial whose robots cannot stop in time: its agents would, one after the other."""
    bodies = trial.bodies or (trial.body,)
    descriptions = [describe(world_of(replace(trial, body=body))) for body in bodies]
    config = SwarmConfig.model_validate(
        {
            "world": world_of(trial).model_dump(),
            "agent": dict(trial.agent),
            "network": {"conditions": trial.cell.network or None},
        }
    )
    check_stopping(config, descriptions, where=f"group '{trial.cell.group}', limits '{trial.cell.limits}': agent")


def _bodies(experiment: Experiment, limits: str) -> tuple[Settings, ...]:
    """Return the settings of the bodies that a name of limits, or of a mix of them, stands for."""
    names = experiment.mixes.get(limits, (limits,))
    return tuple(tuple(experiment.limits[name].model_dump(exclude_none=True).items()) for name in names)


def on_network(experiment: Experiment, conditions: str) -> Experiment:
    """Return the experiment with these conditions of the network in all its groups; empty: a good one.

    Raises
    ------
    ConfigError
        They are wrong.
    """
    if conditions:
        parse_network(conditions, where="--network")
    groups = tuple(group.model_copy(update={"network": conditions}) for group in experiment.groups)
    return experiment.model_copy(update={"groups": groups})


def _cells(group: Group, small: Small | None, engine: str | None) -> list[Cell]:
    if small and small.groups is not None and group.name not in small.groups:
        return []
    return [
        Cell(
            group=group.name,
            behaviour=behaviour.name,
            parameters=tuple(behaviour.parameters.items()),
            scenario=scenario,
            robots=robots,
            engine=each,
            limits=limits,
            network=group.network,
            noise_m=group.noise.position_m,
            noise_rad=group.noise.heading_rad,
            collisions_expected=group.collisions_expected or behaviour.collisions_expected,
            team=_first(behaviour.team, group.team) or "",
            needs=_needs(_first(behaviour.needs, group.needs) or {}),
            roles=tuple((_first(behaviour.roles, group.roles) or {}).items()),
        )
        for each, limits, behaviour, scenario, robots in product(
            group.engines if engine is None else (engine,),
            group.limits,
            group.behaviours,
            group.scenarios,
            group.robots,
        )
        if small is None or (robots <= small.robots_at_most and (engine is not None or each in small.engines))
    ]


def _needs(given: dict[str, Any]) -> NeedsTable:
    needs = needs_of(given)
    values = ((name, getattr(needs, name)) for name in Needs.__struct_fields__)
    return tuple((name, value) for name, value in values if value != getattr(ANYTHING, name))


def _first(own: T | None, usual: T | None) -> T | None:
    return usual if own is None else own


def fits(fields: Mapping[str, object], text: str) -> bool:
    """Return whether a cell's fields fit a filter: ``field=pattern``, or a pattern that any field fits."""
    name, equals, pattern = text.partition("=")
    if equals:
        return name in fields and fnmatch.fnmatchcase(str(fields[name]), pattern)
    return any(fnmatch.fnmatchcase(str(value), text) for value in fields.values())


def world_of(trial: Trial) -> WorldConfig:
    """Return the world of a trial, still without a scenario."""
    cell = trial.cell
    noise = {"position_m": cell.noise_m, "heading_rad": cell.noise_rad}
    settings = {"engine": cell.engine, "noise": noise, "sight": dict(trial.sight), "seed": trial.seed}
    return WorldConfig.model_validate({**world_settings(dict(trial.body)), **settings})


def arena_of(scenario: str) -> str:
    """Return a scenario, by name or path, as the text that a trial carries; `ConfigError` as `load_scenario`."""
    return load_scenario(scenario).model_dump_json(exclude_none=True)


def scenario_of(trial: Trial) -> Scenario:
    """Return the scenario of a trial; `ConfigError` as `load_scenario` when the trial does not carry it."""
    if not trial.arena:
        return load_scenario(trial.cell.scenario)
    return Scenario.model_validate_json(trial.arena, strict=True)
