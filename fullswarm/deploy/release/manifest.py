"""Reads and writes the description of a release: ``manifest.json``, the first file a robot reads, and checksums.

``SHA256SUMS`` holds every file of a release with its digest, as ``sha256sum`` writes and checks it.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fullswarm.errors import ConfigError

MANIFEST = "manifest.json"
FORMAT = 1
ROBOT_PROTOCOL = 1
"""Version of what ``fullswarm-robot`` on the robot must understand to install the release."""
_ID = re.compile(r"[0-9A-Za-z][0-9A-Za-z.+]*-[0-9a-f]{12}")
SUMS = "SHA256SUMS"
SIGNATURE = "SHA256SUMS.sig"
STATEMENT = "STATEMENT"
"""Number, expiry and checksums of the release, signed; not among the checksums, because it may be signed anew."""
_MOST_NAMED = 3


@dataclass(frozen=True, slots=True)
class Target:
    """What a release runs on: ``arch`` as ``uname -m`` prints it; the oldest ``glibc``; Python's ``major.minor``."""

    name: str
    arch: str
    glibc: str
    python: str

    @property
    def manylinux(self) -> str:
        """The newest wheel tag that such a machine can load; it loads all the older ones as well."""
        return f"{self.arch}-manylinux_{self.glibc.replace('.', '_')}"


@dataclass(frozen=True, slots=True)
class Manifest:
    """The facts of one release. ``id`` is ``<version>-<12 hex digits over all its content>``."""

    id: str
    version: str
    target: Target
    extras: tuple[str, ...] = ()
    packages: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    robot_protocol: int = ROBOT_PROTOCOL
    format: int = FORMAT

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """Read the manifest of a release.

        Raises
        ------
        ConfigError
            There is none, or it is not one of this format.
        """
        path = folder / MANIFEST
        try:
            text = path.read_text("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            hint = "a release is a folder made by `fullswarm bundle`"
            raise ConfigError("this is not a release: it has no manifest", where=str(path), hint=hint) from error
        return cls.parse(text, where=str(path))

    @classmethod
    def parse(cls, text: str, where: str = MANIFEST) -> Manifest:
        """Return the manifest that a JSON text holds.

        Raises
        ------
        ConfigError
            It is not JSON, of another format, or lacks something.
        """
        try:
            raw = json.loads(text)
            if raw["format"] != FORMAT:
                hint = "update fullswarm here, or bundle again"
                raise ConfigError(
                    f"a release of format {raw['format']}; this fullswarm reads format {FORMAT}", where=where, hint=hint
                )
            return _from_json(raw)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            what = f"not the manifest of a release ({type(error).__name__}: {error})"
            raise ConfigError(what, where=where, hint="bundle again: the file is damaged") from error

    def to_json(self) -> str:
        """Return the text of ``manifest.json``, the same for the same facts."""
        raw = {
            **{key: getattr(self, key) for key in ("format", "id", "version", "robot_protocol")},
            "target": asdict(self.target),
            "extras": list(self.extras),
            "packages": dict(self.packages),
        }
        return json.dumps(raw, indent=1, sort_keys=True) + "\n"


def _from_json(raw: dict[str, Any]) -> Manifest:
    target = Target(**{key: str(raw["target"][key]) for key in ("name", "arch", "glibc", "python")})
    packages = {str(name): str(version) for name, version in raw["packages"].items()}
    extras = tuple(str(each) for each in raw["extras"])
    name = str(raw["id"])
    if not is_id(name):
        raise ValueError(f"id {name!r}")
    return Manifest(name, str(raw["version"]), target, extras, MappingProxyType(packages), int(raw["robot_protocol"]))


def is_id(text: str) -> bool:
    """Return whether a text can be a release's id: it becomes a folder's name and an argument of a shell command."""
    return _ID.fullmatch(text) is not None and ".." not in text


def id_for(manifest: Manifest, sums: str) -> str:
    """Return the id of a release: of `manifest` regardless of its present id, and of the `sums` of its other files."""
    nameless = Manifest(
        "", *(getattr(manifest, key) for key in ("version", "target", "extras", "packages", "robot_protocol"))
    )
    digest = hashlib.sha256(nameless.to_json().encode() + b"\0" + sums.encode()).hexdigest()
    return f"{manifest.version}-{digest[:12]}"


# ---------------------------------------------------------------- checksums
def files_of(folder: Path) -> Iterator[str]:
    """Yield the path of every file below a folder but the sums and their signature, sorted as bytes.

    Raises
    ------
    ConfigError
        There is a link, a device, or a name that tools on a robot could misread.
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
    yield from sorted((each for each in found if each not in (SUMS, SIGNATURE, STATEMENT)), key=os.fsencode)


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sums_of(folder: Path, *, without: tuple[str, ...] = ()) -> str:
    """Return the text of ``SHA256SUMS`` for a folder as it is now."""
    return "".join(f"{digest_of(folder / each)}  {each}\n" for each in files_of(folder) if each not in without)


def parse_sums(text: str, where: str = SUMS) -> dict[str, str]:
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


def read_sums(folder: Path) -> dict[str, str]:
    """Return ``{path: digest}`` of a release.

    Raises
    ------
    ConfigError
        It has none, or they cannot be read.
    """
    path = folder / SUMS
    try:
        return parse_sums(path.read_text("utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            "this is not a complete release: no checksums", where=str(path), hint="bundle again"
        ) from error


def check_sums(folder: Path) -> None:
    """Compare every file of a release with its sum.

    Raises
    ------
    ConfigError
        A file is missing, differs, or is not in the list; names the first ones.
    """
    wanted, there = read_sums(folder), set(files_of(folder))
    wrong = [f"{each} is missing" for each in wanted if each not in there]
    wrong += [f"{each} is not in the list" for each in sorted(there - set(wanted))]
    wrong += [f"{each} was changed" for each in wanted if each in there and digest_of(folder / each) != wanted[each]]
    if wrong:
        more = f", and {len(wrong) - _MOST_NAMED} more" if len(wrong) > _MOST_NAMED else ""
        what = f"the release is not what was signed: {'; '.join(wrong[:_MOST_NAMED])}{more}"
        raise ConfigError(what, where=str(folder), hint="bundle again, or copy it again")
