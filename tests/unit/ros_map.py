"""Reads a map as ROS's map_server does: with PyYAML and Pillow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from fullswarm.evaluate.scenarios.maps import Map
from fullswarm.perf.coverage import GridFrame


def read_map(sidecar: Path) -> Map:
    """Return the map that a YAML file describes."""
    told = yaml.safe_load(sidecar.read_text("utf-8"))
    assert (told["mode"], told["negate"], told["origin"][2]) == ("trinary", 0, 0.0)
    with Image.open(sidecar.parent / told["image"]) as picture:
        assert picture.format == "PPM"
        pixels = np.asarray(picture)[::-1].copy()
    x_m, y_m, _ = told["origin"]
    return Map(GridFrame(x_m, y_m, told["resolution"], *pixels.shape), pixels)
