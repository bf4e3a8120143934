"""Messages of every type that are typed as they must be and otherwise as wild as can be, from a seed."""

from __future__ import annotations

import math
import random
from typing import Any

import msgspec
from msgspec import inspect

from fullswarm import messages
from fullswarm.bus.codec import decode
from fullswarm.errors import MessageError
from fullswarm.messages import Message

KINDS: tuple[type[Message], ...] = tuple(
    each for each in vars(messages).values()
    if isinstance(each, type) and issubclass(each, Message) and each is not Message
)  # fmt: skip
NUMBERS = (
    0.0, -0.0, 1.0, -1.0, 0.03, 5e-324, 1e-9, 1e5, -1e5, 1e7, -1e7, 1e15, 1e100, 1e154, 1.7e308, -1.7e308,
    math.nan, math.inf, -math.inf,
)  # fmt: skip
WHOLE = (0, 1, -1, 2, 255, 2**31, 2**53, 2**62, 2**63 - 1, -(2**63), 2**64 - 1)


class Wild:
    """Makes messages.

    Parameters
    ----------
    words
        Words that mean something to the receivers: robots, behaviours, ids; chosen more often than nonsense.
    misfits
        Share of values outside the range that their type states.
    """

    def __init__(self, seed: int, words: tuple[str, ...] = (), misfits: float = 0.02) -> None:
        self.chance, self.words, self.misfits = random.Random(seed), words, misfits

    def raw(self, kind: type[Message]) -> bytes:
        """Return the bytes of a message as a stranger might send them."""
        fields = self._struct(inspect.type_info(kind), self.chance.choice((0, 1, 1, 1, 2, 5)))
        return msgspec.msgpack.encode(fields)

    def message(self, kind: type[Message]) -> Message:
        """Return a message that decodes."""
        while True:
            try:
                return decode(self.raw(kind), kind)
            except MessageError:
                continue

    def _struct(self, info: Any, length: int) -> dict[str, Any]:
        fields = {each.encode_name: self.any(each.type, length) for each in info.fields if self._given(each)}
        return ({"kind": info.tag} if info.tag else {}) | fields

    def _given(self, field: Any) -> bool:
        return field.required or self.chance.random() < 0.8

    def any(self, info: Any, length: int) -> Any:
        """Return a value of a type; columns of one message mostly have the same `length`."""
        if self.chance.random() < 0.02:
            length = self.chance.choice((0, 1, 3))
        match info:
            case inspect.BoolType():
                return self.chance.random() < 0.5
            case inspect.FloatType():
                return self._float(info)
            case inspect.IntType():
                return self._int(info)
            case inspect.StrType():
                return self._word()
            case inspect.BytesType():
                return self.chance.randbytes(self.chance.choice((0, 3, 40)))
            case inspect.LiteralType():
                return self.chance.choice(info.values)
            case inspect.VarTupleType() | inspect.ListType():
                return [self.any(info.item_type, length) for _ in range(length)]
            case inspect.TupleType():
                return [self.any(each, length) for each in info.item_types]
            case inspect.DictType():
                return {self._word(): self.any(info.value_type, length) for _ in range(length)}
            case inspect.UnionType():
                return self.any(self.chance.choice(info.types), self.chance.choice((0, 1, 2)))
            case inspect.StructType():
                fields = self._struct(info, length)
                return list(fields.values()) if info.array_like else fields
            case inspect.NoneType():
                return None
            case inspect.AnyType() | inspect.CustomType():
                return self.chance.choice((None, 1, "x", [1.0], {}))
        raise AssertionError(f"{info} is not known here")

    def _float(self, info: inspect.FloatType) -> float:
        low = info.ge if info.ge is not None else info.gt
        choices = [each for each in NUMBERS if low is None or info.le is None or low < each < info.le]
        choices += [each for each in (info.ge, info.le) if each is not None]
        if self.chance.random() < self.misfits:
            return self.chance.choice(NUMBERS)
        return self.chance.choice(choices) if self.chance.random() < 0.5 else self.chance.uniform(0.001, 20.0)

    def _int(self, info: inspect.IntType) -> int:
        choices = [
            each for each in WHOLE if (info.ge is None or each >= info.ge) and (info.le is None or each <= info.le)
        ]
        return self.chance.choice(WHOLE if self.chance.random() < self.misfits else choices)

    def _word(self) -> str:
        nonsense = ("", "*", "**", "a/b", "@", "\x00", "ü" * 70, "r1\n", "#", "$")
        return self.chance.choice(nonsense if self.chance.random() < 0.1 or not self.words else self.words)
