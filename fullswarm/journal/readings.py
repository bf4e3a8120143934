"""What drivers read, as items of a journal and back: arrays of fixed shape as one block of bytes, others when new."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.drivers.base import NO_OBSTACLES, FleetReading, Pose, RangeScan
from fullswarm.journal.journal import Kind

SAME = 0
"""In the place of obstacles, bodies or ranges: the same object as in the reading before."""
FIXED = tuple(each.name for each in fields(FleetReading) if each.name not in ("obstacles", "bodies", "ranges"))
"""Arrays with a row per robot; some may be None for good."""

Layout = list[tuple[str, str, list[int]]]


class ReadingCopy:
    """A reading that changes only when the next one is taken: the drivers' own arrays may change in between."""

    def __init__(self, first: FleetReading) -> None:
        parts = {name: getattr(first, name) for name in FIXED}
        copies: dict[str, Any] = {name: None if part is None else part.copy() for name, part in parts.items()}
        self.reading = FleetReading(**copies, obstacles=first.obstacles, bodies=first.bodies, ranges=first.ranges)
        self._arrays = [(copy, name) for name, copy in copies.items() if copy is not None]
        self.layout: Layout = [(name, copy.dtype.str, list(copy.shape)) for copy, name in self._arrays]
        self._new = True

    def take(self, found: FleetReading) -> tuple[object, ...]:
        """Copy a reading; return its item."""
        own, blob = self.reading, []
        for copy, name in self._arrays:
            np.copyto(copy, getattr(found, name))
            blob.append(copy.tobytes())
        new, self._new = self._new, False
        obstacles = found.obstacles if new or found.obstacles is not own.obstacles else SAME
        bodies = found.bodies if new or found.bodies is not own.bodies else SAME
        ranges = _packed(found.ranges) if new or found.ranges is not own.ranges else SAME
        own.obstacles, own.bodies, own.ranges = found.obstacles, found.bodies, found.ranges
        return Kind.READING, b"".join(blob), obstacles, bodies, ranges


class ReadingFeed:
    """The same readings again, in arrays that stay the same objects."""

    def __init__(self, layout: Sequence[Any]) -> None:
        arrays: dict[str, NDArray[Any]] = {}
        self._places: list[tuple[NDArray[Any], int, int]] = []
        end = 0
        for name, dtype, shape in layout:
            array = arrays[name] = np.zeros(tuple(shape), np.dtype(dtype))
            self._places.append((array, end, end + array.nbytes))
            end += array.nbytes
        self._bytes = end
        fixed: dict[str, Any] = {name: arrays.get(name) for name in FIXED}  # None: one that may be missing
        self.reading = FleetReading(**fixed, obstacles=NO_OBSTACLES)

    def give(self, item: Sequence[Any]) -> FleetReading:
        """Return the reading of an item. Raises `ValueError` where that does not fit the layout."""
        _, blob, obstacles, bodies, ranges = item
        if len(blob) != self._bytes:
            raise ValueError("a reading does not fit its layout")
        own = self.reading
        for array, begin, end in self._places:
            array[...] = np.frombuffer(blob[begin:end], array.dtype).reshape(array.shape)
        if not _is_same(obstacles):
            own.obstacles = obstacles
        if not _is_same(bodies):
            own.bodies = bodies
        if not _is_same(ranges):
            own.ranges = tuple((row, _scan(scan)) for row, scan in ranges)
        return own


def _is_same(part: object) -> bool:
    return isinstance(part, int)


def _packed(ranges: tuple[tuple[int, RangeScan], ...]) -> list[tuple[int, dict[str, Any]]]:
    return [(row, asdict(scan)) for row, scan in ranges]


def _scan(found: dict[str, Any]) -> RangeScan:
    return RangeScan(**{**found, "mount": Pose(**found["mount"])})
