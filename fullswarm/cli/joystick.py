"""The shell commands for gamepads. Only typer is imported here, so that help stays quick."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fullswarm.cli.options import Debug, Hub, Json, Operator, Robots, Swarm
from fullswarm.launch.guard import run_guarded

joystick_app = typer.Typer(invoke_without_command=True)

BindingsFile = Annotated[
    Path | None, typer.Option("--bindings", metavar="FILE", help="What each control asks for (TOML); none: ours.")
]
Pad = Annotated[str, typer.Option("--pad", metavar="N|GUID", help="Only this pad; none: whose dead-man is pressed.")]


@joystick_app.callback()
def joystick(
    context: typer.Context,
    bindings: BindingsFile = None,
    pad: Pad = "",
    robots: Robots = None,
    operator: Operator = "",
    hub: Hub = None,
    swarm: Swarm = "swarm",
    debug: Debug = False,
) -> None:
    """Drive with a gamepad: hold LB and push a stick. A stops, B is the e-stop; Ctrl-C ends.

    LB dead-man, RB turbo, left stick: on the map, right stick: one robot, cross: who is driven, X and Y: behaviours.
    """
    if context.invoked_subcommand is not None:
        return

    def command() -> int:
        from fullswarm.operator.joystick import command as gamepad
        from fullswarm.operator.session import Target, operator_name

        target = Target(hub, swarm, operator_name(operator) if operator else "")
        return gamepad.drive(target, bindings, pad, robots or ())

    raise typer.Exit(run_guarded(command, debug))


@joystick_app.command("list")
def list_pads(as_json: Json = False, debug: Debug = False) -> None:
    """List the gamepads that are plugged in. Exit code 1: none."""

    def command() -> int:
        from fullswarm.operator.joystick import command as gamepad

        return gamepad.list_pads(as_json=as_json)

    raise typer.Exit(run_guarded(command, debug))


@joystick_app.command("test")
def try_out(
    bindings: BindingsFile = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after this; none: on Ctrl-C.")] = None,
    debug: Debug = False,
) -> None:
    """Show what is pressed and what it would ask for. Sends nothing, needs no swarm. Exit code 1: no pad."""

    def command() -> int:
        from fullswarm.operator.joystick import command as gamepad

        return gamepad.show_pads(bindings, seconds)

    raise typer.Exit(run_guarded(command, debug))


@joystick_app.command("map")
def map_pad(
    pad: Pad = "",
    file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where to write; none: your gamecontrollerdb.txt.")
    ] = None,
    patience: Annotated[
        float | None, typer.Option(metavar="SECONDS", min=0.5, help="Leave out what is not moved for so long.")
    ] = None,
    debug: Debug = False,
) -> None:
    """Teach a pad that SDL does not know: asks for each control in turn. Exit code 1: not finished, or parts lack."""

    def command() -> int:
        from fullswarm.operator.joystick import command as gamepad

        return gamepad.map_pad(pad, file, patience)

    raise typer.Exit(run_guarded(command, debug))
