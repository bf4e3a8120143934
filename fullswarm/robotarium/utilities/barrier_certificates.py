"""Barrier certificates: they change desired velocities as little as is needed for robots to keep their distance.

For the points p_i of robots, a safe distance D and ``h_ij = |p_i - p_j|² - D²``, the velocities must satisfy

    d/dt h_ij = 2 (p_i - p_j)·(u_i - u_j) >= -gamma h_ij³       (pairs)
    n·u_i <= 0.4 gamma (room_i - D/2)³                          (each side of the arena, room_i to it in direction n)

(Wang, Ames, Egerstedt, "Safety barrier certificates for collisions-free multirobot systems", IEEE Transactions on
Robotics 33(3), 2017; the cubic form and the sides as used at the Robotarium: Pickem et al., "The Robotarium: A remotely
accessible swarm robotics research testbed", ICRA 2017). For unicycles the points are those in front of the wheels'
axis, see :mod:`~fullswarm.robotarium.utilities.transformations`. The robust form leaves room for disturbances of the
wheels (Emam, Glotfelter, Egerstedt, "Robust barrier functions for a fully autonomous, remotely accessible
swarm-robotics testbed", CDC 2019).

A point is kept from other points, not a body from other bodies: two robots whose points are behind each other's backs
may touch. The safety filter, which commands pass afterwards, keeps the bodies apart.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fullswarm.kernels import Array
from fullswarm.robotarium.utilities.arguments import (
    columns,
    not_negative,
    positive,
    require,
    safe_distance,
    speed_limit,
)
from fullswarm.robotarium.utilities.programme import Constraints, nearest
from fullswarm.robotarium.utilities.transformations import (
    create_si_to_uni_dynamics,
    create_si_to_uni_dynamics_with_backwards_motion,
    create_si_to_uni_mapping,
    create_uni_to_si_dynamics,
)

__all__ = [
    "create_si_to_uni_dynamics",
    "create_si_to_uni_dynamics_with_backwards_motion",
    "create_si_to_uni_mapping",
    "create_single_integrator_barrier_certificate",
    "create_single_integrator_barrier_certificate2",
    "create_single_integrator_barrier_certificate_with_boundary",
    "create_uni_to_si_dynamics",
    "create_unicycle_barrier_certificate",
    "create_unicycle_barrier_certificate2",
    "create_unicycle_barrier_certificate_with_boundary",
    "create_unicycle_differential_drive_barrier_certificate",
    "create_unicycle_differential_drive_barrier_certificate_with_boundary",
    "np",
]

Certificate = Callable[[Array, Array], Array]

ARENA: Array = np.array([-1.6, 1.6, -1.0, 1.0])
"""x_min, x_max, y_min, y_max of the testbed, m."""
SIDE_SHARE = 0.4
_NOTHING: Array = np.empty(0)


# ------------------------------------------------------------------ constraints
def _pairs(points: Array, safety_radius: float, gain: float, unsafe_gain: float) -> Constraints:
    """Return a constraint for each pair of points (2, N); `unsafe_gain` is gamma of those that are too near already."""
    first, second = np.triu_indices(points.shape[1], 1)
    offset = points[:, first] - points[:, second]
    h = (offset**2).sum(axis=0) - safety_radius**2
    rows = np.zeros((len(first), points.shape[1], 2))
    at = np.arange(len(first))
    rows[at, first], rows[at, second] = -2.0 * offset.T, 2.0 * offset.T
    return Constraints(rows.reshape(len(first), -1), np.where(h >= 0.0, gain, unsafe_gain) * h**3)


def _obstacles(points: Array, obstacles: Array, safety_radius: float, gain: float) -> Constraints:
    """Return a constraint for each point (2, N) and each point of an obstacle (2, M), which stands."""
    robot, obstacle = (each.ravel() for each in np.indices((points.shape[1], obstacles.shape[1])))
    offset = points[:, robot] - obstacles[:, obstacle]
    h = (offset**2).sum(axis=0) - safety_radius**2
    rows = np.zeros((len(robot), points.shape[1], 2))
    rows[np.arange(len(robot)), robot] = -2.0 * offset.T
    return Constraints(rows.reshape(len(robot), -1), gain * h**3)


def _sides(points: Array, arena: Array, safety_radius: float, gain: float) -> Constraints:
    """Return four constraints for each point (2, N); `arena`: x_min, x_max, y_min, y_max."""
    out = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    room = (out @ [1.0, 1.0] * arena)[:, None] - out @ points - safety_radius / 2.0
    count = points.shape[1]
    rows = np.einsum("ij,sk->sijk", np.identity(count), out).reshape(4 * count, -1)
    return Constraints(rows, (SIDE_SHARE * gain * room**3).ravel())


def _arena(boundary_points: Array) -> Array:
    """Return x_min, x_max, y_min, y_max as an array (4,)."""
    arena = np.array(boundary_points, float)
    require(arena.shape == (4,), "boundary_points", boundary_points, "x_min, x_max, y_min, y_max")
    return arena


# ------------------------------------------------------------------ single integrators
def _single_integrator(
    gain: float, unsafe_gain: float, safety_radius: float, magnitude_limit: float, arena: Array | None = None
) -> Certificate:
    positive(barrier_gain=gain, unsafe_barrier_gain=unsafe_gain)
    safe_distance(safety_radius)
    speed_limit(magnitude_limit)

    def f(dxi: Array, x: Array) -> Array:
        points = columns(x, 2, "x")
        desired = columns(dxi, 2, "dxi", points.shape[1])
        size = np.linalg.norm(desired, axis=0)
        desired *= np.minimum(1.0, magnitude_limit / np.maximum(size, 1e-300))
        constraints = _pairs(points, safety_radius, gain, unsafe_gain)
        if arena is not None:
            constraints += _sides(points, arena, safety_radius, gain)
        return nearest(desired, constraints)

    return f


def create_single_integrator_barrier_certificate(
    barrier_gain: float = 100, safety_radius: float = 0.17, magnitude_limit: float = 0.2
) -> Certificate:
    """Return a certificate for points: desired velocities (2, N) and points (2, N) to safe velocities (2, N).

    Parameters
    ----------
    barrier_gain : gamma; the greater, the faster points may approach each other
    safety_radius : m between two points
    magnitude_limit : m/s, to which desired velocities are shortened before
    """
    return _single_integrator(barrier_gain, barrier_gain, safety_radius, magnitude_limit)


def create_single_integrator_barrier_certificate_with_boundary(
    barrier_gain: float = 100, safety_radius: float = 0.17, magnitude_limit: float = 0.2, boundary_points: Array = ARENA
) -> Certificate:
    """Return a certificate as :func:`create_single_integrator_barrier_certificate` that keeps points in the arena.

    Parameters
    ----------
    boundary_points : (4,) x_min, x_max, y_min, y_max in m
    """
    return _single_integrator(barrier_gain, barrier_gain, safety_radius, magnitude_limit, _arena(boundary_points))


def create_single_integrator_barrier_certificate2(
    barrier_gain: float = 100,
    unsafe_barrier_gain: float = 1e6,
    safety_radius: float = 0.17,
    magnitude_limit: float = 0.2,
) -> Certificate:
    """Return a certificate with another gain for points that are nearer than the safe distance: they part faster."""
    return _single_integrator(barrier_gain, unsafe_barrier_gain, safety_radius, magnitude_limit)


# ------------------------------------------------------------------ unicycles
def _unicycle(of_points: Certificate, projection_distance: float) -> Certificate:
    """Return the certificate for unicycles that applies one for points to those in front of the robots."""
    to_unicycle, to_points = create_si_to_uni_mapping(projection_distance)
    to_velocities = create_uni_to_si_dynamics(projection_distance)

    def f(dxu: Array, x: Array) -> Array:
        return to_unicycle(of_points(to_velocities(dxu, x), to_points(x)), x)

    return f


def create_unicycle_barrier_certificate(
    barrier_gain: float = 100,
    safety_radius: float = 0.12,
    projection_distance: float = 0.05,
    magnitude_limit: float = 0.2,
) -> Certificate:
    """Return a certificate for unicycles: desired unicycle velocities (2, N) and poses (3, N) to safe ones (2, N).

    Parameters
    ----------
    safety_radius : m between two robots; their points keep `projection_distance` more
    projection_distance : m from a robot to the point in front of it
    """
    safe_distance(safety_radius)
    points = create_single_integrator_barrier_certificate(
        barrier_gain, safety_radius + projection_distance, magnitude_limit
    )
    return _unicycle(points, projection_distance)


def create_unicycle_barrier_certificate_with_boundary(
    barrier_gain: float = 100,
    safety_radius: float = 0.12,
    projection_distance: float = 0.05,
    magnitude_limit: float = 0.2,
    boundary_points: Array = ARENA,
) -> Certificate:
    """Return a certificate as :func:`create_unicycle_barrier_certificate` that keeps the points in the arena."""
    safe_distance(safety_radius)
    points = create_single_integrator_barrier_certificate_with_boundary(
        barrier_gain, safety_radius + projection_distance, magnitude_limit, boundary_points
    )
    return _unicycle(points, projection_distance)


def create_unicycle_barrier_certificate2(
    barrier_gain: float = 500,
    unsafe_barrier_gain: float = 1e6,
    safety_radius: float = 0.12,
    projection_distance: float = 0.05,
    magnitude_limit: float = 0.2,
) -> Certificate:
    """Return a certificate for unicycles with another gain for those that are too near each other already."""
    safe_distance(safety_radius)
    points = create_single_integrator_barrier_certificate2(
        barrier_gain, unsafe_barrier_gain, safety_radius + projection_distance, magnitude_limit
    )
    return _unicycle(points, projection_distance)


# ------------------------------------------------------------------ differential drives, robust
def create_unicycle_differential_drive_barrier_certificate(
    max_num_obstacle_points: int = 100,
    max_num_robots: int = 30,
    disturbance: float = 5,
    wheel_vel_limit: float = 12.5,
    base_length: float = 0.105,
    wheel_radius: float = 0.016,
    projection_distance: float = 0.05,
    barrier_gain: float = 150,
    safety_radius: float = 0.17,
) -> Callable[..., Array]:
    """Return a robust certificate for differential drives, within the limits of their wheels.

    Parameters
    ----------
    max_num_obstacle_points, max_num_robots : more are refused
    disturbance : rad/s by which each wheel may turn faster or slower than commanded
    wheel_vel_limit : rad/s
    base_length, wheel_radius : m
    projection_distance, safety_radius : m; between the points in front of the robots

    Returns
    -------
    callable
        ``(dxu, x, obstacles)`` to unicycle velocities (2, N); robots keep away from the points `obstacles` (2, M).
    """
    return _robust(
        (max_num_robots, max_num_obstacle_points), disturbance, wheel_vel_limit, (base_length, wheel_radius),
        projection_distance, barrier_gain, safety_radius, None,
    )  # fmt: skip


def create_unicycle_differential_drive_barrier_certificate_with_boundary(
    max_num_obstacle_points: int = 100,
    max_num_robots: int = 30,
    disturbance: float = 5,
    wheel_vel_limit: float = 12.5,
    base_length: float = 0.105,
    wheel_radius: float = 0.016,
    projection_distance: float = 0.05,
    barrier_gain: float = 150,
    safety_radius: float = 0.17,
    boundary_points: Array = ARENA,
) -> Callable[..., Array]:
    """Return a certificate as the one without boundary that also keeps the points in the arena."""
    return _robust(
        (max_num_robots, max_num_obstacle_points), disturbance, wheel_vel_limit, (base_length, wheel_radius),
        projection_distance, barrier_gain, safety_radius, _arena(boundary_points),
    )  # fmt: skip


def _robust(
    most: tuple[int, int], disturbance: float, wheel_limit: float, wheels: tuple[float, float], ahead_m: float,
    gain: float, safety_radius: float, arena: Array | None,
) -> Callable[..., Array]:  # fmt: skip
    """Return the robust certificate; `most`: robots and obstacles, `wheels`: base length and wheel radius in m."""
    base_m, radius_m = wheels
    positive(wheel_vel_limit=wheel_limit, base_length=base_m, wheel_radius=radius_m, barrier_gain=gain)
    not_negative(disturbance=disturbance)
    _, to_points = create_si_to_uni_mapping(ahead_m)
    to_velocities = create_uni_to_si_dynamics(ahead_m)
    # From wheel speeds, left and right, to the velocity of the point in the robot's frame.
    drive = radius_m * np.array([[0.5, 0.5], [-ahead_m / base_m, ahead_m / base_m]])

    def robust_barriers(dxu: Array, x: Array, obstacles: Array = _NOTHING) -> Array:
        poses = columns(x, 3, "x")
        count = poses.shape[1]
        require(count <= most[0], "max_num_robots", most[0], f"{count} or more: there are so many robots")
        points, cos, sin = to_points(poses), np.cos(poses[2]), np.sin(poses[2])
        turned = np.array([[cos, -sin], [sin, cos]]).transpose(2, 0, 1)  # (N, 2, 2) from a robot's frame to the arena's
        constraints = _pairs(points, safety_radius, gain, gain)
        if np.size(obstacles):
            there = columns(obstacles, 2, "obstacles")
            require(there.shape[1] <= most[1], "max_num_obstacle_points", most[1], f"{there.shape[1]} or more")
            constraints += _obstacles(points, there, safety_radius, gain)
        of_wheels = np.einsum("mni,nij->mnj", constraints.rows.reshape(-1, count, 2), turned @ drive)
        worst = disturbance * np.abs(of_wheels).sum(axis=(1, 2))
        constraints = Constraints(constraints.rows, constraints.limits - worst)
        if arena is not None:
            constraints += _sides(points, arena, safety_radius, gain)
        constraints += _wheel_limits(turned @ drive, wheel_limit)
        along, left = np.einsum("nji,jn->in", turned, nearest(to_velocities(dxu, poses), constraints))
        return np.stack([along, left / ahead_m])

    return robust_barriers


def _wheel_limits(jacobians: Array, limit: float) -> Constraints:
    """Return the constraints of wheel speeds whose `jacobians` (N, 2, 2) give the velocities of the points."""
    count = len(jacobians)
    inverse = np.einsum("nw,nij->niwj", np.identity(count), np.linalg.inv(jacobians)).reshape(2 * count, -1)
    return Constraints(np.vstack([inverse, -inverse]), np.full(4 * count, float(limit)))
