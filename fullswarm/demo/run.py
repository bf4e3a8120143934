"""Runs `fullswarm demo` in lockstep: its settings, and the summary, which the live run (``live.py``) prints as well."""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from fullswarm.bus.base import OPERATOR
from fullswarm.config import SwarmConfig
from fullswarm.demo.show import Show, acts_for
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.keys import Keys
from fullswarm.launch.network import with_network
from fullswarm.operator.client import Operator
from fullswarm.operator.render import fleet_table
from fullswarm.operator.view import Snapshot
from fullswarm.output import progress

DEMO_FILE = Path(__file__).with_name("demo.toml")
NAMED = {"mixed": Path(__file__).with_name("mixed.toml")}
"""Fleets that come with the package, besides the usual one."""


def demo_config(fleet: Path | None, overrides: tuple[str, ...], network: str | None = None) -> SwarmConfig:
    """Return the demo's settings, or those of the user's own fleet file, on a bad network if one is wanted."""
    named = NAMED.get(str(fleet)) if fleet is not None and not fleet.exists() else None
    return with_network(load_fleet(named or fleet or DEMO_FILE, overrides, here=True), network)


def run_lockstep(config: SwarmConfig, seconds: float, seed: int, as_json: bool, record: Path | None = None) -> int:
    """Run the show on a simulated clock; the JSON of two runs with one seed is the same to the byte."""
    from fullswarm.launch.lockstep import Lockstep

    if any(robot.emulate for robot in config.robot):
        progress("in lockstep emulated robots run as simulated ones: ports and firmware live on the wall clock")
    world = config.world_or_default.model_copy(update={"seed": seed})
    section = config.network.model_copy(update={"seed": seed})
    recorder = None
    if record is not None:
        from fullswarm.launch.recorder import check_record

        check_record(record)
        from fullswarm.record.lockstep import LockstepRecorder

        recorder = LockstepRecorder(record, config.swarm, on_failure=progress)
    lockstep = Lockstep(
        config.model_copy(update={"world": world, "network": section}), recorder.begin if recorder else None
    )
    if recorder is not None:
        recorder.record(lockstep)
    bus = lockstep.bus_of(OPERATOR)
    numbers = itertools.count(1)
    keys = Keys(config.swarm)
    operator = Operator(bus, keys, lockstep.runtime, "demo", new_id=lambda: f"demo-{seed}-{next(numbers)}")
    show = Show(bus, lockstep.runtime, config, operator, seconds, acts_for(config))
    try:
        lockstep.run(1.0)
        show.start()
        lockstep.run(seconds)
        # A wall-clock figure would make two runs differ, so it goes to stderr.
        print(f"{lockstep.real_time_factor:.0f} times faster than real time", file=sys.stderr)  # noqa: T201
        return report(show, as_json, None)
    finally:
        lockstep.close()
        if recorder is not None:
            recorder.close()
            progress(f"{record}: {recorder.messages} messages")


def report(show: Show, as_json: bool, real_time_factor: float | None) -> int:
    """Print the result of the show; return the exit code: 1 if an act was not answered or not requested."""
    document = show.document(real_time_factor)
    if as_json:
        print(json.dumps(document, indent=2))  # noqa: T201
    else:
        print_summary(document, show.view.snapshot())
    if show.yielded_to:
        return 0  # requests after that are not the show's
    answered = all(each.acknowledged_s is not None for each in show.sent)
    return 0 if answered and len(show.sent) == len(show.acts) else 1


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
