"""Which of an operator's requests is the newest for each robot: an older one that comes later must not win, ever.

Stamps of one clock compare, however long ago they were made: a clock that was started anew has another name. Stamps
of two clocks do not compare, those of two operators say nothing: they count in the order of their arrival.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

REMEMBERED = 64
"""Of each robot: operators and clocks. Whoever makes names up must not fill the memory."""

Line = tuple[str, str]
"""Operator and clock: requests of one line are ordered by their stamps."""


class _Asked(NamedTuple):
    request_id: str
    stamp_s: float


class Newest:
    """The newest request of each operator for each robot."""

    def __init__(self) -> None:
        self._of: dict[str, OrderedDict[Line, _Asked]] = {}

    def note(self, robot: str, request_id: str, line: Line, stamp_s: float) -> str:
        """Take note of a request; return the id of a newer one of the same line, or an empty word: it counts."""
        if not line[1]:
            return ""
        lines = self._of.setdefault(robot, OrderedDict())
        newest = lines.get(line)
        if newest is not None and stamp_s < newest.stamp_s:
            return newest.request_id
        lines[line] = _Asked(request_id, stamp_s)
        lines.move_to_end(line)
        while len(lines) > REMEMBERED:
            lines.popitem(last=False)
        return ""
