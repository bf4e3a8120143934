"""Wheel-driven bodies: floor, gravity, friction, two driven wheels and two casters (an iRobot Create).

For sim-in-the-loop: wheels slip, pushes turn a body, acceleration is what the motors' torque gives. Some 40 times
slower than :mod:`pybullet_engine`.
"""

from __future__ import annotations

import math

import numpy as np

from fullswarm.config import WorldConfig
from fullswarm.kernels import Array
from fullswarm.simulation.contacts import ContactReferee
from fullswarm.simulation.movers import solid_rows
from fullswarm.simulation.obstacles import with_trigonometry
from fullswarm.simulation.pybullet_engine import BulletClient, place_movers

WHEEL_BASE_M = 0.235  # Create 2 Open Interface specification
WHEEL_RADIUS_M = 0.036
WHEEL_MASS_KG = 0.15
WHEEL_TORQUE_N_M = 0.6  # holds 2 m/s² at 3.6 kg with four times the force to spare
WHEEL_FRICTION = 1.2
CASTER_RADIUS_M = 0.012
CASTER_GAP_M = 0.0005  # casters hang this far above the floor, so that the wheels carry the weight
SHELL_HEIGHT_M = 0.06
SHELL_BOTTOM_M = 0.02
SHELL_FRICTION = 0.2
GRAVITY_M_S2 = -9.81
CREATE_RADIUS_M = 0.17


class WheelsEngine:
    """An :class:`~fullswarm.simulation.engine.Engine` of differential-drive bodies.

    A robot of another radius has its wheel base scaled with it.
    """

    def __init__(self, config: WorldConfig, starts: Array, radius_m: Array) -> None:
        n = len(starts)
        self.pose = np.array(starts, dtype=float).reshape(n, 3)
        self.twist = np.zeros((n, 2))
        self._dt_s, obstacles = 1.0 / config.rate_hz, solid_rows(config)
        self._base_m = WHEEL_BASE_M * radius_m / CREATE_RADIUS_M
        self._client = BulletClient(
            self._dt_s,
            config.substeps,
            numSolverIterations=20,
            solverResidualThreshold=1e-4,
            enableConeFriction=0,
        )
        self.referee = ContactReferee(config, with_trigonometry(obstacles), radius_m, self._client.part_s)
        self.firmware = self._client.firmware + " wheels"
        api, client = self._client.api, self._client.id
        api.setGravity(0.0, 0.0, GRAVITY_M_S2, physicsClientId=client)
        plane = api.createCollisionShape(api.GEOM_PLANE, physicsClientId=client)
        floor = api.createMultiBody(baseMass=0, baseCollisionShapeIndex=plane, physicsClientId=client)
        api.changeDynamics(floor, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
        self._solid = self._client.add_obstacles(obstacles, 0.0)
        self._movers_m_s = max((each.speed_m_s for each in config.movers), default=0.0)
        for body in self._solid:
            api.changeDynamics(body, -1, lateralFriction=SHELL_FRICTION, physicsClientId=client)
        self._rollers = self._make_rollers()
        self._fastest_m_s = 0.0
        self._bodies = [
            self._add_body(config.mass_kg, each_m, base_m, pose)
            for each_m, base_m, pose in zip(radius_m.tolist(), self._base_m.tolist(), self.pose.tolist(), strict=True)
        ]

    def _make_rollers(self) -> tuple[int, int]:
        """Return the shapes of a wheel and of a caster, which all bodies share."""
        api, client = self._client.api, self._client.id
        return (
            api.createCollisionShape(api.GEOM_SPHERE, radius=WHEEL_RADIUS_M, physicsClientId=client),
            api.createCollisionShape(api.GEOM_SPHERE, radius=CASTER_RADIUS_M, physicsClientId=client),
        )

    def _add_body(self, mass_kg: float, radius_m: float, base_m: float, pose: list[float]) -> int:
        """Add shell, left and right wheel (joints 0, 1; turning about y), front and rear caster (fixed)."""
        api, client = self._client.api, self._client.id
        x, y, heading = pose
        wheel, caster = self._rollers
        shell = api.createCollisionShape(
            api.GEOM_CYLINDER, radius=radius_m, height=SHELL_HEIGHT_M, physicsClientId=client
        )
        centre_m = SHELL_BOTTOM_M + SHELL_HEIGHT_M / 2
        wheel_z = WHEEL_RADIUS_M - centre_m
        caster_x, caster_z = 0.8 * radius_m, CASTER_RADIUS_M + CASTER_GAP_M - centre_m
        straight = [0.0, 0.0, 0.0, 1.0]
        body: int = api.createMultiBody(
            baseMass=mass_kg - 2 * WHEEL_MASS_KG,
            baseCollisionShapeIndex=shell,
            basePosition=[x, y, centre_m],
            baseOrientation=[0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)],
            baseInertialFramePosition=[0.0, 0.0, 0.0],
            linkMasses=[WHEEL_MASS_KG, WHEEL_MASS_KG, 0.01, 0.01],
            linkCollisionShapeIndices=[wheel, wheel, caster, caster],
            linkVisualShapeIndices=[-1] * 4,
            linkPositions=[
                [0.0, base_m / 2, wheel_z],
                [0.0, -base_m / 2, wheel_z],
                [caster_x, 0.0, caster_z],
                [-caster_x, 0.0, caster_z],
            ],
            linkOrientations=[straight] * 4,
            linkInertialFramePositions=[[0.0, 0.0, 0.0]] * 4,
            linkInertialFrameOrientations=[straight] * 4,
            linkParentIndices=[0] * 4,
            linkJointTypes=[api.JOINT_REVOLUTE] * 2 + [api.JOINT_FIXED] * 2,
            linkJointAxis=[[0.0, 1.0, 0.0]] * 4,
            physicsClientId=client,
        )
        frictions = (SHELL_FRICTION, WHEEL_FRICTION, WHEEL_FRICTION, 0.0, 0.0)
        for link, friction in zip((-1, 0, 1, 2, 3), frictions, strict=True):
            api.changeDynamics(
                body,
                link,
                lateralFriction=friction,
                spinningFriction=0.0,
                rollingFriction=0.0,
                restitution=0.0,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                activationState=api.ACTIVATION_STATE_DISABLE_SLEEPING,
                physicsClientId=client,
            )
        return body

    def step(self, twists: Array) -> None:
        """Advance one world step."""
        api, client = self._client.api, self._client.id
        turn = twists[:, 1] * (self._base_m / 2)
        wheels = np.stack([twists[:, 0] - turn, twists[:, 0] + turn], axis=1) / WHEEL_RADIUS_M
        force = [WHEEL_TORQUE_N_M, WHEEL_TORQUE_N_M]
        for body, speeds in zip(self._bodies, wheels.tolist(), strict=True):
            api.setJointMotorControlArray(
                body, [0, 1], api.VELOCITY_CONTROL, targetVelocities=speeds, forces=force, physicsClientId=client
            )
        # A body that slides drives on faster than its wheels turn.
        fastest = max(float(np.abs(twists[:, 0]).max(initial=self._movers_m_s)), self._fastest_m_s)
        near = self.referee.look_ahead(self.pose, fastest * self._dt_s)
        self._client.step(self._bodies, near, self.referee.path)
        self.referee.judge()
        self._fastest_m_s = 0.0
        for row, body in enumerate(self._bodies):
            at, (qx, qy, qz, qw) = api.getBasePositionAndOrientation(body, client)
            linear, angular = api.getBaseVelocity(body, client)
            heading = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
            self.pose[row] = at[0], at[1], heading
            self._fastest_m_s = max(self._fastest_m_s, math.hypot(linear[0], linear[1]))
            self.twist[row] = linear[0] * math.cos(heading) + linear[1] * math.sin(heading), angular[2]

    def place_movers(self, places: Array) -> None:
        """Put the movers there before the next step."""
        place_movers(self._client, self._solid, self.referee, places)

    def close(self) -> None:
        """End the physics server."""
        self._client.close()
