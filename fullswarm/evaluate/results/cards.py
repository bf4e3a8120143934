"""Describes each trial for the report: a card with its figures, its files, and the commands that show it again."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from datetime import UTC, datetime
from glob import escape
from pathlib import Path
from urllib.parse import quote

from fullswarm.evaluate.results.figures import anchor
from fullswarm.evaluate.results.folder import StoredTrial
from fullswarm.evaluate.results.quantities import (
    ARRIVED,
    COLLISIONS,
    COVERAGE,
    PAIRS,
    TIME,
    TOUCHED,
    WORK,
    Quantity,
    values_of,
)
from fullswarm.evaluate.results.sample import condition_name, shown
from fullswarm.evaluate.trial_folder import EVIDENCE_FILE, RESULT_FILE, TRAJECTORY_FILE, TRIAL_FILE, TRIALS

QUANTITIES: tuple[Quantity, ...] = (COLLISIONS, PAIRS, TOUCHED, ARRIVED, TIME, WORK, COVERAGE)
PICTURES = (".png", ".svg", ".gif", ".mp4")
RECORDINGS, RECORDING = "recordings", ".mcap"
"""Where an experiment's folder has those of its trials."""


@dataclass(frozen=True, slots=True)
class Card:
    """A trial on the report's page; `anchor` is its id there."""

    anchor: str
    title: str
    facts: list[tuple[str, str]]
    files: list[tuple[str, str]]  # what it is, and where, relative to the report
    commands: list[tuple[str, str]]  # the command, and what it does


def card_of(stored: StoredTrial, out: Path) -> Card:
    """Return the card of a trial in the results folder `out`."""
    trial = stored.record.trial
    return Card(
        anchor=anchor(stored),
        title=f"{shown(trial.cell.label)}, {trial.cell.scenario}, {trial.cell.robots} robots, seed {trial.seed}",
        facts=_facts(stored),
        files=_files(stored, out),
        commands=_commands(stored, out),
    )


def clock_text(started: str) -> str:
    """Return a time of day in ISO format for people: to the second, in UTC."""
    try:
        return datetime.fromisoformat(started).astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except ValueError:
        return started


def tooltip(stored: StoredTrial) -> str:
    """Return what a point in a figure says of its trial."""
    outcome, trial = stored.record.outcome, stored.record.trial
    events = "" if outcome is None else f": {outcome.events} collisions"
    return f"{shown(trial.cell.label)}, {trial.cell.robots} robots, seed {trial.seed}{events}"


def _facts(stored: StoredTrial) -> list[tuple[str, str]]:
    record, values = stored.record, values_of(stored.record)
    facts = [("Condition", condition_name(record.trial.cell)), ("End", record.end_reason or "failed")]
    if record.failure:
        facts.append(("Failure", record.failure))
    for quantity in QUANTITIES:
        value = quantity.of(values)
        if value == value:  # known
            digits = 0 if quantity in (COLLISIONS, PAIRS, TOUCHED) else quantity.decimals
            facts.append((quantity.title, f"{value:.{digits}f} {quantity.unit}".rstrip()))
    if record.outcome is not None and not record.outcome.safe_start:
        facts.append(("Start", "outside the safe set: in no other figure"))
    facts.append(("Started", clock_text(stored.provenance.started)))
    return [(name, text) for name, text in facts if text]


def _files(stored: StoredTrial, out: Path) -> list[tuple[str, str]]:
    """Return the files that are there: pictures, films and recordings first."""
    names = sorted(each.name for each in stored.path.iterdir()) if stored.path.is_dir() else []
    known = {RESULT_FILE: "result", TRIAL_FILE: "launch file", TRAJECTORY_FILE: "poses", EVIDENCE_FILE: "motion"}
    found = [(name, name) for name in names if Path(name).suffix in PICTURES]
    found += [(text, name) for name, text in known.items() if name in names]
    recordings = [("recording", f"{RECORDINGS}/{quote(each.name)}") for each in _recordings(stored, out)]
    return [*recordings, *((text, f"{TRIALS}/{quote(stored.path.name)}/{quote(name)}") for text, name in found)]


def _recordings(stored: StoredTrial, out: Path) -> list[Path]:
    folder = out / RECORDINGS
    return sorted(folder.glob(f"{escape(stored.path.name)}*{RECORDING}")) if folder.is_dir() else []


def _commands(stored: StoredTrial, out: Path) -> list[tuple[str, str]]:
    folder, name = shlex.quote(out.name or "."), shlex.quote(stored.path.name)
    commands = []
    if (stored.path / TRAJECTORY_FILE).exists():
        commands.append(
            (f"fullswarm experiment replay {folder} --trial {name} --to trial.mp4", "film it, seen from above")
        )
    for each in _recordings(stored, out):
        path = f"{folder}/{RECORDINGS}/{shlex.quote(each.name)}"
        commands.append((f"fullswarm replay {path}", "run its nodes again on its recording"))
    if (stored.path / TRIAL_FILE).exists():
        commands.append((f"fullswarm experiment trial {folder}/{TRIALS}/{name}", "run it again, alone"))
    return commands
