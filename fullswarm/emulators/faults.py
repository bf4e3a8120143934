"""A bad link, on request: what an emulator says or hears is lost, mangled or late. Repeats for a seed."""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass


@dataclass(slots=True)
class LinkFaults:
    """How bad the link is now; may be changed at any time. All zero: a good one."""

    drop: float = 0.0  # share of the chunks (frames, writes) that are lost
    corrupt: float = 0.0  # share of the chunks with one flipped bit
    delay_s: float = 0.0


class BadLink:
    """One direction of a link: chunks in, chunks out, in their order.

    Parameters
    ----------
    faults
        Read at each chunk, so that a test or a command may change them.
    """

    def __init__(self, faults: LinkFaults, seed: int = 0) -> None:
        self._faults = faults
        self._random = random.Random(seed)  # noqa: S311  (must repeat, keeps no secret)
        self._waiting: deque[tuple[float, bytes]] = deque()

    def put(self, data: bytes, now_s: float) -> None:
        """Send a chunk."""
        if not data or self._random.random() < self._faults.drop:
            return
        if self._random.random() < self._faults.corrupt:
            mangled = bytearray(data)
            mangled[self._random.randrange(len(mangled))] ^= 1 << self._random.randrange(8)
            data = bytes(mangled)
        self._waiting.append((now_s + self._faults.delay_s, data))

    def due(self, now_s: float) -> list[bytes]:
        """Return the chunks that have arrived by now."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now_s:
            arrived.append(self._waiting.popleft()[1])
        return arrived

    def clear(self) -> None:
        """Forget what is on the way: the cable was pulled."""
        self._waiting.clear()
