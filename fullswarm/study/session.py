"""Runs one trial of a study: the swarm of its condition as ``fullswarm up`` does, and the console in study mode."""

from __future__ import annotations

import hashlib
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from fullswarm.bus.endpoint import check_endpoint
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.fleet_file import check_frames
from fullswarm.errors import ConfigError, MissingExtra, Unreachable
from fullswarm.launch.network import on_free_ports
from fullswarm.launch.supervisor import Supervisor
from fullswarm.launch.web_console import INSTALL, WebConsole, missing_extra, open_browser
from fullswarm.operator.console.serve import OPEN_S, RedirectPage
from fullswarm.operator.console.study import PLAN, TRIAL, TrialPlan, TrialRecord
from fullswarm.output import INTERRUPTED, progress
from fullswarm.runtime import Runtime
from fullswarm.study.file import ConditionSection, start_request
from fullswarm.study.folder import Due, StudyFolder

LOOK_S = 0.2
THANKS_S = 2.0
"""The page shows that the trial is over before its server ends."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """A trial that can be started: its swarm, and its folder with the plan."""

    config: SwarmConfig
    folder: Path


def prepare(folder: StudyFolder, due: Due) -> Prepared:
    """Read the swarm of a trial's condition and write the plan.

    Raises
    ------
    ConfigError
        The fleet or the mission of the condition is wrong.
    """
    section = folder.study.section
    name = folder.condition(due.label)
    condition = next(each for each in section.conditions if each.name == name)
    config = folder.study.fleet(condition)
    if not config.robot:
        raise ConfigError("names no robot", where="the fleet file", hint="add [[robot]] tables or a [fleet] count")
    check_frames(config)
    trial = folder.folder_of(due)
    trial.mkdir(parents=True, exist_ok=True)
    (trial / PLAN).write_bytes(msgspec.json.format(msgspec.json.encode(_plan(folder, due, condition, config))))
    return Prepared(config, trial)


def _plan(folder: StudyFolder, due: Due, condition: ConditionSection, config: SwarmConfig) -> TrialPlan:
    section = folder.study.section
    # A world with firmware on the machine's clock or with real robots in it cannot be held still.
    can_freeze = all(robot.simulated and robot.emulate is None for robot in config.robot)
    return TrialPlan(
        study=section.name, participant=due.participant, label=due.label, number=due.number, of=due.of,
        attempt=due.attempt, seal=folder.seal, setting=hashlib.sha256(config.model_dump_json().encode()).hexdigest(),
        duration_s=section.duration_s, task=section.task, robots=len(config.robot), briefing=section.briefing,
        consent=section.consent,
        tlx=section.tlx, probes=folder.study.probes(), can_freeze=can_freeze, hide=condition.hide,
        behaviours=condition.behaviours, request=start_request(condition), mission=folder.study.mission(condition),
    )  # fmt: skip


def run(prepared: Prepared, *, open_page: bool, on_address: Callable[[str], None]) -> int:
    """Run a trial until it is over, or Ctrl-C; return the exit code: 1 if it is not complete.

    Raises
    ------
    MissingExtra
        The web console is not installed.
    Unreachable
        The console did not start.
    """
    if problem := missing_extra():
        raise MissingExtra(problem, hint=INSTALL)
    config = prepared.config
    if not any(robot.elsewhere for robot in config.robot):
        config = on_free_ports(config)
    check_endpoint(config.hub.endpoint, insecure_network=False)
    runtime = Runtime(MonotonicClock())
    runtime.stop_on_signals()
    supervisor = Supervisor(config, runtime)
    redirect: list[RedirectPage] = []
    failures: list[str] = []

    def address(url: str) -> None:
        on_address(url)
        if open_page:
            redirect.append(RedirectPage(url))
            runtime.after(OPEN_S, redirect[0].close)
            if problem := open_browser(redirect[0]):
                progress(problem)

    def failed(text: str) -> None:
        failures.append(text)
        runtime.pause()

    try:
        WebConsole(supervisor, runtime, address, failed, ("--study", str(prepared.folder.resolve())))
        supervisor.start()
        _until_over(runtime, prepared.folder)
        runtime.run()
    finally:
        for each in redirect:
            each.close()
        where = supervisor.kept_folder() if failures else supervisor.folder
        supervisor.close()
    if failures:
        raise Unreachable(failures[0], where=str(where), hint="the logs there say why")
    if runtime.exit_signal == signal.SIGINT:
        return INTERRUPTED
    record = record_of(prepared.folder)
    return 0 if record is not None and record.state == "complete" else 1


def _until_over(runtime: Runtime, folder: Path) -> None:
    """Have the runtime paused a little after the trial has ended."""

    def look() -> None:
        record = record_of(folder)
        if record is not None and record.state in ("complete", "interrupted"):
            timer.cancel()
            runtime.after(THANKS_S, runtime.pause)

    timer = runtime.every(LOOK_S, look)


def record_of(folder: Path) -> TrialRecord | None:
    """Return the record of a trial; None: its console has not written it yet."""
    try:
        return msgspec.json.decode((folder / TRIAL).read_bytes(), type=TrialRecord)
    except (OSError, msgspec.DecodeError):
        return None
