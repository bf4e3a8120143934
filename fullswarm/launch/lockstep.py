"""A whole swarm in one process on a simulated clock: deterministic to the byte, as fast as the machine goes.

The nodes are those of the live processes. One agent carries all robots, so that laws, filter, controller and
calculators are evaluated once per tick for everybody.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from fullswarm import kernels
from fullswarm.agent.node import AgentNode, Identity
from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.sim.fleet import SimFleet
from fullswarm.drivers.sim.world import World
from fullswarm.launch import nodes
from fullswarm.runtime import Mailbox, Runtime


@dataclass(slots=True)
class Lockstep:
    """A swarm that moves only when :meth:`run` is called."""

    config: SwarmConfig
    runtime: Runtime = field(init=False)
    bus: LocalBus = field(init=False)
    world: World = field(init=False)
    agent: AgentNode = field(init=False)
    wall_s: float = field(init=False, default=0.0)
    _nodes: list[nodes.Node] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        # One host carries everybody, so there is nothing to split by place.
        agent = self.config.agent.model_copy(update={"state_cell_m": 0.0})
        self.config = config = self.config.model_copy(update={"agent": agent})
        mailbox = Mailbox()
        kernels.compile_all()
        self.runtime = Runtime(SimClock(), mailbox)
        self.bus = LocalBus(mailbox)
        settings = config.world_or_default
        self.world = World(settings, config.robots, nodes.start_poses(config))
        # Before the agent's timer: a period ends with the world's step, then the robots read what came of it.
        self.runtime.every(1.0 / settings.rate_hz, self.world.step)
        self._nodes += nodes.core(self.bus, self.runtime, config, "core-0", self.runtime.now_s)
        self._nodes += nodes.centralised(self.bus, self.runtime, config, "centralised-0")
        fleet = SimFleet(self.world, self.runtime.now_s, config.agent.sensing_radius_m)
        identity = Identity("lockstep", "lockstep-0")
        self.agent = nodes.agent(self.bus, self.runtime, config, fleet, identity, self.runtime.stats)
        self._nodes.append(self.agent)

    def run(self, duration_s: float) -> None:
        """Let `duration_s` simulated seconds pass."""
        began_s = time.perf_counter()
        self.runtime.run(duration_s)
        self.wall_s += time.perf_counter() - began_s

    @property
    def real_time_factor(self) -> float:
        """Simulated seconds per wall second so far."""
        return self.runtime.now_s() / self.wall_s if self.wall_s > 0 else 0.0

    def close(self) -> None:
        """End all nodes and the world."""
        for node in reversed(self._nodes):
            node.close()
        self.runtime.mailbox.drain()
        self.bus.close()
        self.world.close()
