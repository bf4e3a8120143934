"""Summarizers (paper II.F.2). In: measurements of all hosts. Out: a Summary per metric, now and then and at the end.

Nodes in the core: ``CoverageSummarizer(bus, keys, scheduler, conditions)``, and ``robot_summarizers`` for all that is
one number per robot. They differ in their tally alone.

A supervisory process that sees the true bodies may calculate, too (paper II.F.1): what it publishes as host ``truth``
is kept apart and shown beside what the robots say, as ``truth_…``. The truth decides when a trial is over, if it is
known; it stands in for robots that say nothing.

They run in the process that commands the robots, so no measurement may end it: what the bookkeeping raises is
caught here, counted and stated in the summary, which keeps the last values that could be worked out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Generic

import msgspec
import structlog

from fullswarm.bus.base import Bus
from fullswarm.bus.report_query import ReportsOnQuery
from fullswarm.errors import MessageError
from fullswarm.keys import TRUTH, Keys
from fullswarm.messages import CoverageMeasurement, RobotMeasurement, Summary
from fullswarm.perf.coverage import Bounds
from fullswarm.perf.metrics import METRICS, OFTEN_S, Metric
from fullswarm.perf.tallies import CoverageTally, M, Result, Results, RobotTally, Tally
from fullswarm.perf.termination import Conditions, reason_to_stop
from fullswarm.runtime import Scheduler, Timer

log = structlog.get_logger()

FAILED = "failed: "
"""How the reason begins of a summary that could not be worked out just now."""


class Summarizer(Generic[M]):
    """The metrics of one kind of measurement, of the whole swarm.

    The trial's clock starts with the first measurement; nothing is reported before. Conditions are checked with
    every measurement, each period and at `max_execution_s` itself. Once one is met the summarizer halts: the
    result stands, and is still sent each period, so that a lost message or a late performance node costs nothing.

    Parameters
    ----------
    metric, kind, tally
        What it is: name of its first metric, type of its measurements, makes the bookkeeping.
    bus, keys, scheduler
        What every node gets.
    conditions
        Reads the termination conditions as they are now (the core's local database, or a constant).
    topic
        Name of its measurements in the keys; by default that of the metric.
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
        *,
        period_s: float = OFTEN_S,
        topic: str = "",
    ) -> None:
        self.metric, self.refused, self.failures = metric, 0, 0
        """`refused`: invalid measurements, dropped; `failures`: of the bookkeeping itself."""
        self._failure = ""
        self._newest: tuple[Summary, ...] = ()
        self._make, self._tally = tally, tally()
        self._truth: Tally[M] | None = None
        self._onboard = False
        self._bus, self._keys, self._scheduler, self._conditions = bus, keys, scheduler, conditions
        self._started_s: float | None = None
        self._final: tuple[Summary, ...] = ()
        self._deadline: Timer | None = None
        self._period_s = period_s
        self._timer = scheduler.every(period_s, lambda: self._safely(self._on_period))
        self._on_query = ReportsOnQuery(bus, keys, scheduler, self.report)
        take = lambda message: self._safely(lambda: self._on_measurement(message))  # noqa: E731
        self._subscription = bus.subscribe(keys.measurement(topic or metric), kind, take, latest=True)

    @property
    def finished(self) -> bool:
        """Whether a termination condition was met; the result then stands."""
        return bool(self._final)

    def summary(self) -> Summary:
        """Return the result of the first metric as it stands, or the final one."""
        return self.summaries()[0]

    def summaries(self) -> tuple[Summary, ...]:
        """Return the results as they stand, or the final ones."""
        return self._final or self._results("")

    def report(self) -> None:
        """Publish the results now, e.g. when the core ends between two reports."""
        if self._started_s is None and not self._failure:
            return
        self._safely(self._work_out)
        for summary in self._newest or (Summary(metric=self.metric, values={}),):
            sent = summary
            if self._failure and not summary.finished:
                sent = msgspec.structs.replace(summary, reason=self._failure, stamp_s=self._scheduler.now_s())
            self._bus.publish(self._keys.summary(sent.metric), sent)
        self._failure = ""

    def close(self) -> None:
        """Unsubscribe and stop reporting. Closing twice is fine."""
        self._on_query.close()
        self._subscription.close()
        self._timer.cancel()
        self._cancel_deadline()

    def _work_out(self) -> None:
        self._newest = self.summaries()

    def _safely(self, work: Callable[[], None]) -> None:
        """Do some bookkeeping. Whatever it raises, the process goes on commanding robots."""
        try:
            work()
        except Exception as error:
            self.failures += 1
            if not self._failure:  # once per report
                log.error("statistics failed; the robots are not concerned", metric=self.metric, exc_info=error)
            self._failure = f"{FAILED}{type(error).__name__}: {error}"

    def _results(self, reason: str) -> tuple[Summary, ...]:
        now_s = self._scheduler.now_s()
        elapsed_s = 0.0 if self._started_s is None else now_s - self._started_s
        return tuple(
            Summary(
                metric=metric,
                values={**result.values, "elapsed_s": elapsed_s},
                per_robot=result.per_robot,
                finished=bool(reason),
                reason=reason,
                stamp_s=now_s,
            )
            for metric, result in self._tables().items()
        )

    def _tables(self) -> Results:
        if self._truth is None:
            return self._tally.results()
        truth = self._truth.results()
        onboard = self._tally.results() if self._onboard else truth
        return {
            metric: Result(result.values | _marked(truth[metric].values), result.per_robot)
            for metric, result in onboard.items()
        }

    def _on_measurement(self, message: M) -> None:
        if self._final:
            return
        try:
            self._take(message)
        except MessageError:
            self.refused += 1
            return
        if self._started_s is None:
            self._started_s = self._scheduler.now_s()
            self._set_deadline()
        self._check()

    def _take(self, message: M) -> None:
        if getattr(message, "host", "") != TRUTH:
            self._tally.add(message)
            self._onboard = True
            return
        truth = self._truth or self._make()
        truth.add(message)
        self._truth = truth

    def _on_period(self) -> None:
        self._safely(self._check)
        self._set_deadline()  # the limit may have been changed
        if not self._final or self._final[0].stamp_s < self._scheduler.now_s():
            self.report()

    def _check(self) -> None:
        if self._started_s is None or self._final:
            return
        elapsed_s = self._scheduler.now_s() - self._started_s
        progress = self._tally.progress(elapsed_s)
        if self._truth is not None:
            progress = self._truth.progress(elapsed_s).or_else(progress)
        reason = reason_to_stop(self._conditions(), progress)
        if reason:
            self._final = self._results(reason)
            self._cancel_deadline()
            self.report()

    def _set_deadline(self) -> None:
        """Wake at the end of `max_execution_s` itself if that comes before the next report."""
        self._cancel_deadline()
        limit_s = self._conditions().max_execution_s
        if self._started_s is None or self._final or limit_s is None:
            return
        left_s = self._started_s + limit_s - self._scheduler.now_s()
        if left_s < self._period_s:
            self._deadline = self._scheduler.after(max(left_s, 0.0), lambda: self._safely(self._check))

    def _cancel_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


def _marked(values: dict[str, float]) -> dict[str, float]:
    return {f"{TRUTH}_{quantity}": value for quantity, value in values.items()}


CoverageSummarizer = partial(Summarizer[CoverageMeasurement], "coverage", CoverageMeasurement, CoverageTally)


def robot_summarizers(
    bus: Bus, keys: Keys, scheduler: Scheduler, conditions: Conditions, robots: Sequence[str], bounds_m: Bounds
) -> list[Summarizer[RobotMeasurement]]:
    """Return the summarizers of all metrics in ``metrics.py``, one for each period in which some are reported.

    `robots` are those of the fleet file.
    """
    groups: dict[float, dict[str, Metric]] = {}
    for name, metric in METRICS.items():
        groups.setdefault(metric.period_s, {})[name] = metric
    return [
        Summarizer(
            next(iter(group)), RobotMeasurement, partial(RobotTally, robots, bounds_m, group), bus, keys, scheduler,
            conditions, period_s=period_s, topic="robots",
        )
        for period_s, group in groups.items()
    ]  # fmt: skip
