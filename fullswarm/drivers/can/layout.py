"""How messages lie in the bytes of a frame: one line per message, read in both directions.

A :class:`Layout` ties a frozen dataclass to a ``struct`` format; a :class:`Table` is what one protocol version knows.
Decoding is strict: a wrong length or a number that is not finite is no message.
"""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from fullswarm.drivers.can.protocol import MAX_DATA

M = TypeVar("M")


@dataclass(frozen=True)
class Layout:
    """One message.

    Parameters
    ----------
    command
        The command in the identifier.
    kind
        The dataclass; its first fields are those of `format`, the others keep their defaults.
    format
        As in ``struct``, byte order first; empty for a message without data.
    scales
        What the fields are multiplied with on the wire; empty: with one.
    least, most
        How many bytes a valid frame has; what is missing reads as zero. ``least`` None: the whole format.
    unknown
        A NaN stands for "not measured" and reads as None.
    """

    command: int
    kind: type[Any]
    format: str = ""
    scales: tuple[float, ...] = ()
    least: int | None = None
    most: int = MAX_DATA
    unknown: bool = False
    _struct: struct.Struct = field(init=False, repr=False)
    _names: tuple[str, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        layout = struct.Struct(self.format or "<")
        count = len(layout.unpack(bytes(layout.size)))
        object.__setattr__(self, "_struct", layout)
        object.__setattr__(self, "_names", tuple(each.name for each in dataclasses.fields(self.kind)[:count]))

    def pack(self, message: object) -> bytes:
        """Return the data bytes of `message`; ``ValueError`` when a value does not fit."""
        values = [getattr(message, name) for name in self._names]
        if self.scales:
            values = [
                value if scale == 1.0 else round(value * scale)
                for value, scale in zip(values, self.scales, strict=True)
            ]
        if self.unknown:
            values = [math.nan if value is None else value for value in values]
        try:
            return self._struct.pack(*values)
        except (struct.error, OverflowError) as error:
            raise ValueError(f"{message} does not fit into its frame: {error}") from error

    def unpack(self, data: bytes) -> object | None:
        """Return the message that `data` holds; None when it is none."""
        size = self._struct.size
        if not (size if self.least is None else self.least) <= len(data) <= self.most:
            return None
        values: list[Any] = list(self._struct.unpack(data[:size].ljust(size, b"\0")))
        for index, value in enumerate(values):
            if isinstance(value, float) and not math.isfinite(value):
                if not (self.unknown and math.isnan(value)):
                    return None
                values[index] = None
        if self.scales:
            values = [
                value if scale == 1.0 else value / scale for value, scale in zip(values, self.scales, strict=True)
            ]
        message: object = self.kind(*values)
        return message


class Table(Generic[M]):
    """All messages of one protocol version; a command means the same in both directions."""

    def __init__(self, layouts: Iterable[Layout]) -> None:
        layouts = tuple(layouts)
        self.by_command = {each.command: each for each in layouts}
        self.by_kind: dict[type[Any], Layout] = {each.kind: each for each in layouts}
        if len(self.by_command) != len(layouts) or len(self.by_kind) != len(layouts):
            raise ValueError("a command or a message stands twice in the table")

    def pack(self, message: M) -> tuple[int, bytes]:
        """Return command and data of `message`; ``KeyError`` when this version does not know it."""
        layout = self.by_kind[type(message)]
        return layout.command, layout.pack(message)

    def unpack(self, command: int, data: bytes) -> M | None:
        """Return the message; None for an unknown command or malformed data."""
        layout = self.by_command.get(command)
        message: M | None = layout.unpack(data) if layout else None  # type: ignore[assignment]  # its kind is an M
        return message
