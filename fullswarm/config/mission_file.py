"""Reads mission files, and checks a mission's plan as far as no swarm is needed: all errors at once, with their lines.

::

    name = "survey"

    [tracks.west]                        # tracks run at the same time
    robots = ["@west"]                   # of each step that names none; default: the whole swarm

    [[tracks.west.steps]]                # steps follow one another
    name = "out"                         # default: "step 1", "step 2", ...
    behaviour = "move_to_goal_bc"        # none: the robots stand, the track waits
    parameters = { goal = [8.0, 2.0] }
    team = "group"                       # which robots its law counts as neighbours; default: as its record says
    needs = { speed_m_s = 0.3 }          # robots that cannot are left out, or refused if they are named
    roles = { leader = ["r1"] }          # robots, "@groups" or "+capabilities" of each role
    done = { arrived = "all" }           # when = "all" | "any" of: arrived, time_s, metric, confirm
    after = ["east/out"]                 # steps of other tracks that must be over before it begins
    fail_after_s = 60.0
    on_failed = "pause"                  # or "abort", "continue"
    keep_running = false                 # true: its robots continue when it is done

``[[steps]]`` at the top is the short form of a single track, ``main``.
"""

from __future__ import annotations

import operator
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
from pydantic import Field, ValidationError, field_validator
from pydantic_core import ErrorDetails

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
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.fitness import needs_of
from fullswarm.keys import ROBOT_ID
from fullswarm.messages import (
    MissionPlan,
    MissionProblem,
    MissionStep,
    MissionTrack,
    Needs,
    StepConditions,
    Value,
)

MAIN = "main"
"""The track of a file that has only steps."""
MOST_STEPS = 256
GROUP = "@"
_NAME = re.compile(r"[^/\x00-\x1f]{1,64}\Z")
_COMPARISON = re.compile(r"\s*([a-z_0-9]+)\.([a-z_0-9]+)\s*(>=|<=|>|<)\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*\Z")
_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    ">": operator.gt,
    "<": operator.lt,
}


class Comparison(NamedTuple):
    """A metric compared with a number: ``coverage.fraction >= 0.8``."""

    metric: str
    quantity: str
    sign: str
    limit: float

    def holds(self, value: float) -> bool:
        """Tell whether `value` meets it; false for NaN."""
        return _OPERATORS[self.sign](value, self.limit)


def parse_comparison(text: str) -> Comparison:
    """Read a comparison.

    Raises
    ------
    ConfigError
        It is none.
    """
    found = _COMPARISON.match(text)
    try:
        if found:
            return Comparison(found[1], found[2], found[3], float(found[4]))
    except ValueError:
        pass
    raise ConfigError(f"'{text:.64}' is not a comparison", hint='e.g. "coverage.fraction >= 0.8"')


# ------------------------------------------------------------ the file
class DoneSection(Section):
    """``done``: when a step is over."""

    when: Literal["all", "any"] = "all"
    arrived: Literal["all", "any"] | None = None
    within_m: float = Field(0.0, ge=0.0, le=1e5)
    time_s: float | None = Field(None, ge=0.0, le=1e9)
    metric: str = Field("", max_length=64)
    confirm: str = Field("", max_length=500)


class StepSection(Section):
    """One step."""

    name: str = Field("", max_length=64)
    behaviour: str = Field("", max_length=64)
    robots: tuple[str, ...] | None = None
    parameters: dict[str, Any] = Field(default_factory=dict)
    team: str = Field("", max_length=65)
    needs: dict[str, Any] = Field(default_factory=dict)
    roles: dict[str, tuple[str, ...]] = Field(default_factory=dict, max_length=64)
    done: DoneSection = DoneSection()
    after: tuple[str, ...] = ()
    fail_after_s: float = Field(0.0, ge=0.0, le=1e9)
    on_failed: Literal["pause", "abort", "continue"] = "pause"
    keep_running: bool = False

    @field_validator("needs")
    @classmethod
    def _known(cls, given: dict[str, Any]) -> dict[str, Any]:
        try:
            needs_of(given, where="")
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return given

    @field_validator("parameters")
    @classmethod
    def _fit(cls, given: dict[str, Any]) -> dict[str, Any]:
        for name, value in given.items():
            try:
                msgspec.convert(value, Value)
            except msgspec.ValidationError:
                raise ValueError(f"{name} is not a flag, number, word, point or list of points") from None
        return given


class TrackSection(Section):
    """One track."""

    robots: tuple[str, ...] | None = None
    steps: tuple[StepSection, ...] = Field(min_length=1, max_length=MOST_STEPS)


class MissionSection(Section):
    """A mission file."""

    name: str = Field("", max_length=64)
    robots: tuple[str, ...] | None = None
    steps: tuple[StepSection, ...] = Field((), max_length=MOST_STEPS)
    tracks: dict[str, TrackSection] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class MissionFile:
    """A mission as read: its plan, and where each part of it is in the file."""

    plan: MissionPlan
    where: str
    lines: Mapping[KeyPath, int]

    def errors(self, problems: Iterable[MissionProblem]) -> ConfigError:
        """Return the error that names all `problems` with their lines."""
        return _error(self.where, self.lines, ((self._path(each), each.text) for each in problems))

    def _path(self, problem: MissionProblem) -> KeyPath:
        track = next((each for each in self.plan.tracks if each.name == problem.track), None)
        base: KeyPath = () if ("steps",) in self.lines else ("tracks", problem.track)
        names = [step.name for step in track.steps] if track else []
        if problem.step in names:
            base = (*base, "steps", names.index(problem.step))
        return (*base, *problem.key.split(".")) if problem.key else base


def load_mission(path: Path) -> MissionFile:
    """Read and check a mission file.

    Raises
    ------
    ConfigError
        It cannot be read, or something is wrong with it: all errors, each as ``file:line: key: what``.
    """
    text = read_toml(path, "mission file")
    return parse_mission(text, str(path), path.stem)


def parse_mission(text: str, where: str, name: str) -> MissionFile:
    """Read a mission from TOML `text`; `name` is used if the text has none. Raises as :func:`load_mission`."""
    return _read(parse_toml(text, where), line_numbers(text), where, name)


def read_mission(data: Mapping[str, Any]) -> MissionFile:
    """Read a mission from the tables of a mission file, in a program. Raises as :func:`load_mission`, without lines."""
    return _read(data, {("steps",): 0} if "steps" in data else {}, "mission", "mission")


def _read(data: Mapping[str, Any], lines: Mapping[KeyPath, int], where: str, name: str) -> MissionFile:
    try:
        section = validated(MissionSection, data)
    except ValidationError as error:
        found = (_explained(each) for each in own_errors(error.errors(include_url=False)))
        raise _error(where, lines, found) from None
    if bool(section.steps) == bool(section.tracks):
        what = "has both steps and tracks" if section.steps else "has no steps"
        raise ConfigError(
            what,
            where=f"{where}:1" if lines else where,
            hint="write [[steps]], or [[tracks.NAME.steps]] for several tracks",
        )
    tracks = {MAIN: TrackSection(steps=section.steps)} if section.steps else section.tracks
    plan = MissionPlan(
        name=section.name or name[:64],
        tracks=tuple(_track(each, track, section.robots or ()) for each, track in tracks.items()),
    )
    file = MissionFile(plan, where, lines)
    problems = plan_problems(plan)
    if problems:
        raise file.errors(problems)
    return file


def _explained(details: ErrorDetails) -> tuple[KeyPath, str]:
    """Explain an error with the table that it is in: the keys of steps are not those of the file."""
    path = tuple(details["loc"])
    schema: type[Section] = MissionSection
    for part, table in (("tracks", TrackSection), ("steps", StepSection), ("done", DoneSection)):
        if part in path[:-1]:
            schema = table
    if details["type"] == "extra_forbidden":
        return path, unknown_key(str(path[-1]), schema.model_fields, schema.__name__)
    return explain(details, schema)


def _error(where: str, lines: Mapping[KeyPath, int], found: Iterable[tuple[KeyPath, str]]) -> ConfigError:
    complaints = set[tuple[int, str]]()
    for path, what in found:
        line = next((lines[path[:end]] for end in range(len(path), 0, -1) if path[:end] in lines), 0)
        place = f"{where}:{line}" if line else where
        complaints.add((line, f"{place}: {dotted(path)}: {what}" if path else f"{place}: {what}"))
    return ConfigError("\n".join(complaint for _, complaint in sorted(complaints)))


def _track(name: str, track: TrackSection, robots: tuple[str, ...]) -> MissionTrack:
    usual = robots if track.robots is None else track.robots
    return MissionTrack(
        name=name, steps=tuple(_step(number, step, usual) for number, step in enumerate(track.steps, 1))
    )


def _step(number: int, step: StepSection, robots: tuple[str, ...]) -> MissionStep:
    done = step.done
    return MissionStep(
        name=step.name or f"step {number}",
        behaviour=step.behaviour,
        robots=robots if step.robots is None else step.robots,
        parameters=msgspec.convert(step.parameters, dict[str, Value]),
        team=step.team,
        needs=needs_of(step.needs),
        roles=dict(step.roles),
        done=StepConditions(
            when=done.when,
            arrived=done.arrived or "",
            within_m=done.within_m,
            time_s=done.time_s,
            metric=done.metric,
            confirm=done.confirm,
        ),
        after=step.after,
        fail_after_s=step.fail_after_s,
        on_failed=step.on_failed,
        keep_running=step.keep_running,
    )


# ------------------------------------------------------------ what can be checked without a swarm
def plan_problems(plan: MissionPlan) -> list[MissionProblem]:
    """Return all that is wrong with a plan itself; whether its behaviours and robots exist only the core knows."""
    found = list(_names(plan))
    steps = [(track, step) for track in plan.tracks for step in track.steps]
    known = {f"{track.name}/{step.name}" for track, step in steps}
    for track, step in steps:

        def problem(key: str, text: str, track: str = track.name, step: str = step.name) -> None:
            found.append(MissionProblem(track=track, step=step, key=key, text=text[:500]))

        for key, text in (*_condition_problems(step), *_robot_problems(step)):
            problem(key, text)
        others = {each for each in known if each.partition("/")[0] != track.name}
        for each in step.after:
            if each not in known:
                problem("after", f"no step '{each:.64}', {did_you_mean(each, others)}")
            elif each.partition("/")[0] == track.name:
                problem("after", f"'{each}' is in the same track: its steps follow one another anyway")
    if not found and (circle := _circle(plan)):
        track, step = circle
        text = "it waits for a step that waits for this one"
        found.append(MissionProblem(track=track.name, step=step.name, key="after", text=text))
    return found


def _names(plan: MissionPlan) -> Iterator[MissionProblem]:
    def problem(text: str, track: str = "", step: str = "", key: str = "name") -> MissionProblem:
        return MissionProblem(track=track[:64], step=step[:64], key=key, text=text)

    if not _NAME.match(plan.name):
        yield problem("the mission's name must have 1 to 64 characters, without '/'")
    if not plan.tracks:
        yield problem("the mission has no steps", key="")
    if sum(len(track.steps) for track in plan.tracks) > MOST_STEPS:
        yield problem(f"the mission has more than {MOST_STEPS} steps", key="")
    for name, count in Counter(track.name for track in plan.tracks).items():
        if not ROBOT_ID.match(name):
            yield problem("a track is named by letters, digits, '-' and '_', 64 at most", name, key="")
        if count > 1:
            yield problem("two tracks have this name", name, key="")
    for track in plan.tracks:
        if not track.steps:
            yield problem("the track has no steps", track.name, key="")
        for name, count in Counter(step.name for step in track.steps).items():
            if not _NAME.match(name):
                yield problem("a step's name must have 1 to 64 characters, without '/'", track.name, name)
            if count > 1:
                yield problem(f"two steps of this track are named '{name}'", track.name, name)


def _condition_problems(step: MissionStep) -> Iterator[tuple[str, str]]:
    done = step.done
    if not (done.arrived or done.metric or done.confirm or done.time_s is not None):
        yield "done", 'is missing: say when the step is over, e.g. done = { arrived = "all" } or { time_s = 20 }'
    if done.arrived and not step.behaviour:
        yield "done.arrived", "the step has no behaviour that could arrive"
    if done.within_m and not done.arrived:
        yield "done.within_m", 'belongs to arrived = "all" or "any"'
    if done.metric:
        try:
            parse_comparison(done.metric)
        except ConfigError as error:
            yield "done.metric", str(error)
    for key, given in (("team", step.team), ("needs", step.needs != Needs()), ("roles", step.roles)):
        if given and not step.behaviour:
            yield key, "the step has no behaviour that it is for"
    if step.parameters and not step.behaviour:
        yield "parameters", "the step has no behaviour that they are for"
    if step.keep_running and not step.behaviour:
        yield "keep_running", "the step has no behaviour that could continue"
    if step.behaviour and not ROBOT_ID.match(step.behaviour):
        yield "behaviour", f"'{step.behaviour}' cannot name a behaviour"


def _robot_problems(step: MissionStep) -> Iterator[tuple[str, str]]:
    for robot in step.robots:
        if not ROBOT_ID.match(robot.removeprefix(GROUP)):
            yield "robots", f"'{robot:.64}' cannot name a robot or a @group"


def _circle(plan: MissionPlan) -> tuple[MissionTrack, MissionStep] | None:
    """Return a step that can never begin, because it waits for itself."""
    begun: set[str] = set()
    at = dict.fromkeys((track.name for track in plan.tracks), 0)
    moved = True
    while moved:
        moved = False
        for track in plan.tracks:
            while at[track.name] < len(track.steps) and begun.issuperset(track.steps[at[track.name]].after):
                begun.add(f"{track.name}/{track.steps[at[track.name]].name}")
                at[track.name] += 1
                moved = True
    stuck = (track for track in plan.tracks if at[track.name] < len(track.steps))
    return next(((track, track.steps[at[track.name]]) for track in stuck), None)
