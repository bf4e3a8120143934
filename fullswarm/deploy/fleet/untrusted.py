"""What a robot says is bytes from a stranger: bounded, read strictly, without control characters."""

from __future__ import annotations

import unicodedata
from typing import TypeVar

import msgspec

from fullswarm.errors import MessageError

T = TypeVar("T")
LINE = 300
"""Characters of a robot's words that fit into a message."""


def clean(said: bytes | str, limit: int = LINE) -> str:
    """One printable line: no escape sequences, no bidirectional tricks, at most `limit` characters."""
    text = said.decode("utf-8", "replace") if isinstance(said, bytes) else said
    # Cut before the slow part: a robot that sends 100 MB takes no more of our time than one that sends a line.
    words = "".join(_printable(each) for each in text[: 4 * limit]).split()
    line = " ".join(words)
    return line if len(line) <= limit else line[: limit - 1] + "…"


def clean_log_line(said: bytes) -> str:
    """One line of a log with its spaces, at most 4000 characters of it."""
    return "".join(_printable(each) for each in said.decode("utf-8", "replace").rstrip("\r\n")[:4000])


def last_words(said: bytes) -> str:
    """What the last line that is not empty says: programs put what went wrong there."""
    # Not at \r, with which some programs end lines in the midst of ours.
    lines = [line for line in said[-8192:].split(b"\n") if line.strip(b" \r\t)")]
    return clean(lines[-1]) if lines else ""


def strict_json(said: bytes, kind: type[T], robot: str) -> T:
    """Read JSON into a typed struct.

    Raises
    ------
    MessageError
        It is not JSON, or not of this shape.
    """
    try:
        return msgspec.json.decode(said, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        hint = "another program in its place, or another version: `fullswarm deploy` puts ours there"
        raise MessageError(f"its answer cannot be read: {clean(str(error))}", where=robot, hint=hint) from None


def _printable(character: str) -> str:
    # Cc: escape sequences; Cf: right-to-left marks; Co, Cs, Zl, Zp: nothing a terminal should be handed.
    if character == "\t":
        return " "
    return " " if unicodedata.category(character) in ("Cc", "Cf", "Co", "Cs", "Zl", "Zp") else character
