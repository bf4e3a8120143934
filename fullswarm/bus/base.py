"""The interface of a bus, its wrappers that name the sender or count messages, the matching of key expressions."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Generic, NamedTuple, Protocol, TypeVar

from fullswarm.messages import Message

M = TypeVar("M", bound=Message)

CORE, CENTRALISED, OPERATOR, WORLD = "core", "centralised", "operator", "world"
PROCESSES = (CORE, CENTRALISED, OPERATOR, WORLD)
"""Senders that are not a robot's agent; an agent's name is the robot's id."""


class Delivery(NamedTuple, Generic[M]):
    """A message and the name of the process that published it; empty: the publisher states none."""

    message: M
    sender: str


class Carried(NamedTuple):
    """A message as it is on the wire: its key without the sender, who published it, its bytes (`bus/codec.py`).

    `number` is that of the expression it came by, `arrival_s` when it came, on this machine's monotonic clock.
    """

    number: int
    arrival_s: float
    key: str
    sender: str
    data: bytes


class Tap(Protocol):
    """A standing interest in all that comes on some keys, whatever it is.

    Attributes
    ----------
    dropped : messages that were too long, or found no room because `take` was not called; at least
    """

    dropped: int

    def take(self) -> list[Carried]:
        """Return what has come since the last call, in the order of arrival."""
        ...

    def close(self) -> None:
        """Receive no more. Closing twice is fine."""
        ...


class Subscription(Protocol):
    """A standing interest in a key expression."""

    def close(self) -> None:
        """Stop delivering; what is already in the mailbox may still arrive. Closing twice is fine."""
        ...


class Bus(Protocol):
    """Publish/subscribe between nodes. Handlers run on the runtime's thread, in order per publisher."""

    def publish(self, key: str, message: Message) -> None:
        """Send `message` to all subscribers of a matching expression. Never blocks; may lose when cut off."""
        ...

    def subscribe(
        self, expression: str, kind: type[M], handler: Callable[[M], None], *, latest: bool = False
    ) -> Subscription:
        """Have `handler` called for each message of type `kind` on a key that matches `expression`.

        With `latest` only the newest message of each key is kept while the node is busy (states); without,
        each one is delivered (requests). A message that does not decode is dropped and counted.
        """
        ...

    def connected(self) -> bool:
        """Tell whether others can be reached now (the hub is connected; always true within one process)."""
        ...

    def close(self) -> None:
        """End all subscriptions and leave. Publishing afterwards does nothing. Closing twice is fine."""
        ...


class SenderBus(Bus, Protocol):
    """A bus that carries the name of the publishing process beside each message."""

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        """Send `message` in the name of the process `sender`; see :class:`Bus`."""
        ...

    def subscribe_with_sender(
        self, expression: str, kind: type[M], handler: Callable[[Delivery[M]], None], *, latest: bool = False
    ) -> Subscription:
        """Have `handler` called with message and sender; see :meth:`Bus.subscribe`."""
        ...


class NamedBus:
    """A bus as the process `name` uses it: everything that it publishes carries this name."""

    def __init__(self, bus: SenderBus, name: str) -> None:
        self._bus, self._name = bus, name

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        """Send `message`; see :class:`SenderBus`."""
        self._bus.publish(key, message, sender=sender or self._name)

    def subscribe(
        self, expression: str, kind: type[M], handler: Callable[[M], None], *, latest: bool = False
    ) -> Subscription:
        """Have `handler` called; see :class:`Bus`."""
        return self._bus.subscribe(expression, kind, handler, latest=latest)

    def subscribe_with_sender(
        self, expression: str, kind: type[M], handler: Callable[[Delivery[M]], None], *, latest: bool = False
    ) -> Subscription:
        """Have `handler` called with message and sender; see :class:`SenderBus`."""
        return self._bus.subscribe_with_sender(expression, kind, handler, latest=latest)

    def connected(self) -> bool:
        """Tell whether others can be reached now."""
        return self._bus.connected()

    def close(self) -> None:
        """Close the bus inside."""
        self._bus.close()


class CountingBus:
    """Passes everything on.

    Attributes
    ----------
    sent, received : messages published through it, and delivered to subscribers through it
    """

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.sent = self.received = 0

    def publish(self, key: str, message: Message) -> None:
        """Send `message` to all subscribers of a matching key."""
        self.sent += 1
        self._bus.publish(key, message)

    def subscribe(
        self, expression: str, kind: type[M], handler: Callable[[M], None], *, latest: bool = False
    ) -> Subscription:
        """Deliver messages of type `kind` on matching keys to `handler`."""

        def count(message: M) -> None:
            self.received += 1
            handler(message)

        return self._bus.subscribe(expression, kind, count, latest=latest)

    def connected(self) -> bool:
        """Tell whether others can be reached."""
        return self._bus.connected()

    def close(self) -> None:
        """End all subscriptions."""
        self._bus.close()


@functools.lru_cache(maxsize=4096)
def matches(expression: str, key: str) -> bool:
    """Tell whether a key matches an expression: ``*`` is one chunk, ``**`` any number, none included."""
    return _match(expression.split("/"), key.split("/"))


def _match(expression: list[str], key: list[str]) -> bool:
    if not expression:
        return not key
    if expression[0] == "**":
        return any(_match(expression[1:], key[start:]) for start in range(len(key) + 1))
    return bool(key) and expression[0] in ("*", key[0]) and _match(expression[1:], key[1:])
