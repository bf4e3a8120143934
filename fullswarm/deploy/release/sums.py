"""``SHA256SUMS``: every file of a release with its digest, as ``sha256sum`` writes and checks it."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from fullswarm.errors import ConfigError

FILE = "SHA256SUMS"
SIGNATURE = "SHA256SUMS.sig"
_MOST_NAMED = 3


def files(folder: Path) -> Iterator[str]:
    """Yield the path of every file below a folder but the sums and their signature, sorted as bytes.

    Raises
    ------
    ConfigError
        There is a link, a device, or a name that the tools on a robot could misread.
    """
    found = []
    for parent, folders, names in os.walk(folder):
        for name in (*folders, *names):
            path = Path(parent, name)
            kind = path.lstat().st_mode
            if stat.S_ISDIR(kind):
                continue
            relative = path.relative_to(folder).as_posix()
            if not stat.S_ISREG(kind):
                raise ConfigError("a release holds plain files only, no links", where=relative)
            if not relative.isprintable() or "\\" in relative:
                raise ConfigError("a file's name may not hold control characters or backslashes", where=repr(relative))
            found.append(relative)
    yield from sorted((each for each in found if each not in (FILE, SIGNATURE)), key=os.fsencode)


def digest(path: Path) -> str:
    """Return the SHA-256 of a file in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def of(folder: Path, *, without: tuple[str, ...] = ()) -> str:
    """Return the text of ``SHA256SUMS`` for a folder as it is now."""
    return "".join(f"{digest(folder / each)}  {each}\n" for each in files(folder) if each not in without)


def parse(text: str, where: str = FILE) -> dict[str, str]:
    """Return ``{path: digest}``.

    Raises
    ------
    ConfigError
        A line is not one of ``sha256sum``, or a path leads out of the release.
    """
    sums = {}
    for line in text.splitlines():
        hexes, gap, path = line[:64], line[64:66], line[66:]
        if len(hexes) != 64 or set(hexes) - set("0123456789abcdef") or gap != "  " or not _inside(path):
            raise ConfigError(f"not a line of checksums: {line[:100]!r}", where=where, hint="bundle again")
        sums[path] = hexes
    return sums


def _inside(path: str) -> bool:
    return bool(path) and path.isprintable() and all(part not in ("", ".", "..") for part in path.split("/"))


def read(folder: Path) -> dict[str, str]:
    """Return ``{path: digest}`` of a release.

    Raises
    ------
    ConfigError
        It has none, or they cannot be read.
    """
    path = folder / FILE
    try:
        return parse(path.read_text("utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError("this is not a whole release: no checksums", where=str(path), hint="bundle again") from error


def check(folder: Path) -> None:
    """Compare every file of a release with its sum.

    Raises
    ------
    ConfigError
        A file is missing, differs, or is not in the list; names the first ones.
    """
    wanted, there = read(folder), set(files(folder))
    wrong = [f"{each} is missing" for each in wanted if each not in there]
    wrong += [f"{each} is not in the list" for each in sorted(there - set(wanted))]
    wrong += [f"{each} was changed" for each in wanted if each in there and digest(folder / each) != wanted[each]]
    if wrong:
        more = f", and {len(wrong) - _MOST_NAMED} more" if len(wrong) > _MOST_NAMED else ""
        what = f"the release is not what was signed: {'; '.join(wrong[:_MOST_NAMED])}{more}"
        raise ConfigError(what, where=str(folder), hint="bundle again, or copy it again")
