"""Reads maps of ROS's map_server: a YAML file and beside it a picture, PGM or PNG.

The format (wiki.ros.org/map_server): a pixel p of 255 is occupied with the probability (255 - p) / 255, or p / 255 with
``negate: 1``. Above ``occupied_thresh`` it is occupied, below ``free_thresh`` free, else unknown; the first row of the
picture is the map's top, ``origin`` is the pose of its lower left corner. In the mode ``raw`` a pixel is the
probability in percent itself, above 100 unknown.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.kernels import Array
from fullswarm.maps.boxes import boxes
from fullswarm.maps.tiles import FREE, OCCUPIED, UNKNOWN, States

MOST_PIXELS = 40_000_000
MOST_BOXES = 5_000
"""Boxes of a world at most: planners and the simulated world look at each."""
HEAD_BYTES = 65_536


@dataclass(frozen=True, slots=True)
class RosMap:
    """A map: the state of each cell, row 0 at the lowest y, and the pose of its lower left corner."""

    states: States
    cell_m: float
    x_m: float
    y_m: float
    yaw_rad: float

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """The smallest arena that holds it: x_min, y_min, x_max, y_max."""
        rows, columns = self.states.shape
        corners = np.array([(x, y) for x in (0.0, columns * self.cell_m) for y in (0.0, rows * self.cell_m)])
        x, y = self._placed(corners).T
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())

    def boxes(self) -> tuple[tuple[float, float, float, float, float], ...]:
        """Return its occupied cells as boxes of a world: centre x, y, size x, y in m, yaw in rad.

        Raises
        ------
        ConfigError
            They are more than `MOST_BOXES`.
        """
        found = boxes(self.states == OCCUPIED, 0.0, 0.0, self.cell_m)
        if len(found) > MOST_BOXES:
            raise ConfigError(
                f"its occupied cells need {len(found)} boxes, more than {MOST_BOXES}",
                hint="use a map with larger cells, or remove speckles from the picture",
            )
        places = self._placed(found[:, :2])
        sizes = 2.0 * found[:, 2:4]
        rows = np.column_stack([places, sizes, np.full(len(found), self.yaw_rad)]).round(6)
        return tuple((x, y, wide, high, yaw) for x, y, wide, high, yaw in rows.tolist())

    def _placed(self, points: Array) -> Array:
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        turned: Array = points @ np.array([[c, s], [-s, c]]) + (self.x_m, self.y_m)
        return turned


def is_ros_map(text: str) -> bool:
    """Tell whether a YAML file describes a map of map_server."""
    return all(re.search(rf"^{key}\s*:", text, re.MULTILINE) for key in ("image", "resolution", "origin"))


@dataclass(frozen=True, slots=True)
class Sidecar:
    """What the YAML file of a map says: its picture, size of a cell, pose of its lower left corner; all its keys."""

    picture: Path
    cell_m: float
    x_m: float
    y_m: float
    yaw_rad: float
    given: dict[str, str]


def read_sidecar(path: Path) -> Sidecar:
    """Return what the YAML file of a map says; its picture is not read.

    Raises
    ------
    ConfigError
        It cannot be read, or a key is missing or has no valid value.
    """
    where = str(path)
    try:
        given = _settings(path.read_text("utf-8"), where)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"cannot be read: {getattr(error, 'strerror', None) or error}", where=where,
            hint="give the YAML file of a map of ROS's map_server",
        ) from error  # fmt: skip
    cell_m = _numbers(given, "resolution", 1, where)[0]
    x_m, y_m, yaw_rad = _numbers(given, "origin", 3, where)
    if not 1e-4 <= cell_m <= 100.0:
        raise ConfigError(f"resolution: {cell_m} is not the size of a cell in m", where=where)
    image = given["image"]
    if not image:
        raise ConfigError("image: names no picture", where=where)
    return Sidecar(path.parent / image, cell_m, x_m, y_m, yaw_rad, given)


def read_ros_map(sidecar: Path) -> RosMap:
    """Return the map that a YAML file describes.

    Raises
    ------
    ConfigError
        A file cannot be read, a key is missing or has no valid value, or the picture is none.
    MissingExtra
        The picture is no PGM, and Pillow is not installed.
    """
    read = read_sidecar(sidecar)
    states = _states(_picture(read.picture), read.given, str(sidecar))
    return RosMap(states, read.cell_m, read.x_m, read.y_m, read.yaw_rad)


def _settings(text: str, where: str) -> dict[str, str]:
    """Return the keys of the file: map_server's are flat, so no library is needed on board."""
    found: dict[str, str] = {}
    for line in text.splitlines():
        match = re.match(r"^([A-Za-z_]+)\s*:\s*(.*?)\s*(?:\s#.*)?$", line)
        if match:
            value = match[2].strip()
            quoted = len(value) >= 2 and value[0] == value[-1] and value[0] in "\"'"
            found[match[1]] = value[1:-1] if quoted else value
    missing = [key for key in ("image", "resolution", "origin") if key not in found]
    if missing:
        raise ConfigError(f"{', '.join(missing)} missing: this is no map of map_server", where=where)
    return found


def _numbers(given: dict[str, str], key: str, count: int, where: str) -> list[float]:
    words = [word for word in re.split(r"[\s,\[\]]+", given[key]) if word]
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(each) and abs(each) <= 1e6 for each in values):
        raise ConfigError(f"{key}: '{given[key]}' should be {count} number{'s' * (count > 1)}", where=where)
    return values


def _share(given: dict[str, str], key: str, default: float, where: str) -> float:
    if key not in given:
        return default
    value = _numbers(given, key, 1, where)[0]
    if not 0.0 <= value <= 1.0:
        raise ConfigError(f"{key}: {value:g} is out of 0 to 1", where=where)
    return value


def _states(pixels: NDArray[np.uint8], given: dict[str, str], where: str) -> States:
    mode = given.get("mode", "trinary")
    negate = given.get("negate", "0") in ("1", "true", "True")
    if mode not in ("trinary", "scale", "raw"):
        raise ConfigError(f"mode: '{mode}' is none of trinary, scale, raw", where=where)
    occupied_above = _share(given, "occupied_thresh", 0.65, where)
    free_below = _share(given, "free_thresh", 0.196, where)
    states = np.full(pixels.shape, UNKNOWN, np.uint8)
    if mode == "raw":
        known, chance = pixels <= 100, pixels / 100.0
    else:
        known, chance = np.ones(pixels.shape, bool), (pixels if negate else 255 - pixels.astype(int)) / 255.0
    states[known & (chance < free_below)] = FREE
    states[known & (chance > occupied_above)] = OCCUPIED
    return np.ascontiguousarray(states[::-1])


def _picture(path: Path) -> NDArray[np.uint8]:
    """Return the grey values of a picture, (rows, columns), its top row first."""
    where = str(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"the map's picture cannot be read: {error.strerror or error}", where=where) from error
    if data[:2] in (b"P2", b"P5"):
        return _pgm(data, where)
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise MissingExtra(
            "reading a map that is no PGM needs Pillow", where=where,
            hint="pip install 'fullswarm[experiments]', or convert the picture to PGM",
        ) from error  # fmt: skip
    try:
        with Image.open(path) as picture:
            if picture.width * picture.height > MOST_PIXELS:
                raise ConfigError(f"the picture has more than {MOST_PIXELS} pixels", where=where)
            return np.asarray(picture.convert("L"))
    except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ConfigError(f"this is no picture: {error}", where=where) from error


def _pgm(data: bytes, where: str) -> NDArray[np.uint8]:
    """Read a PGM (netpbm.sourceforge.net/doc/pgm.html), plain or raw."""
    head = re.match(rb"(P[25])" + 3 * rb"(?:\s|#[^\n]*\n)+(\d+)" + rb"\s", data[:HEAD_BYTES])
    if head is None:
        raise ConfigError("this is no PGM: its head is damaged", where=where)
    columns, rows, most = (int(head[at][:9]) for at in (2, 3, 4))
    if not 0 < rows * columns <= MOST_PIXELS or not 0 < most <= 65535:
        raise ConfigError(f"a PGM of {columns} x {rows} pixels up to {most} cannot be read", where=where)
    body = data[head.end() :]
    if head[1] == b"P2":
        try:
            values = np.array(body.split()[: rows * columns], dtype=np.int64)
        except (ValueError, OverflowError) as error:
            raise ConfigError("this is no PGM: a grey value is no number", where=where) from error
    else:
        values = np.frombuffer(body, ">u2" if most > 255 else np.uint8, -1 if most < 256 else len(body) // 2)
    if len(values) < rows * columns:
        raise ConfigError(f"the picture ends early: {len(values)} of {rows * columns} pixels", where=where)
    grey = values[: rows * columns].astype(np.int64).reshape(rows, columns)
    return np.asarray(np.clip(grey, 0, most) * 255 // most, np.uint8)
