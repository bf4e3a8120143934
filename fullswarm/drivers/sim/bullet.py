"""What both PyBullet engines share: a quiet client of one's own, static obstacles, reading contacts."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import sys
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.drivers.base import Array
from fullswarm.drivers.sim.engine import TOUCH_M

OBSTACLE_HEIGHT_M = 1.0
LOOK_AHEAD_M = 0.05
"""Gap from which Bullet prepares a contact: more than two bodies of 4 m/s close in a substep of 4 ms (with its own
0.02 m they sink 10 mm into each other). Bullet keeps it in a global, so all clients of a process share it."""


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Send what Bullet's C code prints to nowhere: a command's stdout is data, its stderr is progress."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [(number, os.dup(number)) for number in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for number, _ in kept:
            os.dup2(nowhere, number)
        yield
    finally:
        for number, copy in kept:
            os.dup2(copy, number)
            os.close(copy)
        os.close(nowhere)


class BulletClient:
    """One physics server in this process; every call goes to this one by its id."""

    def __init__(self, step_s: float, substeps: int, **engine: float) -> None:
        with quiet() if "pybullet" not in sys.modules else contextlib.nullcontext():
            self.api: Any = importlib.import_module("pybullet")
        self.id: int = self.api.connect(self.api.DIRECT)
        self.firmware = f"pybullet {version('pybullet')}"
        self._open = True
        self.api.setPhysicsEngineParameter(
            fixedTimeStep=step_s,
            numSubSteps=substeps,
            deterministicOverlappingPairs=1,
            contactBreakingThreshold=LOOK_AHEAD_M,
            enableFileCaching=0,
            physicsClientId=self.id,
            **engine,
        )

    def add_obstacles(self, obstacles: Array, floor_z_m: float) -> dict[int, int]:
        """Add static boxes (rows as in ``Reading.obstacles``); return -1-k by Bullet's body id."""
        api, client = self.api, self.id
        rows: dict[int, int] = {}
        for k, (x, y, half_x, half_y, yaw, _) in enumerate(obstacles.tolist()):
            shape = api.createCollisionShape(
                api.GEOM_BOX, halfExtents=[half_x, half_y, OBSTACLE_HEIGHT_M / 2], physicsClientId=client
            )
            body = api.createMultiBody(
                baseMass=0,
                baseCollisionShapeIndex=shape,
                basePosition=[x, y, floor_z_m + OBSTACLE_HEIGHT_M / 2],
                baseOrientation=[0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)],
                useMaximalCoordinates=1,
                physicsClientId=client,
            )
            api.changeDynamics(body, -1, lateralFriction=0.0, restitution=0.0, physicsClientId=client)
            rows[body] = -1 - k
        return rows

    def touching(self, rows: dict[int, int]) -> NDArray[np.int64]:
        """Return the touching pairs (m, 2) among the bodies of `rows` (body id to row), sorted; robots first."""
        points = self.api.getContactPoints(physicsClientId=self.id)
        if not points:
            return NO_PAIRS
        found = set()
        for point in points:
            first, second = rows.get(point[1]), rows.get(point[2])
            if first is not None and second is not None and point[8] < TOUCH_M:
                if second >= 0 and (first < 0 or second < first):
                    first, second = second, first
                if first >= 0:
                    found.add((first, second))
        return np.array(sorted(found), dtype=np.int64).reshape(-1, 2)

    def close(self) -> None:
        """Disconnect. Closing twice is fine."""
        if self._open:
            self._open = False
            self.api.disconnect(self.id)


NO_PAIRS: NDArray[np.int64] = np.zeros((0, 2), np.int64)


def count_contacts(pairs: NDArray[np.int64], contacts: NDArray[np.int64]) -> None:
    """Set `contacts` (n,) to the number of pairs that each row is part of."""
    contacts[:] = 0
    if len(pairs):
        rows = pairs.ravel()
        contacts += np.bincount(rows[rows >= 0], minlength=len(contacts))
