"""Controllers that drive robots to points and poses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fullswarm.kernels import Array
from fullswarm.robotarium.utilities.arguments import columns, not_negative, positive
from fullswarm.robotarium.utilities.transformations import (
    create_si_to_uni_dynamics,
    create_si_to_uni_dynamics_with_backwards_motion,
    create_si_to_uni_mapping,
    create_uni_to_si_dynamics,
)

__all__ = [
    "create_clf_unicycle_pose_controller",
    "create_clf_unicycle_position_controller",
    "create_hybrid_unicycle_pose_controller",
    "create_si_position_controller",
    "create_si_to_uni_dynamics",
    "create_si_to_uni_dynamics_with_backwards_motion",
    "create_si_to_uni_mapping",
    "create_uni_to_si_dynamics",
    "np",
]

_UNKNOWN: Array = np.empty([0, 0])


def _wrapped(angle: Array) -> Array:
    """Return angles in [-pi, pi]."""
    found: Array = np.arctan2(np.sin(angle), np.cos(angle))
    return found


def _limited(velocities: Array, limit: float) -> Array:
    """Return planar velocities (2, N), shortened to `limit` where they are longer."""
    size = np.linalg.norm(velocities, axis=0)
    found: Array = velocities * np.where(size > limit, limit / np.maximum(size, 1e-300), 1.0)
    return found


def create_si_position_controller(
    x_velocity_gain: float = 1, y_velocity_gain: float = 1, velocity_magnitude_limit: float = 0.15
) -> Callable[[Array, Array], Array]:
    """Return a proportional controller of points (2, N) to goals (2, N): velocities (2, N), of limited size."""
    positive(x_velocity_gain=x_velocity_gain, y_velocity_gain=y_velocity_gain)
    not_negative(velocity_magnitude_limit=velocity_magnitude_limit)
    gain = np.array([[x_velocity_gain], [y_velocity_gain]], float)

    def si_position_controller(xi: Array, positions: Array) -> Array:
        xi = columns(xi, 2, "xi")
        return _limited(gain * (columns(positions, 2, "positions", xi.shape[1]) - xi), velocity_magnitude_limit)

    return si_position_controller


def create_clf_unicycle_position_controller(
    linear_velocity_gain: float = 0.8, angular_velocity_gain: float = 3
) -> Callable[[Array, Array], Array]:
    """Return a controller of poses (3, N) to goals (2, N): unicycle velocities (2, N).

    Speed and turn rate are the distance times cosine and sine of the bearing, so half the squared distance never grows:
    its derivative is ``-gain * (distance * cos(bearing))**2``.
    """
    not_negative(linear_velocity_gain=linear_velocity_gain, angular_velocity_gain=angular_velocity_gain)

    def position_uni_clf_controller(states: Array, positions: Array) -> Array:
        states = columns(states, 3, "states")
        east, north = columns(positions, 2, "positions", states.shape[1]) - states[:2]
        cos, sin = np.cos(states[2]), np.sin(states[2])
        return np.stack(
            [linear_velocity_gain * (cos * east + sin * north), angular_velocity_gain * (cos * north - sin * east)]
        )

    return position_uni_clf_controller


def create_clf_unicycle_pose_controller(
    approach_angle_gain: float = 1, desired_angle_gain: float = 2.7, rotation_error_gain: float = 1
) -> Callable[[Array, Array], Array]:
    """Return a controller of poses (3, N) to poses (3, N): unicycle velocities (2, N).

    With distance e, bearing theta of the goal in the goal's frame, and alpha the angle from the heading to that
    bearing: ``v = gamma e cos(alpha)`` and ``w = k alpha + gamma cos(alpha) sin(alpha) / alpha (alpha + h theta)``
    (Aicardi, Casalino, Bicchi, Balestrino, "Closed loop steering of unicycle like vehicles via Lyapunov techniques",
    IEEE Robotics and Automation Magazine 2(1), 1995; gains gamma, k, h in the order of the parameters). On the goal
    itself it stands: there the bearing is not defined.
    """

    def pose_uni_clf_controller(states: Array, poses: Array) -> Array:
        states = columns(states, 3, "states")
        poses = columns(poses, 3, "poses", states.shape[1])
        east, north = poses[:2] - states[:2]
        distance = np.hypot(east, north)
        bearing = np.arctan2(north, east)
        theta, alpha = _wrapped(bearing - poses[2]), _wrapped(bearing - states[2])
        cos = np.cos(alpha)
        turn = desired_angle_gain * alpha + approach_angle_gain * cos * np.sinc(alpha / np.pi) * (
            alpha + rotation_error_gain * theta
        )
        return np.stack([approach_angle_gain * distance * cos, np.where(distance > 0.0, turn, 0.0)])

    return pose_uni_clf_controller


def create_hybrid_unicycle_pose_controller(
    linear_velocity_gain: float = 1,
    angular_velocity_gain: float = 2,
    velocity_magnitude_limit: float = 0.15,
    angular_velocity_limit: float = np.pi,
    position_error: float = 0.05,
    position_epsilon: float = 0.02,
    rotation_error: float = 0.05,
) -> Callable[..., Array]:
    """Return a controller of poses (3, N) to poses (3, N): it drives to the point, then turns on the spot.

    Parameters
    ----------
    position_error, position_epsilon : m; a robot drives until it is within `position_error - position_epsilon`, and
        drives again when it is farther than `position_error`: two thresholds, so that turning does not alternate with
        driving
    rotation_error : rad that may be left

    Returns
    -------
    callable
        ``(states, poses, input_approach_state)`` to unicycle velocities (2, N). Which robots drive is remembered from
        call to call; an `input_approach_state` (1, N), 0 or not, replaces what is remembered.
    """
    to_unicycle = create_si_to_uni_dynamics(linear_velocity_gain, angular_velocity_limit)
    driving = np.ones(0, bool)

    def pose_uni_hybrid_controller(states: Array, poses: Array, input_approach_state: Array = _UNKNOWN) -> Array:
        nonlocal driving
        states = columns(states, 3, "states")
        count = states.shape[1]
        poses = columns(poses, 3, "poses", count)
        given = np.asarray(input_approach_state)
        if given.size == count:
            driving = given.ravel() != 0
        elif len(driving) != count:
            driving = np.ones(count, bool)
        offset = poses[:2] - states[:2]
        distance = np.linalg.norm(offset, axis=0)
        driving = np.where(driving, distance > position_error - position_epsilon, distance > position_error)
        turn = _wrapped(poses[2] - states[2])
        turn = np.where(np.abs(turn) > rotation_error, angular_velocity_gain * turn, 0.0)
        turning = np.stack([np.zeros(count), turn])
        return np.where(driving, to_unicycle(_limited(offset, velocity_magnitude_limit), states), turning)

    return pose_uni_hybrid_controller
