"""Emulated Creates and Roombas, and the functions that the make's record names.

- ``emulator.py``: the firmware at the end of a serial line, and what a person can do to the robot
- ``firmware.py``: the robot's end of the Open Interface
- ``home_base.py``: the Home Bases around it, and how it drives into one
- ``hardware.py``: its hardware: encoders, battery, lamps, buttons, sensors
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from fullswarm.emulators.create_oi.emulator import CreateEmulator
    from fullswarm.simulation.bodies import Body


def start(url: str, body: Body) -> CreateEmulator:
    """Switch on the robot that a driver's URL names."""
    from fullswarm.drivers.create_oi.settings import parse_url
    from fullswarm.emulators.create_oi.emulator import CreateEmulator
    from fullswarm.emulators.ports import make_folder

    settings = parse_url(url)
    make_folder(settings.path)
    return CreateEmulator(settings.generation, body, port=settings.path).start()


def clients(url: str) -> dict[str, str]:
    """Return how other clients open the robot at a driver's URL."""
    parts = urlsplit(url)
    if "model=create1" in parts.query:
        return {"port": f"{parts.path} at 57600 baud"}
    return {"pycreate2": f"Create2(port='{parts.path}', baud=115200)", "port": f"{parts.path} at 115200 baud"}


def mode(emulator: Any) -> str:
    """Return the Open Interface's mode."""
    return str(emulator.mode.name)


def shows(emulator: Any) -> str:
    """Return what its lamps and its display show and which song was played last."""
    panel = emulator.firmware.panel
    found = []
    if panel.led_bits or panel.power_intensity:
        lamps = [str(bit) for bit in range(4) if panel.led_bits >> bit & 1]
        colour, light = panel.power_colour / 255, panel.power_intensity / 255
        found.append(f"lamps {' '.join(lamps) or 'none'}, power lamp {light:.0%} ({colour:.0%} red)")
    if panel.digits.strip():
        found.append(f"display '{panel.digits.rstrip()}'")
    if panel.played:
        notes = panel.songs[panel.song]
        tune = " ".join(f"{pitch}:{length / 64:.2f}s" for pitch, length in zip(notes[::2], notes[1::2], strict=True))
        found.append(f"song {len(panel.played)} ({tune})")
    return "; ".join(found)
