"""What the steps of missions wait for: where robots are, whether they have settled, the newest metrics.

It subscribes to states and summaries only while some step needs them: they are most of a swarm's traffic.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from fullswarm.bus import Bus
from fullswarm.bus.base import Subscription
from fullswarm.core.behaviours import Library
from fullswarm.core.mission_state import Facts, Running, comparison
from fullswarm.core.roster import Roster
from fullswarm.errors import RequestRefused
from fullswarm.keys import Keys
from fullswarm.messages import RobotStates, Summary
from fullswarm.parameters import Goals, goals_of
from fullswarm.reasons import Code
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler

ARRIVED_M = 0.1
"""Default distance from the goal, if the behaviour's own radius is not larger: below it poses are not certain."""
MOST_METRICS = 256
FRESH_S = 1.0
"""An older position does not count."""


class MissionFacts:
    """The newest positions and metrics, while they are needed."""

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, library: Library, roster: Roster) -> None:
        self._bus, self._keys, self._scheduler = bus, keys, scheduler
        self._library, self._roster = library, roster
        self._places: dict[str, tuple[float, float, float]] = {}  # of robots that the roster knows
        self._summaries: Recent[str, tuple[float, Summary]] = Recent(MOST_METRICS)
        roster.watch_forgotten(lambda robot: self._places.pop(robot, None))
        self._states_subscription: Subscription | None = None
        self._summary_subscription: Subscription | None = None
        self._goals: dict[str, tuple[dict[str, Goals], float]] = {}  # by request

    def close(self) -> None:
        """End the subscriptions."""
        self.need(())

    def need(self, running: Iterable[Running]) -> None:
        """Subscribe to what these steps wait for, and to nothing else."""
        running = tuple(running)
        if any(each.step.done.arrived for each in running):
            if self._states_subscription is None:
                self._states_subscription = self._bus.subscribe(
                    self._keys.state(), RobotStates, self._on_states, latest=True
                )
        elif self._states_subscription is not None:
            self._states_subscription.close()
            self._states_subscription = None
            self._places.clear()
            self._goals.clear()
        if any(each.step.done.metric for each in running):
            if self._summary_subscription is None:
                self._summary_subscription = self._bus.subscribe(
                    self._keys.summary(), Summary, self._on_summary, latest=True
                )
        elif self._summary_subscription is not None:
            self._summary_subscription.close()
            self._summary_subscription = None
            self._summaries.clear()

    def of(self, each: Running, request_id: str) -> Facts:
        """Return what is known of a running step with that request."""
        arrived = tuple(robot for robot in each.state.robots if self._arrived(each, robot, request_id))
        wanted, value = comparison(each.step), None
        if wanted is not None and wanted.metric in self._summaries:
            received_s, summary = self._summaries[wanted.metric]
            if self._scheduler.now_s() - received_s <= each.state.elapsed_s:
                value = summary.values.get(wanted.quantity)
        return Facts(arrived, value)

    def _arrived(self, each: Running, robot: str, request_id: str) -> bool:
        if not each.step.done.arrived or not self._roster.is_present(robot):
            return False
        if robot in each.state.arrived:
            return True
        health = self._roster.health(robot)
        if health is not None and health.request_id == request_id and health.stop_code == Code.SETTLED:
            return True  # as near to its goal as there is room
        place = self._places.get(robot)
        if place is None or self._scheduler.now_s() - place[2] > FRESH_S:
            return False
        goals, radius_m = self._goals_of(each, request_id)
        within_m = each.step.done.within_m or max(radius_m, ARRIVED_M)
        return any(math.dist(place[:2], goal) <= within_m for goal in goals.get(robot, ()))

    def _goals_of(self, each: Running, request_id: str) -> tuple[dict[str, Goals], float]:
        found = self._goals.get(request_id)
        if found is None:
            try:
                record = self._library.get(each.step.behaviour)
                parameters = self._library.resolve(record, each.step.parameters, each.state.robots)
            except RequestRefused:  # its record was changed since
                parameters = {}
            found = self._goals[request_id] = (
                {robot: goals_of(given) for robot, given in parameters.items()},
                max((_number(given.get("arrive_radius_m")) for given in parameters.values()), default=0.0),
            )
        return found

    def _on_states(self, states: RobotStates) -> None:
        if states.own_frame:
            return  # a place in another frame than the goals
        now_s = self._scheduler.now_s()
        for robot, x_m, y_m in zip(states.robots, states.x_m, states.y_m, strict=True):
            if self._roster.is_present(robot):
                self._places[robot] = (x_m, y_m, now_s)

    def _on_summary(self, summary: Summary) -> None:
        self._summaries[summary.metric] = (self._scheduler.now_s(), summary)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else 0.0
