"""A swarm in lockstep that runs one behaviour, for the tests of this package."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.launch.network import with_network
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator


class Swarm:
    """Robots r1, r2, ... at `starts` (x, y, heading); with a `network` each has an agent of its own, as on board."""

    def __init__(self, starts: Sequence[Sequence[float]], network: str | None = None, **agent: Any) -> None:
        robots = [{"id": f"r{row + 1}", "pose": start} for row, start in enumerate(starts)]
        world = {"engine": "kinematic", "bounds_m": [0, 0, 20, 20]}
        config = SwarmConfig.model_validate({"world": world, "robot": robots, "agent": agent})
        self.lockstep = Lockstep(with_network(config, network) if network else config)
        self.lockstep.run(1.0)

    def request(self, behaviour: str, parameters: Mapping[str, Any], run_s: float) -> RequestStatus:
        """Have all robots run a behaviour, and let time pass."""
        statuses: list[RequestStatus] = []
        operator = Operator(self.lockstep.bus, Keys(), self.lockstep.runtime, "test")
        operator.request(behaviour, (), dict(parameters), statuses.append)
        self.lockstep.run(run_s)
        operator.close()
        return statuses[-1]

    def memory(self) -> list[dict[str, list[float]]]:
        """Return what each robot remembers."""
        agents = self.lockstep.agents
        if len(agents) > 1:
            return [each.tasks.memory_of(0) for each in agents]
        return [agents[0].tasks.memory_of(row) for row in range(len(self.lockstep.config.robots))]
