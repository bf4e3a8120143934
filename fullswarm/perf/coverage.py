"""The coverage grid: where its cells lie, and how it is packed for the bus.

A cell is covered once its centre was inside a robot's disc (paper III, *coverage*). Row 0 lies at `origin_y_m`.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import ConfigError, MessageError
from fullswarm.messages import CoverageMeasurement

Bounds = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max in metres."""

MAX_CELLS = 4_000_000
"""A larger grid would cost every message half a megabyte: it is a slip of the cell size."""


@dataclass(frozen=True, slots=True)
class GridFrame:
    """Place and shape of a grid; two hosts' grids can be joined only when these agree."""

    origin_x_m: float
    origin_y_m: float
    cell_m: float
    rows: int
    columns: int

    @classmethod
    def over(cls, bounds_m: Bounds, cell_m: float) -> GridFrame:
        """Return the smallest grid of square cells that holds `bounds_m`.

        Raises
        ------
        ConfigError
            The arena is empty, or it would need more than `MAX_CELLS` cells.
        """
        x_min, y_min, x_max, y_max = bounds_m
        if not (x_max > x_min and y_max > y_min and cell_m > 0.0):
            raise ConfigError(
                f"no coverage grid over bounds {bounds_m} m with cells of {cell_m} m",
                hint="bounds are x_min, y_min, x_max, y_max",
            )
        # 20 m / 0.1 m must give 200 cells although 0.1 is no binary fraction.
        columns = max(1, math.ceil((x_max - x_min) / cell_m - 1e-6))
        rows = max(1, math.ceil((y_max - y_min) / cell_m - 1e-6))
        if rows * columns > MAX_CELLS:
            raise ConfigError(
                f"a coverage grid of {rows} x {columns} cells is too large",
                where="performance.coverage_cell_m",
                hint=f"use cells larger than {cell_m} m; {MAX_CELLS} cells at most",
            )
        return cls(x_min, y_min, cell_m, rows, columns)

    @classmethod
    def of(cls, message: CoverageMeasurement) -> GridFrame:
        """Return the frame that a measurement names, after checking that it is sane.

        Raises
        ------
        MessageError
            No positive cell size, no cells, or too many of them.
        """
        rows, columns, cell_m = message.rows, message.columns, message.cell_m
        sizes_fit = rows > 0 and columns > 0 and rows * columns <= MAX_CELLS
        if not (sizes_fit and 0.0 < cell_m < math.inf):
            raise MessageError(f"a grid of {rows} x {columns} cells of {cell_m} m", where=message.host)
        return cls(message.origin_x_m, message.origin_y_m, cell_m, rows, columns)

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.rows * self.columns

    @property
    def cell_area_m2(self) -> float:
        """Area of one cell."""
        return self.cell_m * self.cell_m


def pack(grid: NDArray[np.uint8]) -> bytes:
    """Return a (rows, columns) grid of 0 and 1 as compressed bits."""
    # A small window: that of zlib.compress takes longer to get from the system than the grid to pack.
    stream = zlib.compressobj(1, zlib.DEFLATED, 12, 4, zlib.Z_RLE)
    return stream.compress(np.packbits(grid).tobytes()) + stream.flush()


def unpack_bits(data: bytes, frame: GridFrame) -> NDArray[np.uint8]:
    """Undo the compression of :func:`pack`, but leave eight cells to a byte.

    Returns
    -------
    NDArray
        Shape (ceil(rows * columns / 8),); unused bits of the last byte are zero.

    Raises
    ------
    MessageError
        Broken, or not as many bits as `frame` has cells.
    """
    size = (frame.cells + 7) // 8
    stream = zlib.decompressobj()
    try:
        raw = stream.decompress(data, size + 1)
    except zlib.error as error:
        raise MessageError(f"a coverage grid that does not unpack: {error}") from error
    if len(raw) != size:
        raise MessageError(f"a coverage grid whose bits do not fit {frame.rows} x {frame.columns} cells")
    bits = np.frombuffer(raw, np.uint8).copy()
    bits[-1] &= (0xFF << (size * 8 - frame.cells)) & 0xFF
    return bits


def count_bits(bits: NDArray[np.uint8]) -> int:
    """Return how many cells of a packed grid are covered."""
    return int(np.bitwise_count(bits).sum())
