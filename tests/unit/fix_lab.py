"""A null robot with its agent, and somebody who sees it: fixes over the bus, on a simulated clock."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from fullswarm.agent.node import AgentNode
from fullswarm.agent.state import Identity
from fullswarm.bus import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.keys import Keys
from fullswarm.messages import (
    ControlRequest,
    HealthReport,
    Heartbeat,
    PoseFix,
    RobotHealth,
    RobotStates,
)
from fullswarm.runtime import Mailbox, Runtime

KEYS = Keys("swarm")
START = (1.0, 2.0, 0.5)
RATE_HZ = 50
TIMEOUT_S = 0.5


class Lab:
    """One null robot with its agent, and a camera that sees it where `truth` says, while `seeing`."""

    def __init__(self, driver: type[NullDriver] = NullDriver, others: int = 0, **agent: Any) -> None:
        self.clock = SimClock()
        self.runtime = Runtime(self.clock, Mailbox())
        self.bus = LocalBus(self.runtime.mailbox)
        robots = [{"id": "r1", "pose": START}, *({"id": f"other{number}"} for number in range(others))]
        config = SwarmConfig.model_validate({"agent": agent, "robot": robots})
        self.driver = driver("null://r1", self.clock)
        self.agent = AgentNode(
            self.bus, self.runtime, config, OneRobot("r1", self.driver), Identity("r1", "r1-0"), np.array([START]),
            self.runtime.stats,
        )  # fmt: skip
        self.reports: list[HealthReport] = []
        self.states: list[RobotStates] = []
        self.bus.subscribe(KEYS.health(), HealthReport, self.reports.append)
        self.bus.subscribe(KEYS.state(), RobotStates, self.states.append)
        self.origin = START  # what the odometry is laid on in truth
        self.seeing = False
        self.source, self.ahead_s = "camera-1", 1000.0  # how far the camera's clock is ahead
        self.contacts = 0
        self.runtime.every(1.0 / RATE_HZ, self._see, first_s=0.011)
        self.runtime.every(0.1, self._beat, first_s=0.0)
        self.run(0.1)

    def _beat(self) -> None:
        self.bus.publish(KEYS.heartbeat("core"), Heartbeat(node="core", process="c", sequence=1))

    def _see(self) -> None:
        if self.seeing:
            self.say()

    def truth(self) -> tuple[float, float, float]:
        reading = self.driver.read()
        assert reading is not None
        x, y, turned = reading.odometry.x_m, reading.odometry.y_m, reading.odometry.heading_rad
        cos, sin = math.cos(self.origin[2]), math.sin(self.origin[2])
        return self.origin[0] + cos * x - sin * y, self.origin[1] + sin * x + cos * y, self.origin[2] + turned

    def say(self, **fields: Any) -> None:
        x_m, y_m, heading_rad = self.truth()
        fix = PoseFix(
            **{
                "robot": "r1", "x_m": x_m, "y_m": y_m, "heading_rad": heading_rad, "position_sigma_m": 0.01,
                "heading_sigma_rad": 0.02, "source": self.source, "stamp_s": self.runtime.now_s() + self.ahead_s,
                "contacts": self.contacts, **fields,
            }
        )  # fmt: skip
        self.bus.publish(KEYS.pose_fix("r1"), fix)  # as in one process: no wire has looked at it

    def run(self, seconds: float) -> None:
        self.runtime.run(seconds)

    def tick(self) -> None:
        self.runtime.run(0.02)

    @property
    def health(self) -> RobotHealth:
        return self.reports[-1].robots[0]

    def now(self) -> RobotHealth:
        self.agent.publish_health()
        self.runtime.mailbox.drain()
        return self.health

    @property
    def pose(self) -> list[float]:
        return [float(value) for value in self.agent.pose[0]]

    def drive(self, linear: float, angular: float) -> None:
        self.bus.publish(
            KEYS.control_requests("r1", "drive"),
            ControlRequest(
                request_id="q", robot="r1", behaviour="drive", law="drive", enable=True, core="c", sequence=1,
                parameters={"linear": linear, "angular": angular, "speed_m_s": 0.4, "turn_rad_s": 1.0},
            ),
        )  # fmt: skip


@pytest.fixture(params=["direct", "ekf"])
def lab(request: pytest.FixtureRequest) -> Iterator[Lab]:
    lab = Lab(estimator=request.param)
    yield lab
    lab.agent.close()


def seen(lab: Lab) -> Lab:
    lab.seeing = True
    lab.run(0.3)
    assert lab.health.pose_source == "fixes"
    return lab
