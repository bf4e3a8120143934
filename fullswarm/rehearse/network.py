"""Simulates the hub and the links to it: what each process publishes reaches the others late, twice, never, or in time.

Faults are injected on paths, a path being the way from one process to another. A message that a process sends to
itself crosses no network.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from fullswarm.bus.base import Delivery, Subscription, matches
from fullswarm.messages import Message
from fullswarm.rehearse.process import SimProcess
from fullswarm.runtime import Runtime

M = TypeVar("M", bound=Message)

LATENCY_S = 0.001
"""From one process through the hub to another on a good network."""
LOSS_SEEN_S = 0.03
"""After the hub's end its clients know that it is gone."""

Observer = Callable[[str, str, str, Message], None]
"""Called with sender, receiver, key and message."""


@dataclass(slots=True)
class Trouble:
    """What is injected on some paths.

    Attributes
    ----------
    between : tells whether a path, from one process to another, is concerned
    loss, duplicate, reorder : shares of the messages
    """

    between: Callable[[str, str], bool]
    cut: bool = False
    loss: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0


@dataclass(slots=True)
class _Path:
    troubles: list[Trouble]
    last_s: float = 0.0


@dataclass(slots=True)
class Counts:
    """What became of the messages between processes."""

    carried: int = 0
    lost: int = 0
    cut: int = 0
    doubled: int = 0
    reordered: int = 0


@dataclass(slots=True)
class Network:
    """The hub and all links.

    Attributes
    ----------
    hub_up : the hub serves
    on_handled : called for each message just before a process handles it
    on_published : called for each message that a process publishes, with an empty receiver
    """

    simulation: Runtime
    chance: random.Random
    on_handled: Observer
    on_published: Observer
    counts: Counts = field(default_factory=Counts)
    hub_up: bool = True
    hub_frozen_until_s: float = 0.0
    hub_ended_s: float = 0.0
    _buses: dict[str, ProcessBus] = field(default_factory=dict)
    _troubles: list[Trouble] = field(default_factory=list)
    _paths: dict[tuple[str, str], _Path] = field(default_factory=dict)
    _routes: dict[str, tuple[ProcessBus, ...]] = field(default_factory=dict)
    _linked: dict[str, float] = field(default_factory=dict)

    def bus_of(self, process: SimProcess) -> ProcessBus:
        """Return a new bus for the present start of a process; the one of an earlier start is cut off."""
        bus = self._buses[process.name] = ProcessBus(self, process)
        self._linked.setdefault(process.name, 0.0)
        self.forget_routes()
        return bus

    def drop(self, name: str) -> None:
        """Forget the bus of a process that has died."""
        self._buses.pop(name, None)
        self.forget_routes()

    def forget_routes(self) -> None:
        """Find the receivers anew: the subscriptions have changed."""
        self._routes.clear()

    def inject(self, trouble: Trouble) -> Callable[[], None]:
        """Inject `trouble` from now on; call what is returned to end it."""
        self._troubles.append(trouble)
        self._refresh()

        def end() -> None:
            self._troubles.remove(trouble)
            self._refresh()

        return end

    def end_hub(self) -> None:
        """Let the hub die."""
        self.hub_up, self.hub_ended_s = False, self.simulation.now_s()

    def start_hub(self, reconnects: Iterable[tuple[str, float]]) -> None:
        """Start the hub again; each process reconnects at a true time of its own."""
        self.hub_up = True
        self._linked.update(reconnects)

    def linked(self, name: str) -> bool:
        """Tell whether messages of a process get through now."""
        return self.hub_up and self.simulation.now_s() >= self._linked.get(name, 0.0)

    def connected(self, name: str) -> bool:
        """Tell what a process knows of its connection: the end of the hub is seen a moment later."""
        if self.hub_up:
            return self.linked(name)
        return self.simulation.now_s() < self.hub_ended_s + LOSS_SEEN_S

    def publish(self, sender: ProcessBus, key: str, message: Message) -> None:
        """Carry one message to all that subscribe to it."""
        route = self._routes.get(key)
        if route is None:
            route = self._routes[key] = tuple(each for each in self._buses.values() if each.wants(key))
        name = sender.process.name
        self.on_published(name, "", key, message)
        linked = self.linked(name)
        for bus in route:
            if bus is sender:
                bus.take(name, key, message)
            elif linked and self.linked(bus.process.name):
                self._carry(name, bus, key, message, max(sender.process.busy_until_s, self.simulation.now_s()))
            else:
                self.counts.cut += 1

    def _carry(self, sender: str, bus: ProcessBus, key: str, message: Message, now_s: float) -> None:
        path = self._paths.get((sender, bus.process.name))
        if path is None:
            path = self._paths[sender, bus.process.name] = _Path(self._troubles_of(sender, bus.process.name))
        counts = self.counts
        counts.carried += 1
        at_s = max(now_s, self.hub_frozen_until_s) + LATENCY_S
        extra_s = 0.0
        for each in path.troubles:
            if each.cut:
                counts.cut += 1
                return
            if each.loss and self.chance.random() < each.loss:
                counts.lost += 1
                return
            if each.delay_s:
                extra_s += each.delay_s + self.chance.uniform(-each.jitter_s, each.jitter_s)
        at_s += extra_s
        for each in path.troubles:
            if each.duplicate and self.chance.random() < each.duplicate:
                counts.doubled += 1
                bus.arrive(at_s + self.chance.uniform(0.0, 0.3), sender, key, message)
            if each.reorder and self.chance.random() < each.reorder:
                counts.reordered += 1
                bus.arrive(at_s + self.chance.uniform(0.0, 0.1), sender, key, message)
                return
        path.last_s = at_s = max(at_s, path.last_s)
        bus.arrive(at_s, sender, key, message)

    def _troubles_of(self, sender: str, receiver: str) -> list[Trouble]:
        return [each for each in self._troubles if each.between(sender, receiver)]

    def _refresh(self) -> None:
        for (sender, receiver), path in self._paths.items():
            path.troubles = self._troubles_of(sender, receiver)


class _Subscription:
    """One handler of a process."""

    def __init__(
        self, bus: ProcessBus, expression: str, kind: type[Message], handler: Callable[[Any], None], latest: bool,
        with_sender: bool,
    ) -> None:  # fmt: skip
        self._bus, self.expression, self.kind, self._handler = bus, expression, kind, handler
        self._latest, self._with_sender = latest, with_sender
        self._waiting: dict[str, tuple[str, Message]] = {}
        self.active = True

    def offer(self, sender: str, key: str, message: Message) -> None:
        """Put a message into the mailbox; with `latest` in the place of one that still waits."""
        if self._latest:
            if key not in self._waiting:
                self._bus.process.runtime.mailbox.put(self._deliver_latest, key)
            self._waiting[key] = sender, message
        else:
            self._bus.process.runtime.mailbox.put(self._deliver, (sender, key, message))

    def _deliver_latest(self, key: str) -> None:
        sender, message = self._waiting.pop(key)
        self._deliver((sender, key, message))

    def _deliver(self, item: tuple[str, str, Message]) -> None:
        sender, key, message = item
        if self.active:
            self._bus.note_handled(sender, key, message)
            self._handler(Delivery(message, sender) if self._with_sender else message)

    def close(self) -> None:
        """Stop delivering."""
        if self.active:
            self.active = False
            self._bus.forget(self)


class ProcessBus:
    """A :class:`~fullswarm.bus.base.SenderBus` of one start of a process."""

    def __init__(self, network: Network, process: SimProcess) -> None:
        self.process = process
        self._network, self._start = network, process.starts
        self._subscriptions: list[_Subscription] = []
        self._routes: dict[str, tuple[_Subscription, ...]] = {}

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        """Send `message` in this process's name."""
        del sender
        if self.process.alive and self.process.starts == self._start:
            self._network.publish(self, key, message)

    def subscribe(
        self, expression: str, kind: type[M], handler: Callable[[M], None], *, latest: bool = False
    ) -> Subscription:
        """Have `handler` called for what arrives; see :class:`~fullswarm.bus.base.Bus`."""
        return self._add(_Subscription(self, expression, kind, handler, latest, with_sender=False))

    def subscribe_with_sender(
        self, expression: str, kind: type[M], handler: Callable[[Delivery[M]], None], *, latest: bool = False
    ) -> Subscription:
        """Have `handler` called for what arrives; see :class:`~fullswarm.bus.base.SenderBus`."""
        return self._add(_Subscription(self, expression, kind, handler, latest, with_sender=True))

    def _add(self, subscription: _Subscription) -> _Subscription:
        self._subscriptions.append(subscription)
        self._changed()
        return subscription

    def forget(self, subscription: _Subscription) -> None:
        """Drop a closed subscription."""
        self._subscriptions.remove(subscription)
        self._changed()

    def _changed(self) -> None:
        self._routes.clear()
        self._network.forget_routes()

    def wants(self, key: str) -> bool:
        """Tell whether it subscribes to a key."""
        return any(matches(each.expression, key) for each in self._subscriptions)

    def arrive(self, at_s: float, sender: str, key: str, message: Message) -> None:
        """Have a message of another process arrive at true time `at_s`."""
        self.process.arrive(at_s, lambda: self.take(sender, key, message))

    def take(self, sender: str, key: str, message: Message) -> None:
        """Put a message into the mailbox, for each subscription."""
        if self.process.starts != self._start:
            return
        route = self._routes.get(key)
        if route is None:
            route = self._routes[key] = tuple(each for each in self._subscriptions if matches(each.expression, key))
        for each in route:
            if isinstance(message, each.kind):
                each.offer(sender, key, message)

    def note_handled(self, sender: str, key: str, message: Message) -> None:
        """Tell the observer that a message is handled now."""
        self._network.on_handled(sender, self.process.name, key, message)

    def connected(self) -> bool:
        """Tell whether the hub is connected, as far as this process knows."""
        return self._network.connected(self.process.name)

    def close(self) -> None:
        """End all subscriptions."""
        for each in tuple(self._subscriptions):
            each.close()
