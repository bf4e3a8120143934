"""Writes a fleet file for robots that a camera sees: `fullswarm track init`."""

from __future__ import annotations

import math
from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.localization.camera.plan import FIRST_FLOOR_TAG

INSET_M = 0.12
SPACING_M = 0.7

HEAD = """\
# {count} robots that a camera above sees by their tags. Steps: docs/how-to-camera.md
#
#     fullswarm track sheets {file}            # print at 100 %, glue on
#     fullswarm track calibrate lens {file}    # then: calibrate floor
#     fullswarm up {file}

swarm = "swarm"

[hub]
endpoint = "tcp/127.0.0.1:7447"     # only this machine can connect

[agent]
estimator = "ekf"                   # fuses odometry with the camera's fixes
speed_limit_m_s = 0.3
safety_margin_m = 0.05
{bounds}
[tags]
size_m = 0.12                       # side of the black square, on robots
height_m = 0.1                      # of the robots' tags above the floor; [[robot]] tag_height_m for one of them
floor_size_m = 0.14
floor = [                           # number, x, y in metres (middle), direction of the upper edge in radians
{floor}
]

[[camera]]
name = "ceiling"
source = "{source}"
rate_hz = 20.0
show = "127.0.0.1:8808"             # the live picture; the console shows it as well
"""
WORLD = """
[world]                             # simulated: `world://` renders what a camera above it would see
engine = "kinematic"
bounds_m = [0.0, 0.0, {width:g}, {depth:g}]
speed_limit_m_s = 0.3
"""
ROBOT = """
[[robot]]
id = "r{number}"                           # carries tag {number}, unless `tag = ...` says otherwise
{driver}
pose = [{x:.2f}, {y:.2f}, {heading:.2f}]            # where it is put at first: x, y, heading
"""


def fleet_text(count: int, width_m: float, depth_m: float, source: str, emulate: str, file: str) -> str:
    """Return a fleet file of `count` robots on a floor of `width_m` by `depth_m`.

    Raises
    ------
    ConfigError
        The robots have no room on that floor.
    """
    simulated = bool(emulate)
    across = INSET_M
    places = [
        (across, across), (width_m / 2.0, across), (width_m - across, across),
        (width_m - across, depth_m - across), (width_m / 2.0, depth_m - across), (across, depth_m - across),
    ]  # fmt: skip
    floor = "\n".join(f"    [{FIRST_FLOOR_TAG + n}, {x:.2f}, {y:.2f}, 0.0]," for n, (x, y) in enumerate(places))
    bounds = (
        ""
        if simulated
        else f"bounds_m = [0.0, 0.0, {width_m:g}, {depth_m:g}]   # the floor: x_min, y_min, x_max, y_max\n"
    )
    text = HEAD.format(count=count, file=file, bounds=bounds, floor=floor, source=source)
    if simulated:
        text += WORLD.format(width=width_m, depth=depth_m)
    for number, (x, y, heading) in enumerate(_starts(count, width_m, depth_m), 1):
        driver = (
            f'emulate = "{emulate}"                # a real driver on a real port; its body is simulated'
            if simulated
            else f'driver = "create:///dev/ttyUSB{number - 1}?model=create2"   # see `fullswarm robots find`'
        )
        text += ROBOT.format(number=number, driver=driver, x=x, y=y, heading=heading)
    return text


def _starts(count: int, width_m: float, depth_m: float) -> list[tuple[float, float, float]]:
    """Return free places in rows along the longer sides, facing the middle."""
    per_row = int((width_m - 1.0) // SPACING_M) + 1
    rows = math.ceil(count / per_row) if per_row > 0 else 0
    if not rows or rows * SPACING_M > depth_m - 0.3:
        raise ConfigError(
            f"{count} robots have no room on {width_m:g} by {depth_m:g} m", hint="--floor WIDTHxDEPTH, in metres"
        )
    found = []
    for number in range(count):
        row, column = divmod(number, per_row)
        in_row = min(per_row, count - row * per_row)
        x = width_m / 2.0 + (column - (in_row - 1) / 2.0) * SPACING_M
        y = depth_m / 2.0 + (row - (rows - 1) / 2.0) * max(SPACING_M, min(1.6, (depth_m - 0.9) / max(1, rows - 1)))
        found.append((x, y, math.pi / 2.0 if y < depth_m / 2.0 else -math.pi / 2.0))
    return found


def write_fleet(path: Path, text: str) -> None:
    """Write a new fleet file; ``ConfigError`` if it is there or cannot be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise ConfigError(
            "is there already; nothing was written", where=str(path), hint="choose another name"
        ) from None
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error
