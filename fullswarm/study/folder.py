"""Keeps the folder of a study: a copy of its file, the sealed key of the labels, and a folder for each trial.

::

    study.toml                       the file as it was when the study began
    key.sealed                       which label is which condition
    unblinded.json                   when the key was opened; not there before
    trials/P01/1-B-1/                first condition of P01, labelled B, first attempt
        plan.json, trial.json        what was run; when, and how it ended
        events.jsonl, motion.jsonl   what the participant did; where the robots were

The seal keeps the key out of sight, it is no encryption: whoever has the folder and wants to know can decode it. Each
trial repeats the key's SHA-256 digest, so that a key that was exchanged later is noticed.
"""

from __future__ import annotations

import base64
import hashlib
import json
import secrets
from dataclasses import dataclass
from pathlib import Path

import msgspec

from fullswarm.clock import wall_time_s
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.files import replace_file
from fullswarm.operator.console.study import TRIAL, TrialRecord
from fullswarm.study.file import StudyFile, load_study
from fullswarm.study.order import orders

COPY, KEY, OPENED, TRIALS = "study.toml", "key.sealed", "unblinded.json", "trials"
LABELS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


class _Key(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is sealed. The salt keeps the digest from being guessed by trying all keys."""

    salt: str
    conditions: dict[str, str]  # label → name


@dataclass(frozen=True, slots=True)
class Due:
    """A trial that is to be run."""

    participant: str
    number: int  # from 1
    of: int
    label: str
    attempt: int


@dataclass(frozen=True, slots=True)
class Stored:
    """A trial that has been begun."""

    folder: Path
    record: TrialRecord


@dataclass(frozen=True, slots=True)
class StudyFolder:
    """A study that has begun.

    Attributes
    ----------
    seal : SHA-256 digest of the key
    """

    path: Path
    study: StudyFile
    seal: str
    _key: _Key

    def order(self, participant: str) -> tuple[str, ...]:
        """Return the labels of a participant's conditions in their order.

        Raises
        ------
        ConfigError
            The study has no such participant.
        """
        section = self.study.section
        if participant not in section.codes:
            known = did_you_mean(participant, section.codes)
            raise ConfigError(f"the study has no participant '{participant}'", where="--participant", hint=known)
        rows = orders(section.order, len(section.conditions), len(section.codes), section.seed)
        return tuple(LABELS[each] for each in rows[section.codes.index(participant)])

    def trials(self, participant: str) -> list[Stored]:
        """Return a participant's trials as they were begun; raises `ConfigError` for a broken one."""
        found = [Stored(path.parent, _read(path)) for path in (self.path / TRIALS / participant).glob(f"*/{TRIAL}")]
        return sorted(found, key=lambda each: (each.record.number, each.record.attempt))

    def complete(self) -> list[Stored]:
        """Return all complete trials, by participant and order."""
        codes = self.study.section.codes
        return [each for code in codes for each in self.trials(code) if each.record.state == "complete"]

    def due(self, participant: str) -> Due | None:
        """Return a participant's next trial, an interrupted one again; None: all are complete."""
        begun, labels = self.trials(participant), self.order(participant)
        for number, label in enumerate(labels, 1):
            attempts = [each.record for each in begun if each.record.number == number]
            if not any(each.state == "complete" for each in attempts):
                attempt = 1 + max((each.attempt for each in attempts), default=0)
                return Due(participant, number, len(labels), label, attempt)
        return None

    def folder_of(self, due: Due) -> Path:
        """Return the folder of a trial; it need not exist."""
        return self.path / TRIALS / due.participant / f"{due.number}-{due.label}-{due.attempt}"

    def condition(self, label: str) -> str:
        """Return the name of the condition behind a label: for running it, not for showing it."""
        return self._key.conditions[label]

    @property
    def opened(self) -> bool:
        """Whether the key has been opened."""
        return (self.path / OPENED).exists()

    def unblind(self) -> dict[str, str]:
        """Open the key: note the time, and return label → condition.

        Raises
        ------
        ConfigError
            A trial was run with another key.
        """
        for stored in self.complete():
            if stored.record.seal != self.seal:
                raise ConfigError(
                    "this trial was run with another key", where=str(stored.folder),
                    hint="the key or the trial was exchanged; restore both from a copy",
                )  # fmt: skip
        if not self.opened:
            complete = len(self.complete())
            note = {"opened_unix_s": wall_time_s(), "complete_trials": complete, "conditions": self._key.conditions}
            replace_file(self.path / OPENED, json.dumps(note, indent=2))
        return dict(self._key.conditions)


def begin(study: StudyFile, path: Path) -> StudyFolder:
    """Open the folder of a study, or make it, with a new key.

    Raises
    ------
    ConfigError
        It holds another study, or this one with another file.
    """
    if (path / KEY).exists():
        if (path / COPY).read_text(encoding="utf-8") != study.text:
            raise ConfigError(
                f"{study.path} is not the file with which this study began", where=str(path),
                hint=f"put the old file back ({path / COPY}), or name another folder with --out",
            )  # fmt: skip
        return open_folder(path, study)
    if path.exists() and any(path.iterdir()):
        raise ConfigError("the folder is not empty, and holds no study", where=str(path), hint="name another: --out")
    labels = LABELS[: len(study.section.conditions)]
    names = [each.name for each in study.section.conditions]
    secrets.SystemRandom().shuffle(names)  # not by the file's seed: who knows the file must not know the labels
    key = _Key(secrets.token_hex(16), dict(zip(labels, names, strict=True)))
    try:
        path.mkdir(parents=True, exist_ok=True)
        replace_file(path / COPY, study.text)
        replace_file(path / KEY, base64.b64encode(msgspec.json.encode(key)))
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error
    return open_folder(path, study)


def open_folder(path: Path, study: StudyFile | None = None) -> StudyFolder:
    """Open the folder of a study that has begun.

    Raises
    ------
    ConfigError
        There is none, or its key is broken.
    """
    if not (path / KEY).exists():
        raise ConfigError("holds no study", where=str(path), hint="`fullswarm study run FILE` begins one")
    study = load_study(path / COPY) if study is None else study
    try:
        sealed = (path / KEY).read_bytes()
        key = msgspec.json.decode(base64.b64decode(sealed), type=_Key)
    except (OSError, ValueError) as error:
        raise ConfigError(f"the key cannot be read: {error}", where=str(path / KEY)) from error
    if set(key.conditions.values()) != {each.name for each in study.section.conditions}:
        raise ConfigError("the key belongs to another study", where=str(path / KEY))
    return StudyFolder(path, study, hashlib.sha256(sealed).hexdigest(), key)


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a participant is.

    Attributes
    ----------
    order, states : the labels in their order, and the state of each trial, empty where none has begun
    complete, interrupted : trials
    next : label of what is due
    """

    participant: str
    order: tuple[str, ...]
    states: tuple[str, ...]
    complete: int
    interrupted: int
    next: str | None


def progress(folder: StudyFolder) -> list[Progress]:
    """Return how far each participant is."""
    rows = []
    for code in folder.study.section.codes:
        labels, begun, due = folder.order(code), folder.trials(code), folder.due(code)
        states = tuple(
            next((each.record.state for each in reversed(begun) if each.record.number == number), "")
            for number in range(1, len(labels) + 1)
        )
        complete = sum(state == "complete" for state in states)
        interrupted = sum(each.record.state != "complete" for each in begun)
        rows.append(Progress(code, tuple(labels), states, complete, interrupted, None if due is None else due.label))
    return rows


def _read(path: Path) -> TrialRecord:
    try:
        return msgspec.json.decode(path.read_bytes(), type=TrialRecord)
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigError(f"is no trial's record: {error}", where=str(path), hint="move its folder away") from error
