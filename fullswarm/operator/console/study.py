"""Conducts one trial of a human-swarm study: briefing, start, probes, end, NASA-TLX; logs all that the operator does.

The plan comes from ``fullswarm study run`` as a file, ``plan.json`` in the trial's folder. It holds the label of the
condition and never its name, so the page cannot show more. Beside the plan this writes, line by line:

``events.jsonl``   what the page's frames asked for, what was clicked, questions, answers and ratings
``motion.jsonl``   where each robot was, five times a second

Of a participant only the code is stored: no name, no address, no text but the answers to the study's own questions.
Stops and e-stops pass in every phase; nothing here can refuse or delay one.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any, Literal

import msgspec

from fullswarm.files import replace_file
from fullswarm.messages import MissionPlan, Value
from fullswarm.operator.console import frames
from fullswarm.operator.view import RobotRow, Snapshot
from fullswarm.runtime import Scheduler

PLAN, TRIAL, EVENTS, MOTION = "plan.json", "trial.json", "events.jsonl", "motion.jsonl"
MOTION_HZ = 5.0
STICK_S = 0.2
"""Samples of a stick that does not change its robots are logged at most so often."""
MOST_EVENT_BYTES, MOST_MOTION_BYTES = 32 * 2**20, 256 * 2**20
RUNNING = "running "
COUNTS = ("robots", "moving", "stopped", "estopped", "silent", "idle")
Tlx = Literal["weighted", "raw", "off"]
Panel = Literal["fleet", "behaviours", "charts", "missions", "log", "legend"]
State = Literal["prepared", "running", "complete", "interrupted"]

SUBSCALES = {
    "mental": ("Mental demand", "How mentally demanding was the task?", "Very low", "Very high"),
    "physical": ("Physical demand", "How physically demanding was the task?", "Very low", "Very high"),
    "temporal": ("Temporal demand", "How hurried or rushed was the pace of the task?", "Very low", "Very high"),
    "performance": (
        "Performance", "How successful were you in accomplishing what you were asked to do?", "Perfect", "Failure",
    ),
    "effort": (
        "Effort", "How hard did you have to work to accomplish your level of performance?", "Very low", "Very high",
    ),
    "frustration": (
        "Frustration", "How insecure, discouraged, irritated, stressed and annoyed were you?", "Very low", "Very high",
    ),
}  # fmt: skip
"""NASA-TLX (S. G. Hart and L. E. Staveland, 1988; questions of the paper-and-pencil form): title, question, ends."""
STEP = 5
PAIRS = tuple(itertools.combinations(SUBSCALES, 2))
"""The fifteen comparisons that weigh the subscales."""


# ---------------------------------------------------------------- what is stored
class Probe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A question that is asked once. Freeze: as in SAGAT (M. R. Endsley, 1995); else in real time, as in SPAM."""

    name: str
    at_s: float
    question: str
    freeze: bool = False
    truth: str = ""  # one of COUNTS, or "running BEHAVIOUR"
    choices: tuple[str, ...] = ()  # none: the answer is a number
    correct: str = ""
    tolerance: float = 0.0
    timeout_s: float = 60.0


class StartRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The request that begins a trial."""

    behaviour: str
    robots: tuple[str, ...] = ()
    parameters: dict[str, Value] = {}


class TrialPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All that the console needs of a trial."""

    study: str
    participant: str
    label: str
    number: int
    of: int
    attempt: int
    seal: str
    setting: str  # SHA-256 digest of the fleet's settings
    duration_s: float
    task: str
    robots: int = 0  # that must have reported before it begins
    briefing: str = ""
    consent: str = ""
    tlx: Tlx = "weighted"
    probes: tuple[Probe, ...] = ()
    can_freeze: bool = False
    hide: tuple[Panel, ...] = ()
    behaviours: tuple[str, ...] = ()  # none: all
    request: StartRequest | None = None
    mission: MissionPlan | None = None


class TrialRecord(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """How a trial went."""

    participant: str
    label: str
    number: int
    attempt: int
    seal: str
    setting: str
    version: str
    state: State = "prepared"
    began_unix_s: float | None = None
    duration_s: float | None = None
    reason: str = ""


class RobotSample(msgspec.Struct, frozen=True, array_like=True):
    """A robot at one moment; None: unknown."""

    robot: str
    x_m: float | None
    y_m: float | None
    heading_rad: float | None
    speed_m_s: float | None
    behaviour: str
    moving: bool
    estop: bool
    silent: bool


class Sample(msgspec.Struct, frozen=True):
    """The swarm at one moment of a trial."""

    at_s: float
    robots: tuple[RobotSample, ...]


def sample_of(rows: Iterable[RobotRow], at_s: float) -> Sample:
    """Return what is recorded of the swarm."""
    return Sample(round(at_s, 3), tuple(_robot_sample(row) for row in rows))


def _robot_sample(row: RobotRow) -> RobotSample:
    def known(value: float) -> float | None:
        return round(value, 3) if math.isfinite(value) else None

    health = row.health
    speed_m_s = known(row.speed_m_s)
    moving = health.moving if health is not None else (speed_m_s or 0.0) > 0.0
    return RobotSample(
        row.robot, known(row.x_m), known(row.y_m), known(row.heading_rad), speed_m_s,
        "" if health is None else health.behaviour, moving, health is not None and health.estop, row.silent,
    )  # fmt: skip


def count(truth: str, sample: Sample) -> int:
    """Return how many robots a probe asks for; silent ones count as nothing else: what they do is not known.

    Parameters
    ----------
    truth : ``robots``, ``moving``, ``stopped``, ``estopped``, ``silent``, ``idle`` (without a behaviour) or
        ``running BEHAVIOUR``
    """
    robots = sample.robots
    present = [each for each in robots if not each.silent]
    if truth.startswith(RUNNING):
        return sum(each.behaviour == truth.removeprefix(RUNNING) for each in present)
    return {
        "robots": len(robots),
        "moving": sum(each.moving for each in present),
        "stopped": sum(not each.moving for each in present),
        "estopped": sum(each.estop for each in present),
        "silent": len(robots) - len(present),
        "idle": sum(not each.behaviour for each in present),
    }[truth]


@dataclass(slots=True)
class Lines:
    """A file of JSON lines that ends growing at `most_bytes`; `left_out` counts the lines that no longer fitted."""

    path: Path
    most_bytes: int
    left_out: int = 0
    _size: int = 0

    def add(self, line: object) -> bool:
        """Append a line; return whether it was written."""
        text = msgspec.json.encode(line) + b"\n"
        if not self.left_out and self._size + len(text) <= self.most_bytes:
            with contextlib.suppress(OSError), self.path.open("ab") as file:  # a full disk must not end the console
                file.write(text)
                self._size += len(text)
                return True
        self.left_out += 1
        return False


# ---------------------------------------------------------------- the trial
@dataclass(frozen=True, slots=True)
class Swarm:
    """What a trial does to the swarm, and what it sees of it."""

    snapshot: Callable[[], Snapshot]
    core_known: Callable[[], bool]
    expand: Callable[[Iterable[str]], tuple[str, ...]]  # groups → robots
    begin: Callable[[TrialPlan], None]  # send the plan's request or mission
    stop: Callable[[], None]
    hold: Callable[[bool], None]  # the simulated world stands still, or goes on


@dataclass(slots=True)
class StudyDesk:
    """One trial, from the briefing to the questionnaire.

    Parameters
    ----------
    folder : holds the plan; the records are written there
    wall_s : seconds since 1970
    changed : called when the frame of the pages has changed
    """

    plan: TrialPlan
    folder: Path
    scheduler: Scheduler
    swarm: Swarm
    wall_s: Callable[[], float]
    version: str
    changed: Callable[[], None]
    phase: Literal["briefing", "running", "tlx", "done"] = "briefing"
    owner: str = ""
    """Key of the session that began the trial: the participant's page."""
    _record: TrialRecord = field(init=False)
    _events: Lines = field(init=False)
    _motion: Lines = field(init=False)
    _began_s: float = 0.0
    _held_s: float = 0.0  # spent in freezes that are over
    _due: list[Probe] = field(init=False)
    _probe: Probe | None = None
    _asked_s: float = 0.0
    _frozen: bool = False
    _stick: tuple[float, tuple[str, ...], str] = (-math.inf, (), "")
    _pages: dict[str, int] = field(default_factory=dict)
    _sampled_s: float = -math.inf
    _told_s: int = -1

    def __post_init__(self) -> None:
        plan = self.plan
        self._events = Lines(self.folder / EVENTS, MOST_EVENT_BYTES)
        self._motion = Lines(self.folder / MOTION, MOST_MOTION_BYTES)
        self._due = list(plan.probes)
        self._record = TrialRecord(
            participant=plan.participant, label=plan.label, number=plan.number, attempt=plan.attempt, seal=plan.seal,
            setting=plan.setting, version=self.version,
        )  # fmt: skip
        if (self.folder / EVENTS).exists():  # this process is the successor of one that failed
            self.phase = "done"
            self._end("interrupted", "the console was started again during the trial")
        else:
            self._write()

    # ------------------------------------------------------------ pages
    def shown(self, mine: bool) -> dict[str, Any]:
        """Return the frame ``study``; `mine`: for the participant's page."""
        plan, probe = self.plan, self._probe
        return {
            "t": "study",
            "phase": self.phase,
            "mine": mine,
            "title": f"{plan.participant} · condition {plan.label} · {plan.number} of {plan.of}",
            "task": plan.task,
            "briefing": plan.briefing if plan.number == 1 else "",
            "consent": plan.consent if plan.number == 1 else "",
            "duration_s": plan.duration_s,
            "left_s": max(0, math.ceil(plan.duration_s - self._trial_s())) if self.phase == "running" else 0,
            "hide": list(plan.hide),
            "probe": None
            if probe is None
            else {
                "id": f"{probe.name}@{probe.at_s:g}", "question": probe.question, "choices": list(probe.choices),
                "freeze": self._frozen,
            },
            "tlx": self._questionnaire() if self.phase == "tlx" else None,
            "reason": self._record.reason,
        }  # fmt: skip

    def offered(self, world: Mapping[str, Any]) -> dict[str, Any]:
        """Return the world as the pages get it: with the behaviours of the condition."""
        names = self.plan.behaviours
        if not names:
            return dict(world)
        return {**world, "behaviours": {name: each for name, each in world["behaviours"].items() if name in names}}

    def _questionnaire(self) -> dict[str, Any]:
        plan = self.plan
        random = Random(f"{plan.study}/{plan.participant}/{plan.number}")  # noqa: S311  (no secret)
        pairs = [random.sample(pair, 2) for pair in random.sample(PAIRS, len(PAIRS))]
        scales = [
            {"name": name, "title": title, "question": question, "low": low, "high": high}
            for name, (title, question, low, high) in SUBSCALES.items()
        ]
        return {"scales": scales, "pairs": pairs if plan.tlx == "weighted" else []}

    # ------------------------------------------------------------ frames
    def refusal(self, command: frames.Command) -> str:
        """Return why a command is not carried out now; empty: it is. Never refuses a stop, an e-stop or its release."""
        if isinstance(command, frames.Stop | frames.Estop | frames.Clear | frames.Release):
            return ""
        if self.phase != "running":
            return "the trial is not running"
        if self._frozen:
            return "answer the question first"
        names = self.plan.behaviours
        if isinstance(command, frames.Request | frames.Drive) and names and command.behaviour not in names:
            return f"{command.behaviour} is not offered in this trial"
        return ""

    def handle(self, command: frames.Study, session: str) -> str:
        """Carry out a frame of the dialogs; return why not, or an empty text."""
        if command.op == "start":
            return self._start(session)
        if command.op == "answer":
            return self._answer(command)
        return self._rate(command)

    def log(self, command: frames.Command, session: str) -> None:
        """Log what a page asks for, while the trial runs."""
        if self.phase != "running":
            return
        match command:
            case frames.Request():
                self._event("request", session, command.robots, behaviour=command.behaviour,
                            parameters=command.parameters)  # fmt: skip
            case frames.Drive():
                self._log_stick(command, session)
            case frames.Release():
                self._event("release", session, self._stick[1])
                self._stick = (-math.inf, (), "")
            case frames.Stop() | frames.Estop() | frames.Clear():
                self._event(type(command).__name__.lower(), session, command.robots)
            case frames.Lease():
                self._event("lease" if command.hold else "unlease", session, command.robots)
            case frames.Mission():
                self._event("mission", session, (), op=command.op)
            case frames.Input():
                self._event(command.kind, session, command.robots, detail=command.detail)

    def _log_stick(self, command: frames.Drive, session: str) -> None:
        now_s = self.scheduler.now_s()
        last_s, robots, behaviour = self._stick
        if now_s - last_s < STICK_S - 1e-9 and (robots, behaviour) == (command.robots, command.behaviour):
            return
        self._stick = (now_s, command.robots, command.behaviour)
        sticks = {name: round(value, 3) for name, value in command.sticks.items()}
        self._event("drive", session, command.robots, behaviour=command.behaviour, sticks=sticks)

    def _event(self, kind: str, session: str = "", robots: Iterable[str] = (), **more: object) -> None:
        """Append to the log; robots: none means all of them, as in a request."""
        event: dict[str, object] = {"at_s": round(self._trial_s(), 3), "kind": kind}
        if session:
            event["page"] = self._pages.setdefault(session, len(self._pages) + 1)
            event["participant"] = session == self.owner
            event["robots"] = self.swarm.expand(robots)
        if not self._events.add({**event, **more}) and self._events.left_out == 1:
            self._record.reason = "the log is full: later input is missing"
            self._write()

    # ------------------------------------------------------------ time
    def _trial_s(self) -> float:
        """Return the time of the trial: it stands while the world is frozen."""
        now_s = self._asked_s if self._frozen else self.scheduler.now_s()
        return now_s - self._began_s - self._held_s

    def _start(self, session: str) -> str:
        if self.phase != "briefing":
            return "the trial has begun already"
        ready = sum(row.health is not None and not row.silent for row in self.swarm.snapshot().robots)
        if ready < self.plan.robots or not self.swarm.core_known():
            return f"the swarm is not ready: {ready} of {self.plan.robots} robots report; try again in some seconds"
        self.owner, self.phase, self._began_s = session, "running", self.scheduler.now_s()
        self._record.state, self._record.began_unix_s = "running", self.wall_s()
        self._write()
        self._event("begin", session)
        self.swarm.begin(self.plan)
        self.tick()
        self.changed()
        return ""

    def tick(self) -> None:
        """Record the swarm, ask what is due, end in time. Called at MOTION_HZ or faster."""
        if self.phase != "running":
            return
        if self._probe is not None and self.scheduler.now_s() - self._asked_s >= self._probe.timeout_s:
            self._settle("", "timeout")
        if self._frozen:
            return
        at_s = self._trial_s()
        if at_s - self._sampled_s >= 1.0 / MOTION_HZ - 1e-9:
            self._sample(at_s)
        if self._due and self._probe is None and at_s >= self._due[0].at_s:
            self._ask(self._due.pop(0), at_s)
        if at_s >= self.plan.duration_s:
            self._finish()
        elif math.ceil(at_s) != self._told_s:
            self._told_s = math.ceil(at_s)
            self.changed()

    def _sample(self, at_s: float) -> Sample:
        self._sampled_s = at_s
        sample = sample_of(self.swarm.snapshot().robots, at_s)
        self._motion.add(sample)
        return sample

    def _finish(self) -> None:
        """End the task: all robots stop, the questionnaire follows."""
        if self._probe is not None:
            self._settle("", "the trial ended")
        self._sample(self._trial_s())
        summaries = {each.metric: each.values for each in self.swarm.snapshot().summaries}
        self._event("end", metrics=summaries)
        self._record.duration_s = round(self._trial_s(), 3)
        self.swarm.stop()
        if self.plan.tlx == "off":
            self.phase = "done"
            self._end("complete")
        else:
            self.phase = "tlx"
            self._write()
        self.changed()

    # ------------------------------------------------------------ probes
    def _ask(self, probe: Probe, at_s: float) -> None:
        # Of this moment: the answer is compared with it, and in a freeze the world stands from now on.
        sample = self._sample(at_s)
        truth = str(count(probe.truth, sample)) if probe.truth else probe.correct
        freeze = probe.freeze and self.plan.can_freeze
        self._event("probe", name=probe.name, question=probe.question, freeze=freeze, truth=truth,
                    numeric=not probe.choices, tolerance=probe.tolerance)  # fmt: skip
        self._probe, self._asked_s = probe, self.scheduler.now_s()
        self._frozen = freeze
        if freeze:
            self.swarm.hold(True)
        self.changed()

    def _answer(self, command: frames.Study) -> str:
        probe = self._probe
        if probe is None or command.probe != f"{probe.name}@{probe.at_s:g}":
            return "that question is not asked now"
        if probe.choices and command.value not in probe.choices:
            return "choose one of the answers"
        if not probe.choices and not _is_number(command.value):
            return "answer with a number"
        self._settle(command.value, "")
        return ""

    def _settle(self, value: str, why: str) -> None:
        """Close the open question; the response time runs on while the trial's own time stands."""
        probe, now_s = self._probe, self.scheduler.now_s()
        if probe is None:
            return
        response_s = round(now_s - self._asked_s, 3)
        self._event("answer", name=probe.name, value=value, response_s=response_s, **({"why": why} if why else {}))
        if self._frozen:
            self._held_s += now_s - self._asked_s
            self._frozen = False
            self.swarm.hold(False)
        self._probe = None
        self.changed()

    # ------------------------------------------------------------ questionnaire
    def _rate(self, command: frames.Study) -> str:
        if self.phase != "tlx":
            return "the questionnaire is not open"
        if set(command.ratings) != set(SUBSCALES):
            return "rate all six scales"
        if any(not 0 <= each <= 100 or each % STEP for each in command.ratings.values()):
            return f"a rating is 0 to 100 in steps of {STEP}"
        weights = dict.fromkeys(SUBSCALES, 0)
        if self.plan.tlx == "weighted":
            if {frozenset(pair) for pair in command.pairs} != {frozenset(pair) for pair in PAIRS}:
                return "compare all fifteen pairs"
            if len(command.pairs) != len(PAIRS):
                return "compare each pair once"
            for chosen, _ in command.pairs:
                weights[chosen] += 1
        self._event("tlx", ratings=command.ratings, weights=weights if self.plan.tlx == "weighted" else None)
        self.phase = "done"
        self._end("complete")
        self.changed()
        return ""

    # ------------------------------------------------------------ end
    def close(self) -> None:
        """End the trial with this process: a trial that has not reached its end is run again."""
        if self._frozen:
            self.swarm.hold(False)
        if self.phase != "done":
            self.phase = "done"
            self._end("interrupted", "the console ended before the trial")

    def _end(self, state: State, reason: str = "") -> None:
        self._record.state = state
        self._record.reason = reason or self._record.reason
        self._write()

    def _write(self) -> None:
        with contextlib.suppress(OSError):  # a full disk: the trial is not complete then, and is run again
            replace_file(self.folder / TRIAL, msgspec.json.format(msgspec.json.encode(self._record)))


def read_plan(path: Path) -> TrialPlan:
    """Read a plan as ``fullswarm study run`` writes it."""
    return msgspec.json.decode(path.read_bytes(), type=TrialPlan)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
