"""Maps of ROS's map_server (YAML and a picture): their occupied cells become boxes."""

from __future__ import annotations

from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios.importers.draft import Draft, Imported, Planar
from fullswarm.maps.ros_map import read_ros_map
from fullswarm.maps.tiles import UNKNOWN


def read(path: Path) -> Imported:
    """Return a map as a scenario.

    Raises
    ------
    ConfigError
        Not readable, no map of map_server, or too many boxes.
    MissingExtra
        The picture is no PGM, and Pillow is not installed.
    """
    found = read_ros_map(path)
    draft = Draft(str(path))
    draft.bounds = found.bounds_m
    draft.walls = False
    for x, y, wide, high, yaw in found.boxes():
        draft.rectangle(Planar(x, y, yaw), wide, high, "cells")
    if not draft.boxes:
        raise ConfigError("no cell of the map is occupied", where=str(path), hint="look at its thresholds and negate")
    if (unknown := int((found.states == UNKNOWN).sum())) > 0:
        share = unknown / found.states.size
        draft.note(f"{share:.0%} of the cells are unknown: free here")
    return draft.finish(path.stem, f"From the map {path.name}")
