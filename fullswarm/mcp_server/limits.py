"""Bounds what one client can cause: a rate limit, and plain values of bounded size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fullswarm.clock import Clock

LONGEST_TEXT = 500
"""Characters of one text that another process has sent."""
MOST_ENTRIES = 2000
"""Of one list or table."""
DEEPEST = 12


class RateLimit:
    """A token bucket.

    Parameters
    ----------
    per_s : calls per second that are admitted for long
    burst : calls that are admitted at once after a pause
    """

    def __init__(self, clock: Clock, per_s: float, burst: float) -> None:
        self._clock, self.per_s, self._burst = clock, per_s, burst
        self._left, self._at_s = burst, clock.now_s()

    def admit(self) -> bool:
        """Count one call; False: it comes too soon."""
        now_s = self._clock.now_s()
        self._left = min(self._burst, self._left + (now_s - self._at_s) * self.per_s)
        self._at_s = now_s
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


def plain(value: Any, depth: int = 0) -> Any:
    """Return a value as JSON has it: NaN and infinity are None, texts are printable, and all sizes are bounded.

    Texts come from other processes. Control characters and whatever else cannot be printed become ``?``, so that a
    text can neither command a terminal nor hide something from the reader.
    """
    if isinstance(value, str):
        shown = "".join(each if each.isprintable() else "?" for each in value[:LONGEST_TEXT])
        return shown + "…" if len(value) > LONGEST_TEXT else shown
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int):
        return value
    if depth >= DEEPEST:
        return "…"
    if isinstance(value, Mapping):
        entries = list(value.items())[:MOST_ENTRIES]
        return {plain(str(name)): plain(each, depth + 1) for name, each in entries}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(each, depth + 1) for each in list(value)[:MOST_ENTRIES]]
    return plain(str(value))
