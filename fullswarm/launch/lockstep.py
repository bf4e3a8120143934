"""A whole swarm in one process on a simulated clock: deterministic to the byte, as fast as the machine allows.

The nodes are those of the live processes. One agent carries all robots, so that laws, filter, controller and
calculators are evaluated once per tick for all robots. On a bad network each robot has an agent of its own, as on
board: a message that one robot misses may reach another.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

from fullswarm import kernels
from fullswarm.agent.node import AgentNode
from fullswarm.agent.state import Identity
from fullswarm.bus.base import CENTRALISED, CORE, SenderBus
from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.config.docks import slots_of
from fullswarm.core.node import CoreNode
from fullswarm.keys import Keys
from fullswarm.launch import nodes
from fullswarm.launch.network import network_of, on_network
from fullswarm.perf.summarizers import Summarizer
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.world import World
from fullswarm.store import Store


@dataclass(slots=True)
class Lockstep:
    """A swarm that moves only when :meth:`run` is called.

    Attributes
    ----------
    bus : carries every message unharmed, for onlookers; nodes are on :meth:`bus_of` their name
    store : the core's local database
    agents : one that carries all robots; on a bad network one per robot, in the order of the file
    """

    config: SwarmConfig
    runtime: Runtime = field(init=False)
    bus: LocalBus = field(init=False)
    world: World = field(init=False)
    store: Store = field(init=False)
    agents: tuple[AgentNode, ...] = field(init=False)
    summarizers: tuple[Summarizer[Any], ...] = field(init=False)
    wall_s: float = field(init=False, default=0.0)
    _nodes: list[nodes.Node] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        bad = network_of(self.config) is not None
        if bad:
            network = self.config.network.model_copy(update={"since_s": 0.0})
            self.config = self.config.model_copy(update={"network": network})
        else:
            # One host carries all robots, so there is nothing to split by place.
            agent = self.config.agent.model_copy(update={"state_cell_m": 0.0})
            self.config = self.config.model_copy(update={"agent": agent})
        config = self.config
        mailbox = Mailbox()
        kernels.compile_all()
        self.runtime = Runtime(SimClock(), mailbox)
        self.bus = LocalBus(mailbox)
        settings = config.world_or_default
        self.world = World(settings, config.robots, nodes.start_poses(config), slots_of(config))
        # Before the agent's timer: a period ends with the world's step, then the robots read what came of it.
        self.runtime.every(1.0 / settings.rate_hz, self.world.step)
        core = nodes.core(self.bus_of(CORE), self.runtime, config, "core-0", self.runtime.now_s)
        self._nodes += core
        self.store = next(node for node in core if isinstance(node, Store))
        extra = [each for node in core if isinstance(node, CoreNode) for each in node.extra]
        self.summarizers = tuple(each for each in extra if isinstance(each, Summarizer))
        self._nodes.append(nodes.centralised(self.bus_of(CENTRALISED), self.runtime, config, "centralised-0"))
        self.agents = self._agent_each() if bad else (self._agent_of_all(),)
        self._nodes += self.agents

    @property
    def agent(self) -> AgentNode:
        """The one agent that carries all robots; on a bad network that of the first robot."""
        return self.agents[0]

    def bus_of(self, name: str) -> SenderBus:
        """Return the bus as process `name` uses it."""
        return on_network(self.bus, self.runtime, self.config, name)

    def _agent_of_all(self) -> AgentNode:
        fleet = SimFleet(self.world, self.runtime.now_s, self.config.agent.sensing_radius_m)
        identity = Identity("lockstep", "lockstep-0")
        return nodes.agent(self.bus, self.runtime, self.config, fleet, identity, self.runtime.stats, self.runtime.now_s)

    def _agent_each(self) -> tuple[AgentNode, ...]:
        """Return an agent for each robot: robots that receive different messages need a table each."""
        found = []
        for row, robot in enumerate(self.config.robots):
            fleet = SimFleet(self.world, self.runtime.now_s, self.config.agent.sensing_radius_m, row=row)
            identity = Identity(robot, f"{robot}-0")
            bus = self.bus_of(robot)
            runtime = self.runtime
            found.append(nodes.agent(bus, runtime, self.config, fleet, identity, runtime.stats, runtime.now_s))
        return tuple(found)

    def run(self, duration_s: float) -> None:
        """Let `duration_s` simulated seconds pass."""
        began_s = time.perf_counter()
        self.runtime.run(duration_s)
        self.wall_s += time.perf_counter() - began_s

    def report(self) -> None:
        """Have the agents and the summarizers publish what they have measured until now."""
        for agent in self.agents:
            agent.publish_measurements()
        self.runtime.mailbox.drain()
        for summarizer in self.summarizers:
            summarizer.report()
        self.runtime.mailbox.drain()

    @property
    def keys(self) -> Keys:
        """The names of the swarm's messages."""
        return Keys(self.config.swarm)

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
