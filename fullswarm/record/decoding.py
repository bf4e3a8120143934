"""Reads recorded messages back: JSON as the recorder writes it, in which a number that is not finite is null."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from typing import Any

import msgspec
from msgspec import inspect

from fullswarm.identity.access import TOPICS
from fullswarm.messages import Message
from fullswarm.record.table import SCHEMA
from fullswarm.schemas import tag_of

PREFIX = "fullswarm."


class Decoder:
    """Decodes the messages of one swarm's recordings.

    Attributes
    ----------
    unread : messages that this version does not know, or that are malformed
    """

    def __init__(self) -> None:
        self.unread = 0
        kinds = {kind for topic in TOPICS for kind in topic.messages}
        self._decoders = {PREFIX + tag_of(kind): msgspec.json.Decoder(kind) for kind in kinds}
        self._kinds = {PREFIX + tag_of(kind): kind for kind in kinds}

    def knows(self, schema: str) -> bool:
        """Return whether channels of a schema hold messages of the bus; `/robots` is made by the recorder."""
        return schema.startswith(PREFIX) and schema != SCHEMA.name

    def decode(self, schema: str, data: bytes) -> Message | None:
        """Return a message; None: of another version, or malformed."""
        decoder = self._decoders.get(schema)
        if decoder is None:
            self.unread += 1
            return None
        try:
            return decoder.decode(data)
        except (msgspec.ValidationError, UnicodeDecodeError):
            return self._filled(schema, data)
        except (msgspec.DecodeError, RecursionError):
            self.unread += 1
            return None

    def _filled(self, schema: str, data: bytes) -> Message | None:
        """Read a message once more, with NaN for each null in place of a number."""
        kind = self._kinds[schema]
        try:
            return msgspec.convert(_fill(msgspec.json.decode(data), inspect.type_info(kind)), kind)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            self.unread += 1
            return None


def _fill(value: Any, kind: inspect.Type) -> Any:
    if value is None:
        return math.nan if isinstance(kind, inspect.FloatType) else None
    match kind:
        case inspect.StructType() if isinstance(value, dict):
            fields = _fields(kind.cls)
            return {name: _fill(each, fields[name]) if name in fields else each for name, each in value.items()}
        case inspect.ListType() | inspect.VarTupleType() | inspect.SetType() if isinstance(value, list):
            return [_fill(each, kind.item_type) for each in value]
        case inspect.TupleType() if isinstance(value, list):
            return [_fill(each, its) for each, its in zip(value, kind.item_types, strict=False)]
        case inspect.DictType() if isinstance(value, dict):
            return {name: _fill(each, kind.value_type) for name, each in value.items()}
        case inspect.UnionType():
            return _fill(value, _likely(kind.types, value))
        case _:
            return value


@functools.cache
def _fields(kind: type) -> dict[str, inspect.Type]:
    found = inspect.type_info(kind)
    assert isinstance(found, inspect.StructType)  # noqa: S101  (narrows the type: only those are asked for)
    return {field.encode_name: field.type for field in found.fields}


def _likely(kinds: Iterable[inspect.Type], value: Any) -> inspect.Type:
    """Return the type of a union that holds a value of this shape."""
    shapes: dict[type, tuple[type, ...]] = {
        dict: (inspect.StructType, inspect.DictType),
        list: (inspect.ListType, inspect.VarTupleType, inspect.TupleType, inspect.SetType),
    }
    fits = shapes.get(type(value), ())
    return next((each for each in kinds if isinstance(each, fits)), inspect.AnyType())
