"""Reads the dark parts of a picture as points, for robots that are to form it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fullswarm.errors import ConfigError, MissingExtra

MOST = 300
"""Points: they travel in the request of each robot."""
FINEST_PX, COARSEST_PX = 96, 4
MIDDLE = 128
LARGEST_PX = 20_000_000


def dark_points(path: Path, most: int = MOST) -> list[list[float]]:
    """Return the middles of dark pixels, in a picture 1 wide with y upwards; of fewer, larger pixels if there are many.

    Transparent parts count as white.

    Raises
    ------
    ConfigError
        There is no such file, it is no picture, or nothing in it is dark.
    MissingExtra
        pillow is not installed.
    """
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise MissingExtra("reading a picture needs pillow", hint="pip install 'fullswarm[experiments]'") from error
    if not path.is_file():
        raise ConfigError("no such file", where=str(path))
    try:
        with Image.open(path) as found:
            if found.width * found.height > LARGEST_PX:
                raise ConfigError(f"{found.width} x {found.height} pixels are too many", where=str(path))
            white = Image.new("RGBA", found.size, "white")
            grey = Image.alpha_composite(white, found.convert("RGBA")).convert("L")
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise ConfigError(f"is no picture that can be read: {error}", where=str(path)) from error
    side = min(FINEST_PX, max(grey.size))
    while True:
        share = side / max(grey.size)
        size = max(1, round(grey.width * share)), max(1, round(grey.height * share))
        rows, columns = np.nonzero(np.asarray(grey.resize(size, Image.Resampling.BOX)) < MIDDLE)
        if len(rows) <= most or side <= COARSEST_PX:
            break
        side = max(COARSEST_PX, int(0.9 * side))
    if not len(rows):
        raise ConfigError("nothing in the picture is dark", where=str(path), hint="draw it black on white")
    points = np.stack([columns + 0.5, size[1] - rows - 0.5], axis=1) / size[0]
    found_points: list[list[float]] = np.round(points[:most], 4).tolist()
    return found_points
