"""A whole swarm in one process on a simulated clock: deterministic to the byte, as fast as the machine allows.

The nodes are those of the live processes. One agent carries all robots, so that laws, filter, controller and
calculators are evaluated once per tick for all robots. On a bad network each robot has an agent of its own, as on
board: a message that one robot misses may reach another.
"""

from __future__ import annotations

import time
from collections.abc import Callable
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
from fullswarm.journal.journal import Journal
from fullswarm.keys import Keys
from fullswarm.launch import journals, nodes
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

    Parameters
    ----------
    begin : begins a journal of each process; None: nothing is noted
    """

    config: SwarmConfig
    begin: journals.Begin | None = None
    runtime: Runtime = field(init=False)
    bus: LocalBus = field(init=False)
    world: World = field(init=False)
    store: Store = field(init=False)
    agents: tuple[AgentNode, ...] = field(init=False)
    summarizers: tuple[Summarizer[Any], ...] = field(init=False)
    wall_s: float = field(init=False, default=0.0)
    _nodes: list[nodes.Node] = field(init=False, default_factory=list)
    _core_journal: Journal | None = field(init=False, default=None)
    _agent_journals: list[Journal | None] = field(init=False, default_factory=list)

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
        core = self._core()
        self.store = next(node for node in core if isinstance(node, Store))
        extra = [each for node in core if isinstance(node, CoreNode) for each in node.extra]
        self.summarizers = tuple(each for each in extra if isinstance(each, Summarizer))
        self._centralised()
        self.agents = self._agent_each() if bad else (self._agent_of_all(),)

    @property
    def agent(self) -> AgentNode:
        """The one agent that carries all robots; on a bad network that of the first robot."""
        return self.agents[0]

    def bus_of(self, name: str) -> SenderBus:
        """Return the bus as process `name` uses it."""
        return on_network(self.bus, self.runtime, self.config, name)

    def _built(self, journal: Journal | None, build: Callable[[], list[nodes.Node]]) -> list[nodes.Node]:
        """Return the nodes that `build` makes; they are closed with the swarm."""
        found: list[nodes.Node] = []

        def make() -> list[nodes.Node]:
            found.extend(build())
            return found

        self._nodes += journals.built(make, journal)
        return found

    def _core(self) -> list[nodes.Node]:
        config, process = self.config, f"{CORE}-0"
        store = Store(config.core.store, self.runtime.now_s)
        journal = None
        if self.begin is not None:
            journal = self.begin(process, journals.core_head(config, process, store, None, watch=False))
        given = journals.given(self.bus_of(CORE), self.runtime, journal, self.runtime.now_s)
        store.wall_s = given.wall_s
        self._core_journal = journal
        return self._built(
            journal,
            lambda: nodes.core_process(
                given.bus, given.scheduler, config, process, given.wall_s, store=store, watch=False
            ),
        )

    def _centralised(self) -> None:
        config, process = self.config, f"{CENTRALISED}-0"
        journal = None
        if self.begin is not None:
            journal = self.begin(process, journals.head_of(CENTRALISED, process, config, watch=False))
        given = journals.given(self.bus_of(CENTRALISED), self.runtime, journal)
        self._built(
            journal, lambda: nodes.centralised_process(given.bus, given.scheduler, config, process, watch=False)
        )

    def _agent(self, bus: SenderBus, fleet: SimFleet, identity: Identity) -> AgentNode:
        runtime, config = self.runtime, self.config
        given, journal = nodes.AgentPorts(bus, runtime, fleet, runtime.stats, runtime.now_s), None
        if self.begin is not None:
            head = journals.agent_head(config, fleet, identity.host, identity.process, None, "")
            journal = self.begin(identity.process, head)
            given = journals.noted(given, journal)
        (node,) = self._built(journal, lambda: nodes.agent_process(given, config, identity))
        assert isinstance(node, AgentNode)  # noqa: S101  (narrows the type: without latches it is the only one)
        self._agent_journals.append(journal)
        return node

    def _agent_of_all(self) -> AgentNode:
        fleet = SimFleet(self.world, self.runtime.now_s, self.config.agent.sensing_radius_m)
        return self._agent(self.bus, fleet, Identity("lockstep", "lockstep-0"))

    def _agent_each(self) -> tuple[AgentNode, ...]:
        """Return an agent for each robot: robots that receive different messages need a table each."""
        found = []
        for row, robot in enumerate(self.config.robots):
            fleet = SimFleet(self.world, self.runtime.now_s, self.config.agent.sensing_radius_m, row=row)
            found.append(self._agent(self.bus_of(robot), fleet, Identity(robot, f"{robot}-0")))
        return tuple(found)

    def run(self, duration_s: float) -> None:
        """Let `duration_s` simulated seconds pass."""
        began_s = time.perf_counter()
        self.runtime.run(duration_s)
        self.wall_s += time.perf_counter() - began_s

    def report(self) -> None:
        """Have the agents and the summarizers publish what they have measured until now."""
        for agent, journal in zip(self.agents, self._agent_journals, strict=True):
            journals.called(journals.MEASUREMENTS, agent.publish_measurements, journal)
        self.runtime.mailbox.drain()
        journals.called(journals.REPORT, self._report, self._core_journal)
        self.runtime.mailbox.drain()

    def _report(self) -> None:
        for summarizer in self.summarizers:
            summarizer.report()

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
