"""What is rewarded. A reward is a function of the states before and after a step, (n,) for n robots."""

from __future__ import annotations

from collections.abc import Callable

from fullswarm.envs.state import State
from fullswarm.kernels import Array

Reward = Callable[[State, State], Array]

ARRIVED, TOUCHED = 1.0, 1.0
PER_SECOND = 0.05


def to_goal(before: State, after: State) -> Array:
    """Reward each metre nearer to the goal by 1 and the arrival by 1; charge 0.05 per second and 1 per contact."""
    nearer = before.distance_m - after.distance_m
    arrived = ARRIVED * (after.arrived & ~before.arrived)
    reward: Array = nearer + arrived - TOUCHED * after.touched - PER_SECOND * (after.time_s - before.time_s)
    return reward
