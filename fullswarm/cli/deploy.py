"""`deploy`, `update`, `rollback`, `fleet`, `logs`, `shell` and `reboot`: the software on the robots' computers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fullswarm.cli import completion
from fullswarm.cli.options import Json, shell_command

if TYPE_CHECKING:
    from fullswarm.deploy.fleet.commands import FleetRequest

FleetFile = Annotated[
    Path,
    typer.Option("--fleet", envvar="FULLSWARM_FLEET", metavar="FILE", help="The fleet file: `host` and `ssh_user`."),
]
Robots = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[ROBOT]...",
        help="Robot ids and @groups, in the order of their update (default: all that are not simulated).",
        autocompletion=completion.fleet_robots,
    ),
]
OneRobot = Annotated[
    str, typer.Argument(metavar="ROBOT", help="The robot's id.", autocompletion=completion.fleet_robots)
]
Release = Annotated[
    str | None, typer.Option("--release", metavar="ID|DIR", help="The release (default: the newest one that fits).")
]
TargetName = Annotated[
    str | None, typer.Option("--target", metavar="NAME", help="Consider only releases of this target.")
]
AllowOlder = Annotated[
    bool,
    typer.Option("--allow-older", help="Sign the release of --release anew: robots may go back to it."),
]
Guard = Annotated[
    float,
    typer.Option(
        "--guard",
        metavar="SECONDS",
        min=10,
        max=3600,
        help="Roll a robot back that is not confirmed by then.",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Include robots that are moving: they are stopped.")]
AtATime = Annotated[int, typer.Option("--at-a-time", metavar="N", min=1, max=64, help="Number of robots in parallel.")]
AskPassword = Annotated[bool, typer.Option("--ask-sudo-password", help="Ask once for the sudo password of the robots.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Query the robots and print what would be done.")]


def _order(fleet: Path, robots: list[str] | None, **rest: Any) -> FleetRequest:
    from fullswarm.deploy.fleet.commands import FleetRequest

    return FleetRequest(fleet, tuple(robots or ()), **rest)


@shell_command(needs="posix")
def deploy(
    fleet: FleetFile,
    robots: Robots = None,
    release: Release = None,
    target: TargetName = None,
    allow_older: AllowOlder = False,
    rename: Annotated[
        bool, typer.Option("--rename", help="Install robots that have another name, under the one of the fleet file.")
    ] = False,
    guard: Guard = 60.0,
    force: Force = False,
    accept: Annotated[
        bool,
        typer.Option("--accept-new-host-keys", help="Trust unknown host keys; never one that has changed."),
    ] = False,
    ask_password: AskPassword = False,
    at_a_time: AtATime = 8,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> int:
    """Install robots over SSH, or bring them to a release; doing it twice changes nothing.

    The computers need Linux with systemd, SSH and Python; no internet, pip, compiler or Docker. Exit code 1 when some
    robots failed, 3 when none could be reached; the table names what to do.
    """
    from fullswarm.deploy.fleet import commands

    return commands.deploy(
        _order(
            fleet,
            robots,
            release=release,
            target=target,
            allow_older=allow_older,
            guard_s=guard,
            force=force,
            accept_host_keys=accept,
            rename=rename,
            ask_password=ask_password,
            at_a_time=at_a_time,
            dry_run=dry_run,
            as_json=as_json,
        )
    )


@shell_command(needs="posix")
def update(
    fleet: FleetFile,
    robots: Robots = None,
    release: Release = None,
    target: TargetName = None,
    allow_older: AllowOlder = False,
    canary: Annotated[
        int, typer.Option(min=0, max=64, help="Number of robots to update first; they must be healthy.")
    ] = 1,
    wave: Annotated[str, typer.Option(metavar="25%", help="Share of the robots in the next wave.")] = "25%",
    stop_at: Annotated[int, typer.Option(min=1, metavar="K", help="Switch no further robot after K failures.")] = 2,
    guard: Guard = 60.0,
    force: Force = False,
    keep_trying: Annotated[
        float,
        typer.Option(
            metavar="MINUTES", min=0, max=1440, help="Retry robots that are unreachable or moving for this long."
        ),
    ] = 0.0,
    ask_password: AskPassword = False,
    at_a_time: AtATime = 8,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> int:
    """Update robots: copy to all, then switch a canary, a wave, the rest; roll back unhealthy ones.

    After Ctrl-C each robot keeps what it ran; one that is switching rolls back automatically.
    """
    from fullswarm.deploy.fleet import commands
    from fullswarm.deploy.fleet.rollout import Plan, parse_share

    return commands.update(
        _order(
            fleet,
            robots,
            release=release,
            target=target,
            allow_older=allow_older,
            plan=Plan(canary, parse_share(wave), stop_at),
            guard_s=guard,
            force=force,
            keep_trying_s=keep_trying * 60.0,
            ask_password=ask_password,
            at_a_time=at_a_time,
            dry_run=dry_run,
            as_json=as_json,
        )
    )


@shell_command(needs="posix")
def rollback(
    fleet: FleetFile,
    robots: Robots = None,
    force: Force = False,
    ask_password: AskPassword = False,
    at_a_time: AtATime = 8,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> int:
    """Roll robots back to the previous release."""
    from fullswarm.deploy.fleet import commands

    rest = {"force": force, "ask_password": ask_password, "at_a_time": at_a_time, "dry_run": dry_run}
    return commands.rollback(_order(fleet, robots, **rest, as_json=as_json))


@shell_command(needs="posix")
def fleet(
    fleet: FleetFile,
    robots: Robots = None,
    ask_password: AskPassword = False,
    at_a_time: AtATime = 16,
    as_json: Json = False,
) -> int:
    """Show what each robot runs and should run, its state, and what to do."""
    from fullswarm.deploy.fleet import commands

    return commands.fleet(_order(fleet, robots, ask_password=ask_password, at_a_time=at_a_time, as_json=as_json))


@shell_command(needs="posix")
def logs(
    robot: OneRobot,
    fleet: FleetFile,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Continue until Ctrl-C.")] = False,
    lines: Annotated[int, typer.Option("--lines", "-n", min=0, max=100_000, help="Number of lines from the end.")] = 50,
    ask_password: AskPassword = False,
    as_json: Json = False,
) -> int:
    """Print the log of a robot's agent."""
    from fullswarm.deploy.fleet import commands

    return commands.logs(_order(fleet, [robot], ask_password=ask_password, as_json=as_json), lines, follow=follow)


@shell_command(needs="posix")
def shell(
    robot: OneRobot,
    fleet: FleetFile,
    words: Annotated[
        list[str] | None, typer.Argument(metavar="[-- COMMAND...]", help="Run this command instead of a shell.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the ssh command only.")] = False,
) -> int:
    """Open a shell on a robot, with the pinned host key and the fleet's key."""
    from fullswarm.deploy.fleet import commands

    return commands.shell(_order(fleet, [robot], dry_run=dry_run), words or [])


@shell_command(needs="posix")
def reboot(
    fleet: FleetFile,
    robots: Robots = None,
    wait: Annotated[
        float | None,
        typer.Option("--wait", metavar="SECONDS", min=1, max=3600, help="Wait this long until they are back."),
    ] = None,
    force: Force = False,
    ask_password: AskPassword = False,
    at_a_time: AtATime = 8,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> int:
    """Restart the computers of robots, unless they are moving."""
    from fullswarm.deploy.fleet import commands

    rest = {"force": force, "ask_password": ask_password, "at_a_time": at_a_time, "dry_run": dry_run}
    return commands.reboot(_order(fleet, robots, **rest, as_json=as_json), wait)
