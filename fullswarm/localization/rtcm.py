"""Finds the RTCM 3 frames in a stream of corrections, and keeps those that wait for the receiver. No I/O.

A frame is 0xD3, six zero bits, ten bits of length, the message, and a CRC-24Q of all that (RTCM 10403.3, section 4).
`pyrtcm` reads frames from a blocking stream and computes the checksum bit by bit; on board it must neither block nor
cost more than a stated amount of work.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable

PREAMBLE = 0xD3
POLYNOMIAL = 0x1864CFB
MOST_WAITING = 8192
"""Bytes that wait for the receiver: some seconds of corrections. Older ones are of no use any more."""
SLOW_S = 10.0
"""So long it is said that frames were dropped."""


def _table() -> tuple[int, ...]:
    found = []
    for byte in range(256):
        left = byte << 16
        for _ in range(8):
            left <<= 1
            if left & 0x1000000:
                left ^= POLYNOMIAL
        found.append(left)
    return tuple(found)


_TABLE = _table()


def crc24q(data: bytes | bytearray) -> int:
    """Return the CRC-24Q; 0 of a frame with its checksum."""
    left = 0
    for byte in data:
        left = ((left << 8) & 0xFFFFFF) ^ _TABLE[(left >> 16) ^ byte]
    return left


class FrameFilter:
    """Finds the well-formed frames in bytes of any content.

    Damaged bytes can look like the start of a thousand frames, each of which has to be checked: `take` therefore stops
    after the work that it is allowed, and goes on when it is called again.

    Attributes
    ----------
    behind : there is more to look at without any further bytes
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.behind = False

    def add(self, data: bytes) -> None:
        """Take bytes in; the caller adds no more while this is `behind`."""
        self._buffer += data
        self.behind = bool(self._buffer)

    def take(self, work: float) -> tuple[list[bytes], int]:
        """Return the frames that are complete now, and the work that was done: bytes that were checked."""
        buffer, frames, done = self._buffer, list[bytes](), 0
        while done < work:
            start = buffer.find(PREAMBLE)
            del buffer[: start if start >= 0 else len(buffer)]
            size = self._size()
            if size is None:
                self.behind = False
                break
            done += max(1, size)
            whole = size > 0 and crc24q(buffer[:size]) == 0
            if whole and size > 6:  # an empty frame only fills the line
                frames.append(bytes(buffer[:size]))
            del buffer[: size if whole else 1]
        return frames, done

    def _size(self) -> int | None:
        """Return the length of the frame at the front; 0: it is none; None: more bytes are needed."""
        buffer = self._buffer
        if len(buffer) < 3:
            return 0 if len(buffer) == 2 and buffer[1] & 0xFC else None
        if buffer[1] & 0xFC:
            return 0
        size = 6 + (buffer[1] << 8 | buffer[2])
        return size if len(buffer) >= size else None


class Outbox:
    """Frames that wait for the receiver's port: any thread puts them in, the thread of the port sends them.

    Attributes
    ----------
    dropped_s : when a frame was dropped last because the port takes too little
    """

    def __init__(self) -> None:
        self._frames: deque[bytes] = deque()
        self._rest: bytes | None = None
        self._size = 0
        self._lock = threading.Lock()
        self.dropped_s = -math.inf

    def put(self, frame: bytes, now_s: float) -> None:
        """Add a frame; the oldest ones make room."""
        with self._lock:
            self._frames.append(frame)
            self._size += len(frame)
            while self._size > MOST_WAITING:
                self._size -= len(self._frames.popleft())
                self.dropped_s = now_s

    def clear(self) -> None:
        """Forget what waits: the port was opened anew."""
        with self._lock:
            self._frames.clear()
            self._rest, self._size = None, 0

    def send(self, write: Callable[[bytes], bytes | None]) -> None:
        """Write what the port takes; `write` returns what it has not taken. A frame that was begun is completed."""
        while True:
            if self._rest is None:
                self._rest = self._next()
            if self._rest is None:
                return
            self._rest = write(self._rest)
            if self._rest is not None:
                return

    def _next(self) -> bytes | None:
        with self._lock:
            if not self._frames:
                return None
            frame = self._frames.popleft()
            self._size -= len(frame)
            return frame
