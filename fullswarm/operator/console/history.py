"""Keeps what pages were shown, so that they can look back: frames in compressed segments, log lines.

The history is bounded in time and in bytes. With 32 robots it takes about 10 kB a second: see decision 81.
"""

from __future__ import annotations

import zlib
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Protocol

from fullswarm.operator.console import frames
from fullswarm.operator.console.log import LOG_LENGTH, Entry

PERIODS_S = {
    "state": 0.1, "fleet": 0.5, "world": 0.0, "goals": 0.0, "filter": 0.0, "obstacles": 0.0, "coverage": 0.0,
    "leases": 0.0, "missions": 0.0,
}  # fmt: skip
"""The kinds of frames that are kept, and how often at most: a page interpolates between states."""
SLACK_S = 0.02
"""A frame that comes a little early still counts as due: its timer has a grid of its own."""
SEGMENT_S, SEGMENT_BYTES = 10.0, 2_000_000
"""A segment ends after this time, or when its text has this length."""
FRAME_BYTES = 1_000_000
"""A longer frame is left out: a thousand robots' worth."""
KEPT_S, KEPT_BYTES = 1800.0, 64_000_000
MOST_ENTRIES = 5_000
TRAIL_STEP_S = 1.0
"""Between the points of a trail at the beginning of a segment."""


class Shelf(Protocol):
    """Where closed segments are."""

    def put(self, data: bytes) -> int:
        """Keep a segment; return its number."""
        ...

    def get(self, number: int) -> bytes:
        """Return a segment."""
        ...

    def drop(self, number: int) -> None:
        """Forget a segment."""
        ...


class MemoryShelf:
    """Keeps segments in memory."""

    def __init__(self) -> None:
        self._kept: dict[int, bytes] = {}
        self._next = 0

    def put(self, data: bytes) -> int:
        """Keep a segment; return its number."""
        self._next += 1
        self._kept[self._next] = data
        return self._next

    def get(self, number: int) -> bytes:
        """Return a segment."""
        return self._kept[number]

    def drop(self, number: int) -> None:
        """Forget a segment."""
        del self._kept[number]


@dataclass(frozen=True, slots=True)
class Segment:
    """A closed segment: its first and last moment, its number on the shelf, its compressed size."""

    from_s: float
    to_s: float
    number: int
    size: int


class _Open:
    """The segment that is being written."""

    def __init__(self, from_s: float) -> None:
        self.from_s, self.length = from_s, 0
        self._packer = zlib.compressobj(1)
        self._packed = bytearray()

    def add(self, at_s: float, text: str) -> None:
        line = f"{',' if self.length else ''}[{at_s:.3f},{text}]".encode()
        self.length += len(line)
        self._packed += self._packer.compress(line)

    def packed(self) -> bytes:
        """Return what it holds so far; it stays open."""
        return bytes(self._packed) + self._packer.copy().flush()


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds of a history: seconds and compressed bytes of its segments, log lines."""

    seconds: float = KEPT_S
    bytes: int = KEPT_BYTES
    entries: int = MOST_ENTRIES


@dataclass(slots=True)
class History:
    """What pages were shown.

    Parameters
    ----------
    trails : returns the present trails, robot → ``[at_s, x_m, y_m]``, for the beginning of a segment

    Attributes
    ----------
    left_out : frames that were too long
    """

    trails: Callable[[], dict[str, list[list[float]]]]
    limits: Limits = field(default_factory=Limits)
    shelf: Shelf = field(default_factory=MemoryShelf)
    left_out: int = 0
    to_s: float = 0.0
    entries: deque[Entry] = field(init=False)
    _segments: deque[Segment] = field(default_factory=deque)
    _open: _Open | None = None
    _size: int = 0
    _newest: dict[str, str] = field(default_factory=dict)
    _kept_s: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.entries = deque(maxlen=self.limits.entries)

    @property
    def from_s(self) -> float:
        """The first moment that can be looked at."""
        return self._segments[0].from_s if self._segments else self._open.from_s if self._open else self.to_s

    @property
    def size(self) -> int:
        """Compressed bytes of all closed segments."""
        return self._size

    def wants(self, kind: str, now_s: float) -> bool:
        """Return whether a frame of this kind would be kept now."""
        period_s = PERIODS_S.get(kind)
        last_s = self._kept_s.get(kind)
        return period_s is not None and (last_s is None or now_s - last_s >= period_s - SLACK_S)

    def add(self, kind: str, text: str, now_s: float) -> None:
        """Keep an encoded frame, if its kind is kept and due."""
        if not self.wants(kind, now_s):
            return
        if len(text) > FRAME_BYTES:
            self.left_out += 1
            return
        self._kept_s[kind] = now_s
        segment = self._segment(now_s)
        segment.add(now_s, text)
        self._newest[kind] = text
        self.to_s = now_s

    def add_entry(self, entry: Entry) -> None:
        """Keep a line of the log."""
        self.entries.append(entry)

    def events(self, most: int) -> list[dict[str, Any]]:
        """Return the newest lines of the log that can still be looked at, the oldest first."""
        lines = islice(self.entries, max(0, len(self.entries) - most), None)
        return [event(each) for each in lines if each.at_s >= self.from_s and each.count == 1]

    def segment(self, at_s: float, reader: str = "") -> str:
        """Return the frame ``history`` with all of the segment that holds a moment, or of the nearest one.

        Parameters
        ----------
        reader : operator whose own lines of the log are marked
        """
        found = self._find(at_s)
        if found is None:
            return '{"t":"history","from":0,"to":0,"open":true,"log":[],"frames":[]}'
        from_s, to_s, packed, is_open = found
        head = frames.encode(
            {
                "t": "history",
                "from": round(from_s, 3),
                "to": round(to_s, 3),
                "open": is_open,
                "log": [entry.shown(reader) for entry in self._lines(to_s)],
            }
        )
        return f'{head[:-1]},"frames":[{zlib.decompress(packed).decode()}]}}'

    def close(self) -> None:
        """End the open segment: nothing more comes."""
        if self._open is not None:
            self._shelve(self._open, self.to_s)
            self._open = None

    # ---------------------------------------------------------------- segments
    def _find(self, at_s: float) -> tuple[float, float, bytes, bool] | None:
        if self._open is not None and (at_s >= self._open.from_s or not self._segments):
            return self._open.from_s, self.to_s, self._open.packed(), True
        if not self._segments:
            return None
        place = bisect_right(self._segments, at_s, key=lambda each: each.from_s) - 1
        found = self._segments[max(0, place)]
        return found.from_s, found.to_s, self.shelf.get(found.number), False

    def _segment(self, now_s: float) -> _Open:
        """Return the segment to write into; a new one begins with the newest of each kind."""
        if self._open is not None:
            if now_s - self._open.from_s < SEGMENT_S and self._open.length < SEGMENT_BYTES:
                return self._open
            self._shelve(self._open, now_s)
        self._open = segment = _Open(now_s)
        segment.add(now_s, frames.encode({"t": "trails", "robots": self._thinned()}))
        for text in self._newest.values():
            segment.add(now_s, text)
        return segment

    def _shelve(self, segment: _Open, to_s: float) -> None:
        packed = segment.packed()
        self._segments.append(Segment(segment.from_s, to_s, self.shelf.put(packed), len(packed)))
        self._size += len(packed)
        while len(self._segments) > 1 and (
            self._size > self.limits.bytes or to_s - self._segments[0].to_s > self.limits.seconds
        ):
            oldest = self._segments.popleft()
            self._size -= oldest.size
            self.shelf.drop(oldest.number)

    def _thinned(self) -> dict[str, list[list[float]]]:
        found = {}
        for robot, points in self.trails().items():
            kept: list[list[float]] = []
            for point in points:
                if not kept or point[0] - kept[-1][0] >= TRAIL_STEP_S:
                    kept.append(point)
            found[robot] = kept
        return found

    def _lines(self, to_s: float) -> Iterable[Entry]:
        """Return the last lines of the log up to a moment."""
        last: deque[Entry] = deque(maxlen=LOG_LENGTH)
        for entry in self.entries:
            if entry.at_s > to_s:
                break
            last.append(entry)
        return last


def event(entry: Entry) -> dict[str, Any]:
    """Return a line of the log as a mark on the timeline."""
    return {"at": round(entry.at_s, 2), "kind": entry.kind, "text": entry.text}
