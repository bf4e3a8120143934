"""Reads partition tables, MBR and GPT, from untrusted bytes."""

from __future__ import annotations

import itertools
import struct
from dataclasses import dataclass

from fullswarm.errors import ConfigError

SECTOR_BYTES = 512
HEAD_BYTES = 1 << 20
"""So much of an image holds any table that is read here."""

_MBR_ENTRY = struct.Struct("<B3sB3sII")
_GPT_HEADER = struct.Struct("<8sIIIIQQQQ16sQIII")
_MAGIC, _BOOT_MARK = b"EFI PART", b"\x55\xaa"
_PROTECTIVE = 0xEE
_EXTENDED = frozenset({0x05, 0x0F, 0x85})
_MOST_ENTRIES = 1024


@dataclass(frozen=True, slots=True)
class Partition:
    """One partition; offsets count from the start of the disk."""

    number: int
    start_bytes: int
    size_bytes: int
    name: str = ""  # GPT only

    @property
    def end_bytes(self) -> int:
        """First byte behind it."""
        return self.start_bytes + self.size_bytes


def read_partitions(head: bytes, where: str) -> tuple[Partition, ...]:
    """Return the partitions of a disk whose first :data:`HEAD_BYTES` are `head`, in the order of the table.

    Logical partitions inside an extended one are left out: no boot partition of ours lives there.

    Raises
    ------
    ConfigError
        There is no table, or it contradicts itself.
    """
    if len(head) < SECTOR_BYTES or head[510:512] != _BOOT_MARK:
        hint = "is it a disk image (.img), whole and decompressed? a .zip or .iso is not"
        raise ConfigError("has no partition table", where=where, hint=hint)
    entries = [_MBR_ENTRY.unpack_from(head, 446 + 16 * index) for index in range(4)]
    if any(kind == _PROTECTIVE for _, _, kind, _, _, _ in entries):
        found = _gpt(head, where)
    else:
        found = tuple(
            Partition(number, first * SECTOR_BYTES, count * SECTOR_BYTES)
            for number, (_, _, kind, _, first, count) in enumerate(entries, start=1)
            if kind and kind not in _EXTENDED and first and count
        )
    if not found:
        raise ConfigError("its partition table is empty", where=where, hint="use an image of a whole card")
    _check_apart(found, where)
    return found


def _gpt(head: bytes, where: str) -> tuple[Partition, ...]:
    broken = "take the image from its source again, or repair its table with `sgdisk --verify`"
    if len(head) < 2 * SECTOR_BYTES:
        raise ConfigError("ends within its partition table", where=where, hint=broken)
    magic, _, _, _, _, _, _, first, last, _, table, count, size, _ = _GPT_HEADER.unpack_from(head, SECTOR_BYTES)
    if magic != _MAGIC:
        raise ConfigError("says GPT, but has no GPT header", where=where, hint=broken)
    begin = table * SECTOR_BYTES
    if not 128 <= size <= 4096 or not 0 < count <= _MOST_ENTRIES or begin + count * size > len(head) or table < 2:
        raise ConfigError("has a GPT whose sizes make no sense", where=where, hint=broken)
    found = []
    for index in range(count):
        entry = head[begin + index * size :][:128]
        start, end = struct.unpack_from("<QQ", entry, 32)
        if entry[:16] == bytes(16):
            continue
        if not first <= start <= end <= last:
            raise ConfigError(f"partition {index + 1} lies outside its disk", where=where, hint=broken)
        name = entry[56:128].decode("utf-16-le", "replace").partition("\0")[0]
        found.append(Partition(index + 1, start * SECTOR_BYTES, (end - start + 1) * SECTOR_BYTES, name))
    return tuple(found)


def _check_apart(found: tuple[Partition, ...], where: str) -> None:
    ordered = sorted(found, key=lambda each: each.start_bytes)
    for before, after in itertools.pairwise(ordered):
        if before.end_bytes > after.start_bytes:
            what = f"partitions {before.number} and {after.number} overlap"
            raise ConfigError(what, where=where, hint="take the image from its source again")
