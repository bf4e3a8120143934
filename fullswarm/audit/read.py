"""Reads the entries of an audit log: all of them, those that a filter selects, and new ones as they are added."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from fullswarm.errors import ConfigError

Entry = dict[str, Any]
_AGO = re.compile(r"([0-9]+(?:\.[0-9]+)?)([smhd])\Z")
_SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400}


@dataclass(frozen=True, slots=True)
class Selection:
    """Which entries are wanted; what is None or empty selects all."""

    since: datetime | None = None
    robot: str = ""
    operator: str = ""

    def wants(self, entry: Entry) -> bool:
        """Tell whether an entry is selected. One that names no robot concerns all of them."""
        robots, operator = entry.get("robots"), str(entry.get("operator", ""))
        if self.robot and robots and self.robot not in robots:
            return False
        by = str(entry.get("source", "")).rpartition(":")[2]  # of a stop, which has no operator: console@desk:1/1:anna
        if self.operator and self.operator not in (operator, operator.partition("@")[0], by):
            return False
        return self.since is None or _time_of(entry) >= self.since


def since(text: str, now: datetime) -> datetime:
    """Return the time of ``30s``, ``10m``, ``2h``, ``1d`` (before `now`), or of a date and time.

    Raises
    ------
    ConfigError
        It is none of these.
    """
    match = _AGO.match(text)
    try:
        if match is not None:
            return now - timedelta(seconds=float(match[1]) * _SECONDS[match[2]])
        when = datetime.fromisoformat(text)
    except (ValueError, OverflowError):
        hint = "expected 30s, 10m, 2h, 1d, or a time such as 2026-11-25T14:30"
        raise ConfigError(f"invalid time '{text}'", where="--since", hint=hint) from None
    return when if when.tzinfo else when.astimezone()


class Reader:
    """Reads a log from its start, then what is added.

    Raises
    ------
    ConfigError
        There is no log in that folder, or it may not be read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._done: dict[str, int] = {}  # file → bytes that were read
        if not self._files():
            hint = "name the folder of the log; `core.audit` of the fleet file says where it is"
            raise ConfigError("there is no audit log", where=str(folder), hint=hint)

    def read(self) -> Iterator[Entry]:
        """Yield the entries that were not read before, in the order of the files; what is no entry is left out."""
        for path in self._files():
            start = self._done.get(path.name, 0)
            try:
                with path.open("rb") as stream:
                    stream.seek(start)
                    for line in stream:
                        if not line.endswith(b"\n"):
                            break  # being written
                        start += len(line)
                        self._done[path.name] = start
                        if (entry := _entry(line)) is not None:
                            yield entry
            except FileNotFoundError:
                continue  # its writer has removed the oldest file meanwhile

    def _files(self) -> list[Path]:
        try:
            return sorted(path for path in self._folder.iterdir() if path.suffix == ".jsonl" and path.stem.isdecimal())
        except FileNotFoundError:
            return []
        except OSError as error:
            raise ConfigError(f"cannot be read: {error.strerror}", where=str(self._folder)) from error


def _entry(line: bytes) -> Entry | None:
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) else None


def _time_of(entry: Entry) -> datetime:
    try:
        return datetime.fromisoformat(str(entry.get("time")))
    except ValueError:
        return datetime.min.replace(tzinfo=UTC)
