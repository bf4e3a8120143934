"""Reads TOML and explains what is wrong in it, with the line of each error: pydantic's errors in plain words.

Python's reader and tomlkit both forget the lines of what they read. The scanner here assumes a text that ``tomllib``
has accepted: it finds the parts and checks nothing.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from fullswarm.config.suggestions import number_in, other_unit, period, unknown_key
from fullswarm.errors import ConfigError, did_you_mean, nearest, without_login
from fullswarm.units import unit_of

KeyPath = tuple[str | int, ...]
"""Way to a value: names of tables and keys, numbers of list elements."""
S = TypeVar("S", bound=BaseModel)

_SYNTAX_AT = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_REPEATED = ("Cannot overwrite", "Cannot declare", "Duplicate inline table key", "Cannot mutate")
"""How the messages of ``tomllib`` begin for what stands twice."""
LONGEST_LINE = 80
"""Characters of a line that an error shows."""

MUST_BE = {
    "bool_parsing": "must be true or false",
    "bool_type": "must be true or false",
    "float_parsing": "must be a number",
    "float_type": "must be a number",
    "int_from_float": "must be a whole number",
    "int_parsing": "must be a whole number",
    "int_type": "must be a whole number",
    "finite_number": "must be a finite number",
    "string_type": "must be text in quotes",
    "path_type": "must be a file name in quotes",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
    "tuple_type": "must be a list",
}


def dotted(path: KeyPath) -> str:
    """Return a path as people write it: ``world.boxes[0][2]``."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def explain(error: ErrorDetails, schema: type[BaseModel], extra_keys: Sequence[str] = ()) -> tuple[KeyPath, str]:
    """Return where a pydantic error stands and what is wrong there.

    `extra_keys` are top-level keys that the file may hold although `schema` lacks them.
    """
    path: KeyPath = tuple(error["loc"])
    kind, given = error["type"], error["input"]
    if kind == "extra_forbidden":
        return path, _unknown_key(path, schema, extra_keys)
    if kind == "missing":
        if isinstance(path[-1], int):
            return path[:-1], f"has too few values: {len(given)}" if isinstance(given, Sequence) else "is too short"
        return path, "is missing"
    if kind == "too_long":
        context = error["ctx"]
        return path, f"has too many values: {context['actual_length']} instead of {context['max_length']}"
    if kind == "value_error":
        return path, str(error["ctx"]["error"])
    if kind == "tuple_type" and isinstance(given, dict):
        return path, f"must be a list: write [[{dotted(path)}]], with two brackets"
    if kind in MUST_BE:
        hint = number_in(str(path[-1]), given) if isinstance(given, str) and "number" in MUST_BE[kind] else ""
        return path, f"{MUST_BE[kind]}{_not(given)}{f': {hint}' if hint else ''}"
    if kind == "literal_error":
        choices = re.findall(r"'([^']*)'", error["ctx"]["expected"])
        return path, f"{_text(error)}{_not(given)}, {did_you_mean(str(given), choices)}"
    return path, _out_of_range(error, next((str(part) for part in reversed(path) if isinstance(part, str)), ""))


def _out_of_range(error: ErrorDetails, name: str) -> str:
    """Return what is wrong with a value, with its unit where it is too great: it may be one in another unit."""
    kind, given, context = error["type"], error["input"], error.get("ctx", {})
    unit = unit_of(name) if kind == "less_than_equal" else ""
    what = f"{_text(error)}{f' {unit}' if unit else ''}{_not(given)}"
    hint = ""
    if isinstance(given, int | float) and not isinstance(given, bool):
        if "le" in context or "lt" in context:
            hint = other_unit(name, given, float(context.get("le", context.get("lt", 0.0))))
        elif "ge" in context:
            hint = period(name, given, float(context["ge"]))
    return f"{what}: {hint}" if hint else what


def _unknown_key(path: KeyPath, schema: type[BaseModel], extra_keys: Sequence[str]) -> str:
    name, model = str(path[-1]), _model_at(schema, path[:-1])
    here = dotted(tuple(part for part in path[:-1] if isinstance(part, str)))
    known = [*model.model_fields, *(extra_keys if len(path) == 1 else ())]
    elsewhere = next((each for each in _sections_with(schema, name) if each != here), "")
    return unknown_key(name, known, model.__name__, elsewhere)


def _text(error: ErrorDetails) -> str:
    return error["msg"].replace("Input should be", "must be")


def _not(given: object) -> str:
    if isinstance(given, bool):
        return f", not {str(given).lower()}"
    if isinstance(given, str):
        given = without_login(given)
    return f", not {given!r}" if isinstance(given, int | float | str) else ""


def _model_of(annotation: Any) -> type[BaseModel] | None:
    """Return the model inside an annotation such as ``Model | None`` or ``tuple[Model, ...]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_model_of, get_args(annotation))), None)


def _sections(schema: type[BaseModel]) -> Iterator[tuple[str, type[BaseModel]]]:
    for name, field in schema.model_fields.items():
        model = _model_of(field.annotation)
        if model is not None:
            yield name, model


def _sections_with(schema: type[BaseModel], key: str) -> Iterator[str]:
    """Yield the tables that have `key`, or one that is spelt nearly so."""
    sections = dict(_sections(schema))
    yield from (name for name, model in sections.items() if key in model.model_fields)
    yield from (name for name, model in sections.items() if nearest(key, model.model_fields))


def _model_at(schema: type[BaseModel], path: KeyPath) -> type[BaseModel]:
    """Return the schema of the table at `path`."""
    model = schema
    for part in path:
        if isinstance(part, str):
            model = dict(_sections(model)).get(part, model)
    return model


# ------------------------------------------------------------ reading
def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Return the tables of TOML `text`; `where` names it in errors.

    Raises
    ------
    ConfigError
        Not TOML: ``where:line: what``.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise _syntax_error(text, where, str(error)) from None
    except RecursionError:
        raise ConfigError(f"{where}:1: not valid TOML: nested too deeply") from None


def _syntax_error(text: str, where: str, message: str) -> ConfigError:
    """Return the error for a text that ``tomllib`` refuses: where, what, the line itself and what to write."""
    what, at = _SYNTAX_AT.sub("", message), _SYNTAX_AT.search(message)
    lines = text.split("\n")
    number = len(lines) if at is None or at[1] is None else int(at[1])
    if what.startswith(_REPEATED) and (found := _repeated(text, where, number)):
        return ConfigError("\n".join(found))
    line = lines[number - 1].strip() if number <= len(lines) else ""
    shown = without_login(line)[:LONGEST_LINE]
    column = f", column {at[2]}" if at is not None and at[2] else ""
    place = f" in {shown!r}" if shown else ""
    return ConfigError(f"{where}:{number}: not valid TOML: {what}{column}{place}", hint=_syntax_hint(line, what))


def _repeated(text: str, where: str, most_line: int) -> list[str]:
    """Return a complaint for each key and table that stands twice, as far as the text can be read."""
    scanner = _Scanner(text)
    whole = False
    try:
        scanner.scan()
        whole = True
    except (ValueError, IndexError):
        pass  # further down is another mistake: only what stands above the reported line counts
    found = []
    tables = [path for path, *_, is_table in scanner.repeated if is_table]
    for path, first, again, is_table in scanner.repeated:
        inside = any(len(path) > len(table) and path[: len(table)] == table for table in tables)
        if (whole or again <= most_line) and not inside:
            name = dotted(tuple(part for part in path if isinstance(part, str))) if is_table else dotted(path)
            key = f"[{name}]" if is_table else name
            advice = (
                f"put its keys under one heading, or write [[{name}]] for each of several"
                if is_table
                else ("remove one of the two")
            )
            found.append(f"{where}:{again}: {key}: stands twice, first in line {first}: {advice}")
    return found


_SYNTAX_HINTS = (
    (re.compile(r"[“”„‘’]"), 'write straight quotes: "text"'),
    (re.compile(r"=\s*(?:True|False)\b"), "write true or false, in small letters"),
    (re.compile(r"=\s*(?:None|null|nil)\b"), "leave out what has no value"),
    (re.compile(r"^\s*(?://|;|--)"), "a comment begins with #"),
    (re.compile(r"^[\w.-]+\s*:"), "write key = value, with an equals sign"),
    (re.compile(r"=\s*[\d.]+\s*[A-Za-z%°]"), "write the number alone: the key's name says its unit"),
    (re.compile(r"=\s*\.\d"), "write a digit before the point: 0.5"),
    (re.compile(r"=\s*\d+,\d"), "write a decimal point: 0.5"),
    (re.compile(r"=\s*[A-Za-z/]"), "text goes in quotes"),
    (re.compile(r"=\s*$"), "write a value behind the equals sign"),
)


def _syntax_hint(line: str, what: str) -> str:
    """Return what to write in place of a line that is not TOML; empty: unknown."""
    if "Illegal character '\\n'" in what:
        return "is a quote not closed in that line?"
    if "Unclosed" in what or not line:
        return "is a bracket not closed?" if "Unclosed" in what else ""
    return next((hint for pattern, hint in _SYNTAX_HINTS if pattern.search(line)), "")


def read_toml(path: Path, kind: str) -> str:
    """Return the text of a TOML file that a person names; `kind` says what it is: "fleet file".

    Raises
    ------
    ConfigError
        It is missing, cannot be read, or is not UTF-8: with the line of the first such byte.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        near = sorted(each.name for each in path.parent.glob("*.toml")) if path.parent.is_dir() else []
        there = f"in that folder: {', '.join(near[:5])}" if near else f"give the path of a {kind} (TOML)"
        raise ConfigError("no such file", where=str(path), hint=there) from None
    except UnicodeDecodeError as error:
        line = path.read_bytes()[: error.start].count(b"\n") + 1
        what = f"is not UTF-8 text (byte {error.start} of the file)"
        raise ConfigError(what, where=f"{path}:{line}", hint="save it as UTF-8 in the editor") from None
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", where=str(path)) from None


def parse_section(
    text: str,
    where: str,
    schema: type[S],
    explained: Callable[[ErrorDetails, type[BaseModel]], tuple[KeyPath, str]] = explain,
) -> S:
    """Return the settings that TOML `text` describes; `where` names it in errors, `explained` replaces `explain`.

    Raises
    ------
    ConfigError
        Not TOML, or not such settings: all errors, sorted by line: ``where:line: key: what``.
    """
    data = parse_toml(text, where)
    try:
        return validated(schema, data)
    except ValidationError as error:
        lines, found = line_numbers(text), set[tuple[int, str]]()
        for details in own_errors(error.errors(include_url=False)):
            path, what = explained(details, schema)
            line = next((lines[path[:end]] for end in range(len(path), 0, -1) if path[:end] in lines), 0)
            place = f"{where}:{line}" if line else where
            found.add((line, f"{place}: {dotted(path)}: {what}" if path else f"{place}: {what}"))
        raise ConfigError("\n".join(complaint for _, complaint in sorted(found))) from None


def validated(schema: type[S], data: object) -> S:
    """Return `data` as settings; raises pydantic's `ValidationError`."""
    # JSON mode is strict (no "5" or true for 5) and yet takes lists for tuples and text for paths.
    return schema.model_validate_json(json.dumps(data, default=str), strict=True)


def own_errors(errors: list[ErrorDetails]) -> list[ErrorDetails]:
    """Leave out lists that are too short only because what stands in them is wrong, and so was not counted."""
    paths = [each["loc"] for each in errors]

    def holds_another(path: tuple[int | str, ...]) -> bool:
        return any(len(other) > len(path) and other[: len(path)] == path for other in paths)

    return [each for each in errors if each["type"] != "too_short" or not holds_another(each["loc"])]


# ------------------------------------------------------------ lines of a text
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
        self._written: dict[KeyPath, int] = {}  # keys with a value, tables with a heading
        self.repeated: list[tuple[KeyPath, int, int, bool]] = []
        """What stands twice, which is not TOML: path, first line, second line, whether it is a table."""

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
            if path in self._written:  # [robot] above [[robot]]
                self.repeated.append((path, self._written[path], self._line, True))
            self._elements[path] = self._elements.get(path, 0) + 1
            self._lines.setdefault(path, self._line)
        path = self._newest(path)
        self._write(path, is_table=True)
        self._lines[path] = self._line
        self._skip_blank()
        self._at += brackets
        return path

    def _write(self, path: KeyPath, *, is_table: bool) -> None:
        if path in self._written:
            self.repeated.append((path, self._written[path], self._line, is_table))
        else:
            self._written[path] = self._line

    def _newest(self, path: KeyPath) -> KeyPath:
        count = self._elements.get(path)
        return path if count is None else (*path, count - 1)

    def _key_value(self, table: KeyPath) -> None:
        path = table
        for part in self._dotted_key():
            path = (*path, part)
            self._lines.setdefault(path, self._line)
        self._write(path, is_table=False)
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
