"""The log that the page shows: requests with their outcomes, stops, leases, and changes of hub, core and robots."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, Literal

import msgspec

from fullswarm.messages import FINAL_PHASES, STOP, BehaviourRequest, FileReload, Lease, RequestStatus, RobotHealth
from fullswarm.operator.console.fleet import core_age_s
from fullswarm.operator.view import SILENT_S, Snapshot
from fullswarm.reasons import Code, Reason, worded
from fullswarm.recent import Recent

LOG_LENGTH = 200

LogKind = Literal["request", "refused", "stop", "estop", "mission", "lease", "link", "reload", "fault"]
Severity = Literal["info", "warning", "error"]
SEVERITIES: dict[LogKind, Severity] = {
    "request": "info", "refused": "warning", "stop": "warning", "estop": "error", "mission": "info", "lease": "info",
    "link": "warning", "reload": "info", "fault": "error",
}  # fmt: skip
"""What a line of each kind is unless it says otherwise."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A line of the log; `by` is the operator that caused it. A line with the `number` of another one repeats it."""

    at_s: float
    clock: str
    kind: LogKind
    text: str
    robots: tuple[str, ...] = ()
    request_id: str = ""
    by: str = ""
    number: int = 0
    count: int = 1
    severity: Severity = "info"

    def shown(self, reader: str) -> dict[str, Any]:
        """Return it as operator `reader` sees it."""
        return {
            "at": round(self.at_s, 2),
            "clock": self.clock,
            "kind": self.kind,
            "text": self.text,
            "robots": self.robots,
            "request_id": self.request_id,
            "by": self.by,
            "severity": self.severity,
            "mine": bool(reader) and self.by == reader,
            "number": self.number,
            "count": self.count,
        }


class EventLog:
    """The lines of the log, in a ring of fixed size. The wall clock is only for its readers."""

    def __init__(self, wall_s: Callable[[], float], on_entry: Callable[[Entry], None]) -> None:
        self.entries: deque[Entry] = deque(maxlen=LOG_LENGTH)
        self._wall_s, self._on_entry, self._last = wall_s, on_entry, 0

    def add(
        self,
        at_s: float,
        kind: LogKind,
        text: str,
        robots: tuple[str, ...] = (),
        *,
        request_id: str = "",
        by: str = "",
        severity: Severity | None = None,
    ) -> None:
        """Write a line, of the severity of its kind unless another is given.

        The same refusal again moves its line to the end and counts.
        """
        clock = f"{datetime.fromtimestamp(self._wall_s()):%H:%M:%S}"
        self._last += 1
        rank = severity or SEVERITIES[kind]
        entry = Entry(at_s, clock, kind, text[:500], robots, request_id, by, self._last, severity=rank)
        if kind == "refused" and (before := self._same(entry)):
            self.entries.remove(before)
            entry = replace(entry, number=before.number, count=before.count + 1)
        self.entries.append(entry)
        self._on_entry(entry)

    def _same(self, entry: Entry) -> Entry | None:
        """Return the line that says the same of the same robots and the same operator; None: there is none."""
        same = (entry.kind, entry.text, entry.robots, entry.by)
        found = (each for each in reversed(self.entries) if (each.kind, each.text, each.robots, each.by) == same)
        return next(found, None)


REMEMBERED = 512
STREAM_GAP_S = 2.0
"""A stick that was at rest for this long gets a new line in the log."""
NAMES_SHOWN = 6
SUPERSEDED = (Code.SUPERSEDED, Code.CAME_FIRST)
SHOWN_REQUESTS = 12
"""Requests that are shown of one robot."""


@dataclass(frozen=True, slots=True)
class RequestRecord:
    """A request that was received."""

    operator: str
    robots: tuple[str, ...]
    intent: bool
    behaviour: str = ""
    halts: bool = False  # a stop or an e-stop


@dataclass(slots=True)
class AskedRequest:
    """A request that is no intent, when it was received, and its newest status."""

    request: BehaviourRequest
    clock: str
    status: RequestStatus | None = None


@dataclass(slots=True)
class RequestLog:
    """Logs requests with their operators and outcomes; the stream of a stick counts as one.

    Parameters
    ----------
    expires
        Returns whether a behaviour is an intent.
    title
        Returns the title of a behaviour.
    """

    log: EventLog
    expires: Callable[[str], bool]
    title: Callable[[str], str] = str
    _asked: Recent[str, AskedRequest] = field(default_factory=lambda: Recent(REMEMBERED))
    _requests: OrderedDict[str, RequestRecord] = field(default_factory=OrderedDict)
    _newest: OrderedDict[str, RequestStatus] = field(default_factory=OrderedDict)
    _streams: OrderedDict[tuple[str, ...], float] = field(default_factory=OrderedDict)

    def add_request(self, request: BehaviourRequest, now_s: float) -> None:
        """Log a request; copies of it change nothing."""
        if request.id in self._requests:
            return
        operator = request.operator or request.source
        intent = self.expires(request.behaviour)
        self._requests[request.id] = RequestRecord(operator, request.robots, intent, request.behaviour)
        _bound(self._requests)
        if intent and not self._begins((operator, request.behaviour), now_s):
            return
        text = f"{operator}: {self._title(request.behaviour)} for {named(request.robots)}"
        request_id = "" if intent else request.id
        self.log.add(now_s, "request", text, request.robots, request_id=request_id, by=operator)
        if not intent:
            self._asked[request.id] = AskedRequest(request, self.log.entries[-1].clock)

    def asked(self, request_id: str) -> AskedRequest | None:
        """Return a request that was received, if it is no intent; None: it was not, or is forgotten."""
        return self._asked.get(request_id)

    def of_robot(self, robot: str) -> list[dict[str, str]]:
        """Return the newest requests that concern a robot, each with its outcome there, the newest first."""
        found: list[dict[str, str]] = []
        for each in reversed(self._asked.values()):
            status, request = each.status, each.request
            if robot not in (request.robots if status is None else (*status.robots, *status.left_out)):
                continue
            outcome, why = _outcome(status, robot)
            found.append(
                {
                    "clock": each.clock, "behaviour": request.behaviour, "operator": request.operator or request.source,
                    "outcome": outcome, "code": str(why.code), "reason": worded(why, "page"),
                }
            )  # fmt: skip
            if len(found) == SHOWN_REQUESTS:
                break
        return found

    def _title(self, behaviour: str) -> str:
        return "stop" if behaviour == STOP else self.title(behaviour)

    def add_stop(self, order_id: str, act: str, operator: str) -> None:
        """Note a stop or an e-stop, which ends requests by its id."""
        self._requests[order_id] = RequestRecord(operator, (), False, act, halts=True)
        _bound(self._requests)

    def operator_of(self, request_id: str) -> str:
        """Return the operator of a request; empty if the request was not received."""
        record = self._requests.get(request_id)
        return record.operator if record else ""

    def add_status(self, status: RequestStatus, now_s: float) -> bool:
        """Log a status of the core; return whether the page shall get it. A repeated status is not logged."""
        record = self._requests.get(status.request_id)
        if record is not None and record.intent:
            # Twenty a second: only a refusal is logged, and not each time.
            stream = (record.operator, status.behaviour, status.reason)
            if status.phase != "refused" or not self._begins(stream, now_s):
                return False
            self._log(status, record.operator, now_s)
            return True
        plain, before = msgspec.structs.replace(status, stamp_s=0.0), self._newest.get(status.request_id)
        if plain == before:
            return False
        self._newest[status.request_id] = plain
        _bound(self._newest)
        if status.request_id in self._asked:
            self._asked[status.request_id].status = status
        halted = record is None and status.behaviour == "stop"  # a stop or an e-stop: logged already
        if not halted and (before is None or (before.phase, before.refused_by) != (status.phase, status.refused_by)):
            self._log(status, record.operator if record else "", now_s)
        return True

    def _begins(self, stream: tuple[str, ...], now_s: float) -> bool:
        """Return whether a stream was at rest for a while, and note that it no longer is."""
        before_s = self._streams.get(stream)
        self._streams[stream] = now_s
        _bound(self._streams)
        return before_s is None or now_s - before_s > STREAM_GAP_S

    def readable(self, status: RequestStatus) -> str:
        """Return the reason for the page, with behaviour and operator of another request in place of its id."""
        if status.code == Code.PARAMETERS:
            return status.parameters.get("problems", status.reason)  # the form lists all parameters
        if status.code not in SUPERSEDED:
            return for_page(status)
        record = self._requests.get(status.parameters.get("by", ""))
        if record is None:
            return "replaced by another request"
        if record.halts:
            return f"ended by {record.behaviour} of {record.operator}"
        return f"replaced by {self._title(record.behaviour)} of {record.operator}"

    def _log(self, status: RequestStatus, operator: str, now_s: float) -> None:
        because = f": {self.readable(status)}" if status.reason else ""
        title = self._title(status.behaviour)
        if status.phase == "refused":
            text = f"{title} refused{because}"
        elif status.refused_by:
            text = f"{title} refused by {named(status.refused_by)}{because}"
        elif status.phase in ("accepted", "scheduled"):
            return  # the request itself was a line
        elif status.phase == "running":
            count = f"{len(status.running)} of {len(status.robots)}"
            text = f"{count} stopped" if status.behaviour == STOP else f"{title} runs on {count}"
        elif status.code in SUPERSEDED:
            text = f"{title} {because.removeprefix(': ')}"
        else:
            text = f"{title} {status.phase}{because}"
        kind: LogKind = "refused" if status.phase == "refused" or status.refused_by else "request"
        self.log.add(now_s, kind, text, status.robots, request_id=status.request_id, by=operator)


def for_page(status: RequestStatus) -> str:
    """Return the reason for readers of the page, who have its buttons and maybe no shell."""
    return worded(Reason(status.code, status.reason, status.parameters), "page", status.refused_by)


def _outcome(status: RequestStatus | None, robot: str) -> tuple[str, Reason]:
    """Return what became of a request on one robot, and why."""
    if status is None:
        return "not answered yet", Reason()
    why = Reason(status.code, status.reason, status.parameters)
    if robot in status.refused_by:
        return "refused", why
    if robot in status.left_out:
        return "left out", why
    if result := next((each for each in status.results if each.robot == robot), None):
        return result.outcome, Reason(Code.GIVEN if result.text else "", result.text)
    if status.phase in FINAL_PHASES:
        return "replaced" if status.phase == "superseded" else status.phase, why
    return "runs" if robot in status.running else "sent", Reason()


def named(robots: Sequence[str]) -> str:
    """Return robots as text."""
    if not robots:
        return "the whole swarm"
    more = len(robots) - NAMES_SHOWN
    return ", ".join(robots[:NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _bound(table: OrderedDict[Any, Any]) -> None:
    while len(table) > REMEMBERED:
        table.popitem(last=False)


NO_REASON = "a fault without a reason"


@dataclass(slots=True)
class ChangeLog:
    """Logs each change of hub, core, robots, leases and files under development once."""

    log: EventLog
    _hub: bool | None = None
    _core: bool | None = None
    _silent: dict[str, bool] = field(default_factory=dict)
    _faults: dict[str, str] = field(default_factory=dict)
    _leases: dict[str, str] = field(default_factory=dict)
    # taker → giver, robots
    _handed: Recent[str, tuple[str, frozenset[str]]] = field(default_factory=lambda: Recent(REMEMBERED))
    # file → problem, hosts that reported it
    _reloads: Recent[str, tuple[str, set[str]]] = field(default_factory=lambda: Recent(REMEMBERED))
    # → phase, end, starts
    _processes: Recent[tuple[str, str], tuple[str, str, int]] = field(default_factory=lambda: Recent(REMEMBERED))

    def update(self, seen: Snapshot, now_s: float) -> None:
        """Log what has changed of hub, core and robots."""
        if seen.connected != self._hub:
            if self._hub is not None or not seen.connected:
                text = "the hub is connected" if seen.connected else "the hub is not connected"
                self.log.add(now_s, "link", text, severity="info" if seen.connected else "error")
            self._hub = seen.connected
        age_s = core_age_s(seen)
        core = age_s is not None and age_s <= SILENT_S
        if core != self._core:
            if self._core is not None:
                text = "the core is running" if core else "the core is silent"
                self.log.add(now_s, "link", text, severity="info" if core else "error")
            self._core = core
        self._supervised(seen, now_s)
        self._robots(seen, now_s)

    def _supervised(self, seen: Snapshot, now_s: float) -> None:
        """Log processes that freeze, end, or run again."""
        for row in seen.processes:
            state = row.state
            known, at = (state.phase, state.ended, state.starts), (row.host, state.name)
            before = self._processes.get(at)
            self._processes[at] = known
            if known != before and row.text and (before is not None or state.phase in ("frozen", "ended", "given_up")):
                self.log.add(now_s, "link", row.text)

    def _robots(self, seen: Snapshot, now_s: float) -> None:
        if len(self._silent) > len(seen.robots):
            there = {row.robot for row in seen.robots}
            self._silent = {robot: silent for robot, silent in self._silent.items() if robot in there}
            self._faults = {robot: fault for robot, fault in self._faults.items() if robot in there}
        gone: list[str] = []
        back: list[str] = []
        faults: dict[str, list[str]] = {}
        for row in seen.robots:
            if row.silent != self._silent.get(row.robot, False):
                (gone if row.silent else back).append(row.robot)
            self._silent[row.robot] = row.silent
            health = row.health
            fault = "" if health is None or row.silent else _fault(health)
            if fault and fault != self._faults.get(row.robot):
                faults.setdefault(fault, []).append(row.robot)
            self._faults[row.robot] = fault
        for fault, robots in faults.items():
            self.log.add(now_s, "fault", f"{named(robots)}: {fault}", tuple(robots))
        for robots, text in ((gone, "silent"), (back, "received again")):
            if robots:
                severity: Severity = "warning" if robots is gone else "info"
                self.log.add(now_s, "link", f"{named(robots)}: {text}", tuple(robots), severity=severity)

    def reloaded(self, message: FileReload, now_s: float) -> None:
        """Log what became of a file that has changed; the other processes with the same report add nothing."""
        problem, hosts = self._reloads.get(message.file, ("", set()))
        if hosts and problem == message.problem and message.host not in hosts and len(hosts) < REMEMBERED:
            hosts.add(message.host)
            return
        self._reloads[message.file] = message.problem, {message.host}
        name = message.file.rpartition("/")[2]
        if message.problem:
            self.log.add(now_s, "fault", f"{name} is not loaded, what ran before goes on: {message.problem}")
        else:
            self.log.add(now_s, "reload", f"{name} is loaded")

    def leased(self, leases: tuple[Lease, ...], now_s: float) -> bool:
        """Log which operator holds which robots; return whether that has changed."""
        before, self._leases = self._leases, {lease.robot: lease.operator for lease in leases}
        if before == self._leases:
            return False
        taken: dict[tuple[str, str], list[str]] = {}
        for robot in sorted({*before, *self._leases}):
            change = before.get(robot, ""), self._leases.get(robot, "")
            if change[0] != change[1]:
                taken.setdefault(change, []).append(robot)
        for (old, new), robots in taken.items():
            names = named(robots)
            if handed := bool(old) and self._handed.get(new) == (old, frozenset(robots)):
                del self._handed[new]
            how = "handed over by" if handed else "taken from"
            text = f"{new} holds {names}" + (f", {how} {old}" if old else "") if new else f"{old} releases {names}"
            severity: Severity = "warning" if new and old and not handed else "info"
            self.log.add(now_s, "lease", text, tuple(robots), by=new or old, severity=severity)
        return True

    def hands_over(self, giver: str, taker: str, robots: Iterable[str]) -> None:
        """Note that robots are handed over: that the taker holds them next is no take-over."""
        self._handed[taker] = giver, frozenset(robots)


def _fault(health: RobotHealth) -> str:
    """Return the fault of a robot, or the error of its control law; empty: it has neither."""
    if health.fault or health.lifecycle == "FAULT":
        return health.fault or NO_REASON
    return health.stop_reason if health.stop_code == Code.LAW else ""
