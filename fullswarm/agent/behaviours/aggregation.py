"""Aggregation: robots that sense no others search at random, robots that find some join them, until all are together.

A state machine per robot with random transitions, after Soysal and Şahin, Probabilistic aggregation strategies in swarm
robotic systems (SIS 2005). As in the cockroaches of Jeanson et al. (J. Theor. Biol. 2005) a robot leaves a group the
less readily the larger it is: at the rate ``leave_per_s / (1 + N)²`` with N neighbours, so that large groups grow at
the expense of small ones. It then drives off for `away_s` before it joins again. A group is what a robot senses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fullswarm.agent.navigation.edges import inwards
from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array, Flags, Index
from fullswarm.memory import rows

SEARCH, JOIN, WAIT = range(3)
LOOSE = 1.5
"""A robot that waits joins again when its nearest neighbour is farther than the gap by this factor."""
EDGE_M = 0.8
"""A robot that searches turns back so far before the edge."""


@dataclass
class Memory:
    """State; until when it may not join; the direction in which it searches."""

    state: Index = rows(fill=SEARCH)
    away_until_s: Array = rows()
    course_rad: Array = rows(fill=np.nan)


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return the search at full speed, the way to the middle of the neighbours, or zero, (n, 2) m/s."""
    count = len(view.position)
    nearest_m = np.full(count, np.inf)
    np.minimum.at(nearest_m, view.of, view.distance)
    gap_m, group = params.gap_m[:, 0], view.neighbours
    leaves = view.random.uniform() < (params.leave_per_s * view.dt_s / (1.0 + group) ** 2)[:, 0]
    leaves &= memory.state == WAIT
    memory.away_until_s = np.where(leaves, view.time_s + params.away_s[:, 0], memory.away_until_s)
    free = ~leaves & (view.time_s >= memory.away_until_s)
    joins = free & np.isfinite(nearest_m)
    there = joins & (nearest_m < np.where(memory.state == WAIT, LOOSE, 1.0) * gap_m)
    memory.state = np.select([there, joins], [WAIT, JOIN], SEARCH)
    search = _search(view, params, memory, leaves)
    middle = view.sum(view.offset) / np.maximum(group, 1.0)
    approach = middle / np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 0.2)
    direction: Array = np.choose(memory.state[:, None], [search, approach, 0.0])
    return params.speed_m_s * direction


def _search(view: View, params: Params, memory: Memory, leaves: Flags) -> Array:
    """Return the directions of a random walk, (n, 2): straight ways of exponential length, turned back at the edge."""
    turn = view.random.uniform(-np.pi, np.pi)
    tumbles: Flags = view.random.uniform() < params.turns_per_s[:, 0] * view.dt_s
    course = np.where(np.isnan(memory.course_rad), view.heading, memory.course_rad)
    course = np.where(tumbles | leaves, turn, course)
    ahead = np.stack([np.cos(course), np.sin(course)], axis=1)
    edge = np.full((len(course), 1), EDGE_M)
    push = inwards(view.position, view.bounds_m, edge)
    ahead = np.where(ahead * push < 0.0, -ahead, ahead)  # reflected
    memory.course_rad = np.arctan2(ahead[:, 1], ahead[:, 0])
    return ahead
