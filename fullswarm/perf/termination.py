"""When a trial is over (paper II.F.2): the conditions stand in the core's local database."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from fullswarm.config import PerformanceConfig

Conditions = Callable[[], PerformanceConfig]
"""Reads the conditions as they are now, so that a change at run time applies."""


@dataclass(frozen=True, slots=True)
class Progress:
    """What one summarizer knows of the trial; None: not its metric."""

    elapsed_s: float = 0.0  # since the first measurement
    coverage: float | None = None  # 0 to 1
    collisions: int | None = None
    all_arrived: bool | None = None
    still_s: float | None = None  # for how long no robot with a task has moved; None, too, when none has a task

    def or_else(self, other: Progress) -> Progress:
        """Return what is known here, and from the other what is not."""
        return Progress(
            elapsed_s=self.elapsed_s,
            coverage=other.coverage if self.coverage is None else self.coverage,
            collisions=other.collisions if self.collisions is None else self.collisions,
            all_arrived=other.all_arrived if self.all_arrived is None else self.all_arrived,
            still_s=other.still_s if self.still_s is None else self.still_s,
        )


def reason_to_stop(conditions: PerformanceConfig, progress: Progress) -> str:
    """Return the name of the condition that is met, as it is spelt in the file; empty: go on.

    What happened (a collision, the coverage reached, all arrived) comes before the time that ran out.
    """
    if conditions.stop_on_collision and progress.collisions:
        return "stop_on_collision"
    goal = conditions.coverage_at_least
    if goal is not None and progress.coverage is not None and progress.coverage >= goal:
        return "coverage_at_least"
    if conditions.all_arrived and progress.all_arrived:
        return "all_arrived"
    patience_s = conditions.stalled_s
    if patience_s is not None and progress.still_s is not None and progress.still_s >= patience_s - 1e-9:
        return "stalled_s"
    limit_s = conditions.max_execution_s
    if limit_s is not None and progress.elapsed_s >= limit_s - 1e-9:
        return "max_execution_s"
    return ""
