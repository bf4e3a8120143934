"""Limits how often each sender's broadcasts are taken in, and names those that send more often."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fullswarm.kernels import Array, Flags, Index

SLACK = 1.2
"""The permitted rate by so much more, for clocks that differ."""
BURST_S = 1.0
"""What a bad network holds back may arrive together: the messages of so much time."""
NAMED_S = 1.0
"""A sender beyond its rate is named once in this time."""


class Throttle:
    """Token buckets, one per sender; senders are rows.

    Attributes
    ----------
    dropped : how many messages were beyond their senders' rates
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._tokens, self._at_s = np.zeros(0), np.zeros(0)
        self._count, self._excess = np.zeros(0, np.int64), np.zeros(0, np.int64)  # since they were last looked at
        self._looked_s = -math.inf

    def admit(self, rows: Index, rate_hz: Array, now_s: float) -> Flags:
        """Tell which senders' messages may be taken in, (k,).

        Parameters
        ----------
        rows : (k,) different senders
        rate_hz : (k,) permitted to each
        """
        if len(rows) and rows.max() >= len(self._tokens):
            self._grow(int(rows.max()) + 1)
        most = 1.0 + rate_hz * BURST_S
        tokens = np.minimum(most, self._tokens[rows] + SLACK * rate_hz * (now_s - self._at_s[rows]))
        admitted: Flags = tokens >= 1.0
        self._tokens[rows], self._at_s[rows] = tokens - admitted, now_s
        self._count[rows] += 1
        self._excess[rows] += ~admitted
        self.dropped += int((~admitted).sum())
        return admitted

    def named(self, now_s: float) -> Iterator[tuple[int, float]]:
        """Yield each sender of which messages were dropped since the last call, and how many it sent per second.

        Nothing, if the last call was less than `NAMED_S` ago.
        """
        span_s = now_s - self._looked_s
        if span_s < NAMED_S:
            return
        self._looked_s = now_s
        if self._excess.any():
            for row in np.flatnonzero(self._excess).tolist():
                yield row, float(self._count[row]) / min(span_s, 60.0) if math.isfinite(span_s) else math.nan
            self._excess.fill(0)
        self._count.fill(0)

    def _grow(self, count: int) -> None:
        more = max(count, 2 * len(self._tokens)) - len(self._tokens)
        self._tokens = np.concatenate([self._tokens, np.zeros(more)])
        self._at_s = np.concatenate([self._at_s, np.full(more, -1e9)])  # a full bucket
        self._count = np.concatenate([self._count, np.zeros(more, np.int64)])
        self._excess = np.concatenate([self._excess, np.zeros(more, np.int64)])
