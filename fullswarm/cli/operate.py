"""The commands that ask for behaviours and watch a swarm: `request`, `stop`, `estop`, `drive`, `status`, ..."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.cli import completion
from fullswarm.cli.leases import leases_app
from fullswarm.cli.options import ALL, Json, Robots, Take, Timeout, shell_command
from fullswarm.cli.params import params_app

if TYPE_CHECKING:
    from fullswarm.cli.options import NamedTarget, Target

operator_app = typer.Typer(no_args_is_help=True, help="Ask a swarm for behaviours and watch it.")
operator_app.add_typer(params_app, name="params")
operator_app.add_typer(leases_app, name="leases")

RobotArguments = Annotated[
    list[str] | None,
    typer.Argument(metavar="[ROBOT]...", help=f"Robot ids; {ALL}.", autocompletion=completion.robot_ids),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="A parameter: 1.5, true, 5,5 (a point), [[0, 0], [1, 1]], or a word.",
        autocompletion=completion.parameters,
    ),
]
Behaviour = Annotated[
    str, typer.Argument(help="Its name; `fullswarm behaviours` lists them.", autocompletion=completion.behaviours)
]
Stick = Annotated[float, typer.Option(min=-1, max=1, help="Share of the robot's full rate, -1 to 1.")]


@operator_app.command()
@shell_command()
def request(
    target: NamedTarget,
    behaviour: Behaviour,
    robots: Robots = None,
    settings: Settings = None,
    wait: Annotated[
        bool | None,
        typer.Option(
            "--wait/--no-wait",
            show_default=False,
            help="Wait for the robots' answers until --timeout, or not at all; default: for 2 s at most.",
        ),
    ] = None,
    take: Take = False,
    timeout: Timeout = 5.0,
    as_json: Json = False,
) -> int:
    """Ask for a behaviour and print what the robots answer.

    Exit code 0: all robots present run it; 1: one refused or did not answer; 2: the core refused; 3: no hub or no
    core; 4: a latched e-stop is in the way. With --no-wait 0: the core accepted.
    """
    from fullswarm.operator import orders
    from fullswarm.operator.values import parse_parameters

    parameters = parse_parameters(settings or ())
    return orders.request(
        target,
        behaviour,
        robots or (),
        parameters,
        wait=wait,
        timeout_s=timeout,
        as_json=as_json,
        take=take,
    )


@operator_app.command()
@shell_command()
def stop(
    target: Target,
    robots: RobotArguments = None,
) -> int:
    """Make robots stand still now, whatever they do. They start again on the next request."""
    from fullswarm.operator import orders

    return orders.stop(target, robots or ())


@operator_app.command()
@shell_command()
def estop(
    target: Target,
    robots: RobotArguments = None,
    clear: Annotated[bool, typer.Option("--clear", help="Release the latched e-stop instead.")] = False,
    reason: Annotated[str, typer.Option(help="Why; robots and logs repeat it.")] = "",
    timeout: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", min=0.1, max=86400, help="Give up then; none: on Ctrl-C, with --clear 5 s."),
    ] = None,
    fleet: Annotated[
        Path | None,
        typer.Option(
            envvar="FULLSWARM_FLEET", metavar="FILE", help="Whose robots must confirm, also if no core knows them."
        ),
    ] = None,
    as_json: Json = False,
) -> int:
    """Emergency stop: latched until --clear. Presses until all confirm.

    Exit code 4 when a robot did not confirm, 3 when none was heard or no hub answers.
    """
    from fullswarm.operator import estop_command

    return estop_command.estop(
        target,
        robots or (),
        engaged=not clear,
        reason=reason,
        timeout_s=timeout,
        fleet=fleet,
        as_json=as_json,
    )


@operator_app.command()
@shell_command()
def drive(
    target: NamedTarget,
    linear: Stick = 0.0,
    angular: Stick = 0.0,
    robots: Robots = None,
    seconds: Annotated[float | None, typer.Option(min=0.05, help="End after this; none: on Ctrl-C.")] = None,
    take: Take = False,
    timeout: Timeout = 3.0,
) -> int:
    """Drive robots by hand until Ctrl-C, then stop them."""
    from fullswarm.operator import orders

    return orders.drive(target, linear, angular, robots or (), seconds, timeout, take=take)


@operator_app.command()
@shell_command()
def mock(
    target: NamedTarget,
    behaviour: Behaviour,
    rate: Annotated[float, typer.Option(min=0.01, max=200, help="Requests per second.")] = 1.0,
    count: Annotated[int, typer.Option(min=0, help="How many; 0: until Ctrl-C.")] = 1,
    robots: Robots = None,
    settings: Settings = None,
    timeout: Timeout = 5.0,
) -> int:
    """Mock publisher: send one request again and again."""
    from fullswarm.operator import orders
    from fullswarm.operator.values import parse_parameters

    parameters = parse_parameters(settings or ())
    return orders.mock(target, behaviour, robots or (), parameters, rate_hz=rate, count=count, timeout_s=timeout)


@operator_app.command()
@shell_command()
def status(
    target: Target,
    robots: Robots = None,
    as_json: Json = False,
) -> int:
    """Show the swarm, or some robots of it, once; first those that need somebody."""
    from fullswarm.operator import reads

    return reads.status(target, robots or (), as_json=as_json)


@operator_app.command()
@shell_command()
def watch(
    target: Target,
    robots: Robots = None,
    as_json: Annotated[bool, typer.Option("--json", help="A line of JSON at each refresh, four each second.")] = False,
) -> int:
    """Show the swarm, or some robots of it, live until Ctrl-C; first those that need somebody."""
    from fullswarm.operator import reads

    return reads.watch(target, robots or (), as_json=as_json)


@operator_app.command()
@shell_command()
def behaviours(
    target: Target,
    name: Annotated[
        str | None, typer.Argument(help="Show this one's parameters.", autocompletion=completion.behaviours)
    ] = None,
    timeout: Timeout = 3.0,
    as_json: Json = False,
) -> int:
    """List the behaviours that can be asked for, or the parameters of one."""
    from fullswarm.operator import reads

    return reads.behaviours(target, name, timeout_s=timeout, as_json=as_json)
