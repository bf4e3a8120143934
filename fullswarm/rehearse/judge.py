"""Judges a rehearsal: which motions had no valid reason, and what else must not be, whatever goes wrong.

It shares no code with what it checks. It sees what operators do, each message as it is handled and published, which
set-points reach the robots, and how the bodies really move. All times are true (simulated) seconds.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from fullswarm.messages import (
    Command,
    ControlAck,
    ControlRequest,
    EStop,
    HealthReport,
    Heartbeat,
    Leases,
    Message,
    RequestStatus,
    StopRequest,
)

TICK_S = 0.02
BOUNDS_S = {
    "stop": TICK_S,
    "core": 1.0 + TICK_S,
    "hub": 0.03 + TICK_S,
    "command": 0.3 + TICK_S,
    "stick": 0.3 + TICK_S,
    "reading": 0.3 + TICK_S,
    "agent": 0.3 + TICK_S,
    "standing": 0.3 + TICK_S + 0.25 + 0.04,
}
"""Set-points are zero so long after: a stop or e-stop was handled; the core's last heartbeat; the end of the hub; the
last command of a centralised behaviour; the last frame of a stick; the driver's last true reading. "agent": after the
last set-point of an agent that died or froze the body's own watchdog makes it zero; "standing": and from 0.5 m/s with
2 m/s² the body stands 0.25 s later (two steps of the simulated world are added)."""
MOVES = 1e-3
"""m/s and rad/s, above which a set-point moves a robot."""
ROLLS = 0.01
"""m/s, above which a body moves."""
EXCUSED_S = 1.5
"""A contact is no violation so long after the agent of one of the two was dead, frozen or deceived by its driver."""
PUSHED_S = 0.25 + TICK_S
"""Nor so long after such a robot has pushed one of the two, itself or through others that touch each other."""
TOGETHER_S = 1.0
"""Two requests of different operators within this time may be carried out in either order."""
CENTRALISED = ("voronoi_centralised_bc", "formation_assigned_bc")
KINDS = (
    "motion", "stop", "e-stop", "silence", "standing", "contact", "twice", "unanswered", "lease", "last", "error",
)  # fmt: skip
"""What a violation may be about."""


@dataclass(frozen=True, slots=True)
class Ask:
    """A request, stop or e-stop of an operator, or a mission that it has started or resumed."""

    at_s: float
    operator: str
    kind: str
    id: str
    robots: tuple[str, ...]
    behaviour: str = ""
    take: bool = False


@dataclass(frozen=True, slots=True)
class Violation:
    """One broken invariant."""

    at_s: float
    kind: str
    robot: str
    text: str


@dataclass(slots=True)
class _Robot:
    """What the judge knows of one robot."""

    name: str
    running: str = ""  # request that its agent has accepted
    offered: str = ""  # request that its agent has handled last, and when
    offered_s: float = -math.inf
    floor_s: float = -math.inf  # when the newest stop that it has handled was issued
    floor_id: str = ""
    handled_s: float = -math.inf  # and when it handled that
    latch_s: float = math.inf  # when the e-stop that holds it was issued; inf: none does
    latch_id: str = ""
    seen: set[tuple[str, bool]] = field(default_factory=set)  # orders that the present agent has handled
    beat_s: float = -math.inf
    command_s: float = -math.inf
    stick_s: float = -math.inf
    commanded_s: float = -math.inf  # last set-point that moves it
    deceived_s: float = math.inf  # its driver has given no true reading since; inf: it does
    excused_s: float = -math.inf  # the last moment at which its agent was not itself
    pushed_s: float = -math.inf  # and at which a robot with such an agent may have pushed it
    enabled: dict[str, set[tuple[str, int]]] = field(default_factory=lambda: defaultdict(set))
    newest: dict[str, int] = field(default_factory=dict)  # highest number that it has accepted from each core
    health: tuple[str, str, bool] = ("", "", False)  # behaviour, request, e-stop as last reported
    health_s: float = -math.inf
    full_s: float = -math.inf  # its disk was full
    faulty_s: float = -math.inf  # its driver was at fault, or its agent unfit, lately


class Judge:
    """Takes everything that happens and names what must not.

    Parameters
    ----------
    now_s : the simulated time
    connected : tells whether the hub has been up for a robot, or down for less than the bound

    Attributes
    ----------
    violations : all, in the order of their times; one of each kind, robot and cause
    excused : contacts of robots whose agents were dead, frozen or deceived
    """

    def __init__(self, robots: Sequence[str], now_s: Callable[[], float], hub_gone_s: Callable[[str], float]) -> None:
        self._now_s, self._hub_gone_s = now_s, hub_gone_s
        self._robots = {name: _Robot(name) for name in robots}
        self.asks: dict[str, Ask] = {}
        self._issued: dict[tuple[str, bool], float] = {}  # e-stop orders of operators and cores
        self.violations: list[Violation] = []
        self._told: set[tuple[str, str, str]] = set()
        self._accepted: dict[str, tuple[float, RequestStatus]] = {}
        self._status: dict[str, RequestStatus] = {}
        self._leases: dict[str, tuple[str, float]] = {}
        self._touching: set[tuple[int, int]] = set()
        self._reached: dict[str, set[str]] = defaultdict(set)  # stop → processes that have handled it
        self.core_lost_s = -math.inf  # newest moment before which the core may have forgotten something
        self.excused = 0
        self.commands = self.steps = 0

    # ---------------------------------------------------------------- what happens
    def asked(self, ask: Ask) -> None:
        """Note what an operator does."""
        before = self.asks.get(ask.id)
        if before is not None:  # a mission is resumed
            ask = Ask(ask.at_s, ask.operator, ask.kind, ask.id, before.robots, before.behaviour, ask.take)
        self.asks[ask.id] = ask

    def died(self, name: str) -> None:
        """Note the end of a process: the next one knows only what is on its disk."""
        robot = self._robots.get(name)
        if robot is not None:
            robot.running, robot.offered_s = "", -math.inf
            robot.seen.clear()
            robot.enabled.clear()
            robot.newest.clear()
            robot.beat_s = robot.command_s = robot.stick_s = -math.inf
            robot.excused_s = self._now_s()

    def hindered(self, name: str) -> None:
        """Note that the agent of a robot does not work as it should now."""
        robot = self._robots.get(name)
        if robot is not None:
            robot.excused_s = self._now_s()

    def deceived(self, name: str, since_s: float) -> None:
        """Note that a robot's driver gives no true readings since then; inf: it does again."""
        robot = self._robots[name]
        robot.deceived_s = since_s
        robot.faulty_s = self._now_s()

    def misled(self, name: str, until_s: float) -> None:
        """Note that a robot's driver is wrong until then in a way that the agent cannot see."""
        robot = self._robots[name]
        robot.excused_s = max(robot.excused_s, until_s)
        robot.faulty_s = self._now_s()

    def disk_full(self, computer: str) -> None:
        """Note that a computer cannot keep anything: a restart may have forgotten what came meanwhile."""
        if computer in self._robots:
            self._robots[computer].full_s = self._now_s()
        else:
            self.core_lost_s = self._now_s()

    def raised(self, process: str, text: str) -> None:
        """Note an error that a node raised."""
        self._violate("error", process, f"a node raised {text}", text)

    def handled(self, receiver: str, message: Message) -> None:
        """Note a message that a process handles now."""
        robot = self._robots.get(receiver)
        if isinstance(message, StopRequest) or (isinstance(message, EStop) and message.engaged):
            self._reached[message.id].add(receiver)
        if robot is None:
            return
        now_s = self._now_s()
        if isinstance(message, Heartbeat):
            if message.node == "core":
                robot.beat_s = now_s
        elif isinstance(message, Command):
            if message.request_id == robot.running:
                robot.command_s = now_s
        elif isinstance(message, ControlRequest):
            if message.robot == robot.name and message.enable:
                robot.offered, robot.offered_s = message.request_id, now_s
                if message.expires_s > 0.0:
                    robot.stick_s = now_s
        elif isinstance(message, StopRequest):
            if (message.id, True) not in robot.seen and (not message.robots or robot.name in message.robots):
                robot.seen.add((message.id, True))
                self._stop(robot, message.id)
        elif isinstance(message, EStop):
            self._latch(robot, message)

    def _stop(self, robot: _Robot, order_id: str) -> None:
        ask = self.asks.get(order_id)
        if ask is not None and ask.at_s > robot.floor_s:
            robot.floor_s, robot.floor_id, robot.handled_s = ask.at_s, order_id, self._now_s()
        robot.running = ""

    def _latch(self, robot: _Robot, order: EStop) -> None:
        if (order.id, order.engaged) in robot.seen:
            return
        robot.seen.add((order.id, order.engaged))
        if order.robots and robot.name not in order.robots:
            return
        issued_s = self._issued.get((order.id, order.engaged), -math.inf)
        if order.engaged:
            self._stop(robot, order.id)
            robot.latch_s = issued_s if robot.latch_s == math.inf else max(issued_s, robot.latch_s)
            robot.latch_id = order.id
            robot.handled_s = self._now_s()
        elif issued_s >= robot.latch_s:
            robot.latch_s = math.inf
            robot.running = ""

    def published(self, sender: str, message: Message) -> None:
        """Note a message that a process publishes now."""
        if isinstance(message, EStop):
            issued_s = self._repeated_s(message) if sender == "core" and message.engaged else self._now_s()
            self._issued.setdefault((message.id, message.engaged), issued_s)
        elif isinstance(message, ControlAck) and sender in self._robots:
            self._acknowledged(self._robots[sender], message)
        elif isinstance(message, HealthReport) and sender in self._robots:
            self._reported(self._robots[sender], message)
        elif sender == "core" and isinstance(message, RequestStatus):
            self._decided(message)
        elif sender == "core" and isinstance(message, Leases):
            self._leased(message)

    def _repeated_s(self, order: EStop) -> float:
        """Return when an operator engaged the e-stop that the core repeats: a release that came later is newer."""
        engaged = (ask for ask in self.asks.values() if ask.kind == "e-stop")
        meant = (ask.at_s for ask in engaged if not order.robots or not set(ask.robots).isdisjoint(order.robots))
        return max(meant, default=self._now_s())

    def _acknowledged(self, robot: _Robot, ack: ControlAck) -> None:
        if not ack.accepted:
            return
        if not ack.enabled:
            robot.running = ""
            return
        robot.running = ack.request_id
        newest = robot.newest.get(ack.core, -1)
        robot.newest[ack.core] = max(newest, ack.sequence)
        if ack.sequence < newest:
            text = f"it carried out {ack.request_id} (number {ack.sequence}) after number {newest} of {ack.core}"
            self._violate("twice", robot.name, text, ack.request_id)
        numbers = robot.enabled[ack.request_id]
        numbers.add((ack.core, ack.sequence))
        behaviour = self._behaviour(ack.request_id)
        if len({each for each in numbers if behaviour not in CENTRALISED or each[0] == ack.core}) > 1:
            self._violate(
                "twice", robot.name, f"it carried out {ack.request_id} twice: {sorted(numbers)}", ack.request_id
            )

    def _reported(self, robot: _Robot, report: HealthReport) -> None:
        for health in report.robots:
            robot.health, robot.health_s = (health.behaviour, health.request_id, health.estop), self._now_s()
            if not health.behaviour:
                robot.running = ""
            if robot.latch_s < math.inf and not health.estop and self._now_s() > robot.handled_s + TICK_S:
                self._violate("e-stop", robot.name, f"it reports no e-stop, but {robot.latch_id} was never released",
                              robot.latch_id)  # fmt: skip

    def _decided(self, status: RequestStatus) -> None:
        now_s, ask = self._now_s(), self.asks.get(status.request_id)
        self._status[status.request_id] = status
        if status.phase in ("refused", "superseded") or status.request_id in self._accepted:
            return
        self._accepted[status.request_id] = now_s, status
        if ask is None or ask.kind not in ("request", "stick") or ask.take:
            return
        for name in status.robots:
            holder, since_s = self._leases.get(name, ("", math.inf))
            if holder not in ("", ask.operator) and since_s < now_s - TICK_S:
                self._violate("lease", name, f"{holder} holds it, and {ask.id} of {ask.operator} was accepted", ask.id)

    def _leased(self, message: Leases) -> None:
        now_s = self._now_s()
        found: dict[str, tuple[str, float]] = {}
        for lease in message.leases:
            if lease.robot in found:
                self._violate(
                    "lease", lease.robot, f"it has two holders: {found[lease.robot][0]}, {lease.operator}", ""
                )
            before = self._leases.get(lease.robot)
            since_s = before[1] if before is not None and before[0] == lease.operator else now_s
            found[lease.robot] = lease.operator, since_s
        self._leases = found

    # ---------------------------------------------------------------- motion
    def commanded(self, name: str, linear_m_s: float, angular_rad_s: float) -> None:
        """Judge a set-point that reaches a robot."""
        self.commands += 1
        if abs(linear_m_s) <= MOVES and abs(angular_rad_s) <= MOVES:
            return
        robot, now_s = self._robots[name], self._now_s()
        robot.commanded_s = now_s
        kind, cause, why = self._objection(robot, now_s)
        if kind:
            self._violate(
                kind, name, f"it is commanded {linear_m_s:.2f} m/s, {angular_rad_s:.2f} rad/s although {why}", cause
            )

    def _objection(self, robot: _Robot, now_s: float) -> tuple[str, str, str]:
        """Return the kind of violation, its cause, and why the robot may not move now; empty: it may."""
        fresh = now_s <= robot.handled_s + BOUNDS_S["stop"]
        if robot.latch_s < math.inf and not fresh:
            return "e-stop", robot.latch_id, f"{robot.latch_id} has latched it"
        running = robot.offered if robot.offered_s == now_s else robot.running  # the wheels come before the answer
        if not running:
            return ("", "", "") if fresh else ("motion", "", "it has accepted no request")
        ask = self._ask_of(running)
        if ask is None or robot.name not in ask.robots:
            return "motion", running, f"no operator has requested {running} of it"
        if ask.at_s < robot.floor_s and not fresh:
            text = f"{running} was requested at {ask.at_s:.3f}, before {robot.floor_id} at {robot.floor_s:.3f}"
            return "stop", running, text
        for cause, since_s in self._silences(robot, ask):
            if now_s - since_s > BOUNDS_S[cause] + 1e-6:
                return "silence", cause, f"it has received nothing ({cause}) for {now_s - since_s:.3f} s"
        return "", "", ""

    def _silences(self, robot: _Robot, ask: Ask) -> Iterable[tuple[str, float]]:
        """Yield what the robot's motion depends on, and since when that is silent."""
        yield "core", robot.beat_s
        yield "hub", self._hub_gone_s(robot.name)
        if robot.deceived_s < math.inf:
            yield "reading", robot.deceived_s
        if ask.behaviour in CENTRALISED:
            yield "command", robot.command_s
        if ask.kind == "stick":
            yield "stick", robot.stick_s

    def _ask_of(self, request_id: str) -> Ask | None:
        return self.asks.get(request_id) or self.asks.get(request_id.partition(".")[0])

    def _behaviour(self, request_id: str) -> str:
        ask = self._ask_of(request_id)
        return "" if ask is None else ask.behaviour

    def stepped(self, speeds: Sequence[float], pairs: Iterable[tuple[int, int]]) -> None:
        """Judge how the bodies move, m/s in the order of the robots, and which touch: second negative: a wall.

        A body that touches another one may be pushed by it; the contact is judged by itself.
        """
        self.steps += 1
        now_s, names, touching = self._now_s(), tuple(self._robots), set(pairs)
        pushed = {each for pair in touching | self._touching if min(pair) >= 0 for each in pair}
        for row, (name, speed) in enumerate(zip(names, speeds, strict=True)):
            robot = self._robots[name]
            if abs(speed) > ROLLS and row not in pushed and now_s - robot.commanded_s > BOUNDS_S["standing"]:
                text = f"it moves at {speed:.2f} m/s, {now_s - robot.commanded_s:.3f} s after its last set-point"
                self._violate("standing", name, text, "")
        if touching:
            self._note_pushed(touching | self._touching, names, now_s)
        for pair in touching - self._touching:
            self._touched(pair, names, now_s)
        self._touching = touching

    def _note_pushed(self, touching: Iterable[tuple[int, int]], names: Sequence[str], now_s: float) -> None:
        """Follow contacts from each robot that is excused: they are pushed all along the chain."""
        beside: dict[int, set[int]] = defaultdict(set)
        for one, other in touching:
            if other >= 0:
                beside[one].add(other)
                beside[other].add(one)
        reached = {row for row in beside if self._excused(self._robots[names[row]], now_s)}
        border = list(reached)
        while border:
            news = beside[border.pop()] - reached
            reached |= news
            border += news
        for row in reached:
            self._robots[names[row]].pushed_s = now_s

    def _excused(self, robot: _Robot, now_s: float) -> bool:
        """Tell whether its agent is not to blame for what a robot touches by its own motion."""
        deceived = now_s - robot.excused_s <= EXCUSED_S or robot.deceived_s < math.inf
        return deceived or self._behaviour(robot.running) in CENTRALISED

    def _touched(self, pair: tuple[int, int], names: Sequence[str], now_s: float) -> None:
        both = [self._robots[names[each]] for each in pair if each >= 0]
        if any(self._excused(each, now_s) or now_s - each.pushed_s <= PUSHED_S for each in both):
            self.excused += 1
            return
        other = both[1].name if len(both) > 1 else "a wall"
        self._violate("contact", both[0].name, f"it touches {other}", other)

    # ---------------------------------------------------------------- the end
    def finish(self, unanswered: Iterable[str], voided: Iterable[str], held: Mapping[str, Sequence[str]]) -> None:
        """Judge what is left after the quiet time.

        Parameters
        ----------
        unanswered : requests that living operators still wait for
        voided : requests that their operators have withdrawn before the core had them
        held : operator → robots that it believes to hold
        """
        for each in unanswered:
            self._violate("unanswered", "", f"{each} got no answer", each)
        owner: dict[str, str] = {}
        for operator, robots in held.items():
            for name in robots:
                if owner.setdefault(name, operator) != operator:
                    self._violate("lease", name, f"{owner[name]} and {operator} both hold it", "")
        gone = set(voided)
        for robot in self._robots.values():
            self._judge_last(robot, gone)

    def _judge_last(self, robot: _Robot, voided: set[str]) -> None:
        items = sorted(self._items(robot, voided), reverse=True)
        behaviour, running, estop = robot.health
        running = running if behaviour else ""
        if robot.latch_s < math.inf:
            if running or not estop:
                self._violate(
                    "last", robot.name, f"it is in e-stop ({robot.latch_id}) and runs {running or 'nothing'}", ""
                )
            return
        if not items:
            if running:
                self._violate("last", robot.name, f"it runs {running}, and nothing was requested of it", "")
            return
        newest_s = items[0][0]
        choices = [each for each in items if newest_s - each[0] <= TOGETHER_S]
        if self.core_lost_s >= choices[-1][0]:
            return
        if not running and self._refused_s(robot) >= choices[-1][0]:  # it had left the one before for that
            return
        if any(self._fits(robot, ask_id, running) for _, ask_id in choices):
            return
        self._violate("last", robot.name, f"it runs {running or 'nothing'}; last requested: {items[0][1]}", items[0][1])

    def _items(self, robot: _Robot, voided: set[str]) -> Iterable[tuple[float, str]]:
        """Yield what was to be carried out by a robot: when it was accepted, and its id."""
        for ask in self.asks.values():
            if robot.name not in ask.robots or ask.id in voided or ask.kind in ("release", "mission"):
                continue
            if ask.kind in ("stop", "e-stop"):
                if self._reached[ask.id] & {robot.name, "core"}:
                    yield ask.at_s, ask.id
                continue
        for request_id, (at_s, first) in self._accepted.items():
            found, last = self._ask_of(request_id), self._status[request_id]
            if found is None or found.kind in ("stop", "e-stop") or robot.name not in first.robots:
                continue
            if self._refused(robot, last) or robot.name in last.left_out:
                continue
            yield at_s, request_id

    def _refused(self, robot: _Robot, status: RequestStatus) -> bool:
        return status.phase == "refused" or robot.name in status.refused_by

    def _refused_s(self, robot: _Robot) -> float:
        """Return when the newest request was accepted by the core that the robot then refused; -inf: there is none."""
        refused = (
            at_s for request_id, (at_s, first) in self._accepted.items()
            if robot.name in first.robots and self._refused(robot, self._status[request_id])
        )  # fmt: skip
        return max(refused, default=-math.inf)

    def _fits(self, robot: _Robot, request_id: str, running: str) -> bool:
        ask = self._ask_of(request_id)
        if ask is None or ask.kind in ("stop", "e-stop"):
            return running == ""
        if ask.kind == "stick":  # its last frame may stay as a task that has expired
            return running in ("", request_id)
        if running == request_id:
            return True
        if running:
            return False
        last = self._status.get(request_id)
        ended = last is not None and (last.phase == "ended" or any(each.robot == robot.name for each in last.results))
        at_s = self._accepted[request_id][0]
        return ended or ask.kind == "mission" or robot.faulty_s >= at_s

    def _violate(self, kind: str, robot: str, text: str, cause: str) -> None:
        if (kind, robot, cause) not in self._told:
            self._told.add((kind, robot, cause))
            self.violations.append(Violation(round(self._now_s(), 4), kind, robot, text))
