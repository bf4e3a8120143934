"""Wheel-driven bodies: floor, gravity, friction, two driven wheels and two casters (as an iRobot Create).

For sim-in-the-loop: wheels slip, pushes turn a body, acceleration is what the motors' torque gives. Some 40 times
slower than :mod:`pybullet_engine`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fullswarm.config import WorldConfig
from fullswarm.kernels import Array
from fullswarm.simulation.contacts import ContactReferee, radii_of
from fullswarm.simulation.movers import solid_rows
from fullswarm.simulation.obstacles import with_trigonometry
from fullswarm.simulation.pybullet_engine import BulletClient, place_movers

CREATE_RADIUS_M = 0.17
CREATE_MASS_KG = 3.6
CREATE_ACCEL_M_S2 = 2.0
WHEEL_BASE_M = 0.235  # Create 2 Open Interface specification
WHEEL_RADIUS_M = 0.036
WHEEL_MASS_KG = 0.15
WHEEL_TORQUE_N_M = 0.6  # a Create holds its acceleration with four times the force to spare
WHEEL_FRICTION = 1.2
CASTER_RADIUS_M = 0.012
CASTER_GAP_M = 0.0005  # casters hang this far above the floor, so that the wheels carry the weight
SHELL_HEIGHT_M = 0.06  # the same for all, so that a small robot cannot drive under a large one
SHELL_BOTTOM_M = 0.02
SHELL_FRICTION = 0.2
GRAVITY_M_S2 = -9.81


class Chassis(NamedTuple):
    """The parts of one body: those of a Create, scaled to its radius, mass and acceleration."""

    radius_m: float
    mass_kg: float
    base_m: float
    wheel_radius_m: float
    wheel_mass_kg: float
    torque_n_m: float
    caster_radius_m: float
    caster_gap_m: float


def chassis_of(body: WorldConfig) -> Chassis:
    """Return the parts of a body."""
    size, weight = body.radius_m / CREATE_RADIUS_M, body.mass_kg / CREATE_MASS_KG
    # A larger wheel needs more torque for the same force on the floor.
    force = weight * max(1.0, body.accel_limit_m_s2 / CREATE_ACCEL_M_S2)
    return Chassis(
        radius_m=body.radius_m,
        mass_kg=body.mass_kg,
        base_m=WHEEL_BASE_M * size,
        wheel_radius_m=WHEEL_RADIUS_M * size,
        wheel_mass_kg=WHEEL_MASS_KG * weight,
        torque_n_m=WHEEL_TORQUE_N_M * force * size,
        caster_radius_m=CASTER_RADIUS_M * size,
        caster_gap_m=CASTER_GAP_M * size,
    )


class WheelsEngine:
    """An :class:`~fullswarm.simulation.engine.Engine` of differential-drive bodies of any size."""

    def __init__(self, config: WorldConfig, starts: Array, bodies: Sequence[WorldConfig]) -> None:
        n = len(starts)
        self.pose = np.array(starts, dtype=float).reshape(n, 3)
        self.twist = np.zeros((n, 2))
        self._dt_s, obstacles = 1.0 / config.rate_hz, solid_rows(config)
        chassis = [chassis_of(body) for body in bodies]
        self._base_m = np.array([each.base_m for each in chassis])
        self._wheel_radius_m = np.array([each.wheel_radius_m for each in chassis])
        self._torques = [[each.torque_n_m] * 2 for each in chassis]
        self._client = BulletClient(
            self._dt_s,
            config.substeps,
            numSolverIterations=20,
            solverResidualThreshold=1e-4,
            enableConeFriction=0,
        )
        self.referee = ContactReferee(
            config, with_trigonometry(obstacles), radii_of(bodies), self._client.part_s, len(config.movers)
        )  # fmt: skip
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
        self._fastest_m_s = 0.0
        shapes = {each: self._shapes_of(each) for each in dict.fromkeys(chassis)}
        self._bodies = [
            self._add_body(each, shapes[each], pose) for each, pose in zip(chassis, self.pose.tolist(), strict=True)
        ]

    def _shapes_of(self, parts: Chassis) -> tuple[int, int, int]:
        """Return the shapes of a shell, a wheel and a caster, which equal bodies share."""
        api, client = self._client.api, self._client.id
        return (
            api.createCollisionShape(
                api.GEOM_CYLINDER, radius=parts.radius_m, height=SHELL_HEIGHT_M, physicsClientId=client
            ),
            api.createCollisionShape(api.GEOM_SPHERE, radius=parts.wheel_radius_m, physicsClientId=client),
            api.createCollisionShape(api.GEOM_SPHERE, radius=parts.caster_radius_m, physicsClientId=client),
        )

    def _add_body(self, parts: Chassis, shapes: tuple[int, int, int], pose: list[float]) -> int:
        """Add shell, left and right wheel (joints 0, 1; turning about y), front and rear caster (fixed)."""
        api, client = self._client.api, self._client.id
        x, y, heading = pose
        shell, wheel, caster = shapes
        centre_m = SHELL_BOTTOM_M + SHELL_HEIGHT_M / 2
        wheel_z = parts.wheel_radius_m - centre_m
        caster_x, caster_z = 0.8 * parts.radius_m, parts.caster_radius_m + parts.caster_gap_m - centre_m
        straight = [0.0, 0.0, 0.0, 1.0]
        body: int = api.createMultiBody(
            baseMass=parts.mass_kg - 2 * parts.wheel_mass_kg,
            baseCollisionShapeIndex=shell,
            basePosition=[x, y, centre_m],
            baseOrientation=[0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)],
            baseInertialFramePosition=[0.0, 0.0, 0.0],
            linkMasses=[parts.wheel_mass_kg] * 2 + [0.01 * parts.mass_kg / CREATE_MASS_KG] * 2,
            linkCollisionShapeIndices=[wheel, wheel, caster, caster],
            linkVisualShapeIndices=[-1] * 4,
            linkPositions=[
                [0.0, parts.base_m / 2, wheel_z],
                [0.0, -parts.base_m / 2, wheel_z],
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
        wheels = np.stack([twists[:, 0] - turn, twists[:, 0] + turn], axis=1) / self._wheel_radius_m[:, None]
        for body, speeds, force in zip(self._bodies, wheels.tolist(), self._torques, strict=True):
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
