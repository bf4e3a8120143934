"""Carries out what one operator does in the console: requests, driving, leases, stops and e-stops."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from fullswarm.bus.base import Bus
from fullswarm.clock import clock_id
from fullswarm.errors import did_you_mean
from fullswarm.keys import Keys
from fullswarm.messages import BehaviourRequest, MissionReply, ParamReply, RequestStatus
from fullswarm.operator.client import Operator
from fullswarm.operator.console import frames
from fullswarm.operator.console.frames import Answer
from fullswarm.operator.console.log import for_page
from fullswarm.operator.console.samples import DEFAULT
from fullswarm.operator.console.study import StudyDesk
from fullswarm.operator.console.tokens import Role
from fullswarm.operator.console.undo import Known, Step, UndoPlan
from fullswarm.operator.console.world import World
from fullswarm.operator.estop import EStopOrder, end_released
from fullswarm.operator.leases import LeaseHolder
from fullswarm.operator.missions import MissionClient
from fullswarm.operator.teleop import Teleop
from fullswarm.runtime import Scheduler, Timer

DEAD_MAN_S = 0.25
"""After this long without a frame the stick counts as released."""
WATCH_S = 0.05
MISSION_S = 5.0
"""A request that the core has not answered by then is given up: it must not start or resume a mission later."""
CLEAR_S = 5.0
"""A forgotten page must not release a robot that comes back tomorrow; an e-stop is repeated without end."""

OBSERVER = "your token is that of an observer: it shows everything and sends nothing"
NO_CLEAR = "your token is that of a driver: an operator who has looked at the robots clears their e-stop"
NO_TAKE = "your token is that of a driver: it takes no robots over from their holders"
READ_ONLY = "this console is read-only: it was started with --read-only"
NO_EXPERIMENTS = "your token is that of a driver: it starts and stops no experiments"
NOT_OFFERED = "this console offers no experiments"
NO_GROUPS = "your token is that of a driver: it makes no groups"
NO_KEEPING = "your token is that of a driver: it keeps no places and no requests"
IN_STUDY = "this is not offered in a study"
NOT_IN_STUDY = (frames.StartMission, frames.Undo, frames.Group, frames.Keep, frames.HandOver)


def refusal_of(role: Role, *, clears: bool = False, takes: bool = False) -> str:
    """Return why an operator of a role may not send what `clears` an e-stop or `takes` robots over; empty: they may."""
    if role == "observer":
        return OBSERVER
    if role == "driver" and (clears or takes):
        return NO_CLEAR if clears else NO_TAKE
    return ""


def _takes(command: frames.Command) -> bool:
    return isinstance(command, frames.Request | frames.Lease | frames.Mission | frames.StartMission) and command.take


class Listener(Protocol):
    """A page that is open. It takes frames at once and never blocks."""

    def put(self, kind: str, text: str) -> None:
        """Send a frame; of some kinds only the newest is kept."""
        ...


class ExperimentDesk(Protocol):
    """Lists and runs experiments; see :class:`fullswarm.operator.console.experiments.Experiments`."""

    def watch(self, listener: Listener, on: bool) -> None:
        """Begin or end to send a page the list."""
        ...

    def start(self, command: frames.Experiment, by: str) -> str:
        """Start one; return why not, or empty."""
        ...

    def stop(self, command: frames.Experiment, by: str) -> str:
        """End the one that runs; return why not, or empty."""
        ...


class ScanDesk(Protocol):
    """Sends pages the range scans of robots; see :class:`fullswarm.operator.console.scans.Scans`."""

    def show(self, listener: Listener, robots: tuple[str, ...]) -> None:
        """Send a page the scans of these robots from now on; of none: no more."""
        ...


@dataclass(frozen=True, slots=True)
class ConsoleContext:
    """What all operator sessions share."""

    bus: Bus
    keys: Keys
    scheduler: Scheduler
    world: World
    present: Callable[[], Iterable[str]]  # robots that are present
    end_estops: Callable[[tuple[str, ...]], None]  # no session may repeat an e-stop that is released
    read_only: bool
    study: StudyDesk | None  # None: the operator takes part in no study
    look: Callable[[frames.Past, Listener, str], Answer]  # shows a page the past
    chart: Callable[[frames.Charts, Listener], Answer]  # shows a page charts
    undo: Known
    note: Callable[[str, str], None]  # logs what an operator has changed: text, name
    hand_over: Callable[[frames.HandOver, OperatorSession], str]  # carries it out, or returns why not
    experiments: ExperimentDesk | None = None  # None: this console offers none
    scans: ScanDesk | None = None  # None: this console shows none


class OperatorSession:
    """Carries out the frames of an operator's pages. It survives a reload; driving ends with the page that drives.

    Parameters
    ----------
    key, source, name
        The secret of the operator's pages; the unique source of its messages; the operator's name.
    role
        What it carries out: an observer nothing, a driver neither clears e-stops nor takes robots over.
    """

    def __init__(self, context: ConsoleContext, key: str, source: str, name: str, *, role: Role = "operator") -> None:
        self.key, self.source, self.name, self.role = key, source, name, role
        self.listeners: list[Listener] = []
        self.watchers: list[Listener] = []  # of them, those that look at cameras
        self.inspected: dict[Listener, str] = {}  # of them, those that show the details of a robot
        self._context = context
        self._operator = Operator(context.bus, context.keys, context.scheduler, source, name=name, clock=clock_id())
        self._leases = LeaseHolder(context.bus, context.keys, context.scheduler, name, on_lost=self._lost)
        self._missions = MissionClient(
            context.bus, context.keys, context.scheduler, source, name=name, clock=clock_id(), watch=False
        )
        self._teleop = self._new_teleop()
        self._driver: Listener | None = None
        self._drove_s = -math.inf
        self._blocked = ""  # why the dead-man must be released first; empty: it need not
        self._watch: Timer | None = None
        self._estops: list[EStopOrder] = []
        self.undo = UndoPlan(context.undo)
        self._undo_sent = self.undo.shown()

    # ---------------------------------------------------------------- pages
    def leave(self, listener: Listener) -> None:
        """Remove a page; what it drove stops at once."""
        for pages in (self.listeners, self.watchers):
            if listener in pages:
                pages.remove(listener)
        self.inspected.pop(listener, None)
        if self._context.experiments is not None:
            self._context.experiments.watch(listener, False)
        if self._context.scans is not None:
            self._context.scans.show(listener, ())
        if self._driver is listener or not self.listeners:
            self._blocked = ""
            self._release()

    def close(self) -> None:
        """Release the robots, send nothing more."""
        self._release()
        self._leases.close()
        self._missions.close()
        self._operator.close()

    def send(self, kind: str, frame: dict[str, Any]) -> None:
        """Send a frame to this operator's pages."""
        text = frames.encode(frame)
        for listener in tuple(self.listeners):
            listener.put(kind, text)

    # ---------------------------------------------------------------- commands
    def handle(self, command: frames.Command, listener: Listener) -> Answer:
        """Carry out a frame that came by `listener`."""
        ref = command.ref
        if isinstance(command, frames.Ping):
            return Answer(ref=ref)
        if isinstance(command, frames.Watch):
            return self._watch_cameras(ref, command.on, listener)
        if isinstance(command, frames.Inspect):
            return self._inspect(ref, command.robot, listener)
        if isinstance(command, frames.Charts):
            return self._chart(command, listener)
        if isinstance(command, frames.Scans):
            return self._show_scans(command, listener)
        if isinstance(command, frames.Look):
            return self._context.look(command, listener, self.name)
        if isinstance(command, frames.Experiment):
            reason = self._experiment(command, listener)
            return Answer(ref=ref, ok=not reason, reason=reason)
        if self._context.read_only:
            return Answer(ref=ref, ok=False, reason=READ_ONLY)
        if reason := refusal_of(self.role, clears=isinstance(command, frames.Clear), takes=_takes(command)):
            return Answer(ref=ref, ok=False, reason=reason)
        if isinstance(command, frames.Mark | frames.Clip):
            return self._context.look(command, listener, self.name)
        desk = self._context.study
        if isinstance(command, frames.Study):
            reason = desk.handle(command, self.key) if desk is not None else "this console is not in a study"
            return Answer(ref=ref, ok=not reason, reason=reason)
        if desk is not None and isinstance(command, NOT_IN_STUDY):
            return Answer(ref=ref, ok=False, reason=IN_STUDY)
        if desk is not None and (reason := desk.refusal(command)):
            return Answer(ref=ref, ok=False, reason=reason)
        answer = self._carry_out(command, listener)
        if desk is not None:
            desk.log(command, self.key)  # afterwards: nothing may delay a stop
        return answer

    def _watch_cameras(self, ref: int, on: bool, listener: Listener) -> Answer:
        """Begin or end to send a page the cameras' pictures; who only looks on may look."""
        if self._context.study is not None:
            return Answer(ref=ref, ok=False, reason="cameras are not shown in a study")
        if listener in self.watchers:
            self.watchers.remove(listener)
        if on and listener in self.listeners:
            self.watchers.append(listener)
        return Answer(ref=ref)

    def _experiment(self, command: frames.Experiment, listener: Listener) -> str:
        """Show experiments to whoever looks on; start and stop them for operators. Return why not, or empty."""
        desk = self._context.experiments
        if desk is None:
            return NOT_OFFERED
        if command.op in ("watch", "unwatch"):
            desk.watch(listener, command.op == "watch" and listener in self.listeners)
            return ""
        if self._context.read_only:
            return READ_ONLY
        if self.role != "operator":
            return OBSERVER if self.role == "observer" else NO_EXPERIMENTS
        return desk.start(command, self.name) if command.op == "start" else desk.stop(command, self.name)

    def _carry_out(self, command: frames.Command, listener: Listener) -> Answer:
        ref = command.ref
        match command:
            case frames.Stop() | frames.Estop() | frames.Clear():
                return self._halt(command)
            case frames.Drive():
                reason = self._drive(command, listener)
            case frames.Release():
                if self._driver in (None, listener):  # else another window of this operator drives
                    self._blocked = ""
                    self._release()
                reason = ""
            case frames.Lease():
                reason = self._lease(command)
            case frames.Request():
                return self._request(command)
            case frames.Mission() | frames.StartMission():
                return self._mission(command)
            case frames.Undo():
                reason = self._undo(command)
            case frames.Group():
                reason = self._group(command)
            case frames.Keep():
                reason = self._keep(command)
            case frames.HandOver():
                reason = self._context.hand_over(command, self)
            case _:  # an input: only a study takes note of it
                reason = ""
        return Answer(ref=ref, ok=not reason, reason=reason)

    def _inspect(self, ref: int, robot: str, listener: Listener) -> Answer:
        """Begin or end to send a page the details of a robot: of one at a time, whoever only looks on may look."""
        if self._context.study is not None:
            return Answer(ref=ref, ok=False, reason=IN_STUDY)
        self.inspected.pop(listener, None)
        if robot and listener in self.listeners:
            self.inspected[listener] = robot
        return Answer(ref=ref)

    def _show_scans(self, command: frames.Scans, listener: Listener) -> Answer:
        """Begin or end to send a page the scans of robots; whoever only looks on may look."""
        scans = self._context.scans
        if scans is None or self._context.study is not None:
            return Answer(ref=command.ref, ok=False, reason=IN_STUDY)
        if listener in self.listeners:
            scans.show(listener, command.robots)
        return Answer(ref=command.ref)

    def _chart(self, command: frames.Charts, listener: Listener) -> Answer:
        """Show a page charts: in a study only those that every page shows."""
        others = command.at is not None or any(each.of not in DEFAULT for each in command.charts)
        if self._context.study is not None and others:
            return Answer(ref=command.ref, ok=False, reason=IN_STUDY)
        if listener not in self.listeners:
            return Answer(ref=command.ref)  # it has left meanwhile
        return self._context.chart(command, listener)

    def _request(self, command: frames.Request) -> Answer:
        def accepted(status: RequestStatus) -> None:
            self.undo.accepted(status.request_id, status.behaviour, status.robots)
            self.send_undo()

        pending = self._operator.request(
            command.behaviour, command.robots, command.parameters, self._holding(command.robots, accepted),
            take=command.take, team=command.team, needs=command.needs, roles=command.roles,
        )  # fmt: skip
        if self._context.study is None and not self._context.world.expires(command.behaviour):
            self.undo.sent(pending.request.id)
        return Answer(ref=command.ref, request_id=pending.request.id)

    def _holding(
        self, robots: tuple[str, ...], accepted: Callable[[RequestStatus], None] = lambda _: None
    ) -> Callable[[RequestStatus], None]:
        """Return what holds the robots of a request, and calls `accepted`, once the core has accepted it."""
        done = False

        def receive(status: RequestStatus) -> None:
            nonlocal done
            # Leases come with a request that the core has accepted: a refused one shall hold no robot.
            if not done and status.phase in ("accepted", "scheduled", "running"):
                done = True
                if robots:
                    self._leases.hold(status.robots)
                accepted(status)

        return receive

    def _undo(self, command: frames.Undo) -> str:
        """Ask again for what ran before the newest request; return why not."""
        steps, refusal = self.undo.steps()
        if command.id != self.undo.id:
            refusal = "what it would undo has changed meanwhile: read it again"
        if refusal:
            return refusal
        self.undo.clear()
        for step in steps:
            self._repeat(step)
        self.send_undo()
        return ""

    def _repeat(self, step: Step) -> None:
        original: BehaviourRequest | None = step.original
        if original is None:
            self.stopped(step.robots)
            self._operator.stop(step.robots)
            return
        self._operator.request(
            step.behaviour, step.robots, step.parameters, self._holding(step.robots), team=original.team,
            needs=original.needs, roles=original.roles,
        )  # fmt: skip

    def send_undo(self) -> None:
        """Send this operator's pages what undoes the newest request, if that has changed."""
        frame = self.undo.shown()
        if frame != self._undo_sent:
            self._undo_sent = frame
            self.send("undo", frame)

    def _group(self, command: frames.Group) -> str:
        """Ask the core to keep a group or to delete it, whose reply is in the log; return why that is not asked for."""
        if self.role != "operator":
            return NO_GROUPS
        if command.op == "save" and not command.robots:
            return "a group needs robots: select some first"
        robots = command.robots if command.op == "save" else None

        def receive(reply: ParamReply) -> None:
            what = f"group {command.name}"
            if not reply.ok:
                self._context.note(f"{what} is not changed: {reply.reason}", self.name)
            elif robots is None:
                self._context.note(f"{self.name} deletes the {what}", self.name)
            else:
                self._context.note(f"{self.name} makes the {what}: {', '.join(robots)}", self.name)

        return self._context.world.set_group(command.name, robots, self.name, receive)

    def _keep(self, command: frames.Keep) -> str:
        """Ask the core to keep a place or a request, or to delete it; return why that is not asked for."""
        if self.role != "operator":
            return NO_KEEPING
        if command.op == "save" and command.value is None:
            return "there is nothing to keep"
        value = command.value if command.op == "save" else None
        thing = f"place {command.name}" if command.what == "place" else f"saved request {command.name}"

        def receive(reply: ParamReply) -> None:
            if not reply.ok:
                self._context.note(f"{thing} is not changed: {reply.reason}", self.name)
            else:
                self._context.note(f"{self.name} {'deletes' if value is None else 'keeps'} the {thing}", self.name)

        return self._context.world.keep(f"{command.what}/{command.name}", value, self.name, receive)

    def _mission(self, command: frames.Mission | frames.StartMission) -> Answer:
        """Pass it to the core, whose reply follows as a frame of its own; that of a new mission has its name."""
        if isinstance(command, frames.StartMission):
            op, mission, ask = "start", command.plan.name, partial(self._missions.ask, "start", plan=command.plan)
        else:
            op, mission = command.op, command.mission
            ask = partial(self._missions.ask, op, mission=mission, track=command.track, step=command.step)

        def receive(reply: MissionReply) -> None:
            told = {"request_id": reply.id, "ok": reply.ok, "reason": reply.reason, "code": reply.code}
            self.send("mission", {"t": "mission", "op": op, "mission": mission, **told})

        def give_up() -> None:
            if pending.reply is None:
                self._missions.forget(pending)
                receive(MissionReply(id=pending.request.id, ok=False, reason="the core does not answer"))

        pending = ask(receive, take=command.take)
        self._context.scheduler.after(MISSION_S, give_up)
        return Answer(ref=command.ref, request_id=pending.request.id)

    def _halt(self, command: frames.Stop | frames.Estop | frames.Clear) -> Answer:
        robots, reason = self._expand(command.robots)
        if reason:
            return Answer(ref=command.ref, ok=False, reason=reason)
        if isinstance(command, frames.Stop):
            self.stopped(robots)
            self._operator.stop(robots)
            return Answer(ref=command.ref)
        engaged = isinstance(command, frames.Estop)
        if engaged:
            self.stopped(robots)
        else:
            self._context.end_estops(robots)
        order = self._operator.estop(
            engaged,
            robots,
            command.reason if isinstance(command, frames.Estop) else "",
            known=self._context.present,
            deadline_s=math.inf if engaged else CLEAR_S,
        )
        self._estops = [*(each for each in self._estops if not each.done), order]
        return Answer(ref=command.ref, request_id=order.message.id)

    def end_estops(self, robots: tuple[str, ...]) -> None:
        """Stop repeating e-stops that concern `robots` (none: all): another operator has released them."""
        self._estops = end_released(self._estops, robots)

    def stopped(self, robots: tuple[str, ...]) -> None:
        """Note that `robots` (none: all) were stopped: driving one again needs the dead-man released first.

        A stop ends what could be undone, too: nothing may start robots again that were stopped since.
        """
        self.undo.stopped(robots)
        self.send_undo()
        mine = self._teleop.robots
        if self._teleop.held and (not robots or not mine or not set(mine).isdisjoint(robots)):
            self._block("stopped while driving")

    def _block(self, why: str) -> None:
        self._blocked = why
        self._teleop.release()

    def _new_teleop(self) -> Teleop:
        def receive(status: RequestStatus) -> None:
            # While it is held: afterwards it is the answer to the final zeros.
            if status.phase == "refused" and teleop is self._teleop and teleop.held:
                self._block(for_page(status) or "refused without a reason")

        teleop = Teleop(self._operator, self._context.scheduler, on_status=receive)
        return teleop

    # ---------------------------------------------------------------- driving
    def _drive(self, command: frames.Drive, listener: Listener) -> str:
        """Return why robots cannot be driven; empty if they can."""
        robots, reason = self._expand(command.robots)
        if reason:
            return reason
        world, behaviour = self._context.world, command.behaviour
        if not world.known:
            return "the core has not reported its behaviours yet"
        if not world.expires(behaviour):
            return f"{behaviour} does not end by itself when the stick is released; request it instead"
        held = self._leases.held_by_others(robots or self._context.present())
        if held:
            return "; ".join(f"{robot} is held by {operator}" for robot, operator in sorted(held.items()))
        self._drove_s = self._context.scheduler.now_s()
        if self._watch is None:
            self._watch = self._context.scheduler.every(WATCH_S, self._check)
        if self._blocked:
            return f"{self._blocked}: release the dead-man switch first"
        if self._driver not in (None, listener):
            return "another window of yours drives"
        if self._driver is None or self._teleop.robots != robots:
            if self._teleop.held:
                self._teleop.release()
                self._teleop = self._new_teleop()  # the zeros continue for robots that were released
            self._teleop.robots = robots
            self._leases.hold(robots)
        self._driver = listener
        self._teleop.hold(behaviour, command.sticks, command.fixed)
        return ""

    def _check(self) -> None:
        if self._context.scheduler.now_s() - self._drove_s >= DEAD_MAN_S:
            self._release()

    def _release(self) -> None:
        self._driver = None
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None
        if self._teleop.held:
            self._teleop.release()

    # ---------------------------------------------------------------- leases
    def _lease(self, command: frames.Lease) -> str:
        robots, reason = self._expand(command.robots)
        if reason:
            return reason
        if not command.hold:
            self._leases.release(robots or None)
            return ""
        robots = robots or tuple(self._context.present())
        held = self._leases.held_by_others(robots)
        if held and not command.take:
            return "; ".join(f"{robot} is held by {operator}" for robot, operator in sorted(held.items()))
        self._leases.hold(robots, take=command.take)
        return ""

    def driven(self) -> set[str]:
        """Return the robots that are driven by hand now."""
        return set(self._teleop.robots or self._context.present()) if self._teleop.held else set()

    def give(self, robots: tuple[str, ...], taker: str) -> set[str]:
        """Hold `robots` no longer, which `taker` gets; return those that were driven by hand, which are stopped."""
        driven = self.driven() & set(robots)
        if driven:
            self._block(f"{', '.join(sorted(driven))} handed over to {taker}")
            self._operator.stop(sorted(driven))  # zeros would be refused once the lease has moved
        self._leases.forget(robots)
        return driven

    def take_in(self, robots: tuple[str, ...], giver: str) -> None:
        """Hold `robots` that `giver` hands over."""
        self._leases.hold(robots, take=True, given_by=giver)

    def _lost(self, robots: tuple[str, ...], operator: str) -> None:
        mine = self._teleop.robots
        if self._teleop.held and (not mine or not set(mine).isdisjoint(robots)):
            self._block(f"{', '.join(robots)} taken over by {operator}")
        self.send("lost", {"t": "lost", "robots": robots, "by": operator})

    def _expand(self, robots: Iterable[str]) -> tuple[tuple[str, ...], str]:
        """Return the robots with groups expanded, or why that is not possible."""
        found: dict[str, None] = {}
        for each in robots:
            if not each.startswith("@"):
                found[each] = None
                continue
            members = self._context.world.group(each[1:])
            if not members:
                hint = did_you_mean(each[1:], self._context.world.shown()["groups"])
                return (), f"no group '{each[1:]}' ({hint})"
            found |= dict.fromkeys(members)
        return tuple(found), ""
