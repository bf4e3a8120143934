"""CAN over a serial line (SLCAN, Lawicel): frames as lines of text. Bytes only.

``t1230`` is a frame with 11 bits of identifier and no data, ``T`` one with 29 bits, ``r`` and ``R`` ask remotely; a
line ends with a carriage return. The line has no checksum: a flipped bit in a digit makes another valid frame, so
that all a parser can do is refuse whatever is not exactly one.
"""

from __future__ import annotations

import re

from fullswarm.drivers.can.protocol import MAX_DATA, Frame

END, BELL = b"\r", b"\a"
LONGEST = len("T1FFFFFFF8") + 2 * MAX_DATA
BITRATES = {
    b"S0": 10_000, b"S1": 20_000, b"S2": 50_000, b"S3": 100_000, b"S4": 125_000,
    b"S5": 250_000, b"S6": 500_000, b"S7": 750_000, b"S8": 1_000_000,
}  # fmt: skip

_DIGIT = rb"[0-9A-Fa-f]"
_SHAPE = re.compile(rb"(?:([tr])([0-7]%b{2})|([TR])([01]%b{7}))([0-8])((?:%b{2}){0,8})" % ((_DIGIT,) * 3))


def encode(frame: Frame) -> bytes:
    """Return `frame` as a line with its end."""
    letter = ("R" if frame.extended else "r") if frame.remote else ("T" if frame.extended else "t")
    digits = 8 if frame.extended else 3
    return f"{letter}{frame.id:0{digits}X}{len(frame.data)}{frame.data.hex().upper()}\r".encode()


def decode(line: bytes) -> Frame | None:
    """Return the frame that a line (without its end) is; None when it is not exactly one."""
    shape = _SHAPE.fullmatch(line)
    if shape is None:
        return None
    short, short_id, long, long_id, length, digits = shape.groups()
    remote = (short or long) in b"rR"
    if len(digits) != (0 if remote else 2 * int(length)):
        return None
    return Frame(int(short_id or long_id, 16), bool(long_id), bytes.fromhex(digits.decode()), remote)


class Lines:
    """Cuts a stream of bytes into lines; what is too long to be one is dropped up to its end."""

    def __init__(self) -> None:
        self._pending = bytearray()
        self._overlong = False
        self.dropped = 0  # lines that were too long

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that `data` completes, without their ends; a bell ends a line too."""
        *complete, rest = data.replace(BELL, END).split(END)
        lines = []
        for part in complete:
            line = bytes(self._pending) + part
            self._pending.clear()
            if self._overlong or len(line) > LONGEST:
                self.dropped += 1
            elif line:
                lines.append(line)
            self._overlong = False
        self._pending += rest
        if len(self._pending) > LONGEST:
            self._overlong = True
            self._pending.clear()
        return lines
