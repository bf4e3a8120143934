"""The commands that look: status, watch, robots, behaviours, params. Each returns its exit code."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from datetime import datetime
from typing import Any, Literal

import msgspec
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from fullswarm import output
from fullswarm.errors import ConfigError, Unreachable, did_you_mean
from fullswarm.messages import ParamEntry, ParamReply
from fullswarm.operator import session
from fullswarm.operator.leases import GROUP
from fullswarm.operator.orders import robot_ids
from fullswarm.operator.params import ParamClient, Stored
from fullswarm.operator.render import fleet_table
from fullswarm.operator.session import Session, Target
from fullswarm.operator.view import FleetView, RobotRow, Snapshot

COLLECT_S = 1.0
"""Two periods of the health reports."""
REFRESH_S = 0.25
CORE = "core"
RECORDS = "behaviour/"
GROUPS = "group/"
GROUPS_S = 3.0


def status(target: Target, robots: Iterable[str] = (), *, as_json: bool) -> int:
    """Listen for a second, then print the swarm, or those `robots` of it, once."""
    seen = _look(target, named(target, robots))
    if as_json:
        output.data_json(seen.as_dict())
    else:
        output.data_table(fleet_table(seen))
    return 0


def robots(target: Target, *, as_json: bool) -> int:
    """Print what robots there are: make, model, driver, firmware, battery."""
    seen = _look(target)
    if as_json:
        output.data_json(seen.as_dict()["robots"])
        return 0
    table = _plain_table("robot", "make", "model", "state", "battery", "firmware", "driver")
    for row in seen.robots:
        table.add_row(*map(escape, _robot_cells(row)))
    output.data_table(table)
    return 0


def watch(target: Target, robots: Iterable[str] = (), *, as_json: bool) -> int:
    """Show the swarm until Ctrl-C, then leave its last state on the screen; or a line of JSON at each refresh."""
    ids = named(target, robots)
    if as_json:
        return _watch_json(target, ids)
    console = Console(highlight=False)
    with session.connect(target) as line:
        view = FleetView(line.bus, line.keys, line.runtime, ids)
        line.on_interrupt = line.finish
        # rich's own refreshing would need a thread; the runtime's timer does.
        with Live(console=console, auto_refresh=False, screen=console.is_terminal, transient=True) as live:

            def refresh() -> None:
                seen = _of(view, ids)
                # Of the screen's height the title and the header take two lines, what stands below a third.
                below = max(3, console.size.height // 3)
                table = fleet_table(seen, max(3, console.size.height - 2 - below), below)
                live.update(table, refresh=True)

            line.runtime.every(REFRESH_S, refresh, first_s=0.0)
            line.run()
        output.data_table(fleet_table(_of(view, ids)))
    return 0


def named(target: Target, robots: Iterable[str]) -> tuple[str, ...]:
    """Return the ids that `robots` stand for; the core knows the members of a group. None: the whole swarm.

    Raises
    ------
    ConfigError
        There is no such group, or a name that no robot can have.
    Unreachable
        A group is named and no core answers.
    """
    ids = robot_ids(robots, groups=True)
    if not any(each.startswith(GROUP) for each in ids):
        return ids
    entries = _ask(target, "core", "get", f"{GROUPS}*", GROUPS_S)
    groups = {entry.key.removeprefix(GROUPS): entry.value for entry in entries if isinstance(entry.value, dict)}
    found: dict[str, None] = {}
    for each in ids:
        name = each.removeprefix(GROUP)
        if name == each:
            found[each] = None
        elif name in groups:
            found |= dict.fromkeys(_members(groups[name]))
        else:
            raise ConfigError(
                f"no group '{each}'", where="--robots", hint=did_you_mean(each, [GROUP + name for name in groups])
            )
    return tuple(found)


def _members(group: dict[str, Any]) -> list[str]:
    robots = group.get("robots")
    return [str(robot) for robot in robots] if isinstance(robots, list) else []


def _watch_json(target: Target, ids: tuple[str, ...]) -> int:
    with session.connect(target) as line:
        view = FleetView(line.bus, line.keys, line.runtime, ids)
        line.on_interrupt = line.finish
        line.runtime.every(REFRESH_S, lambda: output.data(json.dumps(_of(view, ids).as_dict(), ensure_ascii=False)))
        line.run()
    return 0


def _of(view: FleetView, ids: tuple[str, ...]) -> Snapshot:
    seen = view.snapshot()
    return seen.only(ids) if ids else seen


def _look(target: Target, ids: tuple[str, ...] = ()) -> Snapshot:
    with session.connect(target) as line:
        view = FleetView(line.bus, line.keys, line.runtime, ids)
        line.run(COLLECT_S)
        return _of(view, ids)


def _robot_cells(row: RobotRow) -> tuple[str, ...]:
    health = row.health
    if health is None:
        return row.robot, "-", "-", "no health report", "-", "-", "-"
    battery = "-" if health.battery < 0 else f"{health.battery:.0%}"
    state = "SILENT" if row.silent else health.lifecycle
    return row.robot, health.make, health.model, state, battery, health.firmware or "-", health.driver


def _plain_table(*columns: str) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for name in columns:
        table.add_column(name, overflow="fold")
    return table


# ---------------------------------------------------------------- the core's database
def behaviours(target: Target, name: str | None, *, timeout_s: float, as_json: bool) -> int:
    """Print the behaviours that can be asked for, or the parameters of one of them."""
    entries = _ask(target, "core", "get", f"{RECORDS}*", timeout_s)
    records = {entry.key.removeprefix(RECORDS): entry.value for entry in entries if isinstance(entry.value, dict)}
    if name is not None and name not in records:
        raise ConfigError(f"no behaviour '{name}'", hint=did_you_mean(name, records))
    if name is not None:
        records = {name: records[name]}
    if as_json:
        output.data_json(records)
        return 0
    table = _plain_table("behaviour", "what it does")
    for each, record in sorted(records.items()):
        marks = [word for word in ("centralised", "filtered") if record.get(word)]
        summary = str(record.get("summary", "")) + (f" ({', '.join(marks)})" if marks else "")
        table.add_row(escape(each), escape(summary))
    output.data_table(table)
    if name is not None:
        output.data_table(_parameter_table(records[name]))
    else:
        output.progress("`fullswarm behaviours NAME` shows the parameters of one")
    return 0


def _parameter_table(record: dict[str, Any]) -> Table:
    table = _plain_table("parameter", "type", "default", "from", "to", "unit", "meaning")
    for name, spec in (record.get("parameters") or {}).items():
        required, default = spec.get("required"), spec.get("default")
        shown = "required" if required else "" if default is None else json.dumps(default)
        limits = ["" if spec.get(end) is None else f"{spec[end]:g}" for end in ("min", "max")]
        words = (name, spec.get("type", ""), shown, *limits, spec.get("unit", ""), spec.get("doc", ""))
        table.add_row(*(escape(str(word)) for word in words))
    return table


def params_get(target: Target, layer: str, key: str, *, timeout_s: float, as_json: bool) -> int:
    """Print the values of a key, or of all that begin with what stands before ``*``."""
    entries = _ask(target, layer, "get", key, timeout_s)
    if not entries and not key.endswith("*"):
        raise ConfigError(f"the {layer}'s database has no '{key}'", hint="`fullswarm params get '*'` lists all")
    _print_entries(entries, as_json)
    return 0


def params_set(target: Target, layer: str, key: str, value: Stored, *, timeout_s: float, as_json: bool) -> int:
    """Write a value and print what the database then holds."""
    _print_entries(_ask(target, layer, "set", key, timeout_s, value), as_json)
    return 0


def params_history(target: Target, layer: str, key: str, *, timeout_s: float, as_json: bool) -> int:
    """Print the newest changes of a key, oldest first; 100 of each are kept."""
    _print_entries(_ask(target, layer, "history", key, timeout_s), as_json)
    return 0


def params_watch(target: Target, layer: str, pattern: str, *, as_json: bool) -> int:
    """Print changes as they happen, until Ctrl-C."""

    def show(entry: ParamEntry) -> None:
        output.data(json.dumps(msgspec.to_builtins(entry), ensure_ascii=False) if as_json else entry_line(entry))

    with session.connect(target) as line:
        line.on_interrupt = line.finish
        _client(line, layer).watch(pattern, show)
        output.progress("watching; Ctrl-C ends")
        line.run()
    return 0


def entry_line(entry: ParamEntry) -> str:
    """Return an entry with its author and local time: ``key = 1.5  (seed, 2025-01-31 12:00:00)``."""
    value = json.dumps(entry.value, ensure_ascii=False)
    changed = datetime.fromtimestamp(entry.changed).isoformat(sep=" ", timespec="seconds")
    return f"{entry.key} = {value}  ({entry.author or 'unknown'}, {changed})"


def _print_entries(entries: Sequence[ParamEntry], as_json: bool) -> None:
    if as_json:
        output.data_json(msgspec.to_builtins(list(entries)))
    else:
        for entry in entries:
            output.data(entry_line(entry))


def _no_layer(layer: str, hub: str) -> Unreachable:
    return Unreachable(f"no layer '{layer}' answers", where=hub, hint=f"the one with a database is '{CORE}'")


def _client(line: Session, layer: str) -> ParamClient:
    return ParamClient(line.bus, line.keys, line.runtime, line.source, layer=layer)


def _ask(
    target: Target,
    layer: str,
    op: Literal["get", "set", "history"],
    key: str,
    timeout_s: float,
    value: Stored = None,
) -> tuple[ParamEntry, ...]:
    answer: ParamReply | None = None
    with session.connect(target) as line:

        def receive(reply: ParamReply) -> None:
            nonlocal answer
            answer = reply
            line.finish()

        _client(line, layer).ask(op, key, receive, value)
        line.run(timeout_s)
        if answer is None:
            raise line.no_core(timeout_s) if layer == CORE else _no_layer(layer, line.hub)
    if not answer.ok:
        reason = answer.reason or "refused without a reason"
        raise ConfigError(reason, where="" if reason.startswith((key, f"'{key}'")) else key)
    return answer.entries
