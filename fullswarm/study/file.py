"""Reads study files: all errors at once, each with its line.

::

    name = "filter"
    participants = 12                    # P01 to P12; or codes of your own: ["K7", "M2"]
    order = "williams"                   # or "latin", "random"
    seed = 1
    fleet = "hall.toml"                  # of each condition that names none; relative to this file
    duration_s = 300.0
    briefing = "You operate eight robots ..."
    consent = "I have read the information and take part of my own will."
    task = "Keep as much of the hall covered as you can."
    tlx = "weighted"                     # or "raw", "off"

    [[conditions]]
    name = "filtered"                    # never shown before `fullswarm study unblind`
    set = ["agent.safety_margin_m=0.1"]  # settings of the fleet, as --set
    network = "loss=10%"                 # as --network
    behaviours = ["move_to_goal_bc"]     # those that the console offers; default: all
    hide = ["charts"]                    # panels of the console that are not shown
    request = { behaviour = "flocking_bc" }  # sent when the trial begins; or: mission = "survey.toml"

    [[probes]]
    name = "stopped"
    question = "How many robots are stopped?"
    at_s = [60.0, 180.0]
    freeze = true                        # simulated worlds stand still meanwhile
    truth = "stopped"                    # what is counted; or: choices = [...], correct = "..."
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from pydantic import Field, ValidationError, field_validator
from pydantic_core import ErrorDetails

from fullswarm.config import SwarmConfig
from fullswarm.config.mission_file import load_mission
from fullswarm.config.models import Section
from fullswarm.config.suggestions import unknown_key
from fullswarm.config.toml_errors import (
    KeyPath,
    dotted,
    explain,
    line_numbers,
    own_errors,
    parse_toml,
    read_toml,
    validated,
)
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import ConfigError, FullswarmError, did_you_mean
from fullswarm.launch.network import with_network
from fullswarm.messages import MissionPlan, Value
from fullswarm.operator.console.study import COUNTS, RUNNING, Panel, Probe, StartRequest, Tlx
from fullswarm.study.order import Order

SWARM = "study"
"""Name of the swarm in every condition: the page shows it, and a name of the fleet file could tell the condition.

Only robots whose agents run on computers of their own keep theirs.
"""
_CODE = re.compile(r"[A-Za-z0-9_-]{1,32}\Z")
MOST = 1000


class RequestSection(Section):
    """A request that is sent when the trial begins."""

    behaviour: str = Field(min_length=1, max_length=64)
    robots: tuple[str, ...] = ()
    parameters: dict[str, Any] = Field(default_factory=dict)


class ConditionSection(Section):
    """A condition."""

    name: str = Field(min_length=1, max_length=64)
    fleet: Path | None = None
    set: tuple[str, ...] = ()
    network: str | None = None
    mission: Path | None = None
    request: RequestSection | None = None
    behaviours: tuple[str, ...] = ()
    hide: tuple[Panel, ...] = ()


class ProbeSection(Section):
    """A question about the situation, asked during the trial."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]{1,32}$")
    question: str = Field(min_length=1, max_length=300)
    at_s: tuple[float, ...] = Field(min_length=1, max_length=32)
    freeze: bool = False
    truth: str = ""
    choices: tuple[str, ...] = Field((), max_length=8)
    correct: str = ""
    tolerance: float = Field(0.0, ge=0.0)
    timeout_s: float = Field(60.0, gt=0.0, le=600.0)

    @field_validator("truth")
    @classmethod
    def _known(cls, truth: str) -> str:
        if truth and truth not in COUNTS and not truth.startswith(RUNNING):
            raise ValueError(f"nothing is counted as '{truth}': {', '.join(COUNTS)}, or 'running BEHAVIOUR'")
        return truth


class MeasuresSection(Section):
    """How measures are computed, see ``measures.py``."""

    gap_s: float = Field(3.0, gt=0.0, le=60.0)
    least_s: float = Field(0.5, ge=0.0, le=10.0)
    window_s: float = Field(2.0, gt=0.0, le=60.0)
    speed_m_s: float = Field(0.1, gt=0.0, le=10.0)
    threshold: float = Field(0.5, gt=0.0, le=1.0)


class StudySection(Section):
    """A study file."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")
    participants: int | tuple[str, ...]
    order: Order = "williams"
    seed: int = 1
    fleet: Path | None = None
    duration_s: float = Field(gt=0.0, le=7200.0)
    briefing: str = Field("", max_length=8000)
    consent: str = Field("", max_length=2000)
    task: str = Field(min_length=1, max_length=500)
    tlx: Tlx = "weighted"
    conditions: tuple[ConditionSection, ...] = Field(min_length=1, max_length=26)
    probes: tuple[ProbeSection, ...] = Field((), max_length=64)
    measures: MeasuresSection = MeasuresSection()

    @property
    def codes(self) -> tuple[str, ...]:
        """The participants' codes."""
        if isinstance(self.participants, int):
            return tuple(f"P{number:02}" for number in range(1, self.participants + 1))
        return self.participants


@dataclass(frozen=True, slots=True)
class StudyFile:
    """A study as read."""

    section: StudySection
    path: Path
    text: str

    def fleet(self, condition: ConditionSection) -> SwarmConfig:
        """Return the swarm of a condition; raises `ConfigError`."""
        file = condition.fleet or self.section.fleet
        if file is None:
            raise ConfigError("no fleet file", hint='write fleet = "FILE.toml" in the condition or at the top')
        config = with_network(load_fleet(self.path.parent / file, condition.set, here=True), condition.network)
        away = any(robot.elsewhere for robot in config.robot)
        return config if away else config.model_copy(update={"swarm": SWARM})

    def mission(self, condition: ConditionSection) -> MissionPlan | None:
        """Return the plan of a condition's mission; raises `ConfigError`."""
        return None if condition.mission is None else load_mission(self.path.parent / condition.mission).plan

    def probes(self) -> tuple[Probe, ...]:
        """Return each asking of each probe, by time."""
        asked = [
            Probe(
                name=each.name, at_s=at_s, question=each.question, freeze=each.freeze, truth=each.truth,
                choices=each.choices, correct=each.correct, tolerance=each.tolerance, timeout_s=each.timeout_s,
            )
            for each in self.section.probes
            for at_s in each.at_s
        ]  # fmt: skip
        return tuple(sorted(asked, key=lambda probe: probe.at_s))


def load_study(path: Path) -> StudyFile:
    """Read a study file.

    Raises
    ------
    ConfigError
        All that is wrong with the file itself, each as ``file:line: key: what``. Fleets are read by
        :func:`check_fleets`.
    """
    text = read_toml(path, "study file")
    data, lines = parse_toml(text, str(path)), line_numbers(text)
    try:
        section = validated(StudySection, data)
    except ValidationError as error:
        found = [_explained(each) for each in own_errors(error.errors(include_url=False))]
        raise _error(path, lines, found) from None
    if problems := list(_problems(section)):
        raise _error(path, lines, problems)
    return StudyFile(section, path, text)


def check_fleets(study: StudyFile) -> None:
    """Read the fleet and the mission of every condition.

    Raises
    ------
    ConfigError
        All that is wrong, each with the line of its condition.
    """
    lines = line_numbers(study.text)
    found: list[tuple[KeyPath, str]] = []
    for number, condition in enumerate(study.section.conditions):
        for key, read in (("fleet", study.fleet), ("mission", study.mission)):
            try:
                read(condition)
            except FullswarmError as error:
                path = ("conditions", number, key)
                found.append((path, str(error).replace("\n", "; ")))
    if found:
        raise _error(study.path, lines, found)


def _explained(details: ErrorDetails) -> tuple[KeyPath, str]:
    """Explain an error with the table that it is in."""
    path = tuple(details["loc"])
    if path[:1] == ("participants",):
        return ("participants",), "must be a number of participants, or a list of their codes"
    schema: type[Section] = StudySection
    for part, table in (
        ("conditions", ConditionSection), ("request", RequestSection), ("probes", ProbeSection),
        ("measures", MeasuresSection),
    ):  # fmt: skip
        if part in path[:-1]:
            schema = table
    if details["type"] == "extra_forbidden":
        return path, unknown_key(str(path[-1]), schema.model_fields, schema.__name__)
    return explain(details, schema)


def _error(path: Path, lines: Mapping[KeyPath, int], found: list[tuple[KeyPath, str]]) -> ConfigError:
    complaints = set[tuple[int, str]]()
    for key, what in found:
        line = next((lines[key[:end]] for end in range(len(key), 0, -1) if key[:end] in lines), 0)
        place = f"{path}:{line}" if line else str(path)
        complaints.add((line, f"{place}: {dotted(key)}: {what}"))
    return ConfigError("\n".join(complaint for _, complaint in sorted(complaints)))


def _problems(section: StudySection) -> Iterator[tuple[KeyPath, str]]:
    """Tell what the fields alone do not: names that are given twice, and parts that do not go together."""
    if isinstance(section.participants, int) and not 1 <= section.participants <= MOST:
        yield ("participants",), f"must be 1 to {MOST}"
    if not section.codes or len(section.codes) > MOST:
        yield ("participants",), f"must be 1 to {MOST} codes"
    for code in section.codes:
        if not _CODE.match(code):
            yield ("participants",), f"'{code:.40}' is no code: letters, digits, '-' and '_', 32 at most; not a name"
    if len(set(section.codes)) < len(section.codes):
        yield ("participants",), "a code is given twice"
    names = [each.name for each in section.conditions]
    for number, condition in enumerate(section.conditions):
        at: KeyPath = ("conditions", number)
        if condition.name in names[:number]:
            yield (*at, "name"), "another condition has this name"
        if condition.fleet is None and section.fleet is None:
            yield at, 'has no fleet: write fleet = "FILE.toml" here or at the top'
        if condition.mission is not None and condition.request is not None:
            yield at, "has a mission and a request: one of them begins the trial"
        if condition.request is not None:
            try:
                start_request(condition)
            except msgspec.ValidationError as error:
                yield (*at, "request"), str(error)
    for number, probe in enumerate(section.probes):
        yield from ((("probes", number, key), text) for key, text in _probe_problems(probe, section, number))


def _probe_problems(probe: ProbeSection, section: StudySection, number: int) -> Iterator[tuple[str, str]]:
    if any(each.name == probe.name for each in section.probes[:number]):
        yield "name", "another probe has this name"
    if not all(0.0 < at_s < section.duration_s for at_s in probe.at_s):
        yield "at_s", f"must lie within the trial, 0 to {section.duration_s:g} s"
    if probe.truth and (probe.choices or probe.correct):
        yield "truth", "is a number that is counted: leave out choices and correct"
    if probe.choices and not 2 <= len(set(probe.choices)) == len(probe.choices):
        yield "choices", "must be at least two, each once"
    if probe.correct and probe.choices and probe.correct not in probe.choices:
        yield "correct", f"is none of the choices, {did_you_mean(probe.correct, probe.choices)}"
    if probe.correct and not probe.choices:
        try:
            float(probe.correct)
        except ValueError:
            yield "correct", "must be a number in quotes, or write choices"


def start_request(condition: ConditionSection) -> StartRequest | None:
    """Return the request that begins a trial; raises msgspec's `ValidationError`."""
    if condition.request is None:
        return None
    given = condition.request
    parameters = msgspec.convert(given.parameters, dict[str, Value])
    return StartRequest(behaviour=given.behaviour, robots=given.robots, parameters=parameters)
