"""Follow waypoints by a PID control law with memory, and end with a result at the last one."""

from dataclasses import dataclass

import numpy as np
from fullswarm.memory import rows


@dataclass
class Memory:
    leg: np.ndarray = rows(fill=0)  # the waypoint that the robot drives to
    integral: np.ndarray = rows(2)  # m s


def velocity(view, params, memory):
    points = np.array(params.waypoints)
    error = points[memory.leg] - view.position
    there = np.linalg.norm(error, axis=1) < params.reach_m[:, 0]
    view.finish(there & (memory.leg == len(points) - 1), "arrived", f"all {len(points)} waypoints")
    memory.leg = np.minimum(memory.leg + there, len(points) - 1)
    memory.integral = np.where(there[:, None], 0.0, np.clip(memory.integral + view.dt_s * error, -1.0, 1.0))
    moving = view.twist[:, :1] * np.stack([np.cos(view.heading), np.sin(view.heading)], axis=1)
    return params.kp * error + params.ki * memory.integral - params.kd * moving
