"""Reads a FAT file system: is it one, what is it called, how much room does it have. Never writes."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fullswarm.deploy.flash.partitions import HEAD_BYTES, Partition, read_partitions
from fullswarm.errors import ConfigError

BOOT_LABELS = ("bootfs", "cidata", "system-boot", "boot")
"""What the boot partition is called by Raspberry Pi OS, NoCloud seeds, Ubuntu and older Raspberry Pi OS."""

_FAT12_CLUSTERS = 4085


@dataclass(frozen=True, slots=True)
class Volume:
    """A FAT file system at `start_bytes` of a disk."""

    start_bytes: int
    size_bytes: int
    label: str
    volume_id: str  # as in /dev/disk/by-uuid: 1A2B-3C4D
    kind: int  # 12, 16 or 32
    cluster_bytes: int
    free_bytes: int

    def needed_bytes(self, sizes: Iterable[int]) -> int:
        """Return what files of these sizes take, whole clusters and a share for their folder."""
        clusters = sum(-(-size // self.cluster_bytes) + 1 for size in sizes)
        return clusters * self.cluster_bytes


def boot_volume(disk: int, where: str) -> Volume:
    """Return the FAT from which an image boots, of a disk open as `disk`.

    Of several, one with a usual label is taken, else the first.

    Raises
    ------
    ConfigError
        The disk has no partition table, or no FAT.
    """
    partitions = read_partitions(os.pread(disk, HEAD_BYTES, 0), where)
    volumes = [volume for each in partitions if (volume := read_volume(disk, each)) is not None]
    if not volumes:
        count = len(partitions)
        what = f"none of its {count} partitions is a FAT, so there is nowhere to put what the robot needs"
        raise ConfigError(what, where=where, hint="use Raspberry Pi OS or Ubuntu for Raspberry Pi, 64 bit")
    named = [each for each in volumes if each.label.lower() in BOOT_LABELS]
    return (named or volumes)[0]


def read_volume(disk: int, partition: Partition) -> Volume | None:
    """Return the FAT in `partition`, or None when it holds something else."""
    sector = os.pread(disk, 512, partition.start_bytes)
    if len(sector) < 512 or sector[510:] != b"\x55\xaa" or sector[0] not in (0xEB, 0xE9):
        return None
    (
        sector_bytes,
        per_cluster,
        reserved,
        fats,
        root_entries,
        total_16,
        _,
        fat_16,
        _,
        _,
        _,
        total_32,
    ) = struct.unpack_from("<HBHBHHBHHHII", sector, 11)
    fat_sectors = fat_16 or struct.unpack_from("<I", sector, 36)[0]
    powers = sector_bytes in (512, 1024, 2048, 4096) and per_cluster and per_cluster & (per_cluster - 1) == 0
    if not powers or not reserved or fats not in (1, 2) or not fat_sectors:
        return None
    root_sectors = -(-root_entries * 32 // sector_bytes)
    total = total_16 or total_32
    clusters = (total - reserved - fats * fat_sectors - root_sectors) // per_cluster
    if clusters < 1 or total * sector_bytes > partition.size_bytes:
        return None
    kind = 32 if fat_16 == 0 else 12 if clusters < _FAT12_CLUSTERS else 16
    begin = partition.start_bytes + reserved * sector_bytes
    there = os.lseek(disk, 0, os.SEEK_END) - begin
    if there <= 0:
        return None
    table = os.pread(disk, min(fat_sectors * sector_bytes, there), begin)
    at = 67 if fat_16 == 0 else 39
    number, label = struct.unpack_from("<I11s", sector, at)
    return Volume(
        start_bytes=partition.start_bytes,
        size_bytes=partition.size_bytes,
        label=label.decode("ascii", "replace").rstrip(),
        volume_id=f"{number >> 16:04X}-{number & 0xFFFF:04X}",
        kind=kind,
        cluster_bytes=per_cluster * sector_bytes,
        free_bytes=_free_clusters(table, kind, clusters) * per_cluster * sector_bytes,
    )


def _free_clusters(table: bytes, kind: int, clusters: int) -> int:
    if kind == 32:
        entries = np.frombuffer(table[: len(table) // 4 * 4], "<u4")[2 : clusters + 2] & 0x0FFFFFFF
    elif kind == 16:
        entries = np.frombuffer(table[: len(table) // 2 * 2], "<u2")[2 : clusters + 2]
    else:  # two entries of 12 bits in three bytes
        triples = np.frombuffer(table[: len(table) // 3 * 3], "u1").reshape(-1, 3).astype("<u2")
        low, middle, high = triples.T
        pairs = np.stack((low | (middle & 0xF) << 8, middle >> 4 | high << 4), axis=1)
        entries = pairs.reshape(-1)[2 : clusters + 2]
    return int(np.count_nonzero(entries == 0))
