"""An emulated lidar in the shell of all emulators: on a serial port, carried by a body among boxes."""

from __future__ import annotations

import math

import numpy as np

from fullswarm.clock import Clock
from fullswarm.drivers.lidar.settings import parse_url
from fullswarm.emulators.base import Emulator, body_and_clock
from fullswarm.emulators.lidar.firmware import LdFirmware, LidarFirmware, RplidarFirmware
from fullswarm.emulators.ports import PtyPort
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array
from fullswarm.simulation.bodies import Body
from fullswarm.simulation.obstacles import with_trigonometry
from fullswarm.simulation.ranges import cast

NO_DISCS = np.zeros((0, 3))
ROOM = np.array(
    [
        [-4.1, 0.0, 0.1, 3.2, 0.0, 0.0],
        [4.1, 0.0, 0.1, 3.2, 0.0, 0.0],
        [0.0, -3.1, 4.2, 0.1, 0.0, 0.0],
        [0.0, 3.1, 4.2, 0.1, 0.0, 0.0],
        [2.0, 0.0, 0.25, 0.25, 0.3, 0.0],
    ]
)
"""Walls and a box, rows of ``Reading.obstacles``."""


class EmulatedLidar(Emulator):
    """A lidar to plug a driver into.

    Parameters
    ----------
    url
        The driver's; where it is mounted is taken from it. The port is made at its path and removed by :meth:`close`.
    body
        What carries it; stands alone on an endless floor by default.
    boxes
        What it sees, (k, 6) rows of ``Reading.obstacles``; may be replaced at any time.

    Raises
    ------
    ConfigError, DriverError
        The URL is wrong or names no serial port, or its path cannot be had.
    """

    def __init__(self, url: str, body: Body | None = None, boxes: Array = ROOM, clock: Clock | None = None) -> None:
        self._settings = settings = parse_url(url)
        if not settings.path:
            raise ConfigError("an emulated lidar has a serial port", where=url, hint=f"write {settings.scheme}:///PATH")
        self.url, self.boxes = url, boxes
        body, clock = body_and_clock(body, clock)
        make = RplidarFirmware if settings.scheme == "rplidar" else LdFirmware
        sign = 1.0 if settings.upside_down else -1.0
        self.firmware: LidarFirmware = make(self._measure, settings.model.max_m, sign)
        super().__init__(self.firmware, [PtyPort(settings.path)], body, clock)

    @property
    def motors_on(self) -> None:
        """It has no wheels."""
        return

    def _measure(self, angles_rad: Array) -> Array:
        state, mount = self.body.state(), self._settings.mount
        c, s = math.cos(state.heading_rad), math.sin(state.heading_rad)
        x, y = state.x_m + c * mount.x_m - s * mount.y_m, state.y_m + s * mount.x_m + c * mount.y_m
        distances_m = np.empty(len(angles_rad))
        cast.run(
            x, y, state.heading_rad + mount.heading_rad, angles_rad, -1, NO_DISCS, 0, with_trigonometry(self.boxes),
            self._settings.model.max_m, distances_m,
        )  # fmt: skip
        return distances_m
