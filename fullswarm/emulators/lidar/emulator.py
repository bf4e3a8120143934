"""Emulated lidars: LD19 and RPLIDAR A1 on a serial port."""

from __future__ import annotations

from collections.abc import Mapping

from fullswarm.clock import Clock
from fullswarm.emulators.base import Emulator, body_and_clock
from fullswarm.emulators.lidar.firmware import Ld19, RplidarA1, Sees
from fullswarm.emulators.ports import PtyPort

FIRMWARE: Mapping[str, type[Ld19] | type[RplidarA1]] = {"ld19": Ld19, "ld06": Ld19, "rplidar": RplidarA1}


class LidarEmulator(Emulator):
    """A lidar of a kind (``ld19``, ``ld06``, ``rplidar``).

    Parameters
    ----------
    sees
        What is around it.
    path
        Of the serial port; empty: a new one, see `url`.
    """

    def __init__(self, kind: str, sees: Sees, path: str = "", clock: Clock | None = None) -> None:
        body, clock = body_and_clock(None, clock)
        port = PtyPort(path)
        self.url = f"{kind}://{port.address}"
        self.lidar = FIRMWARE[kind](sees)
        super().__init__(self.lidar, [port], body, clock)

    @property
    def motors_on(self) -> None:
        """None: it has no wheels."""
        return

    def surround(self, sees: Sees) -> None:
        """Say what is around it from now on."""
        self.lidar.sees = sees

    def block(self, on: bool) -> None:
        """Hold its motor: it measures nothing any more."""
        self.lidar.turns = not on
