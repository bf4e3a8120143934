"""Messages as bytes: MessagePack, with errors that say what does not fit."""

from __future__ import annotations

import functools
from typing import TypeVar

import msgspec

from fullswarm.errors import MessageError
from fullswarm.messages import Message

M = TypeVar("M", bound=Message)

_encoder = msgspec.msgpack.Encoder()


def encode(message: Message) -> bytes:
    """Return `message` as MessagePack."""
    return _encoder.encode(message)


@functools.cache
def _decoder(kind: type[Message]) -> msgspec.msgpack.Decoder[Message]:
    return msgspec.msgpack.Decoder(kind)


def decode(data: bytes, kind: type[M]) -> M:
    """Return the message of type `kind` that `data` holds.

    Raises
    ------
    MessageError
        Not MessagePack, another type, another version, or an unknown or missing field; says which.
    """
    try:
        message = _decoder(kind).decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(_explain(data, kind, error), where=kind.__name__) from error
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
        return f"got '{found}' where '{wanted}' is understood: {advice}"
    return str(error)
