"""Parses ``key=value`` and values of a command line."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from fullswarm.errors import ConfigError

PICTURE_ENDINGS = (".png", ".jpg", ".jpeg", ".gif", ".bmp", ".webp")

if TYPE_CHECKING:
    from fullswarm.messages import Needs, Value


def parse_parameters(options: Iterable[str], where: str = "--set") -> dict[str, Value]:
    """Return the parameters that ``--set key=value`` options give; `where` is how an error names the option.

    Raises
    ------
    ConfigError
        No equals sign, a key twice, or a value that no parameter can have; says which.
    """
    found: dict[str, Value] = {}
    for option in options:
        key, equals, raw = option.partition("=")
        key = key.strip()
        if not equals or not key:
            raise ConfigError(
                f"'{option}' is not key=value", where=where, hint=f"e.g. {where} speed=0.3".replace("parameters ", "")
            )
        if key in found:
            raise ConfigError("is given twice", where=f"{where} {key}")
        found[key] = parse_value(raw, where=f"{where} {key}")
    return found


def parse_needs(options: Iterable[str]) -> Needs:
    """Return what ``--needs key=value`` options need; lists are separated by commas.

    Raises
    ------
    ConfigError
        No such key, or a value that it cannot have.
    """
    from fullswarm.fitness import needs_of

    found: dict[str, Any] = {}
    for option in options:
        key, _, raw = option.partition("=")
        names = key.strip() in ("capabilities", "makes")
        found[key.strip()] = _words(raw) if names else parse_stored(raw, where=f"--needs {key.strip()}")
    return needs_of(found, where="--needs")


def parse_roles(options: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Return the roles that ``--role role=a,@b,+c`` options give.

    Raises
    ------
    ConfigError
        No equals sign, or nothing after it.
    """
    found: dict[str, tuple[str, ...]] = {}
    for option in options:
        role, _, raw = option.partition("=")
        names = _words(raw)
        if not role.strip() or not names:
            raise ConfigError(f"'{option}' gives no role", where="--role", hint="e.g. --role carrier=r1,+gripper")
        found[role.strip()] = (*found.get(role.strip(), ()), *names)
    return found


def _words(raw: str) -> tuple[str, ...]:
    return tuple(word for each in raw.split(",") if (word := each.strip()))


def parse_value(raw: str, where: str = "") -> Value:
    """Read ``1.5``, ``true``, ``[1, 2]``, ``5,5`` (a point), ``"text"``, a bare word, or ``@heart.png``: dark points.

    Raises
    ------
    ConfigError
        Not finite, empty, a table, or a list of something else than numbers and points.
    """
    if raw.startswith("@") and raw.lower().endswith(PICTURE_ENDINGS):
        from fullswarm.evaluate.pictures.ink import dark_points

        return cast("Value", dark_points(Path(raw[1:]).expanduser()))
    value = parse_stored(raw, where)
    if isinstance(value, list):
        if not value or not all(_is_number(item) or _is_point(item) for item in value):
            raise ConfigError(f"'{raw}' is not a list of numbers or points", where=where, hint="e.g. [1, 2.5]")
    elif not isinstance(value, bool | int | float | str):
        raise ConfigError(f"'{raw}' cannot be a parameter", where=where, hint="flag, number, word, point or list")
    return cast("Value", value)


def parse_stored(raw: str, where: str = "") -> Any:
    """Read a value for a local database: as for parameters, and JSON objects and null too.

    Raises
    ------
    ConfigError
        Empty, not finite, or brackets and quotes that do not match.
    """
    text = raw.strip()
    if not text:
        raise ConfigError("has no value", where=where)
    value = _read(text)
    if not _is_finite(value):
        raise ConfigError(f"'{text}' is not finite", where=where)
    if isinstance(value, str) and value == text and text[0] in "[{\"'":
        raise ConfigError(f"'{text}' does not end", where=where, hint="check brackets and quotes")
    return value


def _read(text: str) -> Any:
    readings = [text]
    if "," in text and text[0] not in "{\"'":
        readings.append(f"[{text}]")  # a point without its brackets, which a shell would want quoted
    for reading in readings:
        try:
            return json.loads(reading)
        except ValueError:
            pass
        try:
            table = tomllib.loads(f"v = {reading}")
        except ValueError:
            continue
        if list(table) == ["v"] and isinstance(table["v"], bool | int | float | str | list):
            return table["v"]
    return text


def _is_number(item: object) -> bool:
    return isinstance(item, int | float) and not isinstance(item, bool)


def _is_point(item: object) -> bool:
    return isinstance(item, list) and len(item) > 0 and all(map(_is_number, item))


def _is_finite(value: object) -> bool:
    if isinstance(value, list | dict):
        return all(map(_is_finite, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or math.isfinite(value)
