"""Maps between single integrators, which can move in any direction, and unicycles, which cannot.

Two maps: one turns towards the desired velocity while it drives along the heading; the other moves a point in front of
the wheels' axis, which a unicycle can move in any direction (near-identity diffeomorphism: Olfati-Saber,
"Near-identity diffeomorphisms and exponential epsilon-tracking and epsilon-stabilization of first-order nonholonomic
SE(2) vehicles", ACC 2002). Both as used at the Robotarium: Wilson et al., "The Robotarium: Globally impactful
opportunities, challenges, and lessons learned in remote-access, distributed control of multirobot systems", IEEE
Control Systems Magazine 40(1), 2020.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fullswarm.kernels import Array
from fullswarm.robotarium.utilities.arguments import columns, not_negative, positive

__all__ = [
    "create_si_to_uni_dynamics",
    "create_si_to_uni_dynamics_with_backwards_motion",
    "create_si_to_uni_mapping",
    "create_uni_to_si_dynamics",
    "np",
]


def _body_frame(dxi: Array, poses: Array) -> tuple[Array, Array]:
    """Return the parts of planar velocities along the headings and to the left of them, (N,) each."""
    cos, sin = np.cos(poses[2]), np.sin(poses[2])
    return cos * dxi[0] + sin * dxi[1], cos * dxi[1] - sin * dxi[0]


def create_si_to_uni_dynamics(
    linear_velocity_gain: float = 1, angular_velocity_limit: float = np.pi
) -> Callable[[Array, Array], Array]:
    """Return a map of planar velocities (2, N) and poses (3, N) to unicycle velocities that turn towards them.

    The speed is the gain times the part along the heading, the turn rate is in proportion to the angle between heading
    and velocity: the limit at 90 degrees, up to twice the limit where the velocity points behind the robot.
    """
    positive(linear_velocity_gain=linear_velocity_gain)
    not_negative(angular_velocity_limit=angular_velocity_limit)

    def si_to_uni_dyn(dxi: Array, poses: Array) -> Array:
        poses = columns(poses, 3, "poses")
        along, left = _body_frame(columns(dxi, 2, "dxi", poses.shape[1]), poses)
        speed = linear_velocity_gain * along
        return np.stack([speed, angular_velocity_limit * np.arctan2(left, speed) / (np.pi / 2.0)])

    return si_to_uni_dyn


def create_si_to_uni_dynamics_with_backwards_motion(
    linear_velocity_gain: float = 1, angular_velocity_limit: float = np.pi
) -> Callable[[Array, Array], Array]:
    """Return a map as :func:`create_si_to_uni_dynamics` that drives backwards where that needs less turning.

    So it never turns by more than 90 degrees, and its turn rate is within the limit.
    """
    positive(linear_velocity_gain=linear_velocity_gain)
    not_negative(angular_velocity_limit=angular_velocity_limit)

    def si_to_uni_dyn(dxi: Array, poses: Array) -> Array:
        poses = columns(poses, 3, "poses")
        along, left = _body_frame(columns(dxi, 2, "dxi", poses.shape[1]), poses)
        speed = linear_velocity_gain * along
        angle = np.arctan2(np.where(speed < 0.0, -left, left), np.abs(speed))
        return np.stack([speed, angular_velocity_limit * angle / (np.pi / 2.0)])

    return si_to_uni_dyn


def create_si_to_uni_mapping(
    projection_distance: float = 0.05, angular_velocity_limit: float = np.pi
) -> tuple[Callable[[Array, Array], Array], Callable[[Array], Array]]:
    """Return two functions for the point `projection_distance` m in front of each robot.

    The first maps desired velocities of the points (2, N) and poses (3, N) to unicycle velocities; exact, as long as
    the turn rate is within its limit. The second maps poses to the points, (2, N).
    """
    positive(projection_distance=projection_distance)
    not_negative(angular_velocity_limit=angular_velocity_limit)

    def si_to_uni_dyn(dxi: Array, poses: Array) -> Array:
        poses = columns(poses, 3, "poses")
        along, left = _body_frame(columns(dxi, 2, "dxi", poses.shape[1]), poses)
        return np.stack([along, np.clip(left / projection_distance, -angular_velocity_limit, angular_velocity_limit)])

    def uni_to_si_states(poses: Array) -> Array:
        poses = columns(poses, 3, "poses")
        return poses[:2] + projection_distance * np.stack([np.cos(poses[2]), np.sin(poses[2])])

    return si_to_uni_dyn, uni_to_si_states


def create_uni_to_si_dynamics(projection_distance: float = 0.05) -> Callable[[Array, Array], Array]:
    """Return a map of unicycle velocities (2, N) and poses (3, N) to velocities of the points in front, (2, N)."""
    positive(projection_distance=projection_distance)

    def uni_to_si_dyn(dxu: Array, poses: Array) -> Array:
        poses = columns(poses, 3, "poses")
        dxu = columns(dxu, 2, "dxu", poses.shape[1])
        cos, sin = np.cos(poses[2]), np.sin(poses[2])
        sideways = projection_distance * dxu[1]
        return np.stack([cos * dxu[0] - sin * sideways, sin * dxu[0] + cos * sideways])

    return uni_to_si_dyn
