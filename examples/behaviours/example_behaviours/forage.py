"""Forage: a state machine per robot that searches at random, carries what it sees to the nest, and counts the loads."""

from dataclasses import dataclass

import numpy as np
from fullswarm.memory import rows

SEARCH, FETCH, CARRY = range(3)


@dataclass
class Memory:
    state: np.ndarray = rows(fill=SEARCH)
    place: np.ndarray = rows(2, fill=np.nan)  # where it searches next
    loads: np.ndarray = rows(fill=0)


def velocity(view, params, memory):
    food, low, high = np.array(params.food), np.array(view.bounds_m[:2]), np.array(view.bounds_m[2:])
    ways = np.linalg.norm(food - view.position[:, None], axis=2)
    seen, near, reach = food[ways.argmin(axis=1)], ways.min(axis=1), params.reach_m[:, 0]
    carries = memory.state == CARRY
    unloads = carries & (np.linalg.norm(params.nest - view.position, axis=1) < reach)
    memory.loads += unloads
    view.finish(memory.loads >= params.loads[:, 0], "arrived", "all loads are in the nest")
    memory.state = np.select([unloads, carries | (near < reach), near < params.sight_m[:, 0]], [SEARCH, CARRY, FETCH])
    there = ~(np.linalg.norm(memory.place - view.position, axis=1, keepdims=True) > 0.7)
    memory.place = np.where(there, view.random.uniform(low + 1.0, high - 1.0, 2), memory.place)
    to = np.choose(memory.state[:, None], [memory.place, seen, params.nest]) - view.position
    return params.speed_m_s * to / np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 0.2)
