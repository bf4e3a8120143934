"""Behaviours and drivers of other people (``--package``): wheels as they are, folders built into wheels first."""

from __future__ import annotations

import email
import re
import shutil
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

from fullswarm.deploy.release import own, uv
from fullswarm.errors import ConfigError

_LEAVE = shutil.ignore_patterns(".*", "__pycache__", "build", "dist", "*.egg-info", "venv", "node_modules")


@dataclass(frozen=True, slots=True)
class Outside:
    """One package: its normal name, its version, its wheel, its requirements."""

    name: str
    version: str
    wheel: Path
    requires: tuple[str, ...]


def find(path: Path, work: Path, wheels: Path | None) -> Outside:
    """Return the package that a wheel or a folder with a ``pyproject.toml`` is; `work` is a scratch folder.

    Raises
    ------
    ConfigError
        It is neither, cannot be built, or a folder's package has parts that are compiled.
    """
    path = path.absolute()
    if path.is_dir() and (path / "pyproject.toml").is_file():
        return _read(_build(path, work, wheels))
    if path.is_file() and path.suffix == ".whl":
        return _read(path)
    hint = "a .whl, or a folder with a pyproject.toml"
    raise ConfigError("not a package", where=f"--package {path}", hint=hint)


def _build(folder: Path, work: Path, wheels: Path | None) -> Path:
    # A copy: building leaves folders behind, and an old `build/` would get its stale files into the wheel.
    number = sum(1 for each in work.glob("built-*"))
    source, out = work / f"source-{number}" / folder.name, work / f"built-{number}"
    shutil.copytree(folder, source, ignore=_LEAVE)
    offline: list[str | Path] = [] if wheels is None else ["--no-index", "--find-links", wheels]
    uv.run(
        work,
        "build",
        "--quiet",
        "--wheel",
        "--python",
        sys.executable,
        *offline,
        "--out-dir",
        out,
        source,
        why=f"build {folder}",
    )
    made = list(out.glob("*.whl"))
    if len(made) != 1 or not made[0].name.endswith("-any.whl"):
        what = "it has compiled parts, which would be for this machine and not for the robot"
        raise ConfigError(what, where=f"--package {folder}", hint="build its wheel on such a robot, and give that")
    return made[0]


def _read(wheel: Path) -> Outside:
    try:
        with zipfile.ZipFile(wheel) as file:
            inside = next(each for each in file.namelist() if re.fullmatch(r"[^/]+\.dist-info/METADATA", each))
            facts = email.message_from_bytes(file.read(inside))
        return Outside(own.name(facts["Name"]), facts["Version"], wheel, tuple(facts.get_all("Requires-Dist") or ()))
    except (zipfile.BadZipFile, StopIteration, KeyError, TypeError) as error:
        raise ConfigError("not a wheel", where=f"--package {wheel}", hint="build it again") from error
