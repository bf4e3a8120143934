"""Sends requests until answered, stops in a burst, and e-stops until confirmed."""

from __future__ import annotations

import itertools
import uuid
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import (
    FINAL_PHASES,
    STOP,
    BehaviourRequest,
    EStop,
    EStopReceipt,
    Needs,
    RequestStatus,
    StopRequest,
    Value,
)
from fullswarm.operator.estop import EStopOrder
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler, Timer

NOTHING_NEEDED = Needs()
RESEND_S = 0.2
PATIENT_SENDS, SELDOM = 50, 5
"""A request that has been sent so often without an answer is sent at every fifth of these times only: by a few clients
that have waited for a core for long, a core that is back must not be kept busy."""
MOST_ORDERS = 256
"""E-stops whose receipts are followed; the newest count."""
STOP_SENDS = 5
STOP_SPACING_S = 0.1
AFTER_LOSS_SENDS = 20
"""A stop is repeated for two seconds after the hub was lost: the robots may reconnect later than this process."""
STOP_TIMEOUT_S = 10.0

StatusHandler = Callable[[RequestStatus], None]


def short_id() -> str:
    """Return a fresh id: 48 random bits are plenty for one swarm and still fit a log line."""
    return uuid.uuid4().hex[:12]


def due(tick: int, phase: int) -> bool:
    """Tell whether an unanswered message is sent at a tick of `RESEND_S`; `phase` keeps clients apart."""
    return tick < PATIENT_SENDS or (tick + phase) % SELDOM == 0


@dataclass(slots=True)
class PendingRequest:
    """A request and its newest answer, `status`."""

    request: BehaviourRequest
    on_status: StatusHandler | None = None
    status: RequestStatus | None = None
    sent: int = 0
    timer: Timer | None = field(default=None, repr=False)

    @property
    def repeats(self) -> bool:
        """Whether it is sent until it is answered."""
        return self.timer is not None

    def close(self) -> None:
        """Do not send it again. What the core has received goes on."""
        if self.timer is not None:
            self.timer.cancel()


@dataclass(slots=True)
class Burst:
    """A message that is sent a few times because it has no answer.

    `left` is how often it must still be sent; not zero at the end: no hub was connected, and it may not have arrived.
    """

    left: int
    on_done: Callable[[], None] | None = None

    @property
    def done(self) -> bool:
        """Whether all have been sent."""
        return self.left == 0


class Operator:
    """One operator's requests to a swarm. All calls return at once; answers come through the callbacks.

    Parameters
    ----------
    source
        The process that sends; unlike any other's.
    name
        The operator's name, for leases; empty: `source`.
    clock
        The clock that `scheduler` reads, see :func:`~fullswarm.clock.clock_id`; empty: one that only `source` reads.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        source: str,
        *,
        name: str = "",
        clock: str = "",
        new_id: Callable[[], str] = short_id,
    ) -> None:
        self._bus, self._keys, self._scheduler, self.source = bus, keys, scheduler, source
        self.name, self._clock = name or source, clock
        self._new_id = new_id
        self._pending: dict[str, PendingRequest] = {}
        self._orders: Recent[str, EStopOrder] = Recent(MOST_ORDERS)
        self._subscriptions = [
            bus.subscribe(keys.behaviour_status, RequestStatus, self._on_status),
            bus.subscribe(keys.estop_receipt(), EStopReceipt, self._on_receipt),
        ]

    def request(
        self,
        behaviour: str,
        robots: Iterable[str] = (),
        parameters: Mapping[str, Value] | None = None,
        on_status: StatusHandler | None = None,
        *,
        resend: bool = True,
        take: bool = False,
        team: str = "",
        needs: Needs = NOTHING_NEEDED,
        roles: Mapping[str, Iterable[str]] | None = None,
    ) -> PendingRequest:
        """Request `behaviour`; send again every 0.2 s, after 10 s each second, until the core has answered it once.

        No `robots` means the whole swarm. `on_status` receives every status of the request until a final one.
        With ``resend=False`` it is sent once, for streams whose next message replaces this one. With ``take=True``
        the robots are taken over from an operator that holds them.

        Parameters
        ----------
        team : which robots the control law counts as neighbours, ``request``, ``group``, ``@name`` or ``swarm``; empty:
            as the behaviour's record says
        needs : what robots must be able to do, beside what the record needs
        roles : robots, ``@groups`` and ``+capabilities`` of each role
        """
        request = BehaviourRequest(
            id=self._new_id(),
            behaviour=behaviour,
            robots=tuple(robots),
            parameters=dict(parameters or {}),
            team=team,
            needs=needs,
            roles={role: tuple(names) for role, names in (roles or {}).items()},
            source=self.source,
            operator=self.name,
            take=take,
            clock=self._clock,
            stamp_s=self._scheduler.now_s(),
        )
        pending = PendingRequest(request, on_status)
        self._pending[request.id] = pending

        ticks, phase = itertools.count(), zlib.crc32(request.id.encode())

        def send() -> None:
            if due(next(ticks), phase):
                pending.sent += 1
                self._bus.publish(self._keys.behaviour_request, request)

        send()
        if resend:
            pending.timer = self._scheduler.every(RESEND_S, send)
        return pending

    def ask_again(self, pending: PendingRequest) -> None:
        """Have the core repeat the newest status of a request that it has answered: its end may have been missed.

        Only for the core that has answered it, which knows its id; another one might carry it out.
        """
        if pending.status is not None:
            self._bus.publish(self._keys.behaviour_request, pending.request)

    def forget(self, pending: PendingRequest) -> None:
        """Stop sending a request and unsubscribe from its status."""
        pending.close()
        self._pending.pop(pending.request.id, None)

    def stop(self, robots: Iterable[str] = (), on_done: Callable[[], None] | None = None) -> Burst:
        """Stop robots: send five times over 0.4 s with one id, since a stop is not acknowledged.

        While there is no hub it is repeated, for 10 s at most: robots that lost it drive on when it is back.
        """
        self._void_all(robots := tuple(robots), "a stop came before the core received it")
        message = StopRequest(
            id=self._new_id(), robots=robots, source=self.source, clock=self._clock, stamp_s=self._scheduler.now_s()
        )
        # The same for the core alone, with the time: requests that were made before it must not start robots after it.
        dated = BehaviourRequest(
            id=message.id, behaviour=STOP, robots=robots, source=self.source, operator=self.name, clock=self._clock,
            stamp_s=self._scheduler.now_s(),
        )  # fmt: skip

        def send() -> None:
            self._bus.publish(self._keys.stop, message)
            self._bus.publish(self._keys.behaviour_request, dated)

        return self._burst(send, on_done)

    def estop(
        self,
        engaged: bool,
        robots: Iterable[str] = (),
        reason: str = "",
        *,
        known: Callable[[], Iterable[str]] = tuple,
        deadline_s: float = 5.0,
        on_receipt: Callable[[EStopReceipt], None] | None = None,
        on_done: Callable[[EStopOrder], None] | None = None,
    ) -> EStopOrder:
        """Engage or release the latched e-stop; repeat until all robots have confirmed or `deadline_s` is over.

        No `robots` means all: then `known` returns which must confirm; called each time, because robots may
        appear after the order was sent.
        """
        robots = tuple(robots)
        if engaged:
            self._void_all(robots, "an e-stop came before the core received it")
        message = EStop(
            id=self._new_id(), engaged=engaged, robots=robots, source=self.source, reason=reason, clock=self._clock,
            stamp_s=self._scheduler.now_s(),
        )  # fmt: skip
        order = EStopOrder(
            message,
            send=lambda: self._bus.publish(self._keys.estop, message),
            scheduler=self._scheduler,
            known=known,
            deadline_s=deadline_s,
            on_receipt=on_receipt,
            on_done=on_done,
        )
        self._orders[message.id] = order
        order.start()
        return order

    def close(self) -> None:
        """Stop sending and unsubscribe."""
        for pending in self._pending.values():
            pending.close()
        for order in self._orders.values():
            order.close()
        for subscription in self._subscriptions:
            subscription.close()

    def _burst(self, publish: Callable[[], None], on_done: Callable[[], None] | None) -> Burst:
        burst, began_s = Burst(STOP_SENDS, on_done), self._scheduler.now_s()

        def send() -> None:
            publish()
            burst.left = burst.left - 1 if self._bus.connected() else AFTER_LOSS_SENDS
            if not burst.done and self._scheduler.now_s() - began_s < STOP_TIMEOUT_S:
                self._scheduler.after(STOP_SPACING_S, send)
            elif burst.on_done is not None:
                burst.on_done()

        send()
        return burst

    def _on_status(self, status: RequestStatus) -> None:
        pending = self._pending.get(status.request_id)
        if pending is None:
            return
        pending.close()
        if pending.status is None and status.phase != "refused":
            self._overtake(pending)
        pending.status = status
        if status.phase in FINAL_PHASES:
            del self._pending[status.request_id]
        if pending.on_status is not None:
            pending.on_status(status)

    def _overtake(self, newer: PendingRequest) -> None:
        """Void what was requested before `newer` for no other robots and got lost: it must not come after it.

        What was requested for others too is still sent: the core leaves out robots that have something newer.
        """
        robots = newer.request.robots
        for pending in list(itertools.takewhile(lambda each: each is not newer, self._pending.values())):
            theirs = pending.request.robots
            if not robots or (theirs and set(theirs) <= set(robots)):
                self._void(pending, f"{newer.request.id} came before the core received it")

    def _void_all(self, robots: tuple[str, ...], why: str) -> None:
        """Void what concerns any of `robots`; none: all."""
        for pending in list(self._pending.values()):
            theirs = pending.request.robots
            if not robots or not theirs or not set(theirs).isdisjoint(robots):
                self._void(pending, why)

    def _void(self, pending: PendingRequest, why: str) -> None:
        """Stop sending a request that is still unanswered, and notify its caller."""
        if pending.status is not None or not pending.repeats:
            return
        self.forget(pending)
        pending.status = RequestStatus(
            request_id=pending.request.id,
            behaviour=pending.request.behaviour,
            phase="superseded",
            reason=why,
            robots=pending.request.robots,
        )
        if pending.on_status is not None:
            pending.on_status(pending.status)

    def _on_receipt(self, receipt: EStopReceipt) -> None:
        for order in tuple(self._orders.values()):
            order.receive(receipt)


class MockPublisher:
    """The paper's mock publisher (III.A): sends `count` separate requests at `rate_hz`; 0 means without end.

    Attributes
    ----------
    sent, answered : int
        Requests sent, and those that the core has answered at least once.
    refused : list of RequestStatus
        Those that it refused.
    """

    def __init__(
        self,
        operator: Operator,
        scheduler: Scheduler,
        behaviour: str,
        robots: Iterable[str] = (),
        parameters: Mapping[str, Value] | None = None,
        *,
        rate_hz: float = 1.0,
        count: int = 1,
        on_status: Callable[[RequestStatus], None] | None = None,
        on_answered: Callable[[], None] | None = None,
    ) -> None:
        self.sent = self.answered = 0
        self.refused: list[RequestStatus] = []
        self._operator, self._scheduler = operator, scheduler
        self._behaviour, self._robots, self._parameters = behaviour, tuple(robots), dict(parameters or {})
        self._period_s, self._count = 1.0 / rate_hz, count
        self._on_status, self._on_answered = on_status, on_answered
        self._open: dict[str, PendingRequest] = {}
        self._timer: Timer | None = None

    def start(self) -> None:
        """Send the first request now."""
        self._timer = self._scheduler.every(self._period_s, self._send)
        self._send()

    def stop(self) -> None:
        """Send nothing more and stop repeating what was not answered."""
        if self._timer is not None:
            self._timer.cancel()
        for pending in self._open.values():
            self._operator.forget(pending)
        self._open.clear()

    def _send(self) -> None:
        self.sent += 1
        if self.sent == self._count and self._timer is not None:
            self._timer.cancel()
        pending = self._operator.request(self._behaviour, self._robots, self._parameters, self._receive)
        self._open[pending.request.id] = pending

    def _receive(self, status: RequestStatus) -> None:
        first = self._open.pop(status.request_id, None) is not None
        self.answered += first
        if status.phase == "refused":
            self.refused.append(status)
        if self._on_status is not None:
            self._on_status(status)
        if first and self._count and self.answered == self._count and self._on_answered is not None:
            self._on_answered()
