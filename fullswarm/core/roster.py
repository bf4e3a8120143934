"""Which robots are present: a robot is present while its agent's health reports arrive. Out: KnownRobots."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from fullswarm.bus import Bus
from fullswarm.bus.report_query import ReportsOnQuery
from fullswarm.keys import ROBOT_ID, Keys
from fullswarm.messages import HealthReport, KnownRobots, ReportQuery, RobotHealth, RobotProfile, RobotProfiles
from fullswarm.recent import Names, Recent
from fullswarm.runtime import Scheduler

SILENCE_S = 1.5
CHECK_S = 0.1
STRANGERS = 1000
"""Robots that are not of the fleet file, at most; see :class:`~fullswarm.recent.Names`."""
REPORT_S = 1.0
"""From one report of all robots to the next, while they stay the same."""
ASK_S = 1.0
"""Between two queries for profiles that have not been received."""
PAST = 16
"""Processes of a robot's agent that are remembered after their end: their last reports may still arrive."""
PAST_S = 1.0
"""Their reports are ignored while a later process reports. If that one falls silent, its reports were the late ones."""


@dataclass(slots=True)
class Member:
    """A robot of the swarm."""

    robot: str
    received_s: float = -math.inf
    present: bool = False
    process: str = ""  # of its agent; another one means that the agent was started again
    health: RobotHealth | None = None
    stamp_s: float = -math.inf  # of that report, on the agent's clock
    past: deque[str] = field(default_factory=lambda: deque(maxlen=PAST))

    def overtaken(self, report: HealthReport, now_s: float) -> bool:
        """Tell whether a newer report was received before this one."""
        if report.process == self.process:
            return report.stamp_s < self.stamp_s
        return report.process in self.past and now_s - self.received_s < PAST_S


class Roster:
    """The configured robots, and those that report without being of the fleet file, until they are forgotten.

    Parameters
    ----------
    configured
        Ids of the fleet file, in its order.
    silence_s
        Returns how long a robot may be silent before it counts as absent.
    process
        Name of this start of the core, unique.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        configured: Sequence[str] = (),
        silence_s: Callable[[], float] = lambda: SILENCE_S,
        process: str = "",
    ) -> None:
        self._scheduler, self._process = scheduler, process
        self._silence_s = silence_s
        self._members = {robot: Member(robot) for robot in configured}
        self._on_report: list[Callable[[Member, bool], None]] = []
        self._on_absence: list[Callable[[str], None]] = []
        self._on_forgotten: list[Callable[[str], object]] = []
        self._names = Names(STRANGERS, self._forget, configured)
        self._bus, self._keys, self._asked_s = bus, keys, -math.inf
        self._profiles: dict[str, RobotProfile] = {}
        self._early: Recent[str, RobotProfile] = Recent(STRANGERS)  # of robots that have not reported yet
        self._sequence, self._reported_s = 0, -math.inf
        self._reported: tuple[tuple[str, ...], tuple[str, ...]] = (), ()  # present, absent
        self._subscriptions = [
            bus.subscribe(keys.health(), HealthReport, self._report),
            bus.subscribe(keys.profile(), RobotProfiles, self._describe, latest=True),
        ]
        self._timer = scheduler.every(CHECK_S, self._check)
        self._queries = ReportsOnQuery(bus, keys, scheduler, self.report)

    def watch(self, on_report: Callable[[Member, bool], None], on_absence: Callable[[str], None]) -> None:
        """Have `on_report(member, restarted)` called for each report, `on_absence(robot)` when one falls silent."""
        self._on_report.append(on_report)
        self._on_absence.append(on_absence)

    def watch_forgotten(self, callback: Callable[[str], object]) -> None:
        """Have `callback(robot)` called when a robot is no longer known; it is not of the fleet file."""
        self._on_forgotten.append(callback)

    def known(self) -> tuple[str, ...]:
        """Return all robots: those of the fleet file in its order, then the others by their first report."""
        return tuple(self._members)

    def present(self) -> tuple[str, ...]:
        """Return the robots that are present now, in the order of :meth:`known`."""
        return tuple(robot for robot, member in self._members.items() if member.present)

    def is_present(self, robot: str) -> bool:
        """Tell whether `robot` is present now."""
        member = self._members.get(robot)
        return member is not None and member.present

    def health(self, robot: str) -> RobotHealth | None:
        """Return the newest health of `robot`; None before the first report."""
        member = self._members.get(robot)
        return member.health if member else None

    def profile(self, robot: str) -> RobotProfile | None:
        """Return what `robot` is and can do, as it last said; None: it never has."""
        return self._profiles.get(robot)

    def _ask(self) -> None:
        """Ask for the profiles of robots that are present; their agents send them seldom otherwise."""
        now_s = self._scheduler.now_s()
        if now_s - self._asked_s < ASK_S or all(each in self._profiles for each in self.present()):
            return
        self._asked_s = now_s
        self._bus.publish(self._keys.report_query, ReportQuery(source="core"))

    def _describe(self, message: RobotProfiles) -> None:
        for profile in message.robots:
            if profile.robot in self._members:
                self._profiles[profile.robot] = profile
            elif ROBOT_ID.match(profile.robot):  # it may come before the robot's first report
                self._early[profile.robot] = profile

    def process(self, robot: str) -> str:
        """Return the process of `robot`'s agent; empty before the first report."""
        member = self._members.get(robot)
        return member.process if member else ""

    def close(self) -> None:
        """End the subscriptions."""
        self._queries.close()
        for subscription in self._subscriptions:
            subscription.close()
        self._timer.cancel()

    def _report(self, report: HealthReport) -> None:
        now_s = self._scheduler.now_s()
        for health in report.robots:
            member = self._members.get(health.robot)
            if member is None:
                if not ROBOT_ID.match(health.robot):
                    continue  # it would not fit into a key
                if not self._names.admit(health.robot, now_s):
                    continue
                member = self._members[health.robot] = Member(health.robot)
                if (profile := self._early.pop(health.robot, None)) is not None:
                    self._profiles[health.robot] = profile
            else:
                self._names.admit(health.robot, now_s)
            if member.overtaken(report, now_s):
                continue
            restarted = member.process != report.process
            if restarted and member.process:
                member.past.append(member.process)
            member.received_s, member.present = now_s, True
            member.process, member.health, member.stamp_s = report.process, health, report.stamp_s
            for callback in self._on_report:
                callback(member, restarted)

    def _forget(self, robot: str) -> None:
        member = self._members.pop(robot)
        self._profiles.pop(robot, None)
        for callback in (*(self._on_absence if member.present else ()), *self._on_forgotten):
            callback(robot)

    def _check(self) -> None:
        self._ask()
        self._names.sweep(self._scheduler.now_s())
        oldest_s = self._scheduler.now_s() - self._silence_s()
        for member in tuple(self._members.values()):
            if member.present and member.received_s < oldest_s:
                member.present = False
                for callback in self._on_absence:
                    callback(member.robot)
        if self._lists() != self._reported or self._scheduler.now_s() - self._reported_s >= REPORT_S:
            self.report()

    def _lists(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the robots that are present, and those that are not."""
        present = self.present()
        return present, tuple(robot for robot, member in self._members.items() if not member.present)

    def report(self) -> None:
        """Publish which robots there are."""
        self._sequence += 1
        self._reported_s, self._reported = self._scheduler.now_s(), self._lists()
        present, absent = self._reported
        message = KnownRobots(present=present, absent=absent, core=self._process, sequence=self._sequence)
        self._bus.publish(self._keys.known_robots, message)
