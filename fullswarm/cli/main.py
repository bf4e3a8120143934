"""The ``fullswarm`` command: assembles all commands, and has `demo`, `up`, `init`, `info` and the single processes."""

from __future__ import annotations

import functools
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.main import get_command

from fullswarm import __version__
from fullswarm.cli import (
    bundle,
    completion,
    deploy,
    estop,
    flash,
    guide,
    mcp,
    metrics,
    request,
    robots,
    schema,
    status,
    tryout,
)
from fullswarm.cli.audit import audit_app
from fullswarm.cli.console import console_app
from fullswarm.cli.experiment import experiment_app
from fullswarm.cli.fixes import fixes_app
from fullswarm.cli.joystick import joystick_app
from fullswarm.cli.keys import keys_app
from fullswarm.cli.leases import leases_app
from fullswarm.cli.mission import mission_app
from fullswarm.cli.options import Json, shell_command
from fullswarm.cli.panels import PlainGroup
from fullswarm.cli.params import params_app
from fullswarm.cli.record import record_app
from fullswarm.cli.rehearse import rehearse
from fullswarm.cli.replay import replay
from fullswarm.cli.results import results_app
from fullswarm.cli.ros import ros_app
from fullswarm.cli.scenario import scenario_app
from fullswarm.cli.signing import signing_app
from fullswarm.cli.study import study_app
from fullswarm.cli.track import track_app
from fullswarm.cli.viewer import viewer_app
from fullswarm.errors import ConfigError
from fullswarm.stderr import survive_full_disk

if TYPE_CHECKING:
    from fullswarm.cli.options import Target
    from fullswarm.config import SwarmConfig

app = typer.Typer(
    cls=PlainGroup,
    rich_markup_mode=None,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="From a swarm algorithm to robots that move. Start with `fullswarm demo`.",
)
START, EVALUATE, DEPLOY, HARDWARE, RUN = "Start", "Evaluate", "Deploy", "Robots and ports", "Single processes"
for command in (
    request.request, request.stop, estop.estop, request.drive, request.mock, status.status, status.watch,
    status.behaviours, status.docks, metrics.metrics,
):  # fmt: skip
    app.command()(command)
for group, name in (
    (mission_app, "mission"), (params_app, "params"), (leases_app, "leases"), (joystick_app, "joystick"),
    (audit_app, "audit"), (console_app, "console"), (record_app, "record"),
    (viewer_app, "viewer"), (ros_app, "ros"),
):  # fmt: skip
    app.add_typer(group, name=name, cls=PlainGroup)
app.command()(mcp.mcp)
for group, name, text in (
    (experiment_app, "experiment", "Measure behaviours over many seeded trials."),
    (results_app, "results", "Show, compare, export and report the results of experiments."),
    (scenario_app, "scenario", "List, show, import and export worlds."),
    (study_app, "study", "Run human-swarm studies: balanced orders, blinded conditions, probes, NASA-TLX."),
):
    app.add_typer(group, name=name, cls=PlainGroup, rich_help_panel=EVALUATE, help=text)
app.command(rich_help_panel=EVALUATE)(rehearse)
app.command(rich_help_panel=EVALUATE)(replay)
for command in (
    bundle.bundle, deploy.deploy, deploy.update, deploy.rollback, deploy.logs, deploy.shell,
    deploy.reboot, deploy.fleet, flash.flash,
):  # fmt: skip
    app.command(rich_help_panel=DEPLOY)(command)
app.add_typer(keys_app, name="keys", cls=PlainGroup, rich_help_panel=DEPLOY)
app.add_typer(signing_app, name="signing", cls=PlainGroup, rich_help_panel=DEPLOY)
app.add_typer(robots.robots_app, name="robots", cls=PlainGroup, rich_help_panel=HARDWARE)
app.add_typer(track_app, name="track", cls=PlainGroup, rich_help_panel=HARDWARE)
for command in (robots.doctor, robots.emulate):
    app.command(rich_help_panel=HARDWARE)(command)

Fleet = Annotated[
    Path, typer.Option("--fleet", envvar="FULLSWARM_FLEET", metavar="FILE", help="The fleet file (TOML).")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a setting: agent.control_rate_hz=20.",
        autocompletion=completion.settings,
    ),
]
Insecure = Annotated[
    bool,
    typer.Option(
        "--insecure-network", help="Listen beyond this machine: everyone on that network can drive the robots."
    ),
]
WithParent = Annotated[bool, typer.Option("--with-parent", hidden=True)]
Network = Annotated[
    str | None,
    typer.Option(
        "--network", metavar="SPEC", help="Inject network faults: loss=20%,delay=100ms±50,partition=r1+r2|*@5s-10s."
    ),
]


Record = Annotated[
    Path | None,
    typer.Option(metavar="FILE.mcap", help="Record the whole run for viewers and for `fullswarm replay`."),
]
Reload = Annotated[
    bool,
    typer.Option(
        "--reload",
        help="Load behaviours of the package in this folder, and of others that are installed, again when they change.",
    ),
]


def _developed(reload: bool, fleet: Path | None) -> Path | None:
    from fullswarm.launch.reload import folder

    return folder(fleet) if reload else None


def _load(fleet: Path, overrides: list[str] | None) -> SwarmConfig:
    from fullswarm.drivers.fleet_file import load_fleet

    return load_fleet(fleet, tuple(overrides or ()))


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


@app.command(rich_help_panel=START)
@shell_command(logs=True)
def demo(
    seconds: Annotated[float, typer.Option(min=4, max=3600, help="Duration of the demo.")] = 45.0,
    headless: Annotated[bool, typer.Option("--headless", help="Show no live table.")] = False,
    as_json: Json = False,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Run in one process on a simulated clock, repeatably.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the lockstep run.")] = 0,
    fleet: Annotated[
        Path | None,
        typer.Option(
            "--fleet",
            metavar="FILE|mixed",
            help="A fleet file, or `mixed`: 3 Creates, 3 rovers, 2 CAN bases, emulated with real ports.",
        ),
    ] = None,
    console: Annotated[
        bool | None,
        typer.Option("--console/--no-console", help="Serve the web console (default: unless --headless or --json)."),
    ] = None,
    stay: Annotated[
        bool | None,
        typer.Option("--stay/--no-stay", help="Continue after the demo (default: in a terminal with a console)."),
    ] = None,
    open_browser: Annotated[
        bool | None, typer.Option("--open/--no-open", help="Open the page (default: in a terminal with a screen).")
    ] = None,
    network: Network = None,
    overrides: Overrides = None,
    reload: Reload = False,
    record: Record = None,
) -> int:
    """Run eight simulated robots that drive to a goal, flock and meet; your first request ends the demo."""
    from fullswarm.demo import run as show

    config = show.demo_config(fleet, tuple(overrides or ()), network)
    if reload and lockstep:
        raise ConfigError("--reload and --lockstep exclude each other", hint="leave --lockstep out")
    if lockstep:
        return show.run_lockstep(config, seconds, seed, as_json, record)
    from fullswarm.demo.live import DemoOptions, run_live

    return run_live(
        config, DemoOptions(seconds, as_json, headless, console, stay, open_browser, _developed(reload, fleet), record)
    )


app.command("try", rich_help_panel=START)(tryout.try_)


@app.command(rich_help_panel=START)
@shell_command(logs=True, needs="posix")
def up(
    fleet: Annotated[Path, typer.Argument(metavar="FLEET.toml", help="The fleet file.")],
    overrides: Overrides = None,
    network: Network = None,
    console: Annotated[bool, typer.Option("--console", help="Serve the web console too; print its address.")] = False,
    api: Annotated[
        bool, typer.Option("--api", help="With --console: also serve programs, as `console --api` does.")
    ] = False,
    experiments: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="With --console: offer the experiment files in it.")
    ] = None,
    record: Record = None,
    insecure_network: Insecure = False,
    reload: Reload = False,
) -> int:
    """Start all processes of a fleet file on this machine: hub, core, world, one agent per robot."""
    from fullswarm.drivers.fleet_file import load_fleet

    config = load_fleet(fleet, tuple(overrides or ()), here=True)
    from fullswarm.launch.up import run  # after the file: who has mistyped a key need not wait for it

    return run(
        config, insecure_network, network,
        console=console, api=api, experiments=experiments, develop=_developed(reload, fleet), record=record,
    )  # fmt: skip


@app.command(rich_help_panel=START)
@shell_command(logs=True)
def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A new folder; its name is the lab's.")],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List the files, write none.")] = False,
) -> int:
    """Make a new lab: a fleet file, a behaviour with its test, a README."""
    from fullswarm.bringup.init import run

    return run(folder, dry_run=dry_run)


app.command(rich_help_panel=START)(guide.guide)
app.command(rich_help_panel=START)(schema.schema)


@app.command(rich_help_panel=START)
@shell_command(logs=True)
def info(target: Target, as_json: Json = False) -> int:
    """Print what a bug report needs, as Markdown: versions, machine, extras, ports; nothing secret."""
    from fullswarm.bringup.info import run

    return run(target.hub, target.swarm, as_json=as_json)


@app.command(rich_help_panel=RUN)
@shell_command(logs=True, needs="posix")
def hub(
    listen: Annotated[str, typer.Option(metavar="ENDPOINT", help="The endpoint to listen on.")] = "tcp/127.0.0.1:7447",
    swarm: Annotated[str, typer.Option(help="The swarm whose certificates are valid, for tls/.")] = "swarm",
    insecure_network: Insecure = False,
    with_parent: WithParent = False,
) -> int:
    """Run the hub that carries the messages."""
    from fullswarm.launch import processes

    return processes.hub(listen, swarm, insecure_network, with_parent)


@app.command(rich_help_panel=RUN)
@shell_command(logs=True, needs="posix")
def core(fleet: Fleet, overrides: Overrides = None, with_parent: WithParent = False) -> int:
    """Run the core: main controller, request handler, database, summarizers."""
    from fullswarm.launch import processes

    return processes.core(_load(fleet, overrides), with_parent)


@app.command(rich_help_panel=RUN)
@shell_command(logs=True, needs="posix")
def centralised(fleet: Fleet, overrides: Overrides = None, with_parent: WithParent = False) -> int:
    """Run the centralised behaviours."""
    from fullswarm.launch import processes

    return processes.centralised(_load(fleet, overrides), with_parent)


@app.command(rich_help_panel=RUN)
@shell_command(logs=True, needs="posix")
def agent(
    robot: Annotated[
        str, typer.Argument(help="The robot's id in the fleet file.", autocompletion=completion.fleet_robots)
    ],
    fleet: Fleet,
    overrides: Overrides = None,
    with_parent: WithParent = False,
) -> int:
    """Run the agent of one robot: on its companion computer, or here for a simulated one."""
    from fullswarm.launch import processes
    from fullswarm.launch.nodes import Node

    config = _load(fleet, overrides)
    if not any(each.id == robot and each.fixes for each in config.robot):
        return processes.agent(config, robot, with_parent)
    from fullswarm.bus.base import Bus
    from fullswarm.keys import Keys
    from fullswarm.localization.fixes import on_board_settings, source_node
    from fullswarm.runtime import Runtime

    def sensor(bus: Bus, runtime: Runtime) -> list[Node]:
        settings = on_board_settings(config, robot)
        return [] if settings is None else [source_node(bus, runtime, Keys(config.swarm), settings)]

    return processes.agent(config, robot, with_parent, sensor)


@app.command(rich_help_panel=RUN)
@shell_command(logs=True, needs="posix")
def sim(
    fleet: Fleet,
    overrides: Overrides = None,
    insecure_network: Insecure = False,
    with_parent: WithParent = False,
) -> int:
    """Run the simulated world that the fleet file describes, in real time."""
    from fullswarm.launch import processes

    return processes.world(_load(fleet, overrides), insecure_network, with_parent)


app.add_typer(fixes_app, name="fixes", cls=PlainGroup, rich_help_panel=RUN)


@functools.cache
def parser() -> Any:
    """Return what reads the command line: typer takes a third of a process's start to make it of all commands."""
    return get_command(app)


def main() -> None:
    """Run the command line; the entry point of the ``fullswarm`` script."""
    if completion.SWITCH in os.environ and not os.environ[completion.SWITCH].startswith("source"):
        raise SystemExit(completion.answer(lambda: app(prog_name="fullswarm")))
    survive_full_disk()
    parser()(prog_name="fullswarm")
