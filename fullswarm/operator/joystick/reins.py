"""The robots in hand: their leases, the stream of intents, and the zeros at its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.messages import EStop, Lease, RequestStatus, StopRequest, Value
from fullswarm.operator.client import Asked, Operator
from fullswarm.operator.joystick.selection import Roster, Selection
from fullswarm.operator.leases import LeaseHolder
from fullswarm.operator.teleop import Teleop
from fullswarm.runtime import Scheduler

TAKE_OVER_S = 2.0
"""How long the core may take to hand robots over."""


class Reins:
    """Drives one selection at a time, as long as it may.

    Parameters
    ----------
    on_lost
        Called with the reason when the robots were let go because they may be driven no longer.
    on_note
        Called with what is worth telling: an answer of the core.
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
        self._asked: tuple[str, dict[str, float]] = "", {}
        self._fixed: Mapping[str, Value] = {}
        self._order: Asked | None = None
        self._taking_s: float | None = None
        self.selection: Selection | None = None

    # ------------------------------------------------------------------ looking
    @property
    def behaviour(self) -> str:
        """What is streamed; empty: nothing."""
        return self._asked[0] if self._stream is not None else ""

    @property
    def values(self) -> Mapping[str, float]:
        """The sticks' parameters that are streamed."""
        return self._asked[1] if self._stream is not None else {}

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

    # ------------------------------------------------------------------ doing
    def take_up(self, selection: Selection, *, take: bool = False) -> str:
        """Take robots in hand; return why that is not possible, empty if it is.

        With `take` also from another operator; they are ready as soon as the core has handed them over.
        """
        problem = self._unreachable()
        if problem or not selection.robots:
            return problem or f"{selection.label}: no robot of it has been heard"
        others = self.holders(selection)
        if others and not take:
            return held_by(others)
        self._leases.hold(selection.robots, take=take)
        self.selection = selection
        self._taking_s = self._scheduler.now_s() if others else None
        return ""

    def hold(self, behaviour: str, values: Mapping[str, float], fixed: Mapping[str, Value]) -> None:
        """Stream an intent to the robots in hand; the first call begins it."""
        if not self.ready or self.selection is None:
            return
        if self._stream is None:
            addressed = self.selection.addressed
            if addressed not in self._teleops:
                self._teleops[addressed] = Teleop(self._operator, self._scheduler, addressed, on_status=self._heard)
            self._stream = self._teleops[addressed]
        self._asked, self._fixed = (behaviour, dict(values)), fixed
        self._stream.hold(behaviour, values, fixed)

    def centre(self) -> None:
        """Stream zeros, if anything is streamed."""
        if self._stream is not None:
            self.hold(self._asked[0], dict.fromkeys(self._asked[1], 0.0), self._fixed)

    def let_go(self, on_done: Callable[[], None] | None = None) -> None:
        """Zero at once, and give the robots back after the last zero."""
        selection, self.selection, self._taking_s = self.selection, None, None
        stream, self._stream = self._stream, None
        order, self._order = self._order, None
        if order is not None and order.status is None:
            self._operator.forget(order)  # it must not start robots that are no longer in hand

        def give_back() -> None:
            if selection is not None:
                kept = self.selection.robots if self.selection is not None else ()
                self._leases.release([robot for robot in selection.robots if robot not in kept])
            if on_done is not None:
                on_done()

        if stream is None:
            give_back()
        else:
            stream.release(give_back)

    def order(self, behaviour: str, parameters: Mapping[str, Value]) -> None:
        """End the stream and then ask for a behaviour that goes on by itself."""
        selection, stream = self.selection, self._stream
        if not self.ready or selection is None:
            return
        self._stream = None

        def ask() -> None:
            if self.selection is selection:
                self._order = self._operator.request(behaviour, selection.addressed, parameters, self._answered)

        if stream is None:
            ask()
        else:
            stream.release(ask)

    def check(self) -> None:
        """Let go if hub or core are gone, or do not hand robots over."""
        if self.selection is None:
            return
        problem = self._unreachable()
        if not problem and self._taking_s is not None:
            others = self.holders(self.selection)
            if not others:
                self._taking_s = None
                self._leases.hold(self.selection.robots)  # whatever was received in between: keep them from now on
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
        """Give everything back and unsubscribe."""
        for subscription in self._subscriptions:
            subscription.close()
        self._leases.close()

    # ------------------------------------------------------------------ answers
    def _unreachable(self) -> str:
        if not self._bus.connected():
            return "no hub: robots that lost it stand"
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
        act = "pressed" if order.engaged else "cleared"
        self._halted(order.robots, f"e-stop {act} by {order.source or 'an operator'}")

    def _halted(self, robots: tuple[str, ...], why: str) -> None:
        """Release robots that another operator has stopped: the next frame would start them again."""
        mine = self.selection.robots if self.selection is not None else ()
        if mine and (not robots or not set(robots).isdisjoint(mine)):
            self._lose(why)

    def _lose(self, why: str) -> None:
        self.let_go()
        self._on_lost(why)

    def _heard(self, status: RequestStatus) -> None:
        if self._stream is None:
            return  # what became of the zeros
        if status.phase == "refused":
            self._lose(status.reason or "refused without a reason")
        elif status.refused_by:
            self._on_note(f"refused by {', '.join(status.refused_by)}: {status.reason or 'see `fullswarm status`'}")

    def _answered(self, status: RequestStatus) -> None:
        why = f": {status.reason}" if status.reason else ""
        self._on_note(f"{status.behaviour} {status.phase}{why}")


def held_by(others: Mapping[str, str]) -> str:
    """Return the holders of robots as text."""
    robots: dict[str, list[str]] = {}
    for robot, operator in others.items():
        robots.setdefault(operator, []).append(robot)
    return "; ".join(f"{', '.join(names)} held by {operator}" for operator, names in robots.items())
