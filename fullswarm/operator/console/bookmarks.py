"""Bookmarks: moments with a name, kept beside a recording or as long as the console runs."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from pathlib import Path

import msgspec
import structlog

from fullswarm.files import replace_file

FORMAT = "fullswarm.bookmarks/1"
MOST = 200
LARGEST_FILE = 1_000_000

log = structlog.get_logger()


class Bookmark(msgspec.Struct, frozen=True, kw_only=True):
    """A moment with a name; `time_s` is in seconds since 1970, so that it holds for a session and its recording."""

    id: str
    time_s: float
    name: str
    by: str = ""


class _File(msgspec.Struct, frozen=True, kw_only=True):
    format: str
    bookmarks: tuple[Bookmark, ...] = ()


class Bookmarks:
    """The bookmarks of a session or of a recording.

    Parameters
    ----------
    recording : returns the recording beside which they are kept now; None: there is none
    """

    def __init__(self, recording: Callable[[], Path | None]) -> None:
        self._recording = recording
        self._marks: list[Bookmark] = list(read(recording()))

    def add(self, time_s: float, name: str, by: str) -> str:
        """Add one; return why that is not possible, or empty."""
        if len(self._marks) >= MOST:
            return f"there are {MOST} bookmarks already: delete one first"
        self._marks.append(Bookmark(id=secrets.token_hex(8), time_s=time_s, name=name, by=by))
        self._marks.sort(key=lambda mark: mark.time_s)
        return self._write()

    def delete(self, mark: str) -> str:
        """Delete one; return why that is not possible, or empty."""
        kept = [each for each in self._marks if each.id != mark]
        if len(kept) == len(self._marks):
            return "this bookmark is gone already"
        self._marks = kept
        return self._write()

    def shown(self, now_s: float, wall_s: float) -> list[dict[str, object]]:
        """Return them in the order of time, on the clock of the frames.

        Parameters
        ----------
        now_s, wall_s : the same moment on the clock of the frames, and in seconds since 1970
        """
        return [
            {"id": each.id, "at": round(each.time_s - wall_s + now_s, 3), "name": each.name, "by": each.by}
            for each in self._marks
        ]

    def _write(self) -> str:
        recording = self._recording()
        if recording is None:
            return ""
        file = file_of(recording)
        text = msgspec.json.format(msgspec.json.encode(_File(format=FORMAT, bookmarks=tuple(self._marks))))
        try:
            replace_file(file, text, mode=0o600)
        except OSError as error:
            return f"kept until this console ends, not in {file.name}: {error.strerror or error}"
        return ""


def file_of(recording: Path) -> Path:
    """Return the file of a recording's bookmarks: ``run.bookmarks.json`` beside ``run.mcap``."""
    return recording.with_name(f"{recording.stem}.bookmarks.json")


def read(recording: Path | None) -> tuple[Bookmark, ...]:
    """Return the bookmarks beside a recording; none if there is no file, or if it is damaged, which is logged."""
    if recording is None:
        return ()
    file = file_of(recording)
    try:
        if file.stat().st_size > LARGEST_FILE:
            raise msgspec.DecodeError("it is too large")
        found = msgspec.json.decode(file.read_bytes(), type=_File)
        if found.format != FORMAT:
            raise msgspec.DecodeError(f"its format is '{found.format}'")
    except FileNotFoundError:
        return ()
    except (OSError, msgspec.DecodeError, UnicodeDecodeError) as error:
        log.warning("bookmarks are not read", file=str(file), reason=str(error))
        return ()
    return found.bookmarks[:MOST]
