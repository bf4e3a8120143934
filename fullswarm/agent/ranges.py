"""What a control request may ask: checked on board too, because any sender on the bus can send one.

The ranges are those of the behaviours' records, from the files that are installed on the robot's computer: a law takes
what one of its records allows. A parameter that no record knows, such as the target that a core works out of a
formation, need only be a number that can be.
"""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from fullswarm import registry
from fullswarm.config.models import EXPIRES_S, HEARING_M
from fullswarm.config.parameter import FILTER, Parameter
from fullswarm.errors import ConfigError
from fullswarm.messages import ControlRequest, Value

RECORDS = Path(__file__).parents[1] / "core" / "behaviours.toml"

GREATEST = 1e7
"""Of a number that no record knows: no coordinate, speed or weight is larger."""
LONGEST = 1000
"""Of a word that no record knows, in characters."""

OWN = {**FILTER, "hearing_m": Parameter(type="number", unit="m", min=HEARING_M[0], max=HEARING_M[1])}
"""Parameters that the agent itself reads, whatever the law."""

Allowed = Mapping[str, tuple[Parameter, ...]]


def check(request: ControlRequest) -> None:
    """Let a request pass that a robot may run.

    Raises
    ------
    ConfigError
        A parameter has another type than its record says or is out of range, or the request would never lapse; says
        which and what is wanted.
    """
    low_s, high_s = EXPIRES_S
    if not math.isfinite(request.stamp_s):  # or an intent would never lapse
        raise ConfigError(f"stamp_s = {request.stamp_s} is no time")
    if not low_s <= request.expires_s <= high_s:
        raise ConfigError(f"expires_s = {request.expires_s:g} is outside [{low_s:g}, {high_s:g}] s")
    spans, allowed = _known(request.law)
    for name, value in request.parameters.items():
        low, high = spans.get(name, (-GREATEST, GREATEST))
        if type(value) is float and low <= value <= high:  # what a stick sends twenty times a second
            continue
        try:
            _fits(name, value, OWN.get(name), allowed.get(name, ()))
        except ValueError as error:
            raise ConfigError(f"the robot refuses {error}") from None


def _fits(name: str, value: Value, own: Parameter | None, allowed: tuple[Parameter, ...]) -> None:
    """Raise the ``ValueError`` of the first record when no record allows the value."""
    if own is not None:
        own.check(name, value)
    elif not allowed:
        _can_be(name, value)
    problem: ValueError | None = None
    for parameter in allowed:
        try:
            parameter.check(name, value)
        except ValueError as error:
            problem = problem or error
        else:
            return
    if problem is not None:
        raise problem


def _can_be(name: str, value: Value | list[float]) -> None:
    """Raise a ``ValueError`` for what cannot be a parameter of any law."""
    if isinstance(value, list):
        for each in value:
            _can_be(name, each)
    elif isinstance(value, str):
        if len(value) > LONGEST:
            raise ValueError(f"{name}: a word of {len(value)} letters")
    elif not abs(value) <= GREATEST:
        raise ValueError(f"{name} = {value:g} is not a number within ±{GREATEST:g}")


@functools.cache
def _known(law: str) -> tuple[dict[str, tuple[float, float]], Allowed]:
    """Return what a law's records say of each parameter: floats that need no further look, and the whole."""
    allowed: dict[str, tuple[Parameter, ...]] = {}
    for name, parameter in _parameters(law):
        if parameter not in allowed.get(name, ()):
            allowed[name] = (*allowed.get(name, ()), parameter)
    spans = {name: (max(low for low, _ in each), min(high for _, high in each)) for name, each in _spans(allowed)}
    return spans, allowed


def _spans(allowed: Allowed) -> Iterator[tuple[str, list[tuple[float, float]]]]:
    for name in {**allowed, **OWN}:
        own = [OWN[name].span] if name in OWN else []
        yield name, [*own, *(each.span for each in allowed.get(name, ()))]


def _parameters(law: str) -> Iterator[tuple[str, Parameter]]:
    tables = _tables()
    for record in tables.values():
        if law and _inherited(tables, record, "law") == law:
            for name, raw in _merged(tables, record).items():
                try:
                    yield name, Parameter.model_validate(raw)
                except ValidationError:  # the core says what is wrong with it
                    continue


@functools.cache
def _tables() -> dict[str, dict[str, Any]]:
    """Return the records that are installed here; a file that cannot be read says nothing."""
    tables: dict[str, Any] = {}
    for file in (*registry.record_files(), RECORDS):
        try:
            tables |= tomllib.loads(file.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
            continue
    return {name: each for name, each in tables.items() if isinstance(each, dict)}


def _lineage(tables: Mapping[str, dict[str, Any]], record: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a record and those that it is like, the nearest first; each once."""
    line = [record]
    while (base := tables.get(str(line[-1].get("like")))) is not None and base not in line:
        line.append(base)
    return line


def _inherited(tables: Mapping[str, dict[str, Any]], record: dict[str, Any], key: str) -> object:
    return next((each[key] for each in _lineage(tables, record) if key in each), None)


def _merged(tables: Mapping[str, dict[str, Any]], record: dict[str, Any]) -> dict[str, Any]:
    merged: dict[str, Any] = {}
    for each in reversed(_lineage(tables, record)):
        parameters = each.get("parameters")
        merged |= parameters if isinstance(parameters, dict) else {}
    return merged
