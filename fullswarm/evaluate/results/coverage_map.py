"""`fullswarm results map`: what the swarm of one trial has covered, as a map that ROS's map_server reads."""

from __future__ import annotations

import zlib
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from fullswarm import output
from fullswarm.errors import ConfigError
from fullswarm.evaluate.coverage_map import coverage_map, occupied_cells, write_map
from fullswarm.evaluate.experiment.record import COVERAGE_FILE, TRAJECTORY_FILE
from fullswarm.evaluate.pictures.replay import find_trial, read_trajectory
from fullswarm.perf.coverage import GridFrame


def write(folder: Path, trial: str, out: Path | None) -> int:
    """Write the map of a trial and print both files' names.

    Raises
    ------
    ConfigError
        No such trial, it has no grid (a failed one, a fleet's), or the map cannot be written.
    """
    place = find_trial(folder, trial)
    frame, covered = read_coverage(place / COVERAGE_FILE)
    boxes = read_trajectory(place).boxes if (place / TRAJECTORY_FILE).exists() else np.zeros((0, 5))
    occupied = occupied_cells(frame, tuple((x, y, size_x, size_y, yaw) for x, y, size_x, size_y, yaw in boxes.tolist()))
    output.data("\n".join(map(str, write_map(coverage_map(frame, covered, occupied), out or place / "coverage"))))
    return 0


def read_coverage(path: Path) -> tuple[GridFrame, NDArray[np.uint8]]:
    """Return a trial's grid: its frame, and (rows, columns) of 0 and 1.

    Raises
    ------
    ConfigError
        There is none, or it is broken.
    """
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            x_m, y_m, cell_m, rows, columns = file["frame"].tolist()
            return GridFrame(x_m, y_m, cell_m, int(rows), int(columns)), file["covered"]
    except FileNotFoundError as error:
        raise ConfigError("this trial has no coverage grid", where=str(path)) from error
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile, zlib.error) as error:
        raise ConfigError(f"not a coverage grid: {error}", where=str(path), hint="run the trial again") from error
