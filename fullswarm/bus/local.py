"""The bus within one process: every message is delivered once, in the order of publishing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from fullswarm.bus.base import Delivery, Subscription, matches
from fullswarm.messages import Message
from fullswarm.runtime import Mailbox

M = TypeVar("M", bound=Message)

CACHED_KEYS = 4096
"""Keys whose subscribers are cached: every reply has a key of its own."""


class _Subscription:
    def __init__(
        self, bus: LocalBus, expression: str, kind: type[Message], handler: Callable[[Any], None], with_sender: bool
    ) -> None:
        self._bus, self.expression, self.kind, self._handler = bus, expression, kind, handler
        self.with_sender, self.active = with_sender, True

    def __call__(self, item: Any) -> None:  # a message, or a `Delivery` with_sender
        if self.active:
            self._handler(item)

    def close(self) -> None:
        if self.active:
            self.active = False
            self._bus.forget(self)


class LocalBus:
    """A bus for nodes that share one runtime. Messages are immutable, so they are passed on as they are.

    A message waits in the mailbox until the runtime delivers it: a publisher never runs a subscriber's code on
    its own stack, as on the real bus. Nothing is ever skipped, so ``latest`` needs no slot.
    """

    def __init__(self, mailbox: Mailbox) -> None:
        self._mailbox = mailbox
        self._subscriptions: list[_Subscription] = []
        self._routes: dict[str, tuple[_Subscription, ...]] = {}
        self._closed = False
        self._onlooker: Callable[[str, Message, str], None] | None = None

    def show(self, onlooker: Callable[[str, Message, str], None]) -> None:
        """Call `onlooker` with key, message and sender of each message, when it is published."""
        self._onlooker = onlooker

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        """Put `message` into the mailbox once per matching subscription, in the order of subscribing."""
        if self._closed:
            return
        if self._onlooker is not None:
            self._onlooker(key, message, sender)
        route = self._routes.get(key)
        if route is None:
            if len(self._routes) >= CACHED_KEYS:
                self._routes.clear()
            route = tuple(each for each in self._subscriptions if matches(each.expression, key))
            self._routes[key] = route
        for subscription in route:
            if isinstance(message, subscription.kind):
                self._mailbox.put(subscription, Delivery(message, sender) if subscription.with_sender else message)

    def subscribe(
        self, expression: str, kind: type[M], handler: Callable[[M], None], *, latest: bool = False
    ) -> Subscription:
        """Deliver messages of type `kind` on matching keys to `handler`."""
        del latest
        return self._add(_Subscription(self, expression, kind, handler, with_sender=False))

    def subscribe_with_sender(
        self, expression: str, kind: type[M], handler: Callable[[Delivery[M]], None], *, latest: bool = False
    ) -> Subscription:
        """Deliver messages of type `kind` on matching keys to `handler`, each with its sender's name."""
        del latest
        return self._add(_Subscription(self, expression, kind, handler, with_sender=True))

    def _add(self, subscription: _Subscription) -> _Subscription:
        self._subscriptions.append(subscription)
        self._routes.clear()
        return subscription

    def forget(self, subscription: _Subscription) -> None:
        """Drop a closed subscription."""
        self._subscriptions.remove(subscription)
        self._routes.clear()

    def connected(self) -> bool:
        """Return True until closed."""
        return not self._closed

    def close(self) -> None:
        """End all subscriptions."""
        self._closed = True
        for subscription in list(self._subscriptions):
            subscription.close()
