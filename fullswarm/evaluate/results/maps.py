"""The report's pictures of arenas: trajectories of chosen trials, and how often each place was covered."""

from __future__ import annotations

import math
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fullswarm.evaluate.experiment.record import COVERAGE_FILE, TRAJECTORY_FILE, Trajectory
from fullswarm.evaluate.results.folder import StoredTrial
from fullswarm.evaluate.results.plots import PAGE_IN, Plot
from fullswarm.evaluate.results.quantities import COLLISIONS
from fullswarm.evaluate.results.sample import Condition, Sample, shown
from fullswarm.evaluate.results.svg import COLOURS, INK, SOLID, legend_below, panels, style, to_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Bounds = NDArray[np.float64]
PERIOD_S = 0.2
"""Trajectories are drawn with five points per second."""
READABLE_ROBOTS = 16
"""More trajectories than these in one picture cannot be followed."""
PANEL_IN = 3.0
BROKEN = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error)
"""What NumPy raises for a missing or broken file."""


def trajectories_plot(condition: Condition, scenario: str, name: str) -> Plot | None:
    """Return one trial per behaviour, with the same seed and so the same start; None when none was recorded.

    The seed is that of the median trial by collisions over all behaviours.
    """
    robots = chosen_size(condition, scenario)
    chosen = _same_seed([condition.sample(scenario, each, robots) for each in condition.behaviours])
    drawn = [(each, path) for each in chosen if (path := _load(each.path / TRAJECTORY_FILE)) is not None]
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
    """Return the largest number of robots whose ways can still be told apart."""
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


def _load(path: Path) -> Trajectory | None:
    """Return a trajectory, None when the trial kept none or the file is broken: a picture less, not no report."""
    if not zipfile.is_zipfile(path):  # of a broken archive NumPy would leave the file open
        return None
    try:
        return Trajectory.load(path)
    except BROKEN:
        return None


def _grid(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return frame and covered cells, None as above."""
    if not zipfile.is_zipfile(path):
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            return np.asarray(file["frame"], np.float64), np.asarray(file["covered"], np.float64)
    except BROKEN:
        return None


def _share(sample: Sample) -> tuple[NDArray[np.float64], Bounds, int] | None:
    """Return per cell the share of trials that covered it, the bounds, and the number of trials."""
    grids = [each for stored in sample.counted if (each := _grid(stored.path / COVERAGE_FILE)) is not None]
    if not grids:
        return None
    frame = grids[0][0]
    same = [covered for other, covered in grids if np.array_equal(frame, other)]  # other cell sizes cannot be joined
    x, y, cell, rows, columns = frame.tolist()
    return np.mean(same, axis=0), np.array([x, y, x + cell * columns, y + cell * rows]), len(same)


def _trajectory(axis: Axes, path: Trajectory) -> None:
    from matplotlib.patches import Circle

    period_s = float(np.median(np.diff(path.time_s))) if len(path.time_s) > 1 else PERIOD_S
    step = max(1, round(PERIOD_S / period_s)) if period_s > 0.0 else 1
    rows = np.unique(np.append(np.arange(0, len(path.time_s), step), len(path.time_s) - 1))
    for row in _corners(path.boxes):
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


def _corners(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corners (k, 4, 2) of boxes (k, 5)."""
    corner = 0.5 * boxes[:, None, 2:4] * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])[None]
    cos, sin = np.cos(boxes[:, 4])[:, None], np.sin(boxes[:, 4])[:, None]
    x = corner[..., 0] * cos - corner[..., 1] * sin + boxes[:, None, 0]
    y = corner[..., 0] * sin + corner[..., 1] * cos + boxes[:, None, 1]
    return np.stack([x, y], axis=-1)


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
