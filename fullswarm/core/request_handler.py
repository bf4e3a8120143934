"""The request handler (paper II.C.2): brings every robot to its desired state, and distributes centralised commands.

It keeps a desired state per robot and compares it with what the robot acknowledges and reports. So a lost message, a
robot that joins late or is started again, and a core that is started again, all end in the desired state. Rapid
requests are spread over `schedule_interval_s`: the first is sent at once, the newest of those that follow at the end of
the interval, the others are superseded. An intent of a stick is never delayed: it would arrive after the stick was
released.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping

import msgspec

from fullswarm.bus import Bus
from fullswarm.core.desired import IDLE, Desired, Order
from fullswarm.core.request_order import RequestOrder
from fullswarm.core.request_status import Progress, StatusBoard
from fullswarm.core.roster import Member, Roster
from fullswarm.keys import Keys
from fullswarm.messages import (
    STOP,
    CentralisedCommands,
    Command,
    ControlAck,
    Halt,
    ParamEntry,
    RequestStatus,
    Result,
    RobotHealth,
)
from fullswarm.reasons import NONE, NOTHING, RESULTS, Code, Reason, given, reason
from fullswarm.runtime import Scheduler
from fullswarm.store import Store

TICK_S = 0.05
WANTED = "wanted/"

Release = Callable[[str, tuple[str, ...]], None]
HaltHandler = Callable[[str, Halt, float], None]


class RequestHandler:
    """Desired-state reconciliation of all robots.

    Parameters
    ----------
    process
        Name of this start of the core; goes with every sequence number.
    interval_s
        Returns the schedule interval, which may change while running.
    command_ttl_s
        How long a robot may follow one command of a centralised behaviour.
    adopted
        Makes the order for a (request id, behaviour) found running after a restart; None: leave it alone.
    request_order
        Gets what had been requested before a restart, as far as the database knows.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        store: Store,
        roster: Roster,
        board: StatusBoard,
        process: str,
        interval_s: Callable[[], float],
        command_ttl_s: float,
        adopted: Callable[[str, str], Order | None],
        request_order: RequestOrder,
    ) -> None:
        self._bus, self._keys, self._scheduler, self._store = bus, keys, scheduler, store
        self._roster, self._board, self._process = roster, board, process
        self._interval_s, self._command_ttl_s = interval_s, command_ttl_s
        self._robots: dict[str, Desired] = {}
        self._requests: dict[str, Progress] = {}
        self._dirty: dict[str, None] = {}
        self._kept: set[str] = set()  # robots with an entry in the database
        self._restored: set[str] = set()  # requests that the database remembered at the start
        # Above the numbers of any core before it on this machine, so that their late commands are known to be old.
        self._counter = itertools.count(int(scheduler.now_s() * 1e6) + 1)
        self._closed = self._held_back = False
        self._on_change: list[Release] = []
        self._on_halt: list[HaltHandler] = []
        self._adopted, self._request_order = adopted, request_order
        roster.watch(self._reported, self._fell_silent)
        roster.watch_forgotten(self._forget)
        self._subscriptions = [
            bus.subscribe(keys.ack(), ControlAck, self._acknowledged),
            bus.subscribe(keys.centralised_commands(), CentralisedCommands, self._distribute),
        ]
        self._timer = scheduler.every(TICK_S, self._tick)
        self._restore(request_order)

    # ------------------------------------------------------------ called by the main controller
    def submit(
        self,
        orders: Mapping[str, Order],
        why: Reason = NONE,
        *,
        at_once: bool = False,
        left_out: tuple[str, ...] = (),
        roles: Mapping[str, str] = NOTHING,
    ) -> None:
        """Order these robots to carry out one request.

        `at_once` skips the schedule interval: a stop waits for nothing. `left_out`, `roles`: for its status.
        """
        if not orders:
            return
        first = next(iter(orders.values()))
        self._requests[first.request_id] = Progress(
            first.request_id, first.behaviour, tuple(orders), why, left_out, roles
        )
        # The robots first: the statuses of superseded requests follow at the end, without a timer.
        self._held_back = True
        applied = [robot for robot, order in orders.items() if self._schedule(robot, order, at_once)]
        self._keep(orders)  # before sending: a restarted core must know all that others have received
        for robot in applied:
            self._advance(self._robots[robot])
        self._held_back = False
        self._publish(first.request_id)
        self._dirty.pop(first.request_id, None)
        self._flush()

    def holds(self, request_id: str) -> bool:
        """Tell whether some robot still holds the request."""
        return request_id in self._requests

    def requests(self) -> tuple[str, ...]:
        """Return the ids of all requests that some robot holds."""
        return tuple(self._requests)

    def holders(self, request_id: str) -> tuple[str, ...]:
        """Return the robots that hold the request."""
        progress = self._requests.get(request_id)
        return progress.holders() if progress else ()

    def keepers(self, request_id: str) -> tuple[str, ...]:
        """Return the robots that hold the request and are not about to leave it for one that waits for its interval."""
        waiting = {robot: self._robots[robot].waiting for robot in self.holders(request_id)}
        return tuple(robot for robot, order in waiting.items() if order is None or order.request_id == request_id)

    def order_of(self, robot: str) -> Order | None:
        """Return the present order of `robot`."""
        state = self._robots.get(robot)
        return state.order if state else None

    def stands(self, robot: str) -> bool:
        """Tell whether `robot` was told to stand, and nothing else waits for it."""
        state = self._robots.get(robot)
        return state is not None and state.waiting is None and state.order is not None and state.order.behaviour == STOP

    def watch_holders(self, callback: Release) -> None:
        """Have ``callback(request_id, robots)`` called when robots left a request; no robots: it has ended."""
        self._on_change.append(callback)

    def watch_halts(self, callback: HaltHandler) -> None:
        """Have ``callback(robot, halt, at_s)`` called for each report of a stop that a robot has carried out.

        It comes before anything that the report makes this core request of the robot; `at_s` is on this core's clock,
        late by the report's delay.
        """
        self._on_halt.append(callback)

    def note_halt(self, robots: Iterable[str], halt_id: str) -> None:
        """Note a stop or e-stop of these robots: they ignore requests that were sent without knowing it."""
        for robot in robots if halt_id else ():
            self._state(robot).halts[halt_id] = None

    def halts_of(self, robot: str) -> tuple[str, ...]:
        """Return the newest stops of `robot` that the core knows."""
        state = self._robots.get(robot)
        return () if state is None else tuple(state.halts)

    def ordered_s(self, robot: str) -> float:
        """Return when this core got `robot`'s newest order; minus infinity for none, and for one from before it."""
        state = self._robots.get(robot)
        return -math.inf if state is None else state.ordered_s

    def close(self) -> None:
        """Stop handling; the robots detect the silence by themselves."""
        self._closed = True
        for subscription in self._subscriptions:
            subscription.close()
        self._timer.cancel()

    # ------------------------------------------------------------ scheduling
    def _schedule(self, robot: str, order: Order, at_once: bool) -> bool:
        """Apply `order` now (True) or have it wait for the end of the interval."""
        state, now_s = self._state(robot), self._scheduler.now_s()
        state.ordered_s = now_s
        if state.waiting is not None:
            self._leave(robot, state.waiting, order)
            state.waiting = None
        rest_s = state.switched_s + self._interval_s() - now_s
        if at_once or order.intent or rest_s <= 0:
            self._apply(state, order)
            return True
        state.waiting = order
        self._scheduler.after(rest_s, lambda: self._interval_over(state, order))
        return False

    def _interval_over(self, state: Desired, order: Order) -> None:
        if state.waiting is order and not self._closed:
            state.waiting = None
            self._apply(state, order)
            self._keep([state.robot])
            self._advance(state)
            self._mark(order.request_id)

    def _apply(self, state: Desired, order: Order) -> None:
        before = state.order
        if before is not None:
            self._leave(state.robot, before, order)
        now_s = self._scheduler.now_s()
        if before is None or before.behaviour != order.behaviour or not order.intent:
            state.switched_s = now_s
        state.set_order(order, now_s)

    def _leave(self, robot: str, old: Order, new: Order) -> None:
        if old.request_id != new.request_id:
            self._release(robot, old.request_id, reason(Code.SUPERSEDED, by=new.request_id), superseded=True)

    def _release(self, robot: str, request_id: str, why: Reason, *, superseded: bool) -> None:
        progress = self._requests.get(request_id)
        if progress is not None:
            progress.leave(robot, why, superseded=superseded)
            self._mark(request_id)

    # ------------------------------------------------------------ sending
    def _advance(self, state: Desired) -> None:
        """Send what is due to one robot."""
        request = state.next(lambda: next(self._counter))
        if request is not None:
            self._send(state)

    def _send(self, state: Desired) -> None:
        now_s = self._scheduler.now_s()
        request = state.due(now_s)
        if request is not None:
            state.sent(now_s)
            self._bus.publish(self._keys.control_requests(request.robot, request.behaviour), request)

    def _tick(self) -> None:
        now_s = self._scheduler.now_s() + 1e-9
        for state in self._robots.values():
            if now_s >= state.expires_at_s and state.order is not None:
                self._give_up(state, reason(Code.NOT_REPEATED, after_s=f"{state.order.expires_s:g}"))
            elif now_s >= state.resend_s and state.present:
                self._send(state)

    def _give_up(self, state: Desired, why: Reason) -> None:
        order = state.order
        if order is not None:
            state.set_order(None, self._scheduler.now_s())
            self._release(state.robot, order.request_id, why, superseded=False)
            self._keep([state.robot])

    def _finish(self, state: Desired, result: Result) -> None:
        """End a robot's order because its behaviour has ended itself."""
        progress = self._requests.get(result.request_id)
        if progress is not None and result.robot == state.robot:
            progress.finish(result)
            self._mark(result.request_id)
        state.set_order(None, self._scheduler.now_s())
        self._keep([state.robot])

    # ------------------------------------------------------------ acknowledgements and reports
    def _acknowledged(self, ack: ControlAck) -> None:
        state = self._robots.get(ack.robot)
        if state is not None and state.acknowledge(ack, self._scheduler.now_s()):
            self._advance(state)
            self._mark_robot(state)
            if state.refused:
                self._keep([state.robot])  # a refused order must not start after a restart of the core

    def _reported(self, member: Member, restarted: bool) -> None:
        health = member.health
        if health is None:
            return
        state = self._state(member.robot)
        before = state.present, state.settled, state.order
        state.present = True
        if self._runs_unsaved(state, health):
            self._adopt(state, health.request_id, health.behaviour)
        given_up = state.compare(health, restarted, self._scheduler.now_s())
        if given_up.code in RESULTS and health.result is not None:
            self._finish(state, health.result)
        elif given_up:
            self._give_up(state, given_up)
        elif state.order is None and not state.acked_sequence and health.behaviour and health.core != self._process:
            self._adopt(state, health.request_id, health.behaviour)
        if health.halt is not None:
            at_s = self._scheduler.now_s() - max(0.0, member.stamp_s - health.halt.stamp_s)
            for callback in self._on_halt:
                callback(member.robot, health.halt, at_s)
        self._advance(state)
        if before != (state.present, state.settled, state.order):
            self._mark_robot(state)

    def _fell_silent(self, robot: str) -> None:
        state = self._state(robot)
        state.present = False
        self._mark_robot(state)

    def _forget(self, robot: str) -> None:
        """Drop all that is kept of a robot that is not of the fleet file and has not been received for long."""
        state = self._robots.pop(robot, None)
        for order in () if state is None else (state.order, state.waiting):
            if order is not None:
                self._release(robot, order.request_id, given("the robot is no longer known"), superseded=False)
        if state is not None:
            state.waiting = None  # its timer may still run
        self._request_order.forget(robot)
        self._kept.discard(robot)
        self._store.forget(WANTED + robot)

    def _runs_unsaved(self, state: Desired, health: RobotHealth) -> bool:
        """Tell whether a robot runs what a core before this one could not save: it is newer than the restored order.

        A robot that was to stand is stopped all the same.
        """
        order = state.order
        if order is None or order.enables_nothing or order.adopted or health.behaviour in IDLE:
            return False
        if order.request_id == health.request_id:  # adopted by the report before this one
            return False
        if state.ordered_s > -math.inf or state.acked_sequence:  # this core has asked it for something
            return False
        return health.request_id not in self._restored

    def _adopt(self, state: Desired, request_id: str, behaviour: str) -> None:
        """Adopt what a robot runs already: this core has no record of it, and the robot must not stop for that."""
        order = self._adopted(request_id, behaviour)
        if order is None:
            return
        if state.order is not None:
            self._leave(state.robot, state.order, order)
        self._hold(order, state.robot).reason = given("adopted after a restart of the core")
        state.set_order(order, self._scheduler.now_s())
        state.settled = order.adopted
        self._keep([state.robot])

    # ------------------------------------------------------------ commands of centralised behaviours
    def _distribute(self, commands: CentralisedCommands) -> None:
        """Send each robot its command at once; a robot that runs something else by now gets none."""
        columns = (commands.robots, commands.linear_m_s, commands.angular_rad_s)
        if len({len(column) for column in columns}) != 1:
            return
        # Numbered by the core: a restarted centralised node counts from one, robots require growing numbers.
        sequence, now_s = next(self._counter), self._scheduler.now_s()
        for robot, linear_m_s, angular_rad_s in zip(*columns, strict=True):
            order = self.order_of(robot)
            finite = math.isfinite(linear_m_s) and math.isfinite(angular_rad_s)
            if finite and order is not None and order.request_id == commands.request_id:
                self._bus.publish(
                    self._keys.command(robot),
                    Command(
                        robot=robot,
                        request_id=commands.request_id,
                        linear_m_s=linear_m_s,
                        angular_rad_s=angular_rad_s,
                        ttl_s=self._command_ttl_s,
                        sequence=sequence,
                        stamp_s=now_s,
                    ),
                )

    # ------------------------------------------------------------ status and memory
    def _state(self, robot: str) -> Desired:
        state = self._robots.get(robot)
        if state is None:
            state = self._robots[robot] = Desired(robot, self._process)
        return state

    def _mark_robot(self, state: Desired) -> None:
        for order in (state.order, state.waiting):
            if order is not None:
                self._mark(order.request_id)

    def _mark(self, request_id: str) -> None:
        """Schedule one update of the status for all that happens at this moment."""
        if not self._dirty and not self._held_back:
            self._scheduler.after(0.0, self._flush)
        self._dirty[request_id] = None

    def _flush(self) -> None:
        dirty, self._dirty = self._dirty, {}
        for request_id in () if self._closed else dirty:
            self._publish(request_id)

    def _publish(self, request_id: str) -> None:
        progress = self._requests.get(request_id)
        if progress is None:
            return
        status = progress.status(self._robots)
        self._board.publish(status)
        # A robot that refused gets no further request: when all refused, the request has ended.
        holders = () if status.phase == "refused" else progress.holders()
        if len(holders) < len(progress.robots):
            if not holders:
                del self._requests[request_id]
            for callback in self._on_change:
                callback(request_id, holders)

    def _keep(self, robots: Iterable[str]) -> None:
        """Write the orders into the local database; an intent is not restored."""
        values: dict[str, dict[str, object] | None] = {}
        for robot in robots:
            state = self._robots[robot]
            order = state.waiting or (None if state.refused else state.order)
            if order is not None and not order.intent:
                values[WANTED + robot] = msgspec.to_builtins(order)
                self._kept.add(robot)
            elif robot in self._kept:  # a stream of intents must not query the database twenty times a second
                values[WANTED + robot] = None
                self._kept.remove(robot)
        if values:
            self._store.keep(values, f"core {self._process}")

    def _restore(self, request_order: RequestOrder) -> None:
        """Restore the orders from before a restart, and remember which requests had ended by then."""
        for entry in self._store.history(WANTED + "*"):
            order = _order(entry)
            if order is None:
                continue
            request_order.note(
                entry.key.removeprefix(WANTED), order.request_id, (order.operator, order.clock), order.stamp_s
            )
            self._restored.add(order.request_id)
            reason = "before the core was started again"
            self._board.remember(
                RequestStatus(request_id=order.request_id, behaviour=order.behaviour, phase="ended", reason=reason)
            )
        for entry in self._store.list(WANTED):
            wanted, robot = _order(entry), entry.key.removeprefix(WANTED)
            self._kept.add(robot)
            if wanted is not None:
                self._hold(wanted, robot)
                self._state(robot).set_order(wanted, self._scheduler.now_s())

    def _hold(self, order: Order, robot: str) -> Progress:
        progress = self._requests.setdefault(order.request_id, Progress(order.request_id, order.behaviour, ()))
        progress.join(robot)
        self._mark(order.request_id)
        return progress


def _order(entry: ParamEntry) -> Order | None:
    """Read an order back; None for an empty entry, or one that another version wrote."""
    try:
        return None if entry.value is None else msgspec.convert(entry.value, Order)
    except msgspec.ValidationError:
        return None
