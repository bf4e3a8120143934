"""Emulated lidars, and the function that their records name.

- ``emulator.py``: a lidar on a serial port, carried by a body among boxes
- ``firmware.py``: what an LD06 or LD19 and an RPLIDAR send, and the commands of the latter
"""

from __future__ import annotations

from typing import TYPE_CHECKING
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from fullswarm.emulators.lidar.emulator import EmulatedLidar
    from fullswarm.simulation.bodies import Body


def start(url: str, body: Body) -> EmulatedLidar:
    """Switch on the lidar that a driver's URL names, in a room of 8 by 6 m with a box in front of it."""
    from fullswarm.emulators.lidar.emulator import ROOM, EmulatedLidar
    from fullswarm.emulators.ports import make_folder

    make_folder(urlsplit(url).path)
    return EmulatedLidar(url, body, ROOM).start()
