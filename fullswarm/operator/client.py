"""Asks the core and the robots: requests until answered, stops in a burst, e-stops until confirmed."""

from __future__ import annotations

import itertools
import uuid
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import STOP, BehaviourRequest, EStop, EStopReceipt, RequestStatus, StopRequest, Value
from fullswarm.operator.estop import EStopOrder
from fullswarm.runtime import Scheduler, Timer

RESEND_S = 0.2
STOP_SENDS = 5
STOP_SPACING_S = 0.1
AFTER_LOSS_SENDS = 20
"""A stop goes on for two seconds after the hub was away: the robots may come back to it later than we do."""
STOP_PATIENCE_S = 10.0
FINAL_PHASES = frozenset({"refused", "superseded", "ended"})

StatusHandler = Callable[[RequestStatus], None]


def short_id() -> str:
    """Return a fresh id: 48 random bits are plenty for one swarm and still fit a log line."""
    return uuid.uuid4().hex[:12]


@dataclass(slots=True)
class Asked:
    """A request on its way; `status` is the newest answer."""

    request: BehaviourRequest
    on_status: StatusHandler | None = None
    status: RequestStatus | None = None
    sent: int = 0
    _timer: Timer | None = field(default=None, repr=False)

    @property
    def repeats(self) -> bool:
        """Whether it is sent until it is answered."""
        return self._timer is not None

    def close(self) -> None:
        """Do not send it again. What the core already has goes on."""
        if self._timer is not None:
            self._timer.cancel()


@dataclass(slots=True)
class Burst:
    """A message that is sent a few times because it has no answer.

    `left` is what a hub has yet to take; not zero at the end: there was none, and the message may not have got through.
    """

    left: int
    on_done: Callable[[], None] | None = None

    @property
    def done(self) -> bool:
        """Whether all have been sent."""
        return self.left == 0


class Operator:
    """One operator's line to a swarm. All calls return at once; answers come through the callbacks.

    Parameters
    ----------
    source
        Which process asks; unlike any other's.
    name
        In whose name it asks, for leases; none: `source`.
    clock
        Which clock `scheduler` reads, see :func:`~fullswarm.clock.clock_id`; empty: one that only `source` reads.
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
        self._asked: dict[str, Asked] = {}
        self._orders: dict[str, EStopOrder] = {}
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
    ) -> Asked:
        """Ask for `behaviour`; send again every 0.2 s until the core has answered that id once.

        No `robots` means the whole swarm. `on_status` receives every status of the request until a final one.
        With ``resend=False`` it is sent once, for streams whose next message replaces this one. With ``take=True``
        the robots are taken over from an operator who holds them.
        """
        request = BehaviourRequest(
            id=self._new_id(),
            behaviour=behaviour,
            robots=tuple(robots),
            parameters=dict(parameters or {}),
            source=self.source,
            operator=self.name,
            take=take,
            clock=self._clock,
            stamp_s=self._scheduler.now_s(),
        )
        asked = Asked(request, on_status)
        self._asked[request.id] = asked

        def send() -> None:
            asked.sent += 1
            self._bus.publish(self._keys.behaviour_request, request)

        send()
        if resend:
            asked._timer = self._scheduler.every(RESEND_S, send)  # noqa: SLF001  (its own record)
        return asked

    def forget(self, asked: Asked) -> None:
        """Stop sending a request and unsubscribe from its status."""
        asked.close()
        self._asked.pop(asked.request.id, None)

    def stop(self, robots: Iterable[str] = (), on_done: Callable[[], None] | None = None) -> Burst:
        """Tell robots to stand still: five times over 0.4 s with one id, since a stop is not acknowledged.

        While there is no hub it goes on, for 10 s at most: robots that lost it drive on when it is back.
        """
        self._call_off_all(robots := tuple(robots), "a stop came before the core had it")
        message = StopRequest(id=self._new_id(), robots=robots, source=self.source)
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

        No `robots` means all: then `known` tells which must confirm, asked anew each time, because robots may
        be heard of after the order went out.
        """
        robots = tuple(robots)
        if engaged:
            self._call_off_all(robots, "an e-stop came before the core had it")
        message = EStop(id=self._new_id(), engaged=engaged, robots=robots, source=self.source, reason=reason)
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
        for asked in self._asked.values():
            asked.close()
        for order in self._orders.values():
            order.close()
        for subscription in self._subscriptions:
            subscription.close()

    def _burst(self, publish: Callable[[], None], on_done: Callable[[], None] | None) -> Burst:
        burst, began_s = Burst(STOP_SENDS, on_done), self._scheduler.now_s()

        def send() -> None:
            publish()
            burst.left = burst.left - 1 if self._bus.connected() else AFTER_LOSS_SENDS
            if not burst.done and self._scheduler.now_s() - began_s < STOP_PATIENCE_S:
                self._scheduler.after(STOP_SPACING_S, send)
            elif burst.on_done is not None:
                burst.on_done()

        send()
        return burst

    def _on_status(self, status: RequestStatus) -> None:
        asked = self._asked.get(status.request_id)
        if asked is None:
            return
        asked.close()
        if asked.status is None and status.phase != "refused":
            self._overtake(asked)
        asked.status = status
        if status.phase in FINAL_PHASES:
            del self._asked[status.request_id]
        if asked.on_status is not None:
            asked.on_status(status)

    def _overtake(self, newer: Asked) -> None:
        """Call off what was asked before `newer` for no other robots and got lost: it must not come after it.

        What was asked for others too is sent on: the core leaves out robots that have something newer.
        """
        robots = newer.request.robots
        for asked in list(itertools.takewhile(lambda each: each is not newer, self._asked.values())):
            theirs = asked.request.robots
            if not robots or (theirs and set(theirs) <= set(robots)):
                self._call_off(asked, f"{newer.request.id} came before the core had it")

    def _call_off_all(self, robots: tuple[str, ...], why: str) -> None:
        """Call off what concerns any of `robots`; none: all."""
        for asked in list(self._asked.values()):
            theirs = asked.request.robots
            if not robots or not theirs or not set(theirs).isdisjoint(robots):
                self._call_off(asked, why)

    def _call_off(self, asked: Asked, why: str) -> None:
        """Stop sending a request that is still unanswered, and notify its caller."""
        if asked.status is not None or not asked.repeats:
            return
        self.forget(asked)
        asked.status = RequestStatus(
            request_id=asked.request.id,
            behaviour=asked.request.behaviour,
            phase="superseded",
            reason=why,
            robots=asked.request.robots,
        )
        if asked.on_status is not None:
            asked.on_status(asked.status)

    def _on_receipt(self, receipt: EStopReceipt) -> None:
        for order in tuple(self._orders.values()):
            order.receive(receipt)
