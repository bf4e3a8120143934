"""Finds gamepads that this user may not read: SDL itself does not report missing permissions."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

INPUT = Path("/dev/input")
LIST = Path("/proc/bus/input/devices")
ACCESS = (
    "sudo usermod -aG input $USER   # then log out and in again; for the local user only, a udev rule: "
    'KERNEL=="event*", ENV{ID_INPUT_JOYSTICK}=="1", TAG+="uaccess" in /etc/udev/rules.d/70-gamepad.rules'
)
_JS = re.compile(r"js\d+\Z")
_EVENT = re.compile(r"event\d+\Z")


@dataclass(frozen=True, slots=True)
class InputDevice:
    """A gamepad as the kernel knows it."""

    name: str
    path: Path
    readable: bool


def gamepads(folder: Path = INPUT, listing: Path = LIST) -> tuple[InputDevice, ...]:
    """Return the gamepads that the kernel lists, each with the file that SDL opens.

    Without a listing, the joystick files of `folder` are returned.
    """
    found = []
    for name, handlers in _listed(listing):
        event = next((each for each in handlers if _EVENT.match(each)), None)
        if event is not None and any(map(_JS.match, handlers)):
            found.append(_device(name, folder / event))
    if not found and folder.is_dir():
        found = [_device(each.name, each) for each in sorted(folder.iterdir()) if _JS.match(each.name)]
    return tuple(found)


def problem(found: tuple[InputDevice, ...]) -> str:
    """Return as text which gamepads this user may not read; empty: none."""
    barred = [f"{each.name} ({each.path})" for each in found if not each.readable]
    return f"not readable by this user: {', '.join(barred)}" if barred else ""


def _device(name: str, path: Path) -> InputDevice:
    return InputDevice(name, path, os.access(path, os.R_OK))


def _listed(listing: Path) -> list[tuple[str, list[str]]]:
    """Return name and handlers of each input device of the kernel's listing."""
    try:
        text = listing.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    found = []
    for block in text.split("\n\n"):
        name = re.search(r'^N: Name="(.*)"$', block, re.MULTILINE)
        handlers = re.search(r"^H: Handlers=(.*)$", block, re.MULTILINE)
        if handlers:
            found.append((name[1] if name else "unnamed gamepad", handlers[1].split()))
    return found
