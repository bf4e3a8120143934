"""Judges a live rehearsal by its requests, the reports of the robots and the motion of their bodies.

It shares no code with the core. Times are seconds of this machine's monotonic clock. Pure: events in, a verdict out.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from dataclasses import dataclass, field

from fullswarm.rehearse.live.plan import DISK_FULL

AGENT_DEAD_S = 1.5
"""A body may move this long after its agent's end: the world's own watchdog takes 0.3 s, then it brakes."""
LINK_DEAD_S = 2.5
"""The same after the hub or the core fell silent: the robots detect that after 1 s."""
STOPPED_S = 1.5
"""And after it confirmed a stop."""
RACE_S = 0.5
"""Two events within this time count in either order: a robot may receive a new core's message before the judge."""
LOST_S = 10.0
"""A request that was accepted is executed within this time, not counting faults of the processes between."""
RECOVER_S = 5.0
"""A fault counts this much longer than it lasted."""
IDLE = ("", "stop")


@dataclass(frozen=True, slots=True)
class Ask:
    """A request of an operator; an empty behaviour: stop or e-stop."""

    t: float
    operator: str
    id: str
    behaviour: str
    robots: tuple[str, ...]

    @property
    def idle(self) -> bool:
        """Nothing is to be enabled."""
        return self.behaviour in IDLE


@dataclass(frozen=True, slots=True)
class Ran:
    """A robot acknowledged that it enabled a request."""

    t: float
    robot: str
    id: str
    agent: str  # process
    core: str
    sequence: int
    centralised: bool = False


@dataclass(frozen=True, slots=True)
class Published:
    """A status of a request, as the core published it."""

    t: float
    id: str
    phase: str
    robots: tuple[str, ...] = ()
    running: tuple[str, ...] = ()
    refused_by: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Down:
    """A process did not work, or could not be reached: a robot's agent, "core", "hub".

    With a full disk the core answers late, but robots may drive.
    """

    name: str
    from_s: float
    to_s: float = math.inf


@dataclass(frozen=True, slots=True)
class Doing:
    """What a robot does at the end."""

    behaviour: str
    request_id: str
    fresh: bool = True
    estop: bool = False
    note: str = ""


@dataclass(slots=True)
class Verdict:
    """What was wrong; each entry names it."""

    uncommanded: list[str] = field(default_factory=list)
    doubled: list[str] = field(default_factory=list)
    older: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    @property
    def clean(self) -> bool:
        """Nothing was."""
        return not (self.uncommanded or self.doubled or self.older or self.lost or self.wrong)


@dataclass(slots=True)
class Record:
    """All observations. `moved` are moments at which a body moved, sampled at 10 Hz.

    `stood` are spans in which the process of the world and of these observations did not run: the machine had suspended
    it. No body moves in them, and what its watchdog and brakes take goes on after them.
    """

    asks: dict[str, Ask] = field(default_factory=dict)
    ran: list[Ran] = field(default_factory=list)
    published: list[Published] = field(default_factory=list)
    seen: set[tuple[str, str]] = field(default_factory=set)  # (robot, request) that a report named
    moved: list[tuple[float, str]] = field(default_factory=list)
    standing: list[tuple[float, str, str]] = field(default_factory=list)  # (when, robot, stop) confirmed
    stood: list[tuple[float, float]] = field(default_factory=list)  # (from, to), in order, apart
    downs: list[Down] = field(default_factory=list)
    killed: dict[str, float] = field(default_factory=dict)  # operator's request that died with its process → when
    late: dict[str, float] = field(default_factory=dict)  # request that was delayed on purpose → when it was sent
    called_off: set[str] = field(default_factory=set)  # by the operator, before the core had them
    doing: dict[str, Doing] = field(default_factory=dict)
    end_s: float = 0.0

    def accepted(self) -> dict[str, tuple[float, tuple[str, ...]]]:
        """Return when the core first published an accepted request, and for which robots."""
        refused = {(each.id, robot) for each in self.published for robot in each.refused_by}
        first: dict[str, tuple[float, tuple[str, ...]]] = {}
        for status in self.published:
            if status.phase not in ("refused", "superseded", "ended") and status.id not in first:
                first[status.id] = (
                    status.t,
                    tuple(robot for robot in status.robots if (status.id, robot) not in refused),
                )
        return first

    def judge(self) -> Verdict:
        """Return what was wrong."""
        accepted = self.accepted()
        of_robot: dict[str, list[tuple[float, Ask]]] = defaultdict(list)
        for request_id, (t, robots) in accepted.items():
            ask = self.asks.get(request_id)
            for robot in robots if ask else ():
                of_robot[robot].append((t, ask))  # type: ignore[arg-type]  # seen one line above
        for each in of_robot.values():
            each.sort(key=lambda pair: pair[0])
        verdict = Verdict(doubled=self._doubled(), older=self._older(), uncommanded=self._uncommanded())
        verdict.lost = [*self._lost(of_robot), *self._unanswered()]
        verdict.wrong = self._wrong(of_robot)
        return verdict

    def _doubled(self) -> list[str]:
        numbers: dict[tuple[str, str, str, str], set[tuple[str, int]]] = defaultdict(set)
        for ran in self.ran:
            # A new core enables a centralised request again, because its commands have its own numbers.
            core = ran.core if ran.centralised else ""
            numbers[ran.robot, ran.id, ran.agent, core].add((ran.core, ran.sequence))
        return [f"{key[0]} executed {key[1]} {len(each)} times" for key, each in numbers.items() if len(each) > 1]

    def _older(self) -> list[str]:
        newest: dict[tuple[str, str], Ask] = {}
        found = []
        for ran in sorted(self.ran, key=lambda each: each.t):
            ask = self.asks.get(ran.id)
            if ask is None:
                continue
            before = newest.get((ran.robot, ask.operator))
            if before is not None and ask.t < before.t:
                found.append(f"{ran.robot} executed {ask.id} of {ask.operator} at {ran.t:.2f}, "
                             f"asked {before.t - ask.t:.2f} s before {before.id}")  # fmt: skip
            else:
                newest[ran.robot, ask.operator] = ask
        return found

    def _uncommanded(self) -> list[str]:
        asked: dict[str, list[float]] = defaultdict(list)
        for ask in sorted(self.asks.values(), key=lambda each: each.t):
            for robot in () if ask.idle else ask.robots:
                asked[robot].append(self._counts_from_s(ask, robot))
        for times in asked.values():
            times.sort()
        stands: dict[str, list[tuple[float, float, str]]] = defaultdict(list)
        for confirmed_s, robot, stop_id in sorted(self.standing):
            stop = self.asks.get(stop_id)
            if stop is not None and (not stands[robot] or stop.t > stands[robot][-1][1]):
                stands[robot].append((self._later_s(confirmed_s, STOPPED_S), stop.t, stop_id))
        incidents: dict[tuple[str, str], list[float]] = defaultdict(list)
        for t, robot in self.moved:
            why = self._dead(t, robot) or _unrequested(t, asked[robot], stands[robot])
            if why:
                incidents[robot, why].append(t)
        return [f"{robot} moved at {times[0]:.2f} ({len(times)} samples) although {why}"
                for (robot, why), times in incidents.items()]  # fmt: skip

    def _counts_from_s(self, ask: Ask, robot: str) -> float:
        """Return since when a request may move a robot: since its arrival, unless the robot was stopped before it."""
        arrived_s = self.late.get(ask.id, ask.t)
        stops = (each for each in self.asks.values() if each.idle)
        beaten = any(ask.t < each.t < arrived_s and robot in each.robots for each in stops)
        return ask.t if beaten else arrived_s

    def _dead(self, t: float, robot: str) -> str:
        links = ("hub", "core", f"link of {robot}")
        for down in self.downs:
            patience_s = LINK_DEAD_S if down.name in links else AGENT_DEAD_S
            concerns = down.name in (*links, robot, f"e-stop of {robot}")
            if concerns and self._later_s(down.from_s, patience_s) < t < down.to_s - RACE_S:
                return f"{down.name} was down since {down.from_s:.2f}"
        return ""

    def _later_s(self, from_s: float, patience_s: float) -> float:
        """Return when the world has run for `patience_s` since `from_s`."""
        end_s = from_s + patience_s
        for begin_s, until_s in self.stood:
            if until_s > from_s and begin_s < end_s:
                end_s += until_s - max(begin_s, from_s)
        return end_s

    def _trouble_s(self, robot: str, from_s: float, to_s: float) -> float:
        """Return how long, between two moments, a process between operator and `robot` was down or recovering."""
        names = (robot, "hub", "core", DISK_FULL, f"link of {robot}", f"e-stop of {robot}")
        spans = sorted((max(each.from_s, from_s), min(each.to_s + RECOVER_S, to_s)) for each in self.downs
                       if each.name in names and each.from_s < to_s and each.to_s + RECOVER_S > from_s)  # fmt: skip
        total_s, end_s = 0.0, from_s
        for begin_s, until_s in spans:
            total_s += max(0.0, until_s - max(begin_s, end_s))
            end_s = max(end_s, until_s)
        return total_s

    def _lost(self, of_robot: dict[str, list[tuple[float, Ask]]]) -> list[str]:
        executed = {(each.robot, each.id) for each in self.ran} | self.seen
        found = []
        for robot, asks in of_robot.items():
            for number, (accepted_s, ask) in enumerate(asks):
                if ask.idle or (robot, ask.id) in executed:
                    continue
                next_s = asks[number + 1][0] if number + 1 < len(asks) else self.end_s
                if next_s - accepted_s - self._trouble_s(robot, accepted_s, next_s) > LOST_S:
                    found.append(f"{robot} never executed {ask.behaviour} {ask.id}, accepted at {accepted_s:.2f}")
        return found

    def _unanswered(self) -> list[str]:
        answered = {each.id for each in self.published} | set(self.killed) | set(self.late) | self.called_off
        return [f"no status for {ask.behaviour} {ask.id}, requested at {ask.t:.2f}" for ask in self.asks.values()
                if ask.behaviour and ask.id not in answered
                and self.end_s - ask.t - self._trouble_s("", ask.t, self.end_s) > LOST_S]  # fmt: skip

    def _wrong(self, of_robot: dict[str, list[tuple[float, Ask]]]) -> list[str]:
        found = []
        for robot, doing in self.doing.items():
            last = of_robot[robot][-1][1] if of_robot.get(robot) else None
            wanted = "" if last is None or last.idle else last.id
            does = doing.request_id if doing.behaviour else ""
            if not doing.fresh:
                found.append(f"{robot} is silent")
            elif doing.estop:
                found.append(f"{robot} is still in e-stop")
            elif does != wanted:
                asked = f"{last.behaviour or 'stop'} {last.id}" if last else "nothing"
                does = f"{doing.behaviour} {doing.request_id}" if doing.behaviour else f"nothing ({doing.note})"
                found.append(f"{robot} runs {does}, its last request is {asked}")
        return found


def _unrequested(t: float, asked: list[float], stands: list[tuple[float, float, str]]) -> str:
    """Return why a robot may not move at `t`; empty: it has a request since the last stop in force."""
    number = bisect_left(stands, (t,)) - 1
    since_s, stop = (stands[number][1], stands[number][2]) if number >= 0 else (-math.inf, "")
    newest = bisect_right(asked, t) - 1
    if newest >= 0 and asked[newest] >= since_s - RACE_S:
        return ""
    return f"no request since {stop}" if stop else "no request before"
