"""Sends what control laws broadcast, takes in what their neighbours broadcast, and keeps the shared tables in step.

A robot broadcasts at most `SAYS_HZ` times per second: the newest values that its control law gave, and what is new in
its table. It takes in what robots of the same team with the same control law broadcast, from within range by the
sender's known position. A robot whose behaviour does neither subscribes to nothing and sends nothing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import structlog

from fullswarm import registry
from fullswarm.agent.messaging.declaration import Layout, layout_of, range_m, rate_hz
from fullswarm.agent.messaging.received import Heard, Received
from fullswarm.agent.messaging.table import Merge, ReplicatedTable, SharedTable
from fullswarm.agent.messaging.throttle import Throttle
from fullswarm.agent.neighbours.estimates import CellSubscriptions, Neighbours
from fullswarm.agent.orders.tasks import Tasks
from fullswarm.agent.state import AgentState
from fullswarm.bus.base import Bus
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Flags, Index
from fullswarm.keys import Keys, cell_of
from fullswarm.messages import SAYS_HZ, BehaviourBroadcast, BroadcastValues, TableUpdate
from fullswarm.reasons import NONE, Code, Reason, reason
from fullswarm.runtime import Scheduler

log = structlog.get_logger()

DIGEST_S = 0.5
"""How often a table's digest is broadcast, also if nothing is new: what was lost is found by it."""
ANEW_S = 1.0
"""A sender of which nothing arrived for so long may count from below: its agent was restarted."""
NAMED_S = 2.0
"""So long a sender that exceeds its rate stays in the health reports."""

LARGEST_VALUE = 1e300
"""Of what a message can carry."""

Topic = tuple[int, str]
"""Team and control law: robots that have both in common receive each other's broadcasts."""


@dataclass(slots=True)
class Conversation:
    """What the own robots of one topic exchange. Arrays have a row per own robot."""

    module: Any  # of the control law
    layout: Layout | None
    merges: dict[str, Merge]
    reach_m: float
    rate_hz: float
    outbox: Array = field(init=False)  # (n, width) what each is to broadcast next
    pending: Flags = field(init=False)
    received: Received | None = field(init=False, default=None)


class Replica(NamedTuple):
    """The table of one robot, and of which task: a new one begins with an empty table."""

    table: ReplicatedTable
    topic: Topic
    since_s: float


class Counts(NamedTuple):
    """Broadcasts of single robots, since the start."""

    sent: int
    received: int
    dropped: int  # beyond their senders' rates


class Exchange:
    """The broadcasts of one agent's robots.

    Parameters
    ----------
    sensing_m : range of broadcasts that no parameter `says_m` states
    period_s : of the control laws
    stride_m : so far a robot moves between two calls of `follow`

    Attributes
    ----------
    flooding : sender → since when, and why some of its messages were dropped
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, host: str, ids: Sequence[str], cell_m: float,
        state: AgentState, tasks: Tasks, neighbours: Neighbours, sensing_m: float, period_s: float, stride_m: float,
    ) -> None:  # fmt: skip
        self._bus, self._keys, self._scheduler, self._host, self._ids = bus, keys, scheduler, host, ids
        self._cell_m, self._state, self._tasks, self._neighbours = cell_m, state, tasks, neighbours
        self._sensing_m, self._early_s, self._stride_m = sensing_m, 0.4 * period_s, stride_m
        self._subscriptions = CellSubscriptions(bus, keys.broadcast, BehaviourBroadcast, cell_m, self._on_broadcast)
        self._conversations: dict[Topic, Conversation] = {}
        self._channels: dict[int, Channel] = {}  # by the first robot
        self._replicas: dict[int, Replica] = {}
        self._sent_s = np.full(len(ids), -math.inf)
        self._digest_s = np.full(len(ids), -math.inf)
        self._interval_s = np.full(len(ids), 1.0 / SAYS_HZ)
        self._throttle = Throttle()
        self._row = {robot: row for row, robot in enumerate(ids)}
        self._newest = np.zeros((0, 2))  # of each sender: sequence, arrival
        self._sequence = itertools.count(1)
        self._sent = self._received = 0
        self.flooding: dict[str, tuple[float, Reason]] = {}

    # ------------------------------------------------------------------ for the control laws
    def channel(self, rows: Index | None) -> Channel:
        """Return what the robots `rows` (None: all) of one call of a control law say and hear through."""
        if rows is None:
            rows = np.arange(len(self._ids))
        first = int(rows[0])
        task, found = self._tasks.of[first], self._channels.get(first)
        if task is None:
            raise ConfigError("a robot without a task broadcasts nothing")
        topic, limits = (task.request.team, task.law), _limits(task.request.parameters)
        module = registry.law_module(task.law)
        if (
            found is None or found.topic != topic or found.limits != limits or not np.array_equal(found.rows, rows)
            or self._conversations.get(topic) is not found.conversation or found.conversation.module is not module
        ):  # fmt: skip
            conversation = self._open(topic, module, *limits)
            self._interval_s[rows] = 1.0 / conversation.rate_hz
            found = Channel(self, topic, limits, conversation, rows, task.request.members)
            self._channels[first] = found
        return found

    def _open(self, topic: Topic, module: Any, reach_m: float, rate_hz: float) -> Conversation:
        found = self._conversations.get(topic)
        if found is None or found.module is not module:  # another one: a law under development
            layout, count = layout_of(module), len(self._ids)
            found = Conversation(module, layout, getattr(module, "MERGE", {}), reach_m, rate_hz)
            if layout is not None:
                found.outbox, found.pending = np.zeros((count, layout.width)), np.zeros(count, bool)
                found.received = Received(layout, rate_hz)
            self._conversations[topic] = found
        found.reach_m, found.rate_hz = reach_m or self._sensing_m, rate_hz
        self.follow()
        return found

    def heard(self, conversation: Conversation, rows: Index, members: Sequence[str]) -> Heard:
        """Return what robots have received from senders within range."""
        received, neighbours, now_s = conversation.received, self._neighbours, self._scheduler.now_s()
        if received is None:
            raise ConfigError("view.heard: the control law declares no class Says")
        position = np.ascontiguousarray(self._state.pose[:, :2])
        start, other = neighbours.within(position, conversation.reach_m, self._tasks.team)
        pairs = [other[start[row] : start[row + 1]] for row in rows.tolist()]
        of, senders = np.repeat(np.arange(len(rows)), [len(each) for each in pairs]), np.concatenate(pairs)
        received.cover(neighbours.count)
        age_s = now_s - received.arrival_s[senders]
        fresh = age_s <= received.expiry_s
        of, senders, age_s = of[fresh], senders[fresh], age_s[fresh]
        offset = neighbours.predicted[senders] - position[rows][of]
        distance = np.hypot(offset[:, 0], offset[:, 1])
        age_s += neighbours.delay_s[senders]
        return Heard(len(rows), of, offset, distance, senders, received, age_s, neighbours.names, members)

    def table_of(self, topic: Topic, conversation: Conversation, row: int) -> ReplicatedTable:
        """Return the replica of robot `row`; an empty one if its task has just begun."""
        since_s = float(self._tasks.since_s[row])
        found = self._replicas.get(row)
        if found is None or found.topic != topic or found.since_s != since_s:
            found = Replica(ReplicatedTable(self._ids[row], conversation.merges), topic, since_s)
            self._replicas[row] = found
            self._digest_s[row] = -math.inf
        return found.table

    # ------------------------------------------------------------------ what goes out
    def send(self) -> None:
        """Broadcast for the robots that may, after the control laws; one message per grid cell."""
        if not self._conversations:
            return
        now_s = self._scheduler.now_s()
        due = now_s - self._sent_s >= self._interval_s - self._early_s
        if not due.any():
            return
        cells: dict[str, tuple[list[BroadcastValues], list[TableUpdate]]] = {}
        for topic, conversation in self._conversations.items():
            if conversation.layout is not None:
                rows = [row for row in np.flatnonzero(conversation.pending & due).tolist() if self._runs(row, topic)]
                conversation.pending[rows] = False
                for cell, there in self._by_cell(rows).items():
                    cells.setdefault(cell, ([], []))[0].append(self._values(topic, conversation, there))
        for row, replica in self._replicas.items():
            digest_due = now_s - self._digest_s[row] >= DIGEST_S - self._early_s
            if due[row] and (digest_due or replica.table.unsent) and self._runs(row, replica.topic):
                for cell in self._by_cell([row]):
                    cells.setdefault(cell, ([], []))[1].append(self._update(row, replica, digest_due))
        sequence = next(self._sequence) if cells else 0
        for cell, (values, tables) in cells.items():
            rows = [self._row[robot] for robot in _senders(values, tables)]
            self._sent_s[rows] = now_s
            self._sent += len(rows)
            message = BehaviourBroadcast(
                host=self._host, sequence=sequence, stamp_s=now_s, values=tuple(values), tables=tuple(tables)
            )  # fmt: skip
            self._bus.publish(self._keys.broadcast(cell, self._host), message)

    def _runs(self, row: int, topic: Topic) -> bool:
        task = self._tasks.of[row]
        return task is not None and (task.request.team, task.law) == topic

    def _by_cell(self, rows: list[int]) -> dict[str, list[int]]:
        """Return robots by the grid cell in which they are; one without a pose is in none."""
        cells: dict[str, list[int]] = {}
        for row, (x_m, y_m) in zip(rows, self._state.pose[rows, :2].tolist(), strict=True):
            if math.isfinite(x_m) and math.isfinite(y_m):
                cells.setdefault(cell_of(x_m, y_m, self._cell_m), []).append(row)
        return cells

    def _values(self, topic: Topic, conversation: Conversation, rows: list[int]) -> BroadcastValues:
        layout = conversation.layout
        return BroadcastValues(
            team=topic[0], law=topic[1], robots=tuple(self._ids[row] for row in rows),
            fields={} if layout is None else layout.widths, values=tuple(conversation.outbox[rows].ravel().tolist()),
        )  # fmt: skip

    def _update(self, row: int, replica: Replica, digest_due: bool) -> TableUpdate:
        if digest_due:
            self._digest_s[row] = self._scheduler.now_s()
        entries = replica.table.take()
        team, law = replica.topic
        digest = replica.table.digest if digest_due else ()
        return TableUpdate(robot=self._ids[row], team=team, law=law, entries=entries, digest=digest)

    # ------------------------------------------------------------------ what comes in
    def _on_broadcast(self, message: BehaviourBroadcast) -> None:
        if message.host == self._host and len(self._ids) == 1:
            return
        values = [each for each in message.values if self._fits(each)]
        tables = [each for each in message.tables if (each.team, each.law) in self._conversations]
        # A sender without a known place is not within range.
        senders = [robot for robot in _senders(values, tables) if self._neighbours.row_of(robot) >= 0]
        if not senders:
            return
        now_s = self._scheduler.now_s()
        rates = {robot: self._conversations[each.team, each.law].rate_hz for each in values for robot in each.robots}
        rates |= {each.robot: self._conversations[each.team, each.law].rate_hz for each in tables}
        rows = np.array([self._neighbours.row_of(robot) for robot in senders], np.int64)
        taken = self._admit(rows, np.array([rates[robot] for robot in senders]), message.sequence, now_s)
        admitted = {robot: int(row) for robot, row in zip(senders, rows, strict=True) if taken[row]}
        self._received += len(admitted)
        for each in values:
            self._take_values(each, admitted, now_s)
        for update in tables:
            if update.robot in admitted:
                self._take_update(update, admitted[update.robot])

    def _fits(self, part: BroadcastValues) -> bool:
        conversation = self._conversations.get((part.team, part.law))
        layout = None if conversation is None else conversation.layout
        if layout is None or list(part.fields.items()) != list(layout.widths.items()):
            return False
        return len(part.values) == len(part.robots) * layout.width and len(set(part.robots)) == len(part.robots)

    def _admit(self, rows: Index, rate_hz: Array, sequence: int, now_s: float) -> Flags:
        """Tell by the row of a sender whether its message is newer than the last one and within its rate, (m,)."""
        taken = np.zeros(self._neighbours.count, bool)
        if len(self._newest) < len(taken):
            more = 2 * len(taken) - len(self._newest)
            self._newest = np.vstack([self._newest, np.full((more, 2), -math.inf)])
        newest = self._newest[rows]
        new = (sequence > newest[:, 0]) | (now_s - newest[:, 1] > ANEW_S)
        rows = rows[new]
        rows = rows[self._throttle.admit(rows, rate_hz[new], now_s)]
        self._newest[rows] = sequence, now_s
        taken[rows] = True
        return taken

    def _take_values(self, part: BroadcastValues, admitted: dict[str, int], now_s: float) -> None:
        received = self._conversations[part.team, part.law].received
        places = [place for place, robot in enumerate(part.robots) if robot in admitted]
        if received is not None and places:
            table = np.array(part.values).reshape(len(part.robots), -1)[places]
            rows = np.array([admitted[part.robots[place]] for place in places], np.int64)
            received.put(rows, table, now_s)

    def _take_update(self, update: TableUpdate, sender: int) -> None:
        """Have the own robots that are within the sender's range take in its entries."""
        topic = (update.team, update.law)
        reach_m = self._conversations[topic].reach_m
        self._neighbours.refresh(self._scheduler.now_s())
        x_m, y_m = self._neighbours.predicted[sender].tolist()
        for row, replica in self._replicas.items():
            if replica.topic != topic or self._ids[row] == update.robot:
                continue
            own = self._state.pose[row]
            if math.hypot(own[0] - x_m, own[1] - y_m) <= reach_m:  # false for a place that is not known
                replica.table.receive(update.entries)
                if update.digest:
                    replica.table.compare(update.digest)

    # ------------------------------------------------------------------ now and then
    def follow(self) -> None:
        """Have the subscriptions follow the robots, and forget what belongs to tasks that have ended."""
        topics = {(task.request.team, task.law) for task in self._tasks.of if task is not None}
        for topic in self._conversations.keys() - topics:
            del self._conversations[topic]
        for row, channel in list(self._channels.items()):
            if channel.topic not in self._conversations:
                del self._channels[row]
        for row, replica in list(self._replicas.items()):
            if not self._runs(row, replica.topic) or replica.since_s != self._tasks.since_s[row]:
                del self._replicas[row]
        if self._conversations:
            self._subscriptions.follow(self._state.pose[:, :2], self.reach_m + self._stride_m)
        else:
            self._subscriptions.close()

    @property
    def reach_m(self) -> float:
        """The greatest range of a broadcast now; 0: none is expected."""
        return max((each.reach_m for each in self._conversations.values()), default=0.0)

    def watch(self) -> None:
        """Name the senders that exceed their rate, each once per second."""
        now_s = self._scheduler.now_s()
        if self.flooding:
            self.flooding = {name: each for name, each in self.flooding.items() if now_s - each[0] <= NAMED_S}
        if not self._conversations:
            return
        for row, per_s in self._throttle.named(now_s):
            name = self._neighbours.names[row]
            why = reason(Code.FLOOD, robot=name, per_s=f"{per_s:.0f}")
            self.flooding[name] = now_s, why
            log.warning("a robot broadcasts too often; part of it is dropped", robot=name, per_s=round(per_s))

    def note(self, row: int) -> Reason:
        """Return what is wrong with the broadcasts that robot `row` receives; false if nothing is."""
        if not self.flooding or self._tasks.of[row] is None:
            return NONE
        return max(self.flooding.values(), key=lambda each: each[0])[1]

    @property
    def counts(self) -> Counts:
        """What was sent, taken in and dropped."""
        return Counts(self._sent, self._received, self._throttle.dropped)

    def close(self) -> None:
        """Drop the subscriptions."""
        self._subscriptions.close()


def _limits(parameters: dict[str, Any]) -> tuple[float, float]:
    """Return what a request states of its broadcasts: their range, 0 if none, and their rate."""
    return range_m(parameters), rate_hz(parameters)


def _senders(values: Iterable[BroadcastValues], tables: Iterable[TableUpdate]) -> list[str]:
    """Return the robots in a message, each once."""
    return list(dict.fromkeys([robot for each in values for robot in each.robots] + [each.robot for each in tables]))


class Channel:
    """What the robots of one call of a control law say and hear through; see ``View``."""

    def __init__(
        self, exchange: Exchange, topic: Topic, limits: tuple[float, float], conversation: Conversation, rows: Index,
        members: Sequence[str],
    ) -> None:  # fmt: skip
        self.topic, self.limits, self.conversation, self.rows = topic, limits, conversation, rows
        self._exchange, self._members = exchange, members

    def say(self, fields: dict[str, Any]) -> None:
        """Broadcast values at the next opportunity; newer ones replace them. Robots with a NaN broadcast nothing.

        Raises
        ------
        ConfigError
            They are not as the law declares, or infinite.
        """
        layout = self.conversation.layout
        if layout is None:
            raise ConfigError("view.say: the control law declares no class Says")
        values = np.empty((len(self.rows), layout.width))
        layout.write(fields, values)
        if (np.abs(values) > LARGEST_VALUE).any():  # false for NaN
            raise ConfigError("view.say: a value is infinite or too large")
        self.conversation.outbox[self.rows] = values
        self.conversation.pending[self.rows] = ~np.isnan(values).any(axis=1)

    @property
    def heard(self) -> Heard:
        """What they have received."""
        return self._exchange.heard(self.conversation, self.rows, self._members)

    @property
    def table(self) -> SharedTable:
        """The shared table of the request."""
        return SharedTable(self._replica)

    def _replica(self, place: int) -> ReplicatedTable:
        return self._exchange.table_of(self.topic, self.conversation, int(self.rows[place]))
