"""Drives the selected robots: their leases, the stream of intents, and the zeros at its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import EStop, Lease, RequestStatus, StopRequest, Value
from fullswarm.operator.client import Operator, PendingRequest
from fullswarm.operator.joystick.selection import Roster, Selection
from fullswarm.operator.leases import LeaseHolder
from fullswarm.operator.teleop import Teleop
from fullswarm.runtime import Scheduler

TAKE_OVER_S = 2.0
"""Time limit for the core to grant leases that are taken over."""


class TeleopSession:
    """Drives one selection at a time, while leases, hub and core permit.

    Parameters
    ----------
    on_lost
        Called with the reason when the robots were released because they may be driven no longer.
    on_note
        Called with an answer of the core.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        operator: Operator,
        roster: Roster,
        *,
        on_lost: Callable[[str], None],
        on_note: Callable[[str], None],
    ) -> None:
        self._bus, self._scheduler, self._operator, self._roster = bus, scheduler, operator, roster
        self._on_lost, self._on_note = on_lost, on_note
        self._leases = LeaseHolder(bus, keys, scheduler, operator.name, on_change=self._leases_changed)
        self._subscriptions = [
            bus.subscribe(keys.stop, StopRequest, self._on_stop),
            bus.subscribe(keys.estop, EStop, self._on_estop),
        ]
        self._teleops: dict[tuple[str, ...], Teleop] = {}
        self._stream: Teleop | None = None
        self._intent: tuple[str, dict[str, float]] = "", {}
        self._fixed: Mapping[str, Value] = {}
        self._pending: PendingRequest | None = None
        self._taking_s: float | None = None
        self.selection: Selection | None = None

    # ------------------------------------------------------------------ state
    @property
    def behaviour(self) -> str:
        """The behaviour that is streamed; empty: none."""
        return self._intent[0] if self._stream is not None else ""

    @property
    def values(self) -> Mapping[str, float]:
        """The parameters that are streamed."""
        return self._intent[1] if self._stream is not None else {}

    @property
    def ready(self) -> bool:
        """Whether robots are held here, and by no other operator."""
        return self.selection is not None and self._taking_s is None

    @property
    def driving(self) -> bool:
        """Whether something else than zero is streamed."""
        return any(self.values.values())

    def holders(self, selection: Selection) -> dict[str, str]:
        """Return robot → operator for those that another operator holds."""
        return self._leases.held_by_others(selection.robots)

    # ------------------------------------------------------------------ commands
    def take_up(self, selection: Selection, *, take: bool = False) -> str:
        """Hold a selection; return why that is not possible, empty if it is.

        With `take` also robots that another operator holds; they are ready as soon as the core has granted them.
        """
        problem = self._unreachable()
        if problem or not selection.robots:
            return problem or f"{selection.label}: no robot of it has been received"
        others = self.holders(selection)
        if others and not take:
            return held_by(others)
        self._leases.hold(selection.robots, take=take)
        self.selection = selection
        self._taking_s = self._scheduler.now_s() if others else None
        return ""

    def hold(self, behaviour: str, values: Mapping[str, float], fixed: Mapping[str, Value]) -> None:
        """Stream an intent to the robots that are held; the first call starts the stream."""
        if not self.ready or self.selection is None:
            return
        if self._stream is None:
            addressed = self.selection.addressed
            if addressed not in self._teleops:
                self._teleops[addressed] = Teleop(
                    self._operator, self._scheduler, addressed, on_status=self._on_intent_status
                )
            self._stream = self._teleops[addressed]
        self._intent, self._fixed = (behaviour, dict(values)), fixed
        self._stream.hold(behaviour, values, fixed)

    def centre(self) -> None:
        """Stream zeros, if anything is streamed."""
        if self._stream is not None:
            self.hold(self._intent[0], dict.fromkeys(self._intent[1], 0.0), self._fixed)

    def release(self, on_done: Callable[[], None] | None = None) -> None:
        """Send zero at once, and release the robots after the last zero."""
        selection, self.selection, self._taking_s = self.selection, None, None
        stream, self._stream = self._stream, None
        pending, self._pending = self._pending, None
        if pending is not None and pending.status is None:
            self._operator.forget(pending)  # it must not start robots that are no longer held

        def release_leases() -> None:
            if selection is not None:
                kept = self.selection.robots if self.selection is not None else ()
                self._leases.release([robot for robot in selection.robots if robot not in kept])
            if on_done is not None:
                on_done()

        if stream is None:
            release_leases()
        else:
            stream.release(release_leases)

    def request(self, behaviour: str, parameters: Mapping[str, Value]) -> None:
        """End the stream and then request a behaviour that continues by itself."""
        selection, stream = self.selection, self._stream
        if not self.ready or selection is None:
            return
        self._stream = None

        def send() -> None:
            if self.selection is selection:
                self._pending = self._operator.request(
                    behaviour, selection.addressed, parameters, self._on_request_status
                )

        if stream is None:
            send()
        else:
            stream.release(send)

    def check(self) -> None:
        """Release the robots if the hub or the core is lost, or if the core does not grant them."""
        if self.selection is None:
            return
        problem = self._unreachable()
        if not problem and self._taking_s is not None:
            others = self.holders(self.selection)
            if not others:
                self._taking_s = None
                self._leases.hold(self.selection.robots)  # renew them whatever was received meanwhile
            elif self._scheduler.now_s() - self._taking_s > TAKE_OVER_S:
                problem = held_by(others)
        if problem:
            self._lose(problem)

    def follow(self, selection: Selection) -> None:
        """Hold the robots that have joined the selection."""
        if self.selection is not None and self.selection.addressed == selection.addressed:
            self._leases.hold(robot for robot in selection.robots if robot not in self.selection.robots)
            self.selection = selection

    def close(self) -> None:
        """Release all robots and unsubscribe."""
        for subscription in self._subscriptions:
            subscription.close()
        self._leases.close()

    # ------------------------------------------------------------------ answers
    def _unreachable(self) -> str:
        if not self._bus.connected():
            return "no hub: robots that lost it stop"
        return "" if self._roster.core_alive else "no core answers"

    def _leases_changed(self, _leases: dict[str, Lease]) -> None:
        if self.ready and self.selection is not None:
            others = self.holders(self.selection)
            if others:
                self._lose(f"taken over: {held_by(others)}")

    def _on_stop(self, order: StopRequest) -> None:
        self._halted(order.robots, f"stopped by {order.source or 'an operator'}")

    def _on_estop(self, order: EStop) -> None:
        # Also its release: a stick that is held at that moment must not start them.
        act = "engaged" if order.engaged else "cleared"
        self._halted(order.robots, f"e-stop {act} by {order.source or 'an operator'}")

    def _halted(self, robots: tuple[str, ...], why: str) -> None:
        """Release robots that another operator has stopped: the next frame would start them again."""
        mine = self.selection.robots if self.selection is not None else ()
        if mine and (not robots or not set(robots).isdisjoint(mine)):
            self._lose(why)

    def _lose(self, why: str) -> None:
        self.release()
        self._on_lost(why)

    def _on_intent_status(self, status: RequestStatus) -> None:
        if self._stream is None:
            return  # the answer to the final zeros
        if status.phase == "refused":
            self._lose(status.reason or "refused without a reason")
        elif status.refused_by:
            self._on_note(f"refused by {', '.join(status.refused_by)}: {status.reason or 'see `fullswarm status`'}")

    def _on_request_status(self, status: RequestStatus) -> None:
        why = f": {status.reason}" if status.reason else ""
        self._on_note(f"{status.behaviour} {status.phase}{why}")


def held_by(others: Mapping[str, str]) -> str:
    """Return the holders of robots as text."""
    robots: dict[str, list[str]] = {}
    for robot, operator in others.items():
        robots.setdefault(operator, []).append(robot)
    return "; ".join(f"{', '.join(names)} held by {operator}" for operator, names in robots.items())
