"""Edits a FAT without mounting it, with mtools; fsck.vfat has the last word."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from fullswarm.deploy.flash.fat import Volume
from fullswarm.errors import ConfigError

_SIGNS = {"MTOOLS_SKIP_CHECK": "1", "MTOOLS_NO_VFAT": "0", "MTOOLS_LOWER_CASE": "0"}


def check_there() -> None:
    """Raise when mtools is not installed.

    Raises
    ------
    ConfigError
        It is not.
    """
    if shutil.which("mcopy") is None:
        raise ConfigError("needs mtools to edit a boot partition", where="flash", hint="apt install mtools dosfstools")


def put(disk: Path, volume: Volume, files: Mapping[str, bytes]) -> None:
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
        stage.chmod(0o700)  # keys pass through here
        for path, content in files.items():
            target = stage / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
        tops = sorted(each.name for each in stage.iterdir())
        _run("mcopy", "-s", "-o", "-m", "-i", drive, *(str(stage / name) for name in tops), "::")
    for path, content in files.items():
        if get(disk, volume, path) != content:
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


def get(disk: Path, volume: Volume, path: str) -> bytes | None:
    """Return a file of the FAT, or None when there is none."""
    done = _call("mcopy", "-n", "-i", f"{disk}@@{volume.start_bytes}", f"::{path}", "-")
    return done.stdout if done.returncode == 0 else None


def names(disk: Path, volume: Volume) -> frozenset[str]:
    """Return what lies at the top of the FAT, in lower case, folders with a slash."""
    done = _run("mdir", "-b", "-i", f"{disk}@@{volume.start_bytes}", "::")
    return frozenset(
        line.strip().removeprefix("::/").lower() for line in done.stdout.decode("utf-8", "replace").splitlines()
    )


def fsck(disk: Path, volume: Volume) -> str:
    """Let fsck.vfat judge the FAT, read only; return the tool's name here, or why there was no check.

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
        said = done.stdout.decode("utf-8", "replace").strip().splitlines()
        what = f"fsck.vfat finds errors in the boot partition: {'; '.join(said[1:4])}"
        raise ConfigError(what, where=str(disk), hint="take the image from its source again")
    return "fsck.vfat: clean"


def copy_range(disk: Path, start_bytes: int, size_bytes: int, into: Path) -> None:
    """Copy a part of a disk into a file of its own, with holes for zeros."""
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
        said = done.stderr.decode("utf-8", "replace").strip() or f"exit code {done.returncode}"
        disk = words[words.index("-i") + 1].partition("@@")[0]
        raise ConfigError(f"{words[0]}: {said}", where=disk, hint="is it whole, and may you write it?")
    return done


def _call(*words: str) -> subprocess.CompletedProcess[bytes]:
    check_there()
    environment = {**os.environ, **_SIGNS, "LC_ALL": "C.UTF-8"}
    return subprocess.run(  # noqa: S603  (no shell, our words)
        words, capture_output=True, check=False, stdin=subprocess.DEVNULL, env=environment
    )
