"""Receives control requests, commands, stops, e-stops and heartbeats, carries them out and answers them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Literal

import structlog

from fullswarm.agent.message_delay import MessageDelay
from fullswarm.agent.motion.robot_controller import RobotController, explain_hazards
from fullswarm.agent.orders.charging import Charging
from fullswarm.agent.orders.estops import EStops, LatchFolder
from fullswarm.agent.orders.tasks import Task, Tasks, simulated_only
from fullswarm.agent.pose.conflicts import PoseConflicts
from fullswarm.agent.state import AgentState
from fullswarm.bus.base import Bus
from fullswarm.config import AgentConfig
from fullswarm.drivers.base import Fleet, Hazard
from fullswarm.errors import FullswarmError
from fullswarm.fitness import unfit
from fullswarm.keys import Keys
from fullswarm.messages import (
    Command,
    ControlAck,
    ControlRequest,
    EStop,
    Halt,
    Heartbeat,
    Ping,
    Result,
    RobotProfile,
    StopRequest,
)
from fullswarm.reasons import DELIBERATE, NONE, Code, Reason, given, reason, voided
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler

log = structlog.get_logger()

REMEMBERED_STOPS = 256
REPORT_S = 1.0
"""Between two log lines about releases that do not count."""
KEEP_S = 0.2
"""Between two writes of stops and of the requests that have ended."""
SIMULATED = "sim"
"""Make of a robot whose driver is that of the simulated world; one that is emulated has the driver of its make."""

UNSAFE = int(Hazard.CLIFF | Hazard.WHEEL_DROP | Hazard.OVERCURRENT | Hazard.MOTORS_OFF)
"""No request is accepted meanwhile. A stop button is not among them: some drivers need a new request to release it. A
switch is: what is requested meanwhile would start when a person at the robot turns it."""


class Inbox:
    """Applies what arrives to the agent's tasks and controller, and answers it.

    Parameters
    ----------
    wake : acts on the change now instead of at the next tick
    profile : returns what a robot is and can do now

    Attributes
    ----------
    ended : why the last task of each robot was ended on board; false: it was not
    results : how it was ended by its own control law; None: it was not
    charging : interrupts tasks so that robots charge
    answered : core and sequence of the newest control request that each robot has answered
    halts : the stop or e-stop since which each robot has started nothing; None: it has started something
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, config: AgentConfig, fleet: Fleet, state: AgentState,
        tasks: Tasks, controller: RobotController, conflicts: PoseConflicts, wake: Callable[[], None],
        profile: Callable[[int], RobotProfile],
    ) -> None:  # fmt: skip
        self._bus, self._keys, self._scheduler, self._config = bus, keys, scheduler, config
        self._fleet, self._state, self._tasks, self._controller = fleet, state, tasks, controller
        self._conflicts, self._wake, self._profile = conflicts, wake, profile
        ids = fleet.ids
        self.ended = [NONE] * len(ids)
        self.results: list[Result | None] = [None] * len(ids)
        self.halts: list[Halt | None] = [None] * len(ids)
        self._row = {robot: row for row, robot in enumerate(ids)}
        self._cores = Cores(config.core_silence_s)
        self._epochs = [CoreEpoch(self._cores) for _ in ids]
        self.answered: list[tuple[str, int]] = [("", 0)] * len(ids)
        self._answers: list[ControlAck | None] = [None] * len(ids)
        self._command_sequence: list[tuple[str, str, int]] = [("", "", -1)] * len(ids)
        self._delays = [MessageDelay() for _ in ids]
        self._stops: Recent[str, None] = Recent(REMEMBERED_STOPS)
        self._folder: LatchFolder | None = None
        self._reported_s = -math.inf
        self._unkept, self._kept_s = set[int](), -math.inf  # robots whose newest stop or ended request is not on disk
        self.charging = Charging(
            bus, keys, scheduler, fleet, state, tasks,
            replaced=lambda row, core: self._epochs[row].replaced(core, scheduler.now_s()), halts=self.halts,
            end=self.void, forget=controller.forget,
        )  # fmt: skip
        self.estops = EStops(bus, keys, config.control_rate_hz, fleet, state, controller.speed_limit, wake)
        robot = ids[0] if len(ids) == 1 else "*"
        self._subscriptions = [
            bus.subscribe(keys.control_requests(robot), ControlRequest, self._on_control),
            bus.subscribe(keys.command(robot), Command, self._on_command, latest=True),
            bus.subscribe(keys.stop, StopRequest, self._on_stop),
            bus.subscribe(keys.estop, EStop, self._on_estop),
            bus.subscribe(keys.heartbeat("core"), Heartbeat, self._on_heartbeat, latest=True),
            bus.subscribe(keys.ping(robot), Ping, self._on_ping),
        ]

    def core_alive(self, now_s: float) -> bool:
        """Tell whether a core's heartbeat was received within the configured silence."""
        return self._cores.any_alive(now_s)

    def core_age_s(self, now_s: float) -> float:
        """Return how long ago a core's heartbeat was received, in seconds; infinity when none ever was."""
        return self._cores.age_s(now_s)

    def _on_heartbeat(self, beat: Heartbeat) -> None:
        self._cores.beat(beat.process, self._scheduler.now_s())

    def _on_ping(self, ping: Ping) -> None:
        if ping.robot in self._row:
            self._bus.publish(self._keys.pong(ping.robot), ping)

    # ------------------------------------------------------------------ behaviours
    def _on_control(self, request: ControlRequest) -> None:
        row = self._row.get(request.robot)
        if row is None:
            return
        if self._epochs[row].replaced(request.core, self._scheduler.now_s()):
            answer = self._answer(row, request, reason(Code.OTHER_CORE))
            self._bus.publish(self._keys.ack(request.robot), answer)
            return
        if self._sent_before_halt(row, request):
            self._wake()  # the next report tells the core
            return
        core, sequence = self.answered[row]
        if request.core == core and request.sequence <= sequence:
            # Delivered again: nothing changes, but the answer may have been lost.
            last = self._answers[row]
            if last and request.sequence == sequence:
                self._bus.publish(self._keys.ack(request.robot), last)
            return
        self.answered[row] = (request.core, request.sequence)
        why_not = self._apply(row, request)
        self._wake()  # the wheels before the answer
        self._answers[row] = answer = self._answer(row, request, why_not)
        self._bus.publish(self._keys.ack(request.robot), answer)

    def _sent_before_halt(self, row: int, request: ControlRequest) -> bool:
        """Tell whether the core did not know the robot's newest stop yet: it is ignored, and sent again if it holds."""
        halt = self.halts[row]
        return request.enable and halt is not None and request.halts is not None and halt.id not in request.halts

    def _answer(self, row: int, request: ControlRequest, why_not: Reason) -> ControlAck:
        task = self._tasks.asked(row)
        return ControlAck(
            request_id=request.request_id,
            robot=request.robot,
            behaviour=request.behaviour,
            enabled=task is not None and task.request.request_id == request.request_id,
            accepted=not why_not,
            reason=why_not.text,
            code=why_not.code,
            parameters=dict(why_not.parameters),
            core=request.core,
            sequence=request.sequence,
        )

    def _apply(self, row: int, request: ControlRequest) -> Reason:
        """Do what is asked; return why not, false if it is done."""
        epoch = self._epochs[row]
        if not request.enable:
            self._supersede(row, request, self._tasks.asked(row))
            self._drop(row)
            return NONE
        epoch.see(request)
        if self._state.estop[row]:
            return reason(Code.ESTOP_LATCHED)
        if (why := epoch.why_void(request.request_id)) is not None:
            return voided(why)
        hazards = 0 if self._state.reading is None else int(self._state.reading.hazards[row])
        if hazards & UNSAFE:
            # If accepted, the robot would drive off while a person puts it back on safe ground.
            seen, remedy = explain_hazards(hazards, self._fleet.fault(row))
            return Reason(seen.code, f"{seen}; {remedy}, then ask for it again", seen.parameters)
        if request.expires_s <= 0.0:
            if self._state.battery_low[row]:
                return reason(Code.BATTERY)
            conflict = self._conflicts.reason(row)
            if conflict:
                return conflict
        if request.needs is not None and (lacks := unfit(request.needs, self._profile(row))):
            return lacks
        task, before = Task(request, self._sent_s(row, request)), self._tasks.of[row]
        try:
            new_law = before is None or before.law != task.law
            if new_law and self._fleet.descriptions[row].make != SIMULATED and simulated_only(task.law):
                return reason(Code.SIMULATED_ONLY, law=task.law)
            replaced = self._tasks.asked(row)
            if not self.charging.take(row, task):
                self._tasks.enable(row, task)
        except FullswarmError as error:
            return given(str(error))
        self._supersede(row, request, replaced)
        if self.halts[row] is not None:
            self.halts[row] = None
            self._unkept.add(row)
        self._controller.law_failed[row] = False
        self.ended[row], self.results[row] = NONE, None
        if request.centralised:
            self._controller.forget(row)
        return NONE

    def _supersede(self, row: int, request: ControlRequest, replaced: Task | None) -> None:
        """Have the request that another one replaces start here no more: a core that lost its newest entries sends it.

        Intents end by themselves.
        """
        if replaced is None or replaced.expires_at_s < math.inf or replaced.request.request_id == request.request_id:
            return
        self._epochs[row].void(replaced.request, reason(Code.SUPERSEDED, by=request.request_id))
        self._unkept.add(row)

    def _sent_s(self, row: int, request: ControlRequest) -> float:
        """Return when an intent was sent, as far as can be known: it lives from then on, not from its arrival."""
        now_s = self._scheduler.now_s()
        if request.expires_s <= 0.0 or request.stamp_s == 0.0:
            return now_s
        return now_s - self._delays[row].delay_s(request.core, request.stamp_s, now_s)

    def void(self, row: int, why: Reason) -> None:
        """End robot `row`'s task for good: the same request, sent again by reconciliation, is refused from now on."""
        task = self._tasks.asked(row)
        if task is None:
            if self.charging.away(row):
                self._drop(row)
            return
        self._epochs[row].void(task.request, why)
        if task.expires_at_s == math.inf:
            self._unkept.add(row)
        self.ended[row] = why
        self._drop(row)

    def end(self, row: int, outcome: Literal["arrived", "failed"], text: str) -> None:
        """End robot `row`'s task as its own control law has decided, and keep the result for the core."""
        task = self._tasks.of[row]
        if task is None:
            return
        code = Code.ARRIVED if outcome == "arrived" else Code.FAILED
        request, said = task.request, text or "no more is said"
        self.void(row, reason(code, behaviour=request.behaviour, text=said))
        if request.stays:
            self._tasks.team[row] = request.team  # the others still count it, until its next request or stop
        self.results[row] = Result(request_id=request.request_id, robot=request.robot, outcome=outcome, text=text)

    def _drop(self, row: int) -> None:
        self.charging.call_off(row)
        self._tasks.disable(row)
        self._controller.forget(row)

    def _on_command(self, command: Command) -> None:
        row = self._row.get(command.robot)
        task = self._tasks.of[row] if row is not None else None
        if row is None or task is None or not task.request.centralised:
            return
        if command.request_id != task.request.request_id:
            return
        if not math.isfinite(command.linear_m_s + command.angular_rad_s + command.ttl_s + command.stamp_s):
            return
        core, request_id, sequence = self._command_sequence[row]
        if (core, request_id) == (task.request.core, command.request_id) and command.sequence <= sequence:
            return
        # A core numbers requests and commands in one row: what is older than the request comes from another core.
        if command.sequence < task.request.sequence:
            return
        self._command_sequence[row] = (task.request.core, command.request_id, command.sequence)
        now_s = self._scheduler.now_s()
        ttl_s = min(command.ttl_s, self._config.command_ttl_s)
        delay_s = self._delays[row].delay_s(task.request.core, command.stamp_s, now_s)
        if delay_s >= ttl_s:
            return
        self._controller.submit(row, command.linear_m_s, command.angular_rad_s, now_s + ttl_s - delay_s)
        self._wake()

    # ------------------------------------------------------------------ stops
    def _on_stop(self, stop: StopRequest) -> None:
        if stop.id in self._stops:
            return
        if stop.id:
            self._stops[stop.id] = None
        rows = self._addressed(stop.robots)
        for row in rows:
            self._halt(row, reason(Code.STOPPED, by=stop.source or "an operator"))
            self._note_halt(row, stop, estop=False)
        self._wake()
        self._unkept.update(rows)
        self._keep()

    def _on_estop(self, order: EStop) -> None:
        addressed = self._addressed(order.robots)
        rows = self.estops.in_force(order, addressed)
        if len(rows) < len(addressed):
            self._report_old_release(order)
        if self.estops.repeats(order):
            return
        for row in rows:
            # Latching ends the behaviour, and so does the release: what was asked for before it, and refused, must
            # not be started by it. Releasing a robot that is not latched stops nothing.
            if order.engaged or self._state.estop[row]:
                code = Code.ESTOP_ENGAGED if order.engaged else Code.ESTOP_RELEASED
                self._halt(row, reason(code, by=order.source or "an operator"))
            if order.engaged:  # its release starts nothing, so the e-stop itself remains what the core must know
                self._note_halt(row, order, estop=True)
        self.estops.carry_out(order, rows, self._scheduler.now_s())
        if order.engaged:
            self._unkept.update(rows)
            self._keep()

    def remember_latches(self, folder: LatchFolder) -> None:
        """Keep latches and stops in `folder`, latch the robots that it names, and take up the stops it has kept."""
        self._folder = folder
        self.estops.remember(folder)
        for row, robot in enumerate(self._fleet.ids):
            kept = folder.halt_of(robot, self._scheduler.now_s())
            self.halts[row] = halt = kept.halt
            self._epochs[row].recall(kept.voided, given("it ended before the robot's agent was restarted"))
            if self._state.estop[row] and (halt is None or not halt.estop):
                self._note_halt(row, None, estop=True)

    def _halt(self, row: int, why: Reason) -> None:
        """Stop a robot and void all its requests, also for a core that does not receive the stop."""
        self._epochs[row].halt(why)
        self.void(row, why)
        if self.ended[row] and self.ended[row].code not in DELIBERATE:
            self.ended[row] = why  # who stops a robot that had stopped by itself has seen that
        self._drop(row)

    def _note_halt(self, row: int, order: StopRequest | EStop | None, *, estop: bool) -> None:
        now_s = self._scheduler.now_s()
        halt = Halt(id=f"unnamed {now_s:.3f}", estop=estop, stamp_s=now_s)
        if order is not None:  # without an id it cannot be known again: each one counts
            halt = Halt(
                id=order.id or halt.id, source=order.source, estop=estop, stamp_s=now_s,
                clock=(order.clock or order.source) if order.stamp_s else "", ordered_s=order.stamp_s,
            )  # fmt: skip
        self.halts[row] = halt

    def _keep(self) -> None:
        """Keep what robots must know after a restart; the wheels come first. A flood is written now and then."""
        folder, now_s = self._folder, self._scheduler.now_s()
        if folder is None or now_s - self._kept_s < KEEP_S:
            return
        rows, self._unkept, self._kept_s = self._unkept, set(), now_s
        for row in rows:
            folder.keep_halt(self._fleet.ids[row], self.halts[row], self._epochs[row].lasting_voided())

    def watch_estops(self, now_s: float) -> None:
        """Confirm the e-stops of robots that have come to a standstill, and keep what has not been kept yet."""
        if self._unkept:
            self._keep()
        self.estops.watch(now_s)

    def _report_old_release(self, order: EStop) -> None:
        """Log a release that does not count, once per second: it came late, or was recorded and sent again."""
        now_s = self._scheduler.now_s()
        if now_s - self._reported_s >= REPORT_S:
            self._reported_s = now_s
            log.warning("release ignored: it is older than the e-stop", id=order.id, source=order.source)

    def _addressed(self, robots: Iterable[str]) -> list[int]:
        rows = [self._row[robot] for robot in dict.fromkeys(robots) if robot in self._row]
        return rows if robots else list(self._row.values())

    def close(self) -> None:
        """Drop all subscriptions."""
        self.charging.close()
        for subscription in self._subscriptions:
            subscription.close()


REMEMBERED = 64
"""Cores, and requests of each robot: other processes choose their names, so their number must be bounded."""


class Cores:
    """Core processes by their heartbeats."""

    def __init__(self, silence_s: float) -> None:
        self._silence_s = silence_s
        self._received_s: Recent[str, float] = Recent(REMEMBERED)
        self._newest_s = -math.inf

    def beat(self, process: str, now_s: float) -> None:
        """Take a heartbeat."""
        self._received_s[process] = self._newest_s = now_s

    def alive(self, process: str, now_s: float) -> bool:
        """Tell whether the process was received within the configured silence."""
        return now_s - self._received_s.get(process, -math.inf) <= self._silence_s

    def any_alive(self, now_s: float) -> bool:
        """Tell whether any core was."""
        return now_s - self._newest_s <= self._silence_s

    def age_s(self, now_s: float) -> float:
        """Return how long ago any core was received, in seconds; infinity when none ever was."""
        return now_s - self._newest_s


class CoreEpoch:
    """Decides which core one robot obeys and which requests it refuses.

    Intents of a stick are remembered apart: there are ten new ones a second, and the others must outlast them.
    """

    def __init__(self, cores: Cores) -> None:
        self._cores = cores
        self._core = ""
        self._replaced: Recent[str, None] = Recent(REMEMBERED)
        self._seen: Recent[str, None] = Recent(REMEMBERED)
        self._voided: Recent[str, Reason] = Recent(REMEMBERED)
        self._seen_intents: Recent[str, None] = Recent(REMEMBERED)
        self._voided_intents: Recent[str, Reason] = Recent(REMEMBERED)

    def replaced(self, core: str, now_s: float) -> bool:
        """Tell whether `core` has been replaced by another one, so that its messages are late; else follow it.

        A replaced core is followed again when it alone lives: then the other one was started by mistake.
        """
        if core == self._core:
            return False
        if core in self._replaced and (self._cores.alive(self._core, now_s) or not self._cores.alive(core, now_s)):
            return True
        self._replaced.pop(core, None)
        if self._core:
            self._replaced[self._core] = None
        self._core = core
        return False

    def see(self, request: ControlRequest) -> None:
        """Remember a request that was to start here."""
        (self._seen_intents if request.expires_s > 0.0 else self._seen)[request.request_id] = None

    def void(self, request: ControlRequest, why: Reason) -> None:
        """Have a request start here no more."""
        (self._voided_intents if request.expires_s > 0.0 else self._voided)[request.request_id] = why

    def why_void(self, request_id: str) -> Reason | None:
        """Return why a request may not start again; None: it may."""
        table = self._voided if request_id in self._voided else self._voided_intents
        return table.get(request_id)

    def halt(self, why: Reason) -> None:
        """Void every request seen so far: a stop overrules also those that are wanted but not running."""
        for seen, table in ((self._seen, self._voided), (self._seen_intents, self._voided_intents)):
            for request_id in seen:
                table[request_id] = why

    def lasting_voided(self) -> tuple[str, ...]:
        """Return the requests that may not start again, the newest last, without intents: those end by themselves."""
        return tuple(self._voided)

    def recall(self, request_ids: Iterable[str], why: Reason) -> None:
        """Void requests that a process before this one has voided."""
        for request_id in request_ids:
            self._voided[request_id] = why
