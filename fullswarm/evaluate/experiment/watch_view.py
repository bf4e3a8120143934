"""How a running experiment looks in the terminal."""

from __future__ import annotations

import math

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from fullswarm.evaluate.experiment import CellResult
from fullswarm.evaluate.experiment.watch_folder import PAUSE_S, Finished, Progress
from fullswarm.evaluate.results.folder import older_text

AROUND = 10
"""Lines of the view besides the cells and the last trials."""
BAR = 60
"""Letters of the line that fills."""


def view(progress: Progress, now_s: float, max_lines: int | None = None) -> RenderableType:
    """Return all of it; cells that do not fit into `max_lines` are counted instead."""
    room = None if max_lines is None else max(3, max_lines - AROUND - len(progress.last))
    parts: list[RenderableType] = [Text(headline(progress), style="bold")]
    if progress.total:
        parts.append(bar(progress.finished / progress.total))
    parts.append(Text(details(progress)))
    if progress.last and progress.trials_per_s is None and not progress.over:
        still_s = max(0.0, now_s - progress.last[0].at_s)
        if still_s > PAUSE_S:
            parts.append(Text(f"nothing has finished for {span(still_s)}", style="yellow"))
    parts += [Text(), cell_table(progress.cells[:room])]
    if room is not None and len(progress.cells) > room:
        parts.append(Text(f"and {len(progress.cells) - room} more cells", style="dim"))
    if progress.last:
        parts += [
            Text(),
            Text("last finished", style="bold"),
            last_table(progress.last, now_s, one_line=room is not None),
        ]
    if progress.older:
        parts.append(Text(older_text(progress.older), style="yellow"))
    if progress.unreadable:
        parts.append(Text(f"unreadable: {', '.join(progress.unreadable[:3])}", style="red"))
    return Group(*parts)


def bar(share: float) -> Text:
    """Return a line that is filled to a share."""
    filled = min(BAR, int(BAR * share))
    return Text.assemble(("━" * filled, "green"), ("─" * (BAR - filled), "dim"))


def headline(progress: Progress) -> str:
    """Return the first line: ``paper: 120 of 640 trials, about 3 min left``."""
    of = "" if progress.total is None else f" of {progress.total}"
    left = "" if progress.left_s is None else f", about {span(progress.left_s)} left"
    return f"{progress.name}: {progress.finished}{of} trials{', all done' if progress.over else left}"


def details(progress: Progress) -> str:
    """Return the second line."""
    words = [_count(progress.collisions), f"{progress.failed} failed"]
    if not math.isnan(progress.arrived_fraction):
        words.append(f"{100 * progress.arrived_fraction:.1f} % of robots arrived")
    if progress.trials_per_s is not None and not progress.over:
        words.append(f"{60 * progress.trials_per_s:.1f} trials/min")
    if progress.real_time_factor is not None and not progress.over:
        words.append(f"{progress.real_time_factor:.0f} x real time")
    words.append(f"{span(progress.simulated_s)} simulated")
    return ", ".join(words)


def cell_table(cells: tuple[CellResult, ...]) -> Table:
    """Return a row for each cell."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    groups = len({each.cell.group for each in cells}) > 1  # cells may differ in nothing else that is shown
    for name in ("group", "behaviour", "scenario", "engine", "limits")[not groups :]:
        table.add_column(name, no_wrap=True, overflow="ellipsis")
    for name in ("N", "done", "coll.", "robots %", "failed"):
        table.add_column(name, justify="right", no_wrap=True, min_width=len(name))
    for each in cells:
        of = each.cell
        table.add_row(
            *(escape(text) for text in (of.group, of.label, of.scenario, of.engine, of.limits)[not groups :]),
            str(of.robots),
            str(len(each.results)),
            "-" if each.is_empty else str(each.collisions),
            "-" if each.is_empty else f"{100 * each.arrived_fraction:.1f}",
            str(len(each.failed)),
            style="red" if each.failed or (each.collisions and not of.collisions_expected) else None,
        )
    return table


def last_table(last: tuple[Finished, ...], now_s: float, *, one_line: bool) -> Table:
    """Return a row for each of the last trials; it may have several lines unless the screen counts them."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(no_wrap=True, justify="right")
    table.add_column(no_wrap=True, overflow="ellipsis")
    table.add_column(no_wrap=one_line, overflow="ellipsis" if one_line else "fold")
    for each in last:
        record, outcome = each.record, each.record.outcome
        if outcome is None:
            told = f"failed: {record.failure}"
        else:
            collisions = f", {_count(outcome.events)}" if outcome.events else ""
            told = f"{outcome.arrived}/{outcome.robots} arrived in {outcome.simulated_s:.1f} s{collisions}"
        ago = f"{span(max(0.0, now_s - each.at_s))} ago"
        style = "red" if outcome is None or outcome.events else None
        table.add_row(ago, escape(record.trial.label), escape(told), style=style)
    return table


def _count(collisions: int) -> str:
    return f"{collisions} collision{'' if collisions == 1 else 's'}"


def span(seconds: float) -> str:
    """Return a time for people: ``8 s``, ``3 min``, ``2.5 h``."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1f} h"
