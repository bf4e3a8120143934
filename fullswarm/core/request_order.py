"""Orders requests by age: an older request that arrives later must not supersede a newer one or a stop.

Stamps of one clock are comparable, however long ago they were made: a clock that was restarted has another name.
Requests of two clocks, and those of two operators, count in the order of their arrival. A stop also supersedes
earlier requests of other operators on its clock: a delayed one would start robots again.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

from fullswarm.recent import Recent

REMEMBERED = 64
"""Entries per robot: invented names must not fill the memory."""

Line = tuple[str, str]
"""Operator and clock: requests of one line are ordered by their stamps."""


Key = TypeVar("Key")


class _Entry(NamedTuple):
    request_id: str
    stamp_s: float


class RequestOrder:
    """The newest request of each operator, and the newest stop on each clock, for each robot."""

    def __init__(self) -> None:
        self._requests: dict[str, Recent[Line, _Entry]] = {}
        self._stops: dict[str, Recent[str, _Entry]] = {}

    def note(self, robot: str, request_id: str, line: Line, stamp_s: float) -> str:
        """Record a request; return the id of the newer request or stop that supersedes it, or "" if there is none."""
        clock = line[1]
        if not clock:
            return ""
        stops = self._stops.get(robot)
        stop = None if stops is None else stops.get(clock)
        if stop is not None and stamp_s < stop.stamp_s:
            return stop.request_id
        return _record(self._requests.setdefault(robot, Recent(REMEMBERED)), line, _Entry(request_id, stamp_s))

    def forget(self, robot: str) -> None:
        """Drop what is recorded of a robot."""
        self._requests.pop(robot, None)
        self._stops.pop(robot, None)

    def stop(self, robot: str, request_id: str, clock: str, stamp_s: float) -> None:
        """Record a stop; with an empty `clock` its time cannot be compared."""
        if clock:
            _record(self._stops.setdefault(robot, Recent(REMEMBERED)), clock, _Entry(request_id, stamp_s))


def _record(entries: Recent[Key, _Entry], key: Key, entry: _Entry) -> str:
    """Keep the newest entry under `key`; return the id of the one that is newer than `entry`."""
    newest = entries.get(key)
    if newest is not None and entry.stamp_s < newest.stamp_s:
        return newest.request_id
    entries[key] = entry
    return ""
