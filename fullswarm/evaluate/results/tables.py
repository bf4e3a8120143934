"""The report's tables, as data: for HTML and for Markdown."""

from __future__ import annotations

import math
from dataclasses import dataclass
from urllib.parse import quote

from fullswarm.evaluate.experiment.plan import differ_by_group
from fullswarm.evaluate.experiment.record import RESULT_FILE, TRIAL_FILE, TRIALS
from fullswarm.evaluate.results.folder import Folder, StoredTrial
from fullswarm.evaluate.results.quantities import (
    ARRIVED,
    COLLISIONS,
    COVERAGE,
    PAIRS,
    TIME,
    TOUCHED,
    WORK,
    Quantity,
)
from fullswarm.evaluate.results.sample import Condition, Sample, bare, is_filtered
from fullswarm.evaluate.results.statistics import describe, paired, wilson
from fullswarm.units import unit_of

NONE = "–"


@dataclass(frozen=True, slots=True)
class Entry:
    """A field of a table; `tone` is "bad" or "good" where that can be said."""

    text: str
    href: str = ""
    tone: str = ""


@dataclass(frozen=True, slots=True)
class Grid:
    """A table; its first `words` columns are text, the others figures."""

    headers: list[str]
    rows: list[list[Entry]]
    words: int = 1

    def markdown(self) -> str:
        """Return the table as Markdown, without links."""
        rule = ["---" if place < self.words else "---:" for place in range(len(self.headers))]
        lines = [self.headers, rule, *([entry.text.replace("|", "\\|") for entry in row] for row in self.rows)]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def cells_grid(condition: Condition) -> Grid:
    """Return all cells with means, quartiles and 95 % confidence intervals."""
    headers = ["Scenario", "Behaviour", "Robots", "Trials", "Collisions per trial", "Median (quartiles)"]
    headers += [
        PAIRS.label,
        TOUCHED.label,
        "Trials with collisions [%]",
        "Robots that arrived [%]",
        "Trials in which all arrived [%]",
    ]
    headers += [each.label for each in (TIME, WORK, COVERAGE)]
    return Grid(headers, [_cell_row(each) for each in condition.samples], words=2)


def _cell_row(sample: Sample) -> list[Entry]:
    cell, events, count = sample.cell, sample.of(COLLISIONS), len(sample.counted)
    struck = sum(each > 0 for each in events)
    described = describe(events)
    quartiles = f"{described.median:g} ({described.lower_quartile:g} to {described.upper_quartile:g})"
    all_arrived = sum(each[("outcome", "all_arrived")] > 0 for each in sample.values)
    notes = [f"{sample.failed} failed"] * bool(sample.failed) + [f"{sample.apart} apart"] * bool(sample.apart)
    return [
        Entry(cell.scenario),
        Entry(cell.label),
        Entry(str(cell.robots)),
        Entry(f"{count}{' (' + ', '.join(notes) + ')' if notes else ''}", tone="bad" if sample.failed else ""),
        Entry(
            _mean(sample, COLLISIONS),
            tone="" if not count or (struck and cell.collisions_expected) else "bad" if struck else "good",
        ),
        Entry(quartiles if count else NONE),
        Entry(_mean(sample, PAIRS)),
        Entry(_mean(sample, TOUCHED)),
        Entry(_share(struck, count)),
        Entry(_mean(sample, ARRIVED)),
        Entry(_share(all_arrived, count)),
        *(Entry(_mean(sample, each)) for each in (TIME, WORK, COVERAGE)),
    ]


def filter_grid(condition: Condition) -> Grid | None:
    """Return each behaviour with and without the safety filter, paired by seed; None when there is no such pair."""
    headers = ["Scenario", "Behaviour", "Robots", "Pairs", "Without filter", "With filter", "Difference"]
    headers += ["Fewer / equal / more", "Rank-biserial", "Cohen's dz", "p (signed-rank)", "p (sign)"]
    rows = []
    for sample in condition.samples:
        cell = sample.cell
        if not is_filtered(cell.label):
            continue
        other = condition.sample(cell.scenario, bare(cell.label), cell.robots)
        if other is not None and (row := _filter_row(other, sample)):
            rows.append(row)
    return Grid(headers, rows, words=2) if rows else None


def _filter_row(without: Sample, behind: Sample) -> list[Entry]:
    first, second = (
        dict(zip((each.record.trial.seed for each in sample.counted), sample.of(COLLISIONS), strict=True))
        for sample in (without, behind)
    )
    seeds = [seed for seed in first if seed in second]
    if not seeds:
        return []
    result = paired([first[seed] for seed in seeds], [second[seed] for seed in seeds])
    cell = behind.cell
    tone = "good" if result.mean_b <= result.mean_a else "bad"
    return [
        Entry(cell.scenario),
        Entry(bare(cell.label)),
        Entry(str(cell.robots)),
        Entry(str(result.count)),
        Entry(f"{result.mean_a:.2f}"),
        Entry(f"{result.mean_b:.2f}", tone=tone),
        Entry(interval(result.mean_difference, result.low, result.high, 2)),
        Entry(f"{result.less} / {result.equal} / {result.more}"),
        Entry(f"{result.rank_biserial:+.2f}"),
        Entry(NONE if result.dz is None else f"{result.dz:+.2f}"),
        Entry(p_text(result.wilcoxon_p)),
        Entry(p_text(result.sign_p)),
    ]


def agreement_grid(condition: Condition) -> Grid | None:
    """Return what the robots measured of themselves beside the truth; None when no value has both."""
    values = [each for sample in condition.samples for each in sample.values]
    names = sorted(
        {name for each in values for source, name in each if source == "truth" and ("onboard", name) in each}
    )
    rows = []
    for name in names:
        both = [
            (each[("truth", name)], each[("onboard", name)])
            for each in values
            if {("truth", name), ("onboard", name)} <= each.keys()
        ]
        result = paired([true for true, _ in both], [told for _, told in both])
        largest = max(abs(told - true) for true, told in both)
        rows.append(
            [
                Entry(name),
                Entry(unit_of(name)),
                Entry(str(result.count)),
                Entry(f"{result.mean_a:.4g}"),
                Entry(f"{result.mean_b:.4g}"),
                Entry(interval(result.mean_difference, result.low, result.high, 4)),
                Entry(f"{largest:.4g}"),
            ]
        )
    headers = ["Quantity", "Unit", "Trials", "True mean", "On-board mean", "On-board − true", "Largest difference"]
    return Grid(headers, rows, words=2) if rows else None


def trials_grid(trials: list[StoredTrial]) -> Grid:
    """Return every trial with links to its files."""
    headers = ["Scenario", "Behaviour", "Engine, limits", "End", "Files", "", "Robots", "Seed", "Collisions"]
    headers += ["Arrived", "Simulated [s]", "Wall [s]"]
    rows = [_trial_row(each) for each in trials]
    if not differ_by_group(each.record.trial.cell for each in trials):
        return Grid(headers, rows, words=6)
    groups = [Entry(each.record.trial.cell.group) for each in trials]
    return Grid(["Group", *headers], [[group, *row] for group, row in zip(groups, rows, strict=True)], words=7)


def _trial_row(stored: StoredTrial) -> list[Entry]:
    record, folder = stored.record, _link(stored)
    cell, outcome = record.trial.cell, record.outcome
    return [
        Entry(cell.scenario),
        Entry(cell.label),
        Entry(f"{cell.engine}, {cell.limits}"),
        Entry(record.end_reason or ("failed" if outcome is None else NONE), tone="bad" if outcome is None else ""),
        Entry("result", f"{folder}{RESULT_FILE}"),
        Entry("launch file", f"{folder}{TRIAL_FILE}"),
        Entry(str(cell.robots)),
        Entry(str(record.trial.seed)),
        Entry(str(outcome.events) if outcome else NONE),
        Entry(f"{outcome.arrived}/{outcome.robots}" if outcome else NONE),
        Entry(f"{outcome.simulated_s:.1f}" if outcome else NONE),
        Entry(f"{stored.provenance.wall_s:.1f}"),
    ]


def trouble_grid(folder: Folder) -> Grid | None:
    """Return missing, failed, retried and unreadable trials with reason and folder; None when there are none."""
    rows = [
        [Entry(name), Entry("missing", tone="bad"), Entry("asked for, not run yet"), Entry(NONE)]
        for name in folder.missing
    ]
    for stored in folder.trials:
        attempts = stored.provenance.attempts
        if stored.record.outcome is None:
            what, tone = f"failed after {attempts} attempts" if attempts > 1 else "failed", "bad"
        elif attempts > 1:
            what, tone = f"done at attempt {attempts}", ""
        else:
            continue
        reason = stored.record.failure or NONE
        rows.append(
            [Entry(stored.record.trial.label), Entry(what, tone=tone), Entry(reason), Entry("folder", _link(stored))]
        )
    for problem in folder.problems:
        href = quote(str(problem.path.relative_to(folder.path)))
        rows.append(
            [Entry(problem.path.name), Entry("unreadable", tone="bad"), Entry(problem.reason), Entry("folder", href)]
        )
    return Grid(["Trial", "What", "Reason", "Files"], rows, words=4) if rows else None


def _link(stored: StoredTrial) -> str:
    return f"{TRIALS}/{quote(stored.path.name)}/"


def _mean(sample: Sample, quantity: Quantity) -> str:
    result = describe(sample.of(quantity), at_least=0.0)
    return interval(
        result.mean, result.low, min(result.high, 100.0) if quantity.unit == "%" else result.high, quantity.decimals
    )


def _share(count: int, total: int) -> str:
    if not total:
        return NONE
    low, high = wilson(count, total)
    return interval(100.0 * count / total, 100.0 * low, 100.0 * high, 0)


def interval(value: float, low: float, high: float, decimals: int) -> str:
    """Return ``value [low, high]``; an unknown interval is left out."""
    if math.isnan(value):
        return NONE
    text = f"{value:.{decimals}f}"
    return text if math.isnan(low) else f"{text} [{low:.{decimals}f}, {high:.{decimals}f}]"


def p_text(p: float) -> str:
    """Return a p for people."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"
