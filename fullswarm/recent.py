"""A dict that keeps its newest entries: what other processes can fill must be bounded."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, TypeVar

K = TypeVar("K")
V = TypeVar("V")


_write: Any = OrderedDict.__setitem__  # `super()` would take half the time of a write


class Recent(OrderedDict[K, V]):
    """The newest `most` entries; writing a key makes it the newest one and drops the oldest one beyond `most`."""

    def __init__(self, most: int) -> None:
        super().__init__()
        self._most = most

    def __setitem__(self, key: K, value: V) -> None:
        """Write one entry."""
        if key in self:
            self.move_to_end(key)
        _write(self, key, value)
        if len(self) > self._most:
            self.popitem(last=False)
