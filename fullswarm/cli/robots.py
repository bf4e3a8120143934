"""The commands about robots and ports: `robots find|test|check`, `doctor`, `emulate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.cli import completion
from fullswarm.cli.options import Json, Yes, shell_command
from fullswarm.cli.status import list_robots

if TYPE_CHECKING:
    from fullswarm.cli.options import Target

robots_app = typer.Typer(invoke_without_command=True)


@robots_app.callback()
@shell_command()
def robots(context: typer.Context, target: Target, as_json: Json = False) -> int:
    """List the robots of the running swarm; `find`, `test` and `check` examine connected hardware."""
    return list_robots(target, as_json=as_json) if context.invoked_subcommand is None else 0


@robots_app.command()
@shell_command(logs=True, needs="linux")
def find(
    port: Annotated[
        list[str] | None, typer.Option("--port", metavar="PATH", help="Search only this serial port.")
    ] = None,
    can: Annotated[
        list[str] | None,
        typer.Option("--can", metavar="CHANNEL", help="Search only this bus: can0, slcan:/dev/ttyACM0@250000, ..."),
    ] = None,
    udp: Annotated[
        list[str] | None, typer.Option("--udp", metavar="[HOST:]PORT", help="Search only this UDP port for rovers.")
    ] = None,
    as_json: Json = False,
) -> int:
    """Search all ports for robots; nothing moves. Exit code 0: robots found; 1: none."""
    from fullswarm.bringup.find import find as run

    return run(port or (), can or (), udp or (), as_json=as_json)


@robots_app.command("test")
@shell_command(logs=True, needs="linux")
def bring_up(
    url: Annotated[str, typer.Argument(metavar="URL", help="The driver's URL, as in a fleet file.")],
    speed: Annotated[float, typer.Option(min=0.02, max=0.5, help="Speed of the wheels, m/s.")] = 0.1,
    yes: Yes = False,
    timeout: Annotated[float, typer.Option(metavar="SECONDS", min=1, max=600, help="Wait this long for READY.")] = 60.0,
    as_json: Json = False,
) -> int:
    """Drive one robot a little and check signs, scale, stops and sensors. Exit code 0: passed; 1: failed."""
    from fullswarm import registry

    registry.driver_target(url)  # before anything is imported
    from fullswarm.bringup.robot_test import run

    return run(url, speed_m_s=speed, confirmed=yes, ready_s=timeout, as_json=as_json)


@robots_app.command("check")
@shell_command(logs=True, needs="linux")
def check(
    url: Annotated[
        str | None, typer.Argument(metavar="[URL]", help="The driver's URL, as in a fleet file; of any package.")
    ] = None,
    emulated: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL", help="Check the driver on this emulated robot, with all its faults; a word of `emulate =`."
        ),
    ] = None,
    rig: Annotated[
        str | None,
        typer.Option(metavar="MODULE:FUNCTION", help="Use this context manager, which yields a fullswarm.testing.Rig."),
    ] = None,
    wire: Annotated[
        bool, typer.Option("--wire", help="Insert a relay into the link, and unplug, mute and disturb it there.")
    ] = False,
    baud: Annotated[int, typer.Option(min=300, help="Baud rate of a serial line with --wire.")] = 115200,
    still: Annotated[
        bool, typer.Option("--still", help="Do not move the robot: lifecycle and promptness only.")
    ] = False,
    yes: Yes = False,
    settle: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.1, max=60, help="Wait this long to reach or leave half its speed.")
    ] = 2.0,
    timeout: Annotated[
        float,
        typer.Option(metavar="SECONDS", min=1, max=600, help="Wait this long for each step that the robot confirms."),
    ] = 10.0,
    as_json: Json = False,
) -> int:
    """Run the published check of drivers on one robot or emulator. Exit code 0: passed; 1: failed.

    For authors of drivers; operators use `robots test`.
    """
    from fullswarm.bringup.robot_check import run

    return run(
        url, emulated, rig, wire_baud=baud if wire else None, still=still, confirmed=yes, settle_s=settle,
        deadline_s=timeout, as_json=as_json,
    )  # fmt: skip


@shell_command(logs=True, needs="linux")
def doctor(
    fleet: Annotated[Path | None, typer.Argument(metavar="[FLEET.toml]", help="Check its hub and robots too.")] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="ROBOT", help="Check this robot and its computer instead.", autocompletion=completion.fleet_robots
        ),
    ] = None,
    fleet_option: Annotated[
        Path | None,
        typer.Option("--fleet", envvar="FULLSWARM_FLEET", metavar="FILE", help="The fleet file with --robot."),
    ] = None,
    press: Annotated[
        bool, typer.Option("--estop/--no-estop", help="With --robot: offer to engage its e-stop for a moment.")
    ] = True,
    yes: Yes = False,
    as_json: Json = False,
) -> int:
    """Check this machine, and a fleet's hub and robots, or one --robot before it drives; print what to do.

    Exit code 1: something is broken; 3: nothing of the --robot answers.
    """
    from fullswarm.bringup import doctor, preflight

    if robot is not None:
        return preflight.check_robot(fleet or fleet_option, robot, press=press, yes=yes, as_json=as_json)
    return doctor.run(fleet, as_json=as_json)


@shell_command(logs=True, needs="linux")
def emulate(
    make: Annotated[
        str,
        typer.Argument(
            metavar="MAKE",
            help="create, mavlink, odrive, vesc, ros, ld19, rplidar, vl53l1x, or one of an outside package.",
            autocompletion=completion.emulated_makes,
        ),
    ],
    port: Annotated[Path | None, typer.Option(metavar="PATH", help="Path of its serial port.")] = None,
    listen: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="mavlink: udp://, udpin://, tcp://HOST:PORT or pty:")
    ] = None,
    url: Annotated[str | None, typer.Option(metavar="URL", help="Serve the other end of this driver URL.")] = None,
    model: Annotated[
        str | None, typer.Option(metavar="NAME", help="create: create1, roomba500, create2; mavlink: rover, px4.")
    ] = None,
    cliff: Annotated[bool, typer.Option("--cliff", help="Emulate a cliff in front.")] = False,
    drop: Annotated[float, typer.Option(min=0, max=1, help="Share of chunks that are lost.")] = 0.0,
    corrupt: Annotated[float, typer.Option(min=0, max=1, help="Share of chunks with a flipped bit.")] = 0.0,
    delay: Annotated[float, typer.Option(metavar="SECONDS", min=0, max=10, help="Delay of each direction.")] = 0.0,
    inject: Annotated[
        list[str] | None, typer.Option("--do", metavar="COMMAND", help="Run a command of the emulator: 'battery 0.1'.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after this time (default: on Ctrl-C).")] = None,
    as_json: Json = False,
) -> int:
    """Run one emulated robot or range sensor on a real port, for any client. Type `help` while it runs."""
    from fullswarm.bringup.emulate import EmulateOptions, run
    from fullswarm.emulators.base import LinkFaults

    commands = (("cliff on",) if cliff else ()) + tuple(inject or ())
    faults = LinkFaults(drop, corrupt, delay)
    return run(EmulateOptions(make, port, listen, url, model), faults, commands, seconds, as_json=as_json)
