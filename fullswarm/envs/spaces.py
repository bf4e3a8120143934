"""Defines what a policy is given and what it commands: names, units, ranges. Needs no more than a robot has."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.safety.barrier import box_gap
from fullswarm.agent.view import View
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Index

Observation = NDArray[np.float32]
LARGEST = 1e6
"""Bound of a number in SI that has no other, m."""


@dataclass(frozen=True)
class Spaces:
    """The observation and the action of one robot. The same object trains a policy and runs it.

    The observation is a vector of float32, see `names`. Lengths are along the robot's own axes, ahead and to the left,
    if the action is a twist; along the world's axes, east and north, if it is a planar velocity. It consists of

    - ``goal_x``, ``goal_y``: from the robot to its goal, shortened to `goal_m` where that is farther away
    - ``speed``, ``turn``: measured
    - with `pose`: ``x``, ``y`` from the middle of the arena, and ``cos``, ``sin`` of the heading
    - for each of the nearest `neighbours`: ``x``, ``y`` from the robot to it, its velocity ``vx``, ``vy`` relative to
      the robot's, ``seen``. Zeros where there is none within `sensing_m`
    - for each of the nearest `obstacles`, walls included: ``x``, ``y`` from the robot's centre to the nearest point of
      its surface, ``seen``

    The action is ``speed``, ``turn`` or ``east``, ``north``. The safety filter can direct a planar velocity around what
    is in the way, and resolves deadlocks; a twist it slows down.

    Attributes
    ----------
    neighbours, obstacles : how many of each are observed
    sensing_m : how far robots and obstacles are observed; obstacles no farther than the robots sense them
    goal_m : longest distance to the goal that is told apart
    pose : the robot's place in the arena is observed; a policy that does not need it suits any arena
    action : "planar" or "twist"
    speed_m_s, turn_rad_s : largest that can be commanded and observed
    period_s : time between two actions; a whole number of control periods
    scaled : all numbers are divided by the largest, so that they are between -1 and 1; else they are in m, m/s, rad/s
    bounds_m : x_min, y_min, x_max, y_max of the arena that `pose` refers to; None: where the robots are

    Raises
    ------
    ConfigError
        A number is out of range.
    """

    neighbours: int = 3
    obstacles: int = 0
    sensing_m: float = 3.0
    goal_m: float = 5.0
    pose: bool = True
    action: Literal["twist", "planar"] = "planar"
    speed_m_s: float = 0.5
    turn_rad_s: float = 2.0
    period_s: float = 0.1
    scaled: bool = True
    bounds_m: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        for name in ("sensing_m", "goal_m", "speed_m_s", "turn_rad_s", "period_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name} = {getattr(self, name)} is not positive", where="Spaces")
        for name in ("neighbours", "obstacles"):
            if not 0 <= getattr(self, name) <= 1000:
                raise ConfigError(f"{name} = {getattr(self, name)} is not from 0 to 1000", where="Spaces")
        if self.action not in ("twist", "planar"):
            raise ConfigError(f"'{self.action}' is no action", where="Spaces", hint='"twist" or "planar"')

    # ------------------------------------------------------------------ the vectors
    @property
    def names(self) -> tuple[str, ...]:
        """Name of each number of the observation."""
        pose = ("x", "y", "cos", "sin") if self.pose else ()
        near = [f"neighbour{k}_{name}" for k in range(self.neighbours) for name in ("x", "y", "vx", "vy", "seen")]
        boxes = [f"obstacle{k}_{name}" for k in range(self.obstacles) for name in ("x", "y", "seen")]
        return "goal_x", "goal_y", "speed", "turn", *pose, *near, *boxes

    @property
    def size(self) -> int:
        """How many numbers an observation has."""
        return 4 + 4 * self.pose + 5 * self.neighbours + 3 * self.obstacles

    @property
    def largest(self) -> Array:
        """Largest magnitude of each number of the observation in SI, (size,)."""
        x_min, y_min, x_max, y_max = self.bounds_m or (-LARGEST, -LARGEST, LARGEST, LARGEST)
        pose = (0.5 * (x_max - x_min), 0.5 * (y_max - y_min), 1.0, 1.0) if self.pose else ()
        reach, relative = self.sensing_m, 2.0 * self.speed_m_s
        near = (reach, reach, relative, relative, 1.0) * self.neighbours
        boxes = (reach, reach, 1.0) * self.obstacles
        return np.array([self.goal_m, self.goal_m, self.speed_m_s, self.turn_rad_s, *pose, *near, *boxes])

    @property
    def observation_high(self) -> Observation:
        """Largest of each number of the observation, (size,); the smallest is its negative."""
        return (np.ones(self.size) if self.scaled else self.largest).astype(np.float32)

    @property
    def command_limits(self) -> Array:
        """Largest command, (2,): m/s and rad/s, or m/s twice."""
        return np.array([self.speed_m_s, self.turn_rad_s if self.action == "twist" else self.speed_m_s])

    @property
    def action_high(self) -> Observation:
        """Largest of each number of the action, (2,); the smallest is its negative."""
        return (np.ones(2) if self.scaled else self.command_limits).astype(np.float32)

    # ------------------------------------------------------------------ between robots and policies
    def velocities(self, actions: object, count: int) -> Array:
        """Return what actions (count, 2) command, in SI; what is beyond the limits is cut off.

        Raises
        ------
        ConfigError
            They are no finite numbers of that shape.
        """
        try:
            found = np.array(actions, float)
        except (TypeError, ValueError):
            found = np.empty(0)
        if found.shape != (count, 2):
            raise ConfigError(f"actions have shape {found.shape}, expected ({count}, 2): one per observation")
        if not np.isfinite(found).all():
            raise ConfigError("an action is not finite")
        limits = self.command_limits
        clipped: Array = np.clip(found * limits if self.scaled else found, -limits, limits)
        return clipped

    def observe(self, view: View, goal: Array) -> Observation:
        """Return the observations of the n robots of a view, (n, size).

        Parameters
        ----------
        goal : (n, 2) m
        """
        offset = self._in_axes(view, goal - view.position)
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        parts = [offset * np.minimum(1.0, self.goal_m / np.maximum(distance, self.goal_m)), view.twist]
        if self.pose:
            x_min, y_min, x_max, y_max = self.bounds_m or view.bounds_m
            middle = [0.5 * (x_min + x_max), 0.5 * (y_min + y_max)]
            parts += [view.position - middle, np.cos(view.heading)[:, None], np.sin(view.heading)[:, None]]
        if self.neighbours:
            parts.append(self._near(view))
        if self.obstacles:
            parts.append(self._surfaces(view))
        found = np.concatenate(parts, axis=1)
        largest = self.largest
        if self.pose and self.bounds_m is None:
            largest[4:6] = 0.5 * (x_max - x_min), 0.5 * (y_max - y_min)
        found = np.clip(found, -largest, largest)
        observation: Observation = (found / largest if self.scaled else found).astype(np.float32)
        return observation

    def _in_axes(self, view: View, vectors: Array, rows: Index | slice = slice(None)) -> Array:
        """Return vectors (k, 2) of the robots `rows` in the axes that are observed."""
        if self.action == "planar":
            return vectors
        cos, sin = np.cos(view.heading[rows]), np.sin(view.heading[rows])
        x, y = vectors[:, 0], vectors[:, 1]
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)

    def _near(self, view: View) -> Array:
        """Return the nearest neighbours, (n, 5 neighbours)."""
        count, most = len(view.position), self.neighbours
        found = np.zeros((count, most, 5))
        within = np.flatnonzero(view.distance <= self.sensing_m)
        order = within[np.lexsort((view.distance[within], view.of[within]))]  # by robot, then by distance
        of = view.of[order]
        rank = np.arange(len(of)) - np.searchsorted(of, of)
        order, of, rank = (each[rank < most] for each in (order, of, rank))
        own = view.twist[:, :1] * np.stack([np.cos(view.heading), np.sin(view.heading)], axis=1)
        found[of, rank, :2] = self._in_axes(view, view.offset[order], of)
        found[of, rank, 2:4] = self._in_axes(view, view.neighbour_velocity[order] - own[of], of)
        found[of, rank, 4] = 1.0
        return found.reshape(count, -1)

    def _surfaces(self, view: View) -> Array:
        """Return the nearest points of the nearest obstacles, (n, 3 obstacles)."""
        found = np.zeros((len(view.position), self.obstacles, 3))
        for row, (x, y) in enumerate(view.position.tolist()):
            boxes = view.known(row, "own")
            gaps = [box_gap(x, y, boxes, k) for k in range(len(boxes))]
            near = sorted(each for each in gaps if each[0] <= self.sensing_m)[: self.obstacles]
            for place, (gap, to_x, to_y) in enumerate(near):
                found[row, place] = gap * to_x, gap * to_y, 1.0
        flat = found.reshape(-1, 3)
        flat[:, :2] = self._in_axes(view, flat[:, :2], np.repeat(np.arange(len(found)), self.obstacles))
        return flat.reshape(len(found), -1)
