"""Clocks. Only this file and :mod:`fullswarm.runtime` read the operating system's time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Protocol

_CLOCK: int | None = getattr(time, "CLOCK_BOOTTIME", None)


class Clock(Protocol):
    """A source of monotonic seconds."""

    def now_s(self) -> float:
        """Return seconds since an arbitrary origin; never goes backwards."""
        ...


class MonotonicClock:
    """The machine's monotonic clock. Setting the wall clock back does not move it.

    On Linux it counts the time for which the computer was suspended, as ``CLOCK_MONOTONIC`` there does not: after
    a suspend a process must see that its data is old.
    """

    def now_s(self) -> float:
        """Return seconds of ``CLOCK_BOOTTIME``, or of Python's monotonic clock where there is none."""
        return time.monotonic() if _CLOCK is None else time.clock_gettime(_CLOCK)


class SimClock:
    """A clock that stands still until it is moved: lockstep runs and tests."""

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


def clock_id() -> str:
    """Return the name of the clock that :class:`MonotonicClock` reads: stamps of one name compare, others do not.

    All processes of a computer share it until the computer is started again; a container may have one of its own.
    Empty where the system does not provide it.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot}/{Path('/proc/self/ns/time').stat().st_ino}"
    except OSError:
        return ""


def wall_time_s() -> float:
    """Return seconds since 1970 for records that people read; never for control."""
    return time.time()
