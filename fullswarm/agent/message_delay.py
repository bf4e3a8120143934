"""Is a message late? Without synchronised clocks: compared with the fastest delivery seen lately."""

from __future__ import annotations

import math

WINDOW_S = 5.0
"""How long a fastest delivery counts; after a suspend of the sender its delays are right again after two windows."""

DRIFT = 1e-4
"""By so much two computers' clocks may go apart: after hours of silence that is more than a message takes."""


class MessageDelay:
    """Measures how much longer than usual a sender's message took.

    A stamp is read off the sender's clock, whose origin is unknown; `arrival - stamp` is that offset plus the
    time on the way. Its smallest recent value is taken as the offset, so what exceeds it is delay. A command that
    waited in a queue while a link was down is thus known to be old although it has just arrived.
    """

    def __init__(self) -> None:
        self._sender = ""
        self._began_s = -math.inf
        self._recent = self._before = math.inf

    def delay_s(self, sender: str, stamp_s: float, arrival_s: float) -> float:
        """Return the extra delay in seconds of a message of `sender`; 0 for the first one."""
        if sender != self._sender:
            self._sender, self._began_s = sender, -math.inf
            self._recent = self._before = math.inf
        if arrival_s - self._began_s > WINDOW_S:
            drift_s = DRIFT * (arrival_s - self._began_s) if self._began_s > -math.inf else 0.0
            self._before, self._recent, self._began_s = self._recent + drift_s, math.inf, arrival_s
        offset_s = arrival_s - stamp_s
        self._recent = min(self._recent, offset_s)
        return offset_s - min(self._recent, self._before)
