"""A gamepad that is plugged in, pressed, pushed and pulled out, as `fullswarm joystick` sees it through SDL."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from fullswarm.cli import joystick
from fullswarm.operator.joystick import pads, pilot
from tests.machines.guest.uinput import Pad
from tests.machines.guest.waiting import Command, run, until


def facts() -> dict[str, Any]:
    """Return what the commands said."""
    assert joystick, "loaded before any fork"
    assert pilot, "loaded before any fork"
    pads.load_sdl()
    none, _ = run("joystick", "list")
    with Pad():
        event = _event_file()
        code, listed = run("joystick", "list", "--json")
        os.environ["SDL_JOYSTICK_DISABLE_UDEV"] = "1"
        _, without_udev = run("joystick", "list", "--json")
        del os.environ["SDL_JOYSTICK_DISABLE_UDEV"]
    with Command("joystick", "test") as test:
        test.says(lambda line: "no gamepad yet" in line, "the command has begun")
        with Pad() as pad:
            there = test.says(lambda line: "at rest" in line, "a pad that is plugged in later")
            pad.press("leftshoulder")
            pad.push("lefty", -32768)
            both = test.says(lambda line: "leftshoulder" in line and "lefty -1.0" in line, "dead-man and stick")
            pad.push("lefty", 0)
            pad.press("leftshoulder", False)
            test.says(lambda line: "at rest" in line, "all let go")
            pad.push("haty", -1)
            cross = test.says(lambda line: "dpup" in line, "the cross")
        gone = test.says(lambda line: line == "no gamepad", "the pad is pulled out")
        ended = test.interrupt()
    return {
        "without_a_pad": none, "exit_code": code, "listed": _document(listed), "event": event,
        "without_udev": _document(without_udev), "there": there, "both": both, "cross": cross, "gone": gone,
        "ended": ended,
    }  # fmt: skip


def _document(said: str) -> Any:
    return json.loads(said[said.index("[") : said.rindex("]") + 1])


def _event_file() -> dict[str, Any]:
    """Return what udev made of the pad's file: a user of the group ``input`` may read it."""
    until(lambda: any(map(_told, _joysticks())), "udev has seen to the pad")
    status = next(filter(_told, _joysticks())).stat()
    return {"mode": oct(status.st_mode & 0o777), "group": status.st_gid}


def _told(file: Path) -> bool:
    return file.exists() and file.stat().st_gid != 0


def _joysticks() -> list[Path]:
    """Return the event files of all gamepads."""
    found = [event.name for event in Path("/sys/class/input").glob("js*/device/event*")]
    return [Path("/dev/input") / each for each in found]
