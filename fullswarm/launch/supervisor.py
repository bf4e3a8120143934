"""Starts the processes of a swarm on this machine, watches them, restarts those that died or froze, ends them in order.

A process is frozen when its loop has written nothing to its pipe for a second (:mod:`fullswarm.launch.liveness`); after
:data:`FROZEN_S` it is killed and started again like one that died. Time counts by the supervisor's own watch, so that a
suspended computer, or a supervisor that was stopped itself, finds no process frozen.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import structlog

from fullswarm import registry
from fullswarm.bus.base import CORE, Bus, NamedBus, SenderBus
from fullswarm.bus.report_query import ReportsOnQuery
from fullswarm.config import SwarmConfig
from fullswarm.config.fleet_file import write_swarm
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.launch.journals import FOLDER as JOURNALS
from fullswarm.launch.liveness import ALIVE, AlivePipe
from fullswarm.launch.processes import PARENT, RUN
from fullswarm.launch.run_folder import RunFolder, bound_log
from fullswarm.launch.spare import FLEET, Spare
from fullswarm.messages import ProcessEnd, ProcessPhase, ProcessReport, ProcessState
from fullswarm.runtime import Scheduler

log = structlog.get_logger()

WATCH_S = 0.1
FIRST_BACKOFF_S = 0.3
LAST_BACKOFF_S = 5.0
STEADY_S = 10.0
"""A process that ran so long is started again as soon as one that dies for the first time."""
SILENT_S = 1.0
"""A process whose loop has shown no sign of life for so long is reported as frozen."""
FROZEN_S = 5.0
"""And is killed after so long: well above what a loaded machine delays a loop."""
REPORT_S = 0.5
"""`status` collects for a second."""
LONGEST_TEXT = 500
END_S = 2.0
"""How long processes may take to end before they are killed; ours take well under a second."""
LOG_BYTES = 4 * 2**20
"""A longer log of a process begins anew, and what it held is kept once."""
LOGS_S = 1.0
SPARES = 2
"""One may be used while the next is still being made: on a busy machine that takes several seconds."""
SPARE_FIRST_S, SPARE_NEXT_S = 15.0, 2.0
"""They are made so long after the start, and after another one was made or used: not while others come up."""
SPARE_LOG = "spare.process.log"
"""No process is called so: names have no dots."""
FROZEN: Literal["frozen"] = "frozen"
CONSOLE, RECORDER = "console", "recorder"
FIXES = "fixes"
"""The process that publishes the poses of the fleet file's sources."""
STORE = "core.db"
"""The core's local database, where the fleet file names none: it lasts as long as the supervisor."""
USAGE = 2
"""Exit code of a process that will not come up however often it is started: its settings are wrong."""


@dataclass(slots=True)
class Child:
    """One process of the swarm.

    Parameters
    ----------
    guest : not one of the swarm's own: it may fail without ending the supervisor, and its stdout is kept apart
    """

    name: str
    arguments: tuple[str, ...]
    guest: bool = False
    process: subprocess.Popen[bytes] | None = None
    starts: int = 0
    started_s: float = 0.0
    backoff_s: float = FIRST_BACKOFF_S
    again_s: float = 0.0
    given_up: str = ""
    pipe: AlivePipe | None = None
    silent_s: float = 0.0
    killed: bool = False  # because it was frozen
    ended: ProcessEnd = ""
    code: int = 0
    phase: ProcessPhase = "starting"
    phase_s: float = 0.0

    def looks(self) -> ProcessPhase:
        """Return its phase now; one without a sign of life yet counts as starting."""
        if self.given_up:
            return "given_up"
        if self.process is None or self.process.poll() is not None:
            return "ended"
        if self.pipe is None or not self.pipe.seen:
            return "starting"
        return "frozen" if self.silent_s >= SILENT_S else "running"


@dataclass(slots=True)
class Supervisor:
    """The processes of one fleet file on this machine.

    Parameters
    ----------
    restart : start a process again when it has died
    world : start the world, if the fleet has simulated robots
    develop : folder of a package under development: its laws and records are loaded again when they change
    journals : folder for the journals of the processes, see :mod:`fullswarm.launch.journals`; None: there are none
    on_end : called with a process that has ended by itself, before it is started again
    """

    config: SwarmConfig
    scheduler: Scheduler
    restart: bool = True
    world: bool = True
    insecure_network: bool = False
    develop: Path | None = None
    journals: Path | None = None
    on_end: Callable[[Child], None] | None = None
    children: dict[str, Child] = field(default_factory=dict)
    _reports: tuple[Bus, str, str] | None = None  # bus, key, host
    _on_query: ReportsOnQuery | None = None
    _reported_s: float = -REPORT_S
    _watched_s: float = 0.0
    _run: RunFolder = field(default_factory=RunFolder)
    _spares: list[Spare] = field(default_factory=list)  # the oldest first
    _spare_again_s: float = math.inf  # when the next one may be made
    folder: Path = field(init=False)

    def __post_init__(self) -> None:
        self.folder = self._run.path
        network = self.config.network
        if network.conditions is not None and network.since_s is None:
            # One zero for all, also for a process that is started again; they share this machine's clock.
            section = network.model_copy(update={"since_s": self.scheduler.now_s()})
            self.config = self.config.model_copy(update={"network": section})

    def start(self) -> None:
        """Write the fleet file for the children and start them all."""
        fleet = self.folder / FLEET
        write_swarm(self._with_memory(), fleet)
        network = ("--insecure-network",) if self.insecure_network else ()
        file = ("--fleet", str(fleet))
        self.add("hub", "hub", "--listen", self.config.hub.endpoint, "--swarm", self.config.swarm, *network)
        self.add("core", "core", *file)
        self.add("centralised", "centralised", *file)
        if self.world and any(each.simulated for each in self.config.robot):
            self.add("world", "sim", *file, *network)
        if self.config.fixes:
            self.add(FIXES, "fixes", *file)
        for camera in self.config.camera:
            self.add(f"camera-{camera.name}", "track", "run", str(fleet), "--camera", camera.name, *network)
        for each in self.config.robot:
            if not each.elsewhere:  # a second agent of its name would be on the bus, with another robot's port
                self.add(each.id, "agent", each.id, *file)
        for child in self.children.values():
            self._spawn(child)
        self.scheduler.every(WATCH_S, self._watch)
        self.scheduler.every(LOGS_S, self._bound_logs)
        if self.restart and self.develop is None:  # it would have imported what is then changed
            self._spare_again_s = self.scheduler.now_s() + SPARE_FIRST_S

    def add(self, name: str, *arguments: str, guest: bool = False) -> None:
        """Have another process of the ``fullswarm`` command beside the swarm's own; before :meth:`start`.

        Raises
        ------
        ConfigError
            A process is called so already.
        """
        if name in self.children:
            raise ConfigError(f"a robot cannot be called '{name}': a process of the swarm is", where="robot.id")
        self.children[name] = Child(name, arguments, guest)

    def kill(self, name: str, number: signal.Signals | None = None) -> None:
        """Send a signal to a child, SIGKILL if none is named: what a crash, a power cut or an operator does."""
        number = number or signal.SIGKILL
        process = self.children[name].process
        if process is not None:
            process.send_signal(number)
            if number == signal.SIGKILL:
                process.wait()

    def revive(self, name: str) -> None:
        """Start a dead child again now."""
        self._spawn(self.children[name])

    def alive(self, name: str) -> bool:
        """Return whether a child runs."""
        process = self.children[name].process
        return process is not None and process.poll() is None

    def output(self, name: str) -> Path:
        """Return the file with what a guest wrote to stdout, which is for data; its log has the rest."""
        return self.folder / f"{name}.out"

    def log_tail(self, name: str, lines: int = 5) -> str:
        """Return the end of what a child wrote to stderr."""
        path = self.log_file(name)
        return "\n".join(path.read_text(errors="replace").splitlines()[-lines:]) if path.exists() else ""

    def report_to(self, bus: SenderBus) -> None:
        """Publish how the processes are, from now on: twice a second and when one changes its phase."""
        host = re.sub(r"[^A-Za-z0-9_-]", "-", socket.gethostname())[:64]
        named, keys = NamedBus(bus, CORE), Keys(self.config.swarm)
        self._reports = named, keys.processes(host), host
        self._on_query = ReportsOnQuery(named, keys, self.scheduler, self._report_soon)

    def _report_soon(self) -> None:
        self._reported_s = -REPORT_S

    def kept_folder(self) -> Path:
        """Return the folder with the logs, which then outlasts this run for some days: for an error that names it."""
        self._run.keep()
        return self.folder

    def close(self) -> None:
        """End all: robots first, so that each stops its own wheels while the rest is still there. Remove the folder."""
        if self._on_query is not None:
            self._on_query.close()
        while self._spares:
            self._spares.pop().close()
        support = (RECORDER, "world", "centralised", "core", "hub")
        rest = [self.children[name] for name in support if name in self.children]
        console = [self.children[name] for name in (CONSOLE,) if name in self.children]  # nothing needs it
        robots = [each for each in self.children.values() if each not in (*rest, *console)]
        _terminate((*robots, *console))
        self._reap(robots)
        _terminate(rest)
        self._reap((*console, *rest))
        for child in self.children.values():
            if child.pipe is not None:
                child.pipe.close()
        self._run.close()

    def _reap(self, children: Iterable[Child]) -> None:
        """Wait until processes have ended, all of them for `END_S` at most; then kill."""
        until_s = self.scheduler.now_s() + END_S
        for child in children:
            if child.process is None:
                continue
            try:
                child.process.wait(max(0.0, until_s - self.scheduler.now_s()))
            except subprocess.TimeoutExpired:
                log.warning("a process did not end and is killed", process=child.name)
                with contextlib.suppress(ProcessLookupError):
                    child.process.kill()
                child.process.wait()

    def _with_memory(self) -> SwarmConfig:
        """Return the settings for the children: a core that is started again must know what it had accepted."""
        core = self.config.core
        if core.store is not None:
            return self.config
        return self.config.model_copy(update={"core": core.model_copy(update={"store": self.folder / STORE})})

    def _spawn(self, child: Child) -> None:
        if child.pipe is not None:
            child.pipe.close()
        child.silent_s, child.killed = 0.0, False
        log_file = self.log_file(child.name)
        data = self.output(child.name) if child.guest else log_file
        arguments = (*child.arguments, "--with-parent")
        spare = self._use_spare(arguments, log_file, data)
        child.process, child.pipe = spare or self._start(arguments, log_file, data)
        child.starts += 1
        child.started_s = self.scheduler.now_s()

    def _use_spare(
        self, arguments: tuple[str, ...], log_file: Path, data: Path
    ) -> tuple[subprocess.Popen[bytes], AlivePipe] | None:
        while self._spares:
            spare = self._spares.pop(0)
            self._spare_again_s = self.scheduler.now_s() + SPARE_NEXT_S
            if spare.become(arguments, log_file, data):
                return spare.process, spare.pipe
            spare.close()
        return None

    def _start(
        self, arguments: tuple[str, ...], log_file: Path, data: Path
    ) -> tuple[subprocess.Popen[bytes], AlivePipe]:
        pipe = AlivePipe()
        with log_file.open("ab") as sink, data.open("ab") as output:
            process = subprocess.Popen(  # noqa: S603  (our own interpreter and our own module)
                [sys.executable, "-m", "fullswarm", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=sink,
                env={**self._environment(), ALIVE: str(pipe.inherited)},
                pass_fds=(pipe.inherited,),
                start_new_session=True,  # Ctrl-C goes to the supervisor alone, which ends them in order
            )
        pipe.close_inherited()
        return process, pipe

    def _environment(self) -> dict[str, str]:
        found = {**os.environ, "PYTHONUNBUFFERED": "1", PARENT: str(os.getpid()), RUN: str(self.folder)}
        if self.develop is not None:
            found[registry.DEVELOP] = str(self.develop)
        if self.journals is not None:
            found[JOURNALS] = str(self.journals)
        return found

    def _bound_logs(self) -> None:
        for child in self.children.values():
            bound_log(self.log_file(child.name), LOG_BYTES)

    def log_file(self, name: str) -> Path:
        """Return the file with what a child writes to stderr."""
        return self.folder / f"{name}.log"

    def _watch(self) -> None:
        now_s = self.scheduler.now_s()
        # A watch that is late was itself kept from running, perhaps with the whole computer: the rest does not count.
        passed_s, self._watched_s = min(now_s - self._watched_s, 2.0 * WATCH_S), now_s
        for child in self.children.values():
            if child.process is None or child.given_up:
                continue
            code = child.process.poll()
            if code is None:
                self._watch_loop(child, child.process, passed_s)
            elif code == USAGE or not self.restart:
                _note_end(child, code)
                child.given_up = self.log_tail(child.name) or f"ended with code {code}"
                if code == USAGE and not child.guest:
                    raise ConfigError(child.given_up.removeprefix("error: "), where=child.name)
            elif child.again_s == 0.0:
                _note_end(child, code)
                if self.on_end is None:
                    log.warning("a process died and is started again", process=child.name, code=code)
                else:
                    self.on_end(child)
                if now_s - child.started_s > STEADY_S:
                    child.backoff_s = FIRST_BACKOFF_S
                    self._spawn(child)
                else:
                    child.again_s = now_s + child.backoff_s
            elif now_s >= child.again_s:
                child.again_s = 0.0
                child.backoff_s = min(2.0 * child.backoff_s, LAST_BACKOFF_S)
                self._spawn(child)
        if len(self._spares) < SPARES and now_s >= self._spare_again_s:
            self._spares.append(Spare(self._environment(), self.folder / SPARE_LOG))
            self._spare_again_s = now_s + SPARE_NEXT_S
        self._report(now_s)

    def _watch_loop(self, child: Child, process: subprocess.Popen[bytes], passed_s: float) -> None:
        """Kill a running process whose loop hangs; one that has not come up yet is left alone."""
        if child.pipe is None or child.pipe.read() or not child.pipe.seen:
            child.silent_s = 0.0
            return
        child.silent_s += passed_s
        if self.restart and child.silent_s >= FROZEN_S and not child.killed:
            if self.on_end is None:
                log.warning("a process is frozen and is killed", process=child.name, silent_s=round(child.silent_s, 1))
            child.killed = True
            _note_end(child, -signal.SIGKILL)
            process.kill()

    def _report(self, now_s: float) -> None:
        changed = False
        for child in self.children.values():
            phase = child.looks()
            if phase != child.phase:
                changed, child.phase, child.phase_s = True, phase, now_s
        if self._reports is None or not (changed or now_s - self._reported_s >= REPORT_S):
            return
        self._reported_s = now_s
        bus, key, host = self._reports
        states = tuple(_state(child, now_s) for child in self.children.values())
        bus.publish(key, ProcessReport(host=host, processes=states, stamp_s=now_s))


def _note_end(child: Child, code: int) -> None:
    """Record how a process ended, for the report."""
    child.ended = FROZEN if child.killed else "signal" if code < 0 else "exit"
    child.code = abs(code)


def _state(child: Child, now_s: float) -> ProcessState:
    return ProcessState(
        name=child.name[:64],
        phase=child.phase,
        since_s=max(0.0, now_s - child.phase_s),
        starts=child.starts,
        ended=child.ended,
        code=child.code,
        text=child.given_up[-LONGEST_TEXT:],
    )


def _terminate(children: Iterable[Child]) -> None:
    for child in children:
        if child.process is not None and child.process.poll() is None:
            child.process.terminate()
