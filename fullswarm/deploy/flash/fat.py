"""Reads partition tables and FAT file systems of images and cards, and edits the boot partition with mtools.

Nothing that an image says is trusted. Reading is done here; files are written by mtools, and the result is checked
by ``fsck.vfat``.
"""

from __future__ import annotations

import itertools
import os
import shutil
import struct
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from fullswarm.errors import ConfigError

SECTOR_BYTES = 512
HEAD_BYTES = 1 << 20
"""The first bytes of an image hold any table that is read here."""

_MBR_ENTRY = struct.Struct("<B3sB3sII")
_GPT_HEADER = struct.Struct("<8sIIIIQQQQ16sQIII")
_MAGIC, _BOOT_MARK = b"EFI PART", b"\x55\xaa"
_PROTECTIVE = 0xEE
_EXTENDED = frozenset({0x05, 0x0F, 0x85})
_MOST_ENTRIES = 1024
BOOT_LABELS = ("bootfs", "cidata", "system-boot", "boot")
"""The boot partition's label in Raspberry Pi OS, NoCloud, Ubuntu and older Raspberry Pi OS."""

_FAT12_CLUSTERS = 4085
_SIGNS = {"MTOOLS_SKIP_CHECK": "1", "MTOOLS_NO_VFAT": "0", "MTOOLS_LOWER_CASE": "0"}


@dataclass(frozen=True, slots=True)
class Partition:
    """One partition; offsets count from the start of the disk."""

    number: int
    start_bytes: int
    size_bytes: int
    name: str = ""  # GPT only

    @property
    def end_bytes(self) -> int:
        """The first byte after it."""
        return self.start_bytes + self.size_bytes


def read_partitions(head: bytes, where: str) -> tuple[Partition, ...]:
    """Return the partitions of a disk whose first :data:`HEAD_BYTES` are `head`, in the order of the table.

    Logical partitions inside an extended one are left out: no supported system boots from one.

    Raises
    ------
    ConfigError
        There is no table, or it is inconsistent.
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
        raise ConfigError("is marked as GPT, but has no GPT header", where=where, hint=broken)
    begin = table * SECTOR_BYTES
    if not 128 <= size <= 4096 or not 0 < count <= _MOST_ENTRIES or begin + count * size > len(head) or table < 2:
        raise ConfigError("has a GPT with invalid sizes", where=where, hint=broken)
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


# ---------------------------------------------------------------- the file system
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
        what = f"none of its {count} partitions is a FAT, so the robot's files cannot be written"
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


# ---------------------------------------------------------------- editing it with mtools
def check_tools() -> None:
    """Raise when mtools is not installed.

    Raises
    ------
    ConfigError
        It is not.
    """
    if shutil.which("mcopy") is None:
        raise ConfigError("needs mtools to edit a boot partition", where="flash", hint="apt install mtools dosfstools")


def put_files(disk: Path, volume: Volume, files: Mapping[str, bytes]) -> None:
    """Write `files` (path within the FAT → content) over what is there, and read them back.

    Raises
    ------
    ConfigError
        They do not fit, or mtools refuses.
    """
    check_room(volume, files, str(disk))
    drive = f"{disk}@@{volume.start_bytes}"
    with TemporaryDirectory(prefix="fullswarm-flash-") as folder:
        stage = Path(folder)
        stage.chmod(0o700)  # it holds keys
        for path, content in files.items():
            target = stage / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
        tops = sorted(each.name for each in stage.iterdir())
        _run("mcopy", "-s", "-o", "-m", "-i", drive, *(str(stage / name) for name in tops), "::")
    for path, content in files.items():
        if get_file(disk, volume, path) != content:
            hint = "update mtools (4.0.21 or newer), or take another card; the robot would not start"
            raise ConfigError(f"{path} reads back different from what was written", where=str(disk), hint=hint)


def check_room(volume: Volume, files: Mapping[str, bytes], where: str) -> None:
    """Raise when `files` do not fit.

    Raises
    ------
    ConfigError
        They do not.
    """
    needed = volume.needed_bytes(len(content) for content in files.values())
    if needed > volume.free_bytes:
        biggest = max(files, key=lambda path: len(files[path]))
        what = (
            f"its boot partition '{volume.label}' has {volume.free_bytes / 1e6:.0f} MB free, "
            f"{needed / 1e6:.0f} MB are needed"
        )
        hint = f"most of it is {biggest}; bundle with fewer extras, or use an image with a larger boot partition"
        raise ConfigError(what, where=where, hint=hint)


def get_file(disk: Path, volume: Volume, path: str) -> bytes | None:
    """Return a file of the FAT, or None when there is none."""
    done = _call("mcopy", "-n", "-i", f"{disk}@@{volume.start_bytes}", f"::{path}", "-")
    return done.stdout if done.returncode == 0 else None


def file_names(disk: Path, volume: Volume) -> frozenset[str]:
    """Return the names at the top of the FAT, in lower case, folders with a slash."""
    done = _run("mdir", "-b", "-i", f"{disk}@@{volume.start_bytes}", "::")
    return frozenset(
        line.strip().removeprefix("::/").lower() for line in done.stdout.decode("utf-8", "replace").splitlines()
    )


def fsck(disk: Path, volume: Volume) -> str:
    """Check the FAT with fsck.vfat, read only; return its result, or why there was no check.

    Raises
    ------
    ConfigError
        It finds errors.
    """
    program = shutil.which("fsck.vfat", path=os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin", "/sbin")))
    if program is None:
        return "not checked: no fsck.vfat (apt install dosfstools)"
    with TemporaryDirectory(prefix="fullswarm-fsck-") as folder:
        alone = Path(folder) / "fat.img"
        alone.touch(mode=0o600)
        copy_range(disk, volume.start_bytes, volume.size_bytes, alone)
        done = subprocess.run([program, "-n", str(alone)], capture_output=True, check=False)  # noqa: S603
    if done.returncode != 0:
        lines = done.stdout.decode("utf-8", "replace").strip().splitlines()
        what = f"fsck.vfat finds errors in the boot partition: {'; '.join(lines[1:4])}"
        raise ConfigError(what, where=str(disk), hint="take the image from its source again")
    return "fsck.vfat: clean"


def copy_range(disk: Path, start_bytes: int, size_bytes: int, into: Path) -> None:
    """Copy a part of a disk into a file of its own, with holes instead of zeros."""
    from fullswarm.deploy.flash.image import CHUNK_BYTES, put_sparse

    with disk.open("rb") as source, into.open("wb") as target:
        source.seek(start_bytes)
        done = 0
        while done < size_bytes and (data := source.read(min(CHUNK_BYTES, size_bytes - done))):
            put_sparse(target.fileno(), data, done)
            done += len(data)
        target.truncate(size_bytes)


def _run(*words: str) -> subprocess.CompletedProcess[bytes]:
    done = _call(*words)
    if done.returncode != 0:
        message = done.stderr.decode("utf-8", "replace").strip() or f"exit code {done.returncode}"
        disk = words[words.index("-i") + 1].partition("@@")[0]
        raise ConfigError(f"{words[0]}: {message}", where=disk, hint="is it complete, and may you write it?")
    return done


def _call(*words: str) -> subprocess.CompletedProcess[bytes]:
    check_tools()
    environment = {**os.environ, **_SIGNS, "LC_ALL": "C.UTF-8"}
    return subprocess.run(  # noqa: S603  (no shell, our words)
        words, capture_output=True, check=False, stdin=subprocess.DEVNULL, env=environment
    )
