"""A live swarm for tests: real processes on free loopback ports, seen through a real bus."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.network import on_free_ports
from fullswarm.launch.nodes import start_poses
from fullswarm.launch.supervisor import Supervisor
from fullswarm.launch.world import WorldNode
from fullswarm.messages import RequestStatus, Value
from fullswarm.operator.client import Operator, PendingRequest
from fullswarm.operator.view import FleetView, RobotRow
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.simulation.server import WorldServer
from fullswarm.simulation.world import World

START_S = 60.0
"""Generous: a dozen interpreters start at once on a machine that may have other work."""


class WatchedWorld(World):
    """A world that remembers the newest set-point of each robot and when it last was not zero."""

    def __init__(self, config: SwarmConfig, clock: MonotonicClock) -> None:
        super().__init__(config.world_or_default, config.robots, start_poses(config))
        self._clock = clock
        self.setpoint = np.zeros((len(config.robot), 2))
        self.driven_s = np.full(len(config.robot), -np.inf)

    def set_twists(self, twists: Any, rows: Any = slice(None)) -> None:
        super().set_twists(twists, rows)
        self.setpoint[rows] = twists
        if np.any(twists):
            self.driven_s[rows] = self._clock.now_s()


class LiveSwarm:
    """Hub, core, centralised behaviours and agents as processes; the world too, or here where it can be watched."""

    def __init__(self, config: dict[str, Any], *, watch: bool) -> None:
        self.clock = MonotonicClock()
        self.config = on_free_ports(SwarmConfig.model_validate(config), prefer_configured=False)
        self.runtime = Runtime(self.clock, Mailbox())
        self.supervisor = Supervisor(self.config, self.runtime, restart=False, world=not watch)
        self.bus = ZenohBus(self.runtime.mailbox, hub=self.config.hub.endpoint)
        keys = Keys(self.config.swarm)
        self.operator = Operator(self.bus, keys, self.runtime, "test")
        self.view = FleetView(self.bus, keys, self.runtime, self.config.robots)
        self.node: WorldNode | None = None
        self.world: WatchedWorld | None = None
        self.server: WorldServer | None = None
        if watch and any(robot.emulate or not robot.simulated for robot in self.config.robot):
            self.node = WorldNode(self.bus, self.runtime, self.config, "world-here")
        elif watch:
            self.world = WatchedWorld(self.config, self.clock)
            self.server = WorldServer(self.world)
            self.runtime.every(1.0 / self.config.world_or_default.rate_hz, self.server.tick)
        self.supervisor.start()
        self.until(self.ready, START_S, "the swarm is ready")

    # ------------------------------------------------------------------ waiting
    def until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> float:
        """Serve until the condition holds; return how long that took, fail with the logs if it never does."""
        began_s = self.clock.now_s()

        def check() -> None:
            if condition() or self.clock.now_s() - began_s > timeout_s:
                timer.cancel()
                self.runtime.pause()

        timer = self.runtime.every(0.005, check)
        self.runtime.run()
        took_s = self.clock.now_s() - began_s
        assert condition(), f"waited {took_s:.1f} s for: {what}\n{self._story()}"
        return took_s

    def rest(self, seconds: float) -> None:
        """Serve for a while: what must not happen gets the time to happen."""
        self.runtime.run(seconds)

    def _story(self) -> str:
        snapshot = self.view.snapshot()
        rows = [f"{row.robot} age {row.age_s:.2f} {row.health}" for row in snapshot.robots]
        logs = [f"--- {name}\n{self.supervisor.log_tail(name, 15)}" for name in self.supervisor.children]
        return "\n".join([str(snapshot.request), *rows, *logs])

    # ------------------------------------------------------------------ looking
    def row(self, robot: str) -> RobotRow:
        return next(row for row in self.view.snapshot().robots if row.robot == robot)

    def ready(self) -> bool:
        snapshot = self.view.snapshot()
        fresh = [row for row in snapshot.robots if row.age_s < 1.0]
        here = [row for row in fresh if row.health and row.health.lifecycle in ("READY", "ACTIVE")]
        nodes = {node.node for node in snapshot.nodes if node.age_s < 1.0}
        return len(here) == len(self.config.robot) and {"core", "centralised"} <= nodes

    def all_run(self, behaviour: str) -> bool:
        rows = self.view.snapshot().robots
        return all(row.age_s < 1.0 and row.health and row.health.behaviour == behaviour for row in rows)

    def driven(self) -> bool:
        """Whether all robots have a set-point that is not zero."""
        assert self.world is not None
        return bool(self.world.setpoint.any(axis=1).all())

    def driven_since(self, robot: str, moment_s: float) -> bool:
        """Whether a robot was sent a set-point that is not zero after a moment."""
        assert self.world is not None
        return bool(self.world.driven_s[self.world.row(robot)] > moment_s)

    def stands(self) -> bool:
        """Whether no robot has a set-point but zero."""
        assert self.world is not None
        return not self.world.setpoint.any()

    # ------------------------------------------------------------------ doing
    def request(
        self,
        behaviour: str,
        parameters: dict[str, Value] | None = None,
        *,
        missing: tuple[str, ...] = (),
        timeout_s: float = 10.0,
    ) -> PendingRequest:
        """Ask for a behaviour and wait until all robots but the `missing` ones confirmed."""
        asked = self.operator.request(behaviour, (), parameters)

        def confirmed() -> bool:
            status = asked.status
            assert status is None or status.phase != "refused", status
            return status is not None and status.phase == "running" and status.missing == missing

        self.until(confirmed, timeout_s, f"{behaviour} is confirmed")
        return asked

    def status(self, asked: PendingRequest) -> RequestStatus:
        assert asked.status is not None
        return asked.status

    def cli(self, *arguments: str, timeout_s: float = START_S) -> subprocess.CompletedProcess[str]:
        """Run the ``fullswarm`` command against this swarm while serving it."""
        process = self.spawn(*arguments)
        self.until(lambda: process.poll() is not None, timeout_s, f"`fullswarm {' '.join(arguments)}` ends")
        out, err = process.communicate()
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)

    def spawn(self, *arguments: str) -> subprocess.Popen[str]:
        environment = {**os.environ, "FULLSWARM_HUB": self.config.hub.endpoint, "FULLSWARM_SWARM": self.config.swarm}
        return subprocess.Popen(
            [sys.executable, "-m", "fullswarm", *arguments],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def json(self, *arguments: str) -> Any:
        result = self.cli(*arguments, "--json")
        assert result.returncode == 0, result.stderr
        return json.loads(result.stdout)

    def close(self) -> None:
        self.operator.close()
        self.view.close()
        self.supervisor.close()
        if self.node:
            self.node.close()
        if self.server and self.world:
            self.server.close()
            self.world.close()
        self.bus.close()
