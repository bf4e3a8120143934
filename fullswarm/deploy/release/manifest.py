"""What a release says about itself: ``manifest.json``, the first file a robot reads."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fullswarm.errors import ConfigError

FILE = "manifest.json"
FORMAT = 1
ROBOT_PROTOCOL = 1
"""Version of what ``fullswarm-robot`` on the robot must understand to install the release."""
_ID = re.compile(r"[0-9A-Za-z][0-9A-Za-z.+]*-[0-9a-f]{12}")


@dataclass(frozen=True, slots=True)
class Target:
    """What a release runs on: ``arch`` as ``uname -m`` says it; the oldest ``glibc``; Python's ``major.minor``."""

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
        path = folder / FILE
        try:
            text = path.read_text("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            hint = "a release is a folder made by `fullswarm bundle`"
            raise ConfigError("this is not a release: it has no manifest", where=str(path), hint=hint) from error
        return cls.parse(text, where=str(path))

    @classmethod
    def parse(cls, text: str, where: str = FILE) -> Manifest:
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
                    f"a release of format {raw['format']}; this fullswarm knows {FORMAT}", where=where, hint=hint
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
    """Tell whether a text can be a release's id: it becomes a folder's name and an argument of a shell command."""
    return _ID.fullmatch(text) is not None and ".." not in text


def id_for(manifest: Manifest, sums: str) -> str:
    """Return the id of a release: of `manifest` whatever id it has now, and of the `sums` of its other files."""
    nameless = Manifest(
        "", *(getattr(manifest, key) for key in ("version", "target", "extras", "packages", "robot_protocol"))
    )
    digest = hashlib.sha256(nameless.to_json().encode() + b"\0" + sums.encode()).hexdigest()
    return f"{manifest.version}-{digest[:12]}"
