"""The state of a mission: declared transitions, what is kept in the local database, and what a step waits for.

Pure: no bus, no clock, no database. Two small tables say which events change a mission and a step; every other pair of
phase and event changes nothing. A step's requests have ids made of the mission, the step and the number of the attempt,
so that a core that is started again recognises them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple

import msgspec

from fullswarm.config.mission_file import Comparison, parse_comparison
from fullswarm.messages import (
    MissionPhase,
    MissionPlan,
    MissionStatus,
    MissionStep,
    MissionTrack,
    StepPhase,
    StepPlace,
    StepStatus,
    TrackStatus,
)

MissionEvent = Literal["pause", "resume", "abort", "fail", "finish"]
StepEvent = Literal["begin", "pause", "finish", "fail", "skip"]

MISSION: Mapping[tuple[MissionPhase, MissionEvent], MissionPhase] = {
    ("running", "pause"): "paused",
    ("paused", "resume"): "running",
    ("running", "finish"): "done",
    ("running", "fail"): "failed",
    ("running", "abort"): "aborted",
    ("paused", "abort"): "aborted",
}
STEP: Mapping[tuple[StepPhase, StepEvent], StepPhase] = {
    ("waiting", "begin"): "running",
    ("running", "pause"): "paused",
    ("paused", "begin"): "running",
    ("running", "finish"): "done",
    ("running", "fail"): "failed",
    ("waiting", "skip"): "skipped",
    ("running", "skip"): "skipped",
    ("paused", "skip"): "skipped",
}
ENDED: frozenset[MissionPhase] = frozenset({"done", "failed", "aborted"})
OVER: frozenset[StepPhase] = frozenset({"done", "failed", "skipped"})
ANSWERED = 32
"""Ids of answered requests that a mission keeps: a late copy must not resume it again."""


class StepState(msgspec.Struct, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """One step as it is kept."""

    phase: StepPhase = "waiting"
    attempt: int = 0  # of its requests; 0: none yet
    robots: tuple[str, ...] = ()  # groups replaced by their robots when it began
    elapsed_s: float = 0.0
    confirmed: bool = False
    arrived: tuple[str, ...] = ()  # that reported it as their result
    over: bool = False  # its request has ended with a result of every robot: not to be sent again
    kept: bool = False  # done, and its robots go on
    reason: str = ""

    def change(self, event: StepEvent, reason: str = "") -> bool:
        """Apply an event; False when it changes nothing in this phase."""
        phase = STEP.get((self.phase, event))
        if phase is None:
            return False
        self.phase, self.reason = phase, reason
        if event == "begin":
            self.attempt, self.over, self.arrived = self.attempt + 1, False, ()
        return True


class MissionState(msgspec.Struct, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A mission's progress as it is kept, beside its plan."""

    mission: str
    operator: str
    steps: dict[str, list[StepState]]  # by track
    phase: MissionPhase = "running"
    reason: str = ""
    number: int = 0  # counts the missions of a database: the newest has the highest
    answered: list[str] = []

    @property
    def ended(self) -> bool:
        """Whether it is over for good."""
        return self.phase in ENDED

    def change(self, event: MissionEvent, reason: str = "") -> bool:
        """Apply an event; False when it changes nothing in this phase."""
        phase = MISSION.get((self.phase, event))
        if phase is None:
            return False
        self.phase, self.reason = phase, reason
        return True

    def answer(self, request_id: str) -> None:
        """Remember that a request was carried out."""
        self.answered = [*self.answered[1 - ANSWERED :], request_id]


@dataclass(frozen=True, slots=True)
class Running:
    """A step with its place and its state."""

    track: MissionTrack
    index: int
    step: MissionStep
    state: StepState

    @property
    def path(self) -> str:
        """``track/step``."""
        return f"{self.track.name}/{self.step.name}"


class Mission:
    """A plan with its progress.

    Attributes
    ----------
    plan, state
    """

    def __init__(self, plan: MissionPlan, state: MissionState) -> None:
        self.plan, self.state = plan, state

    @classmethod
    def new(cls, mission: str, plan: MissionPlan, operator: str, number: int) -> Mission:
        """Return a mission none of whose steps has begun."""
        steps = {track.name: [StepState() for _ in track.steps] for track in plan.tracks}
        return cls(plan, MissionState(mission=mission, operator=operator, steps=steps, number=number))

    def steps(self) -> Iterator[Running]:
        """Yield all steps."""
        for track in self.plan.tracks:
            for index, (step, state) in enumerate(zip(track.steps, self.state.steps[track.name], strict=True)):
                yield Running(track, index, step, state)

    def running(self) -> list[Running]:
        """Return the steps that run."""
        return [each for each in self.steps() if each.state.phase == "running"]

    def current(self) -> list[Running]:
        """Return each track's first step that is not over."""
        found: dict[str, Running] = {}
        for each in self.steps():
            if each.state.phase not in OVER:
                found.setdefault(each.track.name, each)
        return list(found.values())

    def ready(self) -> list[Running]:
        """Return the steps that are to begin now: the first of their track, and all that they wait for is over."""
        over = {each.path for each in self.steps() if each.state.phase in OVER}
        return [each for each in self.current() if each.state.phase != "running" and over.issuperset(each.step.after)]

    def request_id(self, each: Running) -> str:
        """Return the id of a step's present request."""
        return f"{self.state.mission}.{each.track.name}.{each.index + 1}.{each.state.attempt}"

    def wants(self, each: Running) -> bool:
        """Tell whether the robots of a step are to run its behaviour now."""
        if not each.step.behaviour or not each.state.attempt:
            return False
        if each.state.kept:
            return self.state.phase in ("running", "done")
        return self.state.phase == "running" and each.state.phase == "running"

    def end(self) -> None:
        """Skip what has not run, after the mission has ended."""
        for each in self.steps():
            each.state.change("skip")

    def pause(self, reason: str) -> bool:
        """Pause the mission and all its running steps; False when it does not run."""
        if not self.state.change("pause", reason):
            return False
        for each in self.running():
            each.state.change("pause")
        return True

    def status(
        self, waits: Mapping[str, Sequence[str]], places: Mapping[str, tuple[StepPlace, ...]] = MappingProxyType({})
    ) -> MissionStatus:
        """Return the mission as it is sent.

        Parameters
        ----------
        waits : track/step → conditions that do not hold yet
        places : track/step → where it is on the map
        """
        found: dict[str, list[StepStatus]] = {track.name: [] for track in self.plan.tracks}
        for each in self.steps():
            step, state = each.step, each.state
            asked = state.phase == "running" and step.done.confirm and not state.confirmed
            found[each.track.name].append(
                StepStatus(
                    name=step.name,
                    behaviour=step.behaviour,
                    phase=state.phase,
                    robots=state.robots or step.robots,
                    elapsed_s=round(state.elapsed_s, 1),
                    request_id=self.request_id(each) if state.attempt and step.behaviour else "",
                    waits_for=tuple(waits.get(each.path, ())),
                    confirm=step.done.confirm if asked else "",
                    reason=state.reason,
                    places=places.get(each.path, ()),
                )
            )
        return MissionStatus(
            mission=self.state.mission,
            name=self.plan.name,
            phase=self.state.phase,
            operator=self.state.operator,
            reason=self.state.reason,
            tracks=tuple(TrackStatus(name=name, steps=tuple(steps)) for name, steps in found.items()),
        )


class Facts(NamedTuple):
    """What is known of a running step.

    Attributes
    ----------
    arrived : its robots that have arrived
    metric : newest value of the metric that it waits for, received since it began; None: none yet
    """

    arrived: tuple[str, ...] = ()
    metric: float | None = None


def open_conditions(step: MissionStep, state: StepState, facts: Facts) -> list[str]:
    """Return the conditions that keep a step from being done, as text; none: it is done."""
    done = step.done
    found: list[tuple[bool, str]] = []
    if done.arrived:
        count, total = len(set(state.robots) & set(facts.arrived)), len(state.robots)
        holds = bool(count) if done.arrived == "any" else count == total > 0
        found.append((holds, f"arrived: {count} of {total}" + (", any is enough" if done.arrived == "any" else "")))
    if done.time_s is not None:
        left_s = done.time_s - state.elapsed_s
        found.append((left_s <= 1e-6, f"time: {max(0.0, left_s):.0f} s of {done.time_s:g} s left"))
    if done.metric:
        wanted = parse_comparison(done.metric)
        value = facts.metric
        shown = "not reported since the step began" if value is None else f"it is {value:.4g}"
        found.append((value is not None and wanted.holds(value), f"metric: {done.metric}, {shown}"))
    if done.confirm:
        found.append((state.confirmed, f"confirmation: {done.confirm}"))
    if done.when == "any" and any(holds for holds, _ in found):
        return []
    return [text for holds, text in found if not holds]


def comparison(step: MissionStep) -> Comparison | None:
    """Return the metric that a step waits for, if any."""
    return parse_comparison(step.done.metric) if step.done.metric else None
