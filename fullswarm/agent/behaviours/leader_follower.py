"""Leader and followers: the first robot of the request drives to a goal, the others keep their places behind it.

The places are fixed in the leader's frame, as the leader-referenced formations of Balch and Arkin, Behavior-based
formation control for multirobot teams (IEEE T-RA 1998): column, line and wedge. A follower's velocity is that of its
place, which moves and turns with the leader, and the gain times what it is off (feed-forward and proportional feedback:
a constant motion of the leader leaves no error). The leader waits for followers that are far behind. If the first robot
is lost, the next one of the request leads.
"""

from __future__ import annotations

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array, Index

HALF = np.sqrt(0.5)
ARRIVED_M = 0.1


def velocity(view: View, params: Params) -> Array:
    """Return the leader's way to the goal and the followers' to their places, (n, 2) m/s."""
    leader, pair = leading(view)
    lead, rest_m = _lead(view, params)
    follow, off_m, leader_at = _follow(view, params, leader, pair)
    leads = pair < 0
    # The one that leads ends last: without it the next one would lead.
    to_go = np.linalg.norm(params.leader_goal - np.where(leads[:, None], view.position, leader_at), axis=1)
    there = np.where(leads, (view.neighbours[:, 0] == 0.0) & (rest_m < ARRIVED_M), off_m < 2.0 * ARRIVED_M)
    view.finish(there & (to_go < 2.0 * ARRIVED_M) & (view.time_s > 2.0), "arrived")
    desired: Array = np.where(leads[:, None], lead, follow)
    return desired


def leading(view: View) -> tuple[Index, Index]:
    """Return the place in the request of the robot that leads each one, and the pair with it; -1: it leads itself."""
    index = view.neighbour_index
    leader = view.index.copy()
    member = index >= 0
    np.minimum.at(leader, view.of[member], index[member])
    pair = np.full(len(leader), -1)
    found = np.flatnonzero((index == leader[view.of]) & member)
    pair[view.of[found]] = found
    return leader, pair


def places(index: Index, shape: str, spacing_m: Array) -> Array:
    """Return the places of followers, `index` (n,) from 1, in the leader's frame: ahead and to the left, (n, 2) m."""
    side = np.where(index % 2 == 1, 1.0, -1.0)
    row = (index + 1) // 2
    if shape == "column":
        steps = np.stack([-index, 0.0 * index], axis=1)
    elif shape == "line":
        steps = np.stack([0.0 * row, side * row], axis=1)
    else:
        steps = HALF * np.stack([-row, side * row], axis=1)
    found: Array = spacing_m * steps
    return found


def _lead(view: View, params: Params) -> tuple[Array, Array]:
    """Return the velocity to the goal, slower the farther the last follower is behind, and the way that is left."""
    towards = params.leader_goal - view.position
    rest_m = np.linalg.norm(towards, axis=1)
    farthest_m = np.zeros(len(rest_m))
    np.maximum.at(farthest_m, view.of, view.distance)
    most_m = (len(view.members) + 1.0) * params.spacing_m[:, 0]
    patience = np.clip(2.0 - farthest_m / most_m, 0.0, 1.0)
    speed = np.minimum(params.gain[:, 0] * rest_m, params.speed_m_s[:, 0] * patience)
    return towards * (speed / np.maximum(rest_m, 1e-6))[:, None], rest_m


def _follow(view: View, params: Params, leader: Index, pair: Index) -> tuple[Array, Array, Array]:
    """Return the velocity of each follower, how far it is off its place, and where its leader is."""
    count = len(pair)
    if not len(view.of):
        return np.zeros((count, 2)), np.full(count, np.inf), view.position
    state = view.states[view.other[pair]]
    at = view.position + view.offset[pair]
    cos, sin, speed, turn = np.cos(state[:, 2]), np.sin(state[:, 2]), state[:, 3], state[:, 4]
    ahead, left = places(view.index - leader, str(params.shape), params.spacing_m).T
    arm = np.stack([cos * ahead - sin * left, sin * ahead + cos * left], axis=1)
    moves = np.stack([speed * cos - turn * arm[:, 1], speed * sin + turn * arm[:, 0]], axis=1)
    off = at + arm - view.position
    return moves + params.gain * off, np.linalg.norm(off, axis=1), at
