"""The first robot of the request drives to a goal, each other one follows the robot named before it."""

import numpy as np


def velocity(view, params):
    towards = params.leader_goal - view.position
    far = np.linalg.norm(towards, axis=1, keepdims=True)
    lead = towards * np.minimum(params.gain, params.speed_m_s / np.maximum(far, 1e-6))
    before = (view.neighbour_index == view.index[view.of] - 1)[:, None]
    gap = np.maximum(view.distance[:, None], 1e-6)
    along = (view.neighbour_velocity * view.offset).sum(
        axis=1, keepdims=True
    ) / gap  # the speed at which it drives away
    pull = (params.gain[view.of] * (gap - params.gap_m[view.of]) + along) * view.offset / gap
    follow = view.sum(np.where(before, pull, 0.0))
    return np.where((view.index == 0)[:, None], lead, follow)
