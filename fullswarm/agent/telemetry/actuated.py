"""Publishes what was asked of the robots' actuators, once per second, for operators."""

from __future__ import annotations

from collections.abc import Container, Iterable

from fullswarm.agent.motion.actuation import Actuation
from fullswarm.bus.base import Bus
from fullswarm.drivers.base import Fleet
from fullswarm.kernels import Flags
from fullswarm.keys import Keys
from fullswarm.messages import ActuatorReport, RobotActuators
from fullswarm.runtime import Scheduler

LONGEST = 64
"""Characters of a value."""


class ActuatorReporter:
    """Publishes the newest value of each actuator that a driver has taken; nothing until there is one."""

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, host: str, fleet: Fleet) -> None:
        self._bus, self._keys, self._scheduler, self._host, self._fleet = bus, keys, scheduler, host, fleet
        self._values: dict[int, dict[str, object]] = {}

    def note(self, asked: Iterable[Actuation], drive_on: Flags, refused: Container[tuple[int, str]]) -> None:
        """Note what was passed on to the robots in `drive_on` (n,) and not refused."""
        for row, name, value in asked:
            if drive_on[row] and (row, name) not in refused:
                self._values.setdefault(row, {})[name] = value

    def publish(self) -> None:
        """Publish the values as they are now."""
        if not self._values:
            return
        robots = tuple(RobotActuators(robot=self._fleet.ids[row], values=self._shown(row)) for row in self._values)
        message = ActuatorReport(host=self._host, robots=robots, stamp_s=self._scheduler.now_s())
        self._bus.publish(self._keys.actuators(self._host), message)

    def _shown(self, row: int) -> dict[str, str]:
        values, declared = self._values[row], self._fleet.descriptions[row].actuators
        return {each.name: each.shown(values[each.name])[:LONGEST] for each in declared if each.name in values}
