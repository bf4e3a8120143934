"""Loads behaviours under development again when their files change: `up --reload`, `demo --reload`.

The processes of a swarm on this machine watch the files of laws and records from outside this package; built-in ones
are not concerned, and no process on a robot is started so. A file that does not load changes nothing: the law or the
record before stays, and the log says why, with file and line.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Protocol

import structlog

from fullswarm import registry
from fullswarm.bus.base import Bus
from fullswarm.errors import ConfigError, FullswarmError
from fullswarm.keys import Keys
from fullswarm.messages import FileReload
from fullswarm.output import progress
from fullswarm.reasons import given
from fullswarm.runtime import Scheduler

if TYPE_CHECKING:
    from fullswarm.agent.node import AgentNode

LOOK_S = 0.15
"""Between two looks at the files. A change is taken when a second look sees the same: an editor may still write."""
STAND_S = 3.0
"""Robots that are not at standstill by then, for example because they are pushed, get the new law all the same."""

log = structlog.get_logger()

Signature = tuple[int, int]
Report = Callable[[Path, str], None]
"""Is told which file has changed, and why it does not load; an empty text: it was loaded."""


def wanted() -> bool:
    """Tell whether this process was started to load behaviours again."""
    return bool(os.environ.get(registry.DEVELOP))


class Files:
    """Notices changes of files by their time and size.

    Parameters
    ----------
    files : returns the files to watch, by name
    added : a file that comes later counts as changed
    """

    def __init__(self, files: Callable[[], Mapping[str, Path]], *, added: bool = False) -> None:
        self._files, self._added = files, False
        self._taken: dict[str, Signature | None] = {}
        self._seen: dict[str, Signature] = {}
        self._problem = ""
        self.changed()
        self._added = added

    def changed(self) -> dict[str, Path]:
        """Return the files that have changed since they were returned last, or since they were first seen."""
        found = {}
        for name, path in self._known().items():
            try:
                state = path.stat()
            except OSError:
                continue  # between two steps of an editor, or deleted
            signature = state.st_mtime_ns, state.st_size
            settled = self._seen.get(name) == signature
            self._seen[name] = signature
            if self._taken.setdefault(name, None if self._added else signature) != signature and settled:
                self._taken[name] = signature
                found[name] = path
        return found

    def _known(self) -> Mapping[str, Path]:
        """Return the files; none while the package's `pyproject.toml` is being edited and cannot be read."""
        try:
            files, problem = self._files(), ""
        except FullswarmError as error:
            files, problem = {}, str(error)
        if problem and problem != self._problem:
            log.error("the behaviours under development are unknown", error=problem)
        self._problem = problem
        return files


class Runs(Protocol):
    """What runs laws and can hold one: see :class:`LawReloader`."""

    def hold(self, law: str) -> None:
        """Stop the robots that run the law; they wait for it."""
        ...

    def at_rest(self, law: str) -> bool:
        """Tell whether these robots are at standstill."""
        ...

    def release(self, law: str) -> None:
        """Go on with the law as it is now, from the beginning: with new memory."""
        ...


class RobotsOf:
    """The robots of an agent, as :class:`Runs`."""

    def __init__(self, node: AgentNode) -> None:
        self._node = node

    def hold(self, law: str) -> None:
        """Stop the robots that run the law, until it is released."""
        for row in self._node.tasks.rows_with(law):
            self._node.controller.forget(row)
        self._node.tasks.hold(law)

    def at_rest(self, law: str) -> bool:
        """Tell whether they are at standstill."""
        return bool(self._node.standstill.at_standstill[self._node.tasks.rows_with(law)].all())

    def release(self, law: str) -> None:
        """Begin their tasks anew."""
        self._node.controller.law_failed[self._node.tasks.rows_with(law)] = False
        for row, error in self._node.tasks.release(law).items():
            self._node.inbox.ended[row] = given(str(error))
            log.error("a robot does not go on", robot=self._node.fleet.ids[row], error=str(error))


class LawReloader:
    """Loads the laws of one process again: stop first, then exchange, then go on.

    Parameters
    ----------
    loaded : returns the modules of outside laws in this process, by name
    report : is told what became of a file
    """

    def __init__(
        self, scheduler: Scheduler, runs: Runs, loaded: Callable[[], Mapping[str, ModuleType]], report: Report
    ) -> None:
        self._scheduler, self._runs, self._loaded, self._report = scheduler, runs, loaded, report
        self._files = Files(lambda: {name: registry.file_of(module) for name, module in loaded().items()})
        self._waiting: dict[str, tuple[ModuleType, float]] = {}  # law → its new module, and until when to wait
        self._timer = scheduler.every(LOOK_S, self._look)

    def close(self) -> None:
        """Stop watching."""
        self._timer.cancel()

    def _look(self) -> None:
        now_s = self._scheduler.now_s()
        for law, path in self._files.changed().items():
            try:
                module = registry.load_again(self._loaded()[law])
            except FullswarmError as error:
                log.error("a control law does not load; the one before stays", law=law, error=str(error))
                self._report(path, str(error))
                continue
            self._runs.hold(law)
            self._waiting[law] = module, now_s + STAND_S
            log.info("a control law has changed; its robots stop for it", law=law, file=str(path))
        for law, (module, deadline_s) in list(self._waiting.items()):
            if self._runs.at_rest(law) or now_s >= deadline_s:
                del self._waiting[law]
                registry.put_in_place(module)
                self._runs.release(law)
                log.info("a control law was loaded again", law=law)
                self._report(registry.file_of(module), "")


class RecordReloader:
    """Calls `take` when a record file of an outside behaviour has changed or was added."""

    def __init__(self, scheduler: Scheduler, take: Callable[[], object], report: Report) -> None:
        self._take, self._report = take, report
        self._files = Files(record_files, added=True)
        self._timer = scheduler.every(LOOK_S, self._look)

    def close(self) -> None:
        """Stop watching."""
        self._timer.cancel()

    def _look(self) -> None:
        changed = self._files.changed()
        if not changed:
            return
        names, problem = ", ".join(path.name for path in changed.values()), ""
        try:
            self._take()
        except FullswarmError as error:
            problem = str(error)
            log.error("records do not load; those before stay", files=names, error=problem)
        else:
            log.info("records were loaded again", files=names)
        for path in changed.values():
            self._report(path, problem)


class Reporter:
    """Tells the person at the terminal of `up` or `demo` what was loaded again, and what does not load."""

    def __init__(self, scheduler: Scheduler, say: Callable[[str], None]) -> None:
        self._say = say
        self._laws, self._records = Files(registry.law_files, added=True), Files(record_files, added=True)
        self._timer = scheduler.every(LOOK_S, self._look)

    def close(self) -> None:
        """Stop watching."""
        self._timer.cancel()

    def _look(self) -> None:
        from fullswarm.core.behaviours import all_records

        for law, path in self._laws.changed().items():
            self._try(path, lambda law=law: registry.check_law(law))  # type: ignore[misc]  # bound at once
        for path in self._records.changed().values():
            self._try(path, all_records)

    def _try(self, path: Path, load: Callable[[], object]) -> None:
        try:
            load()
        except FullswarmError as error:
            self._say(f"{path.name} is not loaded, what ran before goes on: {error}")
        else:
            self._say(f"{path.name} is loaded")


def reporter(bus: Bus, keys: Keys, host: str) -> Report:
    """Return what sends each report of a process to the operators."""

    def report(path: Path, problem: str) -> None:
        bus.publish(keys.reload(host), FileReload(host=host, file=str(path)[-500:], problem=problem[:500]))

    return report


def watch(develop: Path, scheduler: Scheduler) -> None:
    """Have the person at this terminal told about the behaviours of a package under development.

    Raises
    ------
    ConfigError
        Its `pyproject.toml` cannot be read, or it names no behaviour, and no other package is installed that has one.
    """
    os.environ[registry.DEVELOP] = str(develop)
    laws = registry.law_files()
    if not laws:
        hint = "`fullswarm behaviours new NAME` writes one; run this in its folder"
        raise ConfigError("there is no behaviour to load again", where=str(develop), hint=hint)
    progress(f"loading again when their files change: {', '.join(sorted(laws))}")
    Reporter(scheduler, progress)


def record_files() -> dict[str, Path]:
    """Return the record files of outside behaviours, by path."""
    return {str(file): file for file in registry.record_files()}


def folder(fleet: Path | None) -> Path:
    """Return the package under development: around here, or around the fleet file; else the present folder."""
    starts = [Path.cwd()] if fleet is None else [Path.cwd(), fleet.resolve().parent]
    for start in starts:
        for each in (start, *start.parents):
            if (each / "pyproject.toml").is_file():
                return each
    return Path.cwd()
