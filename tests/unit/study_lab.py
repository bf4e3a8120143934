"""A study on disk, and a console that conducts one of its trials on a simulated clock."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec

from fullswarm.operator.console.study import EVENTS, PLAN, TRIAL, Probe, TrialPlan
from fullswarm.study.file import StudyFile, load_study
from tests.unit.console_bench import ConsoleBench

FLEET = """
[fleet]
count = 2
[world]
engine = "kinematic"
bounds_m = [0.0, 0.0, 10.0, 10.0]
"""
STUDY = """
name = "filter"
participants = 4
seed = 3
fleet = "hall.toml"
duration_s = 20.0
briefing = "You operate two robots."
consent = "I take part of my own will."
task = "Keep them apart."

[[conditions]]
name = "generous-margin"
set = ["agent.safety_margin_m=0.2"]

[[conditions]]
name = "tight-margin"
set = ["agent.safety_margin_m=0.02"]

[[probes]]
name = "stopped"
question = "How many robots are stopped?"
at_s = [5.0]
truth = "stopped"
"""


def write_study(folder: Path, text: str = STUDY) -> StudyFile:
    """Write a study and its fleet; return it as read."""
    (folder / "hall.toml").write_text(FLEET)
    (folder / "study.toml").write_text(text)
    return load_study(folder / "study.toml")


def plan(**changes: Any) -> TrialPlan:
    given: dict[str, Any] = {
        "study": "filter", "participant": "P01", "label": "B", "number": 1, "of": 2, "attempt": 1, "seal": "s",
        "setting": "f", "duration_s": 20.0, "task": "Keep them apart.", "briefing": "Two robots.",
        "probes": (
            Probe(name="stopped", at_s=5.0, question="How many are stopped?", truth="stopped", timeout_s=3.0),
        ),
    }  # fmt: skip
    return TrialPlan(**{**given, **changes})


class StudyBench(ConsoleBench):
    """The console with a trial in `folder`."""

    def __init__(self, folder: Path, trial: TrialPlan) -> None:
        self.folder = folder
        (folder / PLAN).write_bytes(msgspec.json.encode(trial))
        super().__init__(study=folder)

    def events(self, kind: str = "") -> list[dict[str, Any]]:
        path = self.folder / EVENTS
        lines = path.read_text().splitlines() if path.exists() else []
        return [each for line in lines if (each := json.loads(line))["kind"] == kind or not kind]

    def record(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.folder / TRIAL).read_text())
        return found
