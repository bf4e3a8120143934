"""`fullswarm joystick`: drives with a gamepad, and lists, tests and maps gamepads."""

from __future__ import annotations

import select
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm import output
from fullswarm.cli.options import Json, Robots, robot_ids, shell_command
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.cli.options import NamedTarget
    from fullswarm.operator.joystick.mapping import Wizard
    from fullswarm.operator.joystick.pads import Pads
    from fullswarm.operator.joystick.state import PadState
    from fullswarm.runtime import Runtime

SHOWN_S = 0.1
PLATFORMS = {"linux": "Linux", "darwin": "Mac OS X", "win32": "Windows"}
"""SDL's names of operating systems."""

joystick_app = typer.Typer(invoke_without_command=True)

BindingsFile = Annotated[
    Path | None,
    typer.Option(
        "--bindings", metavar="FILE", help="What each control does, as TOML (default: the package's bindings.toml)."
    ),
]
Pad = Annotated[
    str, typer.Option("--pad", metavar="N|GUID", help="Use only this pad (default: the one whose dead-man is pressed).")
]


@joystick_app.callback()
@shell_command()
def joystick(
    context: typer.Context,
    target: NamedTarget,
    bindings: BindingsFile = None,
    pad: Pad = "",
    robots: Robots = None,
) -> int:
    """Drive with a gamepad: hold LB and push a stick. A stops, B is the e-stop; Ctrl-C ends.

    LB dead-man, RB turbo, left stick: on the map, right stick: one robot, cross: choose robots, X and Y: behaviours.
    """
    if context.invoked_subcommand is not None:
        return 0
    from fullswarm.operator import session
    from fullswarm.operator.joystick.bindings import load_bindings
    from fullswarm.operator.joystick.pads import Pads
    from fullswarm.operator.joystick.pilot import Pilot
    from fullswarm.operator.joystick.show import Screen, status_line, status_text

    only, bound, pads = robot_ids(robots, groups=True), load_bindings(bindings), Pads()
    try:
        _report_problems(pads.poll())
        with session.connect(target) as connection:
            bus, keys, runtime, operator = connection.bus, connection.keys, connection.runtime, connection.operator
            pilot = Pilot(bus, keys, runtime, operator, pads, bound, pad=pad, only=only)
            screen = Screen()

            def show() -> None:
                status = pilot.status()
                screen.show(status_text(status), status_line(status))

            connection.on_interrupt = lambda: pilot.close(connection.finish)
            runtime.every(SHOWN_S, show)
            pilot.start()
            try:
                connection.run()
            finally:
                screen.close()
                operator.close()
    finally:
        pads.close()
    output.progress("robots released")
    return 0


@joystick_app.command("list")
@shell_command()
def list_pads(as_json: Json = False) -> int:
    """List the gamepads that are plugged in. Exit code 1: none."""
    from fullswarm.operator.joystick.pads import Pads

    pads = Pads()
    try:
        states = pads.poll()
    finally:
        pads.close()
    if as_json:
        output.data_json([{"number": number, "name": each.name, "guid": each.guid, "known": each.known}
                          for number, each in enumerate(states, 1)])  # fmt: skip
    for number, each in enumerate(() if as_json else states, 1):
        unknown = "" if each.known else "   unknown to SDL: map it with `fullswarm joystick map`"
        output.data(f"{number}  {each.guid}  {each.name}{unknown}")
    _report_problems(states)
    return 0 if states else 1


@joystick_app.command("test")
@shell_command()
def show_pads(
    bindings: BindingsFile = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after this time (default: on Ctrl-C).")] = None,
) -> int:
    """Show what is pressed and what it would do; send nothing, need no swarm. Exit code 1: no pad."""
    from fullswarm.clock import MonotonicClock
    from fullswarm.operator.joystick.bindings import load_bindings
    from fullswarm.operator.joystick.pads import Pads
    from fullswarm.operator.joystick.show import Screen, pad_line, pad_table
    from fullswarm.runtime import Runtime

    meanings = load_bindings(bindings).meanings()
    pads, runtime, screen = Pads(), Runtime(MonotonicClock()), Screen()
    seen = False

    def show() -> None:
        nonlocal seen
        states = pads.poll()
        seen = seen or bool(states)
        screen.show(pad_table(states, meanings), pad_line(states, meanings))

    try:
        _report_problems(pads.poll())
        runtime.every(0.05, show, first_s=0.0)
        runtime.stop_on_signals()
        runtime.run(seconds)
    finally:
        screen.close()
        pads.close()
    return 0 if seen else 1


@joystick_app.command("map")
@shell_command()
def map_pad(
    pad: Pad = "",
    file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write to this file (default: your gamecontrollerdb.txt).")
    ] = None,
    patience: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS", min=0.5, help="Skip a control that is not moved for this long (default: Enter)."
        ),
    ] = None,
) -> int:
    """Map a pad that SDL does not know: ask for each control in turn. Exit code 1: not finished, or controls lack."""
    from fullswarm.clock import MonotonicClock
    from fullswarm.operator.joystick import mapping
    from fullswarm.operator.joystick.pads import Pads
    from fullswarm.runtime import Runtime

    path = file or mapping.user_file()
    pads, runtime = Pads(path), Runtime(MonotonicClock())
    try:
        chosen = _choose(pads.poll(), pad)
        skip = "Enter skips a control" if patience is None else f"a control is skipped after {patience:g} s"
        output.progress(f"{chosen.name} ({chosen.guid}); {skip}")
        wizard = _ask(pads, chosen, runtime, patience)
        if not wizard.done:
            output.progress("not finished: nothing is written")
            return 1
        line = mapping.build(chosen.guid, chosen.name, wizard.controls, PLATFORMS.get(sys.platform, "Linux"))
        pads.add_mapping(line)
        mapping.write_file(path, line)
    finally:
        pads.close()
    output.data(line.text)
    output.progress(f"written to {path}; `fullswarm joystick test` shows what it does")
    if wizard.missing:
        output.progress(f"the default bindings need {', '.join(wizard.missing)}; give others with --bindings")
        return 1
    return 0


def _report_problems(pads: tuple[PadState, ...]) -> None:
    from fullswarm.operator.joystick import devices

    unreadable = devices.problem(devices.gamepads())
    if unreadable:
        output.progress(f"{unreadable}; grant access: {devices.ACCESS}")
    elif not pads:
        output.progress("no gamepad yet: plug one in")


def _choose(states: tuple[PadState, ...], pad: str) -> PadState:
    """Return the pad to map: by number or GUID, else the only one, else the only unknown one."""
    from fullswarm.operator.joystick import devices

    named = [each for number, each in enumerate(states, 1) if pad in (str(number), each.guid)]
    unknown = [each for each in states if not each.known]
    for candidates in (named,) if pad else (states, unknown):
        if len(candidates) == 1:
            return candidates[0]
    if not states:
        unreadable = devices.problem(devices.gamepads())
        hint = devices.ACCESS if unreadable else ""
        raise ConfigError(unreadable or "no gamepad is plugged in", where="joystick", hint=hint)
    present = ", ".join(f"{number}: {each.name}" for number, each in enumerate(states, 1))
    raise ConfigError("several pads are plugged in", where="--pad", hint=f"give a number: {present}")


def _ask(pads: Pads, chosen: PadState, runtime: Runtime, patience_s: float | None) -> Wizard:
    """Run the wizard until it is done, the pad is unplugged or Ctrl-C."""
    from fullswarm.operator.joystick.mapping import Wizard
    from fullswarm.operator.joystick.pilot import POLL_S

    wizard, shown, since_s = Wizard(), "", runtime.now_s()

    def step() -> None:
        nonlocal shown, since_s
        now_s = runtime.now_s()
        if all(each.id != chosen.id for each in pads.poll()):
            output.progress(f"{chosen.name} was unplugged")
            runtime.stop()
            return
        if not wizard.asking:
            since_s = now_s
        if _enter_pressed() or (patience_s is not None and now_s - since_s > patience_s):
            wizard.skip()
        wizard.update(now_s, pads.raw(chosen.id))
        text = f"{wizard.note}\n{wizard.prompt}" if wizard.note else wizard.prompt
        if text != shown:
            output.progress(text)
            shown = text
        if wizard.done:
            runtime.stop()

    runtime.every(POLL_S, step)
    runtime.stop_on_signals()
    runtime.run()
    return wizard


def _enter_pressed() -> bool:
    """Return whether a line was entered; False for a closed or empty stdin."""
    try:
        return bool(select.select([sys.stdin], [], [], 0.0)[0]) and sys.stdin.readline() != ""
    except (OSError, ValueError):  # no stdin, or one that is not a file
        return False
