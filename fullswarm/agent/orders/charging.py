"""Interrupts the tasks of robots that are to charge: drives them to a dock, into it, out of it, and back to the task.

::

    go    -> going -> docking -> docked
    leave ->                     docked -> leaving -> (returning) -> the task goes on
    wait  -> waiting: the robot stands where it is
    cancel-> the task goes on, from a dock by way of leaving

The core decides who goes when and sends a :class:`~fullswarm.messages.ChargeOrder` until the robot's health report
shows it. Meanwhile the task is parked (``Tasks.park``): the core's request stays the robot's, and what its control law
remembers is kept. Whatever ends the task ends the interruption too: a stop, an e-stop, a failed driver, another
request; an order with the same id starts nothing again. The ways are driven as tasks of their own (``navigate``,
``docking``) behind the safety filter.

A robot that was stopped in its dock is still in it. What is requested of it next is parked at once, until the core lets
it leave: it must not drive off sideways, nor with an empty battery.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import structlog

from fullswarm.agent.behaviours.docking import IN, OUT, OUT_FORWARDS
from fullswarm.agent.orders.tasks import Task, Tasks
from fullswarm.agent.state import AgentState
from fullswarm.bus.base import Bus
from fullswarm.drivers.base import Fleet
from fullswarm.errors import FullswarmError
from fullswarm.keys import Keys
from fullswarm.messages import ChargeOrder, ChargePhase, ControlRequest, Halt, RobotCharge, Value
from fullswarm.reasons import NONE, Code, Reason, given, reason
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler

CHARGE = "charge"
"""Behaviour of the ways to a dock and back, in logs and random numbers; no record has it."""
LINED_UP_M = 0.06
"""So near the point before a dock a robot turns towards it."""
DOCKED_M = 0.01
"""So near the dock's pose it has arrived."""
BACK_M = 0.2
"""So near the place that it came from a robot without a task has returned."""
OUT_M = 0.03
REMEMBERED = 64

log = structlog.get_logger()


@dataclass(slots=True)
class Interruption:
    """One robot that charges, or is on its way."""

    order: ChargeOrder
    phase: ChargePhase
    since_s: float
    origin: tuple[float, float]  # where it was interrupted
    leave: bool = False
    next: ChargeOrder | None = None  # another dock, once it is out of this one


class Charging:
    """The interruptions of the robots of one agent.

    Parameters
    ----------
    replaced : tells whether the core of an order has been replaced by another one, for a robot
    halts : the newest stop of each robot since which it has started nothing
    end : ends a robot's task for good, for a reason
    forget : drops a robot's desired twist

    Attributes
    ----------
    flags : (n,) robots that are away: not part of the swarm now
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, fleet: Fleet, state: AgentState, tasks: Tasks,
        replaced: Callable[[int, str], bool], halts: list[Halt | None], end: Callable[[int, Reason], None],
        forget: Callable[[int], None],
    ) -> None:  # fmt: skip
        self._scheduler, self._fleet, self._state, self._tasks = scheduler, fleet, state, tasks
        self._replaced, self._halts, self._end, self._forget = replaced, halts, end, forget
        self._row = {robot: row for row, robot in enumerate(fleet.ids)}
        self._of: dict[int, Interruption] = {}
        self.flags = np.zeros(len(fleet.ids), np.bool_)
        self._left_in: dict[int, ChargeOrder] = {}  # stopped in a dock
        self._over: Recent[str, None] = Recent(REMEMBERED * max(1, len(fleet.ids)))  # ids of interruptions that ended
        robot = fleet.ids[0] if len(fleet.ids) == 1 else "*"
        self._subscription = bus.subscribe(keys.charge(robot), ChargeOrder, self._on_order)
        self.changed = False
        """A phase has changed since this was last set to False."""

    def close(self) -> None:
        """End the subscription."""
        self._subscription.close()

    def away(self, row: int) -> bool:
        """Tell whether robot `row` is not part of the swarm now."""
        return row in self._of

    @property
    def any(self) -> bool:
        """Some robot is away."""
        return bool(self._of)

    def report(self, row: int, now_s: float) -> RobotCharge | None:
        """Return what the health report says of robot `row`; None: its task is not interrupted."""
        found = self._of.get(row)
        if found is None:
            return None
        age_s = max(0.0, now_s - found.since_s)
        return RobotCharge(id=found.order.id, dock=found.order.dock, phase=found.phase, since_s=age_s)

    def reason(self, row: int) -> Reason:
        """Return why robot `row` stands as far as charging is the cause, or what it is doing."""
        found = self._of.get(row)
        if found is None:
            return NONE
        if found.phase == "docked":
            flows = self._charging(row)
            code = Code.DOCKED if flows is False else Code.CHARGING
            return reason(code, dock=found.order.dock)
        code = {
            "waiting": Code.CHARGE_WAITS, "going": Code.CHARGE_GOING, "docking": Code.CHARGE_DOCKING,
            "leaving": Code.CHARGE_LEAVING, "returning": Code.CHARGE_RETURNS,
        }[found.phase]  # fmt: skip
        return reason(code, dock=found.order.dock) if code is not Code.CHARGE_WAITS else reason(code)

    # ------------------------------------------------------------------ orders of the core
    def _on_order(self, order: ChargeOrder) -> None:
        row = self._row.get(order.robot)
        if row is None or order.id in self._over or self._replaced(row, order.core):
            return
        found = self._of.get(row)
        if found is None:
            self._begin(row, order)
        elif found.order.id == order.id:
            self._go_on(row, found, order)
        elif order.op in ("go", "wait"):
            self._retarget(row, found, order)

    def _begin(self, row: int, order: ChargeOrder) -> None:
        """Interrupt a robot's task, if there is one that may be interrupted, or if robots without one charge too."""
        task, halt = self._tasks.of[row], self._halts[row]
        stands_in = self._left_in.get(row)
        if order.op not in ("go", "wait") or self._state.estop[row]:
            return
        if halt is not None and halt.id not in order.halts:
            return  # the core does not know this stop yet
        if (task is None and not order.idle) or (task is not None and task.request.expires_s > 0.0):
            return
        x_m, y_m, _ = self._state.pose[row].tolist()
        if not math.isfinite(x_m + y_m):
            return
        self._tasks.park(row)
        self.flags[row] = True
        self._of[row] = Interruption(order, "waiting", self._scheduler.now_s(), (x_m, y_m))
        if order.op == "go" and stands_in is not None:
            self._of[row].order, self._of[row].next = stands_in, order
            self._leave(row)
        elif order.op == "go":
            self._go(row)
        else:
            self._note(row)

    def _go_on(self, row: int, found: Interruption, order: ChargeOrder) -> None:
        """Take the next order of the same interruption."""
        if order.op == "go" and found.phase == "waiting":
            found.order = order
            self._go(row)
        elif order.op in ("leave", "cancel"):
            if found.phase in ("docking", "docked") and not found.leave:
                found.leave = True  # carried out at the next tick: a driver that searches must be stopped first
                self._stand(row, "docked")
            elif found.phase in ("waiting", "going"):
                self._resume(row)

    def _retarget(self, row: int, found: Interruption, order: ChargeOrder) -> None:
        """Take another interruption in place of this one: another dock, or a core that was started again."""
        if found.phase in ("docking", "docked", "leaving"):
            if found.next is None or found.next.id != order.id:
                found.next = order
                if found.phase != "leaving":
                    found.leave = True
                    self._stand(row, "docked")
            return
        self._over[found.order.id] = None
        found.order = order
        if order.op == "go":
            self._go(row)
        else:
            self._stand(row, "waiting")

    # ------------------------------------------------------------------ what else happens to a robot
    def take(self, row: int, task: Task) -> bool:
        """Park a task that was just requested of a robot that is away, or stands in a dock; False: it is to start.

        Raises
        ------
        ConfigError
            As from ``Tasks.enable``.
        """
        stands_in = self._left_in.get(row)
        if task.request.expires_s > 0.0 or (row not in self._of and stands_in is None):
            self.call_off(row)  # a person at the stick drives at once
            return False
        self._tasks.park_new(row, task)
        if row not in self._of and stands_in is not None:
            x_m, y_m, _ = self._state.pose[row].tolist()
            self._of[row] = Interruption(stands_in, "docked", self._scheduler.now_s(), (x_m, y_m))
            self.flags[row] = True
            del self._left_in[row]
            self._over.pop(stands_in.id, None)
            self._note(row)
        return True

    def call_off(self, row: int) -> None:
        """End an interruption together with the task: a stop, another request, a failed driver."""
        found = self._of.pop(row, None)
        self._tasks.parked.pop(row, None)
        if found is None:
            return
        self._over[found.order.id] = None
        self.flags[row] = False
        if found.phase in ("docking", "docked", "leaving") and found.order.dock:
            self._left_in[row] = found.order
        self.changed = True

    # ------------------------------------------------------------------ each tick
    def update(self) -> None:
        """Go on to the next phase where a robot has got so far. Call it before the control laws are evaluated."""
        for row in self._left_in and tuple(self._left_in):
            if not self._within(row, self._left_in[row]):
                del self._left_in[row]  # it was driven or carried out of the dock
        for row in self._of and tuple(self._of):
            found = self._of.get(row)
            if found is not None:
                self._step(row, found)

    def _step(self, row: int, found: Interruption) -> None:
        order, (along_m, across_m) = found.order, self._off(row, found.order)
        if found.phase == "going":
            if math.hypot(along_m + order.approach_m, across_m) <= LINED_UP_M:
                self._dock(row)
        elif found.phase == "docking":
            own = order.means == "own" and self._fleet.seek_dock(row)
            if self._fleet.docked(row) if own else along_m >= -DOCKED_M:
                self._stand(row, "docked")
        elif found.phase == "docked":
            if found.leave:
                self._leave(row)
        elif found.phase == "leaving":
            if along_m <= OUT_M - order.approach_m or not math.isfinite(along_m + across_m):
                self._out(row, found)
        elif found.phase == "returning":
            x_m, y_m, _ = self._state.pose[row].tolist()
            if math.dist((x_m, y_m), found.origin) <= BACK_M:
                self._resume(row)

    def _out(self, row: int, found: Interruption) -> None:
        """Decide what follows once a robot is out of its dock."""
        if found.next is not None:
            self._over[found.order.id] = None
            found.order, found.next, found.leave = found.next, None, False
            if found.order.op == "go":
                self._go(row)
            else:
                self._stand(row, "waiting")
        elif row in self._tasks.parked:
            self._resume(row)
        else:  # it makes room for others at the dock
            x_m, y_m = found.origin
            self._drive(row, "returning", "navigate", _way_to(x_m, y_m, BACK_M / 2.0), found.order)

    def _off(self, row: int, order: ChargeOrder) -> tuple[float, float]:
        """Return where a robot is from the docked pose: m along the dock's heading, and to the left."""
        x_m, y_m, _ = self._state.pose[row].tolist()
        c, s = math.cos(order.heading_rad), math.sin(order.heading_rad)
        dx, dy = x_m - order.x_m, y_m - order.y_m
        return dx * c + dy * s, dy * c - dx * s

    def _within(self, row: int, order: ChargeOrder) -> bool:
        """Tell whether a robot is between the point before a dock and its pose."""
        along_m, across_m = self._off(row, order)
        return along_m > OUT_M - order.approach_m and abs(across_m) < order.approach_m

    def _charging(self, row: int) -> bool | None:
        reading = self._state.reading
        flows = -1 if reading is None or reading.charging is None else int(reading.charging[row])
        return None if flows < 0 else bool(flows)

    # ------------------------------------------------------------------ phases
    def _go(self, row: int) -> None:
        found = self._of[row]
        order = found.order
        back_m = order.approach_m
        x_m = order.x_m - back_m * math.cos(order.heading_rad)
        y_m = order.y_m - back_m * math.sin(order.heading_rad)
        self._drive(row, "going", "navigate", _way_to(x_m, y_m, LINED_UP_M / 2.0), order)

    def _dock(self, row: int) -> None:
        self._drive(row, "docking", "docking", _straight(self._of[row].order, IN), self._of[row].order)

    def _leave(self, row: int) -> None:
        order = self._of[row].order
        way = OUT if self._fleet.descriptions[row].limits.can_reverse else OUT_FORWARDS
        self._drive(row, "leaving", "docking", _straight(order, way), order)

    def _stand(self, row: int, phase: ChargePhase) -> None:
        self._tasks.disable(row)
        self._forget(row)
        self._enter(row, phase)

    def _drive(self, row: int, phase: ChargePhase, law: str, parameters: dict[str, Value], order: ChargeOrder) -> None:
        """Drive a part of the way as a task behind the safety filter."""
        request = ControlRequest(
            request_id=f"{order.id}.{phase}", robot=order.robot, behaviour=CHARGE, law=law, enable=True,
            parameters=parameters, filtered=True, core=order.core,
        )  # fmt: skip
        self._enter(row, phase)
        try:
            self._tasks.enable(row, Task(request, self._scheduler.now_s()))
        except FullswarmError as error:  # SciPy is missing on board, for one
            self._end(row, given(str(error)))

    def _resume(self, row: int) -> None:
        """End the interruption: the task goes on."""
        found = self._of.pop(row)
        self._over[found.order.id] = None
        self._left_in.pop(row, None)
        self.flags[row] = False
        self._forget(row)
        self.changed = True
        log.info("the task goes on", robot=self._fleet.ids[row], dock=found.order.dock)
        try:
            self._tasks.unpark(row)
        except FullswarmError as error:
            self._end(row, given(str(error)))

    def _enter(self, row: int, phase: ChargePhase) -> None:
        found = self._of[row]
        if phase != "docked":
            found.leave = False
        if phase != found.phase:
            found.phase, found.since_s = phase, self._scheduler.now_s()
            self._note(row)

    def _note(self, row: int) -> None:
        self.changed = True
        found = self._of[row]
        log.debug("charging", robot=self._fleet.ids[row], phase=found.phase, dock=found.order.dock)


def _way_to(x_m: float, y_m: float, within_m: float) -> dict[str, Value]:
    """Return the parameters of ``navigate`` to a point."""
    return {"goal": [x_m, y_m], "gain": 1.0, "arrive_radius_m": within_m, "map": "shared"}


def _straight(order: ChargeOrder, way: float) -> dict[str, Value]:
    """Return the parameters of ``docking``."""
    return {
        "place": [order.x_m, order.y_m], "dock_rad": order.heading_rad, "approach_m": order.approach_m,
        "speed_m_s": order.speed_m_s, "way": way,
    }  # fmt: skip
