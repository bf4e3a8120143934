"""What `fullswarm joystick` and its verbs do. Each returns its exit code."""

from __future__ import annotations

import select
import sys
from collections.abc import Iterable
from pathlib import Path

from fullswarm import output
from fullswarm.clock import MonotonicClock
from fullswarm.errors import ConfigError
from fullswarm.operator import session
from fullswarm.operator.joystick import devices, mapping
from fullswarm.operator.joystick.bindings import load_bindings
from fullswarm.operator.joystick.pads import Pads
from fullswarm.operator.joystick.pilot import POLL_S, Pilot
from fullswarm.operator.joystick.show import Screen, pad_line, pad_table, status_line, status_text
from fullswarm.operator.joystick.state import PadState
from fullswarm.operator.joystick.wizard import Wizard
from fullswarm.operator.orders import robot_ids
from fullswarm.operator.session import Target
from fullswarm.runtime import Runtime

SHOWN_S = 0.1


def drive(target: Target, bindings_file: Path | None, pad: str, robots: Iterable[str]) -> int:
    """Drive with a gamepad until Ctrl-C, then zero."""
    only = robot_ids(robots, groups=True)
    bindings = load_bindings(bindings_file)
    pads = Pads()
    try:
        _say_what_is_there(pads.poll())
        with session.connect(target) as line:
            pilot = Pilot(line.bus, line.keys, line.runtime, line.operator, pads, bindings, pad=pad, only=only)
            screen = Screen()

            def show() -> None:
                status = pilot.status()
                screen.show(status_text(status), status_line(status))

            line.on_interrupt = lambda: pilot.close(line.finish)
            line.runtime.every(SHOWN_S, show)
            pilot.start()
            try:
                line.run()
            finally:
                screen.close()
                line.operator.close()
    finally:
        pads.close()
    output.progress("robots let go")
    return 0


def _say_what_is_there(pads: tuple[PadState, ...]) -> None:
    barred = devices.problem(devices.gamepads())
    if barred:
        output.progress(f"{barred}; mend it: {devices.MEND}")
    elif not pads:
        output.progress("no gamepad yet: plug one in")


def show_pads(bindings_file: Path | None, seconds: float | None) -> int:
    """Show what pads say and what it would ask for; send nothing. Negative when there was no pad."""
    meanings = load_bindings(bindings_file).meanings()
    pads, runtime, screen = Pads(), Runtime(MonotonicClock()), Screen()
    seen = False

    def look() -> None:
        nonlocal seen
        states = pads.poll()
        seen = seen or bool(states)
        screen.show(pad_table(states, meanings), pad_line(states, meanings))

    try:
        _say_what_is_there(pads.poll())
        runtime.every(0.05, look, first_s=0.0)
        runtime.stop_on_signals()
        runtime.run(seconds)
    finally:
        screen.close()
        pads.close()
    return 0 if seen else 1


def list_pads(*, as_json: bool) -> int:
    """Print the pads that are plugged in; negative when there is none."""
    pads = Pads()
    try:
        states = pads.poll()
    finally:
        pads.close()
    if as_json:
        output.data_json([{"number": number, "name": each.name, "guid": each.guid, "known": each.known}
                          for number, each in enumerate(states, 1)])  # fmt: skip
    for number, each in enumerate(() if as_json else states, 1):
        unknown = "" if each.known else "   unknown to SDL: `fullswarm joystick map` teaches it"
        output.data(f"{number}  {each.guid}  {each.name}{unknown}")
    _say_what_is_there(states)
    return 0 if states else 1


def map_pad(pad: str, file: Path | None, patience_s: float | None) -> int:
    """Ask for each control of a pad in turn and write its mapping to the user's file.

    With `patience_s` a control that has not been moved for so long is left out; else Enter does that.
    """
    path = file or mapping.user_file()
    pads, runtime = Pads(path), Runtime(MonotonicClock())
    try:
        chosen = _choose(pads.poll(), pad)
        output.progress(f"{chosen.name} ({chosen.guid}); " + _how_to_skip(patience_s))
        wizard = _ask(pads, chosen, runtime, patience_s)
        if not wizard.done:
            output.progress("not finished: nothing is written")
            return 1
        line = mapping.build(chosen.guid, chosen.name, wizard.controls, _platform())
        pads.add_mapping(line)
        mapping.write_file(path, line)
    finally:
        pads.close()
    output.data(line.text)
    output.progress(f"written to {path}; `fullswarm joystick test` shows what it does")
    if wizard.missing:
        output.progress(f"the default bindings lack: {', '.join(wizard.missing)}; give --bindings others")
        return 1
    return 0


def _platform() -> str:
    names = {"linux": "Linux", "darwin": "Mac OS X", "win32": "Windows"}
    return names.get(sys.platform, "Linux")


def _how_to_skip(patience_s: float | None) -> str:
    return "Enter leaves a control out" if patience_s is None else f"after {patience_s:g} s a control is left out"


def _choose(states: tuple[PadState, ...], pad: str) -> PadState:
    """Return the pad meant: by number or GUID, else the only one, else the only unknown one."""
    named = [each for number, each in enumerate(states, 1) if pad in (str(number), each.guid)]
    unknown = [each for each in states if not each.known]
    for candidates in (named,) if pad else (states, unknown):
        if len(candidates) == 1:
            return candidates[0]
    if not states:
        barred = devices.problem(devices.gamepads())
        raise ConfigError(barred or "no gamepad is plugged in", where="joystick", hint=devices.MEND if barred else "")
    there = ", ".join(f"{number}: {each.name}" for number, each in enumerate(states, 1))
    raise ConfigError("which pad?", where="--pad", hint=f"give its number: {there}")


def _ask(pads: Pads, chosen: PadState, runtime: Runtime, patience_s: float | None) -> Wizard:
    """Run the wizard until it is done, the pad is gone or Ctrl-C."""
    wizard, said, since_s = Wizard(), "", runtime.now_s()

    def look() -> None:
        nonlocal said, since_s
        now_s = runtime.now_s()
        if all(each.id != chosen.id for each in pads.poll()):
            output.progress(f"{chosen.name} is gone")
            runtime.stop()
            return
        if not wizard.asking:
            since_s = now_s
        if _enter_pressed() or (patience_s is not None and now_s - since_s > patience_s):
            wizard.skip()
        wizard.look(now_s, pads.raw(chosen.id))
        text = f"{wizard.note}\n{wizard.prompt}" if wizard.note else wizard.prompt
        if text != said:
            output.progress(text)
            said = text
        if wizard.done:
            runtime.stop()

    runtime.every(POLL_S, look)
    runtime.stop_on_signals()
    runtime.run()
    return wizard


def _enter_pressed() -> bool:
    """Tell whether a line was entered; a closed or empty stdin never says so."""
    try:
        return bool(select.select([sys.stdin], [], [], 0.0)[0]) and sys.stdin.readline() != ""
    except (OSError, ValueError):  # no stdin, or one that is not a file
        return False
