"""Runs experiments for pages: lists them, starts and stops one at a time, shows how far each one is.

Reading and running are processes of their own, `fullswarm experiment list` and `fullswarm experiment run`: neither may
hold up the console's loop, and this layer does not know experiments. The list comes in a file that the one replaces.
"""

from __future__ import annotations

import importlib.util
import os
import secrets
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import msgspec

from fullswarm.audit.log import AuditLog, Event, unlocked
from fullswarm.operator.console import children, frames
from fullswarm.operator.console.sessions import Listener
from fullswarm.runtime import Scheduler

LOOK_S = 0.25
IDLE_S = 10.0
"""The list is read for so long after the last page has stopped to look: a page may be reloaded."""
AGAIN_S = 5.0
"""A reader that has ended by itself is started again after this time."""
STOP_S, END_S = 15.0, 1.2
"""How long a run may take to end, when it is stopped and when the console ends; then it is killed."""
SETTLE_S = 2.5
"""A run that has ended counts as running until the list is newer than its end, for so long at most."""
ELSEWHERE_S = 60.0
"""Trials that ended so shortly after a run of this console were its own, not those of a shell."""
LARGEST_LIST = 4_000_000
MOST_WORDS = 300
FORMAT = "fullswarm.experiments/1"
NEEDED = ("jinja2", "matplotlib", "scipy")
MISSING = "experiments are not installed on the console's computer: pip install 'fullswarm[experiments]'"


class Cell(msgspec.Struct, frozen=True):
    """The trials of one cell, of those in which one has ended last."""

    behaviour: str
    scenario: str
    robots: int
    words: str
    trials: int
    failed: int
    collisions: int | None
    expected: bool
    arrived: float | None


class Results(msgspec.Struct, frozen=True):
    """What is in a results folder."""

    trials: int | None
    finished: int
    failed: int
    collisions: int
    unexpected: int
    arrived_fraction: float | None
    over: bool
    going: bool
    left_s: float | None
    older: int
    unreadable: int
    cells: tuple[Cell, ...]
    more_cells: int
    failures: tuple[str, ...]
    report: str


class Entry(msgspec.Struct, frozen=True):
    """An experiment, as `fullswarm experiment list --json` states it."""

    id: str
    kind: str
    name: str
    source: str
    out: str
    description: str
    fault: str
    trials: int
    small_trials: int
    seeds: str
    small_seeds: str
    results: Results | None


class _List(msgspec.Struct, frozen=True):
    format: str
    experiments: tuple[Entry, ...]


@dataclass(frozen=True, slots=True)
class ExperimentOptions:
    """Where experiments are.

    Attributes
    ----------
    folder : holds experiment files, and their results; made when the first experiment is started
    audit : folder of the log that states who started and stopped which one; None: none is written
    """

    folder: Path
    audit: Path | None = None


@dataclass(slots=True)
class _Run:
    """The experiment that is running."""

    id: str
    name: str
    by: str
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    stopped_by: str = ""
    stopped_s: float = 0.0
    ended_s: float | None = None


@dataclass(frozen=True, slots=True)
class _Ended:
    words: str
    bad: bool
    at_s: float


@dataclass(slots=True)
class _Reader:
    process: subprocess.Popen[bytes]
    log: IO[bytes]


class Experiments:
    """Lists and runs the experiments of one console.

    Parameters
    ----------
    process : name of the console, for the audit log
    send : sends a frame to all pages
    note : adds a line to the log: text, operator
    """

    def __init__(
        self,
        options: ExperimentOptions,
        scheduler: Scheduler,
        process: str,
        wall_s: Callable[[], float],
        send: Callable[[dict[str, Any]], None],
        note: Callable[[str, str], None],
    ) -> None:
        self._options, self._scheduler, self._process, self._wall_s = options, scheduler, process, wall_s
        self._send, self._note = send, note
        self._missing = "" if all(map(importlib.util.find_spec, NEEDED)) else MISSING
        self._watchers: dict[Listener, None] = {}
        self._wanted_s = -IDLE_S
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._reader: _Reader | None = None
        self._again_s = 0.0
        self._problem = ""  # why there is no list
        self._stamp: tuple[int, int] = (0, 0)
        self._entries: dict[str, Entry] | None = None
        self._text: str | None = None  # the frame of the list; None: something has changed
        self._keys: dict[str, str] = {}  # id → secret part of the address of its report
        self._run: _Run | None = None
        self._ended: dict[str, _Ended] = {}
        self._audit: AuditLog | None = None
        self._timer = scheduler.every(LOOK_S, self._look)

    def close(self) -> None:
        """End what runs, which keeps its trials, and the reader; remove all files."""
        self._timer.cancel()
        run = self._run
        if run is not None:
            children.interrupt(run.process)
            try:
                run.process.wait(END_S)
            except subprocess.TimeoutExpired:
                children.end(run.process)
            self._finish(run)
        self._end_reader()
        if self._audit is not None:
            self._audit.close()
        if self._folder is not None:
            self._folder.cleanup()

    # ---------------------------------------------------------------- what pages do
    def watch(self, listener: Listener, on: bool) -> None:
        """Begin or end to send a page the list."""
        self._watchers.pop(listener, None)
        if on:
            self._watchers[listener] = None
            listener.put("experiment_list", self._encoded())
            self._look()

    def start(self, command: frames.Experiment, by: str) -> str:
        """Start an experiment of the list; return why not, or empty."""
        if refusal := self.refusal():
            return refusal
        if self._run is not None:
            return f"{self._run.name} is running, started by {self._run.by}: stop it first, or wait until it has ended"
        entry = (self._entries or {}).get(command.id)
        if entry is None:
            return "there is no such experiment in the list any more"
        if entry.fault or not entry.source:
            return entry.fault or f"{entry.name} has no file here: it can be continued where it was started"
        what = [entry.source, "--out", entry.out, "--parent", str(os.getpid())]
        what += ["--small"] if command.small else []
        what += ["--seeds", command.seeds] if command.seeds else []
        try:
            self._options.folder.mkdir(parents=True, exist_ok=True)
            log = tempfile.TemporaryFile(dir=self._private())  # noqa: SIM115  (closed with the run)
        except OSError as error:
            return f"not started: {error.strerror or error}"
        try:
            process = children.start(["experiment", "run", *what], log)
        except OSError as error:
            log.close()
            return f"not started: {error.strerror or error}"
        self._run = _Run(entry.id, entry.name, by, process, log)
        self._ended.pop(entry.id, None)
        part = "small" if command.small else "full"
        seeds = f", seeds {command.seeds}" if command.seeds else ""
        self._note(f"{by} starts the experiment {entry.name} ({part}{seeds})", by)
        self._record("started", entry, by, {"small": command.small, "seeds": command.seeds})
        self._tell()
        return ""

    def stop(self, command: frames.Experiment, by: str) -> str:
        """Have the running experiment end, as by Ctrl-C; return why not, or empty."""
        run = self._run
        if run is None or (command.id and command.id != run.id):
            return "this experiment is not running here"
        if not run.stopped_by:
            run.stopped_by, run.stopped_s = by, self._scheduler.now_s()
            children.interrupt(run.process)
            self._note(f"{by} stops the experiment {run.name}", by)
            self._record("stopped", (self._entries or {}).get(run.id), by)
            self._tell()
        return ""

    def refusal(self) -> str:
        """Return why no experiment can be run here; empty: they can."""
        return self._missing

    # ---------------------------------------------------------------- what pages are shown
    def shown(self) -> dict[str, Any]:
        """Return the frame ``experiments``, for all pages: whether there are any, and which one runs."""
        run, running = self._run, None
        if run is not None:
            results = self._results(run.id)
            done = None if results is None else results.finished
            of = None if results is None else results.trials
            running = {"id": run.id, "name": run.name, "by": run.by, "done": done, "of": of}
        return {"t": "experiments", "refusal": self.refusal(), "running": running}

    def _list(self) -> dict[str, Any]:
        entries = None if self._entries is None else [self._entry(each) for each in self._entries.values()]
        problem = self.refusal() or self._problem
        return {"t": "experiment_list", "folder": str(self._options.folder), "problem": problem, "entries": entries}

    def _entry(self, entry: Entry) -> dict[str, Any]:
        plain: dict[str, Any] = msgspec.to_builtins(entry)
        del plain["source"], plain["out"]
        ended = self._ended.get(entry.id)
        run = self._run if self._run is not None and self._run.id == entry.id else None
        return {
            **plain,
            "can_start": bool(entry.source) and not entry.fault,
            "state": self._state(entry),
            "by": "" if run is None else run.by,
            "stopping": run is not None and bool(run.stopped_by),
            "words": "" if ended is None else ended.words,
            "bad": ended is not None and ended.bad,
            "report": f"/report/{self._key(entry.id)}/" if self._reportable(entry) else "",
        }

    def _state(self, entry: Entry) -> str:
        if self._run is not None and self._run.id == entry.id:
            return "running"
        results, ended = entry.results, self._ended.get(entry.id)
        if results is None:
            return "faulty" if entry.fault else "new"
        ours = ended is not None and self._scheduler.now_s() - ended.at_s < ELSEWHERE_S
        if results.going and not ours:
            return "elsewhere"
        return "ended" if results.over else "stopped"

    def _reportable(self, entry: Entry) -> bool:
        results = entry.results
        return results is not None and results.finished > 0 and self._state(entry) in ("ended", "stopped")

    def _key(self, entry: str) -> str:
        return self._keys.setdefault(entry, secrets.token_urlsafe(24))

    def _results(self, entry: str) -> Results | None:
        found = (self._entries or {}).get(entry)
        return None if found is None else found.results

    def _encoded(self) -> str:
        """Return the frame of the list, encoded once for all pages and however often they ask."""
        if self._text is None:
            self._text = frames.encode(self._list())
        return self._text

    def _tell(self) -> None:
        self._text = None
        self._send(self.shown())
        for listener in self._watchers:
            listener.put("experiment_list", self._encoded())

    # ---------------------------------------------------------------- reports
    def reported(self, key: str) -> tuple[Entry, str] | None:
        """Return the experiment whose report has this key, and why it has none now; None: there is no such key."""
        given = key.encode(errors="replace")
        entry = next(
            (each for each, known in self._keys.items() if secrets.compare_digest(known.encode(), given)), None
        )
        found = (self._entries or {}).get(entry or "")
        if found is None:
            return None
        return found, "" if self._reportable(
            found
        ) else "this experiment still runs: its report comes when it has ended"

    def report_made(self, entry: Entry) -> None:
        """Note that the report of an experiment is as new as its trials."""
        known = (self._entries or {}).get(entry.id)
        if self._entries is not None and known is not None and known.results is not None:
            results = msgspec.structs.replace(known.results, report="fresh")
            self._entries[entry.id] = msgspec.structs.replace(known, results=results)

    # ---------------------------------------------------------------- processes
    def _look(self) -> None:
        now_s = self._scheduler.now_s()
        if self._watchers or self._run is not None:
            self._wanted_s = now_s
        self._look_after_reader(now_s)
        changed = self._read()
        run = self._run
        if run is not None:
            if run.process.poll() is not None:
                if run.ended_s is None:
                    run.ended_s = now_s
                elif changed or now_s - run.ended_s > SETTLE_S:
                    self._finish(run)
                    changed = True
            elif run.stopped_by and now_s - run.stopped_s > STOP_S:
                children.end(run.process)
        if changed:
            self._tell()

    def _look_after_reader(self, now_s: float) -> None:
        if now_s - self._wanted_s > IDLE_S or self.refusal():
            self._end_reader()
            return
        reader = self._reader
        if reader is not None and reader.process.poll() is not None:
            self._problem = children.last_line(reader.log)[:MOST_WORDS] or "the list of experiments cannot be read"
            self._end_reader()
            self._again_s = now_s + AGAIN_S
            self._tell()
        elif reader is None and now_s >= self._again_s:
            self._start_reader()

    def _start_reader(self) -> None:
        arguments = ["experiment", "list", str(self._options.folder), "--to", str(self._file())]
        log = tempfile.TemporaryFile(dir=self._private())  # noqa: SIM115  (closed with the reader)
        try:
            process = children.start([*arguments, "--parent", str(os.getpid())], log)
        except OSError as error:
            log.close()
            self._problem, self._again_s = f"no list: {error.strerror or error}", self._scheduler.now_s() + AGAIN_S
            self._tell()
            return
        self._reader = _Reader(process, log)

    def _end_reader(self) -> None:
        if self._reader is not None:
            children.end(self._reader.process)
            self._reader.log.close()
            self._reader = None

    def _read(self) -> bool:
        """Take in the list if the reader has replaced it; return whether it has."""
        if self._folder is None:
            return False
        try:
            status = self._file().stat()
            stamp = status.st_mtime_ns, status.st_ino
            if stamp == self._stamp:
                return False
            self._stamp = stamp
            if status.st_size > LARGEST_LIST:
                raise msgspec.DecodeError("it is too large")
            found = msgspec.json.decode(self._file().read_bytes(), type=_List)
            if found.format != FORMAT:
                raise msgspec.DecodeError(f"its format is '{found.format}'")
        except FileNotFoundError:
            return False
        except (OSError, msgspec.DecodeError, UnicodeDecodeError) as error:
            self._problem = f"the list of experiments cannot be read: {error}"[:MOST_WORDS]
            return True
        self._entries, self._problem = {each.id: each for each in found.experiments}, ""
        for known in (self._keys, self._ended):
            for gone in known.keys() - self._entries.keys():
                del known[gone]
        return True

    def _finish(self, run: _Run) -> None:
        """Take in that the run has ended."""
        code = run.process.poll()
        words, bad = _outcome(code, run, children.last_line(run.log))
        run.log.close()
        self._run = None
        self._ended[run.id] = _Ended(words, bad, self._scheduler.now_s())
        self._note(f"the experiment {run.name} {words}", run.by)
        self._record("ended" if code == 0 else f"ended: {words}", (self._entries or {}).get(run.id), run.by)

    def _private(self) -> Path:
        """Return a folder that only this user may enter, for what passes between the processes."""
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="fullswarm-experiments-")
        return Path(self._folder.name)

    def _file(self) -> Path:
        return self._private() / "list.json"

    # ---------------------------------------------------------------- the audit log
    def _record(self, result: str, entry: Entry | None, by: str, what: dict[str, object] | None = None) -> None:
        if self._options.audit is None or os.name != "posix":  # as a core's log
            return
        if self._audit is None:
            self._audit = AuditLog(
                unlocked(self._options.audit), self._process, self._scheduler.now_s, self._wall_s
            )  # fmt: skip
        about = {} if entry is None else {"experiment": entry.id, "source": entry.source, "out": entry.out}
        self._audit.append(
            Event("experiment", {**about, **(what or {})}, result=result, operator=by, source=self._process)
        )


def _outcome(code: int | None, run: _Run, last: str) -> tuple[str, bool]:
    """Return what became of a run, in words, and whether that is bad."""
    if run.stopped_by:
        return f"was stopped by {run.stopped_by}", False
    if code == 0:
        return "has ended", False
    if code == 1:
        return "has ended: trials failed, or robots collided where that is not expected", True
    if code is not None and code < 0:
        return f"was ended by signal {-code}", True
    return f"could not be run: {last or f'exit code {code}'}"[:MOST_WORDS], True
