"""A bus that counts what goes through it: one per process, around the real one."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from fullswarm.bus.base import Bus, Subscription
from fullswarm.messages import Message

M = TypeVar("M", bound=Message)


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
