"""A live swarm under faults: each request is carried out once, in order, and nothing else happens.

Hub, core, centralised behaviours and one agent per robot are processes of a supervisor, as `fullswarm up` starts them;
three operator processes (two of one person) send request after request; every few seconds something is killed, paused,
cut off or finds its disk full. A judge that shares no code with the core counts; the simulated world runs in this
process, where its bodies can be observed.
"""

from __future__ import annotations

import json
import math
import shutil
import signal
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import msgspec

from fullswarm.audit.verify import verify
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock, clock_id
from fullswarm.config import SwarmConfig
from fullswarm.errors import Unreachable
from fullswarm.keys import Keys
from fullswarm.launch.network import on_free_ports
from fullswarm.launch.supervisor import STORE, Supervisor
from fullswarm.launch.world import WorldNode, compile_kernels
from fullswarm.messages import (
    BehaviourRequest,
    ControlAck,
    ControlRequest,
    EStop,
    EStopReceipt,
    HealthReport,
    Heartbeat,
    Message,
    RequestStatus,
    RobotHealth,
    StopRequest,
)
from fullswarm.operator.client import Operator
from fullswarm.reasons import Code
from fullswarm.rehearse.live.judge import Ask, Doing, Down, Published, Ran, Record
from fullswarm.rehearse.live.plan import DISK_FULL, Fault, conditions, plan
from fullswarm.runtime import Mailbox, Runtime

OPERATOR_MODULE = "fullswarm.rehearse.live.operator_process"
LOSS = 0.01
"""Share of all messages that is lost all the time."""
OPERATORS = (("ann", "ann-shell"), ("ann", "ann-pad"), ("bob", "bob-shell"))
LOOK_S, STOOD_S = 0.1, 0.3
"""How often bodies are looked at; this process, and with it the world, did not run for a gap longer than the second."""
FRESH_S = 1.2
SETTLE_S = 12.0
FORGET_S = 30.0
MOVES_M_S, MOVES_RAD_S = 0.03, 0.1
SHOWN = 20
"""Of each kind of what was wrong, so many are printed."""
STANDS = frozenset({Code.HUB, Code.CORE, Code.STALE, Code.DRIVER, Code.DRIVER_FAILED, Code.CLOCK, Code.READING})
"""Reasons for standing that come from a fault; at the edge of the arena a robot stands by right."""


@dataclass(slots=True)
class Watch:
    """Waits for the end of one fault's effects."""

    fault: Fault
    began_s: float
    left: set[str]
    ready: Callable[[str], bool]
    took_s: float = math.inf


@dataclass(slots=True)
class Seen:
    """The newest of one robot."""

    t: float = -math.inf
    process: str = ""
    health: RobotHealth | None = None
    wanted: str = ""  # the request it is to run, as the core accepted it last; empty: none


@dataclass
class LiveRehearsal:
    """The swarm, its operators and its faults."""

    robots: int
    seconds: float
    every_s: float
    seed: int
    loss: float
    record: Record = field(default_factory=Record)
    watches: list[Watch] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.runtime = Runtime(MonotonicClock(), Mailbox())
        names = tuple(f"r{number + 1}" for number in range(self.robots))
        self.faults = plan(names, self.seconds, self.every_s, self.seed)
        self.warm_s = 20.0 + 2.0 * self.robots
        self.zero_s = self.runtime.now_s() + self.warm_s
        side_m = 4.0 * math.ceil(math.sqrt(self.robots)) + 4.0
        columns = math.ceil(math.sqrt(self.robots))
        settings: dict[str, Any] = {
            "swarm": "rehearsal",
            "world": {"engine": "kinematic", "bounds_m": [0, 0, side_m, side_m]},
            "network": {"conditions": conditions(self.faults, self.loss), "seed": self.seed, "since_s": self.zero_s},
            "robot": [
                {"id": name, "pose": [4.0 + 4.0 * (row % columns), 4.0 + 4.0 * (row // columns), 0.0]}
                for row, name in enumerate(names)
            ],
        }
        self.config = on_free_ports(SwarmConfig.model_validate(settings))
        self.keys = Keys(self.config.swarm)
        self.supervisor = Supervisor(self.config, self.runtime, world=False)
        self.folder = self.supervisor.folder
        self.events = (self.folder / "events.jsonl").open("w", encoding="utf-8")
        self.bus = ZenohBus(self.runtime.mailbox, hub=self.config.hub.endpoint)
        compile_kernels(self.config)  # else what robots see of each other takes a third of a core
        self.world = WorldNode(self.bus, self.runtime, self.config, "world-here")
        self.me = Operator(self.bus, self.keys, self.runtime, "rehearsal", name="eve", clock=clock_id())
        self.seen = {name: Seen() for name in names}
        self.beats: dict[str, tuple[float, str]] = {}
        self.last: dict[str, BehaviourRequest] = {}  # by the requesting process
        self.down: dict[str, float] = {}
        self.up_s: dict[str, float] = {}
        self.looked_s = math.inf
        self.people: dict[str, subprocess.Popen[bytes]] = {}
        self.starts: dict[str, int] = defaultdict(int)
        self.accepted: set[str] = set()
        self.hub_killed = False
        self.dead_processes: dict[str, float] = {}
        for key, kind, handler in (
            (self.keys.behaviour_request, BehaviourRequest, self._requested),
            (self.keys.behaviour_status, RequestStatus, self._status),
            (self.keys.stop, StopRequest, self._stopped),
            (self.keys.estop, EStop, self._note),
            (self.keys.estop_receipt(), EStopReceipt, self._receipt),
            (self.keys.control_requests("*"), ControlRequest, self._note),
            (self.keys.ack(), ControlAck, self._acknowledged),
            (self.keys.health(), HealthReport, self._reported),
            (self.keys.heartbeat("core"), Heartbeat, self._beat),
            (self.keys.heartbeat("centralised"), Heartbeat, self._beat),
        ):
            self.bus.subscribe(key, kind, handler)  # type: ignore[arg-type]  # each pair fits

    # ------------------------------------------------------------------ what is seen
    def _write(self, kind: str, **fields: object) -> None:
        line = {"t": round(self.runtime.now_s() - self.zero_s, 3), "kind": kind, **fields}
        self.events.write(json.dumps(line) + "\n")

    def _note(self, message: Message) -> None:
        self._write(type(message).__name__, message=msgspec.to_builtins(message))

    def _requested(self, request: BehaviourRequest) -> None:
        self._note(request)
        if request.behaviour == "stop":  # the same stop as a `StopRequest`, with the time at which it was sent
            robots = request.robots or self.config.robots
            self.record.asks[request.id] = Ask(request.stamp_s, request.operator, request.id, "", robots)
        else:
            self.last[request.source] = request

    def _stopped(self, stop: StopRequest) -> None:
        robots, person = stop.robots or self.config.robots, stop.source.partition("-")[0]
        # A robot reports a stop that is still in force to a new core: "<id>@<robot>" has the time of <id>.
        first = self.record.asks.get(stop.id.partition("@")[0])
        asked_s = first.t if first is not None else self.runtime.now_s()
        self.record.asks.setdefault(stop.id, Ask(asked_s, person, stop.id, "", robots))
        self._note(stop)

    def _status(self, status: RequestStatus) -> None:
        now_s = self.runtime.now_s()
        published = Published(now_s, status.request_id, status.phase, status.robots, status.running, status.refused_by)
        known = status.request_id in self.accepted
        self.record.published.append(published)
        self._note(status)
        idle = status.behaviour == "stop"
        if not known and status.phase not in ("refused", "superseded", "ended"):
            self.accepted.add(status.request_id)
            for robot in status.robots:
                self.seen[robot].wanted = "" if idle else status.request_id
        for robot in status.refused_by:
            if self.seen[robot].wanted == status.request_id:
                self.seen[robot].wanted = ""
        if idle:
            self.record.standing += [(now_s, robot, status.request_id) for robot in status.running]

    def _receipt(self, receipt: EStopReceipt) -> None:
        self._note(receipt)
        if receipt.engaged and receipt.standing:
            self.record.standing.append((self.runtime.now_s(), receipt.robot, receipt.id))

    def _acknowledged(self, ack: ControlAck) -> None:
        self._note(ack)
        if ack.accepted and ack.enabled:
            process, central = self.seen[ack.robot].process, "assigned" in ack.behaviour
            now_s = self.runtime.now_s()
            self.record.ran.append(Ran(now_s, ack.robot, ack.request_id, process, ack.core, ack.sequence, central))

    def _reported(self, report: HealthReport) -> None:
        now_s = self.runtime.now_s()
        for health in report.robots:
            seen = self.seen[health.robot]
            if seen.process and seen.process != report.process:
                self._up(health.robot, report.stamp_s)
            words = _words(health)
            if seen.health is None or seen.process != report.process or _words(seen.health) != words:
                self._write("Health", robot=health.robot, process=report.process, **words)
            if health.behaviour:
                self.record.seen.add((health.robot, health.request_id))
            seen.t, seen.process, seen.health = now_s, report.process, health

    def _beat(self, beat: Heartbeat) -> None:
        before = self.beats.get(beat.node)
        if before is not None and before[1] != beat.process:
            # Its first beat, also where this process was too busy to receive that in time.
            self._up(beat.node, beat.stamp_s - (beat.sequence - 1) / self.config.core.heartbeat_hz)
            self._write("Started", node=beat.node, process=beat.process)
        self.beats[beat.node] = self.runtime.now_s(), beat.process

    def _look(self) -> None:
        """Check, ten times a second, which bodies move and which robots have recovered."""
        now_s, world = self.runtime.now_s(), self.world.world
        if now_s - self.looked_s > STOOD_S:
            self.record.stood.append((self.looked_s, now_s))
        self.looked_s = now_s
        for row, robot in enumerate(self.config.robots):
            speed_m_s, turn_rad_s = abs(world.twist[row]).tolist()
            if speed_m_s > MOVES_M_S or turn_rad_s > MOVES_RAD_S:
                self.record.moved.append((now_s, robot))
        if self.hub_killed and self.supervisor.alive("hub") and self.bus.connected():
            self.hub_killed = False
            self._up("hub")
        for watch in self.watches:
            if watch.took_s == math.inf and now_s - watch.began_s < FORGET_S:
                watch.left = {name for name in watch.left if not watch.ready(name)}
                if not watch.left:
                    watch.took_s = now_s - watch.began_s

    # ------------------------------------------------------------------ what goes wrong
    def _go_down(self, name: str) -> None:
        self.down.setdefault(name, self.runtime.now_s())

    def _up(self, name: str, at_s: float = math.inf) -> None:
        """Record the end of an outage, at `at_s` if that is known better than by when it was received."""
        now_s = self.runtime.now_s()
        since_s, self.up_s[name] = self.down.pop(name, None), now_s
        if since_s is not None:
            self.record.downs.append(Down(name, since_s, min(at_s, now_s)))

    def inject(self, fault: Fault) -> None:
        """Let one fault happen."""
        self._write("Fault", number=fault.number, fault=fault.kind, robots=fault.robots, lasts_s=fault.lasts_s)
        what = fault.kind.partition(" ")[0]
        if fault.kind == "robots cut off":
            for robot in fault.robots:
                self._go_down(f"link of {robot}")
            self.runtime.after(fault.lasts_s, lambda: self._joined(fault))
        elif fault.kind == "late request":
            self._send_late(fault)
        elif fault.kind == "e-stop":
            self._press(fault)
        elif fault.kind == DISK_FULL:
            self._fill_disk(fault)
        elif what == "operator":
            self._replace_operator(fault)
        elif fault.kind.endswith("killed"):
            name = fault.robots[0] if what == "agent" else what
            self._go_down(name)
            self.supervisor.kill(name)
            self.hub_killed |= name == "hub"
            self._wait_for(fault, self._affected(fault), name)
        else:
            name = fault.robots[0] if what == "agent" else what
            self._go_down(name)
            process = self.supervisor.children[name].process
            self.supervisor.kill(name, signal.SIGSTOP)
            self.runtime.after(fault.lasts_s, lambda: self._go_on(fault, name, process))

    def _fill_disk(self, fault: Fault) -> None:
        """Let no file of the core grow for a while: what a full disk does to it, without one for everybody else."""
        process = self.supervisor.children["core"].process
        if process is None or process.poll() is not None:
            return
        import resource  # Linux only

        before = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (0, before[1]))
        self._go_down(DISK_FULL)

        def empty() -> None:
            with suppress(ProcessLookupError):  # it has ended, and its successor has no limit
                resource.prlimit(process.pid, resource.RLIMIT_FSIZE, before)
            self._up(DISK_FULL)
            self._wait_for(fault, self._affected(fault), DISK_FULL)

        self.runtime.after(fault.lasts_s, empty)

    def _go_on(self, fault: Fault, name: str, process: subprocess.Popen[bytes] | None) -> None:
        if process is not None:
            process.send_signal(signal.SIGCONT)
        self._up(name)
        self._wait_for(fault, self._affected(fault), name)

    def _joined(self, fault: Fault) -> None:
        for robot in fault.robots:
            self._up(f"link of {robot}")
        self._wait_for(fault, set(fault.robots), "link")

    def _affected(self, fault: Fault) -> set[str]:
        return set(fault.robots or self.config.robots)

    def _wait_for(self, fault: Fault, robots: set[str], name: str) -> None:
        self.watches.append(Watch(fault, self.runtime.now_s(), robots, partial(self._well_again, name)))

    def _well_again(self, name: str, robot: str) -> bool:
        """Tell whether a robot has recovered, by its own report since `name` is back."""
        since_s = self.up_s.get(name, -math.inf)
        return name not in self.down and self.seen[robot].t >= since_s and self._well(robot)

    def _well(self, robot: str) -> bool:
        """Tell whether a robot carries out its last request, by fresh messages of its agent and the core."""
        seen, now_s = self.seen[robot], self.runtime.now_s()
        core_s = self.beats.get("core", (-math.inf, ""))[0]
        if robot in self.down or seen.health is None or now_s - seen.t > FRESH_S or now_s - core_s > FRESH_S:
            return False
        health = seen.health
        if health.lifecycle not in ("READY", "ACTIVE") or health.stop_code in STANDS:
            return False
        return health.estop or (health.request_id if health.behaviour else "") == seen.wanted

    def _send_late(self, fault: Fault) -> None:
        """Delay a request of an operator until after that operator's later ones."""
        if not self.last:
            return
        like = self.last[sorted(self.last)[fault.number % len(self.last)]]
        x_low, y_low, x_high, y_high = self.config.bounds_m
        middle: list[float | list[float]] = [0.5 * (x_low + x_high), 0.5 * (y_low + y_high)]
        late = BehaviourRequest(
            id=f"late-{fault.number}", behaviour="move_to_goal_bc", robots=fault.robots,
            parameters={"goal": middle}, source=like.source, operator=like.operator, clock=like.clock,
            stamp_s=self.runtime.now_s(),
        )  # fmt: skip
        self.record.asks[late.id] = Ask(late.stamp_s, late.operator, late.id, late.behaviour, late.robots)
        self.record.late[late.id] = late.stamp_s + fault.lasts_s
        self.runtime.after(fault.lasts_s, lambda: self.bus.publish(self.keys.behaviour_request, late))

    def _press(self, fault: Fault) -> None:
        order = self.me.estop(True, fault.robots, "rehearsal", deadline_s=fault.lasts_s)
        now_s = self.runtime.now_s()
        self.record.asks[order.message.id] = Ask(now_s, "eve", order.message.id, "", fault.robots)

        def latched() -> None:
            for robot in fault.robots:
                health = self.seen[robot].health
                if health is not None and health.estop:
                    self._go_down(f"e-stop of {robot}")

        self.runtime.after(0.5 * fault.lasts_s, latched)

        def release() -> None:
            for robot in fault.robots:
                self._up(f"e-stop of {robot}")
            self.me.estop(False, fault.robots, deadline_s=20.0)
            free = lambda robot: (health := self.seen[robot].health) is not None and not health.estop  # noqa: E731
            self.watches.append(Watch(fault, self.runtime.now_s(), set(fault.robots), free))

        self.runtime.after(fault.lasts_s, release)

    # ------------------------------------------------------------------ operators
    def _start_operator(self, name: str, role: str) -> str:
        self.starts[role] += 1
        process = f"{role}:{self.starts[role]}"
        arguments = (str(self.folder / "fleet.toml"), name, process, str(hash_of(self.seed, process)))
        with (self.folder / "operators.log").open("ab") as log:
            self.people[role] = subprocess.Popen(  # noqa: S603  (our own interpreter and our own module)
                [sys.executable, "-m", OPERATOR_MODULE, *arguments, str(self.folder / "asked.jsonl")],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip
        return process

    def _replace_operator(self, fault: Fault) -> None:
        name, role = OPERATORS[fault.number % len(OPERATORS)]
        self.people[role].kill()
        self.people[role].wait()
        self.dead_processes[f"{role}:{self.starts[role]}"] = self.runtime.now_s()
        process = self._start_operator(name, role)
        self.watches.append(Watch(fault, self.runtime.now_s(), {process}, lambda each: each in self.last))

    def _read_asked(self) -> None:
        """Take over what the operators wrote down themselves."""
        answered = {each.id for each in self.record.published}
        for line in (self.folder / "asked.jsonl").read_text(encoding="utf-8").splitlines():
            try:
                entry = json.loads(line)
            except ValueError:  # the end of what a killed operator wrote
                continue
            if "behaviour" in entry:
                robots = tuple(entry["robots"])
                ask = Ask(entry["t"], entry["operator"], entry["id"], entry["behaviour"], robots)
                self.record.asks[ask.id] = ask
                if entry["process"] in self.dead_processes:
                    self.record.killed[ask.id] = self.dead_processes[entry["process"]]
            elif entry.get("phase") == "superseded" and entry["id"] not in answered:
                self.record.called_off.add(entry["id"])

    # ------------------------------------------------------------------ the run
    def until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Serve until the condition holds; False: it did not in time."""
        deadline_s = self.runtime.now_s() + timeout_s

        def check() -> None:
            if condition() or self.runtime.now_s() > deadline_s:
                timer.cancel()
                self.runtime.pause()

        timer = self.runtime.every(0.02, check)
        self.runtime.run()
        return condition()

    def run(self) -> None:
        """Start all, let it all happen, wait until it has calmed down."""
        self.supervisor.start()
        if not self.until(lambda: all(map(self._well, self.seen)), self.warm_s - 5.0):
            missing = [name for name in self.seen if not self._well(name)]
            raise Unreachable(
                f"not ready after {self.warm_s - 5.0:.0f} s: {', '.join(missing)}", where=str(self.folder),
                hint="the logs there say why",
            )  # fmt: skip
        self.runtime.every(LOOK_S, self._look)
        for name, role in OPERATORS:
            self._start_operator(name, role)
        self.until(lambda: self.runtime.now_s() >= self.zero_s, self.warm_s)
        for fault in self.faults:
            self.runtime.after(self.zero_s + fault.at_s - self.runtime.now_s(), partial(self.inject, fault))
        self.until(lambda: False, self.zero_s + self.seconds - self.runtime.now_s())
        for process in self.people.values():
            process.terminate()
        self.until(lambda: False, SETTLE_S)
        now_s = self.record.end_s = self.runtime.now_s()
        self._read_asked()
        self.record.downs += [Down(name, since_s) for name, since_s in self.down.items()]
        for robot, seen in self.seen.items():
            health = seen.health
            if health is not None:
                self.record.doing[robot] = Doing(
                    health.behaviour, health.request_id, now_s - seen.t < FRESH_S, health.estop, health.stop_reason
                )

    def close(self) -> None:
        """End all processes."""
        for process in self.people.values():
            if process.poll() is None:
                process.kill()
            process.wait()
        for name in self.supervisor.children:
            if self.supervisor.alive(name):
                self.supervisor.kill(name, signal.SIGCONT)
        self.me.close()
        self.supervisor.close()
        self.world.close()
        self.bus.close()
        self.events.close()


def _words(health: RobotHealth) -> dict[str, object]:
    return {name: getattr(health, name) for name in (
        "lifecycle", "behaviour", "request_id", "core", "estop", "stop_reason", "fault")}  # fmt: skip


def hash_of(seed: int, process: str) -> int:
    """Return a seed of its own for each start of an operator, the same in every run."""
    return seed * 1_000_003 + sum((place + 1) * ord(each) for place, each in enumerate(process))


@dataclass(frozen=True, slots=True)
class Recovery:
    """How long faults of one kind took until all robots that they concern ran what they were asked for, in seconds."""

    fault: str
    count: int
    median_s: float | None  # None: none is known to be over
    longest_s: float | None
    not_over: int


@dataclass(frozen=True, slots=True)
class LiveReport:
    """What was tried, how long each kind of fault lasted on, and what was wrong."""

    robots: int
    seconds: float
    seed: int
    loss: float
    faults: int
    requests: int
    robot_requests: int
    accepted: int
    executions: int
    audited: int  # entries of the audit log
    recoveries: tuple[Recovery, ...]
    wrong: dict[str, list[str]]
    began_s: float  # on the monotonic clock of `wrong`
    folder: str

    @property
    def failed(self) -> bool:
        """Whether anything was wrong."""
        return any(self.wrong.values())


def report_of(live: LiveRehearsal) -> LiveReport:
    """Judge a rehearsal that is over."""
    record, verdict = live.record, live.record.judge()
    ended = [
        f"{child.name}: {child.given_up or 'does not run'}"
        for child in live.supervisor.children.values()
        if not live.supervisor.alive(child.name)
    ]
    return LiveReport(
        robots=live.robots,
        seconds=live.seconds,
        seed=live.seed,
        loss=live.loss,
        faults=len(live.faults),
        requests=len(record.asks),
        robot_requests=sum(len(each.robots) for each in record.asks.values() if each.behaviour),
        accepted=len(record.accepted()),
        executions=len(record.ran),
        audited=0,
        recoveries=tuple(_recovery(live, kind) for kind in dict.fromkeys(each.kind for each in live.faults)),
        wrong={
            "uncommanded motions": verdict.uncommanded,
            "executed twice": verdict.doubled,
            "older after newer": verdict.older,
            "lost": verdict.lost,
            "not running the last request": verdict.wrong,
            "processes that have ended": ended,
        },
        began_s=live.zero_s,
        folder=str(live.folder),
    )


def _recovery(live: LiveRehearsal, kind: str) -> Recovery:
    took = [each.took_s for each in live.watches if each.fault.kind == kind]
    over = sorted(each for each in took if each < math.inf)
    return Recovery(
        fault=kind,
        count=sum(each.kind == kind for each in live.faults),
        median_s=round(over[len(over) // 2], 2) if over else None,
        longest_s=round(over[-1], 2) if over else None,
        not_over=len(took) - len(over),
    )


def text_of(report: LiveReport) -> str:
    """Return a report as lines for people."""
    tried = f"{report.robots} robots, {report.seconds:g} s, {report.faults} faults, seed {report.seed}, "
    asked = f"{report.requests} requests and stops, {report.robot_requests} robot-requests, "
    lines = [
        f"{tried}{100 * report.loss:g} % loss",
        f"{asked}{report.accepted} accepted, {report.executions} executions, {report.audited} entries audited",
        "",
        f"{'fault':22}{'count':>6}{'median s':>10}{'longest s':>11}{'not over':>10}   (until all run their requests)",
    ]
    for each in report.recoveries:
        median, longest = (
            "-" if value is None else f"{value:.2f}" for value in (each.median_s, each.longest_s)
        )  # fmt: skip
        lines.append(f"{each.fault:22}{each.count:6}{median:>10}{longest:>11}{each.not_over:10}")
    lines.append("")
    for name, found in report.wrong.items():
        lines.append(f"{name:38}{len(found):5}")
        lines += [f"    {each}" for each in found[:SHOWN]]
    if report.failed:
        lines.append(f"times: monotonic clock, the first fault from {report.began_s:.2f} on; logs: {report.folder}")
    return "\n".join(lines)


def rehearse_live(robots: int, seconds: float, every_s: float, seed: int, loss: float) -> LiveReport:
    """Run a live swarm under faults on this machine; its logs stay only after a failure.

    Parameters
    ----------
    seconds : how long faults happen
    every_s : from one fault to the next
    loss : share of all messages that is lost, all the time

    Raises
    ------
    Unreachable
        The swarm was not ready in time.
    """
    live = LiveRehearsal(robots, seconds, every_s, seed, loss)
    folder = live.supervisor.kept_folder()
    try:
        live.run()
        report = report_of(live)
    finally:
        live.close()
    audit = verify(folder / "audit", folder / STORE)  # after the core has ended: it writes in batches
    problems = audit.problems if audit.entries else ["no entries"]
    report = replace(report, audited=audit.entries, wrong={**report.wrong, "problems of the audit log": problems})
    if not report.failed:
        shutil.rmtree(folder, ignore_errors=True)
    return report
