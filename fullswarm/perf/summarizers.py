"""Summarizers (paper II.F.2). In: measurements of all hosts. Out: a Summary per metric, once per second.

One node per metric, in the core: ``WorkSummarizer(bus, keys, scheduler, conditions)`` and likewise
``CollisionSummarizer`` and ``CoverageSummarizer``. They differ in their tally and in nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Generic

from fullswarm.bus.base import Bus
from fullswarm.errors import MessageError
from fullswarm.keys import Keys
from fullswarm.messages import CollisionMeasurement, CoverageMeasurement, Summary, WorkMeasurement
from fullswarm.perf.tallies import CollisionTally, CoverageTally, M, Tally, WorkTally
from fullswarm.perf.termination import Conditions, reason_to_stop
from fullswarm.runtime import Scheduler, Timer

REPORT_PERIOD_S = 1.0


class Summarizer(Generic[M]):
    """One metric of the whole swarm.

    The trial's clock starts with the first measurement; nothing is reported before. Conditions are checked with
    every measurement, each second and at `max_execution_s` itself. Once one is met the summarizer halts: the
    result stands, and is still sent each second, so that a lost message or a late performance node costs nothing.

    Parameters
    ----------
    metric, kind, tally
        What it is: name in the keys, type of its measurements, makes the bookkeeping.
    bus, keys, scheduler
        What every node gets.
    conditions
        Reads the termination conditions as they are now (the core's local database, or a constant).
    """

    def __init__(
        self,
        metric: str,
        kind: type[M],
        tally: Callable[[], Tally[M]],
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        conditions: Conditions,
    ) -> None:
        self.metric, self.refused = metric, 0
        """`refused`: measurements that made no sense and were dropped."""
        self._tally = tally()
        self._bus, self._key, self._scheduler, self._conditions = bus, keys.summary(metric), scheduler, conditions
        self._started_s: float | None = None
        self._final: Summary | None = None
        self._deadline: Timer | None = None
        self._timer = scheduler.every(REPORT_PERIOD_S, self._on_period)
        self._subscription = bus.subscribe(keys.measurement(metric), kind, self._on_measurement, latest=True)

    @property
    def finished(self) -> bool:
        """Whether a termination condition was met; the result then stands."""
        return self._final is not None

    def summary(self) -> Summary:
        """Return the result as it stands, or the final one."""
        return self._final or self._result("")

    def report(self) -> None:
        """Publish the result now, e.g. when the core ends between two reports."""
        if self._started_s is not None:
            self._bus.publish(self._key, self.summary())

    def close(self) -> None:
        """Stop listening and reporting. Closing twice is fine."""
        self._subscription.close()
        self._timer.cancel()
        self._cancel_deadline()

    def _result(self, reason: str) -> Summary:
        now_s = self._scheduler.now_s()
        elapsed_s = 0.0 if self._started_s is None else now_s - self._started_s
        return Summary(
            metric=self.metric,
            values={**self._tally.values(), "elapsed_s": elapsed_s},
            per_robot=self._tally.per_robot(),
            finished=bool(reason),
            reason=reason,
            stamp_s=now_s,
        )

    def _on_measurement(self, message: M) -> None:
        if self._final is not None:
            return
        try:
            self._tally.add(message)
        except MessageError:
            self.refused += 1
            return
        if self._started_s is None:
            self._started_s = self._scheduler.now_s()
            self._set_deadline()
        self._check()

    def _on_period(self) -> None:
        self._check()
        self._set_deadline()  # the limit may have been changed
        if self._final is None or self._final.stamp_s < self._scheduler.now_s():
            self.report()

    def _check(self) -> None:
        if self._started_s is None or self._final is not None:
            return
        progress = self._tally.progress(self._scheduler.now_s() - self._started_s)
        reason = reason_to_stop(self._conditions(), progress)
        if reason:
            self._final = self._result(reason)
            self._cancel_deadline()
            self.report()

    def _set_deadline(self) -> None:
        """Wake at the end of `max_execution_s` itself if that comes before the next report."""
        self._cancel_deadline()
        limit_s = self._conditions().max_execution_s
        if self._started_s is None or self._final is not None or limit_s is None:
            return
        left_s = self._started_s + limit_s - self._scheduler.now_s()
        if left_s < REPORT_PERIOD_S:
            self._deadline = self._scheduler.after(max(left_s, 0.0), self._check)

    def _cancel_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


WorkSummarizer = partial(Summarizer[WorkMeasurement], "work", WorkMeasurement, WorkTally)
CollisionSummarizer = partial(Summarizer[CollisionMeasurement], "collisions", CollisionMeasurement, CollisionTally)
CoverageSummarizer = partial(Summarizer[CoverageMeasurement], "coverage", CoverageMeasurement, CoverageTally)
