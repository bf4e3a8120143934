"""A bench for agents: simulated robots, a lockstep bus and a stand-in for the core, all on a simulated clock."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fullswarm.agent.node import AgentNode
from fullswarm.agent.state import Identity
from fullswarm.bus import LocalBus
from fullswarm.bus.codec import decode, encode
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.messages import (
    Command,
    ControlAck,
    ControlRequest,
    EStop,
    EStopReceipt,
    Heartbeat,
    Message,
    StopRequest,
)
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.world import World

TICK_S = 0.02


class CuttableBus(LocalBus):
    """A bus whose hub can be lost."""

    hub = True

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        """Deliver what would come off a wire: all that an agent says must survive it."""
        super().publish(key, decode(encode(message), type(message)), sender=sender)

    def connected(self) -> bool:
        return self.hub and super().connected()


@dataclass
class Bench:
    """`count` robots at `poses` in a kinematic world, carried by one agent."""

    poses: list[tuple[float, float, float]]
    world: dict[str, Any] = field(default_factory=dict)
    agent_settings: dict[str, Any] = field(default_factory=dict)
    beating: bool = True
    performance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.config = SwarmConfig.model_validate(
            {
                "world": {"engine": "kinematic", **self.world},
                "agent": self.agent_settings,
                "performance": self.performance,
                "robot": [{"id": f"r{row + 1}", "pose": pose} for row, pose in enumerate(self.poses)],
            }
        )
        self.keys = Keys("swarm")
        self.runtime = Runtime(SimClock(), Mailbox())
        self.bus = CuttableBus(self.runtime.mailbox)
        starts = np.array(self.poses, float)
        self.simulated = World(self.config.world_or_default, self.config.robots, starts)
        self.runtime.every(TICK_S, self.simulated.step)
        fleet = SimFleet(self.simulated, self.runtime.now_s)
        self.agent = AgentNode(
            self.bus, self.runtime, self.config, fleet, Identity("bench", "bench-0"), starts, self.runtime.stats
        )
        self.acks: list[ControlAck] = []
        self.receipts: list[EStopReceipt] = []
        self.bus.subscribe(self.keys.ack(), ControlAck, self.acks.append)
        self.bus.subscribe(self.keys.estop_receipt(), EStopReceipt, self.receipts.append)
        self._sequence = itertools.count(1)
        self.runtime.every(0.1, self._beat, first_s=0.0)
        self.run(0.1)

    def _beat(self) -> None:
        if self.beating:
            self.bus.publish(self.keys.heartbeat("core"), Heartbeat(node="core", process="c", sequence=1))

    def run(self, seconds: float) -> None:
        self.runtime.run(seconds)

    def enable(self, law: str, parameters: dict[str, Any] | None = None, robot: str = "", **fields: Any) -> None:
        """Ask one robot, or all, to run a law."""
        for each in [robot] if robot else self.config.robots:
            request = ControlRequest(
                **{
                    "request_id": f"q-{law}",
                    "robot": each,
                    "behaviour": law,
                    "law": law,
                    "enable": True,
                    "parameters": parameters or {},
                    "core": "c",
                    "sequence": next(self._sequence),
                    **fields,
                }
            )
            self.bus.publish(self.keys.control_requests(each, law), request)
        self.runtime.mailbox.drain()

    def command(self, linear_m_s: float, sequence: int, *, robot: str = "r1", stamp_s: float | None = None) -> None:
        message = Command(
            robot=robot,
            request_id="q-central",
            linear_m_s=linear_m_s,
            angular_rad_s=0.0,
            ttl_s=0.3,
            sequence=sequence,
            stamp_s=self.runtime.now_s() if stamp_s is None else stamp_s,
        )
        LocalBus.publish(self.bus, self.keys.command(robot), message)  # as in one process: no wire has looked at it
        self.runtime.mailbox.drain()

    def estop(self, engaged: bool, order: str, robots: tuple[str, ...] = ()) -> None:
        self.bus.publish(self.keys.estop, EStop(id=order, engaged=engaged, robots=robots, source="test"))
        self.runtime.mailbox.drain()

    def stop(self, order: str) -> None:
        self.bus.publish(self.keys.stop, StopRequest(id=order, source="test"))
        self.runtime.mailbox.drain()

    @property
    def commanded(self) -> np.ndarray:
        """What the controller told the drivers in the last tick, (n, 2)."""
        return self.agent.setpoints

    def time_to_zero_s(self, limit_s: float = 3.0) -> float:
        """Run tick by tick until all set-points are zero; return how long that took."""
        began_s = self.runtime.now_s()
        while self.commanded.any():
            assert self.runtime.now_s() - began_s < limit_s, "it drives on"
            self.run(TICK_S)
        return self.runtime.now_s() - began_s
