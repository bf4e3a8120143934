"""The layers of a release that come from fullswarm itself: ``app/fullswarm`` and ``robot/``."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import fullswarm

OWN = Path(fullswarm.__file__).parent
"""Where this fullswarm lies, in a checkout or an environment: a release takes the code that made it."""
NOT_ON_BOARD = ("testing/", "emulators/", "simulation/", "operator/console/page/", "bringup/lab/")
"""What no robot runs: checks for developers, emulated robots and their world, the console's
page, the lab of `fullswarm init`."""
_LEFTOVERS = (".pyc", ".orig", ".rej", "~", ".md")
"""The last: notes for readers of a checkout; an installed fullswarm, which must make the same bytes, has none."""


def app(place: Path) -> None:
    """Copy the package to `place`, which becomes ``app/fullswarm``."""
    for name in _plain_files(OWN):
        beside = name.startswith("deploy/robot/") and not name.endswith(".py")  # in the layer ``robot/``
        if not beside and not name.startswith(NOT_ON_BOARD):
            _copy(OWN / name, place / name)


def robot(place: Path) -> None:
    """Copy what stands on a robot outside every release to `place`, so that a release can install by itself."""
    source = OWN / "deploy" / "robot"
    for name in _plain_files(source):
        if not name.endswith(".py"):
            _copy(source / name, place / name)


def _plain_files(folder: Path) -> Iterator[str]:
    """Yield the paths of the files below a folder that people wrote; not what tools and editors leave."""
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
