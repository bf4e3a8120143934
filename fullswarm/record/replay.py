"""Runs the nodes of a recording again on what they received, and compares what they do with what they did."""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import structlog
from mcap.records import Attachment, Metadata

from fullswarm import kernels
from fullswarm.errors import ConfigError
from fullswarm.journal.feed import Event, events
from fullswarm.journal.journal import FORMAT, read_block
from fullswarm.journal.naming import Difference, difference
from fullswarm.launch.journals import code_hash, rebuild
from fullswarm.output import Progress
from fullswarm.record.reading import continued, records
from fullswarm.record.recorder import JOURNAL
from fullswarm.record.recording import PROFILE

IDLE_S = 1.0
"""How often the progress is shown while processes run."""

Blocks = list[bytes]
_blocks = msgspec.msgpack.Decoder(list[tuple[str, bytes]])


@dataclass(frozen=True, slots=True)
class Window:
    """The seconds of a recording in which outputs are compared, from the first event of its first process on."""

    from_s: float = 0.0
    to_s: float = math.inf


@dataclass(slots=True)
class Outcome:
    """What came of the journal of one process.

    Attributes
    ----------
    name : robot, core, …; several processes have it, one after another, if it was started again
    seconds : from its first event to its last one
    outputs, commands : compared; commands are those to drivers
    different : events whose outputs differ; after the first of them the others may follow from it
    trouble : why its journal could not be run to its end; empty: it was
    at_s : the first difference, seconds from the beginning of the recording
    """

    process: str
    name: str
    events: int = 0
    seconds: float = 0.0
    outputs: int = 0
    commands: int = 0
    different: int = 0
    first: Difference | None = None
    at_s: float = math.nan
    trouble: str = ""


@dataclass(slots=True)
class Recorded:
    """The journals of a recording.

    Attributes
    ----------
    code : hash of the code that was recorded, see :func:`fullswarm.launch.journals.code_hash`
    about : what the file says of itself
    """

    files: list[Path]
    code: str = ""
    about: dict[str, str] = field(default_factory=dict)
    journals: dict[str, Blocks] = field(default_factory=dict)


def recorded_in(paths: Sequence[Path]) -> Recorded:
    """Read the journals of a recording.

    Parameters
    ----------
    paths : its files; those that continue one (``run.2.mcap``, …) are found by themselves

    Raises
    ------
    ConfigError
        A file cannot be read, is no recording, or none of them holds a journal.
    """
    files = list(dict.fromkeys(each for path in paths for each in (path, *continued(path))))
    found = Recorded(files)
    for file in files:
        for record in records(file):
            if isinstance(record, Metadata) and record.name == PROFILE:
                found.about = found.about or dict(record.metadata)
                found.code = found.code or record.metadata.get("code", "")
            elif isinstance(record, Attachment) and record.name == JOURNAL:
                _add(found.journals, record.data, file)
    if not found.journals:
        raise ConfigError(
            "it holds no journal, so nothing of it can be run again", where=str(files[0]),
            hint="record with `fullswarm up --record` or `fullswarm demo --record`",
        )  # fmt: skip
    return found


def _add(journals: dict[str, Blocks], data: bytes, file: Path) -> None:
    try:
        blocks = _blocks.decode(data)
    except msgspec.DecodeError as error:
        raise ConfigError(f"a journal in it is damaged: {error}", where=str(file)) from None
    for process, block in blocks:
        journals.setdefault(process, []).append(block)


def check_code(found: Recorded) -> None:
    """Raise `ConfigError` unless this is the code that was recorded."""
    if found.code and found.code != code_hash():
        version = found.about.get("version", "?")
        raise ConfigError(
            f"it was recorded with other code (fullswarm {version}, {found.code[:12]}) than this ({code_hash()[:12]})",
            where=str(found.files[0]),
            hint="install that version, or use --with-code to run the nodes of today on what was received then",
        )


def replay(found: Recorded, robots: Sequence[str], window: Window, jobs: int) -> list[Outcome]:
    """Run the nodes again, each process by itself; return what came of it, in the order of the processes' starts.

    Parameters
    ----------
    robots : only these processes, by name: robots' ids, ``core``, ``centralised``; empty: all
    jobs : processes at once; 0: one per processor

    Raises
    ------
    ConfigError
        The recording has no such process.
    """
    begun = {process: _begun(blocks) for process, blocks in found.journals.items()}
    names = {process: each.name for process, each in begun.items()}
    if unknown := [each for each in robots if each not in names.values()]:
        raise ConfigError(
            f"no journal of '{unknown[0]}' is in it", where=str(found.files[0]),
            hint=f"there are: {', '.join(sorted(set(names.values())))}",
        )  # fmt: skip
    start_s = min((each.time_s for each in begun.values() if not math.isnan(each.time_s)), default=0.0)
    chosen = [process for process in found.journals if not robots or names[process] in robots]
    outcomes: dict[str, Outcome] = {}
    with Progress("processes", len(chosen)) as progress:
        for compiled in (False, True):  # which holds for all of a worker
            work = {
                process: (process, names[process], found.journals[process], start_s, window)
                for process in chosen
                if begun[process].compiled is compiled
            }
            outcomes |= _run_all(work, jobs, len(outcomes), progress)
    return [outcomes[process] for process in chosen]


def _run_all(
    work: dict[str, tuple[str, str, Blocks, float, Window]], jobs: int, done: int, progress: Progress
) -> dict[str, Outcome]:
    if not work:
        return {}
    count = min(jobs or os.cpu_count() or 1, len(work))
    outcomes = {}
    with ProcessPoolExecutor(count, multiprocessing.get_context("spawn")) as pool:
        futures = {process: pool.submit(run_journal, *each) for process, each in work.items()}
        waiting = set(futures.values())
        while waiting:
            _, waiting = wait(waiting, IDLE_S, return_when=FIRST_COMPLETED)
            progress.at(done + len(futures) - len(waiting))
        for process, future in futures.items():
            try:
                outcomes[process] = future.result()
            except BrokenProcessPool:
                outcomes[process] = Outcome(process, work[process][1], trouble="the process that ran it died")
    return outcomes


class Begun(NamedTuple):
    """The beginning of a journal: its process's name, the time of its first event, NaN where that is missing."""

    name: str = "?"
    time_s: float = math.nan
    compiled: bool = False


def _begun(blocks: Blocks) -> Begun:
    try:
        number, items = read_block(min(blocks, key=_number))
        if number:
            return Begun()
        head = items[0]
        name = head["kind"] if head["kind"] != "agent" else head["host"]
        first = next(events(items[1:]), None)
        return Begun(str(name), math.nan if first is None else first.time_s, head["compiled"] is True)
    except (ValueError, KeyError, TypeError, IndexError):
        return Begun()


def _number(block: bytes) -> int:
    return read_block(block)[0]


def run_journal(process: str, name: str, blocks: Blocks, start_s: float, window: Window) -> Outcome:
    """Run the nodes of one journal again."""
    _be_quiet()
    outcome = Outcome(process, name)
    try:
        items = _items(blocks, outcome)
        head = next(items)
        if not isinstance(head, dict) or head.get("format") != FORMAT:
            raise ValueError("its journal has another format")
        if head["compiled"] and not kernels.compile_all():
            outcome.trouble = "it ran with compiled kernels: pip install 'fullswarm[sim]'"
            return outcome
        _run(head, events(items), start_s, window, outcome)
    except (ValueError, KeyError, TypeError, StopIteration, ConfigError) as error:
        outcome.trouble = outcome.trouble or str(error) or "its journal has no beginning"
    return outcome


def _run(head: dict[str, Any], found: Iterator[Event], start_s: float, window: Window, outcome: Outcome) -> None:
    rebuilt = rebuild(head)
    first_s = math.nan
    try:
        for event in found:
            gone = rebuilt.feed.run(event, rebuilt.calls)
            outcome.events += 1
            first_s = event.time_s if math.isnan(first_s) else first_s
            outcome.seconds = max(outcome.seconds, event.time_s - first_s)
            at_s = event.time_s - start_s
            if at_s > window.to_s:
                break
            if at_s < window.from_s:
                continue
            outcome.outputs += len(event.outputs)
            outcome.commands += len(event.commands)
            differs = difference(event, rebuilt.feed.outputs, gone, rebuilt.robots)
            if differs is not None:
                outcome.different += 1
                if outcome.first is None:
                    outcome.first, outcome.at_s = differs, at_s
    finally:
        rebuilt.close()


def _items(blocks: Blocks, outcome: Outcome) -> Iterator[Any]:
    """Yield the items of blocks in their order, up to a gap."""
    due = 0
    for number, items in _in_order(blocks):
        if number < due:  # a recorder that was started again read it once more
            continue
        if number > due:
            outcome.trouble = (
                "the beginning of its journal is missing: give all files of the recording"
                if due == 0
                else f"{number - due} blocks of its journal are missing; it was run up to there"
            )
            return
        due += 1
        yield from items


def _in_order(blocks: Blocks) -> Iterator[tuple[int, list[Any]]]:
    for _, block in sorted((_number(block), place) for place, block in enumerate(blocks)):
        yield read_block(blocks[block])


def _be_quiet() -> None:
    """Keep what the nodes log to themselves: they logged it when they ran."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
