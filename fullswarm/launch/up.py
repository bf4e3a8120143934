"""`fullswarm up FLEET.toml`: all processes of a fleet file on this machine, until Ctrl-C."""

from __future__ import annotations

import signal
from pathlib import Path

from fullswarm.audit.log import unlocked
from fullswarm.bus.base import CORE
from fullswarm.bus.endpoint import check_endpoint, credentials_at
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.fleet_file import check_frames
from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.keys import Keys
from fullswarm.launch import reload
from fullswarm.launch.complaints import Complaints
from fullswarm.launch.network import with_network
from fullswarm.launch.processes import usual_audit_folder
from fullswarm.launch.recorder import add_recorder, check_record
from fullswarm.launch.stopping import check_fleet
from fullswarm.launch.supervisor import Supervisor
from fullswarm.launch.web_console import INSTALL, WebConsole, api_address, missing_extra
from fullswarm.output import INTERRUPTED, progress
from fullswarm.runtime import Runtime

SETTLED_S = 1.0
"""A process with wrong settings has ended by then, and its complaint comes instead of the hint."""


def _hint(config: SwarmConfig, folder: Path, record: Path | None) -> str:
    usual = SwarmConfig()
    options = "" if config.hub == usual.hub else f" --hub {config.hub.endpoint}"
    options += "" if config.swarm == usual.swarm else f" --swarm {config.swarm}"
    commands = ", ".join(f"`fullswarm {verb}{options}`" for verb in ("watch", "behaviours", "stop"))
    robots = f"{len(config.robot)} robot{'s' if len(config.robot) > 1 else ''}"
    if config.network.conditions is not None:
        robots += f" on a bad network ({config.network.conditions})"
    away = sum(each.elsewhere for each in config.robot)
    others = f" ({away} with an agent on another computer)" if away else ""
    swarm = f"{robots} of swarm '{config.swarm}'{others}"
    swarm += f", recorded to {record}" if record is not None else ""
    return f"{swarm}; logs in {folder}; Ctrl-C ends all.\nIn another terminal: {commands}"


def run(
    config: SwarmConfig,
    insecure_network: bool,
    network: str | None = None,
    *,
    console: bool = False,
    api: bool = False,
    experiments: Path | None = None,
    develop: Path | None = None,
    record: Path | None = None,
) -> int:
    """Start the processes, start those again that die, end all in order on Ctrl-C or SIGTERM.

    What goes wrong with a process or a robot's driver is printed as it happens, see
    :class:`~fullswarm.launch.complaints.Complaints`.

    Parameters
    ----------
    api : the console serves programs, too
    experiments : folder of the experiment files that the console offers; None: the usual one
    develop : folder of a package whose behaviours are loaded again when their files change
    record : file for a recording of the whole run

    Raises
    ------
    ConfigError
        The fleet file names no robot, or something wrong.
    MissingExtra
        The web console is wanted, but not installed.
    """
    if api and not console:
        raise ConfigError("programs are served by the console", where="--api", hint="add --console")
    if experiments is not None and not (console and experiments.is_dir()):
        what, hint = ("no such folder", "make it") if console else ("the console offers experiments", "add --console")
        raise ConfigError(what, where=f"--experiments {experiments}", hint=hint)
    if console and (problem := missing_extra()):
        raise MissingExtra(problem, hint=INSTALL)
    if record is not None:
        check_record(record)
    if not config.robot:
        raise ConfigError("names no robot", where="the fleet file", hint="add [[robot]] tables or a [fleet] count")
    check_frames(config)
    check_endpoint(config.hub.endpoint, insecure_network)
    config = with_network(config, network)
    if warning := check_fleet(config)[1]:
        progress(f"warning: {warning}")
    if config.core.store is None and config.core.audit is None:  # not with the database, which ends with this run
        core = config.core.model_copy(update={"audit": unlocked(usual_audit_folder(config.swarm))})
        config = config.model_copy(update={"core": core})
    runtime = Runtime(MonotonicClock())
    runtime.stop_on_signals()
    supervisor = Supervisor(config, runtime, insecure_network=insecure_network, develop=develop)
    credentials = credentials_at(config.hub.endpoint, config.swarm, CORE, "core")
    bus = ZenohBus(runtime.mailbox, hub=config.hub.endpoint, credentials=credentials)
    supervisor.report_to(bus)
    complaints = Complaints(runtime, supervisor.log_file, progress)
    supervisor.on_end = complaints.ended
    complaints.listen(bus, Keys(config.swarm))
    try:
        if develop is not None:
            reload.watch(develop, runtime)
        if console:
            options: tuple[str, ...] = ("--api",) if api else ()
            options += () if experiments is None else ("--experiments", str(experiments.absolute()))
            options += () if record is None else ("--recorded-to", str(record.absolute()))

            def show(address: str) -> None:
                programs = f"Programs: {api_address(address)}\n" if api else ""
                progress(f"\nOpen {address}\n{programs}")

            WebConsole(supervisor, runtime, show, progress, options)
        if record is not None:
            add_recorder(supervisor, record)
        supervisor.start()
        runtime.after(SETTLED_S, lambda: progress(_hint(config, supervisor.folder, record)))
        runtime.run()
    finally:
        bus.close()  # while the hub is there: without it that takes longer
        supervisor.close()
    return INTERRUPTED if runtime.exit_signal == signal.SIGINT else 0
