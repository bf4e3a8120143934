"""Injected faults of the network: their text, ``loss=20%,partition=r1+r2|*@5s-10s``, and a bus that carries them out.

The faulty bus stands between a process and its bus, and acts where messages arrive, so that each receiver loses others.
Nothing is exempt: not the e-stop, not the heartbeat. What a process sends to itself does not cross a network and is
left alone.
"""

from __future__ import annotations

import math
import random
import re
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

from fullswarm.bus.base import Delivery, SenderBus, Subscription
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.messages import Message
from fullswarm.runtime import Scheduler

M = TypeVar("M", bound=Message)
Deliver = Callable[[], None]

DETOUR_S = 0.05
"""Longest extra delay of a reordered message."""

EXAMPLE = "loss=20%,delay=100ms±50,partition=r1+r2|*"
OTHERS = "*"
"""In a partition: all processes that are not named."""
LONGEST_S = 60.0
"""Longest delay that can be given."""

_SHARE = re.compile(r"(\d+(?:\.\d*)?|\.\d+)(%?)\Z")
_TIME = re.compile(r"(\d+(?:\.\d*)?|\.\d+)(ms|s)?\Z")
_NAME = re.compile(r"(?:[A-Za-z0-9_-]{1,64}|\*)\Z")
_UNIT_S = {"ms": 0.001, "s": 1.0}


@dataclass(frozen=True, slots=True)
class Partition:
    """Processes on different sides receive nothing from each other from `start_s` to `end_s`.

    Parameters
    ----------
    sides
        Names of processes; ``*`` means all that no side names. A process on no side receives all.
    """

    sides: tuple[frozenset[str], ...]
    start_s: float = 0.0
    end_s: float = math.inf

    def parts(self, one: str, other: str, time_s: float) -> bool:
        """Tell whether two processes are cut off from each other at `time_s`."""
        if not self.start_s <= time_s < self.end_s:
            return False
        here, there = self._side(one), self._side(other)
        return here is not None and there is not None and here != there

    def _side(self, name: str) -> int | None:
        rest = None
        for index, side in enumerate(self.sides):
            if name in side:
                return index
            if OTHERS in side:
                rest = index
        return rest


@dataclass(frozen=True, slots=True)
class Network:
    """The injected faults that every message is subject to between two processes, drawn for each receiver.

    Attributes
    ----------
    loss
        Share of the messages that do not arrive, 0 to 1.
    delay_s, jitter_s
        They arrive ``delay_s ± jitter_s`` later, evenly spread, in the order in which they were sent.
    duplicate
        Share that arrives once more, with a delay of its own.
    reorder
        Share that is delivered out of order: up to `DETOUR_S` later than the others.
    partitions
        Which processes are cut off from each other, and when.
    """

    loss: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    partitions: tuple[Partition, ...] = ()

    @property
    def names(self) -> frozenset[str]:
        """Every process that a partition names."""
        return frozenset(name for each in self.partitions for side in each.sides for name in side) - {OTHERS}


def parse_network(text: str, where: str = "--network") -> Network:
    """Read conditions separated by commas, e.g. ``loss=20%,delay=100ms±50,partition=r1+r2|*@5s-10s``.

    Raises
    ------
    ConfigError
        Says which condition, at which character of `text`, what is wrong with it.
    """
    values: dict[str, float] = {}
    partitions: list[Partition] = []
    at = 0
    for part in text.split(","):
        column = at + len(part) - len(part.lstrip()) + 1
        at += len(part) + 1
        try:
            _take(part.strip(), values, partitions)
        except ConfigError as error:
            place = f"'{part.strip()}' at character {column}" if part.strip() else f"'{text}'"
            raise ConfigError(error.what, where=f"{where}: {place}" if where else place, hint=error.hint) from None
    if values.get("jitter_s", 0.0) > values.get("delay_s", 0.0):
        raise ConfigError(
            "the jitter is longer than the delay: some messages would arrive before they are sent",
            where=f"{where}: '{text}'" if where else f"'{text}'",
            hint="delay=100ms±50 is 50 to 150 ms",
        )
    return Network(**values, partitions=tuple(partitions))


def check_names(network: Network, known: Iterable[str], where: str = "--network") -> None:
    """Refuse a partition that names a process that is not `known`.

    Raises
    ------
    ConfigError
        Names it.
    """
    known = tuple(known)
    for name in sorted(network.names - set(known)):
        raise ConfigError(
            f"the partition names '{name}', which is not a process of this swarm", where=where,
            hint=did_you_mean(name, known),
        )  # fmt: skip


def _take(part: str, values: dict[str, float], partitions: list[Partition]) -> None:
    """Add one condition to what has been read."""
    if not part:
        raise ConfigError("there is no condition between the commas", hint=f"for example {EXAMPLE}")
    key, equals, value = (each.strip() for each in part.partition("="))
    if key not in _READ and key != "partition":
        raise ConfigError(f"'{key}' is not a condition of a network", hint=did_you_mean(key, [*_READ, "partition"]))
    if not equals or not value:
        raise ConfigError("a value is missing", hint=f"for example {EXAMPLE}")
    if key == "partition":
        partitions.append(_partition(value))
        return
    for name, number in _READ[key](key, value).items():
        if name in values:
            raise ConfigError(f"{name.removesuffix('_s')} is given twice")
        values[name] = number


def _share(key: str, value: str) -> dict[str, float]:
    match = _SHARE.match(value)
    share = math.nan if match is None else float(match[1]) / (100.0 if match[2] else 1.0)
    if not 0.0 <= share <= 1.0:
        raise ConfigError(f"'{value}' is not a share", hint="write 0% to 100%, or 0.0 to 1.0")
    return {key: share}


def _delay(key: str, value: str) -> dict[str, float]:
    del key
    middle, sign, spread = value.replace("+-", "±").partition("±")
    delay_s, unit = _time(middle.strip())
    if not sign:
        return {"delay_s": delay_s}
    return {"delay_s": delay_s, "jitter_s": _time(spread.strip(), unit)[0]}


def _jitter(key: str, value: str) -> dict[str, float]:
    del key
    return {"jitter_s": _time(value)[0]}


def _time(value: str, unit: str = "") -> tuple[float, str]:
    """Return seconds, and the unit they were given in; `unit` is that of a number that has none."""
    match = _TIME.match(value)
    if match is None:
        raise ConfigError(f"'{value}' is not a time", hint="for example 100ms or 0.1s")
    unit = match[2] or unit
    if not unit:
        raise ConfigError(f"'{value}' has no unit", hint=f"{value}ms or {value}s?")
    seconds = float(match[1]) * _UNIT_S[unit]
    if seconds > LONGEST_S:
        raise ConfigError(f"'{value}' is too long", hint=f"{LONGEST_S:g}s at most")
    return seconds, unit


def _partition(value: str) -> Partition:
    sides_text, at, when = value.partition("@")
    sides = [tuple(name.strip() for name in side.split("+")) for side in sides_text.split("|")]
    if len(sides) < 2:
        raise ConfigError("a partition needs two sides", hint="r1+r2|* cuts r1 and r2 off from all others")
    names = [name for side in sides for name in side]
    for name in names:
        if not _NAME.match(name):
            what = f"'{name}' cannot name a process" if name else "a side of the partition is empty"
            raise ConfigError(what, hint="names with '+' between them, sides with '|': r1+r2|*")
        if names.count(name) > 1:
            raise ConfigError(f"'{name}' is named twice: it can be on one side only")
    start_s, end_s = _span(when) if at else (0.0, math.inf)
    return Partition(tuple(frozenset(side) for side in sides), start_s, end_s)


def _span(when: str) -> tuple[float, float]:
    """Read ``5s-10s``, or ``5s`` and ``5s-``: from then on."""
    first, _, last = when.partition("-")
    start_s, unit = _moment(first.strip())
    end_s = _moment(last.strip(), unit)[0] if last.strip() else math.inf
    if end_s <= start_s:
        raise ConfigError(f"'{when}' ends before it begins", hint="for example @5s-10s")
    return start_s, end_s


def _moment(value: str, unit: str = "") -> tuple[float, str]:
    match = _TIME.match(value)
    if match is None or not (match[2] or unit):
        raise ConfigError(f"'{value}' is not a time since the start", hint="for example @5s-10s")
    unit = match[2] or unit
    return float(match[1]) * _UNIT_S[unit], unit


_READ: dict[str, Callable[[str, str], dict[str, float]]] = {
    "loss": _share,
    "delay": _delay,
    "jitter": _jitter,
    "duplicate": _share,
    "reorder": _share,
}


def faulty(
    bus: SenderBus, scheduler: Scheduler, spec: Network | str, seed: int, name: str, since_s: float = 0.0
) -> SenderBus:
    """Return `bus` as process `name` has it with the injected faults `spec`.

    Parameters
    ----------
    spec
        Faults, or their text such as ``loss=20%,delay=100ms±50``.
    seed
        With a simulated clock the same seed gives the same run, to the byte.
    name
        A robot's id, ``core``, ``centralised``, ``operator`` or ``world``.
    since_s
        Scheduler's time that is zero for the times of a partition.

    Raises
    ------
    ConfigError
        `spec` is a text that does not parse.
    """
    network = parse_network(spec) if isinstance(spec, str) else spec
    return FaultyBus(bus, scheduler, network, seed, name, since_s)


@dataclass(slots=True)
class Counts:
    """Number of messages from other processes by what became of them."""

    sent: int = 0  # that would have arrived here on a good network
    lost: int = 0  # by chance
    cut: int = 0  # by a partition
    doubled: int = 0


class Link:
    """The connection from one process to another: decides loss, delay and order of each message.

    Parameters
    ----------
    chance
        A generator of its own, so that the faults here do not depend on other traffic.
    """

    def __init__(self, network: Network, scheduler: Scheduler, chance: random.Random, counts: Counts) -> None:
        self._network, self._scheduler, self._chance, self._counts = network, scheduler, chance, counts
        self._slow = network.delay_s + network.jitter_s > 0.0
        self._last_s = 0.0
        self._waiting: deque[Deliver] = deque()

    def carry(self, deliver: Deliver) -> None:
        """Call `deliver` when the message arrives, twice if it is doubled, or never."""
        network, chance = self._network, self._chance
        if network.loss and chance.random() < network.loss:
            self._counts.lost += 1
            return
        if network.duplicate and chance.random() < network.duplicate:
            self._counts.doubled += 1
            self._detour(deliver)
        if network.reorder and chance.random() < network.reorder:
            self._detour(deliver)
        elif self._slow:
            self._queue(deliver)
        else:
            deliver()

    def _queue(self, deliver: Deliver) -> None:
        """Deliver in the order of sending: a message with a short delay waits for those before."""
        now_s = self._scheduler.now_s()
        self._last_s = max(self._last_s, now_s + self._delay_s())
        self._waiting.append(deliver)
        self._scheduler.after(self._last_s - now_s, self._arrive)

    def _arrive(self) -> None:
        # The first in the queue, not the one this timer was set for: rounding may swap two timers of one moment.
        self._waiting.popleft()()

    def _detour(self, deliver: Deliver) -> None:
        self._scheduler.after(self._delay_s() + self._chance.uniform(0.0, DETOUR_S), deliver)

    def _delay_s(self) -> float:
        network = self._network
        if not network.jitter_s:
            return network.delay_s
        return network.delay_s + self._chance.uniform(-network.jitter_s, network.jitter_s)


@dataclass(slots=True, eq=False)
class _Interest:
    """All handlers for one expression: a message reaches a process once, however many of its nodes subscribe."""

    handlers: list[Callable[[Any], None]] = field(default_factory=list)
    inner: Subscription | None = None

    def deliver(self, sent: Delivery[Any]) -> None:
        for handler in tuple(self.handlers):
            if handler in self.handlers:  # one of those before may have closed it
                handler(sent)


Interests = dict[tuple[str, type[Message], bool], _Interest]


class _Share:
    """One handler's share in an interest; the last one to close ends it."""

    def __init__(self, interests: Interests, key: tuple[str, type[Message], bool], handler: Callable[[Any], None]):
        # Not the handler itself: the same one may be subscribed twice.
        self._interests, self._key, self._handler = interests, key, lambda sent: handler(sent)
        interests[key].handlers.append(self._handler)

    def close(self) -> None:
        interest = self._interests.get(self._key)
        if interest is None or self._handler not in interest.handlers:
            return
        interest.handlers.remove(self._handler)
        if not interest.handlers:
            del self._interests[self._key]
            if interest.inner is not None:
                interest.inner.close()


class FaultyBus:
    """A :class:`~fullswarm.bus.base.Bus` around another; see :func:`faulty`.

    Attributes
    ----------
    counts : what became of the messages of other processes
    """

    def __init__(
        self, bus: SenderBus, scheduler: Scheduler, network: Network, seed: int, name: str, since_s: float = 0.0
    ) -> None:
        self.counts = Counts()
        self._bus, self._scheduler, self._network = bus, scheduler, network
        self._seed, self._name, self._since_s = seed, name, since_s
        self._links: dict[str, Link] = {}
        self._interests: Interests = {}

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        """Send `message`; faults are injected where it arrives."""
        self._bus.publish(key, message, sender=sender or self._name)

    def subscribe(
        self, expression: str, kind: type[M], handler: Callable[[M], None], *, latest: bool = False
    ) -> Subscription:
        """Have `handler` called for what arrives; see :class:`~fullswarm.bus.base.Bus`."""
        return self.subscribe_with_sender(expression, kind, lambda sent: handler(sent.message), latest=latest)

    def subscribe_with_sender(
        self, expression: str, kind: type[M], handler: Callable[[Delivery[M]], None], *, latest: bool = False
    ) -> Subscription:
        """Have `handler` called for what arrives; see :class:`~fullswarm.bus.base.SenderBus`."""
        key = (expression, kind, latest)
        if key in self._interests:
            return _Share(self._interests, key, handler)
        interest = self._interests[key] = _Interest()
        share = _Share(self._interests, key, handler)
        try:
            receive = partial(self._receive, interest)
            interest.inner = self._bus.subscribe_with_sender(expression, kind, receive, latest=latest)
        except BaseException:
            share.close()
            raise
        return share

    def _receive(self, interest: _Interest, sent: Delivery[Any]) -> None:
        sender = sent.sender
        if sender == self._name:
            interest.deliver(sent)
            return
        self.counts.sent += 1
        time_s = self._scheduler.now_s() - self._since_s
        if any(each.parts(sender, self._name, time_s) for each in self._network.partitions):
            self.counts.cut += 1
            return
        self._link(sender).carry(partial(interest.deliver, sent))

    def _link(self, sender: str) -> Link:
        link = self._links.get(sender)
        if link is None:
            chance = random.Random(f"{self._seed}:{sender}>{self._name}")  # noqa: S311  (repeats, keeps no secret)
            link = self._links[sender] = Link(self._network, self._scheduler, chance, self.counts)
        return link

    def connected(self) -> bool:
        """Tell whether the hub is connected: injected faults do not show here."""
        return self._bus.connected()

    def close(self) -> None:
        """Close the bus inside; delayed messages are dropped."""
        for interest in self._interests.values():
            interest.handlers.clear()
        self._interests.clear()
        self._bus.close()
