"""Builds the nodes of each layer. Live processes and lockstep call the same functions: they cannot differ.

Each imports its own layer when it is called: an agent that is started again must be back soon, and needs no core.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import structlog

from fullswarm.bus.base import CENTRALISED, CORE, Bus, SenderBus
from fullswarm.clock import wall_time_s
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.drivers.base import Fleet
from fullswarm.files import MACHINE_DISK, Disk
from fullswarm.keys import Keys
from fullswarm.reasons import Reason
from fullswarm.runtime import LoopStats, Scheduler

if TYPE_CHECKING:
    from fullswarm.agent.node import AgentNode
    from fullswarm.agent.state import Identity
    from fullswarm.core.centralised.node import CentralisedNode
    from fullswarm.store import Store

log = structlog.get_logger()


class Node(Protocol):
    """Anything with an end."""

    def close(self) -> None:
        """End it in order."""
        ...


@dataclass(frozen=True, slots=True)
class AgentPorts:
    """What an agent's nodes use of the world around them."""

    bus: SenderBus
    scheduler: Scheduler
    fleet: Fleet
    loop: Callable[[], LoopStats]
    wall_s: Callable[[], float] = wall_time_s
    disk: Disk = MACHINE_DISK


def process_id(name: str) -> str:
    """Return a name that no other start of this process has."""
    return f"{name}-{uuid.uuid4().hex[:8]}"


def core(
    bus: SenderBus,
    scheduler: Scheduler,
    config: SwarmConfig,
    process: str,
    wall_s: Callable[[], float] = wall_time_s,
    *,
    audit: Path | None = None,
    store: Store | None = None,
) -> list[Node]:
    """Build the core: main controller, request handler, database, summarizers, performance node.

    Parameters
    ----------
    audit : folder of the audit log; None: there is none, as in lockstep
    store : the database; None: the one that the fleet file names
    """
    from fullswarm.core.node import CoreNode
    from fullswarm.perf.performance_node import PerformanceNode
    from fullswarm.perf.summarizers import CoverageSummarizer, robot_summarizers
    from fullswarm.store import Store

    keys = Keys(config.swarm)
    store = store or Store(config.core.store, wall_s)
    node: CoreNode  # made last, and used by what is made before it as soon as messages arrive
    conditions = lambda: node.settings.performance  # noqa: E731
    extra: list[Node] = [CoverageSummarizer(bus, keys, scheduler, conditions)]
    extra += robot_summarizers(bus, keys, scheduler, conditions, config.robots, config.bounds_m)
    extra.append(PerformanceNode(bus, keys, scheduler, config.core.results))
    built: list[Node] = [store]
    if audit is not None:
        from fullswarm.audit.log import AuditLog
        from fullswarm.core.audit import AuditRecorder, noted_head

        log = AuditLog(audit, process, scheduler.now_s, wall_s, anchor=noted_head(store))
        recorder = AuditRecorder(bus, keys, scheduler, log, store, process, lambda name: node.library.expires(name))
        bus = recorder.bus
        built.append(recorder)
    node = CoreNode(bus, scheduler, config, store, process, tuple(extra), wall_s)
    return [*built, node]


def centralised(bus: Bus, scheduler: Scheduler, config: SwarmConfig, process: str) -> CentralisedNode:
    """Build the centralised behaviours' node."""
    from fullswarm.core.centralised.node import CentralisedNode

    return CentralisedNode(bus, scheduler, config, process)


def agent(
    bus: Bus,
    scheduler: Scheduler,
    config: SwarmConfig,
    fleet: Fleet,
    identity: Identity,
    loop: Callable[[], LoopStats],
    wall_s: Callable[[], float] = wall_time_s,
) -> AgentNode:
    """Build the agent that carries the robots of `fleet`."""
    from fullswarm.agent.node import AgentNode

    poses = {each.id: each.pose for each in config.robot}
    start = np.array([poses.get(robot) or (0.0, 0.0, 0.0) for robot in fleet.ids], float)
    return AgentNode(bus, scheduler, config, fleet, identity, start, loop, wall_s=wall_s)


def agent_process(
    ports: AgentPorts, config: SwarmConfig, identity: Identity, latches: Path | None = None, clock: str = ""
) -> list[Node]:
    """Build all nodes of an agent's process that have a part in what its robots do.

    Parameters
    ----------
    latches : folder for latches and stops, on a live process; None: there is no other process to be told of
    clock : name of the process's clock, see :class:`~fullswarm.agent.orders.estops.LatchFolder`
    """
    from fullswarm.agent.orders.estops import LatchFolder
    from fullswarm.bus.versions import VersionWatch

    node = agent(ports.bus, ports.scheduler, config, ports.fleet, identity, ports.loop, ports.wall_s)
    if latches is None:
        return [node]
    node.inbox.remember_latches(LatchFolder(latches, clock, ports.disk))

    def note(why: Reason) -> None:
        log_versions(why)
        node.pose_conflicts.other_version = why

    return [node, VersionWatch(ports.bus, Keys(config.swarm), ports.scheduler, identity.host, note)]


def centralised_process(
    bus: Bus, scheduler: Scheduler, config: SwarmConfig, process: str, *, watch: bool
) -> list[Node]:
    """Build the nodes of the process of centralised behaviours; `watch`: look for processes of another version."""
    from fullswarm.bus.versions import VersionWatch

    node: Node = centralised(bus, scheduler, config, process)
    return [node, *([VersionWatch(bus, Keys(config.swarm), scheduler, CENTRALISED, log_versions)] if watch else [])]


def core_process(
    bus: SenderBus,
    scheduler: Scheduler,
    config: SwarmConfig,
    process: str,
    wall_s: Callable[[], float] = wall_time_s,
    *,
    watch: bool,
    audit: Path | None = None,
    store: Store | None = None,
) -> list[Node]:
    """Build the nodes of the core's process; parameters as of :func:`core` and :func:`centralised_process`."""
    from fullswarm.bus.versions import VersionWatch
    from fullswarm.core.node import CoreNode

    built = core(bus, scheduler, config, process, wall_s, audit=audit, store=store)
    if watch:
        node = next(each for each in built if isinstance(each, CoreNode))
        found = VersionWatch(bus, Keys(config.swarm), scheduler, CORE, log_versions)
        node.controller.version_problem = found.problem_of
        built.append(found)
    return built


def log_versions(why: Reason) -> None:
    """Log that a process of another version is there, or is gone."""
    if why:
        log.warning("another version", reason=why.text)
    else:
        log.info("all processes are of one version")


def start_poses(
    config: SwarmConfig, robots: Sequence[RobotConfig] | None = None
) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return where `robots` of the file stand at first, (n, 3); None: all. The file's poses, else free places."""
    from fullswarm.simulation.starts import default_starts

    world, robots = config.world_or_default, config.robot if robots is None else robots
    if all(each.pose for each in robots):
        return np.array([each.pose for each in robots], float).reshape(-1, 3)
    largest_m = max(world.of_body(each.id).radius_m for each in robots)
    others = [each.pose for each in config.robot if each.pose and each not in robots]
    free = default_starts(world, len(robots), others, radius_m=largest_m)
    return np.array([each.pose or tuple(free[row]) for row, each in enumerate(robots)], float)
