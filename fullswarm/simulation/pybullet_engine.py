"""The default engine: PyBullet, planar velocity-driven cylinders with roll and pitch locked.

Once per world step every body gets the velocity of its unicycle; Bullet then runs the substeps and solves the
contacts. No gravity, no floor, no friction: a body that pushes does not turn the other. :class:`BulletClient` is what
the wheel-driven engine uses as well.
"""

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

from fullswarm.config import WorldConfig
from fullswarm.kernels import Array
from fullswarm.simulation.contacts import ContactReferee, radii_of
from fullswarm.simulation.movers import solid_rows
from fullswarm.simulation.obstacles import with_trigonometry

HEIGHT_M = 0.2
SOLVER_ITERATIONS = 30  # a pile of 32 stays below 0.1 mm of penetration
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
        """Add static boxes and discs (rows as in ``Reading.obstacles``); return Bullet's body ids."""
        api, client = self.api, self.id
        bodies: list[int] = []
        for x, y, half_x, half_y, yaw, corner in obstacles.tolist():
            disc = half_x == half_y == 0.0
            kind = (
                {"shapeType": api.GEOM_CYLINDER, "radius": corner, "height": OBSTACLE_HEIGHT_M} if disc
                else {"shapeType": api.GEOM_BOX, "halfExtents": [half_x, half_y, OBSTACLE_HEIGHT_M / 2]}
            )  # fmt: skip
            shape = api.createCollisionShape(**kind, physicsClientId=client)
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

    def place(self, bodies: Sequence[int], places: Array) -> None:
        """Put bodies at `places` (k, 2) m; their height and yaw stay."""
        for body, (x, y) in zip(bodies, places.tolist(), strict=True):
            (_, _, z), turn = self.api.getBasePositionAndOrientation(body, self.id)
            self.api.resetBasePositionAndOrientation(body, [x, y, z], turn, self.id)

    def step(self, bodies: Sequence[int], rows: Sequence[int], path: Array) -> None:
        """Advance by one world step; write into `path` (substeps + 1, n, 2) the ways of the `bodies` in `rows`.

        Bullet returns poses only between two calls, so substeps are called one by one while a path is needed; the
        motion is the same to the bit.
        """
        if not rows:
            self._divide(self._substeps)
            self.api.stepSimulation(self.id)
            return
        self._divide(1)
        get, watched = self.api.getBasePositionAndOrientation, [(row, bodies[row]) for row in rows]
        for point in range(self._substeps + 1):
            if point:
                self.api.stepSimulation(self.id)
            for row, body in watched:
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


def place_movers(client: BulletClient, solid: list[int], referee: ContactReferee, places: Array) -> None:
    """Put the movers, the last ones of the `solid` bodies and of the referee's obstacles, at `places` (m, 2)."""
    client.place(solid[len(solid) - len(places) :], places)
    referee.place_movers(places)


class PyBulletEngine:
    """An :class:`~fullswarm.simulation.engine.Engine` on Bullet's rigid bodies."""

    def __init__(self, config: WorldConfig, starts: Array, bodies: Sequence[WorldConfig]) -> None:
        n = len(starts)
        self.pose = np.array(starts, dtype=float).reshape(n, 3)
        self.twist = np.zeros((n, 2))
        obstacles = solid_rows(config)
        self._dt_s = 1.0 / config.rate_hz
        self._client = BulletClient(self._dt_s, config.substeps, numSolverIterations=SOLVER_ITERATIONS)
        self.referee = ContactReferee(
            config, with_trigonometry(obstacles), radii_of(bodies), self._client.part_s, len(config.movers)
        )  # fmt: skip
        self.firmware = self._client.firmware
        self._solid = self._client.add_obstacles(obstacles, -HEIGHT_M)
        self._movers_m_s = max((each.speed_m_s for each in config.movers), default=0.0)
        self._bodies = [
            self._add_body(body.mass_kg, body.radius_m, pose)
            for body, pose in zip(bodies, self.pose.tolist(), strict=True)
        ]
        self._velocity = np.zeros((n, 3))
        self._spin = np.zeros((n, 3))

    def _add_body(self, mass_kg: float, radius_m: float, pose: list[float]) -> int:
        api, client = self._client.api, self._client.id
        shape = api.createCollisionShape(api.GEOM_CYLINDER, radius=radius_m, height=HEIGHT_M, physicsClientId=client)
        x, y, heading = pose
        body: int = api.createMultiBody(
            baseMass=mass_kg,
            baseCollisionShapeIndex=shape,
            basePosition=[x, y, 0.0],
            baseOrientation=[0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)],
            useMaximalCoordinates=1,
            physicsClientId=client,
        )
        api.changeDynamics(
            body,
            -1,
            mass=mass_kg,  # without it Bullet takes 0 together with a new inertia, and positions are NaN
            localInertiaDiagonal=[0.0, 0.0, mass_kg * radius_m**2 / 2],  # 0: roll, pitch locked
            linearDamping=0.0,
            angularDamping=0.0,
            lateralFriction=0.0,
            spinningFriction=0.0,
            rollingFriction=0.0,
            restitution=0.0,
            activationState=api.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=client,
        )
        return body

    def step(self, twists: Array) -> None:
        """Advance one world step."""
        client, pose = self._client.id, self.pose
        half = twists[:, 1] * (0.5 * self._dt_s)
        # A straight run along the mid-step heading, as long as the arc's chord, ends exactly on the arc.
        chord = np.sinc(half / math.pi)
        middle = pose[:, 2] + half
        along_x, along_y = np.cos(middle), np.sin(middle)
        speed = twists[:, 0] * chord
        velocity = self._velocity
        velocity[:, 0], velocity[:, 1], self._spin[:, 2] = speed * along_x, speed * along_y, twists[:, 1]
        push = self._client.api.resetBaseVelocity
        for body, linear, angular in zip(self._bodies, velocity.tolist(), self._spin.tolist(), strict=True):
            push(body, linear, angular, client)
        near = self.referee.look_ahead(pose, float(np.abs(speed).max(initial=self._movers_m_s)) * self._dt_s)
        self._client.step(self._bodies, near, self.referee.path)
        self.referee.judge()
        get = self._client.api.getBasePositionAndOrientation
        poses = [get(body, client) for body in self._bodies]
        new = np.array([(at[0], at[1], turn[2], turn[3]) for at, turn in poses])
        heading = 2.0 * np.arctan2(new[:, 2], new[:, 3])
        heading -= np.round(heading / (2 * math.pi)) * (2 * math.pi)
        self.twist[:, 0] = ((new[:, 0] - pose[:, 0]) * along_x + (new[:, 1] - pose[:, 1]) * along_y) / (
            chord * self._dt_s
        )
        self.twist[:, 1] = twists[:, 1]
        pose[:, :2] = new[:, :2]
        pose[:, 2] = heading

    def place_movers(self, places: Array) -> None:
        """Put the movers there before the next step."""
        place_movers(self._client, self._solid, self.referee, places)

    def close(self) -> None:
        """End the physics server."""
        self._client.close()
