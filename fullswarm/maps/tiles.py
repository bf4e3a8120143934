"""Cuts a grid of states into square tiles and packs them for the bus: two bits per cell, then deflated.

All robots of a fleet file lay the same grid over the arena, so a tile is named by its number alone.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import MessageError
from fullswarm.kernels import Array, Index
from fullswarm.messages import GridTiles

States = NDArray[np.uint8]
"""UNKNOWN, FREE or OCCUPIED of each cell, (rows, columns); row 0 lies at the lowest y."""

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
SIDE = 32
"""Cells along each side of a tile."""
PACKED = SIDE * SIDE // 4
MOST_TILES = 32
"""Tiles in a message at most: 8 KB before they are deflated."""
MOST_CELLS = 1_000_000
"""A larger arena gets coarser cells."""


@dataclass(frozen=True, slots=True)
class GridPlace:
    """Where the cells of an occupancy grid lie: its lower left corner and cell size in m, rows and columns of cells.

    Rows and columns are whole tiles.
    """

    x_min: float
    y_min: float
    cell_m: float
    rows: int
    columns: int

    @classmethod
    def over(cls, bounds_m: Sequence[float], cell_m: float) -> GridPlace:
        """Return the grid over an arena x_min, y_min, x_max, y_max with one more cell around it, or coarser ones."""
        x_min, y_min, x_max, y_max = bounds_m
        cell_m = max(cell_m, math.sqrt((x_max - x_min) * (y_max - y_min) / MOST_CELLS))
        sides = [max(1, math.ceil((high - low) / cell_m - 1e-6)) + 2 for low, high in ((y_min, y_max), (x_min, x_max))]
        rows, columns = (SIDE * math.ceil(each / SIDE) for each in sides)
        return cls(x_min - cell_m, y_min - cell_m, cell_m, rows, columns)

    @property
    def tiles_across(self) -> int:
        """Tiles side by side in a row."""
        return self.columns // SIDE

    @property
    def tiles(self) -> int:
        """How many tiles there are."""
        return self.tiles_across * (self.rows // SIDE)

    def cells(self, points: Array) -> Index:
        """Return the cell in which each point (k, 2) lies, numbered row by row, (k,); -1 outside."""
        column = np.floor((points[:, 0] - self.x_min) / self.cell_m)
        row = np.floor((points[:, 1] - self.y_min) / self.cell_m)
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        found: Index = np.where(inside, row * self.columns + column, -1.0).astype(np.int64)
        return found

    def tile(self, states: States, number: int) -> States:
        """Return a view of one tile of the grid's states."""
        row, column = divmod(number, self.tiles_across)
        return states[row * SIDE : (row + 1) * SIDE, column * SIDE : (column + 1) * SIDE]


def pack(place: GridPlace, states: States, tiles: Sequence[int], host: str, stamp_s: float) -> GridTiles:
    """Return the message with these tiles, `MOST_TILES` at most."""
    packed = bytearray()
    for number in tiles:
        four = place.tile(states, number).reshape(-1, 4)
        packed += (four[:, 0] | four[:, 1] << 2 | four[:, 2] << 4 | four[:, 3] << 6).astype(np.uint8).tobytes()
    return GridTiles(
        host=host, x_min_m=place.x_min, y_min_m=place.y_min, cell_m=place.cell_m, rows=place.rows,
        columns=place.columns, tiles=tuple(tiles), cells=zlib.compress(bytes(packed), 6), stamp_s=stamp_s,
    )  # fmt: skip


def place_of(message: GridTiles) -> GridPlace:
    """Return the grid that a message names.

    Raises
    ------
    MessageError
        No positive cell size, too many cells, or no whole tiles.
    """
    rows, columns = message.rows, message.columns
    if not message.cell_m > 0.0 or rows % SIDE or columns % SIDE or not 0 < rows * columns <= 4 * MOST_CELLS:
        raise MessageError(
            f"a grid of {rows} x {columns} cells of {message.cell_m} m is none of whole tiles",
            where=f"grid of {message.host}",
        )
    return GridPlace(message.x_min_m, message.y_min_m, message.cell_m, rows, columns)


def unpack(message: GridTiles) -> list[tuple[int, States]]:
    """Return the number and the states (SIDE, SIDE) of each tile of a message.

    Raises
    ------
    MessageError
        The bytes are not those of its tiles, or a tile is none of the grid.
    """
    where, place = f"grid of {message.host}", place_of(message)
    length = PACKED * len(message.tiles)
    try:
        inflater = zlib.decompressobj()
        data = inflater.decompress(message.cells, length + 1)
    except zlib.error as error:
        raise MessageError(f"its cells cannot be inflated: {error}", where=where) from error
    if len(data) != length:
        raise MessageError(f"its cells are not those of {len(message.tiles)} tiles", where=where)
    if any(number >= place.tiles for number in message.tiles):
        raise MessageError("it names a tile outside the grid", where=where)
    packed = np.frombuffer(data, np.uint8).reshape(-1, PACKED, 1)
    states = (packed >> np.array([0, 2, 4, 6], np.uint8)) & 3
    if (states > OCCUPIED).any():
        raise MessageError("a cell has no valid state", where=where)
    return list(zip(message.tiles, states.reshape(-1, SIDE, SIDE), strict=True))
