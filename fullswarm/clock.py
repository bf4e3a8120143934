"""Clocks. Only this file and :mod:`fullswarm.runtime` ask the operating system for the time."""

from __future__ import annotations

import time
from typing import Protocol

_CLOCK: int = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


class Clock(Protocol):
    """A source of monotonic seconds."""

    def now_s(self) -> float:
        """Return seconds since an arbitrary origin; never goes backwards."""
        ...


class MonotonicClock:
    """The machine's monotonic clock. Setting the wall clock back does not move it.

    On Linux it counts the time for which the computer was suspended, as ``CLOCK_MONOTONIC`` there does not: whoever
    wakes up must see that what it knows is old.
    """

    def now_s(self) -> float:
        """Return seconds of ``CLOCK_BOOTTIME``, or of ``CLOCK_MONOTONIC`` where there is none."""
        return time.clock_gettime(_CLOCK)


class SimClock:
    """A clock that stands still until somebody moves it: lockstep runs and tests."""

    __slots__ = ("_now_s",)

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now_s(self) -> float:
        """Return the simulated time in seconds."""
        return self._now_s

    def advance_to(self, now_s: float) -> None:
        """Move forward to `now_s`; an earlier time is refused with ``ValueError``."""
        if now_s < self._now_s:
            raise ValueError(f"a clock cannot go back from {self._now_s} s to {now_s} s")
        self._now_s = now_s


def wall_time_s() -> float:
    """Return seconds since 1970 for records that people read; never for control."""
    return time.time()
