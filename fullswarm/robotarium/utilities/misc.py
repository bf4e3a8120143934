"""Start poses, tests of arrival, and sizes of what a script draws."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Index
from fullswarm.robotarium.utilities.arguments import columns, positive, require

__all__ = [
    "at_pose",
    "at_position",
    "determine_font_size",
    "determine_marker_size",
    "generate_initial_conditions",
    "np",
    "plt",
]

POINTS_PER_INCH = 72.0


def generate_initial_conditions(N: int, spacing: float = 0.3, width: float = 3, height: float = 1.8) -> Array:
    """Return random poses (3, N) on a grid of `spacing` m that covers `width` by `height` m around the origin.

    They come from NumPy's global generator: after the same ``numpy.random.seed`` they are those of ``rps``.

    Raises
    ------
    ConfigError
        The grid has no room for N robots.
    """
    positive(N=N, spacing=spacing, width=width, height=height)
    across, along = int(width / spacing), int(height / spacing)
    if across * along <= N:
        raise ConfigError(
            f"{N} robots do not fit into {width} by {height} m at distances of {spacing} m",
            where="generate_initial_conditions", hint="fewer robots, or a smaller spacing",
        )  # fmt: skip
    cells = np.random.choice(across * along, N, replace=False) + 1  # noqa: NPY002
    column, row = np.divmod(cells, along)
    heading = np.random.rand(N) * 2.0 * np.pi - np.pi  # noqa: NPY002
    return np.stack([column * spacing - width / 2.0, row * spacing - height / 2.0, heading])


def at_pose(states: Array, poses: Array, position_error: float = 0.05, rotation_error: float = 0.2) -> tuple[Index]:
    """Return which robots are within both errors, m and rad, of their poses, in a tuple as ``numpy.nonzero``."""
    states = columns(states, 3, "states")
    poses = columns(poses, 3, "poses", states.shape[1])
    turn = states[2] - poses[2]
    turned = np.abs(np.arctan2(np.sin(turn), np.cos(turn))) <= rotation_error
    return (np.flatnonzero(turned & (np.linalg.norm(states[:2] - poses[:2], axis=0) <= position_error)),)


def at_position(states: Array, points: Array, position_error: float = 0.02) -> tuple[Index]:
    """Return which robots, of poses (3, N), are within the error of their points (2, N), as :func:`at_pose`."""
    states = columns(states, 3, "states")
    points = columns(points, 2, "points", states.shape[1])
    return (np.flatnonzero(np.linalg.norm(states[:2] - points, axis=0) <= position_error),)


def determine_marker_size(robotarium_instance: Any, marker_size_meters: float) -> float:
    """Return the `s` of ``axes.scatter`` (points squared) with which a marker is `marker_size_meters` wide."""
    return _points(robotarium_instance, marker_size_meters) ** 2


def determine_font_size(robotarium_instance: Any, font_height_meters: float) -> float:
    """Return the font size (points) with which a text is `font_height_meters` high."""
    return _points(robotarium_instance, font_height_meters)


def _points(robotarium: Any, size_m: float) -> float:
    """Return how many points `size_m` takes in the figure of a testbed."""
    require(robotarium.show_figure, "show_figure", robotarium.show_figure, "True: sizes are those in the figure")
    pixels = robotarium.axes.transData.transform([[0.0, 0.0], [size_m, 0.0]])
    return float(pixels[1, 0] - pixels[0, 0]) * POINTS_PER_INCH / float(robotarium.figure.dpi)
