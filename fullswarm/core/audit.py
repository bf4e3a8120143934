"""Records what is asked of the swarm and what comes of it in the audit log: requests, stops, leases, missions, changes.

It receives what the core receives, with the sender that the bus states, and sees what the core publishes. The result of
a request is the core's own word, not a message that anybody could send.

A storm must not fill the disk nor push older entries out of the log: each kind of entry and each sender has a budget.
What is over it is counted, and an entry ``summary`` states the counts.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from fullswarm.audit.log import AuditLog, Event, Head, bounded
from fullswarm.bus.base import Delivery, NamedBus, SenderBus
from fullswarm.keys import Keys
from fullswarm.messages import (
    STOP,
    BehaviourRequest,
    ChargeOrder,
    ChargingStatus,
    EStop,
    EStopReceipt,
    HealthReport,
    Lease,
    LeaseRequest,
    Leases,
    Message,
    MissionReply,
    MissionRequest,
    MissionStatus,
    ParamChanged,
    ParamReply,
    ParamRequest,
    RequestStatus,
    RobotHealth,
    StopRequest,
)
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler
from fullswarm.store import SEED, Store

NOTED = "audit/head"
"""Key of the core's database that holds the newest entry, so that a log that was cut off is noticed."""
SYNC_S = 1.0
SHARE = 100.0
"""The next wait for the disk comes no sooner than so many times its last duration: it holds up the core."""
NOTE_S = 10.0
SUMMARY_S = 10.0
MOST_WAITING = 1024
"""Requests without an answer that are remembered; others are only counted."""
UNANSWERED_S = 2.0
STICK_S = 2.0
"""A stick that is silent for so long is released: its intents are one entry at the begin and one at the end."""
MOST_SENDERS = 64
OTHERS = "others"

SAFETY, OPERATOR, ROBOT = "safety", "operator", "robot"
KINDS = {"stop": SAFETY, "estop": SAFETY, "estop_release": SAFETY, "estop_receipt": SAFETY, "core": SAFETY}
KINDS |= dict.fromkeys(("robot_stop", "robot_fault", "robot_estop", "robot_start"), ROBOT)
"""Kind of an entry's act; all others are those of operators."""


@dataclass(slots=True)
class Budget:
    """Entries that may be written: `burst` at once, `rate_hz` on average."""

    rate_hz: float
    burst: float
    _left: float = field(init=False)
    _at_s: float = -math.inf

    def __post_init__(self) -> None:
        self._left = self.burst

    def has(self, now_s: float) -> bool:
        """Tell whether one may be written now."""
        if self._at_s > -math.inf:
            self._left = min(self.burst, self._left + (now_s - self._at_s) * self.rate_hz)
        self._at_s = now_s
        return self._left >= 1.0

    def take(self) -> None:
        """Count one that is written."""
        self._left -= 1.0


class Budgets:
    """The budget of each kind of entry, and of each sender within it. What is over them is counted."""

    def __init__(self) -> None:
        self._kinds: dict[str, Budget] = {}
        self._senders: dict[tuple[str, str], Budget] = {}
        self.omitted: dict[str, int] = {}

    def allow(self, event: Event, now_s: float) -> bool:
        """Tell whether an entry may be written; if not, it is counted."""
        kind = KINDS.get(event.act, OPERATOR)
        whole = self._kinds.setdefault(kind, Budget(2.0, 1000.0))
        sender = (kind, event.sender or event.source)
        if sender not in self._senders and len(self._senders) >= MOST_SENDERS:
            sender = (kind, OTHERS)
        own = self._senders.setdefault(sender, Budget(1.0, 300.0))
        if whole.has(now_s) and own.has(now_s):
            whole.take()
            own.take()
            return True
        self.omit(event)
        return False

    def omit(self, event: Event) -> None:
        """Count an entry that is not written."""
        what = f"{event.act} from {(event.sender or event.source)[:48] or 'an unnamed sender'}"
        what = what if what in self.omitted or len(self.omitted) < MOST_SENDERS - 8 else OTHERS
        self.omitted[what] = self.omitted.get(what, 0) + 1


@dataclass(slots=True)
class Stick:
    """The intents of one operator for the same robots, while they go on."""

    event: Event
    newest_s: float
    count: int = 1


@dataclass(slots=True)
class Robot:
    """What a robot reported last, of what is recorded."""

    process: str
    estop: bool
    stop_code: str
    fault: str


class _CoreBus(NamedBus):
    """The bus as the parts of the core use it: what they publish is seen by the recorder."""

    def __init__(self, bus: SenderBus, seen: Callable[[Message], None]) -> None:
        super().__init__(bus, "")
        self._seen = seen

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        """Send `message`, then have it seen."""
        super().publish(key, message, sender=sender)
        self._seen(message)


class AuditRecorder:
    """Writes the audit log of a core.

    Parameters
    ----------
    log
        Closed with this node.
    store
        The core's database, which notes the newest entry; its opener closes it after this node.
    process
        Name of this start of the core.
    expires
        Tells whether a behaviour ends unless its request is repeated: a stick's.

    Attributes
    ----------
    bus : for all other parts of the core
    """

    def __init__(
        self,
        bus: SenderBus,
        keys: Keys,
        scheduler: Scheduler,
        log: AuditLog,
        store: Store,
        process: str,
        expires: Callable[[str], bool],
    ) -> None:
        self.bus: SenderBus = _CoreBus(bus, self._published)
        self._scheduler, self._log, self._store, self._process = scheduler, log, store, process
        self._expires, self._budgets, self._closed = expires, Budgets(), False
        self._requests: Recent[str, tuple[Event, float]] = Recent(MOST_WAITING)  # not answered yet
        self._phases: Recent[str, tuple[str, str]] = Recent(8192)  # request → its newest phase, its sender
        self._sticks: dict[tuple[object, ...], Stick] = {}
        self._intents: Recent[str, None] = Recent(4096)
        self._missions: Recent[str, Event] = Recent(256)
        self._mission_phases: Recent[str, str] = Recent(64)
        self._params: Recent[str, Event] = Recent(256)
        self._orders: Recent[tuple[str, str], None] = Recent(1024)  # stops, e-stops and receipts, which are repeated
        self._leases: dict[str, Lease] = {}
        self._docks: dict[str, tuple[str, str]] = {}  # slot → phase and reason, of those that are not used
        self._holders: Recent[str, str] = Recent(256)  # operator → who sent their newest lease request
        self._given: Recent[str, str] = Recent(256)  # operator → who hands robots over to them
        self._robots: dict[str, Robot] = {}
        self._summary_s, self._noted_s, self._sync_s = scheduler.now_s(), scheduler.now_s(), -math.inf
        self._noted = log.head
        self._by_kind: dict[type[Message], Callable[[Any], None]] = {
            RequestStatus: self._answered,
            MissionReply: self._mission_answered,
            MissionStatus: self._mission_changed,
            ParamReply: self._param_answered,
            ParamChanged: self._param_changed,
            Leases: self._leased,
            ChargeOrder: self._charge_order,
            ChargingStatus: self._docks_changed,
            EStop: self._core_estop,
        }
        self._subscriptions = [
            bus.subscribe_with_sender(keys.behaviour_request, BehaviourRequest, self._request),
            bus.subscribe_with_sender(keys.stop, StopRequest, self._stop),
            bus.subscribe_with_sender(keys.estop, EStop, self._estop),
            bus.subscribe_with_sender(keys.estop_receipt(), EStopReceipt, self._receipt),
            bus.subscribe_with_sender(keys.lease_request, LeaseRequest, self._lease_request),
            bus.subscribe_with_sender(keys.mission_request, MissionRequest, self._mission),
            bus.subscribe_with_sender(keys.param_request("core"), ParamRequest, self._param),
            bus.subscribe_with_sender(keys.health(), HealthReport, self._health),
        ]
        self._timer = scheduler.every(SYNC_S, self._tick)
        self._log.append(Event("core", {"process": process}, result="started", source=process))
        self._log.sync()

    def close(self) -> None:
        """Write what is still open and the end of the core; closing twice is fine."""
        if self._closed:
            return
        self._closed = True
        self._timer.cancel()
        for subscription in self._subscriptions:
            subscription.close()
        self._finish(math.inf)
        self._log.append(Event("core", {"process": self._process}, result="ended", source=self._process))
        self._log.sync()
        self._note()
        self._log.close()

    # ---------------------------------------------------------------- writing
    def _write(self, event: Event) -> None:
        if self._budgets.allow(event, self._scheduler.now_s()):
            self._log.append(event)

    def _tick(self) -> None:
        now_s = self._scheduler.now_s()
        self._finish(now_s)
        if now_s >= self._sync_s:
            self._log.sync()
            self._sync_s = now_s + SHARE * (self._scheduler.now_s() - now_s)
        if now_s - self._noted_s >= NOTE_S:
            self._noted_s = now_s
            self._note()

    def _finish(self, now_s: float) -> None:
        """Write the entries that waited for something: answers, the release of a stick, the counts of a storm."""
        for request_id, (event, at_s) in list(self._requests.items()):
            if now_s - at_s < UNANSWERED_S:
                break  # the others are newer
            del self._requests[request_id]
            self._write(_with(event, "no answer"))
        for key, stick in list(self._sticks.items()):
            if now_s - stick.newest_s >= STICK_S:
                del self._sticks[key]
                self._write(_with(stick.event, "released", act="drive", what={"requests": stick.count}))
        if self._budgets.omitted and now_s - self._summary_s >= SUMMARY_S:
            self._summary_s = self._scheduler.now_s()
            omitted, self._budgets.omitted = self._budgets.omitted, {}
            total = {"entries": sum(omitted.values())}
            self._log.append(Event("summary", total | omitted, result="omitted", source=self._process))

    def _note(self) -> None:
        head = self._log.head
        if head != self._noted:
            self._noted = head
            self._store.keep({NOTED: {"n": head.n, "hash": head.hash}}, f"core {self._process}")

    def _published(self, message: Message) -> None:
        handler = self._by_kind.get(type(message))
        if handler is not None:
            handler(message)

    # ---------------------------------------------------------------- requests
    def _request(self, delivery: Delivery[BehaviourRequest]) -> None:
        request, sender = delivery
        request_id = _short(request.id)
        known = self._phases.get(request_id)
        if known is not None or request_id in self._requests or request_id in self._intents:
            if known is not None and known[1] != sender:
                self._phases[request_id] = (known[0], sender)
                self._write(_with(_request_event(request, sender), "ignored: the id of another sender's request"))
            return
        event, now_s = _request_event(request, sender), self._scheduler.now_s()
        if not self._expires(request.behaviour):
            if request.behaviour == STOP:
                self._new("stop", request.id, sender)
            if len(self._requests) < MOST_WAITING:
                self._requests[request_id] = (event, now_s)
            else:
                self._budgets.omit(event)
            return
        self._intents[request_id] = None
        key = (sender, request.source, request.operator, request.behaviour, request.robots)
        stick = self._sticks.get(key)
        if stick is not None:
            stick.newest_s, stick.count = now_s, stick.count + 1
        elif len(self._sticks) < MOST_SENDERS:
            self._sticks[key] = Stick(event, now_s)
            self._write(_with(event, "held", act="drive"))
        else:
            self._budgets.omit(event)

    def _answered(self, status: RequestStatus) -> None:
        request_id, phase = _short(status.request_id), status.phase
        waiting = self._requests.get(request_id)
        result = f"{phase}: {status.reason}" if status.reason else phase
        if waiting is not None:
            del self._requests[request_id]
            event = waiting[0]
            self._phases[request_id] = (phase, event.sender)
            self._write(_with(event, result, robots=status.robots or event.robots))
            return
        known = self._phases.get(request_id)
        if request_id in self._intents:
            if phase == "refused":
                self._write(Event("drive", {"id": request_id, "behaviour": status.behaviour}, status.robots, result))
        elif known is not None and known[0] != phase:
            self._phases[request_id] = (phase, known[1])
            if phase in ("refused", "ended", "superseded"):
                what: dict[str, object] = {"id": request_id, "behaviour": status.behaviour}
                what |= {"refused_by": status.refused_by} if status.refused_by else {}
                what |= {"results": {each.robot: each.outcome for each in status.results}} if status.results else {}
                self._write(Event("request_end", what, status.robots, result, source=self._process))

    # ---------------------------------------------------------------- charging
    def _charge_order(self, order: ChargeOrder) -> None:
        """Record who is sent where; an order is repeated until its robot reports it."""
        if self._new(f"charge {order.op}", f"{order.id} {order.dock}", self._process):
            what: dict[str, object] = {"id": order.id, "dock": order.dock}
            self._write(Event("charge", what, (order.robot,), order.op, source=self._process))

    def _docks_changed(self, status: ChargingStatus) -> None:
        """Record the docks that are not used, and those that are used again."""
        found: dict[str, tuple[str, str]] = {
            each.dock: (each.phase, each.reason) for each in status.docks if each.reason
        }
        for dock in {**found, **self._docks}:
            phase, why = found.get(dock, ("free", ""))
            if found.get(dock) != self._docks.get(dock):
                result = f"{phase}: {why}" if why else "in use again"
                self._write(Event("dock", {"dock": dock}, (), result, source=self._process))
        self._docks = found

    # ---------------------------------------------------------------- stops
    def _new(self, kind: str, order_id: str, sender: str) -> bool:
        """Tell whether an order is not a copy of one that was recorded."""
        key = (kind, _short(order_id) or f"unnamed from {sender}")
        if key in self._orders:
            return False
        self._orders[key] = None
        return True

    def _stop(self, delivery: Delivery[StopRequest]) -> None:
        order, sender = delivery
        if self._new("stop", order.id, sender):
            self._write(Event("stop", {"id": order.id}, order.robots, sender=sender, source=order.source))

    def _estop(self, delivery: Delivery[EStop]) -> None:
        order, sender = delivery
        act = "estop" if order.engaged else "estop_release"
        if self._new(act, order.id, sender):
            self._write(_estop_event(act, order, sender))

    def _core_estop(self, order: EStop) -> None:
        if self._new("estop", order.id, self._process):
            self._write(_estop_event("estop", order, ""))

    def _receipt(self, delivery: Delivery[EStopReceipt]) -> None:
        receipt, sender = delivery
        state = f"{'engaged' if receipt.engaged else 'released'}{', at standstill' if receipt.standing else ''}"
        if self._new(f"receipt {receipt.robot} {state}", receipt.id, sender):
            what = {"id": receipt.id, "rolled_m": receipt.rolled_m}
            self._write(Event("estop_receipt", what, (receipt.robot,), state, sender))

    # ---------------------------------------------------------------- leases
    def _lease_request(self, delivery: Delivery[LeaseRequest]) -> None:
        request = delivery.message
        self._holders[_short(request.operator)] = delivery.sender
        if request.given_by:
            self._given[_short(request.operator)] = request.given_by
        elif request.take:
            self._given.pop(_short(request.operator), None)

    def _leased(self, message: Leases) -> None:
        now = {lease.robot: lease for lease in message.leases}
        groups: dict[tuple[str, str, str], list[str]] = {}
        for robot in {**self._leases, **now}:
            old, new = self._leases.get(robot), now.get(robot)
            holder, before = (new.operator if new else ""), (old.operator if old else "")
            if holder == before:
                continue
            if not holder:
                act, operator, other = "lease_end", before, ""
            elif new is not None and new.taken_from:
                given = self._given.get(_short(holder)) == new.taken_from
                act, operator, other = "hand_over" if given else "take_over", holder, new.taken_from
            else:
                act, operator, other = "lease", holder, ""
            groups.setdefault((act, operator, other), []).append(robot)
        self._leases = now
        for (act, operator, other), robots in groups.items():
            what = {"from": other} if other else {}
            if act == "hand_over":
                self._given.pop(_short(operator), None)  # what they take later is a take-over again
            self._write(Event(act, what, robots, sender=self._holders.get(_short(operator)) or "", operator=operator))

    # ---------------------------------------------------------------- missions
    def _mission(self, delivery: Delivery[MissionRequest]) -> None:
        request, sender = delivery
        if request.op in ("check", "show") or request.id in self._missions:
            return
        what: dict[str, object] = {"id": request.id, "op": request.op, "mission": request.mission}
        what |= {"plan": request.plan.name} if request.plan is not None else {}
        what |= {"track": request.track, "step": request.step} if request.op == "confirm" else {}
        what |= {"take": True} if request.take else {}
        self._missions[request.id] = Event(
            "mission", what, sender=sender, operator=request.operator, source=request.source
        )

    def _mission_answered(self, reply: MissionReply) -> None:
        event = self._missions.get(reply.id)
        if event is not None and not event.result:
            result = "accepted" if reply.ok else f"refused: {reply.reason}"
            self._missions[reply.id] = event = _with(event, result)
            self._write(event)

    def _mission_changed(self, status: MissionStatus) -> None:
        if self._mission_phases.get(status.mission) != status.phase:
            self._mission_phases[status.mission] = status.phase
            result = f"{status.phase}: {status.reason}" if status.reason else status.phase
            robots = dict.fromkeys(robot for track in status.tracks for step in track.steps for robot in step.robots)
            what = {"id": status.mission, "plan": status.name}
            self._write(
                Event("mission_state", what, tuple(robots), result, operator=status.operator, source=self._process)
            )

    # ---------------------------------------------------------------- parameters
    def _param(self, delivery: Delivery[ParamRequest]) -> None:
        request, sender = delivery
        if request.op == "set" and _short(request.id) not in self._params:
            what = {"id": bounded(request.id), "key": bounded(request.key), "value": bounded(request.value)}
            self._params[_short(request.id)] = Event("parameter", what, sender=sender, operator=request.author)

    def _param_answered(self, reply: ParamReply) -> None:
        event = self._params.get(_short(reply.id))
        if event is not None and not event.result:
            self._params[_short(reply.id)] = event = _with(event, "changed" if reply.ok else f"refused: {reply.reason}")
            self._write(event)

    def _param_changed(self, message: ParamChanged) -> None:
        entry = message.entry
        if entry.author == SEED:  # a file was loaded again
            self._write(Event("parameter", {"key": entry.key, "value": entry.value}, result="reloaded", source=SEED))

    # ---------------------------------------------------------------- robots
    def _health(self, delivery: Delivery[HealthReport]) -> None:
        report, sender = delivery
        for health in report.robots:
            old = self._robots.get(health.robot)
            if old is None and len(self._robots) >= 4096:
                continue
            new = self._robots[health.robot] = Robot(report.process, health.estop, _stop_code(health), health.fault)
            if old is None or old.process != new.process:
                what = {"process": report.process, "version": report.version, "driver": health.driver}
                self._robot("robot_start", what, health, "reports", sender)
            if new.estop != (old.estop if old else False):
                self._robot("robot_estop", {}, health, "latched" if new.estop else "not latched", sender)
            if new.stop_code and new.stop_code != (old.stop_code if old else ""):
                what = {"code": health.stop_code, "behaviour": health.behaviour, "request": health.request_id}
                self._robot("robot_stop", what, health, health.stop_reason, sender)
            if new.fault != (old.fault if old else ""):
                self._robot("robot_fault", {"code": health.fault_code}, health, new.fault or "cleared", sender)

    def _robot(self, act: str, what: dict[str, str], health: RobotHealth, result: str, sender: str) -> None:
        self._write(Event(act, what, (health.robot,), result, sender))


def noted_head(store: Store) -> Head:
    """Return the newest entry as the core's database notes it."""
    value = store.get(NOTED)
    n, digest = (value.get("n"), value.get("hash")) if isinstance(value, dict) else (None, None)
    return Head(n, digest) if isinstance(n, int) and isinstance(digest, str) else Head()


def _with(event: Event, result: str, *, act: str = "", what: dict[str, object] | None = None,
          robots: Sequence[str] | None = None) -> Event:  # fmt: skip
    """Return an entry with its result, and with what is known in addition."""
    return Event(
        act or event.act,
        {**event.what, **(what or {})},
        event.robots if robots is None else robots,
        result,
        event.sender,
        event.operator,
        event.source,
    )


def _request_event(request: BehaviourRequest, sender: str) -> Event:
    what: dict[str, object] = {"id": bounded(request.id), "behaviour": bounded(request.behaviour)}
    what |= {"parameters": bounded(request.parameters)} | ({"take": True} if request.take else {})
    act = "stop" if request.behaviour == STOP else "request"
    return Event(act, what, request.robots, "", sender, request.operator[:256], request.source[:256])


def _short(name: str) -> str:
    """Return a name that another process chose, or its hash: what is remembered must be bounded."""
    return name if len(name) <= 128 else hashlib.sha256(name.encode()).hexdigest()


def _estop_event(act: str, order: EStop, sender: str) -> Event:
    what = {"id": order.id, "reason": order.reason}
    return Event(act, what, order.robots, "", sender, source=order.source)


def _stop_code(health: RobotHealth) -> str:
    return (health.stop_code or health.stop_reason) if health.behaviour else ""
