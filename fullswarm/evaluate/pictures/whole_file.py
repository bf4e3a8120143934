"""Files that appear whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fullswarm.errors import ConfigError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a path beside `path` with the same ending, to write to; at the end it takes its place.

    Raises
    ------
    ConfigError
        The file cannot be written. Nothing half done is left, whatever happens.
    """
    beside = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        try:
            beside.touch()  # what cannot be written is known before the work is done
            yield beside
            beside.replace(path)
        except OSError as error:
            raise ConfigError(f"cannot write it: {error.strerror or error}", where=str(path)) from error
    finally:
        beside.unlink(missing_ok=True)
