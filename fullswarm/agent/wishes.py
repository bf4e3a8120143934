"""What the robots would like to do: the laws are evaluated, and their wishes filtered where asked."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import structlog
from numpy.typing import NDArray

from fullswarm.agent.tasks import Group
from fullswarm.agent.view import View
from fullswarm.config import AgentConfig
from fullswarm.drivers.base import FleetReading

if TYPE_CHECKING:
    from fullswarm.agent.node import AgentNode

log = structlog.get_logger()


class Wishes:
    """Puts the wishes of all laws that run before the controller, tick by tick.

    Attributes
    ----------
    law_error : what the last failure of each robot's law was, empty if it never failed
    """

    def __init__(self, agent: AgentNode, settings: AgentConfig, bounds_m: tuple[float, float, float, float]) -> None:
        self._agent, self._config, self._bounds = agent, settings, bounds_m
        count = len(agent.fleet.ids)
        # Robots that sense no obstacles have their map instead.
        self._sees_obstacles = any(each.senses_obstacles for each in agent.fleet.descriptions)
        self._alone = self._near = np.zeros(count + 1, np.int64), np.zeros(1, np.int64)
        self._planar = np.full((count, 2), math.nan)
        self._law_errors: set[str] = set()
        self.law_error = [""] * count

    def near(self, now_s: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return who is in sensing range of each robot (``Neighbours.around``), of the last tick if asked then."""
        agent = self._agent
        if self._near is self._alone and len(agent.fleet.ids):
            agent.neighbours.look(now_s)
            return agent.neighbours.around(np.ascontiguousarray(agent.pose[:, :2]), self._config.sensing_radius_m)
        return self._near

    def gather(self, groups: list[Group], now_s: float, reading: FleetReading) -> None:
        """Evaluate the laws and put their wishes, filtered where asked, before the controller."""
        self._near = self._alone
        agent, settings = self._agent, self._config
        tasks = agent.tasks
        if not groups and not tasks.any_filtered:
            return
        pose, neighbours = agent.pose, agent.neighbours
        position = np.ascontiguousarray(pose[:, :2])
        neighbours.look(now_s)

        self._planar.fill(math.nan)
        planar = False
        for group in groups:
            reach_m = group.hearing_m or settings.sensing_radius_m
            view = View(
                position, pose[:, 2], agent.radius, partial(neighbours.within, position, reach_m, tasks.team),
                neighbours.predicted, neighbours.heard, self._bounds, agent.atlas.known,
            )  # fmt: skip
            whole = len(group.rows) == len(position)
            planar |= self._evaluate(group, view if whole else view.select(group.rows), now_s)
        if not planar and not tasks.any_filtered:
            return
        if tasks.any_filtered:
            # A stick is not turned aside: whoever holds it sees the robot.
            agent.deadlocks.resolve(now_s, self._planar, tasks.lasting, pose, agent.controller.speed_limit)
        reach_m = settings.sensing_radius_m
        self._near = near = neighbours.around(position, reach_m) if tasks.any_filtered else self._alone
        obstacles = reading.obstacles if self._sees_obstacles else agent.atlas.given
        agent.filter.apply(
            now_s, self._planar, tasks.filtered, pose, reading.twist, reading.stamp_s, tasks.gain_per_s,
            tasks.margin_m, near, neighbours.believed, obstacles, agent.controller.wished,
        )  # fmt: skip

    def _evaluate(self, group: Group, view: View, now_s: float) -> bool:
        """Call one law; if it raises or answers something that is not finite, its robots stand and say so.

        Returns
        -------
        bool
            It wishes planar velocities, which have yet to be mapped to twists.
        """
        try:
            wished = group.call(view, group.params)
            # On board there is one robot, and reducing an array costs it five times as much as two numbers.
            if not math.isfinite(sum(wished[0].tolist()) if len(wished) == 1 else np.add.reduce(wished, None)):
                raise ValueError("the law's answer is not finite")
        except Exception as error:  # a law is outside code: whatever it raises, the robot must stand
            self._law_failed(group, error)
            return False
        controller = self._agent.controller
        rows = slice(None) if len(group.rows) == len(self.law_error) else group.rows
        (self._planar if group.planar else controller.wished)[rows] = wished
        controller.valid_until_s[rows] = now_s + self._config.command_ttl_s
        controller.law_failed[rows] = False
        return group.planar

    def _law_failed(self, group: Group, error: Exception) -> None:
        text = f"law '{group.law}': {type(error).__name__}: {error}"
        self._agent.controller.law_failed[group.rows] = True
        for row in group.rows:
            self.law_error[row] = text
        if text not in self._law_errors:
            self._law_errors.add(text)
            log.error("law failed; its robots stand", law=group.law, error=str(error), exc_info=error)
