"""Where things stand in a TOML file. Python's reader and tomlkit both forget the lines of what they read.

The scanner assumes a text that ``tomllib`` has accepted: it only has to find the parts, not to judge them.
"""

from __future__ import annotations

import re
import tomllib

KeyPath = tuple[str | int, ...]
"""Way to a value: names of tables and keys, numbers of list elements."""

_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_SCALAR = re.compile(
    r'"""(?:\\.|[^\\])*?"""(?:"{0,2})|\'\'\'.*?\'\'\'(?:\'{0,2})'  # multi-line: up to two quotes may touch the end
    r"|\"(?:\\.|[^\"\\])*\"|'[^']*'|[^,\]}#\n]+",
    re.DOTALL,
)
_KEY = re.compile(r"\"(?:\\.|[^\"\\])*\"|'[^']*'|[A-Za-z0-9_-]+")
_DOT = re.compile(r"[ \t]*\.[ \t]*")


def line_numbers(text: str) -> dict[KeyPath, int]:
    """Return the line (from 1) of every table, key and list element of a valid TOML text."""
    return _Scanner(text).scan()


class _Scanner:
    def __init__(self, text: str) -> None:
        self._text, self._at, self._line = text, 0, 1
        self._lines: dict[KeyPath, int] = {}
        self._elements: dict[KeyPath, int] = {}  # how many [[name]] so far

    def scan(self) -> dict[KeyPath, int]:
        table: KeyPath = ()
        while self._skip_blank():
            if self._text.startswith("[[", self._at):
                table = self._header(2)
            elif self._text[self._at] == "[":
                table = self._header(1)
            else:
                self._key_value(table)
        return self._lines

    def _take(self, pattern: re.Pattern[str]) -> str:
        found = pattern.match(self._text, self._at)
        if found is None:  # only for a text that is not TOML
            raise ValueError(f"line {self._line}: not TOML")
        self._at = found.end()
        self._line += found.group().count("\n")
        return found.group()

    def _skip_blank(self) -> bool:
        self._take(_BLANK)
        return self._at < len(self._text)

    def _dotted_key(self) -> list[str]:
        parts = []
        while True:
            raw = self._take(_KEY)
            parts.append(str(tomllib.loads(f"k = {raw}")["k"]) if raw[0] in "\"'" else raw)
            if not _DOT.match(self._text, self._at):
                return parts
            self._take(_DOT)

    def _header(self, brackets: int) -> KeyPath:
        self._at += brackets
        self._skip_blank()
        *parents, name = self._dotted_key()
        path: KeyPath = ()
        for parent in parents:
            path = self._newest((*path, parent))
            self._lines.setdefault(path, self._line)
        path = (*path, name)
        if brackets == 2:
            self._elements[path] = self._elements.get(path, 0) + 1
            self._lines.setdefault(path, self._line)
        path = self._newest(path)
        self._lines[path] = self._line
        self._skip_blank()
        self._at += brackets
        return path

    def _newest(self, path: KeyPath) -> KeyPath:
        count = self._elements.get(path)
        return path if count is None else (*path, count - 1)

    def _key_value(self, table: KeyPath) -> None:
        path = table
        for part in self._dotted_key():
            path = (*path, part)
            self._lines.setdefault(path, self._line)
        self._skip_blank()
        self._at += 1  # the equals sign
        self._skip_blank()
        self._value(path)

    def _value(self, path: KeyPath) -> None:
        self._lines.setdefault(path, self._line)
        opening = self._text[self._at]
        if opening not in "[{":
            self._take(_SCALAR)
            return
        self._at += 1
        closing = "]" if opening == "[" else "}"
        index = 0
        while self._skip_blank() and self._text[self._at] != closing:
            if opening == "[":
                self._value((*path, index))
                index += 1
            else:
                self._key_value(path)
            self._skip_blank()
            if self._text.startswith(",", self._at):
                self._at += 1
        self._at += 1
