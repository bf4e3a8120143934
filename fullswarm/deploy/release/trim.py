"""Takes out of unpacked wheels what never runs on board: tests, stubs, headers, generators, dialects. Licences stay."""

from __future__ import annotations

import re
from pathlib import Path

_INSTALLER = (
    r"\.[^/]*",  # what the installer leaves at the top
    r"bin/.*",  # scripts with the first line of this machine
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
    r"pygments/lexers/(?!(__init__|_mapping|python|special|text)\.py$).*",  # rich's: it shows Python at most
    # pymavlink: fullswarm speaks MAVLink 2 with this one dialect, which holds all of `common`.
    r"pymavlink/dialects/v(09|10)/.*",
    r"pymavlink/dialects/v20/(?!(ardupilotmega|common|__init__)\.py$).*",
    r"pymavlink/generator/(?!(mavcrc|mavparse|__init__)\.py$).*",  # what mavutil imports, for outside drivers
    r"pymavlink/(tools|dfindexer|message_definitions|setup\.py).*",
)
_NOT_NEEDED = re.compile("|".join(f"(?:{each})" for each in _RULES))
_OF_INSTALLER = re.compile("|".join(f"(?:{each})" for each in _INSTALLER))
_LICENCE = re.compile(r"(.*/)?(licen[cs]es?|copying|notice|authors)(/.*|[^/]*)", re.IGNORECASE)


def needed(path: str) -> bool:
    """Tell whether a file of unpacked wheels, by its path below them, is needed on board."""
    if _LICENCE.fullmatch(path) and "__pycache__" not in path:
        return True
    return not _NOT_NEEDED.fullmatch(path)


def trim(folder: Path, *, whole: bool = False) -> int:
    """Delete what is not needed; return how many bytes that was.

    With `whole` the packages stay as their authors made them, but for what the installer left.
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
