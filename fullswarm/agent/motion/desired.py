"""Evaluates the control laws and puts the desired twists, filtered where requested, before the robot controller."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
import structlog

from fullswarm import registry
from fullswarm.agent.motion.actuation import Actuation
from fullswarm.agent.motion.coordination import Coordinator, Crowd
from fullswarm.agent.motion.evade import Evasion
from fullswarm.agent.motion.robot_controller import RobotController
from fullswarm.agent.motion.settling import Settling
from fullswarm.agent.neighbours.estimates import Nearby, Neighbours
from fullswarm.agent.neighbours.obstacle_map import ObstacleMap
from fullswarm.agent.neighbours.standing import Standing
from fullswarm.agent.orders.tasks import Group, Tasks
from fullswarm.agent.safety.deadlock import Deadlocks
from fullswarm.agent.safety.filter import Measured, Requested, SafetyFilter
from fullswarm.agent.state import AgentState
from fullswarm.agent.view import Context, Ending, RequestsDiffer, View
from fullswarm.config import AgentConfig
from fullswarm.drivers.base import FleetReading
from fullswarm.errors import FullswarmError
from fullswarm.kernels import Array, Index, sum_of
from fullswarm.reasons import NONE, Code, Reason, reason

log = structlog.get_logger()

Bounds = tuple[float, float, float, float]


class DesiredMotion:
    """The desired motion of n robots.

    Attributes
    ----------
    law_error : the last failure of each robot's control law, false if it never failed
    blocked : by robot, why its control law knows no way to where it is to drive
    news : `blocked` has changed since this was last set to False
    asked : what control laws have asked of actuators since this was last emptied
    context : what control laws may know beside positions
    endings : by robot, how control laws have ended themselves since this was last emptied
    """

    def __init__(
        self, settings: AgentConfig, bounds_m: Bounds, state: AgentState, tasks: Tasks,
        neighbours: Neighbours, obstacle_map: ObstacleMap, settling: Settling, deadlocks: Deadlocks,
        safety: SafetyFilter, controller: RobotController, evasion: Evasion,
    ) -> None:  # fmt: skip
        self._config, self._bounds, self._state = settings, bounds_m, state
        self._tasks, self._neighbours, self._obstacle_map = tasks, neighbours, obstacle_map
        self._settling, self._deadlocks, self._evasion = settling, deadlocks, evasion
        self._filter, self._controller = safety, controller
        count = len(state.radius)
        self._alone = self._near = neighbours.nearby(np.zeros(count + 1, np.int64), np.zeros(1, np.int64))
        self._planar = np.full((count, 2), math.nan)
        self._requested = Requested(self._planar, tasks.filtered, tasks.gain_per_s, tasks.margin_m)
        self._standing = Standing(neighbours, evasion.objects)
        self._measured = Measured(state.pose, state.twist, np.zeros(count), state.sigma)  # kept while they are the same
        self._logged_errors: set[str] = set()
        crowd = Crowd(
            tasks.coordinated, state.radius, tasks.margin_m, controller.speed_limit, controller.turn_limit,
            held=np.zeros(count, bool), slide=np.zeros((count, 2)),
        )  # fmt: skip
        self._coordinator = Coordinator(crowd, settings.sensing_radius_m, 1.0 / settings.control_rate_hz)
        self.context = Context(
            neighbours.ids, neighbours.names, state, tasks.since_s, tasks.index, self._contacts_read, tasks.generator
        )
        self.law_error = [NONE] * count
        self.blocked: dict[int, Reason] = {}
        self.asked: list[Actuation] = []
        self.endings: dict[int, Ending] = {}
        self.news = False

    def near(self, now_s: float) -> Nearby:
        """Return which robots each one senses (``Neighbours.around``), of the last tick if asked then."""
        if self._near is self._alone and len(self._state.radius):
            self._neighbours.set_time(now_s)
            position = np.ascontiguousarray(self._state.pose[:, :2])
            return self._neighbours.around(position, self._config.sensing_radius_m)
        return self._near

    def _contacts_read(self) -> Index:
        return self.context.reading.contacts

    def gather(
        self, groups: list[Group], now_s: float, reading: FleetReading, dt_s: float = 0.0, *, at_tick: bool = True
    ) -> None:
        """Evaluate all control laws and write the desired twists, filtered where requested, into the controller.

        Parameters
        ----------
        dt_s : since the last call
        at_tick : False: for a message between two ticks, with control laws that are not called once per request
        """
        self._near = self._alone
        if self._filter.commands.any:
            self._filter.commands.update(self._state.setpoints, now_s)
        settings, tasks = self._config, self._tasks
        if self.blocked:
            for row in [row for row in self.blocked if not tasks.active[row]]:
                del self.blocked[row]
        if not groups and not tasks.any_filtered:
            return
        pose, neighbours = self._state.pose, self._neighbours
        position = np.ascontiguousarray(pose[:, :2])
        neighbours.set_time(now_s)

        self._planar.fill(math.nan)
        self._state.aim.fill(math.nan)
        self.context.now_s, self.context.dt_s = now_s, dt_s
        planar = False
        for group in groups:
            try:
                planar |= self._evaluate(group, position, now_s)
            except RequestsDiffer:
                tasks.separate(group.law)
                for part in tasks.groups() if at_tick else ():
                    if part.law == group.law and np.isin(part.rows, group.rows).all():
                        planar |= self._evaluate(part, position, now_s)
        if not planar and not tasks.any_filtered:
            return
        reach_m = settings.sensing_radius_m
        self._near = near = neighbours.around(position, reach_m) if tasks.any_filtered else self._alone
        obstacles = self._state.obstacles
        if tasks.any_filtered:
            self._settling.hold(now_s, self._planar, pose, reading.twist, self._state.sigma, near, obstacles)
            # A stick's twist is not turned: its operator sees the robot.
            self._deadlocks.resolve(
                now_s, self._planar, tasks.lasting, pose, reading.twist, self._controller.speed_limit
            )
        if planar and tasks.any_filtered:
            self._coordinator.apply(self._planar, pose, reading.twist, near)
        if tasks.any_filtered and settings.evade:
            self._evasion.apply(self._planar, tasks.lasting, pose, obstacles, self._filter.bounds_m)
        measured = self._measured
        if pose is not measured.pose or reading.twist is not measured.twist or reading.stamp_s is not measured.stamp_s:
            self._measured = measured = Measured(pose, reading.twist, reading.stamp_s, self._state.sigma)
        self._filter.apply(now_s, self._requested, measured, near, obstacles, self._controller.desired)

    def _view(self, group: Group, position: Array) -> View:
        neighbours, pose = self._neighbours, self._state.pose
        reach_m = group.hearing_m or self._config.sensing_radius_m
        find = partial(
            neighbours.within if group.shared is None else neighbours.within_by_name, position, reach_m,
            self._tasks.team, self._tasks.peers,
        )  # fmt: skip
        view = View(
            position, pose[:, 2], self._state.radius, find,
            neighbours.predicted, neighbours.states, self._bounds, self._obstacle_map.known,
            self._controller.speed_limit, neighbours.aims, self._tasks.margin_m, self._standing.around,
            self.context, None, group.shared,
        )  # fmt: skip
        return view if len(group.rows) == len(position) else view.select(group.rows)

    def _evaluate(self, group: Group, position: Array, now_s: float) -> bool:
        """Call one control law; if it raises or returns what is not finite, its robots are stopped with that reason.

        Returns
        -------
        bool
            It returned planar velocities, which have yet to be mapped to twists.

        Raises
        ------
        RequestsDiffer
            It must be called once per request.
        """
        view = self._view(group, position)
        try:
            desired = group.call(view, group.params)
            if not math.isfinite(sum_of(desired)):
                raise ValueError("the law's answer is not finite")
        except RequestsDiffer:
            raise
        except Exception as error:  # a control law is outside code: whatever it raises, the robot must stop
            self._law_failed(group, error)
            return False
        controller = self._controller
        rows = slice(None) if len(group.rows) == len(self.law_error) else group.rows
        (self._planar if group.planar else controller.desired)[rows] = desired
        controller.valid_until_s[rows] = now_s + self._config.command_ttl_s
        controller.law_failed[rows] = False
        if view.actuations:
            self.asked += [each._replace(row=int(group.rows[each.row])) for each in view.actuations]
        if view.endings:
            self.endings |= {int(group.rows[each.row]): each for each in view.endings}
        if view.aim is not None:
            self._state.aim[rows] = view.aim
        if view.blocked or self.blocked:
            self._note_blocked(group, view.blocked)
        return group.planar

    def _note_blocked(self, group: Group, found: Mapping[int, Reason]) -> None:
        """Keep and log which robots of a group know no way, and which know one again."""
        for place, row in enumerate(group.rows.tolist()):
            why, before = found.get(place, NONE), self.blocked.get(row, NONE)
            if why == before:
                continue
            self.news, robot = True, self._neighbours.ids[row]
            if why:
                self.blocked[row] = why
                log.warning("a robot stands: it knows no way to its goal", robot=robot, reason=why.text)
            else:
                del self.blocked[row]
                log.info("a robot knows a way to its goal again", robot=robot)

    def _law_failed(self, group: Group, error: Exception) -> None:
        why = reason(Code.LAW, law=group.law, error=f"{type(error).__name__}: {error}{_place(group.law, error)}")
        self._controller.law_failed[group.rows] = True
        for row in group.rows:
            self.law_error[row] = why
        if why.text not in self._logged_errors:
            self._logged_errors.add(why.text)
            log.error("a control law failed; its robots are stopped", law=group.law, error=str(error), exc_info=error)


def _place(law: str, error: Exception) -> str:
    """Return the line of the law's own file that an error came by, in brackets; empty where none did."""
    file = getattr(registry.law_module(law), "__file__", None)
    if file is None or isinstance(error, FullswarmError):
        return ""
    # By hand, because it may be in each control period: `traceback` reads the source as well.
    line = 0
    entry = error.__traceback__
    while entry is not None:
        if entry.tb_frame.f_code.co_filename == file:
            line = entry.tb_lineno
        entry = entry.tb_next
    return f" ({Path(file).name}:{line})" if line else ""
