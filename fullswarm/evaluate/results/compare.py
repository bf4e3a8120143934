"""Two sets of trials against each other, paired: the same scenario, robots, engine, limits, network and seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec

from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.experiment.plan import Cell, differ_by_group
from fullswarm.evaluate.results.folder import StoredTrial, read_records
from fullswarm.evaluate.results.quantities import Key, in_order, is_dull, values_of
from fullswarm.evaluate.results.statistics import Paired, holm, paired
from fullswarm.units import unit_of

PairKey = tuple[object, ...]
CellKey = tuple[tuple[str, object], ...]
"""What cells of partners share: names of fields and their values."""
FIELDS = ("behaviour", "scenario", "robots", "engine", "limits", "network", "noise_m", "noise_rad", "group")
Read = Callable[[Path], list[StoredTrial]]


@dataclass(frozen=True, slots=True)
class MetricComparison:
    """One quantity in one cell, or in all of them when `cell` is empty."""

    source: str
    name: str
    cell: str
    result: Paired
    wilcoxon_holm_p: float  # corrected for the number of quantities, or of quantities in all cells

    @property
    def unit(self) -> str:
        """Unit of the means and of the difference; empty: a count or a share."""
        return unit_of(self.name)


@dataclass(frozen=True, slots=True)
class Comparison:
    """What came of comparing `b` with `a`: differences are b - a."""

    a: str
    b: str
    pairs: int
    alone_a: int  # trials without a partner, failed ones and those that began outside the safe set
    alone_b: int
    overall: list[MetricComparison]
    cells: list[MetricComparison]

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``--json``; what is not known is null."""
        document: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(asdict(self)))  # NaN → null
        return document


def compare(a: Path, b: Path, read: Read = read_records) -> Comparison:
    """Compare two results folders: the trials of `b` with the same trials of `a`.

    When they share no behaviour and each holds one only, the two behaviours are compared.

    Raises
    ------
    ConfigError
        A folder holds no trials, or there is no pair.
    """
    first, second = read(a), read(b)
    names = [{each.record.trial.cell.label for each in side} for side in (first, second)]
    across = not (names[0] & names[1]) and len(names[0]) == len(names[1]) == 1
    without = "behaviour" if across else ""
    groups = any(differ_by_group(each.record.trial.cell for each in side) for side in (first, second))
    return compare_trials(first, second, (str(a), str(b)), lambda cell: condition_of(cell, without, groups))


def compare_by(out: Path, field: str, a: str, b: str, read: Read = read_records) -> Comparison:
    """Compare two values of a cell's field within one folder: behaviours, engines, limits, groups, ….

    A behaviour can be named with its parameters: ``navigate_bc map=own``.

    Raises
    ------
    ConfigError
        No such field or value, a value that fits several trials of a pair, or no pair at all.
    """
    if field not in FIELDS:
        raise ConfigError(f"trials cannot be compared by '{field}'", where="--by", hint=did_you_mean(field, FIELDS))
    trials = read(out)
    sides: list[list[StoredTrial]] = []
    for value in (a, b):
        fits = [each for each in trials if value in _names(each.record.trial.cell, field)]
        if not fits:
            known = {_names(each.record.trial.cell, field)[0] for each in trials}
            raise ConfigError(f"no trial has {field} '{value}'", where=str(out), hint=did_you_mean(value, known))
        sides.append(fits)
    groups = differ_by_group(each.record.trial.cell for each in trials)
    return compare_trials(sides[0], sides[1], (a, b), lambda cell: condition_of(cell, field, groups))


def compare_trials(
    a: list[StoredTrial], b: list[StoredTrial], names: tuple[str, str], condition: Callable[[Cell], PairKey]
) -> Comparison:
    """Compare trials that have the same condition and seed.

    Raises
    ------
    ConfigError
        Several trials of a side would be one half of the same pair, or there is no pair.
    """
    first, second = (_by_key(side, name, condition) for side, name in zip((a, b), names, strict=True))
    keys = [key for key in first if key in second]
    if not keys:
        raise ConfigError(
            f"no trial of '{names[0]}' has a partner in '{names[1]}'",
            hint="partners have the same scenario, robots, engine, limits, network and seed",
        )
    pairs = [(key[:-1], values_of(first[key].record), values_of(second[key].record)) for key in keys]
    cells: dict[PairKey, list[tuple[dict[Key, float], dict[Key, float]]]] = {}
    for key, one, other in pairs:
        cells.setdefault(key, []).append((one, other))
    return Comparison(
        a=names[0],
        b=names[1],
        pairs=len(pairs),
        alone_a=len(a) - len(pairs),
        alone_b=len(b) - len(pairs),
        overall=_corrected(_metrics("", [(one, other) for _, one, other in pairs])),
        cells=_corrected(
            [each for key, some in cells.items() for each in _metrics(" ".join(filter(None, map(_text, key))), some)]
        ),
    )


def _corrected(found: list[_Measured]) -> list[MetricComparison]:
    """Return comparisons with p values corrected for all that people read; the same clock many times counts never."""
    tested = holm([result.wilcoxon_p for (_, name), _, result in found if not is_dull(name)])
    return [
        MetricComparison(*key, cell, result, result.wilcoxon_p if is_dull(key[1]) else tested.pop(0))
        for key, cell, result in found
    ]


_Measured = tuple[Key, str, Paired]


def _metrics(cell: str, pairs: list[tuple[dict[Key, float], dict[Key, float]]]) -> list[_Measured]:
    found = []
    for key in in_order(key for pair in pairs for values in pair for key in values):
        both = [(one[key], other[key]) for one, other in pairs if key in one and key in other]
        if both:
            result = paired([one for one, _ in both], [other for _, other in both])
            found.append((key, cell, result))
    return found


def _by_key(trials: list[StoredTrial], name: str, condition: Callable[[Cell], PairKey]) -> dict[PairKey, StoredTrial]:
    found: dict[PairKey, StoredTrial] = {}
    for stored in trials:
        if not stored.counts:
            continue
        trial = stored.record.trial
        # Bodies and agents are part of the limits' name and of the group only by convention: seed last.
        key = (*condition(trial.cell), trial.seed)
        if key in found:
            raise ConfigError(
                f"'{name}' fits several trials of one pair: {found[key].record.id} and {stored.record.id}",
                hint="name the behaviour with its parameters, as in 'navigate_bc map=own', or compare --by group",
            )
        found[key] = stored
    return found


def condition_of(cell: Cell, without: str, groups: bool) -> CellKey:
    """Return what partners share; the group only where cells differ by nothing else: elsewhere it is but a name."""
    fields = {"behaviour": cell.label, **{name: getattr(cell, name) for name in FIELDS[1:]}}
    left_out = (without,) if groups else (without, "group")
    return tuple((name, value) for name, value in fields.items() if name not in left_out)


def _names(cell: Cell, field: str) -> tuple[str, ...]:
    return (cell.label, cell.behaviour) if field == "behaviour" else (str(getattr(cell, field)),)


def _text(pair: object) -> str:
    """Return a part of a condition for people; what is as usual needs no word."""
    name, value = pair if isinstance(pair, tuple) else ("", pair)
    if name == "robots":
        return f"N={value}"
    if name in ("noise_m", "noise_rad"):
        return f"{name}={value}" if value else ""
    return str(value)
