"""A snapshot of the swarm as a table that people read; it fits 80 columns and says everything in words."""

from __future__ import annotations

import math

from rich.markup import escape
from rich.table import Table

from fullswarm.messages import STOPPED_BY, Summary
from fullswarm.operator.view import SILENT_S, RobotRow, Snapshot

_UNITS = (("_m2", "m²"), ("_m", "m"), ("_s", "s"))
_NAMES_SHOWN = 8
_HIDDEN = frozenset({"cells", "robots"})
"""Values of a summary that the same line or the table already says in another way."""


def fleet_table(snapshot: Snapshot, max_rows: int | None = None) -> Table:
    """Return the swarm as a table: a row per robot, the header above, what concerns all of them below.

    With more robots than `max_rows` those that need attention come first and the rest is counted.
    """
    table = Table(
        title=_title(snapshot),
        caption="\n".join(footer_lines(snapshot)),
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
    table.add_column("behaviour", overflow="fold", max_width=18)
    # Widths that most numbers fit, so that a live table does not jump.
    for name, width in (("x m", 6), ("y m", 6), ("head °", 6), ("m/s", 5), ("age s", 5), ("hits", 4)):
        table.add_column(name, justify="right", no_wrap=True, min_width=width)
    table.add_column("state", overflow="fold", min_width=16, ratio=1)
    rows = snapshot.robots
    if max_rows is not None and len(rows) > max_rows:
        rows = tuple(sorted(rows, key=lambda row: (not row_state(row)[1], row.robot)))[: max(1, max_rows - 1)]
    for row in rows:
        table.add_row(*_cells(row))
    if len(rows) < len(snapshot.robots):
        table.add_row("…", f"{len(snapshot.robots) - len(rows)} more")
    return table


def row_state(row: RobotRow) -> tuple[str, bool]:
    """Return what a robot is doing, in words, and whether somebody should look at it."""
    health = row.health
    if row.silent:
        return f"SILENT for {row.age_s:.0f} s", True
    if health is None:
        return "no health report", True
    if health.fault or health.lifecycle == "FAULT":
        latched = "E-STOP, " if health.estop else ""
        return f"{latched}FAULT: {health.fault or 'no reason given'}", True
    if health.estop:
        return "E-STOP" if not health.moving else "E-STOP, still rolling", True
    if health.stop_reason and not (health.stop_reason.startswith(STOPPED_BY) and not health.behaviour):
        return f"STOPPED: {health.stop_reason}", True
    doing = "moving" if health.moving else "standing"
    if health.lifecycle not in ("READY", "ACTIVE"):
        doing = f"{health.lifecycle.lower()}, not ready"
    if health.contacts:
        return f"{doing}, TOUCHING", True
    if 0.0 <= health.battery < 0.2:
        return f"{doing}, BATTERY {health.battery:.0%}", True
    return doing, False


def footer_lines(snapshot: Snapshot) -> list[str]:
    """Return what concerns the whole swarm: summaries, the newest request, who is missing or silent."""
    lines = [f"{each.metric}: {_values(each)}" for each in snapshot.summaries]
    if snapshot.request is not None:
        request = snapshot.request
        reason = f", {request.reason}" if request.reason else ""
        lines.append(f"request {request.request_id}: {request.behaviour} {request.phase}{reason}")
    if snapshot.missing:
        lines.append(f"MISSING, never heard: {_names(snapshot.missing)}")
    if snapshot.silent:
        lines.append(f"SILENT, heard before: {_names(snapshot.silent)}")
    return [escape(line) for line in lines]


def _title(snapshot: Snapshot) -> str:
    hub = "hub connected" if snapshot.connected else "HUB LOST"
    silent = [f"{node.node} SILENT" for node in snapshot.nodes if node.age_s > SILENT_S]
    alive = [node.node for node in snapshot.nodes if node.age_s <= SILENT_S]
    if not any(node.node == "core" for node in snapshot.nodes):
        silent.insert(0, "NO CORE heard")
    count = len(snapshot.robots)
    robots = f"{count} robot{'' if count == 1 else 's'}"
    parts = [f"swarm {snapshot.swarm}: {robots}", hub, *silent]
    if alive:
        parts.append(f"alive: {' '.join(alive)}")
    return escape(", ".join(parts))


def _cells(row: RobotRow) -> list[str]:
    state, attention = row_state(row)
    health = row.health
    collisions = "" if health is None else str(health.collisions)
    return [
        escape(row.robot),
        escape((health.behaviour if health else "") or "-"),
        _number(row.x_m, 2),
        _number(row.y_m, 2),
        _number(math.degrees(row.heading_rad), 0),
        _number(row.speed_m_s, 2),
        f"{row.age_s:.1f}",
        f"[bold red]{collisions}[/]" if health and health.collisions else collisions,
        f"[bold red]{escape(state)}[/]" if attention else escape(state),
    ]


def _number(value: float, digits: int) -> str:
    if not math.isfinite(value):
        return "-"
    # Adding zero turns "-0" into "0".
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _values(summary: Summary) -> str:
    shown = {
        name: value for name, value in summary.values.items() if name not in _HIDDEN and not _is_nought(name, value)
    }
    text = ", ".join(_quantity(name, value) for name, value in shown.items())
    done = f"; finished: {summary.reason or 'done'}" if summary.finished else ""
    return text + done


def _is_nought(name: str, value: float) -> bool:
    """Tell whether a count of trouble is zero, so that it need not be said."""
    return name.startswith("refused") and value == 0


def _quantity(name: str, value: float) -> str:
    for ending, unit in _UNITS:
        if name.endswith(ending):
            return f"{name.removesuffix(ending).replace('_', ' ')} {value:.2f} {unit}"
    if name == "fraction":
        return f"{value:.1%} of the area"
    return f"{name.replace('_', ' ')} {value:g}"


def _names(robots: tuple[str, ...]) -> str:
    more = len(robots) - _NAMES_SHOWN
    return ", ".join(robots[:_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")
