"""What an experiment is, and how its file is read."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from fullswarm.bus.network_faults import parse_network
from fullswarm.config import (
    AgentConfig,
    DrivetrainConfig,
    EngineName,
    NoiseConfig,
    PerformanceConfig,
    Section,
    SightConfig,
    WorldConfig,
)
from fullswarm.config.toml_errors import KeyPath, dotted, line_numbers, parse_section
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.scenarios.model import package_names, read_named, scenario_names
from fullswarm.fitness import needs_of

EvidenceMode = Literal["always", "contacts", "never"]
"""Of which trials the motion is kept: of all, of those with a contact, or of none."""
Parameter = bool | int | float | str
Requested = bool | int | float | str | tuple[float | tuple[float, float], ...]
"""A parameter of a request: also a point or a list of points, as tuples so that cells can be keys of a dictionary."""
T = TypeVar("T")
TEAMS, TERMS = ("request", "swarm"), ("team", "needs", "roles")
LARGEST_SEED, MOST_SEEDS = 2**63 - 1, 100_000
"""What a file of results can hold, and a table of trials."""


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds that ``"7"`` or ``"0-19"`` names; anything else is a ``ValueError``."""
    first, dash, last = text.partition("-")
    if not (first.isdecimal() and (last.isdecimal() if dash else not last)):
        raise ValueError(f"'{text}' is no range of seeds: write 7 or 0-19")
    least, most = int(first), int(last or first)
    if least > most:
        raise ValueError(f"'{text}' holds no seed: the smaller one comes first")
    if most > LARGEST_SEED:
        raise ValueError(f"the largest seed is {LARGEST_SEED}, not {most}")
    if most - least >= MOST_SEEDS:
        raise ValueError(f"'{text}' holds {most - least + 1} seeds: {MOST_SEEDS} at most")
    return tuple(range(least, most + 1))


def _seeds(text: str) -> str:
    parse_seeds(text)
    return text


Seeds = Annotated[str, AfterValidator(_seeds)]


ROBOT = re.compile(r"r(0|[1-9][0-9]*)\Z")
"""A robot in an experiment file, by its place in a trial; a trial's robots have its seed in their names."""


def robot_place(name: str) -> int | None:
    """Return the place of the robot that an experiment file calls `name`; None: it names none."""
    found = ROBOT.match(name)
    return int(found[1]) if found else None


def _check_network(text: str) -> None:
    try:
        parse_network(text, where="network")
    except ConfigError as error:
        raise ValueError(str(error)) from error


class Body(Section):
    """What the simulated robots can do; named in ``[limits.<name>]``."""

    speed_limit_m_s: PositiveFloat
    turn_limit_rad_s: PositiveFloat
    accel_limit_m_s2: PositiveFloat = 2.0
    turn_accel_limit_rad_s2: PositiveFloat = 20.0
    radius_m: PositiveFloat = 0.17
    declared_radius_m: PositiveFloat | None = None  # what the robots state; None: `radius_m`
    # Of the engine "drivetrain", as in `DrivetrainConfig`; None: its defaults.
    dead_time_s: NonNegativeFloat | None = None
    lag_s: NonNegativeFloat | None = None
    slip: NonNegativeFloat | None = None
    unequal_wheels: NonNegativeFloat | None = None
    brakes: PositiveFloat | None = None
    declared: bool | None = None

    @model_validator(mode="after")
    def _fits_a_world(self) -> Self:
        WorldConfig.model_validate(world_settings(self.model_dump(exclude_none=True)))
        return self


def world_settings(body: Mapping[str, Parameter]) -> dict[str, object]:
    """Return the settings of a `Body` as those of a world, or of one robot's body in it."""
    drivetrain = {name: value for name, value in body.items() if name in DrivetrainConfig.model_fields}
    others: dict[str, object] = {name: value for name, value in body.items() if name not in drivetrain}
    return {**others, "drivetrain": drivetrain} if drivetrain else others


def _team(name: str) -> str:
    if name not in TEAMS:
        raise ValueError(f"the robots of a trial have {' or '.join(TEAMS)}, and no groups; {did_you_mean(name, TEAMS)}")
    return name


def _role_holder(name: str) -> str:
    capability = name.startswith("+") and len(name) > 1
    if not capability and robot_place(name) is None:
        raise ValueError(f"'{name:.64}' names no robot of a trial: write r0, r1, … or +capability")
    return name


class RequestTerms(Section):
    """What a request says beside its parameters, as in `fullswarm.messages.BehaviourRequest`; None: nothing."""

    team: Annotated[str, AfterValidator(_team)] | None = None  # robots that the law counts as neighbours
    needs: dict[str, Any] | None = None  # robots that cannot are left out
    roles: dict[str, tuple[Annotated[str, AfterValidator(_role_holder)], ...]] | None = Field(None, max_length=64)

    @field_validator("needs")
    @classmethod
    def _known_needs(cls, given: dict[str, Any] | None) -> dict[str, Any] | None:
        try:
            needs_of(given or {}, where="")
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return given

    @model_serializer(mode="wrap")
    def _only_what_is_said(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what is unsaid: a file without these keys is the same version of an experiment as ever."""
        return {key: value for key, value in serialize(self).items() if value is not None or key not in TERMS}

    def places(self) -> set[int]:
        """Return the places of the robots that the roles name."""
        found = (robot_place(name) for names in (self.roles or {}).values() for name in names)
        return {each for each in found if each is not None}


class Behaviour(RequestTerms):
    """A behaviour and the parameters of its request, besides the goal; its terms count before those of the group."""

    name: str = Field(min_length=1)
    parameters: dict[str, Requested] = Field(default_factory=dict)
    collisions_expected: bool = False  # they do not make the experiment fail, e.g. without a filter


def _no_twins(values: tuple[T, ...]) -> tuple[T, ...]:
    """Refuse what would count each of its trials twice."""
    for place, value in enumerate(values):
        if value in values[:place]:
            raise ValueError(f"{value!r} is given twice")
    return values


def _no_twin_behaviours(values: tuple[Behaviour, ...]) -> tuple[Behaviour, ...]:
    known = [each.model_copy(update={"collisions_expected": False}) for each in values]
    for place, each in enumerate(known):
        if each in known[:place]:
            words = " ".join((each.name, *(f"{key}={value}" for key, value in each.parameters.items())))
            raise ValueError(f"'{words}' is given twice")
    return values


Unique = AfterValidator(_no_twins)


class Group(RequestTerms):
    """Cells: every combination of what is listed here."""

    name: str = Field(min_length=1)
    behaviours: Annotated[tuple[Behaviour, ...], Field(min_length=1), AfterValidator(_no_twin_behaviours)]
    scenarios: Annotated[tuple[str, ...], Field(min_length=1), Unique]
    robots: Annotated[tuple[PositiveInt, ...], Field(min_length=1), Unique]
    engines: Annotated[tuple[EngineName, ...], Field(min_length=1), Unique]
    limits: Annotated[tuple[str, ...], Field(min_length=1), Unique]
    time_limit_s: PositiveFloat | None = None  # None: the scenario's
    seeds_at_most: PositiveInt | None = None  # slow cells: only so many of the seeds
    noise: NoiseConfig = NoiseConfig()
    network: str = ""  # as in --network; the robots are called r0, r1, …
    sight: SightConfig = SightConfig()  # whether and how well robots see other bodies
    agent: dict[str, Parameter] = Field(default_factory=dict)  # settings of the agents that differ from the usual ones
    stop: PerformanceConfig = PerformanceConfig()  # ends a trial before its time limit, as the summarizers see it
    collisions_expected: bool = False  # of all behaviours

    @model_validator(mode="after")
    def _known(self) -> Self:
        known = scenario_names()
        for scenario in self.scenarios:
            if scenario not in known and not scenario.endswith(".toml"):
                raise ValueError(f"there is no scenario '{scenario}'; {did_you_mean(scenario, known)}")
        least = min(self.robots)
        terms: tuple[RequestTerms, ...] = (self, *self.behaviours)
        for place in sorted(place for each in terms for place in each.places()):
            if place >= least:
                raise ValueError(f"roles: there is no r{place} in a trial of {least} robots: r0 to r{least - 1}")
        AgentConfig.model_validate(self.agent)
        if self.network:
            _check_network(self.network)
        return self


class Small(Section):
    """What `--small` leaves of the experiment."""

    seeds: Seeds = "0"
    robots_at_most: PositiveInt = 10
    groups: tuple[str, ...] | None = None  # None: all
    engines: tuple[EngineName, ...] = ("kinematic", "pybullet")


class Experiment(Section):
    """An experiment file; immutable."""

    name: str = Field(min_length=1)
    description: str = ""
    seeds: Seeds
    limits: dict[str, Body] = Field(min_length=1)
    mixes: dict[str, Annotated[tuple[str, ...], Field(min_length=1)]] = Field(default_factory=dict)
    """Limits that robots have in turn: ``[mixes]``, a list of names of limits for each name of a mix."""
    groups: tuple[Group, ...] = Field(min_length=1)
    small: Small = Small()
    evidence: EvidenceMode = "contacts"  # whose motion is kept, to audit it

    @model_validator(mode="after")
    def _named(self) -> Self:
        for group in self.groups:
            for name in group.limits:
                if name not in self.limits and name not in self.mixes:
                    names = (*self.limits, *self.mixes)
                    raise ValueError(f"group '{group.name}': no [limits.{name}]; {did_you_mean(name, names)}")
        for mix, names in self.mixes.items():
            if mix in self.limits:
                raise ValueError(f"mixes: '{mix}' is also the name of [limits.{mix}]")
            for name in names:
                if name not in self.limits:
                    raise ValueError(f"mixes: '{mix}': no [limits.{name}]; {did_you_mean(name, self.limits)}")
        known = [group.name for group in self.groups]
        for name in (*(self.small.groups or ()), *(each for each in known if known.count(each) > 1)):
            if known.count(name) != 1:
                raise ValueError(f"there must be one group '{name}', not {known.count(name)}")
        return self


def experiment_names() -> tuple[str, ...]:
    """Return the names of the experiments that come with the package."""
    return package_names(resources.files(__package__))


def load_experiment(name_or_path: str | Path) -> Experiment:
    """Return an experiment of the package by its name, or one from a TOML file.

    Raises
    ------
    ConfigError
        No such experiment or file, or errors in it: all of them at once, with file and line.
    """
    text, where = read_named(name_or_path, resources.files(__package__), "experiment")
    return _with_scenarios(parse_experiment(text, where), text, where)


def _with_scenarios(experiment: Experiment, text: str, where: str) -> Experiment:
    """Return an experiment whose scenario files are looked for beside its own file, then in the present folder.

    Raises
    ------
    ConfigError
        Some are in neither: all of them, each with its line.
    """
    folder, lines, missing = Path(where).parent, line_numbers(text), list[str]()
    groups = []
    for number, group in enumerate(experiment.groups):
        found = []
        for index, name in enumerate(group.scenarios):
            places = (folder / name, Path(name)) if name.endswith(".toml") else ()
            there = next((place for place in places if place.is_file()), None)
            if places and there is None:
                path: KeyPath = ("groups", number, "scenarios", index)
                line = next((lines[path[:end]] for end in range(len(path), 0, -1) if path[:end] in lines), 1)
                looked = " and ".join(dict.fromkeys(str(place.absolute().parent) for place in places))
                missing.append(f"{where}:{line}: {dotted(path)}: no file '{name}', looked in {looked}")
            found.append(name if there is None else str(there))
        groups.append(group.model_copy(update={"scenarios": tuple(found)}))
    if missing:
        raise ConfigError("\n".join(missing))
    return experiment.model_copy(update={"groups": tuple(groups)})


def parse_experiment(text: str, where: str) -> Experiment:
    """Return the experiment that TOML `text` describes; `where` names it in errors.

    Raises
    ------
    ConfigError
        Not TOML, or not an experiment.
    """
    return parse_section(text, where, Experiment)
