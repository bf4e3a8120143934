"""Trials sorted for tables and figures: conditions (engine, limits, network), scenarios, sizes, behaviours."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from fullswarm.evaluate.experiment.plan import Cell, differ_by_group
from fullswarm.evaluate.results.folder import StoredTrial
from fullswarm.evaluate.results.quantities import Key, Quantity, values_of

FILTERED = "_bc"
"""End of the names of behaviours behind the safety filter."""


@dataclass(frozen=True)
class Sample:
    """The trials of one cell whose figures count, and the others."""

    cell: Cell
    trials: list[StoredTrial]

    @cached_property
    def counted(self) -> list[StoredTrial]:
        """Trials with an outcome that began in the safe set, by seed."""
        return sorted((each for each in self.trials if each.counts), key=lambda each: each.record.trial.seed)

    @cached_property
    def values(self) -> list[dict[Key, float]]:
        """All figures of the counted trials."""
        return [values_of(each.record) for each in self.counted]

    def of(self, quantity: Quantity) -> list[float]:
        """Return one quantity of the counted trials; NaN for a trial that has none."""
        return [quantity.of(values) for values in self.values]

    @property
    def failed(self) -> int:
        """Trials without an outcome."""
        return sum(each.record.outcome is None for each in self.trials)

    @property
    def apart(self) -> int:
        """Trials that began outside the safe set: their figures are in no other."""
        return len(self.trials) - len(self.counted) - self.failed


@dataclass(frozen=True)
class Condition:
    """All cells with the same engine, limits, network and noise, and group if need be: what one figure shows."""

    name: str
    samples: list[Sample]

    @cached_property
    def scenarios(self) -> list[str]:
        """Names, the paper's first."""
        return _unique((each.cell.scenario for each in self.samples), PAPER_ORDER)

    @cached_property
    def behaviours(self) -> list[str]:
        """Labels, each unfiltered one before its filtered one."""
        return sorted({each.cell.label for each in self.samples}, key=lambda label: (bare(label), label))

    def sizes(self, scenario: str) -> list[int]:
        """Return the numbers of robots that were tried in a scenario."""
        return sorted({each.cell.robots for each in self.samples if each.cell.scenario == scenario})

    def sample(self, scenario: str, behaviour: str, robots: int) -> Sample | None:
        """Return one cell, None when it was not tried."""
        wanted = scenario, behaviour, robots
        cells = (each for each in self.samples if (each.cell.scenario, each.cell.label, each.cell.robots) == wanted)
        return next(cells, None)


PAPER_ORDER = ("empty", "empty_dense", "uniform", "concave", "corridor")


def conditions(trials: Iterable[StoredTrial]) -> list[Condition]:
    """Return the trials by condition and cell; where cells differ by their group alone, each group has its own."""
    cells: dict[str, dict[Cell, list[StoredTrial]]] = {}
    for stored in trials:
        cell = stored.record.trial.cell
        cells.setdefault(condition_name(cell), {}).setdefault(cell, []).append(stored)
    found: list[Condition] = []
    for name, of in cells.items():
        samples = sorted((Sample(cell, some) for cell, some in of.items()), key=_cell_order)
        if not differ_by_group(of):
            found.append(Condition(name, samples))
            continue
        groups = dict.fromkeys(each.cell.group for each in samples)
        found += [Condition(f"{name}, {group}", [s for s in samples if s.cell.group == group]) for group in groups]
    return found


def condition_name(cell: Cell) -> str:
    """Return what is the same in all panels of a figure."""
    noise = f"noise {cell.noise_m:g} m, {cell.noise_rad:g} rad" if cell.noise_m or cell.noise_rad else ""
    return ", ".join(filter(None, (f"{cell.engine} engine", f"limits “{cell.limits}”", cell.network, noise)))


def bare(label: str) -> str:
    """Return a behaviour's label as it is without the filter."""
    name, _, parameters = label.partition(" ")
    return f"{name.removesuffix(FILTERED)} {parameters}".strip()


def is_filtered(label: str) -> bool:
    """Tell whether a behaviour runs behind the safety filter."""
    return label.split(" ")[0].endswith(FILTERED)


def shown(label: str) -> str:
    """Return a behaviour's label for people."""
    return f"{label} (filtered)" if is_filtered(label) else label


def _unique(names: Iterable[str], first: tuple[str, ...]) -> list[str]:
    order = {name: place for place, name in enumerate(first)}
    return sorted(set(names), key=lambda name: (order.get(name, len(first)), name))


def _cell_order(sample: Sample) -> tuple[object, ...]:
    cell = sample.cell
    place = PAPER_ORDER.index(cell.scenario) if cell.scenario in PAPER_ORDER else len(PAPER_ORDER)
    return place, cell.scenario, cell.robots, bare(cell.label), cell.label, cell.group
