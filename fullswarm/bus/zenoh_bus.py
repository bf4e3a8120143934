"""The live bus: a zenoh client of the hub behind the interface of every bus.

Messages arrive on zenoh's receive thread, are decoded there and put into the node's mailbox; no Python thread is left
that could keep a process from ending. States of robots are fetched instead, in a process that only shows what robots
tell all else too: a call from a thread that is not Python's costs 14 µs, twice the rest of the way. Messages between
nodes of one process do not touch the network.

On the wire the sender is part of the key: what a node publishes on ``<swarm>/<rest>`` travels as
``<swarm>/<sender>/<rest>``, and a subscription to ``<swarm>/<rest>`` is one to ``<swarm>/*/<rest>``. So a secured hub
can restrict each certificate to its own name.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import math
import os
import threading
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import zenoh

from fullswarm.bus.arrivals import Arrivals
from fullswarm.bus.base import Carried, Delivery, Subscription, matches
from fullswarm.bus.codec import LARGEST_BYTES, decode, encode
from fullswarm.bus.endpoint import DEFAULT_HUB, host_of, is_secured, no_hub
from fullswarm.bus.lanes import Bucket, service_of
from fullswarm.clock import MonotonicClock
from fullswarm.errors import ConfigError, FullswarmError, MessageError, Unreachable
from fullswarm.identity import Credentials
from fullswarm.identity.access import ACCESS_KEY
from fullswarm.identity.binding import Check, check_of
from fullswarm.identity.credentials import UNNAMED
from fullswarm.keys import ANY, ROBOT_ID
from fullswarm.logs import Logger
from fullswarm.messages import Message
from fullswarm.runtime import ROOM, Lane, Mailbox

M = TypeVar("M", bound=Message)

CACHED_KEYS = 1024
"""Keys whose publisher or route is cached: every reply has a key of its own, so the cache is bounded."""

FETCHED, FETCHED_AT_ONCE = 4096, 512
"""Messages that wait to be fetched at most, the newest ones, and those that one call takes."""
SOON_S = 0.005
"""Between two fetches of a subscription: a node wakes up more often than anything new has come."""
MANY_HZ, MANY_S = 1500.0, 0.08
"""In a process that only shows, a subscription that gets more than this rests for so long between two fetches: of 100
robots' states every second one is then never decoded, and pages are sent half as many."""

LOG_S = 1.0
LOGGED_KEYS = 32
"""Most keys that are logged within `LOG_S`, once each: a flood must not fill the log."""

_STEERING = frozenset({"command", "commands", "control_request", "control_requests", "request"})
_STOPPING = frozenset({"stop", "estop", "heartbeat"})

_log = Logger("fullswarm.bus")

RETRY_FIRST_S, RETRY_LAST_S, RETRY_FACTOR = 0.1, 0.5, 2
CLOSE_S = 0.5
"""Longest wait for a session to end: with a frozen hub zenoh itself would take nine seconds."""
LEAVE_S = 1.0
"""Longest wait at the end of the process, which aborts if a thread returns from zenoh into the shutdown."""

ASK_FIRST_S, ASK_TIMEOUT_S = 0.02, 1.0
"""First wait, after a link to a secured hub is up, before it is asked once more whether it admits this process."""
EXPLAIN_AFTER_S, EXPLAIN_EVERY_S = 5.0, 30.0
"""A link to a secured hub that is down so long has its cause looked for, logged once per cause."""

OLD_HEARTBEATS = "*/heartbeat/*"
"""On the wire of versions without the sender's chunk. They and this version do not receive each other's messages."""

_COMMON: dict[str, object] = {
    # No discovery: the default settings join any zenoh on the local network.
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,  # else opening a router waits 0.5 s in vain
    "transport/link/tx/lease": 1000,  # ms; what a node announces: its silence is noticed after this
    # Zenoh's own limit is 1 GB: a receiver would gather that much before anything here sees the message.
    "transport/link/rx/max_message_size": 2 * LARGEST_BYTES,
    # Our messages are small: shared memory saves nothing, costs 16 MB and leaves files after a kill.
    "transport/shared_memory/enabled": False,
}


def config(**settings: object) -> zenoh.Config:
    """Return a zenoh configuration: the common settings, then `settings` (``/`` of a name written ``__``)."""
    result = zenoh.Config()
    renamed = {name.replace("__", "/"): value for name, value in settings.items()}
    for name, value in (_COMMON | renamed).items():
        result.insert_json5(name, json.dumps(value))
    return result


def untyped(method: Callable[[], object]) -> None:
    """Call a method that zenoh's stubs leave without types."""
    method()


def reason_of(error: zenoh.ZError) -> str:
    """Return zenoh's error text, without the place in its sources."""
    return str(error).split(" at /")[0]


def wire_key(key: str, sender: str) -> str:
    """Return a node's key, or key expression, as it is on the wire: with the chunk of the sender after the swarm's."""
    swarm, slash, rest = key.partition("/")
    return f"{swarm}/{sender}{slash}{rest}"


def client_config(
    hub: str, *, multicast: bool, credentials: Credentials | None = None, **settings: object
) -> zenoh.Config:
    """Return the configuration of a client of the hub at the endpoint `hub`; further `settings` as in :func:`config`.

    Raises
    ------
    ConfigError
        The hub is secured and there are no credentials, or they can never work.
    """
    secured: dict[str, object] = {}
    if is_secured(hub):
        from fullswarm.bus.tls import link_settings

        if credentials is None:
            raise ConfigError(
                "this hub is secured, and this program has no certificate",
                where=hub,
                hint="make one with `fullswarm keys issue NAME --role ROLE`",
            )
        secured = link_settings(credentials, listens=False)
    return config(
        **secured,
        **settings,
        mode="client",
        connect__endpoints=[hub],
        connect__retry={
            "period_init_ms": round(RETRY_FIRST_S * 1000),
            "period_max_ms": round(RETRY_LAST_S * 1000),
            "period_increase_factor": RETRY_FACTOR,
        },
        scouting__multicast__enabled=multicast,
    )


class HubLink:
    """Opens a client's session as soon as the hub answers, watches the link, closes it at the end.

    One daemon thread does all that may block. `up` is true while the link is connected; zenoh's transport events set
    it, so that reading it costs nothing. After a loss zenoh connects again by itself and restores what was
    declared.

    Parameters
    ----------
    hub
        Endpoint of the hub.
    multicast
        Also search for routers by multicast.
    credentials
        Of a secured hub, else None. Then `up` also means that the hub has admitted this process: it links to every
        certificate of its authority, and passes on nothing of one that its list does not have.
    on_open
        Called once, on the link's thread, with the open session and before `up` becomes true.
    settings
        Of zenoh, in addition, as in :func:`config`.

    Raises
    ------
    ConfigError
        The hub is secured and there are no credentials, or they can never work.
    """

    def __init__(
        self,
        hub: str,
        *,
        multicast: bool,
        on_open: Callable[[zenoh.Session], None],
        credentials: Credentials | None = None,
        **settings: object,
    ) -> None:
        self.hub, self.up = hub, False
        self._on_open, self._credentials = on_open, credentials if is_secured(hub) else None
        self._config = client_config(hub, multicast=multicast, credentials=credentials, **settings)
        self._routers: set[str] = set()
        self._admitted = self._credentials is None
        self._logged = ""
        self._lock = threading.Lock()
        self._is_up, self._closing, self._changed = threading.Event(), threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._serve, name="fullswarm-bus", daemon=True)
        # Without it a message that arrives while the interpreter shuts down finds no interpreter.
        atexit.register(self._leave)
        self._thread.start()

    def _serve(self) -> None:
        session = self._open()
        if session is None:
            return
        try:
            if not self._closing.is_set():
                self._on_open(session)
                listener = zenoh.handlers.Callback(self._on_event, indirect=False)
                session.info.declare_transport_events_listener(listener, history=True)
            if self._credentials is None:
                self._closing.wait()
            else:
                self._ask_for_access(session)
        finally:
            untyped(session.close)

    def _open(self) -> zenoh.Session | None:
        delay_s, failed_s = RETRY_FIRST_S, 0.0
        while not self._closing.is_set():
            try:
                return zenoh.open(self._config)
            except zenoh.ZError:  # no hub listens there yet, or one that refuses this client
                if failed_s >= EXPLAIN_AFTER_S:
                    self._log_cause()
                    failed_s -= EXPLAIN_EVERY_S
                self._closing.wait(delay_s)
                failed_s += delay_s
                delay_s = min(delay_s * RETRY_FACTOR, RETRY_LAST_S)
        return None

    def _ask_for_access(self, session: zenoh.Session) -> None:
        """Ask after each connection whether the hub's list has this certificate, until it has."""
        down_s, delay_s = 0.0, ASK_FIRST_S
        while not self._closing.is_set():
            with self._lock:
                linked, admitted = bool(self._routers), self._admitted
                self._changed.clear()
            if linked and (admitted or self._ask(session)):
                self._changed.wait()
                down_s, delay_s = 0.0, ASK_FIRST_S
                continue
            if down_s >= EXPLAIN_AFTER_S:
                self._log_cause()
                down_s -= EXPLAIN_EVERY_S
            if self._changed.wait(delay_s):
                delay_s = ASK_FIRST_S
            else:
                down_s, delay_s = down_s + delay_s, min(delay_s * RETRY_FACTOR, RETRY_LAST_S)

    def _ask(self, session: zenoh.Session) -> bool:
        if not any(reply.ok is not None for reply in session.get(ACCESS_KEY, timeout=ASK_TIMEOUT_S)):
            return False
        with self._lock:
            if self._changed.is_set():  # the link that the answer came through is gone
                return False
            self._admitted, self._logged = True, ""
            self._set_up()
        return True

    def _log_cause(self) -> None:
        cause = str(self._cause() or "")
        if cause and cause != self._logged and not self._closing.is_set():
            _log.warning("not connected to the hub", cause=cause)
            self._logged = cause

    def _cause(self) -> FullswarmError | None:
        """Return why there is no connection, as far as it shows. Connects to the hub on its own for that."""
        from fullswarm.bus.tls import explain, not_in_list

        if self._credentials is not None and self._routers:
            return not_in_list(self._credentials, self.hub)
        return explain(self.hub, self._credentials)

    def _on_event(self, event: zenoh.TransportEvent) -> None:
        """Record a transport that connected or disconnected; runs on zenoh's threads."""
        zid = str(event.transport.zid)
        with self._lock:
            if event.kind == zenoh.SampleKind.PUT:
                self._routers.add(zid)
            else:
                self._routers.discard(zid)
            self._admitted = self._credentials is None
            self._set_up()
            self._changed.set()

    def _set_up(self) -> None:
        self.up = bool(self._routers) and self._admitted and not self._closing.is_set()
        if self.up:
            self._is_up.set()
        else:
            self._is_up.clear()

    def wait(self, timeout_s: float) -> None:
        """Return once the link is connected.

        Raises
        ------
        Unreachable
            It is not within `timeout_s`, or the link is closed. Names the cause, if the hub is there and refuses.
        """
        if self._closing.is_set():
            raise Unreachable("this bus is closed", where=self.hub)
        if not self._is_up.wait(timeout_s):
            cause = self._cause()
            if cause is not None:
                raise cause
            raise no_hub(self.hub)

    def close(self) -> None:
        """End the session; return within `CLOSE_S` even when the hub is frozen. Closing twice is fine."""
        self._closing.set()
        self._changed.set()
        with self._lock:
            self.up = False
            self._is_up.clear()
        self._thread.join(CLOSE_S)
        if not self._thread.is_alive():
            atexit.unregister(self._leave)

    def _leave(self) -> None:
        self.close()
        self._thread.join(LEAVE_S)


class Origin(NamedTuple):
    """What the key of a message on the wire says: the sender's name, and the check of messages that it publishes."""

    sender: str
    check: Check | None
    bucket: Bucket | None = None  # limits the rate; None: there is no limit


class Inbox:
    """One handler's interest in a key expression. Zenoh may call :meth:`receive` on several threads at once.

    Parameters
    ----------
    mailbox
        Where the messages wait for the node.
    expression, kind, handler
        The keys, the type to decode, the function to call.
    latest
        Keep one message per key: a newer one takes the place of one that still waits.
    with_sender
        Give the handler a :class:`~fullswarm.bus.base.Delivery` in place of the message.
    at_once
        Run the handler on zenoh's thread when the node is idle (see :meth:`Mailbox.run_now`).
    fetched
        Have the mailbox fetch messages of other processes in place of that; only with `latest`.
    rests_s
        How long to wait between two fetches where many messages come.
    secured
        The hub guarantees the sender's name: check all fields of messages that depend on it.
    on_bad
        Called with the key and the error of a message that is dropped.
    on_close
        Called once, by :meth:`close`.

    Raises
    ------
    ConfigError
        `expression` is not a key expression.
    """

    def __init__(
        self,
        mailbox: Mailbox,
        expression: str,
        kind: type[Message],
        handler: Callable[[Any], None],
        *,
        latest: bool,
        with_sender: bool,
        at_once: bool,
        fetched: bool,
        rests_s: float,
        secured: bool,
        on_bad: Callable[[str, MessageError], None],
        on_close: Callable[[Inbox], None],
    ) -> None:
        try:
            zenoh.KeyExpr(expression)
        except zenoh.ZError as error:
            raise ConfigError(f"'{expression}' is not a key expression", hint=reason_of(error)) from error
        self.expression, self.kind = expression, kind
        self._mailbox, self._handler, self._latest = mailbox, handler, latest
        self._on_bad, self._on_close = on_bad, on_close
        self._at_once, self._with_sender, self._secured = at_once, with_sender, secured
        self._fetched, self._many_s = fetched and latest, rests_s
        self._service, self._clock = service_of(expression), MonotonicClock()
        self._too_often = MessageError(f"more than {self._service.rate_hz:g} a second of one sender")
        self._full = MessageError(f"the node is behind: {ROOM[self._service.lane]} messages wait")
        self._origins: dict[str, Origin] = {}
        self._waiting: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._declared: zenoh.Subscriber[Any] | None = None
        self._active = True
        self._fetched_s, self._rests_s = -math.inf, 0.0

    def declare(self, session: zenoh.Session) -> None:
        """Subscribe to messages of other processes at the hub. The caller does this once."""
        if not self._active:
            return
        expression = wire_key(self.expression, ANY)
        if self._fetched:
            ring: Any = zenoh.handlers.RingChannel(FETCHED)  # never a FIFO: a full one blocks zenoh's thread
            self._declared = session.declare_subscriber(expression, ring, allowed_origin=zenoh.Locality.REMOTE)
            self._mailbox.add_source(self.fetch)
        else:
            # Direct: zenoh's own handler thread is not a daemon, a process with one would never end.
            callback = zenoh.handlers.Callback(self.receive, indirect=False)
            self._declared = session.declare_subscriber(expression, callback, allowed_origin=zenoh.Locality.REMOTE)

    def fetch(self) -> bool:
        """Deliver the newest message of each key of those that wait; return whether more wait."""
        declared, count = self._declared, 0
        newest: dict[str, tuple[Origin, zenoh.Sample]] = {}
        now_s = self._clock.now_s()
        passed_s = now_s - self._fetched_s
        if passed_s < self._rests_s:
            return False
        with contextlib.suppress(zenoh.ZError):  # another thread closed the bus just now
            while declared is not None and count < FETCHED_AT_ONCE and (sample := declared.try_recv()) is not None:
                count += 1
                key = str(sample.key_expr)
                origin = self._origins.get(key) or self._origin(key)
                if self._admit(key, origin, now_s):
                    newest[key] = origin, sample
        for key, (origin, sample) in newest.items():
            message = self._read(key, origin, sample)
            if message is not None:
                self._deliver(Delivery(message, origin.sender) if self._with_sender else message)
        more = count == FETCHED_AT_ONCE
        rests_s = self._many_s if count > MANY_HZ * passed_s else SOON_S
        self._fetched_s, self._rests_s = now_s, 0.0 if more else rests_s
        return more

    def receive(self, sample: zenoh.Sample) -> None:
        """Take a message from another process."""
        key = str(sample.key_expr)
        origin = self._origins.get(key) or self._origin(key)
        message = self._read(key, origin, sample) if self._admit(key, origin, self._clock.now_s()) else None
        if message is None:
            return
        item = Delivery(message, origin.sender) if self._with_sender else message
        if self._at_once and self._mailbox.run_now(self._deliver, item):
            return
        self._enqueue(key, message, item)

    def _admit(self, key: str, origin: Origin, now_s: float) -> bool:
        """Tell whether its sender may send one more message now."""
        if origin.bucket is None or origin.bucket.take(now_s):
            return True
        self._mailbox.note_drop("rate")
        self._on_bad(key, self._too_often)
        return False

    def _read(self, key: str, origin: Origin, sample: zenoh.Sample) -> Message | None:
        """Return the message; None: it does not fit, which is counted."""
        check = origin.check
        try:
            message = decode(sample.payload.to_bytes(), self.kind)
            if check is not None and (refusal := check(message)):
                raise MessageError(refusal, where=self.kind.__name__)
        except MessageError as error:
            self._on_bad(key, error)
            return None
        return message

    def _enqueue(self, key: str, message: Message, item: Any) -> None:
        """Have an item wait for the node: `message`, or its delivery."""
        service = self._service
        if service.stops and (order_id := getattr(message, "id", "")):  # copies of an order that waits need no place
            self._replace(f"{order_id} {getattr(message, 'engaged', True)}", item)
        elif self._latest:
            self._replace(key, item)
        else:
            self._mailbox.put_into(service.lane, self._deliver, item, self._lost, always=service.stops)

    def _lost(self, _: Any) -> None:
        self._on_bad(self.expression, self._full)

    def _lost_key(self, key: str) -> None:
        with self._lock:
            self._waiting.pop(key, None)
        self._on_bad(key, self._full)

    def _origin(self, key: str) -> Origin:
        _, _, rest = key.partition("/")
        name, _, rest = rest.partition("/")
        sender = "" if name == UNNAMED else name
        with self._lock:
            if len(self._origins) >= CACHED_KEYS:
                self._origins.clear()
            bucket = Bucket(self._service.rate_hz, self._clock.now_s()) if self._service.rate_hz > 0.0 else None
            check = check_of(rest, sender, secured=self._secured)
            self._origins[key] = origin = Origin(sender, check, bucket)
        return origin

    def offer(self, key: str, message: Message, sender: str) -> None:
        """Take a message of the same process, as it is."""
        if not isinstance(message, self.kind):
            error = MessageError(f"got {type(message).__name__}", where=self.kind.__name__)
            self._on_bad(key, error)
            return
        self._enqueue(key, message, Delivery(message, sender) if self._with_sender else message)

    def _replace(self, key: str, item: Any) -> None:
        with self._lock:
            is_new = key not in self._waiting
            self._waiting[key] = item
        if is_new:
            service = self._service
            self._mailbox.put_into(service.lane, self._deliver_key, key, self._lost_key, always=service.stops)

    def _deliver(self, item: Any) -> None:
        if self._active:
            self._handler(item)

    def _deliver_key(self, key: str) -> None:
        with self._lock:
            item = self._waiting.pop(key, None)
        if self._active and item is not None:
            self._handler(item)

    def close(self) -> None:
        """Stop delivering; closing twice is fine."""
        if not self._active:
            return
        self._active = False
        self._mailbox.remove_source(self.fetch)
        self._on_close(self)

    def undeclare(self) -> None:
        """Withdraw the declaration at the hub."""
        declared, self._declared = self._declared, None
        if declared is not None:
            untyped(declared.undeclare)


ONE_THREAD = "(acc: (handover: app), net: (handover: app), rx: (handover: app), tx: (handover: app))"


def use_one_thread() -> None:
    """Have zenoh do all its work in this process on one thread; to be called before the first session.

    For a process that only collects messages (:meth:`ZenohBus.tap`): each wakes one thread instead of two. Where
    messages are handled on the receiving thread, they would hold up what is sent.
    """
    os.environ.setdefault("ZENOH_RUNTIME", ONE_THREAD)


TAP_ROOM = 5000
"""Messages of one expression that wait to be taken."""


class ZenohTap:
    """Collects all that other processes send on some keys: see :class:`fullswarm.bus.base.Tap`.

    Nothing is woken by a message, and no Python runs for it: zenoh keeps the newest `room` of each expression until
    `take` is called, a few times a second. The times of arrival follow from the times at which the hub passed them on.
    """

    def __init__(self, expressions: Sequence[str], room: int, on_close: Callable[[ZenohTap], None]) -> None:
        self._expressions, self._room, self._on_close = tuple(expressions), room, on_close
        self._clock, self._arrivals = MonotonicClock(), Arrivals()
        self._waiting: list[Carried] = []
        self._declared: list[tuple[int, zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]]] = []
        self._lock = threading.Lock()
        self._active = True
        self.dropped = 0

    def declare(self, session: zenoh.Session) -> None:
        """Subscribe at the hub. The caller does this once."""
        for number, expression in enumerate(self._expressions):
            kept = session.declare_subscriber(
                wire_key(expression, ANY), zenoh.handlers.RingChannel(self._room), allowed_origin=zenoh.Locality.REMOTE
            )
            with self._lock:
                self._declared.append((number, kept))

    def take(self) -> list[Carried]:
        """Return what has come since the last call, in the order of arrival."""
        with self._lock:
            self._collect()
            found, self._waiting = self._waiting, []
        return found

    def _collect(self) -> None:
        """Move what zenoh has kept to what is waiting."""
        samples: list[tuple[int, zenoh.Sample]] = []
        for number, kept in self._declared:
            before = len(samples)
            while len(samples) - before < self._room and (sample := kept.try_recv()) is not None:
                samples.append((number, sample))
            if len(samples) - before == self._room:
                self.dropped += 1  # at least: how many came without room is not known
        times_s = self._arrivals.at([_stamp_s(sample) for _, sample in samples], self._clock.now_s())
        for at_s, (number, sample) in sorted(zip(times_s, samples, strict=True), key=lambda each: each[0]):
            if len(sample.payload) > LARGEST_BYTES:
                self.dropped += 1
                continue
            swarm, _, rest = str(sample.key_expr).partition("/")
            sender, _, rest = rest.partition("/")
            sender = "" if sender == UNNAMED else sender
            self._waiting.append(Carried(number, at_s, f"{swarm}/{rest}", sender, sample.payload.to_bytes()))

    def close(self) -> None:
        """Receive no more; closing twice is fine."""
        if self._active:
            self._active = False
            self._on_close(self)

    def undeclare(self) -> None:
        """Withdraw the declarations at the hub; what has come can still be taken."""
        with self._lock:
            self._collect()
            declared, self._declared = self._declared, []
        for _, each in declared:
            untyped(each.undeclare)


def _stamp_s(sample: zenoh.Sample) -> float:
    """Return when the hub passed a message on, on its clock; NaN: it has not said so."""
    stamp = sample.timestamp
    return math.nan if stamp is None else stamp.get_time().timestamp()


def is_urgent(key: str) -> bool:
    """Tell whether messages of `key` start, steer or stop robots.

    They have priority on the link, and an idle node handles them on the receiving thread, as it does with states.
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
        Endpoint of the hub, ``tcp/<host>:<port>``, or ``tls/<host>:<port>`` if it is secured.
    credentials
        Of a secured hub: the certificate's name is the sender of all that this bus publishes.
    multicast
        Also search for routers by multicast; off, because it joins any zenoh on the network.
    only_shows
        The process shows what robots tell and need not act on it: messages of which only the newest counts wait until
        the runtime fetches them, up to :data:`~fullswarm.runtime.FETCH_S`, and cost less. Heartbeats never wait.

    Attributes
    ----------
    dropped : int
        Messages that came in and were not of the type, version, form or range that was subscribed to, or named
        another host, robot or operator than their sender.
    unsent : int
        Messages published while no hub was connected.

    Raises
    ------
    ConfigError
        `hub` is not an address, or a secured one and there are no credentials, or they can never work.
    """

    def __init__(
        self,
        mailbox: Mailbox,
        *,
        hub: str = DEFAULT_HUB,
        credentials: Credentials | None = None,
        multicast: bool = False,
        only_shows: bool = False,
    ) -> None:
        host_of(hub)
        self._secured, self._only_shows = is_secured(hub), only_shows
        self._name = credentials.name if credentials is not None and self._secured else ""
        self.dropped = self.unsent = 0
        self._mailbox = mailbox
        self._inboxes: list[Inbox] = []
        self._taps: list[ZenohTap] = []
        self._routes: dict[str, tuple[Inbox, ...]] = {}
        self._publishers: dict[tuple[str, str], zenoh.Publisher] = {}
        self._logged: set[str] = set()
        self._clock, self._logged_s = MonotonicClock(), 0.0
        self._session: zenoh.Session | None = None
        self._closed = False
        # Two locks: zenoh's threads count while another thread holds the first one inside zenoh.
        self._lock, self._count_lock = threading.Lock(), threading.Lock()
        self._link = HubLink(hub, multicast=multicast, on_open=self._on_open, credentials=credentials)

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
        name = self._name or sender
        publisher = self._publishers.get((name, key)) or self._publisher(name, key)
        if publisher is None:
            self.unsent += 1
            return
        try:
            publisher.put(encode(message))
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
        service = service_of(expression)
        inbox = Inbox(
            self._mailbox,
            expression,
            kind,
            handler,
            latest=latest,
            with_sender=with_sender,
            at_once=is_urgent(expression) or service.lane is Lane.STATES,
            fetched=service.polled or (self._only_shows and service.lane is not Lane.ORDERS),
            rests_s=MANY_S if self._only_shows else SOON_S,
            secured=self._secured,
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

    def tap(self, expressions: Sequence[str], room: int = TAP_ROOM) -> ZenohTap:
        """Collect all that other processes send on matching keys, unread; the newest `room` of each wait."""
        tap = ZenohTap(expressions, room, self._forget)
        with self._lock:
            if not self._closed:
                self._taps.append(tap)
                if self._session is not None:
                    tap.declare(self._session)
        return tap

    def connected(self) -> bool:
        """Tell whether the hub is connected; false within milliseconds of its end."""
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
            listening: list[Inbox | ZenohTap] = [*self._inboxes, *self._taps]
            self._inboxes, self._taps, self._routes = [], [], {}
        for each in listening:
            each.close()
        self._link.close()

    def _on_open(self, session: zenoh.Session) -> None:
        with self._lock:
            if not self._closed:
                self._session = session
                for inbox in self._inboxes:
                    inbox.declare(session)
                for tap in self._taps:
                    tap.declare(session)
                if not self._secured:
                    callback = zenoh.handlers.Callback(self._on_old_version, indirect=False)
                    session.declare_subscriber(OLD_HEARTBEATS, callback, allowed_origin=zenoh.Locality.REMOTE)

    def _on_old_version(self, sample: zenoh.Sample) -> None:
        self._drop(str(sample.key_expr), MessageError("a process of an older version of fullswarm: update it"))

    def _route(self, key: str) -> tuple[Inbox, ...]:
        with self._lock:
            if len(self._routes) >= CACHED_KEYS:
                self._routes = {}
            route = tuple(each for each in self._inboxes if matches(each.expression, key))
            self._routes[key] = route
        return route

    def _publisher(self, sender: str, key: str) -> zenoh.Publisher | None:
        """Declare a publisher: a put then costs 1 µs instead of 25, and sends nothing while there is no subscriber.

        A sender whose name is not one chunk of a key is published without a name.
        """
        with self._lock:
            if self._session is None:
                return None
            if len(self._publishers) >= CACHED_KEYS:
                untyped(self._publishers.pop(next(iter(self._publishers))).undeclare)
            try:
                publisher = self._session.declare_publisher(
                    wire_key(key, sender if ROBOT_ID.match(sender) else UNNAMED),
                    congestion_control=zenoh.CongestionControl.DROP,  # a slow reader must not stop a control loop
                    priority=zenoh.Priority.REAL_TIME if is_urgent(key) else zenoh.Priority.DATA,
                    allowed_destination=zenoh.Locality.REMOTE,
                )
            except zenoh.ZError as error:  # a key made from another process's message must not end this one
                self._log_once(key, f"cannot publish: {reason_of(error)}")
                return None
            self._publishers[sender, key] = publisher
        return publisher

    def _forget(self, listening: Inbox | ZenohTap) -> None:
        with self._lock:
            if isinstance(listening, ZenohTap):
                if listening not in self._taps:
                    return
                self._taps.remove(listening)
            else:
                if listening not in self._inboxes:
                    return
                self._inboxes.remove(listening)
                self._routes = {}
            listening.undeclare()

    def _drop(self, key: str, error: MessageError) -> None:
        with self._count_lock:
            self.dropped += 1
        self._log_once(key, str(error))

    def _log_once(self, key: str, reason: str) -> None:
        """Log once per key, which names the sender, and second, whatever the rate."""
        now_s = self._clock.now_s()
        with self._count_lock:
            if now_s - self._logged_s >= LOG_S:
                self._logged.clear()
                self._logged_s = now_s
            if key in self._logged or len(self._logged) >= LOGGED_KEYS:
                return
            self._logged.add(key)
        _log.warning("message dropped", key=key, reason=reason, dropped=self.dropped)
