"""Shows the progress of a running experiment (`fullswarm experiment watch`): reads its folder each second."""

from __future__ import annotations

import itertools
import json
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import msgspec
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from fullswarm import output
from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment import CellResult, TrialResult, summarise
from fullswarm.evaluate.results.folder import older_text
from fullswarm.evaluate.trial_folder import RESULT_FILE, TRIALS, Record
from fullswarm.runtime import Runtime

REFRESH_S = 1.0
LEFT = "left; the experiment goes on"


@dataclass(frozen=True, slots=True)
class Watch:
    """The options of the command line."""

    folder: Path
    once: bool = False
    as_json: bool = False


def watch(wanted: Watch, runtime: Runtime | None = None, wall_s: Callable[[], float] = wall_time_s) -> int:
    """Show how an experiment goes until all its trials have ended or Ctrl-C; return 0.

    Parameters
    ----------
    runtime : its clock and timers
    wall_s : seconds since 1970, as the folder's files have them

    Raises
    ------
    ConfigError
        The folder is missing, unreadable, or no experiment writes there.
    """
    folder = ExperimentFolder(wanted.folder)
    folder.refresh()
    if wanted.once:
        _print(progress_of(folder, wall_s()), wall_s(), as_json=wanted.as_json)
        return 0
    runtime = runtime or Runtime(MonotonicClock())
    try:
        if wanted.as_json:
            _lines(folder, runtime, wall_s)
        else:
            _live(folder, runtime, wall_s)
    except KeyboardInterrupt:
        output.progress(LEFT)
    if not wanted.as_json:
        _print(progress_of(folder, wall_s()), wall_s(), as_json=False)
    return 0


def _print(progress: Progress, now_s: float, *, as_json: bool) -> None:
    if as_json:
        output.data_json(progress.to_json(now_s))
    else:
        output.data_table(view(progress, now_s), into_file=130)


def _live(folder: ExperimentFolder, runtime: Runtime, wall_s: Callable[[], float]) -> None:
    console = Console(highlight=False)
    if not console.is_terminal:
        _told(folder, runtime, wall_s)
        return
    # rich's own refreshing would need a thread; the runtime's timer does.
    with Live(console=console, auto_refresh=False, screen=True, transient=True) as live:

        def refresh() -> None:
            folder.refresh()
            progress = progress_of(folder, wall_s())
            live.update(view(progress, wall_s(), console.size.height), refresh=True)
            if progress.over:
                runtime.stop()

        runtime.every(REFRESH_S, refresh, first_s=0.0)
        runtime.run()


def _told(folder: ExperimentFolder, runtime: Runtime, wall_s: Callable[[], float]) -> None:
    """Print a line on stderr now and each few seconds, for a pipe."""
    with output.Progress("trials", clock=runtime, at_once=True) as shown:

        def refresh() -> None:
            folder.refresh()
            progress = progress_of(folder, wall_s())
            note = f"{progress.collisions} collisions, {progress.failed} failed"
            shown.parts(progress.finished, progress.total or 0, note, progress.left_s)
            if progress.over:
                runtime.stop()

        runtime.every(REFRESH_S, refresh, first_s=0.0)
        runtime.run()


def _lines(folder: ExperimentFolder, runtime: Runtime, wall_s: Callable[[], float]) -> None:
    """Print one line of JSON now and at each change."""
    first = True

    def refresh() -> None:
        nonlocal first
        changed = folder.refresh() or first
        first = False
        if changed:
            progress = progress_of(folder, wall_s())
            output.data(json.dumps(progress.to_json(wall_s()), allow_nan=False, ensure_ascii=False))
            if progress.over:
                runtime.stop()

    runtime.every(REFRESH_S, refresh, first_s=0.0)
    runtime.run()


EXPERIMENT_FILE = "experiment.json"
RECENT = 60
"""Speed and time left are those of so many of the last trials."""
PAUSE_S, PAUSE_GAPS = 30.0, 20.0
"""Nothing finished for so long, and for so many times as long as usual: then it was not running."""
LAST = 5
"""How many of the last finished trials are shown."""


@dataclass(frozen=True, slots=True)
class Finished:
    """A trial that has a result."""

    record: Record
    at_s: float  # since 1970
    stamp: tuple[int, int]  # changes when the file is replaced

    @property
    def result(self) -> TrialResult:
        """What `summarise` joins."""
        record = self.record
        return TrialResult(seed=record.trial.seed, outcome=record.outcome, failure=record.failure)


class ExperimentFolder:
    """Reads each trial once, when its directory comes; failed ones again when they were run again.

    Raises
    ------
    ConfigError
        The folder does not exist, or no experiment writes there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.finished: dict[str, Finished] = {}  # by the name of the directory
        self.unreadable: dict[str, str] = {}  # name → why
        self.asked: dict[str, Any] = {}  # experiment.json
        if not path.is_dir():
            raise ConfigError("no such folder", where=str(path))
        if not ((path / TRIALS).is_dir() or (path / EXPERIMENT_FILE).is_file()):
            raise ConfigError(
                f"holds neither {TRIALS}/ nor {EXPERIMENT_FILE}",
                where=str(path),
                hint="name the folder of `fullswarm experiment run … --out FOLDER`",
            )

    def refresh(self) -> bool:
        """Read what is new; return whether anything was."""
        changed = self._read_asked()
        names = set()
        for name in self._names():
            names.add(name)
            known = self.finished.get(name)
            if known is None or known.record.outcome is None:
                changed |= self._read(name, known)
        for name in self.finished.keys() - names:
            del self.finished[name]
            changed = True
        return changed

    def _names(self) -> Iterator[str]:
        """Yield the trials' directories; hidden ones are still being written."""
        try:
            with os.scandir(self.path / TRIALS) as entries:
                yield from (each.name for each in entries if not each.name.startswith("."))
        except FileNotFoundError:
            return
        except OSError as error:
            raise ConfigError(f"cannot read it: {error.strerror}", where=str(self.path / TRIALS)) from error

    def _read(self, name: str, known: Finished | None) -> bool:
        file = self.path / TRIALS / name / RESULT_FILE
        try:
            status = file.stat()
            stamp = (status.st_mtime_ns, status.st_ino)
            if known is not None and known.stamp == stamp:
                return False
            record = msgspec.json.decode(file.read_bytes(), type=Record)
        except (FileNotFoundError, NotADirectoryError):
            return False  # moved away to be run again, or no trial at all
        except (OSError, msgspec.DecodeError, ValueError) as error:  # ValueError: not UTF-8
            new = name not in self.unreadable
            self.unreadable[name] = str(error)
            return new
        self.unreadable.pop(name, None)
        self.finished[name] = Finished(record, status.st_mtime, stamp)
        return True

    def _read_asked(self) -> bool:
        try:
            asked = msgspec.json.decode((self.path / EXPERIMENT_FILE).read_bytes())
        except (OSError, msgspec.DecodeError, ValueError):
            return False  # not there yet, or no JSON: none of it is needed
        changed = isinstance(asked, dict) and asked != self.asked
        if changed:
            self.asked = asked
        return changed


@dataclass(frozen=True, slots=True)
class Progress:
    """How it goes."""

    name: str
    total: int | None  # None: not written
    finished: int  # with an outcome or failed
    failed: int
    collisions: int
    arrived_fraction: float  # of robots; NaN before the first trial
    simulated_s: float
    trials_per_s: float | None  # None: too few trials
    real_time_factor: float | None  # simulated seconds per second
    left_s: float | None
    cells: tuple[CellResult, ...]  # the one that a trial finished in last comes first
    last: tuple[Finished, ...]  # newest first
    unreadable: tuple[str, ...]
    older: int = 0  # trials of older settings: in no figure

    @property
    def over(self) -> bool:
        """All trials have ended."""
        return self.total is not None and self.finished >= self.total

    def to_json(self, now_s: float) -> dict[str, Any]:
        """Return the document of ``--json``; unknown is null."""
        return {
            "name": self.name,
            "trials": self.total,
            "finished": self.finished,
            "failed": self.failed,
            "collisions": self.collisions,
            "arrived_fraction": None if math.isnan(self.arrived_fraction) else round(self.arrived_fraction, 6),
            "simulated_s": round(self.simulated_s, 3),
            "trials_per_s": _rounded(self.trials_per_s),
            "real_time_factor": _rounded(self.real_time_factor),
            "left_s": _rounded(self.left_s),
            "over": self.over,
            "unreadable": list(self.unreadable),
            "older": self.older,
            "cells": [each.to_json() for each in self.cells],
            "last": [_last_json(each, now_s) for each in self.last],
        }


def progress_of(folder: ExperimentFolder, now_s: float) -> Progress:
    """Return how it goes at a time, in seconds since 1970."""
    wanted = folder.asked.get("trials")
    ids = set(wanted) if isinstance(wanted, list) and wanted else folder.finished.keys()
    found = [each for name, each in folder.finished.items() if name in ids]  # the others are of older settings
    newest = sorted(found, key=lambda each: (each.at_s, each.record.id), reverse=True)
    report = summarise((each.record.trial, each.result) for each in newest)
    outcomes = [each.record.outcome for each in newest if each.record.outcome]
    robots = sum(each.robots for each in outcomes)
    total = _total(folder.asked)
    rate, factor = _speed(newest, _started_s(folder.asked), now_s)
    left = None if total is None else max(0, total - len(newest))
    return Progress(
        name=_name(folder, newest),
        total=total,
        finished=len(newest),
        failed=report.trials_failed,
        collisions=report.collisions,
        arrived_fraction=sum(each.arrived for each in outcomes) / robots if robots else math.nan,
        simulated_s=report.simulated_s,
        trials_per_s=rate,
        real_time_factor=factor,
        left_s=0.0 if left == 0 else None if left is None or not rate else left / rate,
        cells=tuple(report.cells),
        last=tuple(newest[:LAST]),
        unreadable=tuple(sorted(folder.unreadable)),
        older=len(folder.finished) - len(found),
    )


def _speed(newest: list[Finished], started_s: float, now_s: float) -> tuple[float | None, float | None]:
    """Return trials per second and simulated seconds per second of the last trials since the start."""
    recent = _without_pauses([each for each in newest[: RECENT + 1] if each.at_s >= started_s], now_s)
    if len(recent) < 2:
        return None, None
    # The oldest one only shows when the others began. Trials that take longer now slow it down.
    span_s = max(now_s, recent[0].at_s) - recent[-1].at_s
    if span_s <= 0.0:
        return None, None
    outcomes = (each.record.outcome for each in recent[:-1])
    return (len(recent) - 1) / span_s, sum(each.simulated_s for each in outcomes if each) / span_s


def _without_pauses(newest: list[Finished], now_s: float) -> list[Finished]:
    """Return those since the experiment was started again; none when it does not seem to run now."""
    gaps_s = [after.at_s - before.at_s for after, before in itertools.pairwise(newest)]
    if not gaps_s:
        return newest
    longest_s = max(PAUSE_S, PAUSE_GAPS * median(gaps_s))
    if now_s - newest[0].at_s > longest_s:
        return []
    since = next((row for row, gap_s in enumerate(gaps_s) if gap_s > longest_s), len(gaps_s))
    return newest[: since + 1]


def _total(asked: dict[str, Any]) -> int | None:
    """Return the number of trials; their list does too."""
    trials = asked.get("trials")
    if isinstance(trials, (list, dict)):
        return len(trials)
    return trials if isinstance(trials, int) and not isinstance(trials, bool) and trials >= 0 else None


def _started_s(asked: dict[str, Any]) -> float:
    """Return when it was started last, since 1970: what was finished before does not count for its speed."""
    try:
        started = datetime.fromisoformat(asked["started"])
    except (KeyError, TypeError, ValueError):
        return -math.inf
    return (started if started.tzinfo else started.replace(tzinfo=UTC)).timestamp()


def _name(folder: ExperimentFolder, newest: list[Finished]) -> str:
    for key in ("name", "experiment"):
        if isinstance(folder.asked.get(key), str):
            return str(folder.asked[key])
    return newest[0].record.experiment if newest else folder.path.name


def _last_json(each: Finished, now_s: float) -> dict[str, Any]:
    record, outcome = each.record, each.record.outcome
    return {
        "id": record.id,
        "ago_s": round(max(0.0, now_s - each.at_s), 1),
        "end_reason": record.end_reason,
        "failure": record.failure,
        "robots": record.trial.cell.robots,
        "arrived": None if outcome is None else outcome.arrived,
        "collisions": None if outcome is None else outcome.events,
        "simulated_s": None if outcome is None else round(outcome.simulated_s, 3),
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


AROUND = 10
"""Lines of the view besides the cells and the last trials."""
BAR = 60
"""Letters of the line that fills."""


def view(progress: Progress, now_s: float, max_lines: int | None = None) -> RenderableType:
    """Return all of it; cells that do not fit into `max_lines` are counted instead."""
    room = None if max_lines is None else max(3, max_lines - AROUND - len(progress.last))
    parts: list[RenderableType] = [Text(headline(progress), style="bold")]
    if progress.total:
        parts.append(bar(progress.finished / progress.total))
    parts.append(Text(details(progress)))
    if progress.last and progress.trials_per_s is None and not progress.over:
        still_s = max(0.0, now_s - progress.last[0].at_s)
        if still_s > PAUSE_S:
            parts.append(Text(f"nothing has finished for {span(still_s)}", style="yellow"))
    parts += [Text(), cell_table(progress.cells[:room])]
    if room is not None and len(progress.cells) > room:
        parts.append(Text(f"and {len(progress.cells) - room} more cells", style="dim"))
    if progress.last:
        parts += [
            Text(),
            Text("last finished", style="bold"),
            last_table(progress.last, now_s, one_line=room is not None),
        ]
    if progress.older:
        parts.append(Text(older_text(progress.older), style="yellow"))
    if progress.unreadable:
        parts.append(Text(f"unreadable: {', '.join(progress.unreadable[:3])}", style="red"))
    return Group(*parts)


def bar(share: float) -> Text:
    """Return a line that is filled to a share."""
    filled = min(BAR, int(BAR * share))
    return Text.assemble(("━" * filled, "green"), ("─" * (BAR - filled), "dim"))


def headline(progress: Progress) -> str:
    """Return the first line: ``paper: 120 of 640 trials, about 3 min left``."""
    of = "" if progress.total is None else f" of {progress.total}"
    left = "" if progress.left_s is None else f", about {span(progress.left_s)} left"
    return f"{progress.name}: {progress.finished}{of} trials{', all done' if progress.over else left}"


def details(progress: Progress) -> str:
    """Return the second line."""
    words = [_count(progress.collisions), f"{progress.failed} failed"]
    if not math.isnan(progress.arrived_fraction):
        words.append(f"{100 * progress.arrived_fraction:.1f} % of robots arrived")
    if progress.trials_per_s is not None and not progress.over:
        words.append(f"{60 * progress.trials_per_s:.1f} trials/min")
    if progress.real_time_factor is not None and not progress.over:
        words.append(f"{progress.real_time_factor:.0f} x real time")
    words.append(f"{span(progress.simulated_s)} simulated")
    return ", ".join(words)


def cell_table(cells: tuple[CellResult, ...]) -> Table:
    """Return a row for each cell."""
    table = output.plain_table()
    groups = len({each.cell.group for each in cells}) > 1  # cells may differ in nothing else that is shown
    for name in ("group", "behaviour", "scenario", "engine", "limits")[not groups :]:
        table.add_column(name, no_wrap=True, overflow="ellipsis")
    for name in ("N", "done", "coll.", "robots %", "failed"):
        table.add_column(name, justify="right", no_wrap=True, min_width=len(name))
    for each in cells:
        of = each.cell
        table.add_row(
            *(escape(text) for text in (of.group, of.label, of.scenario, of.engine, of.limits)[not groups :]),
            str(of.robots),
            str(len(each.results)),
            "-" if each.is_empty else str(each.collisions),
            "-" if each.is_empty else f"{100 * each.arrived_fraction:.1f}",
            str(len(each.failed)),
            style="red" if each.failed or (each.collisions and not of.collisions_expected) else None,
        )
    return table


def last_table(last: tuple[Finished, ...], now_s: float, *, one_line: bool) -> Table:
    """Return a row for each of the last trials; it may have several lines unless the screen counts them."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(no_wrap=True, justify="right")
    table.add_column(no_wrap=True, overflow="ellipsis")
    table.add_column(no_wrap=one_line, overflow="ellipsis" if one_line else "fold")
    for each in last:
        record, outcome = each.record, each.record.outcome
        if outcome is None:
            text = f"failed: {record.failure}"
        else:
            collisions = f", {_count(outcome.events)}" if outcome.events else ""
            text = f"{outcome.arrived}/{outcome.robots} arrived in {outcome.simulated_s:.1f} s{collisions}"
        ago = f"{span(max(0.0, now_s - each.at_s))} ago"
        style = "red" if outcome is None or outcome.events else None
        table.add_row(ago, escape(record.trial.label), escape(text), style=style)
    return table


def _count(collisions: int) -> str:
    return f"{collisions} collision{'' if collisions == 1 else 's'}"


def span(seconds: float) -> str:
    """Return a time for people: ``8 s``, ``3 min``, ``2.5 h``."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1f} h"
