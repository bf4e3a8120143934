"""Reads what lies under the console's map: a floor plan, a map of ROS's map_server, or tiles of a file, for outdoors.

A picture is placed in the swarm's frame by a sidecar: the YAML file of map_server, which may name any picture, or an
ESRI world file beside it (``plan.pgw`` of ``plan.png``). A picture without one fills the arena. Tiles come from an
MBTiles file (github.com/mapbox/mbtiles-spec, 1.3: Web Mercator, rows counted from the south), and lie where the
swarm's origin is on earth.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
import secrets
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.maps.ros_map import read_sidecar

PATH = "/underlay"
MOST_PIXELS = 100_000_000
LONGEST_SIDE = 4096
"""Pixels of a picture that pages get: browsers on tablets draw no larger ones."""
SIDECARS = {".yaml", ".yml"}
PICTURES = {".png", ".jpg", ".jpeg", ".webp", ".pgm", ".gif", ".bmp", ".tif", ".tiff"}
WORLD_FILES = {".png": ".pgw", ".jpg": ".jgw", ".jpeg": ".jgw", ".tif": ".tfw", ".tiff": ".tfw"}
TILES = ".mbtiles"
TILE_MEDIA = {"png": "image/png", "jpg": "image/jpeg", "jpeg": "image/jpeg", "webp": "image/webp"}
DEEPEST = 24
SKEW = 1e-3
HINT = "give a picture, the YAML file of a map of ROS's map_server, or an MBTiles file"


@dataclass(frozen=True, slots=True)
class Place:
    """Where a picture lies: size of a pixel in m, and the pose of its lower left corner in the swarm's frame."""

    cell_m: float
    x_m: float
    y_m: float
    yaw_rad: float


class Source(Protocol):
    """Something that is drawn under the map."""

    def shown(self) -> dict[str, Any]:
        """Return what the page must know of it, without its address."""
        ...

    def read(self, name: str) -> tuple[bytes, str] | None:
        """Return the bytes and the media type of a part of it by its name; None: there is none."""
        ...


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture; `place` is None for one that fills the arena."""

    data: bytes
    media: str
    width: int
    height: int
    place: Place | None

    def shown(self) -> dict[str, Any]:
        """Return what the page must know of it."""
        place = self.place
        placed = None if place is None else [place.cell_m, place.x_m, place.y_m, place.yaw_rad]
        return {"kind": "picture", "width": self.width, "height": self.height, "place": placed}

    def read(self, name: str) -> tuple[bytes, str] | None:
        """Return the picture."""
        return (self.data, self.media) if name == "picture" else None


@dataclass(frozen=True, slots=True)
class Tiles:
    """Tiles of an MBTiles file."""

    file: Path
    media: str
    zooms: tuple[int, int]
    attribution: str

    def shown(self) -> dict[str, Any]:
        """Return what the page must know of them."""
        return {"kind": "tiles", "zooms": list(self.zooms), "attribution": self.attribution}

    def read(self, name: str) -> tuple[bytes, str] | None:
        """Return a tile by ``zoom/column/row``, its row counted from the north as in addresses of the web."""
        match = re.fullmatch(r"(\d{1,2})/(\d{1,8})/(\d{1,8})", name)
        if match is None:
            return None
        zoom, column, row = map(int, match.groups())
        if zoom > DEEPEST or max(column, row) >= 2**zoom:
            return None
        with (
            contextlib.suppress(sqlite3.Error),
            _opened(self.file) as database,
        ):  # damaged: the page draws what there is
            found = database.execute(
                "SELECT tile_data FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?",
                (zoom, column, 2**zoom - 1 - row),
            ).fetchone()
            if found is not None and isinstance(found[0], bytes):
                return found[0], self.media
        return None


@dataclass(frozen=True, slots=True)
class Underlay:
    """Serves a source to pages, under an address that only they are told."""

    source: Source
    name: str
    key: str = field(default_factory=lambda: secrets.token_urlsafe(16))

    def frame(self) -> dict[str, Any]:
        """Return the frame ``underlay``."""
        return {"t": "underlay", "name": self.name, "address": f"{PATH}/{self.key}/", **self.source.shown()}

    def route(self) -> Route:
        """Return what answers requests for its parts."""
        return Route(f"{PATH}/{{key}}/{{name:path}}", self._answer)

    async def _answer(self, request: Request) -> Response:
        known = secrets.compare_digest(request.path_params["key"].encode(), self.key.encode())
        found = self.source.read(request.path_params["name"]) if known else None
        if found is None:
            return PlainTextResponse("nothing lies there", 404)
        return Response(found[0], media_type=found[1], headers={"Cache-Control": "private, max-age=86400"})


def read_underlay(path: Path) -> Underlay:
    """Return what a file shows under the map.

    Raises
    ------
    ConfigError
        The file cannot be read, or is none that can be shown.
    MissingExtra
        Pillow, which reads pictures, is not installed.
    """
    suffix = path.suffix.lower()
    if not path.is_file():
        raise ConfigError("there is no such file", where=str(path), hint=HINT)
    source: Source
    if suffix == TILES:
        source = _tiles(path)
    elif suffix in SIDECARS:
        sidecar = read_sidecar(path)
        source = _picture(sidecar.picture, lambda _: Place(sidecar.cell_m, sidecar.x_m, sidecar.y_m, sidecar.yaw_rad))
    elif suffix in PICTURES:
        source = _picture(path, lambda height: _from_world_file(path, height))
    else:
        raise ConfigError(f"a '{suffix}' file cannot be shown under the map", where=str(path), hint=HINT)
    return Underlay(source, path.name)


# ---------------------------------------------------------------- pictures
def _picture(path: Path, place: Callable[[int], Place | None]) -> Picture:
    """Return a picture as pages get it; `place` is given its height in pixels."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise MissingExtra(
            "a picture under the map needs Pillow", where=str(path), hint="pip install 'fullswarm[console]'"
        ) from error
    try:
        with Image.open(path) as picture:
            width, height = picture.size
            if width * height > MOST_PIXELS:
                raise ConfigError(f"the picture has more than {MOST_PIXELS} pixels", where=str(path))
            kind = "JPEG" if picture.format == "JPEG" else "PNG"
            keeps = picture.mode in ("L", "LA", "RGB", "RGBA")
            shown = picture if keeps else picture.convert("RGBA" if "transparency" in picture.info else "RGB")
            shown.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
            out = io.BytesIO()
            shown.save(out, kind, **({"quality": 85} if kind == "JPEG" else {}))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ConfigError(f"this is no picture: {error}", where=str(path), hint=HINT) from error
    media = "image/jpeg" if kind == "JPEG" else "image/png"
    return Picture(out.getvalue(), media, width, height, place(height))


def _from_world_file(path: Path, height: int) -> Place | None:
    """Return where the world file beside a picture puts it; None: there is none.

    Its six lines are A, D, B, E, C, F: a pixel's column and row lie at x = A column + B row + C and
    y = D column + E row + F (Esri, "World files"); C and F are the middle of the upper left pixel.
    """
    suffix = path.suffix.lower()
    names = [path.with_suffix(each) for each in (WORLD_FILES.get(suffix, ""), ".wld") if each]
    file = next((each for each in names if each.is_file()), None)
    if file is None:
        return None
    try:
        numbers = [float(word) for word in file.read_text("ascii").split()]
    except (OSError, ValueError) as error:
        raise ConfigError("this is no world file: it should have six numbers", where=str(file)) from error
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise ConfigError("this is no world file: it should have six numbers", where=str(file))
    a, d, b, e, c, f = numbers
    cell_m = math.hypot(a, d)
    if not 1e-5 <= cell_m <= 1e4 or math.hypot(e + a, b - d) > SKEW * cell_m:
        raise ConfigError(
            "it stretches, skews or mirrors the picture", where=str(file), hint="A = -E and B = D, in m per pixel"
        )
    column, row = -0.5, height - 0.5
    return Place(cell_m, a * column + b * row + c, d * column + e * row + f, math.atan2(d, a))


# ---------------------------------------------------------------- tiles
def _tiles(path: Path) -> Tiles:
    where = str(path)
    try:
        with _opened(path) as database:
            given = {str(name): str(value) for name, value in database.execute("SELECT name, value FROM metadata")}
            low, high = database.execute("SELECT min(zoom_level), max(zoom_level) FROM tiles").fetchone()
    except sqlite3.Error as error:
        raise ConfigError(f"this is no MBTiles file: {error}", where=where) from error
    kind = given.get("format", "png").lower()
    if kind not in TILE_MEDIA:
        hint = "make one with pictures: png, jpg or webp"
        raise ConfigError(f"its tiles are '{kind}', which the map cannot draw", where=where, hint=hint)
    if not isinstance(low, int) or not 0 <= low <= high <= DEEPEST:
        raise ConfigError("it has no tiles", where=where)
    return Tiles(path, TILE_MEDIA[kind], (low, high), re.sub(r"<[^>]*>", "", given.get("attribution", ""))[:200])


def _opened(path: Path) -> contextlib.closing[sqlite3.Connection]:
    return contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True))
