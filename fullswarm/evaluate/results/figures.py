"""Draws the report's figures as SVG text: the same bytes for the same data, fit to stand inside an HTML page.

The effect of the main comparison, box plots with all points (the paper's Figures 4 and 5), means over size,
trajectories of chosen trials, and how often each place was covered. A new figure is one function that returns a `Plot`,
and its line in ``report.py``.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.evaluate.pictures.scene import corners
from fullswarm.evaluate.results.folder import StoredTrial
from fullswarm.evaluate.results.headline import Effect, Headline, counted
from fullswarm.evaluate.results.quantities import COLLISIONS, SHOWN, Quantity
from fullswarm.evaluate.results.sample import Condition, Sample, shown
from fullswarm.evaluate.results.statistics import describe
from fullswarm.evaluate.swarm import Coverage
from fullswarm.evaluate.trial_folder import Trajectory, read_coverage, read_trajectory

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito 2008: distinct for colour-blind readers too."""
MARKERS = ("o", "s", "^", "D", "v", "P")
INK, GRID, SOLID, PAPER = "#1f2328", "#d0d4d9", "#9aa1a9", "#fefefe"
"""Text and lines, grid, obstacles, background."""
THEME = {INK: "var(--ink, #1f2328)", GRID: "var(--grid, #d0d4d9)", SOLID: "var(--solid, #9aa1a9)"}
"""What follows the page's light or dark theme."""

STYLE: dict[Any, Any] = {  # keys are literals in Matplotlib's types
    "svg.fonttype": "none",  # text stays text: small, sharp, can be searched
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "path.simplify": True,
    "path.simplify_threshold": 0.5,
    "image.composite_image": False,
}


@contextmanager
def style(name: str) -> Iterator[None]:
    """Draw in the report's style; `name` keeps the ids of two figures on a page apart.

    Raises
    ------
    MissingExtra
        Matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
    except ImportError as error:
        raise MissingExtra("plots need Matplotlib", hint="pip install 'fullswarm[experiments]'") from error
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        yield


Sharing = Literal["none", "all", "row", "col"]


def panels(
    rows: int, columns: int, width: float, height: float, sharex: Sharing = "none", sharey: Sharing = "none"
) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels, each `width` x `height` inches, and the panels row by row."""
    from matplotlib.figure import Figure

    # Not pyplot: it keeps figures alive and looks for a screen.
    figure = Figure(figsize=(columns * width, rows * height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey)
    return figure, list(axes.ravel())


def legend_below(figure: Figure, handles: Sequence[Artist], labels: Sequence[str]) -> None:
    """Put one legend for all panels under them."""
    figure.legend(handles, labels, loc="outside lower center", markerscale=1.4, ncols=min(4, max(1, len(labels))))


def to_svg(figure: Figure, name: str, description: str) -> str:
    """Return a figure as an SVG document with a white background; call within `style`."""
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None}, facecolor=PAPER)
    return _tidied(file.getvalue(), name, description)


def inline(svg: str, tips: Mapping[str, str] | None = None) -> str:
    """Return an SVG document for the inside of an HTML page, in the colours of the page's theme.

    Points that lead to an id in `tips` say its text when the pointer is on them.
    """
    body = svg[svg.index("<svg") :]
    body = re.sub(r' (xmlns(:xlink)?|version)="[^"]*"', "", body, count=3)
    body = body.replace("xlink:href", "href").replace(f"fill: {PAPER}", "fill: none")
    for colour, variable in THEME.items():
        body = body.replace(colour, variable)
    for name, text in (tips or {}).items():
        body = body.replace(f'<a href="#{name}">', f'<a href="#{name}">\n<title>{_escaped(text)}</title>')
    return body


def unlinked(svg: str) -> str:
    """Return an SVG document for a file of its own: what its points lead to is on the report's page."""
    return re.sub(r"</?a\b[^>]*>\n?", "", svg)


def _tidied(svg: str, name: str, description: str) -> str:
    """Drop what a page does not need, and digits that no eye can see."""
    svg = re.sub(r"\s*<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<\?xml.*?\?>|<!DOCTYPE.*?>", "", svg, flags=re.DOTALL).strip()
    used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', svg))
    svg = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in used else "", svg)
    svg = re.sub(r' transform="rotate\(-0 [^"]*"', "", svg)
    svg = svg.replace(' target="_blank"', "")  # of links within the page
    svg = svg.replace("fill-opacity: 0;", "fill: none;")  # what simple viewers understand too
    svg = svg.replace("font-family: 'DejaVu Sans'", "font-family: 'DejaVu Sans', Verdana, sans-serif")
    svg = re.sub(r' (?:d|x|y|width|height)="[^"]*"', lambda found: _rounded(found[0]), svg)
    svg = re.sub(r"\n\s*", "\n", svg).replace(" \n", "\n")
    title = _escaped(description)
    head, _, rest = svg.partition(">")
    return f'{head} role="img" aria-labelledby="{name}-title">\n<title id="{name}-title">{title}</title>{rest}\n'


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _rounded(text: str) -> str:
    return re.sub(r"-?\d+\.\d+", lambda found: f"{float(found[0]):.2f}".rstrip("0").rstrip("."), text)


COLUMNS = 2
PAGE_IN = 9.0
"""Width of a figure in inches."""


@dataclass(frozen=True, slots=True)
class Plot:
    """A figure: file name without its end, caption, SVG document."""

    name: str
    caption: str
    svg: str


MOST_EFFECTS = 40
"""Rows of the figure of the main comparison: more cells are in the table only."""


def effect_plot(found: Headline, name: str) -> Plot:
    """Return the difference over all cells and in each of them, with intervals, and the single pairs as points."""
    shown_cells = found.cells if 1 < len(found.cells) <= MOST_EFFECTS else ()
    rows = [found.whole, *shown_cells]
    with style(name):
        figure, (axis,) = panels(1, 1, PAGE_IN, 0.9 + 0.3 * len(rows))
        for place, effect in enumerate(rows):
            _effect(axis, effect, -place, COLOURS[1] if place == 0 else INK)
        axis.axvline(0.0, color=SOLID, linewidth=1.0, zorder=1)
        axis.set_yticks([-place for place in range(len(rows))], [each.name for each in rows])
        axis.get_yticklabels()[0].set_fontweight("bold")
        axis.set_ylim(-len(rows) + 0.4, 0.6)
        axis.tick_params(axis="y", length=0)
        unit = f" [{found.quantity.unit}]" if found.quantity.unit else ""
        axis.set_xlabel(f"{found.quantity.title}{unit}: {found.b} minus {found.a}")
        axis.grid(axis="x")
        points = "; each point below is the difference of one seed" if found.paired else ""
        beyond = "" if shown_cells or len(found.cells) == 1 else f" {len(found.cells)} cells are too many to draw."
        gone = f" {counted(found.left_out, 'cell')} with other seeds left out." if found.left_out else ""
        how = "Student's t of the seeds' means" if found.paired else "Welch's t of the two groups"
        caption = f"Difference with its 95 % confidence interval ({how}){points}.{beyond}{gone}"
        return Plot(name, caption, to_svg(figure, name, f"Main comparison: {found.sentence}"))


def _effect(axis: Axes, effect: Effect, height: float, colour: str) -> None:
    count = len(effect.differences)
    if count:
        below = height - 0.27 + 0.2 * _spread(count)
        axis.plot(effect.differences, below, "o", color=colour, markersize=3.2, alpha=0.55, markeredgewidth=0.0)
    if math.isfinite(effect.low):
        axis.plot((effect.low, effect.high), (height, height), color=colour, linewidth=2.0, solid_capstyle="butt")
    axis.plot(effect.difference, height, "D", color=colour, markersize=5.0, zorder=4)


def collisions_plot(condition: Condition, name: str) -> Plot | None:
    """Return box plots of collisions over the number of robots, a panel per scenario; None: no trial counts."""
    if not _is_known(condition, COLLISIONS):
        return None
    scenarios = condition.scenarios
    columns = min(COLUMNS, len(scenarios))
    rows = math.ceil(len(scenarios) / columns)
    with style(name):
        # One scale in all panels: they are compared.
        figure, axes = panels(rows, columns, PAGE_IN / max(columns, 1.4), 2.9, sharey="all")
        handles: dict[str, Artist] = {}
        for axis, scenario in zip(axes, scenarios, strict=False):
            handles |= _boxes(axis, condition, scenario)
        _shared_scale(axes[: len(scenarios)])
        for axis in axes[len(scenarios) :]:
            axis.remove()
        legend_below(figure, list(handles.values()), [shown(each) for each in handles])
        caption = (
            "Collisions per trial over the number of robots. Box: quartiles and median; whiskers: the farthest trial "
            f"within 1.5 box heights; each point is one trial and leads to it; white diamond: mean. {condition.name}."
        )
        return Plot(name, caption, to_svg(figure, name, f"Collisions per trial, {condition.name}"))


def _boxes(axis: Axes, condition: Condition, scenario: str) -> dict[str, Artist]:
    """Draw one scenario; return a handle for the legend per behaviour."""
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
            points = axis.scatter(spread, values, 14.0, colour, marker=marker, alpha=0.65, linewidths=0.0, zorder=3)
            points.set_urls([link_to(each) for each in sample.counted] if sample else [])
            axis.plot(centre, np.mean(values), "D", color="white", markeredgecolor=INK, markersize=3.4, zorder=4)
            handles.setdefault(behaviour, points)
    axis.set_xticks(range(len(sizes)), [str(each) for each in sizes])
    axis.set_xlim(-0.6, len(sizes) - 0.4)
    axis.set_title(scenario.replace("_", " "))
    axis.set_xlabel("Number of robots")
    axis.set_ylabel(COLLISIONS.label)
    axis.grid(axis="y")
    return handles


def _shared_scale(axes: list[Axes]) -> None:
    """Let the panels' common axis begin just below zero, with whole numbers: they count."""
    from matplotlib.ticker import MaxNLocator

    top = max(axes[0].get_ylim()[1], 1.0)
    axes[0].set_ylim(-0.03 * top, top)
    for axis in axes:
        axis.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True, steps=[1, 2, 5, 10]))
        axis.tick_params(labelleft=True)  # of each panel: with four in two rows the left one is far away


def link_to(stored: StoredTrial) -> str:
    """Return where on the report's page a trial stands."""
    return f"#{anchor(stored)}"


def anchor(stored: StoredTrial) -> str:
    """Return the id of a trial on the report's page."""
    return f"trial-{re.sub(r'[^A-Za-z0-9_.=-]', '-', stored.path.name)}"


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


Bounds = NDArray[np.float64]
PERIOD_S = 0.2
"""Trajectories are drawn with five points per second."""
READABLE_ROBOTS = 16
"""More trajectories than these in one picture cannot be followed."""
PANEL_IN = 3.0


def trajectories_plot(condition: Condition, scenario: str, name: str) -> Plot | None:
    """Return one trial per behaviour, with the same seed and so the same start; None when none was recorded.

    The seed is that of the median trial by collisions over all behaviours.
    """
    robots = chosen_size(condition, scenario)
    chosen = _same_seed([condition.sample(scenario, each, robots) for each in condition.behaviours])
    drawn = [(each, path) for each in chosen if (path := _load(each)) is not None]
    if not drawn:
        return None
    with style(name):
        figure, axes = panels(1, len(drawn), max(PANEL_IN, 0.45 * PAGE_IN / len(drawn)), PANEL_IN + 0.45)
        for axis, (stored, path) in zip(axes, drawn, strict=True):
            _trajectory(axis, path)
            outcome = stored.record.outcome
            events = outcome.events if outcome else 0
            axis.set_title(f"{shown(stored.record.trial.cell.label)}\n{events} collisions", fontsize=9.0)
        _legend(figure)
        seed = drawn[0][0].record.trial.seed
        caption = (
            f"Scenario “{scenario}”, {robots} robots, seed {seed}: the median trial by collisions. {condition.name}."
        )
        return Plot(name, caption, to_svg(figure, name, f"Trajectories: {caption}"))


def coverage_plot(condition: Condition, scenario: str, name: str) -> Plot | None:
    """Return in how many of the trials each place was covered, a panel per behaviour; None without grids."""
    robots = chosen_size(condition, scenario)
    found = []
    for behaviour in condition.behaviours:
        sample = condition.sample(scenario, behaviour, robots)
        mean = _share(sample) if sample else None
        if mean is not None:
            found.append((behaviour, *mean))
    if not found:
        return None
    with style(name):
        figure, axes = panels(1, len(found), max(PANEL_IN, 0.45 * PAGE_IN / len(found)), PANEL_IN + 0.2)
        for axis, (behaviour, share, bounds, count) in zip(axes, found, strict=True):
            image = axis.imshow(
                share,
                origin="lower",
                extent=(bounds[0], bounds[2], bounds[1], bounds[3]),
                cmap="cividis",
                vmin=0.0,
                vmax=1.0,
                interpolation="nearest",
            )
            axis.set_title(f"{shown(behaviour)}\n{count} trials", fontsize=9.0)
            _frame(axis, bounds)
        bar = figure.colorbar(image, ax=axes, shrink=0.8, ticks=(0.0, 0.25, 0.5, 0.75, 1.0), format="{x:.0%}")
        bar.set_label("Trials that covered the place")
        caption = f"Scenario “{scenario}”, {robots} robots: where the robots' discs have been. {condition.name}."
        return Plot(name, caption, to_svg(figure, name, f"Coverage: {caption}"))


def chosen_size(condition: Condition, scenario: str) -> int:
    """Return the largest number of robots whose ways can still be distinguished."""
    sizes = condition.sizes(scenario)
    return max((each for each in sizes if each <= READABLE_ROBOTS), default=sizes[0])


def _same_seed(samples: list[Sample | None]) -> list[StoredTrial]:
    """Return a trial of each sample, all with the seed that has the median number of collisions in sum."""
    by_seed = [{each.record.trial.seed: each for each in sample.counted} for sample in samples if sample]
    by_seed = [each for each in by_seed if each]
    common = set.intersection(*map(set, by_seed)) if by_seed else set()
    if not common:
        return [next(iter(each.values())) for each in by_seed]
    total: dict[int, float] = dict.fromkeys(common, 0.0)
    for sample in samples:
        for seed, events in zip(_seeds(sample), sample.of(COLLISIONS) if sample else (), strict=True):
            if seed in total:
                total[seed] += events
    ranked = sorted(common, key=lambda seed: (total[seed], seed))
    return [each[ranked[(len(ranked) - 1) // 2]] for each in by_seed]


def _seeds(sample: Sample | None) -> list[int]:
    return [each.record.trial.seed for each in sample.counted] if sample else []


def _load(stored: StoredTrial) -> Trajectory | None:
    """Return a trajectory, None when the trial kept none or the file is broken: a picture less, not no report."""
    try:
        return read_trajectory(stored.path)
    except ConfigError:
        return None


def _grid(stored: StoredTrial) -> Coverage | None:
    """Return frame and covered cells, None as above."""
    try:
        return read_coverage(stored.path)
    except ConfigError:
        return None


def _share(sample: Sample) -> tuple[NDArray[np.float64], Bounds, int] | None:
    """Return per cell the share of trials that covered it, the bounds, and the number of trials."""
    grids = [each for stored in sample.counted if (each := _grid(stored)) is not None]
    if not grids:
        return None
    frame = grids[0][0]
    same = [covered.astype(float) for other, covered in grids if other == frame]  # other cell sizes cannot be joined
    x, y, cell = frame.origin_x_m, frame.origin_y_m, frame.cell_m
    return np.mean(same, axis=0), np.array([x, y, x + cell * frame.columns, y + cell * frame.rows]), len(same)


def _trajectory(axis: Axes, path: Trajectory) -> None:
    from matplotlib.patches import Circle

    period_s = float(np.median(np.diff(path.time_s))) if len(path.time_s) > 1 else PERIOD_S
    step = max(1, round(PERIOD_S / period_s)) if period_s > 0.0 else 1
    rows = np.unique(np.append(np.arange(0, len(path.time_s), step), len(path.time_s) - 1))
    for row in corners(path.boxes):
        axis.fill(row[:, 0], row[:, 1], facecolor=SOLID, edgecolor="none")
    for goal in np.unique(path.goals, axis=0):
        axis.add_patch(
            Circle(goal, path.goal_radius_m, facecolor=f"{COLOURS[2]}26", edgecolor=COLOURS[2], linestyle="--")
        )
    for robot in range(len(path.ids)):
        x, y = path.pose[rows, robot, 0], path.pose[rows, robot, 1]
        axis.plot(x, y, color=COLOURS[1], linewidth=0.8, alpha=0.75, zorder=2)
    axis.plot(*path.pose[0, :, :2].T, "o", markerfacecolor="none", markeredgecolor=INK, markersize=4.0, zorder=4)
    axis.plot(*path.pose[-1, :, :2].T, "o", color=COLOURS[1], markersize=4.0, markeredgewidth=0.0, zorder=4)
    began = path.touching & ~np.vstack([np.zeros((1, len(path.ids)), bool), path.touching[:-1]])
    axis.plot(*path.pose[:, :, :2][began].T, "x", color=COLOURS[0], markersize=4.5, markeredgewidth=1.2, zorder=5)
    _frame(axis, path.bounds_m)


def _frame(axis: Axes, bounds: Bounds) -> None:
    axis.set_xlim(bounds[0], bounds[2])
    axis.set_ylim(bounds[1], bounds[3])
    axis.set_aspect("equal")
    axis.spines[["top", "right"]].set_visible(True)
    step = max(1.0, round((bounds[2] - bounds[0]) / 4.0))
    axis.set_xticks(np.arange(math.ceil(bounds[0]), bounds[2] + 1e-9, step))
    axis.set_yticks(np.arange(math.ceil(bounds[1]), bounds[3] + 1e-9, step))
    axis.set_xlabel("x [m]")
    axis.set_ylabel("y [m]")


def _legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], linestyle="none", marker="o", markerfacecolor="none", markeredgecolor=INK),
        Line2D([], [], color=COLOURS[1], marker="o", linestyle="none"),
        Line2D([], [], color=COLOURS[0], marker="x", linestyle="none"),
        Line2D([], [], color=COLOURS[2], linestyle="--"),
    ]
    legend_below(figure, handles, ["start", "end", "contact", "goal"])
