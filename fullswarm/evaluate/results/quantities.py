"""What is measured: names, titles and units. A value has a source: `outcome` (referee), `onboard`, or `truth`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from fullswarm.evaluate.experiment.outcomes import Outcome
from fullswarm.evaluate.trial_folder import Record

Key = tuple[str, str]
"""Source and name, such as ``("onboard", "work.total_m")``."""
SHARES: tuple[Key, ...] = (("outcome", "all_arrived"), ("outcome", "safe_start"))
"""0 or 1 in a trial, so that their mean is a share of trials."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """How a value is shown: `factor` times the value has `unit`."""

    keys: tuple[Key, ...]  # where to look for it, the best first
    title: str
    unit: str = ""
    factor: float = 1.0
    decimals: int = 1

    @property
    def label(self) -> str:
        """Title with unit, for an axis."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def of(self, values: dict[Key, float]) -> float:
        """Return the value to show, NaN when a trial has none."""
        return self.factor * next((values[key] for key in self.keys if key in values), math.nan)


COLLISIONS = Quantity((("outcome", "events"),), "Collisions per trial")
PAIRS = Quantity((("outcome", "pairs_touched"),), "Pairs that touched")
TOUCHED = Quantity((("outcome", "robots_touched"),), "Robots that touched anything")
ARRIVED = Quantity((("outcome", "arrived_fraction"),), "Robots that arrived", "%", 100.0)
TIME = Quantity((("outcome", "arrival_s"),), "Time until all arrived", "s")
WORK = Quantity(
    (("truth", "work.mean_m"), ("onboard", "work.mean_m")), "Distance per robot", "m"
)  # the paper's work, made comparable between sizes
COVERAGE = Quantity((("truth", "coverage.fraction"), ("onboard", "coverage.fraction")), "Arena covered", "%", 100.0)
REVERSALS = Quantity((("outcome", "reversals_per_s"),), "Reversals of a wheel", "1/s", decimals=2)
SETTLED = Quantity((("outcome", "settled_fraction"),), "Robots that settled as near as possible", "%", 100.0)
QUIET = Quantity((("outcome", "quiet_s"),), "Motion after the last progress", "s")
SPEED_VARIATION = Quantity((("outcome", "speed_variation_m_s2"),), "Variation of the speed", "m/s²", decimals=2)
TURN_VARIATION = Quantity((("outcome", "turn_variation_rad_s2"),), "Variation of the turn rate", "rad/s²", decimals=2)
SHOWN = (COLLISIONS, ARRIVED, TIME, WORK, COVERAGE)


def values_of(record: Record) -> dict[Key, float]:
    """Return all figures of a trial; of a failed one only what was measured before."""
    values = {("outcome", name): value for name, value in _of_outcome(record.outcome).items()}
    values |= {("onboard", name): value for name, value in record.onboard.items()}
    values |= {("truth", name): value for name, value in record.truth.items()}
    return values


def _of_outcome(outcome: Outcome | None) -> dict[str, float]:
    if outcome is None:
        return {}
    all_arrived = outcome.arrived == outcome.robots
    values = {
        "events": float(outcome.events),
        "robot_events": float(outcome.robot_events),
        "obstacle_events": float(outcome.obstacle_events),
        "mover_events": float(outcome.mover_events),
        "mover_hits": float(outcome.mover_hits),
        "pushed_events": float(outcome.pushed_events),
        "arrived": float(outcome.arrived),
        "arrived_fraction": outcome.arrived / outcome.robots if outcome.robots else 0.0,
        "all_arrived": float(all_arrived),
        "simulated_s": outcome.simulated_s,
        "safe_start": float(outcome.safe_start),
        "above_limits": float(outcome.above_limits),
        "deadlocks": float(outcome.deadlocks),
        "settled_fraction": outcome.settled / outcome.robots if outcome.robots else 0.0,
        "deadlock_s": outcome.deadlock_s,
    }
    for name in (
        "pairs_touched", "robots_touched", "separation_m", "clearance_m", "time_to_contact_s", "quiet_s",
        "reversals_per_s", "speed_variation_m_s2", "turn_variation_rad_s2",
    ):  # fmt: skip
        count = getattr(outcome, name)
        if count is not None:
            values[name] = float(count)
    return {**values, "arrival_s": outcome.simulated_s} if all_arrived else values


def is_dull(name: str) -> bool:
    """Tell whether a value is the same clock for every metric: left out where people read."""
    return name.endswith(".elapsed_s")


def range_of(key: Key) -> tuple[float, float]:
    """Return the least and the largest value that a quantity can have."""
    source, name = key
    if name.endswith("fraction") or key in SHARES:
        return 0.0, 1.0
    gap = name in ("separation_m", "clearance_m")  # below zero where bodies overlap
    return (0.0 if source == "outcome" and not gap else -math.inf), math.inf  # else the referee only counts and times


def in_order(keys: Iterable[Key]) -> list[Key]:
    """Return keys without repetition: the referee's first, then by name with on-board beside truth."""
    return sorted(set(keys), key=lambda key: (key[0] != "outcome", key[1], key[0]))
