"""A swarm of real processes that one trial uses: started, waited for, watched for deaths, ended whatever happens."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from types import TracebackType

from fullswarm.bus.base import OPERATOR, WORLD
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock, clock_id
from fullswarm.config import SwarmConfig
from fullswarm.drivers.sim.world import World
from fullswarm.errors import ConfigError
from fullswarm.evaluate.live_summaries import LiveSummaries
from fullswarm.evaluate.trial import TrialFailed
from fullswarm.keys import Keys
from fullswarm.launch.network import on_network
from fullswarm.launch.nodes import process_id
from fullswarm.launch.supervisor import USAGE, Supervisor
from fullswarm.launch.world import WorldNode
from fullswarm.operator.client import Operator
from fullswarm.operator.view import FleetView, RobotRow
from fullswarm.runtime import Mailbox, Runtime

START_S = 60.0
"""A dozen interpreters start at once on a machine that may have other work."""
CHECK_S = 0.02
FRESH_S = 1.0
STEADY_S = 0.3
UP = ("READY", "ACTIVE")
TAIL_LINES = 3


class TrialHeld(TrialFailed):
    """A robot is held by an e-stop: nothing may go on by itself."""


class LiveSwarm:
    """Hub, core, centralised behaviours and one agent per robot as processes; a context manager.

    The simulated world, if there is one, lives in this process: here its bodies can be watched. It is the very node
    of ``fullswarm sim``, and robots reach it through the same ports.

    Parameters
    ----------
    config : the fleet; its ports must be free
    runtime : serves this process; by default one on the machine's clock

    Attributes
    ----------
    bus : carries every message unharmed, for onlookers; `operator` is on the fleet's own network
    world : None: all robots are real
    """

    def __init__(self, config: SwarmConfig, runtime: Runtime | None = None, insecure_network: bool = False) -> None:
        self.runtime = runtime or Runtime(MonotonicClock(), Mailbox())
        self.supervisor = Supervisor(
            config, self.runtime, restart=False, world=False, insecure_network=insecure_network
        )
        self.config = config = self.supervisor.config
        self.keys = Keys(config.swarm)
        self.bus = ZenohBus(self.runtime.mailbox, hub=config.hub.endpoint)
        self.operator = Operator(
            on_network(self.bus, self.runtime, config, OPERATOR),
            self.keys,
            self.runtime,
            "experiment",
            clock=clock_id(),
        )
        self.view = FleetView(self.bus, self.keys, self.runtime, config.robots)
        self.summaries = LiveSummaries(self.bus, self.keys)
        self.world: WorldNode | None = None
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
                "no robot is simulated: nobody can watch the bodies", where=self.config.swarm,
                hint="start the swarm first; one of real robots is watched by what they tell",
            )  # fmt: skip
        return self.world.world

    def settle(self) -> None:
        """Wait until every robot has been ready for a while.

        It has to be asked again before a trial: the world stands still while this process is busy with something
        else, and a robot that hears nothing of its body for half a second is not ready.

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
            raise TrialFailed(self._obituary(dead), hint=f"their logs are in {self.supervisor.folder}")
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
        """Return a robot as last heard."""
        return next((row for row in self.view.snapshot().robots if row.robot == robot), None)

    def held(self) -> tuple[str, ...]:
        """Return the robots that an e-stop holds."""
        return tuple(row.robot for row in self.view.snapshot().robots if row.health and row.health.estop)

    def unready(self) -> tuple[str, ...]:
        """Return which robots are not ready yet, with the reason as far as it is known."""
        snapshot = self.view.snapshot()
        rows = {row.robot: row for row in snapshot.robots}
        nodes = {node.node for node in snapshot.nodes if node.age_s < FRESH_S}
        found = [f"no {node} heard" for node in ("core", "centralised") if node not in nodes]
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
            self.supervisor.close()
        finally:
            if self.world is not None:
                self.world.close()
            self.bus.close()
            if not self.kept:
                shutil.rmtree(self.supervisor.folder, ignore_errors=True)

    def _obituary(self, dead: tuple[str, ...]) -> str:
        """Say which processes ended, with their last output."""
        words = []
        for name in dead:
            process = self.supervisor.children[name].process
            code = None if process is None else process.poll()
            tail = self.supervisor.log_tail(name, TAIL_LINES).replace("\n", " | ")
            words.append(f"the process of '{name}' ended with code {code}" + (f": {tail}" if tail else ""))
        return "; ".join(words)
