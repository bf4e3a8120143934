"""Has a node publish on request what it otherwise publishes seldom. In: ReportQuery."""

from __future__ import annotations

import math
from collections.abc import Callable

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import ReportQuery
from fullswarm.runtime import Scheduler

LEAST_S = 0.1
"""Between two answers: a query that comes sooner gets none, since what was published is that new."""


class ReportsOnQuery:
    """Calls `report` for each query, at most each `LEAST_S`."""

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, report: Callable[[], None]) -> None:
        self._scheduler, self._report, self._answered_s = scheduler, report, -math.inf
        self._subscription = bus.subscribe(keys.report_query, ReportQuery, self._on_query)

    def _on_query(self, _: ReportQuery) -> None:
        now_s = self._scheduler.now_s()
        if now_s - self._answered_s >= LEAST_S:
            self._answered_s = now_s
            self._report()

    def close(self) -> None:
        """Unsubscribe."""
        self._subscription.close()
