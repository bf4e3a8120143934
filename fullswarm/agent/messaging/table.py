"""A shared key-value table: one replica per robot, which converges whatever is lost on the way.

Each entry carries a Lamport stamp and the robot that wrote it. Of two entries of a key the newer one stays, or what a
merge that the control law declares makes of both. A robot broadcasts what is new to it, and a digest of all it has; a
robot whose digest differs sends what may be missing there.

C. Pinciroli, A. Lee-Brown, G. Beltrame: A tuple space for data sharing in robot swarms, BICT 2015 (virtual stigmergy
of the language Buzz); the order of entries is a join-semilattice as in M. Shapiro et al., Conflict-free replicated data
types, SSS 2011.
"""

from __future__ import annotations

import hashlib
import math
from bisect import insort
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import msgspec

from fullswarm.errors import ConfigError
from fullswarm.messages import LARGEST_STAMP, MOST_NUMBERS, TABLE_BUCKETS, TableEntry

Shared = float | str | tuple[float, ...]
"""A value of a table: a number, a text, or numbers."""
Merge = Callable[[Any, Any], Any]

MOST_KEYS = 64
"""Of one table. If more come together, the first ones in alphabetical order stay, on all robots the same."""
ENTRY_BYTES = 200
"""Of one entry, and of all entries in one message: with the digest it stays below 256 bytes."""


class ReplicatedTable:
    """One robot's replica of the table of a request.

    Parameters
    ----------
    writer : the robot's id
    merges : a function of two values per key, or per part of a key before its first "/". The order of its arguments
        and repetitions must not matter: ``min``, ``max``

    Attributes
    ----------
    failure : why a merge could not be carried out; empty: it never failed
    evicted : entries that were dropped because there were more than `MOST_KEYS` keys
    """

    def __init__(self, writer: str, merges: Mapping[str, Merge] | None = None) -> None:
        self._writer, self._merges = writer, merges or {}
        self._entries: dict[str, TableEntry] = {}
        self._keys: list[str] = []  # sorted
        self._hashes: dict[str, int] = {}
        self._digest = [0] * TABLE_BUCKETS
        self._unsent: dict[str, None] = {}  # in order of the changes
        self._clock = 0
        self.failure, self.evicted = "", 0

    def __len__(self) -> int:
        """Return the number of keys."""
        return len(self._entries)

    def get(self, key: str, default: Shared | None = None) -> Shared | None:
        """Return the value of `key` as far as this robot knows, `default` if it knows none."""
        entry = self._entries.get(key)
        return default if entry is None else entry.value

    def items(self) -> list[tuple[str, Shared]]:
        """Return all keys, sorted, with their values."""
        return [(key, self._entries[key].value) for key in self._keys]

    def writer_of(self, key: str) -> str:
        """Return the robot that wrote the newest value of `key`, empty if there is none."""
        entry = self._entries.get(key)
        return "" if entry is None else entry.writer

    def put(self, key: str, value: float | str | Sequence[float]) -> None:
        """Write a value: it replaces an older one, or is merged with it if the law declares that.

        Raises
        ------
        ConfigError
            The key or the value is too large or no number, or the table is full.
        """
        stamp = min(self._clock + 1, LARGEST_STAMP)
        entry = TableEntry(key, _shared(key, value), stamp, self._writer)
        if not key or _size(entry) > ENTRY_BYTES:
            raise ConfigError(
                f"the table cannot hold '{key[:40]}': key and value have {_size(entry)} bytes", where="view.table.put",
                hint=f"{ENTRY_BYTES} at most, and a key that is not empty",
            )  # fmt: skip
        known = self._entries.get(key)
        if known is None:
            if len(self._entries) >= MOST_KEYS:
                raise ConfigError(f"the table is full: it has {MOST_KEYS} keys", where="view.table.put",
                                  hint="write to keys that are there")  # fmt: skip
            self._store(entry)
            return
        merge = self._merge_of(key)
        if merge is not None:
            merged = _shared(key, merge(known.value, entry.value))
            if merged == known.value:
                return
            entry = TableEntry(key, merged, stamp, self._writer)
        if merge is not None or entry.value != known.value:
            self._store(entry)

    def receive(self, entries: Iterable[TableEntry]) -> None:
        """Take in entries of another robot."""
        for entry in entries:
            entry = TableEntry(entry.key, _without_sign(entry.value), entry.stamp, entry.writer)
            if _size(entry) > ENTRY_BYTES:
                continue
            known = self._entries.get(entry.key)
            joined = entry if known is None else self._join(known, entry)
            if joined != known:
                self._store(joined)
                while len(self._entries) > MOST_KEYS:
                    self._evict()
            if joined != entry:  # its sender does not have it
                self._unsent.setdefault(entry.key)

    @property
    def digest(self) -> tuple[int, ...]:
        """Return a number per bucket of keys; the same on two robots with the same entries."""
        return tuple(self._digest)

    def compare(self, digest: Sequence[int]) -> None:
        """Mark what has to be sent to a robot with that `digest`."""
        differing = {bucket for bucket, ours in enumerate(self._digest) if digest[bucket] != ours}
        if differing:
            for key in self._keys:
                if _bucket(key) in differing:
                    self._unsent.setdefault(key)

    @property
    def unsent(self) -> bool:
        """Tell whether there is something to send."""
        return bool(self._unsent)

    def take(self) -> tuple[TableEntry, ...]:
        """Return the entries of the next message, those that have waited longest, and count them as sent."""
        found: list[TableEntry] = []
        left = ENTRY_BYTES
        for key in self._unsent:
            left -= _size(self._entries[key])
            if left < 0:
                break
            found.append(self._entries[key])
        for entry in found:
            del self._unsent[entry.key]
        return tuple(found)

    def _join(self, one: TableEntry, other: TableEntry) -> TableEntry:
        """Return the least upper bound of two entries of one key: the same in whatever order entries arrive."""
        newer = max(one, other, key=_order)
        merge = self._merge_of(one.key)
        if merge is None or one.value == other.value:
            return newer
        try:
            value = _shared(one.key, merge(one.value, other.value))
        except Exception as error:  # a merge is outside code, and the values are another robot's
            self.failure = f"the merge of '{one.key}' failed: {type(error).__name__}: {error}"
            return newer
        return TableEntry(one.key, value, newer.stamp, newer.writer)

    def _merge_of(self, key: str) -> Merge | None:
        return self._merges.get(key) or self._merges.get(key.partition("/")[0])

    def _store(self, entry: TableEntry) -> None:
        key, bucket = entry.key, _bucket(entry.key)
        if key not in self._entries:
            insort(self._keys, key)
        new = _hash(entry)
        self._digest[bucket] ^= self._hashes.get(key, 0) ^ new
        self._hashes[key], self._entries[key] = new, entry
        self._unsent.setdefault(key)
        self._clock = max(self._clock, entry.stamp)

    def _evict(self) -> None:
        key = self._keys.pop()
        self._digest[_bucket(key)] ^= self._hashes.pop(key)
        del self._entries[key]
        self._unsent.pop(key, None)
        self.evicted += 1


class SharedTable:
    """The table of a request as n robots know it, each by itself.

    Parameters
    ----------
    replica : ``replica(row)`` returns that of one robot
    """

    def __init__(self, replica: Callable[[int], ReplicatedTable]) -> None:
        self._replica = replica

    def put(self, row: int, key: str, value: float | str | Sequence[float]) -> None:
        """Write a value as robot `row`; see :meth:`ReplicatedTable.put`."""
        self._sound(row).put(key, value)

    def get(self, row: int, key: str, default: Shared | None = None) -> Any:
        """Return the value of `key` as far as robot `row` knows, `default` if it knows none."""
        return self._sound(row).get(key, default)

    def items(self, row: int) -> list[tuple[str, Shared]]:
        """Return all keys that robot `row` knows, sorted, with their values."""
        return self._sound(row).items()

    def writer(self, row: int, key: str) -> str:
        """Return the robot that wrote the value of `key` that robot `row` knows; empty: it knows none."""
        return self._sound(row).writer_of(key)

    def _sound(self, row: int) -> ReplicatedTable:
        table = self._replica(row)
        if table.failure:
            raise ConfigError(table.failure, hint="a merge must take any two values that robots write")
        return table


def _shared(key: str, value: Any) -> Shared:
    """Return a value as it is kept and sent.

    Raises
    ------
    ConfigError
        It is no finite number, text or short list of numbers.
    """
    if isinstance(value, str):
        return value
    try:
        numbers = [float(each) for each in value] if hasattr(value, "__len__") else [float(value)]
    except (TypeError, ValueError):
        numbers = [math.nan]
    if len(numbers) > MOST_NUMBERS or not all(math.isfinite(each) for each in numbers):
        raise ConfigError(
            f"the table cannot hold {value!r}", where=f"view.table.put '{key[:40]}'",
            hint=f"a finite number, a text, or up to {MOST_NUMBERS} finite numbers",
        )  # fmt: skip
    return _without_sign(tuple(numbers) if hasattr(value, "__len__") else numbers[0])


def _without_sign(value: Shared) -> Shared:
    """Return the value with 0 in place of -0, which is equal and would have another hash."""
    if isinstance(value, str):
        return value
    return tuple(each + 0.0 for each in value) if isinstance(value, tuple) else value + 0.0


def _order(entry: TableEntry) -> tuple[int, str, bytes]:
    """Return what orders the entries of a key; by the value last: a robot that restarts may use a stamp again."""
    return entry.stamp, entry.writer, msgspec.msgpack.encode(entry.value)


def _size(entry: TableEntry) -> int:
    return len(msgspec.msgpack.encode(entry))


def _hash(entry: TableEntry) -> int:
    return int.from_bytes(hashlib.blake2b(msgspec.msgpack.encode(entry), digest_size=4).digest(), "big")


def _bucket(key: str) -> int:
    return hashlib.blake2b(key.encode(), digest_size=1).digest()[0] % TABLE_BUCKETS
