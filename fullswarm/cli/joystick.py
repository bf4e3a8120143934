"""The shell commands for gamepads. Only typer is imported here, so that help stays quick."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.cli.options import Json, Robots, shell_command

if TYPE_CHECKING:
    from fullswarm.cli.options import NamedTarget

joystick_app = typer.Typer(invoke_without_command=True)

BindingsFile = Annotated[
    Path | None, typer.Option("--bindings", metavar="FILE", help="What each control asks for (TOML); none: ours.")
]
Pad = Annotated[str, typer.Option("--pad", metavar="N|GUID", help="Only this pad; none: whose dead-man is pressed.")]


@joystick_app.callback()
@shell_command()
def joystick(
    context: typer.Context,
    target: NamedTarget,
    bindings: BindingsFile = None,
    pad: Pad = "",
    robots: Robots = None,
) -> int:
    """Drive with a gamepad: hold LB and push a stick. A stops, B is the e-stop; Ctrl-C ends.

    LB dead-man, RB turbo, left stick: on the map, right stick: one robot, cross: who is driven, X and Y: behaviours.
    """
    if context.invoked_subcommand is not None:
        return 0
    from fullswarm.operator.joystick import command as gamepad

    return gamepad.drive(target, bindings, pad, robots or ())


@joystick_app.command("list")
@shell_command()
def list_pads(as_json: Json = False) -> int:
    """List the gamepads that are plugged in. Exit code 1: none."""
    from fullswarm.operator.joystick import command as gamepad

    return gamepad.list_pads(as_json=as_json)


@joystick_app.command("test")
@shell_command()
def try_out(
    bindings: BindingsFile = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after this; none: on Ctrl-C.")] = None,
) -> int:
    """Show what is pressed and what it would ask for. Sends nothing, needs no swarm. Exit code 1: no pad."""
    from fullswarm.operator.joystick import command as gamepad

    return gamepad.show_pads(bindings, seconds)


@joystick_app.command("map")
@shell_command()
def map_pad(
    pad: Pad = "",
    file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where to write; none: your gamecontrollerdb.txt.")
    ] = None,
    patience: Annotated[
        float | None, typer.Option(metavar="SECONDS", min=0.5, help="Leave out what is not moved for so long.")
    ] = None,
) -> int:
    """Teach a pad that SDL does not know: asks for each control in turn. Exit code 1: not finished, or parts lack."""
    from fullswarm.operator.joystick import command as gamepad

    return gamepad.map_pad(pad, file, patience)
