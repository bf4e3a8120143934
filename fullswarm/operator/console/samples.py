"""Keeps the numbers of all robots and the swarm's metrics over time, for charts of now and of the past.

They are sampled at `SAMPLE_HZ` into blocks of arrays, one a minute. A block has the robots that were there in
its minute, so a robot that is gone leaves with the blocks that had it. The oldest blocks go when
they are too old, or all take too much.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fullswarm.messages import Summary
from fullswarm.operator.console import fields
from fullswarm.operator.console.fields import NAMES
from fullswarm.operator.view import RobotRow

SAMPLE_HZ = 2.0
CHART_S = 600.0
"""The length of a chart."""
KEPT_S, KEPT_BYTES = 1800.0 + CHART_S, 80_000_000
"""As long as pages can look back, with the chart that ends then. 100 robots need 31 MB; 1,000 have 10 minutes."""
DEFAULT = ("work.total_m", "coverage.fraction", "collisions.events")
"""What a page shows that has chosen nothing; a study offers nothing else."""
BLOCK_ROWS = 120
MOST_ROBOTS, MOST_METRICS = 1024, 256
"""Robots of a block, and quantities, that are kept at most; of more, those that were there first."""
_PER_BLOCK, _PER_ROBOT = 2000, 100
"""Bytes of a block beside its arrays."""
_FEW = 8
"""Robots that a block makes room for at a time."""

Times = NDArray[np.float64]
Values = NDArray[np.float64]


class Block:
    """A minute of samples.

    Attributes
    ----------
    times : (rows,) s
    values : (fields, robots, rows); NaN: unknown
    places : robot → its place in `values`
    metrics : quantity → (rows,); NaN: not reported
    count : rows that are filled
    """

    def __init__(self, robots: int) -> None:
        self.times = np.empty(BLOCK_ROWS)
        self.values = np.full((len(NAMES), robots, BLOCK_ROWS), math.nan, np.float32)
        self.places: dict[str, int] = {}
        self.metrics: dict[str, Values] = {}
        self.count = 0
        self._robots: tuple[str, ...] = ()  # of the newest row, and which of them are kept where
        self._chosen: tuple[list[int], list[int]] = [], []

    @property
    def size(self) -> int:
        """Bytes, about."""
        rows = self.times.nbytes * (1 + len(self.metrics))
        return rows + self.values.nbytes + _PER_BLOCK + _PER_ROBOT * (len(self.places) + len(self.metrics))

    def add(self, rows: Sequence[RobotRow], reported: dict[str, float], now_s: float) -> None:
        """Fill the next row."""
        robots = tuple([row.robot for row in rows])
        if robots != self._robots:
            self._make_room(robots)
        ours, theirs = self._chosen
        table = fields.read(rows)
        with np.errstate(over="ignore"):  # what is beyond a float32 becomes infinite, which is sent as unknown
            self.values[:, theirs, self.count] = table[ours].T
        for name, value in reported.items():
            if name not in self.metrics:
                self.metrics[name] = np.full(BLOCK_ROWS, math.nan)
            self.metrics[name][self.count] = value
        self.times[self.count] = now_s
        self.count += 1

    def _make_room(self, robots: tuple[str, ...]) -> None:
        for robot in robots:
            if robot not in self.places and len(self.places) < MOST_ROBOTS:
                self.places[robot] = len(self.places)
        missing = len(self.places) - self.values.shape[1]
        if missing > 0:
            shape = (len(NAMES), max(missing, _FEW, self.values.shape[1] // 4), BLOCK_ROWS)
            self.values = np.concatenate([self.values, np.full(shape, math.nan, np.float32)], axis=1)
        ours = [number for number, robot in enumerate(robots) if robot in self.places]
        self._robots, self._chosen = robots, (ours, [self.places[robots[number]] for number in ours])


@dataclass(slots=True)
class Samples:
    """All samples of a swarm.

    Parameters
    ----------
    seconds, most_bytes : bounds; the newest block is kept whatever it takes
    """

    seconds: float = KEPT_S
    most_bytes: int = KEPT_BYTES
    _closed: deque[Block] = field(default_factory=deque)
    _closed_bytes: int = 0
    _open: Block | None = None
    _names: dict[str, None] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Bytes of all blocks, about."""
        return self._closed_bytes + (0 if self._open is None else self._open.size)

    @property
    def names(self) -> tuple[str, ...]:
        """The quantities that were reported so far, as ``work.total_m``."""
        return tuple(self._names)

    @property
    def to_s(self) -> float:
        """Time of the newest sample, s; -inf without one."""
        return -math.inf if self._open is None else float(self._open.times[self._open.count - 1])

    def add(self, rows: Sequence[RobotRow], summaries: Iterable[Summary], now_s: float) -> None:
        """Sample robots and summaries; a time that is not after the last one is left out."""
        if now_s <= self.to_s:
            return
        self._block(len(rows)).add(rows, self._reported(summaries), now_s)
        while self._closed and (self.size > self.most_bytes or now_s - float(self._closed[0].times[-1]) > self.seconds):
            self._closed_bytes -= self._closed.popleft().size

    def _reported(self, summaries: Iterable[Summary]) -> dict[str, float]:
        found: dict[str, float] = {}
        for summary in summaries:
            for quantity, value in summary.values.items():
                name = f"{summary.metric}.{quantity}"
                if name not in self._names:
                    if len(self._names) >= MOST_METRICS:
                        continue
                    self._names[name] = None
                found[name] = value
        return found

    def _block(self, robots: int) -> Block:
        """Return the block to write into; a new one has room for so many robots."""
        block = self._open
        if block is None or block.count == BLOCK_ROWS:
            if block is not None:
                self._closed.append(block)
                self._closed_bytes += block.size
            self._open = block = Block(min(robots, MOST_ROBOTS))
        return block

    # ---------------------------------------------------------------- reading
    def robots(self, from_s: float, to_s: float) -> tuple[str, ...]:
        """Return the robots that were sampled in a time, in no order."""
        return tuple({robot: None for block, _ in self._within(from_s, to_s) for robot in block.places})

    def times(self, from_s: float, to_s: float) -> Times:
        """Return the times of the samples after `from_s` and up to `to_s`, (m,) s."""
        return np.concatenate([np.empty(0), *(block.times[rows] for block, rows in self._within(from_s, to_s))])

    def of_robots(self, name: str, robots: Sequence[str], from_s: float, to_s: float) -> Values:
        """Return a field of robots at `times`, (robots, m); NaN where it is unknown.

        Raises
        ------
        KeyError
            There is no such field.
        """
        place = _PLACES[name]
        parts = [np.empty((len(robots), 0))]
        for block, rows in self._within(from_s, to_s):
            part = np.full((len(robots), rows.stop - rows.start), math.nan)
            ours = [number for number, robot in enumerate(robots) if robot in block.places]
            part[ours] = block.values[place, [block.places[robots[number]] for number in ours], rows]
            parts.append(part)
        return np.concatenate(parts, axis=1)

    def of_swarm(self, name: str, from_s: float, to_s: float) -> Values:
        """Return a quantity at `times`, (1, m); NaN where it was not reported."""
        parts = [np.empty(0)]
        for block, rows in self._within(from_s, to_s):
            known = block.metrics.get(name)
            parts.append(np.full(rows.stop - rows.start, math.nan) if known is None else known[rows])
        return np.concatenate(parts)[None, :]

    def _within(self, from_s: float, to_s: float) -> Iterator[tuple[Block, slice]]:
        """Yield the blocks with samples after `from_s` and up to `to_s`, and which of their rows these are."""
        blocks = [] if self._open is None else [self._open]
        for block in reversed(self._closed):
            if block.times[block.count - 1] <= from_s:
                break
            blocks.append(block)
        for block in reversed(blocks):
            first, end = np.searchsorted(block.times[: block.count], (from_s, to_s), side="right")
            if first < end:
                yield block, slice(int(first), int(end))


_PLACES = {name: place for place, name in enumerate(NAMES)}
