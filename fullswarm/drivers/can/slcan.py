"""CAN over a serial line (SLCAN, Lawicel): frames as lines of text, and the adapter that sends them. Bytes only.

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
VERSION, SERIAL_NUMBER = b"V1013", b"NA123"

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


class Adapter:
    """An adapter's command interpreter, as delivered: closed, no bit rate, no time stamps.

    Parameters
    ----------
    bitrate
        Of the bus behind it: with another one it opens, and exchanges nothing that other nodes understand.
    """

    def __init__(self, bitrate: int) -> None:
        self._bitrate = bitrate
        self._lines = Lines()
        self._chosen: int | None = None
        self.is_open = False
        self._listens_only = False
        self.refused = 0  # lines that were neither a command nor a frame

    def receive(self, data: bytes) -> tuple[bytes, list[Frame]]:
        """Obey what a computer writes; return the answers and the frames for the bus."""
        answers, frames = b"", []
        for line in self._lines.feed(data):
            frame = decode(line)
            if frame is None:
                answer = self._command(line)
            elif self.is_open and not self._listens_only:
                frames += [frame] if self._chosen == self._bitrate else []
                answer = (b"Z" if frame.extended else b"z") + END
            else:
                answer = BELL
            self.refused += frame is None and answer == BELL
            answers += answer
        return answers, frames

    def deliver(self, frame: Frame) -> bytes:
        """Return what the computer gets to read of a frame on the bus; nothing while closed."""
        return encode(frame) if self.is_open and self._chosen == self._bitrate else b""

    def restart(self) -> None:
        """Power was cut, or the computer let go of the port."""
        self._lines = Lines()
        self.is_open = self._listens_only = False
        self._chosen = None

    def _command(self, line: bytes) -> bytes:
        match line[:1]:
            case b"C" if line == b"C":
                self.is_open = False
                return END
            case b"O" | b"L" if len(line) == 1 and self._chosen is not None:
                was_open, self.is_open, self._listens_only = self.is_open, True, line == b"L"
                return BELL if was_open else END
            case b"S" if line in BITRATES and not self.is_open:
                self._chosen = BITRATES[line]
                return END
            case b"Z" if line == b"Z0":
                return END
            case b"V" if line == b"V":
                return VERSION + END
            case b"N" if line == b"N":
                return SERIAL_NUMBER + END
            case b"F" if line == b"F" and self.is_open:
                return b"F00" + END
        return BELL
