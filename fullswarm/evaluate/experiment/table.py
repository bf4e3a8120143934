"""What people see of an experiment at its end."""

from __future__ import annotations

import math

from rich.table import Table

from fullswarm.evaluate.experiment import CellResult, Report
from fullswarm.evaluate.experiment.plan import differ_by_group

NONE = "-"


def table(report: Report) -> Table:
    """Return the results for people."""
    view = Table(box=None, pad_edge=False)
    grouped = differ_by_group(each.cell for each in report.cells)
    for name in (*["group"] * grouped, "behaviour", "scenario", "engine", "limits", "bad"):
        view.add_column(name, overflow="fold")
    for name in ("N", "seeds", "coll.", "pairs", "touched", "robots %", "trials %", "mean s", "blocked"):
        view.add_column(name, justify="right", no_wrap=True, min_width=len(name))
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
