"""`fullswarm fixes`: poses of motion capture, receivers and radio anchors as fixes; `fixes record`, `fixes play`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.cli.options import shell_command
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.cli.options import Target

fixes_app = typer.Typer(invoke_without_command=True)

Source = Annotated[
    str | None,
    typer.Option(
        "--source", metavar="URL", help="natnet://HOST, vicon://, qualisys://, vrpn://, gnss:///dev/ttyACM0, ..."
    ),
]
Map = Annotated[
    list[str] | None, typer.Option("--map", metavar="NAME=ROBOT", help="Map a name of the source to a robot.")
]
Objects = Annotated[
    list[str] | None,
    typer.Option("--object", metavar="NAME=RADIUS_M", help="Report a name as an object to keep off: a person, a cart."),
]
Axes = Annotated[str | None, typer.Option(metavar="z-up|y-up", help="Which axis of the source points up.")]
Unit = Annotated[str | None, typer.Option(metavar="m|cm|mm", help="The source's unit of length.")]
SigmaM = Annotated[
    float | None, typer.Option(min=1e-4, max=100, help="Standard deviation of positions that come without one, m.")
]
SigmaRad = Annotated[
    float | None, typer.Option(min=1e-4, max=3, help="Standard deviation of headings that come without one, rad.")
]
Robot = Annotated[str, typer.Option(metavar="ROBOT", help="The robot that is measured, where the source names none.")]
FleetFile = Annotated[
    Path | None,
    typer.Option("--fleet", envvar="FULLSWARM_FLEET", metavar="FILE", help="Take the sources of this fleet file."),
]
Listen = Annotated[
    str | None, typer.Option(metavar="HOST:PORT", help="Listen for JSON there: short for --source json://HOST:PORT.")
]
Insecure = Annotated[
    bool, typer.Option("--insecure-network", help="Listen beyond this machine: everyone there can send fixes.")
]
WithParent = Annotated[bool, typer.Option("--with-parent", hidden=True)]


def _url(source: str | None, listen: str | None) -> str:
    from fullswarm.localization.fixes import DEFAULT_SOURCE

    if source and listen:
        raise ConfigError("--source and --listen exclude each other", hint="write --source json://HOST:PORT")
    return source or (f"json://{listen}" if listen else DEFAULT_SOURCE)


@fixes_app.callback()
@shell_command(logs=True, needs="posix")
def fixes(
    context: typer.Context,
    target: Target,
    source: Source = None,
    listen: Listen = None,
    fleet: FleetFile = None,
    names: Map = None,
    objects: Objects = None,
    axes: Axes = None,
    unit: Unit = None,
    sigma_m: SigmaM = None,
    sigma_rad: SigmaRad = None,
    robot: Robot = "",
    insecure_network: Insecure = False,
    with_parent: WithParent = False,
) -> int:
    """Publish poses of motion capture, GNSS receivers and radio anchors as fixes for the robots."""
    if context.invoked_subcommand is not None:
        return 0
    from fullswarm.localization import fixes as service
    from fullswarm.localization.publisher import Names, parse_map, parse_objects
    from fullswarm.localization.source import Settings

    config = service.swarm_at(target.hub, target.swarm)
    if fleet is not None:
        from fullswarm.drivers.fleet_file import load_fleet

        config = load_fleet(fleet)
    if fleet is not None and not source and not listen:
        found = [service.settings_of(config, each, insecure_network) for each in config.fixes]
        if not found:
            raise ConfigError("has no source of fixes", where=str(fleet), hint='add [fixes] with source = "natnet://…"')
        return service.run(config, found, with_parent)
    settings = Settings(
        _url(source, listen),
        Names(parse_map(names or ()), parse_objects(objects or ())),
        axes,
        unit,
        sigma_m,
        sigma_rad,
        insecure_network,
        robot,
        config.origin_deg,
        service.anchors_of(config),
    )
    return service.run(config, [settings], with_parent)


@fixes_app.command()
@shell_command(logs=True, needs="posix")
def record(
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="A new file, JSON lines.")],
    source: Source = None,
    listen: Listen = None,
    axes: Axes = None,
    unit: Unit = None,
    seconds: Annotated[float, typer.Option(min=0, max=86_400, help="Duration; 0: until Ctrl-C.")] = 0.0,
    insecure_network: Insecure = False,
) -> int:
    """Write what a source delivers to a file, without a swarm. Exit code 1: nothing arrived."""
    from fullswarm.localization.fixes import record as run
    from fullswarm.localization.source import Anchors, Settings

    # Bytes of receivers and tags are recorded as they are: whose they are and where does not matter yet.
    nowhere = Anchors({"": (0.0, 0.0, 0.0)})
    settings = Settings(
        _url(source, listen),
        axes=axes,
        unit=unit,
        insecure_network=insecure_network,
        robot="r1",
        origin_deg=(0.0, 0.0),
        anchors=nowhere,
    )
    return run(settings, out, seconds)


@fixes_app.command()
@shell_command(logs=True, needs="posix")
def play(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A file of `fixes record`.")],
    protocol: Annotated[
        str | None,
        typer.Option(
            "--as", metavar="PROTOCOL", help="natnet, vicon, qualisys, vrpn, json, raw (default: as recorded)."
        ),
    ] = None,
    at: Annotated[
        str | None, typer.Option("--at", metavar="HOST:PORT", help="Serve, or send, there (default: as the vendor).")
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end.")] = False,
    speed: Annotated[float, typer.Option(min=0.01, max=100, help="How many times faster.")] = 1.0,
) -> int:
    """Play a recording on a real port in the format of its vendor, as if the system were there."""
    from fullswarm.emulators.mocap.player import run

    return run(file, protocol, at, loop=loop, speed=speed)
