"""pydantic's complaints in plain words: which key, what is wrong, what was probably meant."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from fullswarm.config.positions import KeyPath
from fullswarm.errors import did_you_mean, nearest
from fullswarm.units import unit_of

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
