"""The live bus: a zenoh client of the hub behind the interface that every node knows.

Messages arrive on zenoh's receive thread, are decoded there and put into the node's mailbox; no Python thread
is left that could keep a process from ending. Messages between nodes of one process do not touch the network.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import structlog
import zenoh

from fullswarm.bus.base import Delivery, Subscription, matches
from fullswarm.bus.codec import encode
from fullswarm.bus.endpoint import DEFAULT_HUB, host_of
from fullswarm.bus.inbox import Inbox
from fullswarm.bus.session import HubLink, reason_of, untyped
from fullswarm.clock import MonotonicClock
from fullswarm.errors import MessageError
from fullswarm.messages import Message
from fullswarm.runtime import Mailbox

M = TypeVar("M", bound=Message)

CACHED_KEYS = 1024
"""Keys whose publisher or route is remembered: every reply has a key of its own, so it must end."""

COMPLAIN_S = 1.0
COMPLAINTS = 32
"""Keys at most that are complained of within `COMPLAIN_S`, once each: a flood must not fill the log."""

_STEERING = frozenset({"command", "commands", "control_request", "control_requests", "request"})
_STOPPING = frozenset({"stop", "estop", "heartbeat"})

_log = structlog.get_logger("fullswarm.bus")


def is_urgent(key: str) -> bool:
    """Tell whether messages of `key` start, steer or stop robots.

    They overtake others on the link, and an idle node handles them on the thread that brings them.
    """
    topic, _, rest = key.partition("/")[2].partition("/")
    if topic in ("robot", "behaviour"):
        return rest.rpartition("/")[2] in _STEERING
    return topic in _STOPPING


class ZenohBus:
    """Publish and subscribe through a hub, which may come, go and come back at any time.

    The constructor returns at once; a thread connects. Own subscribers get a message even without a hub, as on
    a :class:`~fullswarm.bus.local.LocalBus`; to other processes it is then lost, and counted in `unsent`.

    Parameters
    ----------
    mailbox
        The runtime's.
    hub
        Endpoint of the hub, ``tcp/<host>:<port>``.
    multicast
        Also search for routers by multicast; off, because it joins any zenoh on the network.

    Attributes
    ----------
    dropped : int
        Messages that came in and were not of the type, version, form or range that was subscribed to.
    unsent : int
        Messages published while no hub was connected.

    Raises
    ------
    ConfigError
        `hub` is not an address.
    """

    def __init__(self, mailbox: Mailbox, *, hub: str = DEFAULT_HUB, multicast: bool = False) -> None:
        host_of(hub)
        self.dropped = self.unsent = 0
        self._mailbox = mailbox
        self._inboxes: list[Inbox] = []
        self._routes: dict[str, tuple[Inbox, ...]] = {}
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._complained: set[str] = set()
        self._clock, self._complaints_s = MonotonicClock(), 0.0
        self._session: zenoh.Session | None = None
        self._closed = False
        # Two locks: zenoh's threads count while another thread holds the first one inside zenoh.
        self._lock, self._count_lock = threading.Lock(), threading.Lock()
        self._link = HubLink(hub, multicast=multicast, on_open=self._on_open)

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        """Hand `message` to own subscribers and to the hub; about 2 µs, never blocks."""
        if self._closed:
            return
        route = self._routes.get(key)
        for inbox in self._route(key) if route is None else route:
            inbox.offer(key, message, sender)
        if not self._link.up:
            self.unsent += 1
            return
        publisher = self._publishers.get(key) or self._publisher(key)
        if publisher is None:
            self.unsent += 1
            return
        try:
            publisher.put(encode(message), attachment=sender or None)
        except zenoh.ZError:  # another thread closed the bus just now
            self.unsent += 1

    def subscribe(
        self, expression: str, kind: type[M], handler: Callable[[M], None], *, latest: bool = False
    ) -> Subscription:
        """Deliver messages of type `kind` on matching keys to `handler`; see :class:`~fullswarm.bus.base.Bus`."""
        return self._listen(expression, kind, handler, latest, with_sender=False)

    def subscribe_with_sender(
        self, expression: str, kind: type[M], handler: Callable[[Delivery[M]], None], *, latest: bool = False
    ) -> Subscription:
        """Deliver messages and their senders to `handler`; see :class:`~fullswarm.bus.base.SenderBus`."""
        return self._listen(expression, kind, handler, latest, with_sender=True)

    def _listen(
        self, expression: str, kind: type[M], handler: Callable[[Any], None], latest: bool, *, with_sender: bool
    ) -> Inbox:
        inbox = Inbox(
            self._mailbox,
            expression,
            kind,
            handler,
            latest=latest,
            with_sender=with_sender,
            urgent=is_urgent(expression),
            on_bad=self._drop,
            on_close=self._forget,
        )
        with self._lock:
            if not self._closed:
                self._inboxes.append(inbox)
                self._routes = {}
                if self._session is not None:
                    inbox.declare(self._session)
        return inbox

    def connected(self) -> bool:
        """Tell whether the link to the hub stands; false within milliseconds of the hub's death."""
        return self._link.up

    def wait_connected(self, timeout_s: float) -> None:
        """Return once the hub is connected.

        Raises
        ------
        Unreachable
            No hub answered within `timeout_s`, or the bus is closed.
        """
        self._link.wait(timeout_s)

    def close(self) -> None:
        """End all subscriptions and leave the hub; at most 0.5 s. Closing twice is fine."""
        with self._lock:
            self._closed, self._session = True, None
            inboxes, self._inboxes, self._routes = self._inboxes, [], {}
        for inbox in inboxes:
            inbox.close()
        self._link.close()

    def _on_open(self, session: zenoh.Session) -> None:
        with self._lock:
            if not self._closed:
                self._session = session
                for inbox in self._inboxes:
                    inbox.declare(session)

    def _route(self, key: str) -> tuple[Inbox, ...]:
        with self._lock:
            if len(self._routes) >= CACHED_KEYS:
                self._routes = {}
            route = tuple(each for each in self._inboxes if matches(each.expression, key))
            self._routes[key] = route
        return route

    def _publisher(self, key: str) -> zenoh.Publisher | None:
        """Declare a publisher: a put then costs 1 µs instead of 25, and stays here while there is no subscriber."""
        with self._lock:
            if self._session is None:
                return None
            if len(self._publishers) >= CACHED_KEYS:
                untyped(self._publishers.pop(next(iter(self._publishers))).undeclare)
            try:
                publisher = self._session.declare_publisher(
                    key,
                    congestion_control=zenoh.CongestionControl.DROP,  # a slow reader must not stop a control loop
                    priority=zenoh.Priority.REAL_TIME if is_urgent(key) else zenoh.Priority.DATA,
                    allowed_destination=zenoh.Locality.REMOTE,
                )
            except zenoh.ZError as error:  # a key made from what a stranger sent must not end this process
                self._complain(key, f"cannot publish: {reason_of(error)}")
                return None
            self._publishers[key] = publisher
        return publisher

    def _forget(self, inbox: Inbox) -> None:
        with self._lock:
            if inbox not in self._inboxes:
                return
            self._inboxes.remove(inbox)
            self._routes = {}
            inbox.undeclare()

    def _drop(self, key: str, error: MessageError) -> None:
        with self._count_lock:
            self.dropped += 1
        self._complain(key, str(error))

    def _complain(self, key: str, reason: str) -> None:
        """Log once per key, which names the sender, and second, whatever the rate."""
        now_s = self._clock.now_s()
        with self._count_lock:
            if now_s - self._complaints_s >= COMPLAIN_S:
                self._complained.clear()
                self._complaints_s = now_s
            if key in self._complained or len(self._complained) >= COMPLAINTS:
                return
            self._complained.add(key)
        _log.warning("message dropped", key=key, reason=reason, dropped=self.dropped)
