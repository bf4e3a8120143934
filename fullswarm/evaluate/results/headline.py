"""Chooses the main comparison of an experiment and estimates its effect, for the head of the report.

The comparison is what the experiment varies besides arena, size and seed: with and without the safety filter, else the
one field that has two values. The quantity is the first of `SHOWN` that differs in any trial. The seed is the unit:
trials of one seed have their starts and obstacles in common, so that a seed's mean over all cells is one observation,
and the interval is Student's t of the paired observations, or Welch's when the two sides have no seed in common.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fullswarm.evaluate.experiment.plan import Cell, differ_by_group
from fullswarm.evaluate.results.compare import CellKey, condition_of
from fullswarm.evaluate.results.folder import StoredTrial
from fullswarm.evaluate.results.quantities import SHOWN, Quantity, values_of
from fullswarm.evaluate.results.sample import PAPER_ORDER, bare, is_filtered
from fullswarm.evaluate.results.statistics import paired, two_groups

FIELDS = ("behaviour", "limits", "network", "engine", "noise_m", "noise_rad", "group")
Means = dict[CellKey, dict[int, float]]
"""By condition and seed."""


@dataclass(frozen=True, slots=True)
class Effect:
    """Difference b - a and its 95 % interval, NaN where it is unknown, and the single differences behind it."""

    name: str
    a: float
    b: float
    difference: float
    low: float
    high: float
    differences: tuple[float, ...]  # of each seed; empty: not paired


@dataclass(frozen=True, slots=True)
class Headline:
    """The main comparison: `whole` over all cells, `cells` one by one."""

    quantity: Quantity
    a: str
    b: str
    paired: bool
    seeds: int  # observations: pairs, or the fewer of both sides
    left_out: int  # conditions that too few seeds have in common with the others
    whole: Effect
    cells: tuple[Effect, ...]

    @property
    def sentence(self) -> str:
        """The comparison in one sentence."""
        return f"{self.verdict}: {self.detail}."

    @property
    def detail(self) -> str:
        """Both means, the difference, its interval and what it rests on."""
        effect, digits = self.whole, self.quantity.decimals + 1
        unit = f" {self.quantity.unit}" if self.quantity.unit else ""
        how = f"paired over {counted(self.seeds, 'seed')}" if self.paired else "two independent groups"
        if math.isnan(effect.low):
            interval = "no interval: the difference does not vary" if self.seeds > 1 else "no interval: one seed"
        else:
            interval = f"95 % confidence interval {signed(effect.low, digits)} to {signed(effect.high, digits)}{unit}"
        cells = counted(len(self.cells), "cell")
        return (
            f"{effect.b:.{digits}f}{unit} {self.b}, {effect.a:.{digits}f}{unit} {self.a}; difference "
            f"{signed(effect.difference, digits)}{unit} ({interval}; {how}, mean over {cells})"
        )

    @property
    def verdict(self) -> str:
        """What the interval says of the difference, and no more."""
        effect, title = self.whole, self.quantity.title
        if math.isnan(effect.low) or effect.low <= 0.0 <= effect.high:
            return f"{title}: no difference shown {self.b} and {self.a}"
        return f"{title}: {'higher' if effect.low > 0.0 else 'lower'} {self.b}"


def counted(number: int, noun: str) -> str:
    """Return a number with its noun."""
    return f"{number} {noun}{'s' * (number != 1)}"


def signed(value: float, digits: int) -> str:
    """Return a number with its sign, a true minus; zero has none."""
    text = f"{value:+.{digits}f}".replace("-", "−")
    return text[1:] if not float(f"{value:.{digits}f}") else text


def headline(trials: Sequence[StoredTrial]) -> Headline | None:
    """Return the main comparison of an experiment; None: it compares nothing, or more than two things.

    Raises
    ------
    MissingExtra
        SciPy is not installed.
    """
    counted = [each for each in trials if each.counts]
    for choose in (_by_filter, *(_by_field(field) for field in FIELDS)):
        sides = choose(counted)
        if sides is not None:
            return _compare(sides)
    return None


@dataclass(frozen=True, slots=True)
class _Sides:
    names: tuple[str, str]
    trials: tuple[list[StoredTrial], list[StoredTrial]]
    condition: Callable[[Cell], CellKey]


def _by_filter(trials: list[StoredTrial]) -> _Sides | None:
    """Return the behaviours that ran without and with the safety filter; None when there are other pairs as well."""
    groups = differ_by_group(each.record.trial.cell for each in trials)

    def condition(cell: Cell) -> CellKey:
        return ("behaviour", bare(cell.label)), *condition_of(cell, "behaviour", groups)

    sides: tuple[list[StoredTrial], list[StoredTrial]] = ([], [])
    for each in trials:
        sides[is_filtered(each.record.trial.cell.label)].append(each)
    common = {condition(each.record.trial.cell) for each in sides[0]}
    common &= {condition(each.record.trial.cell) for each in sides[1]}
    kept = tuple([each for each in side if condition(each.record.trial.cell) in common] for side in sides)
    behaviours = {bare(each.record.trial.cell.label) for side in kept for each in side}
    if not common or len(behaviours) != len({bare(each.record.trial.cell.label) for each in trials}):
        return None
    return _Sides(("without the safety filter", "with the safety filter"), (kept[0], kept[1]), condition)


def _by_field(field: str) -> Callable[[list[StoredTrial]], _Sides | None]:
    def choose(trials: list[StoredTrial]) -> _Sides | None:
        groups = differ_by_group(each.record.trial.cell for each in trials)
        if field == "group" and not groups:
            return None
        names = list(dict.fromkeys(_value(each.record.trial.cell, field) for each in trials))
        if len(names) != 2:
            return None
        first, second = ([e for e in trials if _value(e.record.trial.cell, field) == name] for name in names)

        def condition(cell: Cell) -> CellKey:
            return condition_of(cell, field, groups)

        shared = {condition(e.record.trial.cell) for e in first} & {condition(e.record.trial.cell) for e in second}
        shown = tuple(_named(field, name) for name in names)
        return _Sides((shown[0], shown[1]), (first, second), condition) if shared else None

    return choose


def _value(cell: Cell, field: str) -> str:
    return cell.label if field == "behaviour" else str(getattr(cell, field))


def _named(field: str, value: str) -> str:
    if field == "behaviour":
        return f"with {value}"
    if field == "network":
        return f"on the network “{value}”" if value else "on a good network"
    return f"with {field.replace('_', ' ')} “{value}”"


def _compare(sides: _Sides) -> Headline | None:
    for quantity in SHOWN:
        first, second = (_means(side, sides.condition, quantity) for side in sides.trials)
        shared = [key for key in first if key in second]
        values = {value for means in (first, second) for key in shared for value in means[key].values()}
        if shared and len(values) > 1:
            return _estimate(sides.names, quantity, first, second, shared)
    return None


def _means(trials: list[StoredTrial], condition: Callable[[Cell], CellKey], quantity: Quantity) -> Means:
    sums: dict[CellKey, dict[int, list[float]]] = {}
    for each in trials:
        value = quantity.of(values_of(each.record))
        if math.isfinite(value):
            trial = each.record.trial
            sums.setdefault(condition(trial.cell), {}).setdefault(trial.seed, []).append(value)
    return {key: {seed: sum(some) / len(some) for seed, some in sorted(seeds.items())} for key, seeds in sums.items()}


def _estimate(
    names: tuple[str, str], quantity: Quantity, first: Means, second: Means, shared: list[CellKey]
) -> Headline:
    is_paired = any(set(first[key]) & set(second[key]) for key in shared)
    if is_paired:
        kept, seeds = _complete({key: set(first[key]) & set(second[key]) for key in shared})
        left, right = seeds, seeds
    else:
        kept, left = _complete({key: set(first[key]) for key in shared})
        kept, right = _complete({key: set(second[key]) for key in kept})
    a = [_average(first, kept, seed) for seed in left]
    b = [_average(second, kept, seed) for seed in right]
    ordered = sorted(kept, key=_order)
    return Headline(
        quantity=quantity,
        a=names[0],
        b=names[1],
        paired=is_paired,
        seeds=min(len(a), len(b)),
        left_out=len(shared) - len(kept),
        whole=_effect("All cells" if len(kept) > 1 else "All trials", a, b, is_paired),
        cells=tuple(_cell_effect(key, first[key], second[key], is_paired, ordered) for key in ordered),
    )


def _complete(seeds: dict[CellKey, set[int]]) -> tuple[list[CellKey], list[int]]:
    """Return the conditions that at least two seeds have all of, and these seeds; those with fewest seeds go first."""
    kept = sorted((key for key in seeds if seeds[key]), key=lambda key: len(seeds[key]))
    while len(kept) > 1 and len(set.intersection(*(seeds[key] for key in kept))) < 2:
        kept.pop(0)
    return kept, sorted(set.intersection(*(seeds[key] for key in kept)))


def _average(means: Means, kept: list[CellKey], seed: int) -> float:
    return sum(means[key][seed] for key in kept) / len(kept)


def _cell_effect(
    key: CellKey, a: dict[int, float], b: dict[int, float], is_paired: bool, others: list[CellKey]
) -> Effect:
    name = condition_text(key, others)
    if not is_paired:
        return _effect(name, list(a.values()), list(b.values()), is_paired)
    seeds = [seed for seed in a if seed in b]
    return _effect(name, [a[seed] for seed in seeds], [b[seed] for seed in seeds], is_paired)


def _effect(name: str, a: list[float], b: list[float], is_paired: bool) -> Effect:
    if is_paired:
        found = paired(a, b)
        each = tuple(two - one for one, two in zip(a, b, strict=True))
        return Effect(name, found.mean_a, found.mean_b, found.mean_difference, found.low, found.high, each)
    difference, low, high = two_groups(a, b)
    return Effect(name, sum(a) / len(a), sum(b) / len(b), difference, low, high, ())


def condition_text(key: CellKey, others: Sequence[CellKey]) -> str:
    """Return a condition for people: only what is not the same in all of them."""
    own, first = dict(key), dict(others[0])
    varying = {name for each in others for name, value in each if value != first.get(name)}
    words = [f"{value} robots" if name == "robots" else str(value) for name, value in key if name in varying]
    return ", ".join(words or [str(own.get("scenario", "all"))]).replace("_", " ")


def _order(key: CellKey) -> tuple[object, ...]:
    own = dict(key)
    scenario = str(own.get("scenario", ""))
    place = PAPER_ORDER.index(scenario) if scenario in PAPER_ORDER else len(PAPER_ORDER)
    return str(own.get("behaviour", "")), place, scenario, own.get("robots"), str(key)
