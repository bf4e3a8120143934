"""The commands that show a swarm: `status`, `watch`, `behaviours`, and `robots` without a verb."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fullswarm import output
from fullswarm.cli import completion
from fullswarm.cli.options import Json, Robots, Timeout, robot_ids, shell_command
from fullswarm.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    from rich.table import Table

    from fullswarm.cli.options import Target
    from fullswarm.operator.view import FleetView, RobotRow, Snapshot

COLLECT_S = 1.0
"""Longest wait for reports: two periods of the health reports. All are asked to report at once."""
SETTLED_S, COUNTED_S, LOOK_S = 0.1, 0.03, 0.01
"""What is complete, and has not grown for so long, is shown: sooner where the core has said which robots there are."""
USUAL = ("bodies", "bumps", "obstacles", "pose", "reverse")
"""Capabilities that the list of robots leaves out; `--json` has them."""
REFRESH_S = 0.25
FIRST_LINES_S = 0.6
"""By then each robot has reported once."""
GROUPS_TIMEOUT_S = 3.0


@shell_command()
def status(target: Target, robots: Robots = None, as_json: Json = False) -> int:
    """Show the swarm, or some robots of it, once; those that need attention come first."""
    _need_hub(target)
    seen = _collect(target, members(target, robots))
    if as_json:
        output.data_json(seen.as_dict())
    else:
        from fullswarm.operator.render import fleet_table

        output.data_table(fleet_table(seen))
    _warn_of_certificates(target)
    return 0


def _need_hub(target: Target) -> None:
    """Refuse a hub that has not been started, before what talks to one is loaded."""
    from fullswarm.operator.target import need_hub

    need_hub(target)


def _warn_of_certificates(target: Target) -> None:
    from fullswarm.bus.endpoint import is_secured

    if target.hub is None or not is_secured(target.hub):
        return
    from fullswarm.bringup.certificates import warnings_of
    from fullswarm.clock import wall_time_s

    for line in warnings_of(target.swarm, wall_time_s()):
        output.progress(f"warning: {line}")


@shell_command()
def watch(
    target: Target,
    robots: Robots = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a line of JSON at each refresh, four a second.")
    ] = False,
) -> int:
    """Show the swarm, or some robots of it, live until Ctrl-C; those that need attention come first.

    In a pipe: a line for each robot and process when its state changes, with the time of day.
    """
    from rich.console import Console
    from rich.live import Live

    from fullswarm.operator import session
    from fullswarm.operator.render import fleet_table
    from fullswarm.operator.state_lines import StateLines
    from fullswarm.operator.view import FleetView

    ids = members(target, robots)
    with session.connect(target) as connection:
        view = FleetView(connection.bus, connection.keys, connection.runtime, ids)
        connection.on_interrupt = connection.finish
        if as_json:
            connection.runtime.every(REFRESH_S, lambda: output.data_json(_only(view, ids).as_dict(), indent=None))
            connection.run()
            return 0
        console = Console(highlight=False)
        if not console.is_terminal:
            changes = StateLines(output.data)
            connection.runtime.every(REFRESH_S, lambda: changes.look(_only(view, ids)), first_s=FIRST_LINES_S)
            connection.run()
            return 0
        # rich's own refreshing would need a thread; the runtime's timer does.
        with Live(console=console, auto_refresh=False, screen=True, transient=True) as live:

            def refresh() -> None:
                # Of the screen's height the title and the header take two lines, what stands below a third.
                below = max(3, console.size.height // 3)
                table = fleet_table(_only(view, ids), max(3, console.size.height - 2 - below), below)
                live.update(table, refresh=True)

            connection.runtime.every(REFRESH_S, refresh, first_s=0.0)
            connection.run()
        output.data_table(fleet_table(_only(view, ids)))  # the last state stays on the screen
    return 0


def list_robots(target: Target, *, as_json: bool) -> int:
    """Print the robots of a swarm: make, model, driver, firmware, battery."""
    _need_hub(target)
    from rich.markup import escape

    seen = _collect(target)
    if as_json:
        output.data_json(seen.as_dict()["robots"])
        return 0
    table = output.plain_table("robot", "make", "model", "state", "battery", "firmware", "driver", "can")
    for row in seen.robots:
        table.add_row(*map(escape, _robot_cells(row)))
    output.data_table(table)
    return 0


@shell_command()
def docks(target: Target, as_json: Json = False) -> int:
    """Show the docks of a swarm, who charges there, and which robots wait for one."""
    _need_hub(target)
    from rich.markup import escape

    seen = _collect(target)
    if as_json:
        found = seen.as_dict()
        output.data_json({"docks": found["docks"], "waiting": found["waiting_for_docks"]})
        return 0
    if not seen.docks:
        output.progress("no docks: the fleet file has no [[dock]], or no core answers")
        return 0
    batteries = {row.robot: row.health.battery for row in seen.robots if row.health is not None}
    table = output.plain_table("dock", "state", "robot", "battery", "at", "reason")
    for each in seen.docks:
        battery = batteries.get(each.robot, -1.0)
        share = "-" if battery < 0.0 else f"{battery:.0%}"
        place = f"{each.x_m:.2f}, {each.y_m:.2f}"
        table.add_row(*map(escape, (each.dock, each.phase, each.robot or "-", share, place, each.reason or "-")))
    output.data_table(table)
    if seen.waiting:
        output.data(f"waiting for a dock: {', '.join(seen.waiting)}")
    return 0


def members(target: Target, robots: Iterable[str] | None) -> tuple[str, ...]:
    """Return the ids that `robots` stand for; the core knows the members of a group. None: the whole swarm.

    Raises
    ------
    ConfigError
        There is no such group, or a name that no robot can have.
    Unreachable
        A group is named and no core answers.
    """
    from fullswarm.operator.leases import GROUP

    ids = robot_ids(robots, groups=True)
    if not any(each.startswith(GROUP) for each in ids):
        return ids
    groups = _tables(target, "group/", GROUPS_TIMEOUT_S)
    found: dict[str, None] = {}
    for each in ids:
        name = each.removeprefix(GROUP)
        if name == each:
            found[each] = None
        elif name in groups:
            members = groups[name].get("robots")
            found |= dict.fromkeys(map(str, members) if isinstance(members, list) else ())
        else:
            raise ConfigError(
                f"no group '{each}'", where="--robots", hint=did_you_mean(each, [GROUP + name for name in groups])
            )
    return tuple(found)


def _tables(target: Target, prefix: str, timeout_s: float) -> dict[str, dict[str, Any]]:
    """Return name → table of all entries of the core's database whose keys begin with `prefix`."""
    from fullswarm.operator.params import ask

    entries = ask(target, "core", "get", f"{prefix}*", timeout_s)
    return {entry.key.removeprefix(prefix): entry.value for entry in entries if isinstance(entry.value, dict)}


def _only(view: FleetView, ids: tuple[str, ...]) -> Snapshot:
    seen = view.snapshot()
    return seen.only(ids) if ids else seen


def _collect(target: Target, ids: tuple[str, ...] = ()) -> Snapshot:
    from fullswarm.operator import session
    from fullswarm.operator.view import FleetView

    with session.connect(target) as connection:
        view = FleetView(connection.bus, connection.keys, connection.runtime, ids)
        grown_s, known = connection.runtime.now_s(), 0

        def look() -> None:
            nonlocal grown_s, known
            now_s, before = connection.runtime.now_s(), known
            known = view.received()
            if known != before:
                grown_s = now_s
            elif now_s - grown_s >= (COUNTED_S if view.counted() else SETTLED_S) and view.complete():
                connection.finish()

        connection.runtime.every(LOOK_S, look)
        connection.run(COLLECT_S)
        return _only(view, ids)


def _robot_cells(row: RobotRow) -> tuple[str, ...]:
    health = row.health
    can = " ".join(each for each in (row.profile.capabilities if row.profile else ()) if each not in USUAL) or "-"
    if health is None:
        return row.robot, "-", "-", "no health report", "-", "-", "-", can
    battery = "-" if health.battery < 0 else f"{health.battery:.0%}"
    state = "SILENT" if row.silent else health.lifecycle
    return row.robot, health.make, health.model, state, battery, health.firmware or "-", health.driver, can


# ---------------------------------------------------------------- behaviours
NEW, PICTURE = "new", "picture"


@shell_command()
def behaviours(
    target: Target,
    name: Annotated[
        str | None, typer.Argument(help="Show the parameters of this one.", autocompletion=completion.behaviours)
    ] = None,
    new_name: Annotated[str | None, typer.Argument(metavar="[NEW_NAME]", help="With `new`: the one to write.")] = None,
    centralised: Annotated[
        bool, typer.Option("--centralised", help="With `new`: a law that the base station computes for all robots.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="With `picture`: a .png or .svg (default: NAME.png)."),
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="With `picture`: a parameter.")
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", min=1, max=1000, help="With `picture`: how many robots.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.1, max=1e5, help="With `picture`: simulated time.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="With `picture`: of the start places.")] = None,
    timeout: Timeout = 3.0,
    as_json: Json = False,
) -> int:
    """List the behaviours that can be requested, or the parameters of one.

    `behaviours new NAME` writes a control law, its record and its test into the Python package around the current
    folder, or into a new one. `behaviours picture NAME` runs a behaviour in lockstep and draws starts, trails and ends.
    """
    from rich.markup import escape

    if name == PICTURE:
        changes = {"robots": count, "seconds": seconds, "seed": seed}
        return _picture(new_name, out, {key: each for key, each in changes.items() if each is not None}, settings or ())
    if out is not None or settings or count is not None or seconds is not None or seed is not None:
        raise ConfigError(f"-o, --set, --count, --seconds and --seed go with `{PICTURE}` only", where="behaviours")
    if name == NEW:
        from fullswarm.bringup.new_behaviour import run

        if new_name is None:
            raise ConfigError("it needs a name", where=f"behaviours {NEW}", hint="fullswarm behaviours new orbit")
        return run(new_name, centralised=centralised, folder=Path.cwd())
    if new_name is not None or centralised:
        raise ConfigError(f"goes with `{NEW}` only", where=new_name or "--centralised", hint="behaviours new NAME")
    records = _tables(target, "behaviour/", timeout)
    if name is not None and name not in records:
        raise ConfigError(f"no behaviour '{name}'", hint=did_you_mean(name, records))
    if name is not None:
        records = {name: records[name]}
    if as_json:
        output.data_json(records)
        return 0
    table = output.plain_table("behaviour", "what it does")
    for each, record in sorted(records.items()):
        marks = [word for word in ("centralised", "filtered") if record.get(word)]
        summary = str(record.get("summary", "")) + (f" ({', '.join(marks)})" if marks else "")
        table.add_row(escape(each), escape(summary))
    output.data_table(table)
    if name is not None:
        output.data_table(_parameter_table(records[name]))
        for line in demands(records[name], _collect(target)):
            output.data(line)
    else:
        output.progress("`fullswarm behaviours NAME` shows the parameters of one")
    return 0


def _picture(name: str | None, out: Path | None, changes: dict[str, Any], settings: Iterable[str]) -> int:
    """Draw a behaviour; count the contacts, which a picture can hide."""
    from fullswarm.cli.values import parse_parameters
    from fullswarm.lab import gallery

    if name is None:
        raise ConfigError(
            "it needs a behaviour", where=f"behaviours {PICTURE}", hint="fullswarm behaviours picture flocking_bc"
        )
    path = out or Path(f"{name}.png")
    scene = gallery.scene_of(name, changes, parse_parameters(settings))
    found = gallery.draw(name, scene, path)
    touching = int(found.touching.any(axis=0).sum())
    output.data(f"{path}: {scene.robots} robots, {scene.seconds:g} s, {touching} of them touched something")
    return 0


def demands(record: dict[str, Any], seen: Snapshot) -> list[str]:
    """Return what a behaviour needs of robots, which roles it gives, and which robots cannot take part, as lines.

    Of what is needed as the value of a parameter its default counts.
    """
    import msgspec

    from fullswarm.fitness import ANYTHING, unfit
    from fullswarm.messages import Needs

    given = {**(record.get("static") or {})}
    given |= {name: spec.get("default") for name, spec in (record.get("parameters") or {}).items()}
    raw = record.get("needs") or {}
    lines = ["needs: " + ", ".join(f"{name} {_plain(value)}" for name, value in raw.items())] if raw else []
    for role, terms in (record.get("roles") or {}).items():
        limits = ", ".join(f"{key} {_plain(value)}" for key, value in terms.items() if key != "doc")
        lines.append(f"role {role}: {terms.get('doc', '')}" + (f" ({limits})" if limits else ""))
    try:
        values = {name: given.get(value) if isinstance(value, str) else value for name, value in raw.items()}
        needs = msgspec.convert({name: value for name, value in values.items() if value is not None}, Needs)
    except msgspec.ValidationError:  # a broken record, which the core names when it is requested
        needs = ANYTHING
    if needs != ANYTHING:
        described = ((row.robot, row.profile) for row in seen.robots if row.profile is not None)
        lines += [f"{robot}: {why.text}" for robot, profile in described if (why := unfit(needs, profile))]
    return lines


def _plain(value: object) -> str:
    if isinstance(value, str):
        return f"as the parameter {value}"
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _parameter_table(record: dict[str, Any]) -> Table:
    from rich.markup import escape

    table = output.plain_table("parameter", "type", "default", "from", "to", "unit", "meaning")
    for name, spec in (record.get("parameters") or {}).items():
        required, default = spec.get("required"), spec.get("default")
        shown = "required" if required else "" if default is None else json.dumps(default)
        limits = ["" if spec.get(end) is None else f"{spec[end]:g}" for end in ("min", "max")]
        words = (name, spec.get("type", ""), shown, *limits, spec.get("unit", ""), spec.get("doc", ""))
        table.add_row(*(escape(str(word)) for word in words))
    return table
