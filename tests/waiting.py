"""Wait on the wall clock for what another thread or process does, with a deadline."""

from __future__ import annotations

import time
from collections.abc import Callable

POLL_S, EACH_S = 0.002, 0.02


def until(
    condition: Callable[[], bool],
    limit_s: float = 10.0,
    what: str | Callable[[], str] = "the condition",
    *,
    each: Callable[[], object] | None = None,
) -> float:
    """Wait for a condition, calling `each` at 50 Hz meanwhile; return how long it took, in s."""
    began_s = time.monotonic()
    while not condition():
        if time.monotonic() - began_s > limit_s:
            raise AssertionError(f"not within {limit_s:g} s: {what if isinstance(what, str) else what()}")
        if each is not None:
            each()
        time.sleep(POLL_S if each is None else EACH_S)
    return time.monotonic() - began_s
