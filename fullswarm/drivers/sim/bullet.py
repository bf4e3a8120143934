"""What both PyBullet engines share: a quiet client of one's own, static obstacles, steps whose paths are known."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from fullswarm.kernels import Array

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
        self._step_s, self._substeps = step_s, substeps
        self._parts = substeps  # into which the next call of Bullet divides its time
        self.api.setPhysicsEngineParameter(
            fixedTimeStep=step_s,
            numSubSteps=substeps,
            deterministicOverlappingPairs=1,
            contactBreakingThreshold=LOOK_AHEAD_M,
            enableFileCaching=0,
            physicsClientId=self.id,
            **engine,
        )

    @property
    def part_s(self) -> Array:
        """When the substeps of a step end, since its start, (substeps,)."""
        return np.arange(1, self._substeps + 1, dtype=np.float64) * (self._step_s / self._substeps)

    def add_obstacles(self, obstacles: Array, floor_z_m: float) -> list[int]:
        """Add static boxes (rows as in ``Reading.obstacles``); return Bullet's body ids."""
        api, client = self.api, self.id
        bodies: list[int] = []
        for x, y, half_x, half_y, yaw, _ in obstacles.tolist():
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
            bodies.append(body)
        return bodies

    def step(self, bodies: Sequence[int], rows: Sequence[int], path: Array) -> None:
        """Advance by one world step; write into `path` (substeps + 1, n, 2) the ways of the `bodies` in `rows`.

        Bullet tells where bodies are only between two calls, so substeps are called one by one while anybody is asked
        about; the motion is the same to the bit.
        """
        if not rows:
            self._divide(self._substeps)
            self.api.stepSimulation(self.id)
            return
        self._divide(1)
        get, told = self.api.getBasePositionAndOrientation, [(row, bodies[row]) for row in rows]
        for point in range(self._substeps + 1):
            if point:
                self.api.stepSimulation(self.id)
            for row, body in told:
                (x, y, _), _ = get(body, self.id)
                path[point, row] = x, y

    def _divide(self, parts: int) -> None:
        if parts != self._parts:
            self._parts = parts
            step_s = self._step_s if parts > 1 else self._step_s / self._substeps
            self.api.setPhysicsEngineParameter(
                fixedTimeStep=step_s, numSubSteps=parts if parts > 1 else 0, physicsClientId=self.id
            )

    def close(self) -> None:
        """Disconnect. Closing twice is fine."""
        if self._open:
            self._open = False
            self.api.disconnect(self.id)
