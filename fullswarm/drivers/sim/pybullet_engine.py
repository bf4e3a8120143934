"""The default engine: PyBullet, planar velocity-driven cylinders with roll and pitch locked.

Once per world step every body gets the velocity of its unicycle; Bullet then runs the substeps and solves the
contacts. No gravity, no floor, no friction: a body that pushes does not turn the other.
"""

from __future__ import annotations

import math

import numpy as np

from fullswarm.config import WorldConfig
from fullswarm.drivers.sim.bullet import BulletClient
from fullswarm.drivers.sim.contacts import ContactReferee
from fullswarm.drivers.sim.obstacles import static_obstacles, with_trigonometry
from fullswarm.kernels import Array

HEIGHT_M = 0.2
SOLVER_ITERATIONS = 30  # a pile of 32 stays below 0.1 mm of penetration


class PyBulletEngine:
    """An :class:`~fullswarm.drivers.sim.engine.Engine` on Bullet's rigid bodies."""

    def __init__(self, config: WorldConfig, starts: Array) -> None:
        n = len(starts)
        self.pose = np.array(starts, dtype=float).reshape(n, 3)
        self.twist = np.zeros((n, 2))
        obstacles = static_obstacles(config)
        self._dt_s = 1.0 / config.rate_hz
        self._client = BulletClient(self._dt_s, config.substeps, numSolverIterations=SOLVER_ITERATIONS)
        self.referee = ContactReferee(config, with_trigonometry(obstacles), n, self._client.part_s)
        self.firmware = self._client.firmware
        self._client.add_obstacles(obstacles, -HEIGHT_M)
        self._bodies = [self._add_body(config, pose) for pose in self.pose.tolist()]
        self._velocity = np.zeros((n, 3))
        self._spin = np.zeros((n, 3))

    def _add_body(self, config: WorldConfig, pose: list[float]) -> int:
        api, client = self._client.api, self._client.id
        shape = api.createCollisionShape(
            api.GEOM_CYLINDER, radius=config.radius_m, height=HEIGHT_M, physicsClientId=client
        )
        x, y, heading = pose
        body: int = api.createMultiBody(
            baseMass=config.mass_kg,
            baseCollisionShapeIndex=shape,
            basePosition=[x, y, 0.0],
            baseOrientation=[0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)],
            useMaximalCoordinates=1,
            physicsClientId=client,
        )
        api.changeDynamics(
            body,
            -1,
            mass=config.mass_kg,  # without it Bullet takes 0 together with a new inertia, and positions are NaN
            localInertiaDiagonal=[0.0, 0.0, config.mass_kg * config.radius_m**2 / 2],  # 0: roll, pitch locked
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
        near = self.referee.look_ahead(pose, float(np.abs(speed).max(initial=0.0)) * self._dt_s)
        self._client.step(self._bodies, near, self.referee.path)
        self.referee.judge()
        get = self._client.api.getBasePositionAndOrientation
        told = [get(body, client) for body in self._bodies]
        new = np.array([(at[0], at[1], turn[2], turn[3]) for at, turn in told])
        heading = 2.0 * np.arctan2(new[:, 2], new[:, 3])
        heading -= np.round(heading / (2 * math.pi)) * (2 * math.pi)
        self.twist[:, 0] = ((new[:, 0] - pose[:, 0]) * along_x + (new[:, 1] - pose[:, 1]) * along_y) / (
            chord * self._dt_s
        )
        self.twist[:, 1] = twists[:, 1]
        pose[:, :2] = new[:, :2]
        pose[:, 2] = heading

    def close(self) -> None:
        """End the physics server."""
        self._client.close()
