"""Selects the files that go on board: fullswarm's own (``app/fullswarm``, ``robot/``), and what stays of its wheels."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import fullswarm

OWN = Path(fullswarm.__file__).parent
"""Folder of this fullswarm, in a checkout or an environment: a release contains the code that made it."""
NOT_ON_BOARD = ("testing/", "emulators/", "simulation/", "operator/console/page/", "bringup/lab/")
"""Not on robots: checks for developers, emulated robots and their world, the console's
page, the lab of `fullswarm init`."""
_LEFTOVERS = (".pyc", ".orig", ".rej", "~", ".md")
"""The last, because only a checkout has such notes, and an installed fullswarm must make the same bytes."""
_INSTALLER = (
    r"\.[^/]*",  # files of the installer at the top
    r"bin/.*",  # scripts with this machine's interpreter
    r"(.*/)?__pycache__/.*",
    r"[^/]+\.dist-info/(RECORD|INSTALLER|REQUESTED|WHEEL|direct_url\.json|uv_[^/]*\.json|sboms/.*)",
)
_RULES = (
    *_INSTALLER,
    r"(.*/)?(tests?|docs?|examples?|benchmarks?)/.*",
    r".*\.(pyi|pyx|pxd|pxi|c|cc|cpp|h|hpp|a|lib|pc|map|md|rst)",
    r"share/.*|include/.*",
    r"numpy/(f2py|_pyinstaller)/.*",
    r"numpy/conftest\.py",
    r"pygments/lexers/(?!(__init__|_mapping|python|special|text)\.py$).*",  # used by rich, for Python at most
    # pymavlink: fullswarm speaks MAVLink 2 with this one dialect, which holds all of `common`.
    r"pymavlink/dialects/v(09|10)/.*",
    r"pymavlink/dialects/v20/(?!(ardupilotmega|common|__init__)\.py$).*",
    r"pymavlink/generator/(?!(mavcrc|mavparse|__init__)\.py$).*",  # what mavutil imports, for outside drivers
    r"pymavlink/(tools|dfindexer|message_definitions|setup\.py).*",
)
_NOT_NEEDED = re.compile("|".join(f"(?:{each})" for each in _RULES))
_OF_INSTALLER = re.compile("|".join(f"(?:{each})" for each in _INSTALLER))
_LICENCE = re.compile(r"(.*/)?(licen[cs]es?|copying|notice|authors)(/.*|[^/]*)", re.IGNORECASE)


def copy_app(place: Path) -> None:
    """Copy the package to `place`, which becomes ``app/fullswarm``."""
    for name in _plain_files(OWN):
        beside = name.startswith("deploy/robot/") and not name.endswith(".py")  # in the layer ``robot/``
        if not beside and not name.startswith(NOT_ON_BOARD):
            _copy(OWN / name, place / name)


def copy_robot_files(place: Path) -> None:
    """Copy what stands on a robot outside every release to `place`, so that a release can install itself."""
    source = OWN / "deploy" / "robot"
    for name in _plain_files(source):
        if not name.endswith(".py"):
            _copy(source / name, place / name)


def _plain_files(folder: Path) -> Iterator[str]:
    """Yield the paths of the source files below a folder, without what tools and editors leave."""
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        hidden = any(part.startswith(".") or part == "__pycache__" for part in name.parts)
        if path.is_file() and not hidden and not path.name.endswith(_LEFTOVERS):
            yield name.as_posix()


def _copy(source: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, place)
    with source.open("rb") as file:
        place.chmod(0o755 if file.read(2) == b"#!" else 0o644)


# ---------------------------------------------------------------- what of the wheels stays
def needed(path: str) -> bool:
    """Return whether a file of unpacked wheels, by its path below them, is needed on board."""
    if _LICENCE.fullmatch(path) and "__pycache__" not in path:
        return True
    return not _NOT_NEEDED.fullmatch(path)


def trim(folder: Path, *, whole: bool = False) -> int:
    """Delete what is not needed; return the number of bytes.

    With `whole` only the files of the installer are deleted.
    """
    gone = 0
    for path in sorted(folder.rglob("*"), reverse=True):  # files before their folder
        if path.is_dir():
            if not any(path.iterdir()):
                path.rmdir()
            continue
        name = path.relative_to(folder).as_posix()
        if _OF_INSTALLER.fullmatch(name) if whole else not needed(name):
            gone += path.stat().st_size
            path.unlink()
    return gone
