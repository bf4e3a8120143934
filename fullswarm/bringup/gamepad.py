"""Checks of `fullswarm doctor` for gamepads: SDL reports nothing when it may not read one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fullswarm.bringup.checks import Check
from fullswarm.errors import MissingExtra
from fullswarm.operator.joystick import devices

NAME = "gamepad"


def checks(folder: Path = devices.INPUT, listing: Path = devices.LIST) -> Iterator[Check]:
    """Check that SDL is there, and that this user may read the gamepads that are plugged in."""
    from fullswarm.operator.joystick.pads import load_sdl

    found = devices.gamepads(folder, listing)
    try:
        load_sdl()
    except MissingExtra as error:
        # Without a pad it is not needed, and the line on extras has named how to get it.
        yield Check(NAME, "warning", error.what, error.hint) if found else Check(NAME, "ok", "none is plugged in")
        return
    if not found:
        yield Check(NAME, "ok", "none is plugged in" if folder.is_dir() else f"none: there is no {folder}")
    for each in found:
        if each.readable:
            yield Check(NAME, "ok", f"{each.name} ({each.path})")
        else:
            yield Check(NAME, "warning", devices.problem((each,)), devices.ACCESS)
