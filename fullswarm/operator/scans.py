"""Asks robots for the scans of their range sensors while they are looked at, and receives the reports."""

from __future__ import annotations

from collections.abc import Callable, Collection

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import RangeQuery, RangeReport
from fullswarm.runtime import Scheduler

RENEW_S = 1.0
"""How often a query is repeated: it counts for three times as long."""
DEFAULT_HZ, MOST_HZ = 5.0, 20.0
NO_ROBOT = "-"
"""A query for it ends the one before at once."""


class ScanWatch:
    """Receives the scans of some robots, or of all. Asks for none before :meth:`ask`.

    Parameters
    ----------
    source : unique to this asker, 64 characters at most
    on_report : called with each report on the bus, also with those that others have asked for
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, source: str, on_report: Callable[[RangeReport], None]
    ) -> None:
        self._bus, self._keys, self._source = bus, keys, source[-64:]
        self._query: RangeQuery | None = None
        self._subscription = bus.subscribe(keys.range_report(), RangeReport, on_report, latest=True)
        self._timer = scheduler.every(RENEW_S, self._renew)

    def ask(self, robots: Collection[str] | None, rate_hz: float = DEFAULT_HZ) -> None:
        """Ask from now on for the scans of `robots` at `rate_hz`, 20 at most; None: of all robots, empty: of none."""
        before = self._query
        if robots is not None and not robots:
            self._query = None
            if before is not None:
                self._bus.publish(self._keys.range_query, RangeQuery(source=self._source, robots=(NO_ROBOT,)))
            return
        named = () if robots is None else tuple(sorted(robots))
        self._query = RangeQuery(source=self._source, robots=named, rate_hz=min(rate_hz, MOST_HZ))
        if self._query != before:
            self._renew()

    def _renew(self) -> None:
        if self._query is not None:
            self._bus.publish(self._keys.range_query, self._query)

    def close(self) -> None:
        """Ask and receive no more. Closing twice is fine."""
        self.ask(())
        self._timer.cancel()
        self._subscription.close()
