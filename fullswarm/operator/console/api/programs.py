"""What outside programs hold and have requested: one :class:`Program` per token that was used. Knows no asyncio."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from fullswarm.bus.base import Subscription
from fullswarm.clock import clock_id
from fullswarm.messages import BehaviourRequest, EStop, RequestStatus, StopRequest
from fullswarm.operator.client import Operator, PendingRequest
from fullswarm.operator.console.api.twists import MOST_DRIVEN, MOST_DRIVEN_EACH, TwistStreams
from fullswarm.operator.console.sessions import CLEAR_S, ConsoleContext
from fullswarm.operator.console.tokens import Admitted, Doorkeeper
from fullswarm.operator.estop import EStopOrder, end_released
from fullswarm.operator.leases import LeaseHolder
from fullswarm.operator.missions import MissionClient

PREFIX = "api/"
"""A program acts neither under the name of a person, nor with their leases."""
CHECK_S = 0.25
END_S = 2.0
MOST_REQUESTS = 256
MOST_ESTOPS = 16
"""Different choices of robots whose e-stop one program has repeated; all robots together never count."""


class Program:
    """One program: the operator behind a token.

    Parameters
    ----------
    on_change
        Called when an answer has come, or a lease has changed.
    admit_twists
        Returns whether one more robot may be driven.

    Attributes
    ----------
    name : the operator's name in leases and the audit log
    refused : robot → operator that held it when it was last asked for in vain
    """

    def __init__(
        self,
        context: ConsoleContext,
        admitted: Admitted,
        source: str,
        on_change: Callable[[], None],
        admit_twists: Callable[[], bool],
    ) -> None:
        self.admitted, self.name = admitted, PREFIX + admitted.name
        self.refused: dict[str, str] = {}
        self._context, self._on_change = context, on_change
        bus, keys, scheduler = context.bus, context.keys, context.scheduler
        self._operator = Operator(bus, keys, scheduler, source, name=self.name, clock=clock_id())
        self.leases = LeaseHolder(
            bus, keys, scheduler, self.name,
            on_change=lambda _: on_change(), on_lost=self._lost, on_refused=self._refused,
        )  # fmt: skip
        self.missions = MissionClient(bus, keys, scheduler, source, name=self.name, clock=clock_id(), watch=False)
        self.twists = TwistStreams(self._operator, scheduler, admit_twists)
        self._ends: dict[str, tuple[float, bool]] = {}  # robot → when its lease ends, whether it is stopped then
        self._requests: dict[str, PendingRequest] = {}
        self._estops: list[EStopOrder] = []

    def close(self, *, stop: bool) -> None:
        """Release everything; with `stop` the robots whose lease asks for that are stopped."""
        self.twists.release()
        if stop:
            self._stop_at_end(tuple(self._ends))
        self.leases.close()
        self.missions.close()
        self._context.scheduler.after(END_S, self._operator.close)  # later: the zeros and stops are sent several times

    # ---------------------------------------------------------------- leases
    def hold(self, robots: tuple[str, ...], seconds: float, *, take: bool, stop_at_end: bool) -> None:
        """Ask for the leases of robots, or renew them."""
        end_s = self._context.scheduler.now_s() + seconds
        self.twists.unblock(robot for robot in robots if robot not in self._ends)
        for robot in robots:
            self.refused.pop(robot, None)
            self._ends[robot] = end_s, stop_at_end
        self.leases.hold(robots, take=take)

    def release(self, robots: Iterable[str]) -> None:
        """Release robots; what they do by request goes on."""
        robots = tuple(robot for robot in robots if robot in self._ends)
        self.twists.release(robots)
        for robot in robots:
            del self._ends[robot]
        if robots:
            self.leases.release(robots)

    def held(self) -> tuple[str, ...]:
        """Return the robots that are held, as the core reports."""
        return tuple(robot for robot in self.leases.held() if robot in self._ends)

    def asked(self) -> tuple[str, ...]:
        """Return the robots that are held or asked for."""
        return tuple(self._ends)

    def ends_in_s(self, robot: str) -> float | None:
        """Return in how many seconds a lease ends; None: the robot is not held."""
        if robot not in self._ends:
            return None
        return max(0.0, self._ends[robot][0] - self._context.scheduler.now_s())

    def expire(self, now_s: float) -> None:
        """Release robots whose time has ended without being renewed."""
        ended = tuple(robot for robot, (end_s, _) in self._ends.items() if now_s >= end_s)
        if ended:
            self._stop_at_end(ended)
            self.release(ended)

    def _stop_at_end(self, robots: tuple[str, ...]) -> None:
        held = set(self.leases.held())  # a robot that another operator has taken over is not stopped
        stopped = tuple(robot for robot in robots if self._ends[robot][1] and robot in held)
        if stopped:
            self._operator.stop(stopped)

    def _lost(self, robots: tuple[str, ...], operator: str) -> None:
        self.twists.block(robots, f"taken over by {operator}")
        for robot in robots:
            self._ends.pop(robot, None)
        self._on_change()

    def _refused(self, robots: tuple[str, ...], operator: str) -> None:
        for robot in robots:
            self._ends.pop(robot, None)
            self.refused[robot] = operator
        self._on_change()

    # ---------------------------------------------------------------- requests
    def request(self, order: BehaviourRequest) -> PendingRequest:
        """Request a behaviour; what `order` names of itself is filled in."""
        if len(self._requests) >= MOST_REQUESTS:
            self._operator.forget(self._requests.pop(next(iter(self._requests))))
        pending = self._operator.request(
            order.behaviour, order.robots, order.parameters, self._answered, team=order.team, roles=order.roles
        )
        self._requests[pending.request.id] = pending
        return pending

    def status(self, request_id: str) -> RequestStatus | None:
        """Return the newest status of a request of this program; None: there is none."""
        pending = self._requests.get(request_id)
        return None if pending is None else pending.status

    def withdraw(self, pending: PendingRequest) -> None:
        """Do not send a request again that the core has not answered."""
        self._operator.forget(self._requests.pop(pending.request.id, pending))

    def _answered(self, _: RequestStatus) -> None:
        self._on_change()

    # ---------------------------------------------------------------- stops
    def stop(self, robots: tuple[str, ...]) -> None:
        """Stop robots; none: all."""
        self._operator.stop(robots)

    def engage(self, robots: tuple[str, ...], reason: str) -> EStopOrder | None:
        """Latch the e-stop of robots (none: all) and repeat it until they confirm; None: too many are repeated."""
        self._estops = [each for each in self._estops if not each.done]
        for order in self._estops:
            if order.message.engaged and order.message.robots == robots:
                return order
        if robots and len(self._estops) >= MOST_ESTOPS:
            return None
        return self._estop(robots, reason, engaged=True)

    def clear(self, robots: tuple[str, ...]) -> EStopOrder:
        """Release the e-stop of robots; none: all. Repeated e-stops for them must have been ended."""
        return self._estop(robots, "", engaged=False)

    def _estop(self, robots: tuple[str, ...], reason: str, *, engaged: bool) -> EStopOrder:
        order = self._operator.estop(
            engaged, robots, reason, known=self._context.present, deadline_s=math.inf if engaged else CLEAR_S,
            on_receipt=lambda _: self._on_change(), on_done=lambda _: self._on_change(),
        )  # fmt: skip
        self._estops.append(order)
        return order

    def end_estops(self, robots: tuple[str, ...]) -> None:
        """Stop repeating e-stops that concern `robots` (none: all): they are released."""
        self._estops = end_released(self._estops, robots)


class Programs:
    """All programs, by their tokens. A program whose token has ended is closed within `CHECK_S`.

    Parameters
    ----------
    process
        Name of this console, unlike any other's.
    """

    def __init__(self, context: ConsoleContext, doorkeeper: Doorkeeper, process: str) -> None:
        self._context, self._doorkeeper, self._process = context, doorkeeper, process
        self._programs: dict[str, Program] = {}  # by the key of the token
        self._opened = 0
        self.on_change: Callable[[], None] = lambda: None
        bus, keys = context.bus, context.keys
        self._subscriptions: list[Subscription] = [
            bus.subscribe(keys.stop, StopRequest, self._on_stop),
            bus.subscribe(keys.estop, EStop, self._on_estop),
        ]
        self._timer = context.scheduler.every(CHECK_S, self._check)

    def of(self, admitted: Admitted) -> Program:
        """Return the program of a token, a new one if it is used for the first time."""
        found = self._programs.get(admitted.key)
        if found is None:
            self._opened += 1
            # Stops have no operator: their source has to say whose they are.
            source = f"{self._process}/api{self._opened}:{PREFIX}{admitted.name}"
            found = Program(self._context, admitted, source, lambda: self.on_change(), self._admit(admitted.key))
            self._programs[admitted.key] = found
        return found

    def end_estops(self, robots: tuple[str, ...]) -> None:
        """Stop repeating e-stops that concern `robots`, of all programs and pages."""
        self._context.end_estops(robots)
        for program in self._programs.values():
            program.end_estops(robots)

    def close(self) -> None:
        """Release everything and unsubscribe."""
        self._timer.cancel()
        for subscription in self._subscriptions:
            subscription.close()
        for program in self._programs.values():
            program.close(stop=True)

    def _admit(self, key: str) -> Callable[[], bool]:
        def admit() -> bool:
            driven = sum(len(each.twists) for each in self._programs.values())
            return driven < MOST_DRIVEN and len(self._programs[key].twists) < MOST_DRIVEN_EACH

        return admit

    def _check(self) -> None:
        now_s = self._context.scheduler.now_s()
        for key, program in tuple(self._programs.items()):
            program.expire(now_s)
            if not self._doorkeeper.holds(program.admitted):
                del self._programs[key]
                program.close(stop=True)

    def _on_stop(self, order: StopRequest) -> None:
        self._block(order.robots, "stopped while driving")

    def _on_estop(self, order: EStop) -> None:
        self._block(order.robots, "e-stop while driving" if order.engaged else "e-stop released while driving")
        if not order.engaged:
            for program in self._programs.values():
                program.end_estops(order.robots)

    def _block(self, robots: tuple[str, ...], why: str) -> None:
        for program in self._programs.values():
            program.twists.block(robots, why)
