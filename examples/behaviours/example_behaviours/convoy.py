"""Carriers drive to a goal and show a red lamp, the other robots drive around the nearest carrier."""

import numpy as np


def velocity(view, params):
    carrier = view.role == "carrier"
    towards = params.goal - view.position
    far = np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-6)
    desired = towards * np.minimum(1.0, params.speed_m_s / far)
    view.actuate(carrier & view.can("gripper"), "lamp", "red")  # simulated robots have both
    view.finish(carrier & (far[:, 0] < params.reach_m[:, 0]), "arrived")
    there = np.where(view.neighbour_role == "carrier", view.distance, np.inf)
    for row in np.flatnonzero(~carrier):
        pairs = np.flatnonzero((view.of == row) & np.isfinite(there))
        if not len(pairs):
            desired[row] = 0.0
            continue
        pair = pairs[there[pairs].argmin()]
        out = -view.offset[pair] / max(view.distance[pair], 1e-6)
        around = np.array([-out[1], out[0]]) * params.speed_m_s[row]
        desired[row] = view.neighbour_velocity[pair] + around + (params.ring_m[row] - view.distance[pair]) * out
    return desired
