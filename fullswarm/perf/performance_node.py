"""The performance node (paper II.F.3). In: Summaries. Out: files that people and programs read, tables.

``performance.json`` holds the newest summary of each metric and is replaced whole, so that a reader never sees
half a file; ``summaries.jsonl`` keeps every summary that differed from the one before it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import structlog

from fullswarm.bus.base import Bus
from fullswarm.errors import ConfigError
from fullswarm.files import replace_file
from fullswarm.keys import Keys
from fullswarm.messages import Summary
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler
from fullswarm.units import unit_of

log = structlog.get_logger()

FORMAT = "fullswarm.performance/1"
WRITE_PERIOD_S = 1.0

MOST_METRICS = 256
"""Metrics kept; the newest count."""
MAX_WAITING = 1000
"""Lines kept for ``summaries.jsonl`` while the disk refuses them."""


@dataclass(frozen=True, slots=True)
class Row:
    """One number for an operator's table."""

    metric: str
    quantity: str  # e.g. total_m
    value: float
    unit: str  # empty: a count or a share
    state: str  # running, the termination condition that was met, or why it could not be worked out


class PerformanceNode:
    """Keeps the newest summary of each metric, and writes what changed at most once per second and on close.

    Parameters
    ----------
    results
        Directory for the two files, made if need be; None: keep everything in memory only.

    Raises
    ------
    ConfigError
        The directory cannot be made or written.
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, results: Path | None = None) -> None:
        self._swarm, self._results = keys.swarm, results
        self._newest: Recent[str, Summary] = Recent(MOST_METRICS)
        self._lines: list[bytes] = []
        self._changed = False
        self._closed = False
        self.fault = ""
        """Why the last write failed, e.g. a full disk; it is tried again each second."""
        if results is not None:
            _make_writable(results)
        self.failures = 0
        """How often the bookkeeping itself has failed; the process goes on commanding robots."""
        self._timer = scheduler.every(WRITE_PERIOD_S, lambda: self._safely(self._write))
        take = lambda summary: self._safely(lambda: self._on_summary(summary))  # noqa: E731
        self._subscription = bus.subscribe(keys.summary(), Summary, take, latest=True)

    @property
    def summaries(self) -> dict[str, Summary]:
        """The newest summary per metric, in the order of the names."""
        return dict(sorted(self._newest.items()))

    @property
    def finished(self) -> dict[str, str]:
        """Metrics whose summarizer has halted, with the condition that was met."""
        return {metric: each.reason for metric, each in self.summaries.items() if each.finished}

    def table(self) -> list[Row]:
        """Return the swarm's numbers as rows, metric by metric."""
        return [
            Row(metric, quantity, value, unit_of(quantity), each.reason or "running")
            for metric, each in self.summaries.items()
            for quantity, value in each.values.items()
        ]

    def document(self) -> dict[str, object]:
        """Return what ``performance.json`` holds: plain data, the same for the same summaries."""
        metrics = {
            metric: {
                "values": each.values,
                "per_robot": each.per_robot,
                "finished": each.finished,
                "reason": each.reason,
                "stamp_s": each.stamp_s,
            }
            for metric, each in self.summaries.items()
        }
        return {"format": FORMAT, "swarm": self._swarm, "finished": self.finished, "metrics": metrics}

    def close(self) -> None:
        """Write what is left and unsubscribe. Closing twice is fine."""
        if self._closed:
            return
        self._closed = True
        self._subscription.close()
        self._timer.cancel()
        self._safely(lambda: self._write(sync=True))

    def _safely(self, work: Callable[[], None]) -> None:
        """Do some bookkeeping; log its first failure and count all, because no statistics may end this process."""
        try:
            work()
        except Exception as error:
            self.failures += 1
            if self.failures == 1:
                log.error("the results failed; the robots are not concerned", exc_info=error)
            self.fault = f"the results failed: {type(error).__name__}: {error}"

    def _on_summary(self, summary: Summary) -> None:
        before = self._newest.get(summary.metric)
        self._newest[summary.metric] = summary
        if before is not None and _same(before, summary):
            return
        self._changed = True
        if self._results is not None:
            self._lines.append(msgspec.json.encode(summary) + b"\n")
            del self._lines[:-MAX_WAITING]

    def _write(self, *, sync: bool = False) -> None:
        if self._results is None or not self._changed:
            return
        try:
            _append(self._results / "summaries.jsonl", self._lines)
            self._lines.clear()
            text = msgspec.json.format(msgspec.json.encode(self.document()), indent=2) + b"\n"
            replace_file(self._results / "performance.json", text, sync=sync)
        except OSError as error:
            self.fault = f"{self._results}: cannot write the results: {error.strerror or error}"
            return
        except (ValueError, TypeError, msgspec.MsgspecError) as error:  # of what was sent as a summary
            self.fault = f"{self._results}: the results cannot be written as JSON: {error}"
            return
        self._changed, self.fault = False, ""


def _same(one: Summary, other: Summary) -> bool:
    """Return whether nothing but time has passed between two summaries."""
    return _timeless(one) == _timeless(other)


def _timeless(summary: Summary) -> tuple[object, ...]:
    values = {quantity: value for quantity, value in summary.values.items() if quantity != "elapsed_s"}
    return values, summary.per_robot, summary.finished, summary.reason


def _make_writable(results: Path) -> None:
    try:
        results.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"cannot make the results' directory: {error.strerror or error}",
            where=str(results),
            hint="choose another one with core.results",
        ) from error
    if not os.access(results, os.W_OK | os.X_OK):
        raise ConfigError(
            "the results' directory is not writable",
            where=str(results),
            hint="choose another one with core.results",
        )


def _append(path: Path, lines: list[bytes]) -> None:
    """Add whole lines to `path`, or none when the disk fills up in between."""
    if not lines:
        return
    with path.open("ab", buffering=0) as log:
        before, data = log.tell(), b"".join(lines)
        try:
            while data:
                data = data[log.write(data) :]
        except OSError:
            with contextlib.suppress(OSError):
                log.truncate(before)
            raise
