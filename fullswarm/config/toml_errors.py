"""Reads TOML and explains what is wrong in it, with the line of each error: pydantic's errors in plain words.

Python's reader and tomlkit both forget the lines of what they read. The scanner here assumes a text that ``tomllib``
has accepted: it finds the parts and checks nothing.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from fullswarm.errors import ConfigError, did_you_mean, nearest, without_login
from fullswarm.units import unit_of

KeyPath = tuple[str | int, ...]
"""Way to a value: names of tables and keys, numbers of list elements."""
S = TypeVar("S", bound=BaseModel)

_SYNTAX_AT = re.compile(r" \(at (?:line (\d+), column \d+|end of document)\)$")

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
    if kind in MUST_BE:
        return path, f"{MUST_BE[kind]}{_not(given)}"
    if kind == "literal_error":
        choices = re.findall(r"'([^']*)'", error["ctx"]["expected"])
        return path, f"{_text(error)}{_not(given)}, {did_you_mean(str(given), choices)}"
    # A radius of 3000 was meant in millimetres.
    unit = unit_of(str(path[-1])) if kind == "less_than_equal" else ""
    return path, f"{_text(error)}{f' {unit}' if unit else ''}{_not(given)}"


def _unknown_key(path: KeyPath, schema: type[BaseModel], extra_keys: Sequence[str]) -> str:
    name = str(path[-1])
    known = [*_fields(schema, path[:-1]), *(extra_keys if len(path) == 1 else ())]
    if not nearest(name, known):
        for section in _sections_with(schema, name):
            if section != dotted(path[:-1]):
                return f"unknown key here, it belongs in [{section}]"
    return f"unknown key, {did_you_mean(name, known)}"


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
    return (name for name, model in _sections(schema) if key in model.model_fields)


def _fields(schema: type[BaseModel], path: KeyPath) -> Mapping[str, object]:
    """Return the fields of the table at `path`."""
    model = schema
    for part in path:
        if isinstance(part, str):
            model = dict(_sections(model)).get(part, model)
    return model.model_fields


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
        what, at = str(error), _SYNTAX_AT.search(str(error))
        line = text.count("\n") + 1 if at is None or at[1] is None else int(at[1])
        hint = "is a quote not closed in that line?" if "Illegal character '\\n'" in what else ""
        raise ConfigError(f"{where}:{line}: not valid TOML: {_SYNTAX_AT.sub('', what)}", hint=hint) from None
    except RecursionError:
        raise ConfigError(f"{where}:1: not valid TOML: nested too deeply") from None


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
