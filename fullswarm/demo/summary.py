"""The demo's last page: what was asked, how fast it was acknowledged, how well it went."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from fullswarm.operator.render import fleet_table
from fullswarm.operator.view import Snapshot


def print_summary(document: dict[str, Any], snapshot: Snapshot) -> None:
    """Print the fleet's last state, the requests and the totals to stdout."""
    console = Console()
    console.print(fleet_table(snapshot))
    requests = Table(title="requests", title_justify="left")
    for column in ("behaviour", "confirmed by", "after", "arrived", "then"):
        requests.add_column(column)
    for each in document["requests"]:
        after_s = each["acknowledged_after_s"]
        requests.add_row(
            each["behaviour"],
            f"{len(each['confirmed_by'])} robots",
            "never" if after_s is None else f"{1000 * after_s:.0f} ms",
            "-" if each["arrived"] is None else f"{len(each['arrived'])} robots",
            each["phase"] + (f": {each['reason']}" if each["reason"] else ""),
        )
    console.print(requests)
    totals = Table(title="summary", title_justify="left", show_header=False)
    totals.add_row("work (distance, all robots)", _text(document["work_m"], "m", 1))
    totals.add_row("coverage of the arena", _text(_percent(document["coverage"]), "%", 1))
    totals.add_row("collisions", _text(document["collisions"], "", 0))
    if document["real_time_factor"] is not None:
        totals.add_row("real-time factor", _text(document["real_time_factor"], "", 2))
    console.print(totals)


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share


def _text(value: float | None, unit: str, digits: int) -> str:
    return "not measured" if value is None else f"{value:.{digits}f} {unit}".strip()
