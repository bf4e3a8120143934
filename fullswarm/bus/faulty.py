"""A bus on a bad network: loses, delays, doubles and reorders what comes in, and cuts processes off from each other.

It stands between a process and its bus, and acts where messages arrive, so that each receiver loses others. Nothing
is exempt: not the e-stop, not the heartbeat. What a process tells itself does not cross a network and is left alone.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

from fullswarm.bus.base import Delivery, SenderBus, Subscription
from fullswarm.bus.network import Network, parse_network
from fullswarm.messages import Message
from fullswarm.runtime import Scheduler

M = TypeVar("M", bound=Message)
Deliver = Callable[[], None]

DETOUR_S = 0.05
"""How much longer at most a message takes that is reordered."""


def faulty(
    bus: SenderBus, scheduler: Scheduler, spec: Network | str, seed: int, name: str, since_s: float = 0.0
) -> SenderBus:
    """Return `bus` as process `name` has it on a network of conditions `spec`.

    Parameters
    ----------
    spec
        Conditions, or their text such as ``loss=20%,delay=100ms±50``.
    seed
        With a simulated clock the same seed gives the same run, to the byte.
    name
        A robot's id, ``core``, ``centralised``, ``operator`` or ``world``.
    since_s
        Scheduler's time from which the times of a partition count.

    Raises
    ------
    ConfigError
        `spec` is a text that does not parse.
    """
    network = parse_network(spec) if isinstance(spec, str) else spec
    return FaultyBus(bus, scheduler, network, seed, name, since_s)


@dataclass(slots=True)
class Counts:
    """What came of the messages of others so far."""

    sent: int = 0  # that would have arrived here on a good network
    lost: int = 0  # by chance
    cut: int = 0  # by a partition
    doubled: int = 0


class Link:
    """The way from one process to another: fate and order of each message.

    Parameters
    ----------
    chance
        Its own, so that what happens here does not depend on the traffic of others.
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
    """All handlers for one expression: a message comes once to a process, however many of its nodes listen."""

    handlers: list[Callable[[Any], None]] = field(default_factory=list)
    inner: Subscription | None = None

    def deliver(self, sent: Delivery[Any]) -> None:
        for handler in tuple(self.handlers):
            if handler in self.handlers:  # one of those before may have closed it
                handler(sent)


Interests = dict[tuple[str, type[Message], bool], _Interest]


class _Share:
    """One handler's share in an interest; the last one that goes ends it."""

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
    counts : what came of the messages of others
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
        """Send `message`; what becomes of it is decided where it arrives."""
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
        """Tell whether the hub is there: a bad network does not say that it is bad."""
        return self._bus.connected()

    def close(self) -> None:
        """Close the bus inside; what is still on its way does not arrive."""
        for interest in self._interests.values():
            interest.handlers.clear()
        self._interests.clear()
        self._bus.close()
