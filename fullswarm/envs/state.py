"""The state of an episode's robots, as a reward sees it."""

from __future__ import annotations

from dataclasses import dataclass

from fullswarm.kernels import Array, Flags


@dataclass(frozen=True)
class State:
    """The n robots of an episode at the end of a step.

    Attributes
    ----------
    time_s : since the episode began
    pose, twist : (n, 3) true, m, m, rad; (n, 2) measured, m/s, rad/s
    goal, distance_m : (n, 2) m, (n,) to it
    arrived : (n,) within `Setup.goal_radius_m` of the goal
    touched : (n,) has begun to touch something since the state before
    command : (n, 2) the last action in SI; zeros for robots that no action drives
    changed_m_s : (n,) how far the safety filter changed the velocity that was desired, in the last control period
    """

    time_s: float
    pose: Array
    twist: Array
    goal: Array
    distance_m: Array
    arrived: Flags
    touched: Flags
    command: Array
    changed_m_s: Array
