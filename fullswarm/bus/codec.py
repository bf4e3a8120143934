"""Encodes and decodes messages as MessagePack; errors name what does not fit.

A decoded message is of its type, within the ranges of the type's annotations, and has columns of equal length: a
reader need not check again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec

from fullswarm.errors import MessageError
from fullswarm.messages import FITS, Message

M = TypeVar("M", bound=Message)

LARGEST_BYTES = 4_000_000
"""Limit of one message. A thousand robots' health is a tenth of it; a longer message would block its reader."""

_encoder = msgspec.msgpack.Encoder()


def encode(message: Message) -> bytes:
    """Return `message` as MessagePack."""
    return _encoder.encode(message)


_Reader = tuple[msgspec.msgpack.Decoder[Any], Callable[[Any], bool] | None]
_readers: dict[type[Message], _Reader] = {}
_building = threading.Lock()


def _reader(kind: type[Message]) -> _Reader:
    """Return what decodes a type, and what then looks at its columns, if it has any.

    One thread at a time builds: msgspec shares what it knows of a type before that is complete, and a second thread
    that decodes with it ends the process with a segmentation fault (msgspec 0.22).
    """
    found = _readers.get(kind)
    if found is None:
        with _building:
            found = _readers[kind] = msgspec.msgpack.Decoder(kind), FITS.get(kind)
    return found


def decode(data: bytes, kind: type[M]) -> M:
    """Return the message of type `kind` that `data` holds.

    Raises
    ------
    MessageError
        Not MessagePack, another type, another version, an unknown or missing field, a number out of range, columns
        that do not fit together; names it.
    """
    if len(data) > LARGEST_BYTES:
        raise MessageError(f"{len(data)} bytes, more than {LARGEST_BYTES}", where=kind.__name__)
    decoder, fits = _reader(kind)
    try:
        message = decoder.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(_explain(data, kind, error), where=kind.__name__) from error
    if fits is not None and not fits(message):
        raise MessageError("columns of different length", where=kind.__name__)
    if not isinstance(message, kind):
        raise MessageError(f"got {type(message).__name__}", where=kind.__name__)
    return message


def _explain(data: bytes, kind: type[Message], error: Exception) -> str:
    try:
        head = msgspec.msgpack.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return f"{len(data)} bytes that are not MessagePack"
    found = head.get("kind") if isinstance(head, dict) else None
    wanted = str(kind.__struct_config__.tag)
    if isinstance(found, str) and found != wanted:
        same_name = found.split("/")[0] == wanted.split("/")[0]
        advice = "update the older side" if same_name else "two programs use one key for different things"
        return f"got '{found}' where '{wanted}' is expected: {advice}"
    return str(error)
