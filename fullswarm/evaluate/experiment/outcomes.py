"""Joins the outcomes of trials by cell, and shows them as a table."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import msgspec
from rich.table import Table

from fullswarm import output
from fullswarm.evaluate.experiment.plan import Cell, Trial, differ_by_group


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """What one trial measured. An event: contact after at least 0.25 s without; a meeting is one for each robot."""

    robots: int  # that took part
    arrived: int  # inside the goal disc at the end
    robot_events: int  # a robot touched another robot
    obstacle_events: int  # a robot touched a box or a wall
    safe_start: bool  # no gap was below the margin at the start
    simulated_s: float  # from the request to the end
    above_limits: int = 0  # commands beyond the actuators' limits
    deadlocks: int = 0  # how often a robot was found blocked
    deadlock_s: float = 0.0  # robot-seconds spent on stepping aside
    pairs_touched: int | None = None  # pairs of robots that touched at least once; None: not known
    robots_touched: int | None = None  # robots that touched anything
    separation_m: float | None = None  # least gap of two robots; None: there was one
    clearance_m: float | None = None  # least gap of a robot and an obstacle; None: there was none
    time_to_contact_s: float | None = None  # least; None: nothing came nearer to anything
    # per robot and second, as the robots measured it; None: not known
    reversals_per_s: float | None = None  # of a wheel's commanded speed, mean of both wheels
    speed_variation_m_s2: float | None = None  # total variation of the commanded speed
    turn_variation_rad_s2: float | None = None  # and of the commanded turn rate
    settled: int = 0  # not in the disc, but as near to it as they could get
    # from the last progress of any robot until the last motion; None: all arrived, or robots moved to the end
    quiet_s: float | None = None

    mover_events: int = 0  # a robot touched a mover by its own motion
    mover_hits: int = 0  # a mover touched a robot that stood or went away from it: no collision of the robot's
    pushed_events: int = 0  # robots touched, one for each of the two, while a mover pushed one of them: likewise
    left_out: int = 0  # robots that took no part, being unfit for the request

    @property
    def events(self) -> int:
        """All contact events that robots brought about."""
        return self.robot_events + self.obstacle_events + self.mover_events


class TrialResult(msgspec.Struct, frozen=True, kw_only=True):
    """A trial that ended: with an outcome, or with the reason why there is none."""

    seed: int
    outcome: Outcome | None
    failure: str = ""
    wall_s: float = 0.0
    end_reason: str = ""  # as in `Record`
    attempts: int = 1
    lost: bool = False  # its process died or ran out of time, and could keep nothing


@dataclass(slots=True)
class CellResult:
    """The trials of one cell. Those that began outside the safe set are kept apart."""

    cell: Cell
    results: list[TrialResult] = field(default_factory=list)

    @property
    def outcomes(self) -> list[tuple[int, Outcome]]:
        """Seed and outcome of the trials that began in the safe set."""
        return [(each.seed, each.outcome) for each in self.results if each.outcome and each.outcome.safe_start]

    @property
    def is_empty(self) -> bool:
        """Nothing counts: all trials failed or began outside the safe set. Then the cell has no figures."""
        return not self.outcomes

    @property
    def collisions(self) -> int:
        """Contact events; see `is_empty`."""
        return sum(each.events for _, each in self.outcomes)

    @property
    def pairs_touched(self) -> int:
        """Pairs of robots that touched, of all trials that know them."""
        return sum(each.pairs_touched or 0 for _, each in self.outcomes)

    @property
    def robots_touched(self) -> int:
        """Robots that touched anything, of all trials that know them."""
        return sum(each.robots_touched or 0 for _, each in self.outcomes)

    @property
    def failed(self) -> list[TrialResult]:
        """Trials without an outcome."""
        return [each for each in self.results if each.outcome is None]

    @property
    def arrived_fraction(self) -> float:
        """Robots that arrived, of all; NaN when nothing counts."""
        robots = sum(each.robots for _, each in self.outcomes)
        return sum(each.arrived for _, each in self.outcomes) / robots if robots else math.nan

    @property
    def all_arrived_fraction(self) -> float:
        """Trials in which all arrived, of all; NaN when nothing counts."""
        outcomes = self.outcomes
        return sum(each.arrived == each.robots for _, each in outcomes) / len(outcomes) if outcomes else math.nan

    @property
    def colliding_seeds(self) -> list[int]:
        """Seeds of the trials with contacts."""
        return [seed for seed, each in self.outcomes if each.events]

    @property
    def late_seeds(self) -> list[int]:
        """Seeds of the trials in which a robot did not arrive."""
        return [seed for seed, each in self.outcomes if each.arrived < each.robots]

    def least_of(self, name: str) -> float | None:
        """Return the least figure of the outcomes that have one."""
        known = [value for _, each in self.outcomes if (value := getattr(each, name)) is not None]
        return round(min(known), 5) if known else None

    def mean_of(self, name: str) -> float | None:
        """Return the mean of a number of the outcomes, each weighted by its time; None when none has it."""
        known = [(getattr(each, name), each.simulated_s) for _, each in self.outcomes]
        known = [(value, time_s) for value, time_s in known if value is not None and time_s > 0.0]
        total_s = sum(time_s for _, time_s in known)
        return round(sum(value * time_s for value, time_s in known) / total_s, 4) if known else None

    def mean_s(self) -> float:
        """Return the mean simulated time until all had arrived; NaN when they never did."""
        times = [each.simulated_s for _, each in self.outcomes if each.arrived == each.robots]
        return sum(times) / len(times) if times else math.nan

    def to_json(self) -> dict[str, Any]:
        """Return the record of ``--json``; what is not known is null."""
        cell, outcomes = self.cell, [each for _, each in self.outcomes]
        mean_s = self.mean_s()
        known = bool(outcomes)
        apart = [each.outcome for each in self.results if each.outcome and not each.outcome.safe_start]
        return {
            "group": cell.group,
            "behaviour": cell.behaviour,
            "parameters": dict(cell.parameters),
            "team": cell.team,
            "needs": dict(cell.needs),
            "roles": dict(cell.roles),
            "scenario": cell.scenario,
            "robots": cell.robots,
            "seeds": len(self.results),
            "engine": cell.engine,
            "limits": cell.limits,
            "network": cell.network,
            "noise_m": cell.noise_m,
            "collisions": self.collisions if known else None,
            "robot_collisions": sum(each.robot_events for each in outcomes) if known else None,
            "obstacle_collisions": sum(each.obstacle_events for each in outcomes) if known else None,
            "mover_collisions": sum(each.mover_events for each in outcomes) if known else None,
            "mover_hits": sum(each.mover_hits for each in outcomes) if known else None,
            "pushed_collisions": sum(each.pushed_events for each in outcomes) if known else None,
            "pairs_touched": self.pairs_touched if known else None,
            "robots_touched": self.robots_touched if known else None,
            "colliding_seeds": self.colliding_seeds,
            "arrived_fraction": self.arrived_fraction if known else None,
            "all_arrived_fraction": self.all_arrived_fraction if known else None,
            "late_seeds": self.late_seeds,
            "mean_arrival_s": None if math.isnan(mean_s) else round(mean_s, 3),
            "longest_s": max((each.simulated_s for each in outcomes), default=None),
            "deadlocks": sum(each.deadlocks for each in outcomes) if known else None,
            "deadlock_s": round(sum(each.deadlock_s for each in outcomes), 3) if known else None,
            "left_out": sum(each.left_out for each in outcomes) if known else None,
            "settled": sum(each.settled for each in outcomes) if known else None,
            "quiet_s": max((each.quiet_s for each in outcomes if each.quiet_s is not None), default=None),
            "never_quiet": sum(each.arrived < each.robots and each.quiet_s is None for each in outcomes),
            **{name: self.least_of(name) for name in ("separation_m", "clearance_m", "time_to_contact_s")},
            "reversals_per_s": self.mean_of("reversals_per_s"),
            "speed_variation_m_s2": self.mean_of("speed_variation_m_s2"),
            "turn_variation_rad_s2": self.mean_of("turn_variation_rad_s2"),
            "commands_above_limits": sum(each.above_limits for each in outcomes) if known else None,
            "unsafe_starts": len(apart),
            "unsafe_start_collisions": sum(each.events for each in apart),
            "collisions_expected": cell.collisions_expected,
            "end_reasons": dict(sorted(Counter(each.end_reason for each in self.results if each.end_reason).items())),
            "failed": len(self.failed),
            "failures": sorted({each.failure for each in self.failed}),
        }


@dataclass(slots=True)
class Report:
    """The whole experiment."""

    cells: list[CellResult]
    wall_s: float = 0.0

    @property
    def trials_done(self) -> int:
        """Trials with an outcome."""
        return sum(len(each.results) - len(each.failed) for each in self.cells)

    @property
    def trials_failed(self) -> int:
        """Trials without one."""
        return sum(len(each.failed) for each in self.cells)

    @property
    def collisions(self) -> int:
        """Contact events of all trials that began in the safe set."""
        return sum(each.collisions for each in self.cells)

    @property
    def simulated_s(self) -> float:
        """Simulated seconds of all trials."""
        outcomes = (each.outcome for cell in self.cells for each in cell.results)
        return sum(each.simulated_s for each in outcomes if each)

    @property
    def passed(self) -> bool:
        """No trial failed, none collided but where that was expected, and each cell has one that counts."""
        collisions = sum(each.collisions for each in self.cells if not each.cell.collisions_expected)
        return collisions == 0 and self.trials_failed == 0 and not any(each.is_empty for each in self.cells)

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``--json``."""
        return {
            "trials_done": self.trials_done,
            "trials_failed": self.trials_failed,
            "wall_s": round(self.wall_s, 3),
            "simulated_s": round(self.simulated_s, 3),
            "cells": [each.to_json() for each in self.cells],
        }


def summarise(pairs: Iterable[tuple[Trial, TrialResult]], wall_s: float = 0.0) -> Report:
    """Join trials by cell, in the order in which the cells first come, seeds in order."""
    cells: dict[Cell, CellResult] = {}
    for trial, result in pairs:
        cells.setdefault(trial.cell, CellResult(trial.cell)).results.append(result)
    for each in cells.values():
        each.results.sort(key=lambda result: result.seed)
    return Report(list(cells.values()), wall_s)


NONE = "-"


def table(report: Report) -> Table:
    """Return the results for people."""
    grouped = differ_by_group(each.cell for each in report.cells)
    texts = (*["group"] * grouped, "behaviour", "scenario", "engine", "limits", "bad")
    numbers = ("N", "seeds", "coll.", "pairs", "touched", "robots %", "trials %", "mean s", "blocked", "rev./s")
    view = output.plain_table(*texts, numbers=numbers)
    for cell in report.cells:
        view.add_row(*[cell.cell.group] * grouped, *_row(cell), style="red" if _is_bad(cell) else None)
    return view


def _is_bad(cell: CellResult) -> bool:
    return bool(cell.failed) or cell.is_empty or (cell.collisions > 0 and not cell.cell.collisions_expected)


def _row(cell: CellResult) -> tuple[str, ...]:
    of, mean_s = cell.cell, cell.mean_s()
    return (
        of.label,
        of.scenario,
        of.engine,
        of.limits,
        "network" if of.network else "noise" if of.noise_m or of.noise_rad else "",
        str(of.robots),
        str(len(cell.results)),
        NONE if cell.is_empty else str(cell.collisions),
        NONE if cell.is_empty else str(cell.pairs_touched),
        NONE if cell.is_empty else str(cell.robots_touched),
        _number(100 * cell.arrived_fraction, 1),
        _number(100 * cell.all_arrived_fraction, 0),
        _number(mean_s, 1),
        NONE if cell.is_empty else str(sum(each.deadlocks for _, each in cell.outcomes)),
        NONE if (reversals := cell.mean_of("reversals_per_s")) is None else f"{reversals:.2f}",
    )


def _number(value: float, decimals: int) -> str:
    return NONE if math.isnan(value) else f"{value:.{decimals}f}"


def closing(report: Report) -> str:
    """Return the last lines for people."""
    apart = sum(len(each.results) - len(each.failed) - len(each.outcomes) for each in report.cells)
    above = sum(each.above_limits for cell in report.cells for _, each in cell.outcomes)
    counts = f"{report.trials_done} trials done, {report.trials_failed} failed, {report.collisions} collisions"
    pairs, robots = (sum(getattr(each, name) for each in report.cells) for name in ("pairs_touched", "robots_touched"))
    counts += f" ({pairs} pairs, {robots} robots touched)" * bool(report.collisions)
    pushed = sum(each.pushed_events for cell in report.cells for _, each in cell.outcomes)
    counts += f" (and {pushed} while a mover pushed one of the two)" * bool(pushed)
    lines = [
        f"{counts}, {above} commands above the limits, {apart} starts outside the safe set",
        f"{report.simulated_s:.0f} s simulated in {report.wall_s:.0f} s",
    ]
    grouped = differ_by_group(each.cell for each in report.cells)
    for cell in report.cells:
        words = (*[cell.cell.group] * grouped, *_row(cell)[:5])
        name = " ".join((*filter(None, words), f"N={cell.cell.robots}"))
        if cell.is_empty:
            lines.append(f"nothing counted: {name}")
        if cell.colliding_seeds and not cell.cell.collisions_expected:
            lines.append(f"collided: {name}: seeds {cell.colliding_seeds}")
        lines += [f"failed: {name} seed {each.seed}: {each.failure}" for each in cell.failed]
    return "\n".join(lines)
