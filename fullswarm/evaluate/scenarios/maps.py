"""Draws arenas and coverage grids as maps: as text, and for ROS as a PGM picture with map_server's YAML file beside it.

Row 0 of a grid lies at the lowest y; the first row of a picture is its top. Pixels as map_server writes them:
0 occupied, 205 unknown, 254 free.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios.model import Box, Scenario
from fullswarm.evaluate.scenarios.placement import boxes_for
from fullswarm.perf.coverage import GridFrame

OCCUPIED, UNKNOWN, FREE = 0, 205, 254
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196
"""(255 - 205) / 255 = 0.19608 is just not free: with map_server's other default, 0.25, unknown would be free."""

Pixels = NDArray[np.uint8]

_TOUCH_M = 1e-9


@dataclass(frozen=True, slots=True)
class Map:
    """Where a map's cells lie, and their pixels, shape (rows, columns), row 0 at the lowest y."""

    frame: GridFrame
    pixels: Pixels


def coverage_map(frame: GridFrame, covered: NDArray[np.generic], occupied: NDArray[np.bool_] | None = None) -> Map:
    """Return what a swarm has covered as a map: covered cells are free, others unknown, `occupied` ones occupied.

    Parameters
    ----------
    covered, occupied
        Shape (rows, columns); not zero means yes.

    Raises
    ------
    ConfigError
        A grid's shape is not the frame's.
    """
    grid = np.asarray(covered).astype(bool)
    for each in (grid, occupied):
        if each is not None and each.shape != (frame.rows, frame.columns):
            raise ConfigError(f"a grid of shape {each.shape} in a frame of {frame.rows} x {frame.columns} cells")
    pixels = np.where(grid, FREE, UNKNOWN).astype(np.uint8)
    if occupied is not None:
        pixels[occupied] = OCCUPIED
    return Map(frame, pixels)


def scenario_map(scenario: Scenario, seed: int, cell_m: float) -> Map:
    """Return a scenario's boxes as a map; with walls there is one more row of cells all around, occupied.

    Raises
    ------
    ConfigError
        The boxes do not fit, or the map would be too large.
    """
    frame = GridFrame.over(scenario.bounds_m, cell_m)
    occupied = occupied_cells(frame, boxes_for(scenario, seed))
    if scenario.walls:
        occupied = np.pad(occupied, 1, constant_values=True)
        frame = GridFrame(
            frame.origin_x_m - cell_m, frame.origin_y_m - cell_m, cell_m, frame.rows + 2, frame.columns + 2
        )
    return Map(frame, np.where(occupied, OCCUPIED, FREE).astype(np.uint8))


def occupied_cells(frame: GridFrame, boxes: tuple[Box, ...]) -> NDArray[np.bool_]:
    """Return which cells a box reaches into, be it by a corner, shape (rows, columns).

    Two rectangles overlap unless one of their four axes parts them (separating axis theorem).
    """
    half = frame.cell_m / 2.0
    x = frame.origin_x_m + frame.cell_m * np.arange(frame.columns) + half
    y = frame.origin_y_m + frame.cell_m * np.arange(frame.rows) + half
    occupied = np.zeros((frame.rows, frame.columns), np.bool_)
    for centre_x, centre_y, size_x, size_y, yaw in boxes:
        cos, sin = abs(np.cos(yaw)), abs(np.sin(yaw))
        reach_x, reach_y = (size_x * cos + size_y * sin) / 2.0, (size_x * sin + size_y * cos) / 2.0
        columns = np.flatnonzero(np.abs(x - centre_x) < reach_x + half - _TOUCH_M)
        rows = np.flatnonzero(np.abs(y - centre_y) < reach_y + half - _TOUCH_M)
        dx, dy = x[columns][None, :] - centre_x, y[rows][:, None] - centre_y
        cell_reach = half * (cos + sin) - _TOUCH_M
        along = np.abs(np.cos(yaw) * dx + np.sin(yaw) * dy) < size_x / 2.0 + cell_reach
        across = np.abs(np.cos(yaw) * dy - np.sin(yaw) * dx) < size_y / 2.0 + cell_reach
        occupied[np.ix_(rows, columns)] |= along & across
    return occupied


def write_map(grid: Map, path: Path) -> tuple[Path, Path]:
    """Write the picture and its YAML file beside it; return both paths. `path` may end in .pgm or .yaml, or not.

    Raises
    ------
    ConfigError
        They cannot be written.
    """
    stem = path.with_suffix("") if path.suffix in (".pgm", ".yaml") else path
    picture, sidecar = (stem.with_name(stem.name + ending) for ending in (".pgm", ".yaml"))
    frame = grid.frame
    head = f"P5\n{frame.columns} {frame.rows}\n255\n".encode("ascii")
    text = (
        f"image: {_quoted(picture.name)}\n"
        "mode: trinary\n"
        f"resolution: {frame.cell_m!r}\n"
        f"origin: [{frame.origin_x_m!r}, {frame.origin_y_m!r}, 0.0]\n"
        "negate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESHOLD}\n"
        f"free_thresh: {FREE_THRESHOLD}\n"
    )
    try:
        picture.write_bytes(head + np.ascontiguousarray(grid.pixels[::-1]).tobytes())
        sidecar.write_text(text, "utf-8")
    except OSError as error:
        raise ConfigError(f"cannot write the map: {error.strerror or error}", where=str(picture)) from error
    return picture, sidecar


def _quoted(name: str) -> str:
    """Return a YAML string in double quotes where it needs them."""
    plain = name.replace(".", "").replace("_", "").replace("-", "").isalnum() and name[0].isalpha()
    return name if plain and name.isascii() else json.dumps(name)


COLUMNS = 64
"""Width of the map; a character is about twice as high as wide, so two cells side by side are one square."""

BOX, ROBOT, GOAL, START, FLOOR = "#", "R", "o", ".", " "
LEGEND = f"{BOX} box or wall   {ROBOT} robot   {GOAL} goal   {START} where robots start"


def text_map(
    scenario: Scenario,
    boxes: tuple[Box, ...],
    robots: Sequence[tuple[float, float]],
    names: Sequence[str] | None = None,
    goals: Sequence[tuple[float, float]] | None = None,
) -> str:
    """Return the arena seen from above, y upwards, with a frame where it has walls.

    Parameters
    ----------
    names : a character for each robot; None: `ROBOT` for all
    goals : of the robots; None: the scenario's
    """
    x_min, y_min, x_max, y_max = scenario.bounds_m
    cell_x = max((x_max - x_min) / COLUMNS, (y_max - y_min) / COLUMNS)
    columns, rows = max(1, round((x_max - x_min) / cell_x)), max(1, round((y_max - y_min) / (2 * cell_x)))
    # A character is a box when boxes reach into a sixth of its 3 x 6 parts: thin walls stay, most gaps stay open.
    parts = occupied_cells(GridFrame(x_min, y_min, cell_x / 3, 6 * rows, 3 * columns), boxes)
    solid = parts.reshape(rows, 6, columns, 3).mean(axis=(1, 3)) >= 1 / 6 - 1e-9
    x = x_min + (np.arange(columns) + 0.5) * cell_x
    y = y_min + (np.arange(rows)[:, None] + 0.5) * 2 * cell_x
    left, low, right, high = scenario.spawn.region_m
    grid = np.where((left <= x) & (x <= right) & (low <= y) & (y <= high), START, FLOOR)
    for goal_x, goal_y in goals or (scenario.goal.centre_m,):
        grid[(x - goal_x) ** 2 + (y - goal_y) ** 2 <= scenario.goal.radius_m**2] = GOAL
    grid[solid] = BOX
    for (robot_x, robot_y), name in zip(robots, names or ROBOT * len(robots), strict=True):
        column, row = int((robot_x - x_min) / cell_x), int((robot_y - y_min) / (2 * cell_x))
        if 0 <= column < columns and 0 <= row < rows:
            grid[row, column] = name
    side, corner = (BOX, BOX) if scenario.walls else ("|", "+")
    edge = corner + (BOX if scenario.walls else "-") * columns + corner
    return "\n".join([edge, *(f"{side}{''.join(line)}{side}" for line in grid[::-1].tolist()), edge])
