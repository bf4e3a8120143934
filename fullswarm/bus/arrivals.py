"""When messages arrived that are looked at later: from the stamps of another clock."""

from __future__ import annotations

import math
from collections.abc import Sequence

CLOCK_DRIFT = 1e-3
"""The clocks of hub and receiver may differ in their rates by this; set anew, they jump."""


class Arrivals:
    """Computes on this process's clock when messages arrived that are looked at later, from the stamps of their sender.

    The sender's clock may differ by any amount. The smallest age of a message when it is looked at is that difference,
    but for the way of a message that arrives just then.
    """

    def __init__(self) -> None:
        self._behind_s, self._looked_s = math.inf, -math.inf

    def at(self, stamps_s: Sequence[float], now_s: float) -> list[float]:
        """Return when messages arrived that have come since the last call, not before that and not after `now_s`.

        Parameters
        ----------
        stamps_s : when each was sent, on another clock; NaN: not known, it counts as `now_s`
        """
        newest_s = max((stamp_s for stamp_s in stamps_s if not math.isnan(stamp_s)), default=math.nan)
        if not math.isnan(newest_s):
            drifted_s = self._behind_s + CLOCK_DRIFT * (now_s - self._looked_s)
            self._behind_s = min(now_s - newest_s, drifted_s)
            if newest_s + self._behind_s < self._looked_s:  # the other clock was set back
                self._behind_s = now_s - newest_s
        since_s, self._looked_s = self._looked_s, now_s
        return [
            now_s if math.isnan(stamp_s) else min(max(stamp_s + self._behind_s, since_s), now_s) for stamp_s in stamps_s
        ]
