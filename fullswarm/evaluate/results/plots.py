"""The report's plots of figures: box plots with all points (the paper's Figures 4 and 5), and means over size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fullswarm.evaluate.results.quantities import COLLISIONS, SHOWN, Quantity
from fullswarm.evaluate.results.sample import Condition, shown
from fullswarm.evaluate.results.statistics import describe
from fullswarm.evaluate.results.svg import COLOURS, INK, MARKERS, legend_below, panels, style, to_svg

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

COLUMNS = 2
PAGE_IN = 9.0
"""Width of a figure in inches."""


@dataclass(frozen=True, slots=True)
class Plot:
    """A figure: file name without its end, caption, SVG document."""

    name: str
    caption: str
    svg: str


def collisions_plot(condition: Condition, name: str) -> Plot | None:
    """Return box plots of collisions over the number of robots, a panel per scenario; None: no trial counts."""
    if not _is_known(condition, COLLISIONS):
        return None
    scenarios = condition.scenarios
    columns = min(COLUMNS, len(scenarios))
    rows = math.ceil(len(scenarios) / columns)
    with style(name):
        figure, axes = panels(rows, columns, PAGE_IN / max(columns, 1.4), 2.9)
        handles: dict[str, Artist] = {}
        for axis, scenario in zip(axes, scenarios, strict=False):
            handles |= _boxes(axis, condition, scenario)
        for axis in axes[len(scenarios) :]:
            axis.remove()
        legend_below(figure, list(handles.values()), [shown(each) for each in handles])
        caption = (
            "Collisions per trial over the number of robots. Box: quartiles and median; whiskers: the farthest trial "
            f"within 1.5 box heights; each point is one trial; white diamond: mean. {condition.name}."
        )
        return Plot(name, caption, to_svg(figure, name, f"Collisions per trial, {condition.name}"))


def _boxes(axis: Axes, condition: Condition, scenario: str) -> dict[str, Artist]:
    """Draw one scenario; return a handle for the legend per behaviour."""
    from matplotlib.ticker import MaxNLocator

    sizes, behaviours = condition.sizes(scenario), condition.behaviours
    slot = 0.8 / len(behaviours)
    handles: dict[str, Artist] = {}
    for row, behaviour in enumerate(behaviours):
        colour, marker = COLOURS[row % len(COLOURS)], MARKERS[row % len(MARKERS)]
        for place, robots in enumerate(sizes):
            sample = condition.sample(scenario, behaviour, robots)
            values = sample.of(COLLISIONS) if sample else []
            if not values:
                continue
            centre = place + slot * (row - 0.5 * (len(behaviours) - 1))
            _box(axis, values, centre, 0.62 * slot, colour)
            spread = centre + 0.42 * slot * _spread(len(values))
            (points,) = axis.plot(
                spread, values, marker, color=colour, markersize=3.0, alpha=0.65, markeredgewidth=0.0, zorder=3
            )
            axis.plot(centre, np.mean(values), "D", color="white", markeredgecolor=INK, markersize=3.4, zorder=4)
            handles.setdefault(behaviour, points)
    axis.set_xticks(range(len(sizes)), [str(each) for each in sizes])
    axis.set_xlim(-0.6, len(sizes) - 0.4)
    axis.set_title(scenario.replace("_", " "))
    axis.set_xlabel("Number of robots")
    axis.set_ylabel(COLLISIONS.label)
    axis.grid(axis="y")
    top = max(axis.get_ylim()[1], 1.0)
    axis.set_ylim(-0.03 * top, top)
    axis.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True, steps=[1, 2, 5, 10]))
    return handles


def _box(axis: Axes, values: list[float], centre: float, width: float, colour: str) -> None:
    line = {"color": colour, "linewidth": 1.1}
    axis.boxplot(
        [values],
        positions=[centre],
        widths=[width],
        showfliers=False,  # every trial is drawn as a point anyway
        manage_ticks=False,
        patch_artist=True,
        boxprops={"facecolor": f"{colour}30", "edgecolor": colour, "linewidth": 1.1},
        medianprops={"color": colour, "linewidth": 2.2},
        whiskerprops=line,
        capprops=line,
    )


def _spread(count: int) -> NDArray[np.float64]:
    """Return places in [-0.5, 0.5] that keep points apart: the golden ratio's multiples, the same every time."""
    places: NDArray[np.float64] = (np.arange(count, dtype=np.float64) * 0.6180339887 + 0.5) % 1.0 - 0.5
    return places


def means_plot(condition: Condition, name: str, quantities: tuple[Quantity, ...] = SHOWN[1:]) -> Plot | None:
    """Return means with confidence intervals over the number of robots: quantities down, scenarios across."""
    scenarios = condition.scenarios
    known = [each for each in quantities if _is_known(condition, each)]
    if not known:
        return None
    with style(name):
        width = max(PAGE_IN / len(scenarios), 1.9) if len(scenarios) > 1 else 0.6 * PAGE_IN
        figure, axes = panels(len(known), len(scenarios), width, 1.75, sharey="row", sharex="col")
        handles: dict[str, Artist] = {}
        for place, axis in enumerate(axes):
            row, column = divmod(place, len(scenarios))
            handles |= _means(axis, condition, scenarios[column], known[row])
            if row == 0:
                axis.set_title(scenarios[column].replace("_", " "))
            if row == len(known) - 1:
                axis.set_xlabel("Number of robots")
            if column == 0:
                axis.set_ylabel(f"{known[row].title}\n[{known[row].unit}]")
        for row, quantity in enumerate(known):  # the panels of a row share their axis: once all is drawn
            first = axes[row * len(scenarios)]
            top = first.get_ylim()[1]
            first.set_ylim(0.0, min(top, 105.0) if quantity.unit == "%" else top)
        legend_below(figure, list(handles.values()), [shown(each) for each in handles])
        figure.align_ylabels()
        caption = (
            "Mean with 95 % confidence interval over the number of robots. No point: no trial has the value, as in the "
            f"time until all arrived when they never did. {condition.name}."
        )
        return Plot(name, caption, to_svg(figure, name, f"Arrivals, times, work and coverage, {condition.name}"))


def _is_known(condition: Condition, quantity: Quantity) -> bool:
    return any(math.isfinite(value) for sample in condition.samples for value in sample.of(quantity))


def _means(axis: Axes, condition: Condition, scenario: str, quantity: Quantity) -> dict[str, Artist]:
    sizes, behaviours = condition.sizes(scenario), condition.behaviours
    handles: dict[str, Artist] = {}
    for row, behaviour in enumerate(behaviours):
        samples = [condition.sample(scenario, behaviour, robots) for robots in sizes]
        points = [
            (place, describe(sample.of(quantity), at_least=0.0)) for place, sample in enumerate(samples) if sample
        ]
        points = [(place, each) for place, each in points if each.count]
        if not points:
            continue
        shift = 0.12 * (row - 0.5 * (len(behaviours) - 1))
        mean = np.array([each.mean for _, each in points])
        bars = np.nan_to_num([(each.mean - each.low, each.high - each.mean) for _, each in points]).T
        colour = COLOURS[row % len(COLOURS)]
        x = np.array([place for place, _ in points]) + shift
        axis.plot(x, mean, color=colour, linewidth=0.8, alpha=0.5)
        container = axis.errorbar(
            x, mean, bars, fmt=MARKERS[row % len(MARKERS)], color=colour, markersize=4.0, capsize=2.5, linewidth=1.2
        )
        handles[behaviour] = container.lines[0]
    axis.set_xticks(range(len(sizes)), [str(each) for each in sizes])
    axis.set_xlim(-0.5, len(sizes) - 0.5)
    axis.grid(axis="y")
    return handles
