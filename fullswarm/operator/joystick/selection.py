"""Selects the robots to drive: one robot, a group, a make, or the whole swarm, by stepping through them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import HealthReport, Heartbeat, ParamEntry, ParamReply
from fullswarm.operator.params import ParamClient
from fullswarm.runtime import Scheduler

WHOLE_SWARM = "whole swarm"
CORE_SILENT_S = 1.0
GROUP = "group/"


@dataclass(frozen=True, slots=True)
class Selection:
    """The robots that are driven.

    Attributes
    ----------
    robots
        By name, also of the whole swarm as far as it has been received: for leases.
        None: no robot can be driven.
    addressed
        As in a request: none means all, so that a robot that joins later is included.
    """

    label: str
    robots: tuple[str, ...]
    addressed: tuple[str, ...]


class Roster:
    """The robots and groups that are present, and whether the core is.

    Parameters
    ----------
    only
        Robots and "@group" to choose among; none: all.
    on_change
        Called when a robot or a group has appeared or changed.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        params: ParamClient,
        only: Iterable[str] = (),
        on_change: Callable[[], None] | None = None,
    ) -> None:
        self._scheduler, self._params, self._only, self._on_change = scheduler, params, frozenset(only), on_change
        self._makes: dict[str, str] = {}
        self._groups: dict[str, tuple[str, ...]] = {}
        self._core, self._core_s = "", -CORE_SILENT_S
        self._subscriptions = [
            bus.subscribe(keys.health(), HealthReport, self._on_health),
            bus.subscribe(keys.heartbeat("core"), Heartbeat, self._on_beat, latest=True),
            params.watch(f"{GROUP}*", self._on_group),
        ]

    @property
    def core_alive(self) -> bool:
        """Whether the core has been received lately."""
        return self._scheduler.now_s() - self._core_s <= CORE_SILENT_S

    def robots(self) -> tuple[str, ...]:
        """Return the robots that may be chosen, r2 before r10."""
        return tuple(sorted(filter(self._may, self._makes), key=lambda name: (len(name), name)))

    def all_robots(self) -> tuple[str, ...]:
        """Return all robots that have been received: those that must confirm an e-stop."""
        return tuple(sorted(self._makes))

    def _may(self, robot: str) -> bool:
        if not self._only or robot in self._only:
            return True
        return any(robot in members for name, members in self._groups.items() if f"@{name}" in self._only)

    @property
    def all_label(self) -> str:
        """Return the name for all that may be chosen."""
        return "all given" if self._only else WHOLE_SWARM

    def groups(self) -> tuple[Selection, ...]:
        """Return the whole swarm, each group, and each make if there are several."""
        robots = self.robots()
        found = [Selection(self.all_label, robots, robots if self._only else ())]
        for name, members in sorted(self._groups.items()):
            there = tuple(filter(self._may, members))
            if there:
                found.append(Selection(f"group {name}", there, there))
        makes = sorted({*self._makes.values()})
        for make in makes if len(makes) > 1 else ():
            those = tuple(robot for robot in robots if self._makes[robot] == make)
            found.append(Selection(f"all {make}", those, those))
        return tuple(found)

    def close(self) -> None:
        """Unsubscribe."""
        for subscription in self._subscriptions:
            subscription.close()

    def _on_health(self, report: HealthReport) -> None:
        before = dict(self._makes)
        for health in report.robots:
            self._makes[health.robot] = health.make or "unknown make"
        if self._makes != before:
            self._changed()

    def _on_beat(self, beat: Heartbeat) -> None:
        self._core_s = self._scheduler.now_s()
        if beat.process != self._core:
            self._core = beat.process
            self._params.ask("get", f"{GROUP}*", self._on_reply)

    def _on_reply(self, reply: ParamReply) -> None:
        for entry in reply.entries:
            self._on_group(entry)

    def _on_group(self, entry: ParamEntry) -> None:
        name, value = entry.key.removeprefix(GROUP), entry.value
        members = value.get("robots") if isinstance(value, dict) else None
        before = dict(self._groups)
        if isinstance(members, list | tuple) and members:
            self._groups[name] = tuple(str(each) for each in members)
        else:
            self._groups.pop(name, None)
        if self._groups != before:
            self._changed()

    def _changed(self) -> None:
        if self._on_change is not None:
            self._on_change()


class Chooser:
    """Steps through robots and groups; starts with the whole swarm. The choice is kept by name."""

    def __init__(self, roster: Roster) -> None:
        self._roster = roster
        self._robot, self._group = "", roster.all_label

    def now(self) -> Selection:
        """Return the selection."""
        if self._robot:
            return Selection(self._robot, (self._robot,), (self._robot,))
        gone = Selection(f"{self._group} (gone)", (), ())  # an empty selection must not become the whole swarm
        return next((each for each in self._roster.groups() if each.label == self._group), gone)

    def step_robot(self, step: int) -> None:
        """Choose the next robot, or with -1 the one before."""
        robots = self._roster.robots()
        if robots:
            at = robots.index(self._robot) + step if self._robot in robots else (0 if step > 0 else -1)
            self._robot = robots[at % len(robots)]

    def step_group(self, step: int) -> None:
        """Choose the next group, or with -1 the one before; from a robot the group that was chosen last."""
        labels = [each.label for each in self._roster.groups()]
        if not self._robot and self._group in labels:
            self._group = labels[(labels.index(self._group) + step) % len(labels)]
        elif self._group not in labels:
            self._group = self._roster.all_label
        self._robot = ""
