"""Draws a snapshot of the swarm as a table of 80 columns; colours only repeat what the text states."""

from __future__ import annotations

import math

from rich.markup import escape
from rich.table import Table

from fullswarm.messages import DockState, Summary
from fullswarm.operator.robot_state import pose_text, row_state
from fullswarm.operator.view import SILENT_S, RobotRow, Snapshot, memory_text, natural
from fullswarm.units import UNITS

_NAMES_SHOWN = 8
_CLOCKS_APART_S = 1.0
_MEMORIES_SHOWN = 4
"""Of no more robots than this it is shown what their control laws remember."""
_NUMBERS = (("x m", 6), ("y m", 6), ("head °", 6), ("m/s", 5), ("age s", 5), ("hits", 4))
_LEAST = frozenset({"head °", "age s"})
"""Columns left out for the holders of the robots."""
_HIDDEN = frozenset({"cells", "robots", "elapsed_s"})
"""Values of a summary that the table or the same line shows in another form."""
_WORDS = {
    "deadlock_count": "blocked and stepped aside {:.0f} times",
    "sidestep_s": "{:.0f} s spent on stepping aside",
}
"""Values of summaries whose names say little to people."""
_TRUTH = "truth_"
"""The same values as measured by a supervisory process: for results and --json."""
_FIRST = ("work", "coverage", "collisions")


def fleet_table(snapshot: Snapshot, max_rows: int | None = None, max_lines: int | None = None) -> Table:
    """Return the swarm as a table: a row per robot, the header above, what concerns all of them below.

    Those that need attention come first; with more robots than `max_rows` the rest is counted.
    At most `max_lines` lines follow the table.
    """
    table = Table(
        title=_title(snapshot),
        caption="\n".join(footer_lines(snapshot)[:max_lines]),
        title_justify="left",
        caption_justify="left",
        title_style="bold",
        caption_style="",
        box=None,
        padding=(0, 1, 0, 0),
        header_style="bold",
        expand=True,  # the lines above and below are wrapped to the table's width
    )
    table.add_column("robot", overflow="fold", max_width=14)
    table.add_column("behaviour", overflow="fold", max_width=len("voronoi_coverage_bc"))
    # Widths that most numbers fit, so that a live table does not jump.
    for name, width in _NUMBERS:
        if not (snapshot.leases and name in _LEAST):
            table.add_column(name, justify="right", no_wrap=True, min_width=width)
    if snapshot.leases:
        table.add_column("held by", overflow="fold", max_width=10)
    table.add_column("state", overflow="fold", min_width=16, ratio=1)
    rows = sorted(snapshot.robots, key=lambda row: (not row_state(row).attention, natural(row.robot)))
    if max_rows is not None and len(rows) > max_rows:
        rows = rows[: max(1, max_rows - 1)]
    for row in rows:
        table.add_row(*_cells(row, snapshot.holders if snapshot.leases else None))
    if len(rows) < len(snapshot.robots):
        table.add_row("…", f"{len(snapshot.robots) - len(rows)} more")
    return table


def dock_text(dock: DockState) -> str:
    """Return one slot of a dock in a few words."""
    if dock.phase in ("failed", "blocked"):
        return f"{dock.dock} {dock.phase.upper()}: {dock.reason}"
    return f"{dock.dock} free" if dock.phase == "free" else f"{dock.dock} {dock.robot} {dock.phase}"


def footer_lines(snapshot: Snapshot) -> list[str]:
    """Return what concerns the whole swarm: processes, missing or silent robots, the newest request, summaries."""
    lines = [row.text for row in snapshot.processes if row.text]
    if snapshot.missing:
        lines.append(f"MISSING, not reporting: {_names(snapshot.missing)}")
    if snapshot.silent:
        lines.append(f"SILENT, no longer reporting: {_names(snapshot.silent)}")
    if snapshot.docks:
        lines.append(f"docks: {', '.join(dock_text(each) for each in snapshot.docks)}")
    if snapshot.waiting:
        lines.append(f"WAITING for a dock: {_names(snapshot.waiting)}")
    lines += _clock_lines(snapshot)
    if len(snapshot.robots) <= _MEMORIES_SHOWN:
        lines += [f"{row.robot} remembers {text}" for row in snapshot.robots if (text := memory_text(row.memory))]
        lines += [
            f"{row.robot} pose by {text}" for row in snapshot.robots if row.health and (text := pose_text(row.health))
        ]
        lines += [
            f"{row.robot}: {', '.join(f'{name} {value}' for name, value in row.actuators.items())}"
            for row in snapshot.robots
            if row.actuators
        ]
    if snapshot.request is not None:
        request = snapshot.request
        reason = f", {request.reason}" if request.reason else ""
        lines.append(f"request {request.request_id}: {request.behaviour} {request.phase}{reason}")
    summaries = sorted(snapshot.summaries, key=lambda each: (each.metric not in _FIRST, each.metric))
    lines += [f"{each.metric}: {text}" for each in summaries if (text := _values(each))]
    return [escape(line) for line in lines]


def _clock_lines(snapshot: Snapshot) -> list[str]:
    """Return which robots' computers have another time of day than the core's: their logs would not fit together."""
    apart = {
        row.robot: row.wall_offset_s
        for row in snapshot.robots
        if row.wall_offset_s is not None and abs(row.wall_offset_s) > _CLOCKS_APART_S
    }
    if not apart:
        return []
    worst = max(apart, key=lambda robot: abs(apart[robot]))
    where = "ahead of" if apart[worst] > 0 else "behind"
    more = f", and {len(apart) - 1} more" if len(apart) > 1 else ""
    return [f"CLOCK of {worst} is {abs(apart[worst]):.1f} s {where} the core's{more}: set it (timedatectl, NTP)"]


def _title(snapshot: Snapshot) -> str:
    hub = "hub connected" if snapshot.connected else "HUB LOST"
    silent = [f"{node.node} SILENT" for node in snapshot.nodes if node.age_s > SILENT_S]
    alive = [node.node for node in snapshot.nodes if node.age_s <= SILENT_S]
    if not any(node.node == "core" for node in snapshot.nodes):
        silent.insert(0, "NO CORE")
    count = len(snapshot.robots)
    robots = f"{count} robot{'' if count == 1 else 's'}"
    parts = [f"swarm {snapshot.swarm}: {robots}", hub, *silent]
    if alive:
        parts.append(f"alive: {' '.join(alive)}")
    return escape(", ".join(parts))


def _cells(row: RobotRow, holders: dict[str, str] | None) -> list[str]:
    state = row_state(row)
    health = row.health
    collisions = "" if health is None else str(health.collisions)
    cells = {
        "robot": escape(row.robot),
        "behaviour": escape((health.behaviour if health else "") or "-"),
        "x m": _number(row.x_m, 2),
        "y m": _number(row.y_m, 2),
        "head °": _number(math.degrees(row.heading_rad), 0),
        "m/s": _number(row.speed_m_s, 2),
        "age s": f"{row.age_s:.1f}",
        "hits": f"[bold red]{collisions}[/]" if health and health.collisions else collisions,
    }
    if holders is not None:
        cells = {name: text for name, text in cells.items() if name not in _LEAST}
        cells["held by"] = escape(holders.get(row.robot, "-"))
    text = escape(state.text)
    return [*cells.values(), f"[bold red]{text}[/]" if state.attention else text]


def _number(value: float, digits: int) -> str:
    if not math.isfinite(value):
        return "-"
    # Adding zero turns "-0" into "0".
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _values(summary: Summary) -> str:
    shown = {
        name: value for name, value in summary.values.items() if name not in _HIDDEN and not _is_nought(name, value)
    }
    whole = "area" if summary.metric == "coverage" else "robots"
    text = ", ".join(_quantity(name, value, whole) for name, value in shown.items() if not name.startswith(_TRUTH))
    if summary.finished:
        return f"{text}; finished: {summary.reason or 'done'}"
    return "; ".join(filter(None, (text, summary.reason)))


def _is_nought(name: str, value: float) -> bool:
    """Return whether a count of faults is zero, so that it need not be shown."""
    return name.startswith("refused") and value == 0


def _quantity(name: str, value: float, whole: str) -> str:
    if name in _WORDS:
        return _WORDS[name].format(value)
    for ending, unit in UNITS.items():
        if name.endswith(ending):
            return f"{name.removesuffix(ending).replace('_', ' ')} {value:.2f} {unit}"
    if name == "fraction":
        return f"{value:.1%} of the {whole}"
    return f"{name.replace('_', ' ')} {value:g}"


def _names(robots: tuple[str, ...]) -> str:
    more = len(robots) - _NAMES_SHOWN
    return ", ".join(robots[:_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")
