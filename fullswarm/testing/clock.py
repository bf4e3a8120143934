"""Time that passes when the test says so."""

from __future__ import annotations

from fullswarm.clock import SimClock as FakeClock
from fullswarm.runtime import Mailbox, Runtime

__all__ = ["FakeClock", "simulated_runtime"]


def simulated_runtime(mailbox: Mailbox | None = None, *, start_s: float = 0.0) -> Runtime:
    """Return a runtime on a :class:`FakeClock`: ``run(10.0)`` takes no longer than what the nodes compute.

    Parameters
    ----------
    mailbox
        Of the bus that the nodes use; all of them share one.
    start_s
        What the clock shows first. A node must not care; tests find out with another value than 0.
    """
    return Runtime(FakeClock(start_s), mailbox)
