"""Checks names and private files: whether others can read them, whether they are whole."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.keys import ROBOT_ID
from fullswarm.portability import seen_by_others

LONGEST_NAME = 53
"""Characters; a common name has room for 64, and a generation follows the name."""
_PEM = re.compile(rb"-----BEGIN ([A-Z ]+)-----\r?\n[A-Za-z0-9+/=\r\n]+-----END \1-----\s*\Z")


def check_name(name: str) -> None:
    """Refuse a name that is no plain chunk of a key, or too long for a certificate.

    Raises
    ------
    ConfigError
        It is not valid.
    """
    if not ROBOT_ID.match(name) or len(name) > LONGEST_NAME:
        hint = f"use letters, digits, '-' and '_', {LONGEST_NAME} at most"
        raise ConfigError(f"'{name:.80}' cannot be the name in a certificate", hint=hint)


def check_private(path: Path) -> None:
    """Refuse a file or folder that other users may read or write, as SSH does.

    Raises
    ------
    ConfigError
        They may.
    """
    with usable(path.parent, path):
        mode = path.stat().st_mode
    if seen_by_others(mode):
        hint = f"chmod {'700' if path.is_dir() else '600'} '{path}'"
        raise ConfigError("other users can read this, and it is private", where=str(path), hint=hint)


def read_pem(path: Path, hint: str = "") -> bytes:
    """Return the content of a private file of one PEM block.

    Raises
    ------
    ConfigError
        It is missing, incomplete, or readable by others; `hint` says what replaces it.
    """
    hint = hint or "`fullswarm keys issue` on the base station replaces it; `fullswarm deploy` that of a robot"
    try:
        check_private(path)
        with usable(path.parent, path):
            content = path.read_bytes()
    except FileNotFoundError as error:
        raise ConfigError("this file is missing", where=str(path), hint=hint) from error
    if not _PEM.fullmatch(content.strip() + b"\n"):
        raise ConfigError("this file is incomplete or damaged", where=str(path), hint=hint)
    return content


@contextmanager
def usable(folder: Path, writing: Path | None = None) -> Iterator[None]:
    """Report which file of `folder` this user may not read or write, such as one that `sudo fullswarm` left.

    Parameters
    ----------
    writing
        The file that an error without a name is about.

    Raises
    ------
    ConfigError
        Instead of an OSError about a file of `folder`, unless the file is missing.
    """
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as error:
        file = Path(os.fsdecode(error.filename)) if error.filename else writing
        if file is None or not file.is_relative_to(folder):
            raise
        hint = f"sudo chown -R \"$USER\" '{folder}'" if isinstance(error, PermissionError) else ""
        what = f"cannot be read or written: {(error.strerror or str(error)).lower()}"
        raise ConfigError(what, where=str(file), hint=hint) from error
