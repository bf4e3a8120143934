"""The ``fullswarm`` command. Imports what a command needs when it runs: help must come at once."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm import __version__
from fullswarm.cli import completion
from fullswarm.cli.console import console as serve_console
from fullswarm.cli.deploy import deploy_app
from fullswarm.cli.experiment import experiment_app
from fullswarm.cli.joystick import joystick_app
from fullswarm.cli.operate import operator_app
from fullswarm.cli.options import shell_command
from fullswarm.cli.results import results_app
from fullswarm.cli.robots import hardware_app
from fullswarm.cli.scenario import scenario_app

if TYPE_CHECKING:
    from fullswarm.config import SwarmConfig

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="From a swarm algorithm to robots that move. Start with `fullswarm demo`.",
)
app.add_typer(operator_app)
app.add_typer(joystick_app, name="joystick")
for each, name, text in (
    (experiment_app, "experiment", "Measure behaviours over many seeded trials."),
    (results_app, "results", "Look at what experiments left: cells, figures, comparisons, reports."),
    (scenario_app, "scenario", "Worlds: list, look at, bring along from other simulators, take to them."),
):
    app.add_typer(each, name=name, rich_help_panel="Evaluate", help=text)
app.add_typer(deploy_app, rich_help_panel="Deploy")
app.add_typer(hardware_app)  # after the operator's: its `robots` has more verbs

app.command("console")(serve_console)

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
    bool, typer.Option("--insecure-network", help="Listen beyond this machine: anybody there can drive the robots.")
]
WithParent = Annotated[bool, typer.Option("--with-parent", hidden=True)]
Network = Annotated[
    str | None,
    typer.Option("--network", metavar="SPEC", help="A bad network: loss=20%,delay=100ms±50,partition=r1+r2|*@5s-10s."),
]
START, RUN = "Start", "Single processes"


def _load(fleet: Path, overrides: list[str] | None) -> SwarmConfig:
    from fullswarm.drivers.fleet_file import load_fleet

    return load_fleet(fleet, tuple(overrides or ()))


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, typer.Option("--version", help="Print the version and end.")] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


@app.command(rich_help_panel=START)
@shell_command(logs=True)
def demo(
    seconds: Annotated[float, typer.Option(min=4, max=3600, help="How long the show lasts.")] = 45.0,
    headless: Annotated[bool, typer.Option("--headless", help="No live table.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as one JSON document.")] = False,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="One process, simulated clock, repeatable.")] = False,
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
        typer.Option("--console/--no-console", help="The web console. Default: on, unless --headless or --json."),
    ] = None,
    stay: Annotated[
        bool | None,
        typer.Option("--stay/--no-stay", help="Go on after the show. Default: in a terminal, with a console."),
    ] = None,
    open_browser: Annotated[
        bool | None, typer.Option("--open/--no-open", help="Show the page. Default: in a terminal with a screen.")
    ] = None,
    network: Network = None,
    overrides: Overrides = None,
) -> int:
    """Eight simulated robots drive to a goal, flock, and meet, and are yours as soon as you ask for anything."""
    from fullswarm.demo import run as show

    config = show.demo_config(fleet, tuple(overrides or ()), network)
    if lockstep:
        return show.run_lockstep(config, seconds, seed, as_json)
    from fullswarm.demo.live import Manner, run_live

    return run_live(config, Manner(seconds, as_json, headless, console, stay, open_browser))


@app.command(rich_help_panel=START)
@shell_command(logs=True)
def up(
    fleet: Annotated[Path, typer.Argument(metavar="FLEET.toml", help="The fleet file.")],
    overrides: Overrides = None,
    network: Network = None,
    console: Annotated[bool, typer.Option("--console", help="The web console as well; prints its address.")] = False,
    insecure_network: Insecure = False,
) -> int:
    """Start all that a fleet file names on this machine: hub, core, world, one agent per robot."""
    from fullswarm.drivers.fleet_file import load_fleet
    from fullswarm.launch.up import run
    from fullswarm.simulation.starts import start_problems

    config = load_fleet(fleet, tuple(overrides or ()), here=True, check=start_problems)
    return run(config, insecure_network, network, console=console)


@app.command(rich_help_panel=START)
@shell_command(logs=True)
def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A new folder; its name is the lab's.")],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only list the files.")] = False,
) -> int:
    """Make a lab of your own: a fleet file, a behaviour with its test, a README; it works at once."""
    from fullswarm.bringup.init import run

    return run(folder, dry_run=dry_run)


@app.command(rich_help_panel=START)
@shell_command(logs=True)
def info(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    hub: Annotated[str | None, typer.Option(envvar="FULLSWARM_HUB", metavar="ENDPOINT", help="The hub.")] = None,
    swarm: Annotated[str, typer.Option(envvar="FULLSWARM_SWARM", metavar="NAME", help="Which swarm.")] = "swarm",
) -> int:
    """Print what a bug report needs: versions, machine, extras, ports; nothing secret. Markdown, to be pasted."""
    from fullswarm.bringup.info import run

    return run(hub, swarm, as_json=as_json)


@app.command(rich_help_panel=RUN)
@shell_command(logs=True)
def hub(
    listen: Annotated[str, typer.Option(metavar="ENDPOINT", help="Where to listen.")] = "tcp/127.0.0.1:7447",
    insecure_network: Insecure = False,
    with_parent: WithParent = False,
) -> int:
    """Run the hub that carries the messages."""
    from fullswarm.launch import processes

    return processes.hub(listen, insecure_network, with_parent)


@app.command(rich_help_panel=RUN)
@shell_command(logs=True)
def core(fleet: Fleet, overrides: Overrides = None, with_parent: WithParent = False) -> int:
    """Run the core: main controller, request handler, database, summarizers."""
    from fullswarm.launch import processes

    return processes.core(_load(fleet, overrides), with_parent)


@app.command(rich_help_panel=RUN)
@shell_command(logs=True)
def centralised(fleet: Fleet, overrides: Overrides = None, with_parent: WithParent = False) -> int:
    """Run the centralised behaviours."""
    from fullswarm.launch import processes

    return processes.centralised(_load(fleet, overrides), with_parent)


@app.command(rich_help_panel=RUN)
@shell_command(logs=True)
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

    return processes.agent(_load(fleet, overrides), robot, with_parent)


@app.command(rich_help_panel=RUN)
@shell_command(logs=True)
def sim(
    fleet: Fleet,
    overrides: Overrides = None,
    insecure_network: Insecure = False,
    with_parent: WithParent = False,
) -> int:
    """Run the simulated world that the fleet file describes, in real time."""
    from fullswarm.launch import processes

    return processes.world(_load(fleet, overrides), insecure_network, with_parent)


@app.command(rich_help_panel=RUN)
@shell_command(logs=True)
def fixes(
    listen: Annotated[str, typer.Option(metavar="HOST:PORT", help="UDP port for the datagrams.")] = "127.0.0.1:9870",
    names: Annotated[
        list[str] | None, typer.Option("--map", metavar="NAME=ROBOT", help="Which robot a name of the sender is.")
    ] = None,
    unit: Annotated[str, typer.Option(metavar="m|cm|mm", help="Unit of x, y and z.")] = "m",
    y_up: Annotated[bool, typer.Option("--y-up", help="The sender's floor is x and -z, as in Motive.")] = False,
    sigma_m: Annotated[float, typer.Option(min=1e-4, max=100, help="Error of a position that says none.")] = 0.005,
    sigma_rad: Annotated[float, typer.Option(min=1e-4, max=3, help="Error of a heading that says none.")] = 0.02,
    hub: Annotated[str | None, typer.Option(envvar="FULLSWARM_HUB", metavar="ENDPOINT", help="The hub.")] = None,
    swarm: Annotated[str, typer.Option(envvar="FULLSWARM_SWARM", metavar="NAME", help="Which swarm.")] = "swarm",
    insecure_network: Annotated[
        bool, typer.Option("--insecure-network", help="Listen beyond this machine: anybody there can misplace robots.")
    ] = False,
    with_parent: WithParent = False,
) -> int:
    """Tell the robots where motion capture sees them: JSON over UDP in, pose fixes out."""
    from fullswarm.localization import fixes as source
    from fullswarm.localization.mocap import Format

    options = source.Options(
        listen,
        source.parse_map(names or ()),
        Format(source.unit_of(unit), y_up, sigma_m, sigma_rad),
        insecure_network,
    )
    return source.run(hub, swarm, options, with_parent)


def main() -> None:
    """Run the command line; the entry point of the ``fullswarm`` script."""
    if completion.SWITCH in os.environ and not os.environ[completion.SWITCH].startswith("source"):
        raise SystemExit(completion.answer(lambda: app(prog_name="fullswarm")))
    app(prog_name="fullswarm")
