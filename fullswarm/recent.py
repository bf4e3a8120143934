"""Collections that stay small: what other processes can fill must be bounded."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

K = TypeVar("K")
V = TypeVar("V")


_write: Any = OrderedDict.__setitem__  # `super()` would take half the time of a write

FORGET_S = 4.0
LINGER = 10.0
"""A name is forgotten when it has been silent for so many times the time in which it was received, and `FORGET_S` at
least: an invented one soon, a robot that had been there for an hour hardly ever."""
LONGEST_S = 86_400.0
FRESH_S = 1.0
"""A name that was received this recently does not make room for a new one."""


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

    def update_in_place(self, key: K, value: V) -> None:
        """Replace the value of a key that is there, which stays as old as it is."""
        if key not in self:
            raise KeyError(key)
        _write(self, key, value)


class Names:
    """The names that other processes use for themselves: which count, and when each is forgotten.

    Names of the fleet file always count and are never forgotten. Of others at most `most` count: while there is no
    room, the one that has been silent for longest makes way for a new one.

    Parameters
    ----------
    forget
        Called with each name that is forgotten: the owner drops what it keeps under that name.
    listed
        Names of the fleet file.
    least_s
        No name is forgotten sooner after its last message.

    Attributes
    ----------
    refused : int
        Messages under names for which there was no room.
    """

    def __init__(
        self, most: int, forget: Callable[[str], object], listed: Iterable[str] = (), least_s: float = FORGET_S
    ) -> None:
        self._most, self._forget, self._least_s, self.listed = most, forget, least_s, frozenset(listed)
        self._seen: OrderedDict[str, tuple[float, float]] = OrderedDict()  # first and last arrival, the oldest first
        self.refused = 0

    def __len__(self) -> int:
        """Return how many names count beside the listed ones."""
        return len(self._seen)

    def admit(self, name: str, now_s: float) -> bool:
        """Note a message under `name`; False: there is no room for it, ignore the message."""
        if name in self.listed:
            return True
        seen = self._seen.get(name)
        if seen is None:
            if len(self._seen) >= self._most and not self._make_room(now_s):
                self.refused += 1
                return False
            self._seen[name] = now_s, now_s
            return True
        self._seen[name] = seen[0], now_s
        self._seen.move_to_end(name)
        return True

    def sweep(self, now_s: float) -> None:
        """Forget the names that have been silent for too long; to be called now and then."""
        over = []
        for name, (first_s, last_s) in self._seen.items():
            if now_s - last_s <= self._least_s:
                break  # all that follow are newer
            if now_s - last_s > min(LINGER * (last_s - first_s), LONGEST_S):
                over.append(name)
        for name in over:
            self._drop(name)

    def _make_room(self, now_s: float) -> bool:
        name, (_, last_s) = next(iter(self._seen.items()))
        if now_s - last_s < FRESH_S:
            return False
        self._drop(name)
        return True

    def _drop(self, name: str) -> None:
        del self._seen[name]
        self._forget(name)
