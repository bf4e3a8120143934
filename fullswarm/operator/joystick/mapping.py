"""SDL's text form of a pad's mapping: ``guid,name,a:b0,leftx:a0,…,platform:Linux,`` and files of such lines."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterable
from collections.abc import Mapping as Table
from dataclasses import dataclass
from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.operator.joystick.state import AXES, BUTTONS

FILE = "gamecontrollerdb.txt"
_GUID = re.compile(r"[0-9a-fA-F]{32}\Z|xinput\Z")
_TARGETS = frozenset((*AXES, *BUTTONS))
_SOURCE = re.compile(r"[+-]?a\d{1,3}~?\Z|b\d{1,3}\Z|h\d{1,2}\.[1248]\Z")
_LONGEST = 4096


@dataclass(frozen=True, slots=True)
class Mapping:
    """One line: which axis, button or hat of a kind of pad is which control."""

    text: str
    guid: str
    name: str
    controls: Table[str, str]  # "leftx" → "a0", "dpup" → "h0.1"
    platform: str = ""  # empty: any


def user_file() -> Path:
    """Return where the user's own mappings are."""
    import platformdirs

    return Path(platformdirs.user_config_dir("fullswarm")) / FILE


def build(guid: str, name: str, controls: Table[str, str], platform: str) -> Mapping:
    """Return the mapping for a pad; commas in its name become spaces, since they part the fields."""
    plain = " ".join(re.sub(r"[,\x00-\x1f]", " ", name).split()) or "pad"
    fields = [guid, plain, *(f"{target}:{source}" for target, source in controls.items()), f"platform:{platform}"]
    return Mapping(",".join(fields) + ",", guid, plain, dict(controls), platform)


def parse(line: str) -> Mapping:
    """Read one line.

    Raises
    ------
    ValueError
        Says what is wrong with it.
    """
    if len(line) > _LONGEST:
        raise ValueError(f"is longer than {_LONGEST} characters")
    fields = [field.strip() for field in line.split(",")]
    if len(fields) < 3 or not _GUID.match(fields[0]):
        raise ValueError("does not begin with 32 hexadecimal digits, a comma and a name")
    controls, platform = dict[str, str](), ""
    for field in filter(None, fields[2:]):
        target, colon, source = field.partition(":")
        if not colon or not source:
            raise ValueError(f"'{field}' is not control:source")
        if target == "platform":
            platform = source
        elif target.lstrip("+-") in _TARGETS:
            if not _SOURCE.match(source):
                raise ValueError(f"'{source}' is no axis, button or hat (a0, b3, h0.1)")
            controls[target] = source
    return Mapping(line.strip(), fields[0], fields[1], controls, platform)


def read_file(path: Path) -> list[Mapping]:
    """Return the mappings of a file; none when there is no such file.

    Raises
    ------
    ConfigError
        All lines that are wrong, each with its number.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        return []
    except UnicodeDecodeError as error:
        raise ConfigError(f"is not UTF-8 text (byte {error.start})", where=str(path)) from None
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", where=str(path)) from None
    found, wrong = [], []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            found.append(parse(line))
        except ValueError as error:
            wrong.append(f"{path}:{number}: {error}")
    if wrong:
        raise ConfigError("\n".join(wrong))
    return found


def write_file(path: Path, made: Mapping) -> None:
    """Put a mapping into a file, in place of an older one for the same pad and platform.

    Raises
    ------
    ConfigError
        The file cannot be written.
    """
    try:
        before = path.read_text(encoding="utf-8-sig").splitlines() if path.exists() else []
        path.parent.mkdir(parents=True, exist_ok=True)
        _replace(path, [*(line for line in before if not _same_pad(line, made)), made.text])
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from None


def _same_pad(line: str, made: Mapping) -> bool:
    try:
        other = parse(line)
    except ValueError:
        return False
    return (other.guid.lower(), other.platform) == (made.guid.lower(), made.platform)


def _replace(path: Path, lines: Iterable[str]) -> None:
    """Write beside it, then rename: no reader sees half a file."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in lines)
        Path(name).replace(path)
    except OSError:
        Path(name).unlink(missing_ok=True)
        raise
