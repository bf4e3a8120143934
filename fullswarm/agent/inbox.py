"""What an agent is told: control requests, commands, stops, e-stops, heartbeats."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fullswarm.agent.freshness import Freshness
from fullswarm.agent.tasks import Task
from fullswarm.bus.base import Bus
from fullswarm.config import AgentConfig
from fullswarm.errors import FullswarmError
from fullswarm.keys import Keys
from fullswarm.messages import Command, ControlAck, ControlRequest, EStop, EStopReceipt, Heartbeat, StopRequest
from fullswarm.runtime import Scheduler

if TYPE_CHECKING:
    from fullswarm.agent.node import AgentNode

REMEMBERED_STOPS = 256
SETTLE_TIMEOUT_S = 5.0
"""A robot that still moves so long after an e-stop is reported as not standing, and not watched further."""


@dataclass(slots=True)
class Rolling:
    """A robot between an e-stop and standing."""

    order: EStop
    since_s: float
    last_xy: tuple[float, float]
    rolled_m: float = 0.0


class Inbox:
    """Applies what arrives to the agent's tasks and controller, and answers it."""

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, config: AgentConfig, agent: AgentNode) -> None:
        self._bus, self._keys, self._scheduler, self._config, self._agent = bus, keys, scheduler, config, agent
        ids = agent.fleet.ids
        self._row = {robot: row for row, robot in enumerate(ids)}
        self._core_heard_s = -math.inf
        self._newest: list[tuple[str, int]] = [("", 0)] * len(ids)
        self._answers: list[ControlAck | None] = [None] * len(ids)
        self._command_sequence: list[tuple[str, str, int]] = [("", "", -1)] * len(ids)
        self._freshness = [Freshness() for _ in ids]
        self._spent = [""] * len(ids)
        self._stops: OrderedDict[str, None] = OrderedDict()
        self._rolling: dict[int, Rolling] = {}
        self._receipts: dict[int, EStopReceipt] = {}
        whose = ids[0] if len(ids) == 1 else "*"
        self._subscriptions = [
            bus.subscribe(keys.control_requests(whose), ControlRequest, self._on_control),
            bus.subscribe(keys.command(whose), Command, self._on_command, latest=True),
            bus.subscribe(keys.stop, StopRequest, self._on_stop),
            bus.subscribe(keys.estop, EStop, self._on_estop),
            bus.subscribe(keys.heartbeat("core"), Heartbeat, self._on_heartbeat, latest=True),
        ]

    def core_alive(self, now_s: float) -> bool:
        """Tell whether the core's heartbeat was heard within the configured silence."""
        return now_s - self._core_heard_s <= self._config.core_silence_s

    def _on_heartbeat(self, _: Heartbeat) -> None:
        self._core_heard_s = self._scheduler.now_s()

    # ------------------------------------------------------------------ behaviours
    def _on_control(self, request: ControlRequest) -> None:
        row = self._row.get(request.robot)
        if row is None:
            return
        core, sequence = self._newest[row]
        if request.core == core and request.sequence <= sequence:
            # Delivered again: nothing changes, but the answer may have been lost.
            answer = self._answers[row]
            if answer and request.sequence == sequence:
                self._bus.publish(self._keys.ack(request.robot), answer)
            return
        self._newest[row] = (request.core, request.sequence)
        accepted, reason = self._apply(row, request)
        task = self._agent.tasks.of[row]
        answer = ControlAck(
            request_id=request.request_id,
            robot=request.robot,
            behaviour=request.behaviour,
            enabled=task is not None and task.request.request_id == request.request_id,
            accepted=accepted,
            reason=reason,
            core=request.core,
            sequence=request.sequence,
        )
        self._answers[row] = answer
        self._agent.wake()
        self._bus.publish(self._keys.ack(request.robot), answer)

    def _apply(self, row: int, request: ControlRequest) -> tuple[bool, str]:
        agent = self._agent
        if not request.enable:
            agent.tasks.disable(row)
            agent.controller.forget(row)
            return True, ""
        if request.request_id == self._spent[row]:
            return False, f"{agent.ended[row]}; ask for it again"
        if agent.controller.estop[row]:
            return False, "its e-stop is latched; clear it with `fullswarm estop --clear`"
        try:
            agent.tasks.enable(row, Task(request, self._scheduler.now_s()))
        except FullswarmError as error:
            return False, str(error)
        agent.controller.law_failed[row] = False
        agent.ended[row] = ""
        if request.centralised:
            agent.controller.forget(row)
        return True, ""

    def spend(self, row: int, why: str) -> None:
        """End robot `row`'s task for good: the same request, sent again by reconciliation, is refused from now on."""
        task = self._agent.tasks.of[row]
        if task is None:
            return
        self._spent[row] = task.request.request_id
        self._agent.ended[row] = why
        self._agent.tasks.disable(row)
        self._agent.controller.forget(row)

    def _on_command(self, command: Command) -> None:
        row = self._row.get(command.robot)
        task = self._agent.tasks.of[row] if row is not None else None
        if row is None or task is None or not task.request.centralised:
            return
        if command.request_id != task.request.request_id:
            return
        core, request_id, sequence = self._command_sequence[row]
        if (core, request_id) == (task.request.core, command.request_id) and command.sequence <= sequence:
            return
        self._command_sequence[row] = (task.request.core, command.request_id, command.sequence)
        now_s = self._scheduler.now_s()
        ttl_s = min(command.ttl_s, self._config.command_ttl_s)
        delay_s = self._freshness[row].delay_s(task.request.core, command.stamp_s, now_s)
        finite = math.isfinite(command.linear_m_s) and math.isfinite(command.angular_rad_s)
        if delay_s >= ttl_s or not finite:
            return
        self._agent.controller.submit(row, command.linear_m_s, command.angular_rad_s, now_s + ttl_s - delay_s)
        self._agent.wake()

    # ------------------------------------------------------------------ stops
    def _on_stop(self, stop: StopRequest) -> None:
        if stop.id in self._stops:
            return
        self._stops[stop.id] = None
        if len(self._stops) > REMEMBERED_STOPS:
            self._stops.popitem(last=False)
        for row in self._addressed(stop.robots):
            self._agent.tasks.disable(row)
            self._agent.controller.forget(row)
        self._agent.wake()

    def _on_estop(self, order: EStop) -> None:
        agent, now_s = self._agent, self._scheduler.now_s()
        for row in self._addressed(order.robots):
            receipt = self._receipts.get(row)
            if receipt and receipt.id == order.id:
                self._bus.publish(self._keys.estop_receipt(receipt.robot), receipt)
                continue
            if order.engaged:
                agent.controller.estop[row] = True
                x, y = float(agent.pose[row, 0]), float(agent.pose[row, 1])
                self._rolling[row] = Rolling(order, now_s, (x, y))
            else:
                agent.controller.estop[row] = False
                self._rolling.pop(row, None)
            # Latching ends the behaviour: after the release a robot stands READY until it is asked again.
            agent.tasks.disable(row)
            agent.controller.forget(row)
            self._receive(row, EStopReceipt(id=order.id, robot=agent.fleet.ids[row], engaged=order.engaged))
        agent.wake()

    def watch_estops(self, now_s: float) -> None:
        """Follow the robots that still roll; confirm again once they stand, with the distance."""
        agent = self._agent
        for row, rolling in list(self._rolling.items()):
            x, y = float(agent.pose[row, 0]), float(agent.pose[row, 1])
            rolling.rolled_m += math.hypot(x - rolling.last_xy[0], y - rolling.last_xy[1])
            rolling.last_xy = (x, y)
            standing = bool(abs(agent.twist[row, 0]) < 0.005 and abs(agent.twist[row, 1]) < 0.02)
            # Two ticks at least: the first reading after the order still shows the motion before it.
            if (standing and now_s - rolling.since_s > 0.04) or now_s - rolling.since_s > SETTLE_TIMEOUT_S:
                del self._rolling[row]
                self._receive(
                    row,
                    EStopReceipt(
                        id=rolling.order.id,
                        robot=agent.fleet.ids[row],
                        engaged=True,
                        rolled_m=rolling.rolled_m if math.isfinite(rolling.rolled_m) else 0.0,
                        standing=standing,
                    ),
                )

    def _receive(self, row: int, receipt: EStopReceipt) -> None:
        self._receipts[row] = receipt
        self._bus.publish(self._keys.estop_receipt(receipt.robot), receipt)

    def _addressed(self, robots: tuple[str, ...]) -> list[int]:
        if not robots:
            return list(self._row.values())
        return [self._row[robot] for robot in robots if robot in self._row]

    def close(self) -> None:
        """Stop listening."""
        for subscription in self._subscriptions:
            subscription.close()
