"""`fullswarm track`: poses of robots from cameras above them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm.cli.options import Json, shell_command
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.config import SwarmConfig

track_app = typer.Typer(help="See robots with cameras: print tags, calibrate, publish poses.")
calibrate_app = typer.Typer(help="Calibrate a camera: first `lens`, then `floor`.", no_args_is_help=True)
track_app.add_typer(calibrate_app, name="calibrate")

FleetArgument = Annotated[Path, typer.Argument(metavar="FLEET.toml", envvar="FULLSWARM_FLEET", help="The fleet file.")]
Camera = Annotated[
    str | None, typer.Option("--camera", metavar="NAME", help="A camera of the fleet file (default: the only one).")
]
Source = Annotated[
    str | None,
    typer.Option(
        "--source",
        metavar="SOURCE",
        help="Device, stream, video or folder of pictures (default: as in the fleet file).",
    ),
]
Square = Annotated[
    float, typer.Option("--square-mm", min=5, max=500, help="Side of the printed board's squares, as measured.")
]
Seconds = Annotated[
    float, typer.Option("--seconds", min=1, max=3600, help="Look at a live source for so long at most.")
]
TagSize = Annotated[float, typer.Option("--tag-size-m", min=0.01, max=10, help="Side of the robots' black squares.")]
TagHeight = Annotated[float, typer.Option("--tag-height-m", min=0, max=10, help="Height of the robots' tags.")]


def _load(fleet: Path) -> SwarmConfig:
    from fullswarm.drivers.fleet_file import load_fleet

    return load_fleet(fleet)


@track_app.callback(invoke_without_command=True)
@shell_command(logs=True)
def track(
    context: typer.Context,
    video: Annotated[
        str | None, typer.Option("--video", metavar="FILE", help="Judge a video or a folder of pictures.")
    ] = None,
    fleet: Annotated[
        Path | None,
        typer.Option("--fleet", metavar="FILE", envvar="FULLSWARM_FLEET", help="The fleet file: its tags and cameras."),
    ] = None,
    camera: Camera = None,
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="FILE", help="The camera's file (default: that of the fleet's camera)."),
    ] = None,
    robots: Annotated[
        int, typer.Option(min=1, max=500, help="Without a fleet file: tags 1 to this number are on robots r1, r2, ...")
    ] = 32,
    tag_size_m: TagSize = 0.12,
    tag_height_m: TagHeight = 0.1,
    as_json: Json = False,
) -> int:
    """Print the poses in a recorded video, a line per frame and tag; `run` publishes those of live cameras."""
    if context.invoked_subcommand is not None:
        return 0
    if video is None:
        raise ConfigError("nothing to do", hint="fullswarm track run FLEET.toml, or --video FILE; --help lists all")
    from fullswarm.localization.camera import run
    from fullswarm.localization.camera.camera_file import read_camera
    from fullswarm.localization.camera.plan import plan_of

    if fleet is None:
        if calibration is None:
            raise ConfigError("needs --calibration FILE or --fleet FILE", where=f"--video {video}")
        plan = run.plain_plan(robots, tag_size_m, tag_height_m)
    else:
        config = _load(fleet)
        plan = plan_of(config)
        calibration = calibration or run.calibration_of(run.one_camera(config, camera, fleet))
    return run.judge(video, read_camera(calibration), str(calibration), plan, as_json=as_json)


@track_app.command()
@shell_command()
def init(
    fleet: Annotated[Path, typer.Argument(metavar="FLEET.toml", help="A new fleet file.")],
    robots: Annotated[int, typer.Option(min=1, max=100, help="Number of robots.")] = 8,
    floor: Annotated[str, typer.Option(metavar="WIDTHxDEPTH", help="Size of the floor in metres.")] = "6x4",
    source: Annotated[
        str | None,
        typer.Option(help="The camera (default: v4l2:///dev/video0; with --emulate: world://, a simulated camera)."),
    ] = None,
    emulate: Annotated[
        str, typer.Option(metavar="MODEL", help="Emulate the robots: create2, rover, ... (default: real Creates).")
    ] = "",
) -> int:
    """Write a fleet file of robots that a camera sees."""
    from fullswarm import output
    from fullswarm.localization.camera.fleet_template import fleet_text, write_fleet

    try:
        width_m, depth_m = (float(each) for each in floor.lower().split("x"))
    except ValueError:
        raise ConfigError("expected WIDTHxDEPTH", where=f"--floor {floor}", hint="like 6x4") from None
    if not (1.0 <= width_m <= 100.0 and 1.0 <= depth_m <= 100.0):
        raise ConfigError("a floor is 1 to 100 m wide and deep", where=f"--floor {floor}")
    source = source or ("world://" if emulate else "v4l2:///dev/video0?width=1920&height=1080&fps=30")
    write_fleet(fleet, fleet_text(robots, width_m, depth_m, source, emulate, str(fleet)))
    output.data(str(fleet))
    output.progress(f"Next: fullswarm track sheets {fleet}")
    return 0


@track_app.command()
@shell_command()
def sheets(
    fleet: Annotated[
        Path | None,
        typer.Argument(metavar="[FLEET.toml]", help="The fleet file: its tags, robots and places on the floor."),
    ] = None,
    robots: Annotated[int, typer.Option(min=1, max=500, help="Without a fleet file: number of robots.")] = 8,
    tag_size_m: TagSize = 0.12,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The PDF.")] = Path("sheets.pdf"),
    paper: Annotated[str, typer.Option(metavar="a4|letter", help="Size of the paper.")] = "a4",
    board: Annotated[bool, typer.Option("--board/--no-board", help="Print the calibration board as well.")] = True,
) -> int:
    """Print the tags for robots and floor and the calibration board, at true size."""
    from fullswarm import output
    from fullswarm.errors import did_you_mean
    from fullswarm.localization.camera import run
    from fullswarm.localization.camera.plan import FIRST_FLOOR_TAG, FloorTag, TagPlan, plan_of
    from fullswarm.localization.camera.sheets import PAPERS_M, write_sheets

    if paper.lower() not in PAPERS_M:
        raise ConfigError(f"unknown paper '{paper}'", where="--paper", hint=did_you_mean(paper, PAPERS_M))
    if fleet is not None:
        plan = plan_of(_load(fleet))
    else:
        corners = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
        floor = {
            FIRST_FLOOR_TAG + n: FloorTag(FIRST_FLOOR_TAG + n, x, y, 0.0, 0.14) for n, (x, y) in enumerate(corners)
        }
        plan = TagPlan(run.plain_plan(robots, tag_size_m, 0.0).robots, floor)
    pages = write_sheets(plan, out, paper.lower(), with_board=board, placed=fleet is not None)
    output.data(str(out))
    output.progress(f"{pages} pages; print at 100 % and measure the ruler: 100 mm")
    return 0


@calibrate_app.command()
@shell_command(logs=True)
def lens(
    fleet: FleetArgument,
    camera: Camera = None,
    source: Source = None,
    square_mm: Square = 34.0,
    seconds: Seconds = 120.0,
) -> int:
    """Find the lens from views of the printed board: in all parts of the picture, tilted each time."""
    from fullswarm.localization.camera import run

    entry = run.one_camera(_load(fleet), camera, fleet)
    return run.calibrate_lens(entry, source or entry.source, square_mm / 1000.0, seconds)


@calibrate_app.command()
@shell_command(logs=True)
def floor(
    fleet: FleetArgument,
    camera: Camera = None,
    source: Source = None,
    board_at: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,DEG", help="The board lies here: its lower left corner, and the direction of its lower edge."
        ),
    ] = None,
    square_mm: Square = 34.0,
    seconds: Seconds = 20.0,
) -> int:
    """Find where the camera hangs, from four or more floor tags of the fleet file, or from the board on the floor."""
    import math

    from fullswarm.localization.camera import run

    config = _load(fleet)
    entry = run.one_camera(config, camera, fleet)
    place: tuple[float, float, float] | None = None
    if board_at is not None:
        try:
            x_m, y_m, turn_deg = (float(each) for each in board_at.split(","))
        except ValueError:
            raise ConfigError("expected X,Y,DEG", where=f"--board-at {board_at}", hint="like 1.5,0.8,90") from None
        place = x_m, y_m, math.radians(turn_deg)
    return run.calibrate_floor(config, entry, source or entry.source, place, seconds, square_mm / 1000.0)


@track_app.command("run")
@shell_command(logs=True)
def run_cameras(
    fleet: FleetArgument,
    camera: Annotated[
        list[str] | None, typer.Option("--camera", metavar="NAME", help="A camera of the file (default: all).")
    ] = None,
    source: Source = None,
    show: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Serve the live picture here (default: as in the fleet file)."),
    ] = None,
    insecure_network: Annotated[
        bool, typer.Option("--insecure-network", help="Show the live picture beyond this machine.")
    ] = False,
    with_parent: Annotated[bool, typer.Option("--with-parent", hidden=True)] = False,
) -> int:
    """Publish the poses of robots that the cameras of a fleet file see; `fullswarm up` does this as well."""
    from fullswarm.localization.camera import run

    config = _load(fleet)
    cameras = run.cameras_of(config, camera or (), fleet)
    return run.run_live(config, cameras, run.Live(source, show, insecure_network, with_parent))
