"""Runs a trial through real processes in real time (``--live``): starts and watches them, ends them in any case."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from fullswarm import kernels
from fullswarm.bus.base import OPERATOR, WORLD
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock, clock_id
from fullswarm.config import SwarmConfig
from fullswarm.drivers.make import emulated
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.experiment.plan import Trial, scenario_of
from fullswarm.evaluate.swarm import (
    ALL_ENDED,
    CHECK_PERIOD_S,
    Report,
    Summaries,
    TrialFailed,
    TrialHeld,
    left_out_of,
)
from fullswarm.evaluate.trial import configure, drive_in_world, terms
from fullswarm.evaluate.trial_folder import Measurement, recording_of
from fullswarm.fitness import ANYTHING
from fullswarm.keys import Keys
from fullswarm.launch.network import on_free_ports, on_network
from fullswarm.launch.nodes import process_id
from fullswarm.launch.recorder import add_recorder
from fullswarm.launch.supervisor import USAGE, Supervisor
from fullswarm.launch.world import WorldNode
from fullswarm.messages import Needs, RequestStatus, Value
from fullswarm.operator.client import Operator
from fullswarm.operator.session import own_credentials
from fullswarm.operator.view import FleetView, RobotRow
from fullswarm.reasons import Code
from fullswarm.runtime import Mailbox, Runtime, Timer
from fullswarm.simulation.world import World

START_S = 60.0
"""A dozen interpreters start at once on a machine that may have other work."""
CHECK_S = 0.02
WATCH_S = 0.02
"""How often onlookers are called where no world is stepped."""
FRESH_S = 1.0
STEADY_S = 0.3
UP = ("READY", "ACTIVE")
TAIL_LINES = 3
CONFIRM_S = 5.0
"""How long the swarm may take until every robot runs what it was asked for."""
STAND_S = 3.0
"""How long robots may roll on after a stop."""
ALONE_S = 1.0
"""How long a robot whose agent is dead may take until its own watchdog has stopped it."""
SUMMARY_S = 4.0
"""How long to wait for summaries of what was measured after the stop: sent each other second at least."""
MEASURED_S = 0.6
"""After so long whatever robots measured at the end has been sent: they do it twice a second."""


class LiveSwarm:
    """Hub, core, centralised behaviours and one agent per robot as processes; a context manager.

    Implements :class:`~fullswarm.evaluate.swarm.Swarm`, with simulated, emulated and real robots.
    The simulated world, if there is one, lives in this process: here its bodies can be watched. It is the very node
    of ``fullswarm sim``, and robots reach it through the same ports.

    Parameters
    ----------
    config : the fleet; its ports must be free
    runtime : serves this process; by default one on the machine's clock
    record : a new file for a recording of all of it

    Attributes
    ----------
    bus : carries every message unharmed, for onlookers; `operator` is on the fleet's own network
    world : None: all robots are real
    """

    def __init__(
        self, config: SwarmConfig, runtime: Runtime | None = None, insecure_network: bool = False,
        record: Path | None = None,
    ) -> None:  # fmt: skip
        self.runtime = runtime or Runtime(MonotonicClock(), Mailbox())
        self.supervisor = Supervisor(
            config, self.runtime, restart=False, world=False, insecure_network=insecure_network
        )
        if record is not None:
            add_recorder(self.supervisor, record)
        self.config = config = self.supervisor.config
        self.keys = Keys(config.swarm)
        hub = config.hub.endpoint
        self.bus = ZenohBus(self.runtime.mailbox, hub=hub, credentials=own_credentials(hub, config.swarm))
        self.operator = Operator(
            on_network(self.bus, self.runtime, config, OPERATOR),
            self.keys,
            self.runtime,
            "experiment",
            clock=clock_id(),
        )
        self.view = FleetView(self.bus, self.keys, self.runtime, config.robots)
        self.summaries = Summaries(self.bus, self.keys)
        self.world: WorldNode | None = None
        self._statuses: list[RequestStatus] = []
        self._began_s = self._ended_s = 0.0
        self._watch_timer: Timer | None = None
        self._insecure_network = insecure_network
        self.kept = False
        """Whether the folder of the logs stays when this ends: it does after an error."""

    def __enter__(self) -> LiveSwarm:
        """Start nothing yet: see `start`."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all processes."""
        self.kept = kind is not None and issubclass(kind, Exception)  # not after Ctrl-C
        self.close()

    def start(self) -> None:
        """Start all processes and wait until every robot is ready.

        Raises
        ------
        TrialFailed
            A process ended, or a robot is not ready after a minute; says which and why.
        TrialHeld
            A robot is held by an e-stop from before.
        ConfigError
            A process, or the world, says that its settings are wrong.
        """
        if any(robot.simulated for robot in self.config.robot):
            bus = on_network(self.bus, self.runtime, self.config, WORLD)
            self.world = WorldNode(bus, self.runtime, self.config, process_id("world"), self._insecure_network)
        self.supervisor.start()
        self.settle()

    @property
    def bodies(self) -> World:
        """The simulated world's bodies; `TrialFailed` before `start`, and where all robots are real."""
        if self.world is None:
            raise TrialFailed(
                "no robot is simulated: there are no bodies to watch", where=self.config.swarm,
                hint="start the swarm first; real robots are watched by what they report",
            )  # fmt: skip
        return self.world.world

    def settle(self) -> None:
        """Wait until every robot has been ready for a while.

        It has to be asked again before a trial: the world stands still while this process is busy with something
        else, and a robot that receives nothing of its body for half a second is not ready.

        Raises
        ------
        TrialFailed, TrialHeld, ConfigError
            As `start`.
        """
        since_s = math.inf

        def steady() -> bool:
            nonlocal since_s
            now_s = self.runtime.now_s()
            since_s = math.inf if self.unready() else min(since_s, now_s)
            return now_s - since_s >= STEADY_S or bool(self.held())

        ready = self.until(steady, START_S)
        if self.held():
            raise TrialHeld("an e-stop holds the robot", where=", ".join(self.held()))
        if not ready:
            raise TrialFailed(
                f"not ready within {START_S:.0f} s: {'; '.join(self.unready())}", where=str(self.supervisor.folder),
                hint="the logs there say why",
            )  # fmt: skip

    # ------------------------------------------------------------------------------------------ a trial
    @property
    def passed_s(self) -> float:
        """Time since the request, to the millisecond."""
        return round(self.runtime.now_s() - self._began_s, 3)

    @property
    def seen_s(self) -> float:
        """The same: bodies move by this clock."""
        return self.passed_s

    def request(
        self, behaviour: str, parameters: Mapping[str, Value], *, team: str = "", needs: Needs = ANYTHING,
        roles: Mapping[str, Sequence[str]] | None = None,
    ) -> None:  # fmt: skip
        """Request a behaviour of all robots."""
        self.summaries.begin()
        self._statuses, self._began_s = [], self.runtime.now_s()
        self.operator.request(behaviour, (), parameters, self._statuses.append, team=team, needs=needs, roles=roles)

    def watch(self, on_step: Callable[[], None]) -> None:
        """Call `on_step` after each step of the world, so that none is missed on a busy machine; else by time."""
        if self.world is None:
            self._watch_timer = self.runtime.every(WATCH_S, on_step)
        else:
            self.world.world.watchers.append(on_step)

    def advance(self, stopped: Callable[[], bool]) -> bool:
        """Serve for `CHECK_PERIOD_S`, or until `stopped`.

        Raises
        ------
        TrialFailed
            The request was refused, a robot does not run it, is in FAULT or silent, its law failed, or a process ended.
        TrialHeld
            A robot is held by an e-stop.
        """
        if self.until(stopped, CHECK_PERIOD_S):
            return True
        self._check()
        return False

    def end_reason(self) -> str:
        """Return the first termination condition that was met since the request."""
        ended = self._statuses and self._statuses[-1].phase == "ended" and self._statuses[-1].results
        return self.summaries.reason or (ALL_ENDED if ended else "")

    def settled(self) -> NDArray[np.bool_]:
        """Return which robots report that they have settled, (n,)."""
        health = {row.robot: row.health for row in self.view.snapshot().robots}
        return np.array(
            [(of := health.get(robot)) is not None and of.stop_code == Code.SETTLED for robot in self.config.robots],
            bool,
        )

    def left_out(self) -> NDArray[np.bool_]:
        """Return which robots do not take part because they are unfit for the request, (n,)."""
        return left_out_of(self.config.robots, self._statuses)

    def stop(self) -> None:
        """Command all robots to stop, and wait until they report that they stand, for `STAND_S` at most."""
        burst, began_s = self.operator.stop(), self.runtime.now_s()
        self._ended_s = began_s

        def at_standstill() -> bool:
            dead = self.dead()  # its last report may be that it moves
            if dead and self.runtime.now_s() - began_s < ALONE_S:
                return False
            rows = [row for row in self.view.snapshot().robots if row.robot not in dead]
            return burst.done and not any(row.health and row.health.moving for row in rows)

        self.serve(at_standstill, STAND_S)  # also for those whose neighbour's process has died
        if self._watch_timer is not None:
            self._watch_timer.cancel()

    def report(self) -> Report:
        """Return what was measured, when summaries of what was measured until the stop have come."""
        self.until(lambda: self.summaries.later_than(self._ended_s + MEASURED_S), SUMMARY_S)
        onboard = self.summaries.onboard()
        return Report(
            onboard=onboard,
            per_robot=self.summaries.per_robot(),
            coverage=self.summaries.coverage(),
            memories=self.summaries.memories(),
            deadlocks=int(onboard.get("deadlocks.deadlock_count", 0.0)),
            deadlock_s=round(onboard.get("deadlocks.sidestep_s", 0.0), 3),
        )

    def _check(self) -> None:
        """Raise unless all robots do what was requested, or still have time to begin."""
        for row in self.view.snapshot().robots:
            health = row.health
            if health is not None and health.estop:
                raise TrialHeld(f"an e-stop holds the robot: {health.stop_reason}", where=row.robot)
            if health is not None and health.lifecycle == "FAULT":
                raise TrialFailed(f"it is in FAULT: {health.fault or 'without a reason'}", where=row.robot)
            if health is not None and health.stop_code == Code.LAW:
                raise TrialFailed(health.stop_reason, where=row.robot)
            if row.silent:
                raise TrialFailed(f"it has been silent for {row.age_s:.1f} s", where=row.robot)
        newest = self._statuses[-1] if self._statuses else None
        ended = {each.robot for each in newest.results} if newest is not None else set[str]()
        if newest is not None and (
            newest.phase in ("refused", "superseded") or (newest.phase == "ended" and not ended)
        ):
            raise TrialFailed(f"the request was {newest.phase}: {newest.reason}".rstrip(": "))
        if newest is not None and newest.refused_by:
            raise TrialFailed(f"refused by {', '.join(newest.refused_by)}: {newest.reason}".rstrip(": "))
        if self.passed_s < CONFIRM_S:
            return
        if newest is None:
            raise TrialFailed(f"the core did not answer within {CONFIRM_S:.0f} s")
        absent = sorted(set(self.config.robots) - set(newest.running) - set(newest.left_out) - ended)
        if absent:
            raise TrialFailed(f"{', '.join(absent)} did not run the behaviour within {CONFIRM_S:.0f} s")

    # ------------------------------------------------------------------------------------------ its processes
    def until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Serve until the condition holds; False: it did not in time.

        Raises
        ------
        TrialFailed
            A process of the swarm has ended.
        ConfigError
            It ended because its settings are wrong.
        """
        held = self.serve(lambda: condition() or bool(self.dead()), timeout_s)
        dead = self.dead()
        for name in dead:
            process = self.supervisor.children[name].process
            if process is not None and process.poll() == USAGE:
                raise ConfigError(self.supervisor.log_tail(name).removeprefix("error: "), where=name)
        if dead:
            raise TrialFailed(self._ended_text(dead), hint=f"their logs are in {self.supervisor.folder}")
        return held

    def serve(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Serve until the condition holds, whatever process has died; False: it did not in time."""
        deadline_s = self.runtime.now_s() + timeout_s

        def check() -> None:
            if condition() or self.runtime.now_s() >= deadline_s:
                timer.cancel()
                self.runtime.pause()

        timer = self.runtime.every(CHECK_S, check)
        try:
            self.runtime.run()
        finally:
            timer.cancel()
        return condition()

    def dead(self) -> tuple[str, ...]:
        """Return the processes that were started and have ended."""
        children = self.supervisor.children
        return tuple(name for name, each in children.items() if each.process and not self.supervisor.alive(name))

    def row(self, robot: str) -> RobotRow | None:
        """Return a robot's newest state."""
        return next((row for row in self.view.snapshot().robots if row.robot == robot), None)

    def held(self) -> tuple[str, ...]:
        """Return the robots that an e-stop holds."""
        return tuple(row.robot for row in self.view.snapshot().robots if row.health and row.health.estop)

    def unready(self) -> tuple[str, ...]:
        """Return which robots are not ready yet, with the reason as far as it is known."""
        snapshot = self.view.snapshot()
        rows = {row.robot: row for row in snapshot.robots}
        nodes = {node.node for node in snapshot.nodes if node.age_s < FRESH_S}
        found = [f"nothing received from {node}" for node in ("core", "centralised") if node not in nodes]
        for robot in self.config.robots:
            row = rows.get(robot)
            if row is None or row.health is None or row.age_s > FRESH_S:
                found.append(f"{robot} is silent")
            elif row.health.lifecycle not in UP:
                found.append(f"{robot} is {row.health.lifecycle} {row.health.fault}".rstrip())
        return tuple(found)

    def close(self) -> None:
        """End all: the robots' agents stop their wheels first, while the rest is still there."""
        try:
            self.operator.close()
            self.view.close()
            self.summaries.close()
            if self.kept:
                self.supervisor.kept_folder()
            self.supervisor.close()
        finally:
            if self.world is not None:
                self.world.close()
            self.bus.close()

    def _ended_text(self, dead: tuple[str, ...]) -> str:
        """Say which processes ended, with their last output."""
        words = []
        for name in dead:
            process = self.supervisor.children[name].process
            code = None if process is None else process.poll()
            tail = self.supervisor.log_tail(name, TAIL_LINES).replace("\n", " | ")
            words.append(f"the process of '{name}' ended with code {code}" + (f": {tail}" if tail else ""))
        return "; ".join(words)


EMULATED_MARGIN_M = 0.08
"""Odometry and fixes are a few centimetres off, and a rover needs time to brake."""


def measure_live(trial: Trial, emulate: str | None = None, recordings: Path | None = None) -> Measurement:
    """Run a trial with a process for each robot; none is left afterwards.

    Parameters
    ----------
    emulate : the robots are of this make, behind emulated ports with their real drivers; None: simulated ones
    recordings : folder for a recording of the trial; None: it is not recorded

    Raises
    ------
    ConfigError
        The trial's settings are wrong, the make is unknown, or so many robots do not fit.
    MissingExtra
        The make's library, or that of the estimator, is not installed.
    TrialFailed
        A process ended, a robot is in FAULT, or the swarm did not do what it was asked.
    """
    scenario = scenario_of(trial)
    config, goals = configure(trial, scenario)
    config = on_free_ports(with_make(config, trial, emulate), prefer_configured=False)
    config, limit = terms(trial, scenario, config)
    kernels.compile_all()
    with LiveSwarm(config, record=recording_of(trial, recordings)) as swarm:
        swarm.start()
        return drive_in_world(swarm, swarm.bodies, trial, scenario, goals, limit, emulate is not None)


def with_make(config: SwarmConfig, trial: Trial, emulate: str | None) -> SwarmConfig:
    """Put every robot behind an emulated port; agents keep the cell's limits where the make could do more."""
    if emulate is None:
        return config
    if emulate not in (known := emulated()):
        raise ConfigError(f"no emulated robot '{emulate}'", where="--emulate", hint=did_you_mean(emulate, known))
    if trial.bodies:
        raise ConfigError("robots that differ from each other are not emulated", where="--emulate")
    body, asked = dict(trial.body), dict(trial.agent)
    usual = {
        "estimator": "ekf",
        "safety_margin_m": EMULATED_MARGIN_M,
        "speed_limit_m_s": body["speed_limit_m_s"],
        "turn_limit_rad_s": body["turn_limit_rad_s"],
    }
    agent = config.agent.model_copy(update={name: value for name, value in usual.items() if name not in asked})
    robots = tuple(each.model_copy(update={"emulate": emulate}) for each in config.robot)
    return config.model_copy(update={"agent": agent, "robot": robots})
