"""Emulated lidars: LD19 and RPLIDAR A1 on a serial port."""

from __future__ import annotations

import math
from collections.abc import Mapping

from fullswarm.clock import Clock
from fullswarm.emulators.base import Emulator, body_and_clock
from fullswarm.emulators.lidar.firmware import Ld19, RplidarA1, Sees
from fullswarm.emulators.ports import PtyPort
from fullswarm.simulation.bodies import Body, BodyState

FIRMWARE: Mapping[str, type[Ld19] | type[RplidarA1]] = {"ld19": Ld19, "ld06": Ld19, "rplidar": RplidarA1}
ROOM_M = (3.0, 2.0)
"""Half the length and half the width of :class:`RoomLidar`'s room."""


class LidarEmulator(Emulator):
    """A lidar of a kind (``ld19``, ``ld06``, ``rplidar``).

    Parameters
    ----------
    sees
        What is around it.
    path
        Of the serial port; empty: a new one, see `url`.
    body
        What carries it.
    """

    lacks = ("bump",)

    def __init__(
        self, kind: str, sees: Sees, path: str = "", clock: Clock | None = None, body: Body | None = None
    ) -> None:
        body, clock = body_and_clock(body, clock)
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


class RoomLidar(LidarEmulator):
    """A lidar in a rectangular room (`ROOM_M`), whose middle is the origin of the body that carries it."""

    def __init__(self, kind: str, path: str, body: Body) -> None:
        super().__init__(kind, lambda angle_rad: room_wall_m(body.state(), angle_rad), path, body=body)


def room_wall_m(state: BodyState, angle_rad: float) -> float:
    """Return the distance (m) from a body to the room's wall, in a direction of its own; infinite outside the room."""
    c, s = math.cos(state.heading_rad + angle_rad), math.sin(state.heading_rad + angle_rad)
    long_m, wide_m = ROOM_M
    if abs(state.x_m) >= long_m or abs(state.y_m) >= wide_m:
        return math.inf
    along_m = (math.copysign(long_m, c) - state.x_m) / c if abs(c) > 1e-9 else math.inf
    across_m = (math.copysign(wide_m, s) - state.y_m) / s if abs(s) > 1e-9 else math.inf
    return min(along_m, across_m)
