"""Each robot pursues the next one of the request, which brings all of them onto one circle at equal distances.

Marshall, Broucke, Francis, 2004; the angle that holds the radius as in Ramirez-Riberos, Pavone, Frazzoli, Miller, 2010.
"""

from dataclasses import dataclass

import numpy as np
from fullswarm.memory import rows


@dataclass
class Memory:
    outwards_rad: np.ndarray = rows(1)  # learnt: robots that turn late drive around a larger circle


def velocity(view, params, memory):
    count = max(len(view.members), 2)
    to = view.sum(np.where((view.neighbour_index == (view.index[view.of] + 1) % count)[:, None], view.offset, 0.0))
    gap = np.linalg.norm(to, axis=1, keepdims=True)
    near = params.gain * np.clip(1.0 - gap / (2.0 * params.radius_m * np.sin(np.pi / count)), -1.0, 1.0)
    memory.outwards_rad = np.clip(memory.outwards_rad + 0.1 * view.dt_s * near, -0.5, 0.5)
    turn = (np.pi / count + near + memory.outwards_rad)[:, 0]
    (x, y), c, s = (to / np.maximum(gap, 1e-6)).T, np.cos(turn), np.sin(turn)
    return params.speed_m_s * np.stack([c * x + s * y, c * y - s * x], axis=1)
