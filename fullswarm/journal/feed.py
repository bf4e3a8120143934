"""Runs nodes again on a journal: the ports give what they gave, and what the nodes do is compared with what they did.

Time does not pass by itself, timers do not fire by themselves: each event of the journal is carried out in its turn.
Where the nodes ask more often than they did (other code), a port repeats its last answer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fullswarm.bus.base import Delivery, Subscription
from fullswarm.bus.codec import decode, encode
from fullswarm.drivers.base import Description, FleetReading, Lifecycle, Pose
from fullswarm.errors import DriverError, MessageError
from fullswarm.journal import ports
from fullswarm.journal.journal import CAUSES, Kind
from fullswarm.journal.readings import ReadingFeed
from fullswarm.kernels import Array
from fullswarm.messages import Message
from fullswarm.runtime import LoopStats, Timer

M = TypeVar("M", bound=Message)
Output = tuple[Any, ...]
OUTPUTS = (Kind.PUBLISH, Kind.COMMAND, Kind.ASK, Kind.RAISED)


@dataclass(slots=True)
class Event:
    """One event: its cause, what came in during it, and what went out.

    Attributes
    ----------
    time_s : the first answer of the clock in it; that of the event before where it did not ask
    """

    number: int
    cause: tuple[Any, ...]
    time_s: float
    nows: deque[float] = field(default_factory=deque)
    answers: dict[str, deque[Any]] = field(default_factory=dict)
    readings: deque[Any] = field(default_factory=deque)
    applied: deque[bytes] = field(default_factory=deque)
    layout: Any = None
    outputs: list[Output] = field(default_factory=list)

    @property
    def commands(self) -> list[Output]:
        """The commands among its outputs."""
        return [each for each in self.outputs if each[0] == Kind.COMMAND]

    def add(self, item: Any) -> None:
        """Add an item. Raises `ValueError` where it is none."""
        if isinstance(item, float):
            if not self.nows:
                self.time_s = item
            self.nows.append(item)
            return
        kind = item[0]
        if kind == Kind.ANSWER:
            self.answers.setdefault(item[1], deque()).append(item[2])
        elif kind == Kind.READING:
            self.readings.append(item)
        elif kind == Kind.LAYOUT:
            self.layout = item[1]
        elif kind == Kind.COMMAND:
            self.outputs.append((Kind.COMMAND, item[1], item[2]))
            self.applied.append(item[3])
        elif kind in OUTPUTS:
            self.outputs.append(_plain(item))
        else:
            raise ValueError(f"an item of kind {kind}")


def _plain(value: Any) -> Any:
    """Return a value as a journal gives it back: lists become tuples."""
    return tuple(_plain(each) for each in value) if isinstance(value, (list, tuple)) else value


def events(items: Iterable[Any]) -> Iterator[Event]:
    """Yield the events of a journal without its head. Raises `ValueError` where an item is none."""
    present: Event | None = None
    number, time_s = 0, float("nan")
    for item in items:
        if isinstance(item, float) or item[0] not in CAUSES:
            if present is not None:
                present.add(item)
            continue
        if present is not None:
            time_s = present.time_s
            yield present
        number += 1
        present = Event(number, _plain(item), time_s)
    if present is not None:
        yield present


class Feed:
    """The event that is carried out now: gives its inputs, collects what the nodes do in it."""

    def __init__(self) -> None:
        self.event = Event(0, (), float("nan"))
        self.outputs: list[Output] = []
        self.timers: dict[str, tuple[Timer, Callable[[], None]]] = {}
        self.handlers: dict[str, Callable[[bytes, str | None], None]] = {}
        self._now_s = 0.0
        self._last: dict[str, Any] = {}

    def now_s(self) -> float:
        """Return the next answer of the clock."""
        if self.event.nows:
            self._now_s = self.event.nows.popleft()
        return self._now_s

    def answer(self, port: str, otherwise: Any = None) -> Any:
        """Return the next answer of a port, its last one where there is no more, or `otherwise`."""
        waiting = self.event.answers.get(port)
        if waiting:
            self._last[port] = waiting.popleft()
        return self._last.get(port, otherwise)

    def run(self, event: Event, calls: dict[str, Callable[[], None]]) -> str:
        """Carry an event out; return what it was meant for that is not there any more, or nothing.

        Parameters
        ----------
        calls : what the process itself called, by name
        """
        self.event, self.outputs = event, []
        kind, name = event.cause[0], str(event.cause[1])
        if event.nows:
            self._now_s = event.nows[0]
        try:
            if kind == Kind.TIMER:
                timer, callback = self.timers.get(name, (None, None))
                if timer is None or callback is None:
                    return f"the timer '{name}'"
                if timer.period_s is None:
                    del self.timers[name]
                callback()
            elif kind == Kind.MESSAGE:
                handler = self.handlers.get(name)
                if handler is None:
                    return f"the subscription '{name}'"
                handler(event.cause[2], event.cause[3])
            elif name in calls:
                calls[name]()
            else:
                return f"the call '{name}'"
        except Exception as error:  # of any kind: it is compared with what was raised then
            self.outputs.append((Kind.RAISED, type(error).__name__, str(error)))
        return ""


class FeedScheduler:
    """A scheduler whose timers fire when they fired."""

    def __init__(self, feed: Feed) -> None:
        self._feed, self._names = feed, ports.Names()

    def now_s(self) -> float:
        """Return what the clock said."""
        return self._feed.now_s()

    def every(self, period_s: float, callback: Callable[[], None], *, first_s: float | None = None) -> Timer:
        """Have `callback` called whenever it was called."""
        del first_s
        return self._add(period_s, callback)

    def after(self, delay_s: float, callback: Callable[[], None]) -> Timer:
        """Have `callback` called if it was called."""
        del delay_s
        return self._add(None, callback)

    def _add(self, period_s: float | None, callback: Callable[[], None]) -> Timer:
        timer = Timer(0.0, period_s, callback)
        self._feed.timers[self._names.of(ports.timer_name(callback))] = timer, callback
        return timer


class _FeedSubscription:
    def __init__(self, feed: Feed, name: str) -> None:
        self._feed, self._name = feed, name

    def close(self) -> None:
        self._feed.handlers.pop(self._name, None)


class FeedBus:
    """A bus that delivers what was delivered."""

    def __init__(self, feed: Feed) -> None:
        self._feed, self._names = feed, ports.Names()

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        """Collect `message`."""
        self._feed.outputs.append((Kind.PUBLISH, key, encode(message), sender))

    def subscribe(
        self, expression: str, kind: type[M], handler: Callable[[M], None], *, latest: bool = False
    ) -> Subscription:
        """Have `handler` called for the messages that it got."""
        del latest
        return self._add(expression, kind, lambda message, _: handler(message))

    def subscribe_with_sender(
        self, expression: str, kind: type[M], handler: Callable[[Delivery[M]], None], *, latest: bool = False
    ) -> Subscription:
        """Have `handler` called for the messages that it got, with their senders."""
        del latest
        return self._add(expression, kind, lambda message, sender: handler(Delivery(message, sender or "")))

    def _add(self, expression: str, kind: type[M], handler: Callable[[M, str | None], None]) -> Subscription:
        name = self._names.of(ports.subscription_name(expression, kind))

        def take(data: bytes, sender: str | None) -> None:
            try:
                message = decode(data, kind)
            except MessageError as error:  # a type of message that has changed since
                raise ValueError(f"a message of then cannot be read now: {error}") from None
            handler(message, sender)

        self._feed.handlers[name] = take
        return _FeedSubscription(self._feed, name)

    def connected(self) -> bool:
        """Return whether it was connected."""
        return bool(self._feed.answer(ports.CONNECTED, True))

    def close(self) -> None:
        """Nothing is open."""


class FeedFleet:
    """Drivers that read and answer what they did."""

    def __init__(self, feed: Feed, ids: tuple[str, ...], urls: tuple[str, ...], found: tuple[Description, ...]) -> None:
        self._feed = feed
        self.ids: tuple[str, ...] = ids
        self.urls: tuple[str, ...] = urls
        self.descriptions: tuple[Description, ...] = found
        self._readings: ReadingFeed | None = None
        self._applied = np.zeros((len(ids), 2))

    def _ask(self, port: str, *arguments: Any) -> None:
        self._feed.outputs.append((Kind.ASK, port, _plain(arguments)))

    def open(self) -> None:
        """Collect the call."""
        self._ask(ports.OPEN)

    def read(self) -> FleetReading:
        """Return what was read."""
        event = self._feed.event
        if event.layout is not None:
            self._readings, event.layout = ReadingFeed(event.layout), None
        if self._readings is None:
            raise ValueError("the journal has no reading yet")
        if event.readings:
            return self._readings.give(event.readings.popleft())
        return self._readings.reading

    def command(self, twists: Array, active: NDArray[np.bool_]) -> Array:
        """Collect a command, and return what was applied."""
        self._feed.outputs.append((Kind.COMMAND, twists.tobytes(), active.tobytes()))
        if self._feed.event.applied:
            self._applied = np.frombuffer(self._feed.event.applied.popleft()).reshape(-1, 2).copy()
        return self._applied

    def lifecycle(self, row: int) -> Lifecycle:
        """Return what it was."""
        del row
        return Lifecycle(self._feed.answer(ports.LIFECYCLE, Lifecycle.CLOSED))

    def fault(self, row: int) -> str:
        """Return what it was."""
        del row
        return str(self._feed.answer(ports.FAULT, ""))

    def fault_code(self, row: int) -> str:
        """Return what it was."""
        del row
        return str(self._feed.answer(ports.FAULT_CODE, ""))

    def firmware(self, row: int) -> str:
        """Return what it was."""
        del row
        return str(self._feed.answer(ports.FIRMWARE, ""))

    def locate(self, row: int, pose: Pose, position_sigma_m: float, heading_sigma_rad: float) -> None:
        """Collect the call."""
        self._ask(ports.LOCATE, row, pose.x_m, pose.y_m, pose.heading_rad, position_sigma_m, heading_sigma_rad)

    def seek_dock(self, row: int) -> bool:
        """Collect the call, and return what it did."""
        self._ask(ports.SEEK_DOCK, row)
        return bool(self._feed.answer(ports.SEEK_DOCK, False))

    def docked(self, row: int) -> bool:
        """Return what it was."""
        del row
        return bool(self._feed.answer(ports.DOCKED, False))

    def actuate(self, row: int, name: str, value: object) -> None:
        """Collect the call, and raise what it raised."""
        self._ask(ports.ACTUATE, row, name, value)
        found = self._feed.answer(ports.ACTUATE)
        if found is not None:
            raise DriverError(found[1]) if found[0] else ValueError(found[1])

    def close(self) -> None:
        """Nothing is open."""


class FeedDisk:
    """A disk that holds what it held, and fails where it failed."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed

    def _answer(self, port: str, otherwise: Any) -> Any:
        found = self._feed.answer(port, otherwise)
        if isinstance(found, list):
            raise OSError(found[0], found[1])
        return found

    def read(self, file: Path) -> bytes:
        """Return what was in the file."""
        del file
        return bytes(self._answer(ports.DISK_READ, b""))

    def exists(self, file: Path) -> bool:
        """Return whether it was there."""
        del file
        return bool(self._answer(ports.DISK_EXISTS, False))

    def write(self, file: Path, content: bytes) -> None:
        """Collect the call."""
        self._change(ports.DISK_WRITE, file, content)

    def replace(self, file: Path, content: bytes) -> None:
        """Collect the call."""
        self._change(ports.DISK_REPLACE, file, content)

    def remove(self, file: Path) -> None:
        """Collect the call."""
        self._change(ports.DISK_REMOVE, file, b"")

    def _change(self, port: str, file: Path, content: bytes) -> None:
        self._feed.outputs.append((Kind.ASK, port, (file.name, content)))
        self._answer(port, None)


def fed_loop(feed: Feed) -> Callable[[], LoopStats]:
    """Return what tells how the loop kept its deadlines then."""

    def found() -> LoopStats:
        ticks, late, missed, worst_late_s, dropped = feed.answer(ports.LOOP, (0, 0, 0, 0.0, {}))
        return LoopStats(ticks, late, missed, worst_late_s, dropped)

    return found


def fed_wall(feed: Feed) -> Callable[[], float]:
    """Return the time of day of then."""
    return lambda: float(feed.answer(ports.WALL, 0.0))
