"""One agent that carries one rover: on the driver itself and real time, or on its session in simulated time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from fullswarm.agent.motion.robot_controller import StopReason
from fullswarm.agent.node import AgentNode
from fullswarm.agent.state import Identity
from fullswarm.bus.local import LocalBus
from fullswarm.clock import Clock, SimClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Driver, Lifecycle, Reading, Twist
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.mavlink.codec import StreamParser
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.mavlink.session import Session
from fullswarm.emulators.mavlink.firmware import Firmware
from fullswarm.keys import Keys
from fullswarm.messages import ControlRequest, EStop, EStopReceipt, HealthReport, Heartbeat, RobotHealth
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.simulation.bodies import BodyState, FreeBody

KEYS = Keys()
STEP_S = 0.01
FASTEST = "speed=1.0&turn=2.0"


class SessionDriver:
    """MavlinkDriver without its port and thread: the session and the firmware, stepped by the runtime."""

    def __init__(self, runtime: Runtime, body: FreeBody, seed: int) -> None:
        self.url = f"mavlink+udp://127.0.0.1:1?{FASTEST}"
        driver = MavlinkDriver(self.url, runtime.clock)
        self.description, self.firmware = driver.description, ""
        self.rover = Firmware(body, boot_s=0.2, seed=seed)
        self.rover.power_on(runtime.now_s())
        self.session = Session(driver._settings.options, runtime.now_s())
        self._runtime = runtime
        self._down, self._up = StreamParser(), StreamParser()
        runtime.every(STEP_S, self._step, first_s=0.0)

    def _step(self) -> None:
        now_s = self._runtime.now_s()
        for frame in self.rover.tick(now_s):
            for message in self._down.feed(frame):
                self.session.receive(message, now_s)
        for frame in self.session.tick(now_s):
            for message in self._up.feed(frame):
                self.rover.receive(message, now_s)

    @property
    def state(self) -> Lifecycle:
        return self.session.state

    @property
    def fault(self) -> str:
        return self.session.fault or self.session.unfit or self.session.unaided(self._runtime.now_s())

    def open(self) -> None:
        """It is open."""

    def close(self) -> None:
        """There is nothing to let go of."""

    def activate(self) -> None:
        self.session.activate(self._runtime.now_s())

    def deactivate(self) -> None:
        self.session.deactivate(self._runtime.now_s())

    def read(self) -> Reading | None:
        return self.session.read()

    def command(self, twist: Twist) -> Twist:
        return self.session.command(twist, self._runtime.now_s())


class RoverAgent:
    """The agent, a heartbeat of a core, and what the agent has told."""

    sensors: Sequence[Driver] = ()

    def __init__(self, clock: Clock, make: Callable[[Runtime], Driver], **settings: float) -> None:
        self.runtime = Runtime(clock, Mailbox())
        self.bus = LocalBus(self.runtime.mailbox)
        self.driver = make(self.runtime)
        config = SwarmConfig.model_validate(
            {"world": {"bounds_m": [-20, -20, 80, 20]}, "agent": settings, "robot": [{"id": "r1"}]}
        )
        self.fleet = OneRobot("r1", self.driver, clock, self.sensors)
        self.agent = AgentNode(
            self.bus, self.runtime, config, self.fleet, Identity("r1", "p"), np.zeros((1, 3)),
            self.runtime.stats,
        )  # fmt: skip
        self.receipts: list[tuple[float, EStopReceipt]] = []
        self.health: list[RobotHealth] = []
        self.bus.subscribe(KEYS.estop_receipt(), EStopReceipt, self._receive)
        self.bus.subscribe(KEYS.health(), HealthReport, lambda report: self.health.append(report.robots[0]))
        self._sequence, self._orders = itertools.count(1), itertools.count(1)
        beat = Heartbeat(node="core", process="c", sequence=1)
        self.runtime.every(0.1, lambda: self.bus.publish(KEYS.heartbeat("core"), beat), first_s=0.0)

    def _receive(self, receipt: EStopReceipt) -> None:
        self.receipts.append((self.runtime.now_s(), receipt))

    def until(self, condition: Callable[[], bool], timeout_s: float = 15.0) -> float:
        """Go on until something holds; return how long that took."""
        began_s = self.runtime.now_s()
        while not condition():
            assert self.runtime.now_s() - began_s < timeout_s, f"waited in vain: {self.reason!r} {self.driver.fault}"
            self.runtime.run(STEP_S)
        return self.runtime.now_s() - began_s

    def ready(self) -> None:
        self.until(lambda: self.driver.state is Lifecycle.READY and bool(self.health))

    @property
    def reason(self) -> StopReason:
        return StopReason(int(self.agent.controller.reason[0]))

    @property
    def standing(self) -> bool:
        return bool(self.agent.standstill.at_standstill[0])

    def drive(self, *, filtered: bool = False) -> None:
        """Ask for a straight drive, as fast as the rover may; `filtered`: behind the safety filter."""
        request = ControlRequest(
            request_id=f"q{next(self._orders)}", robot="r1", behaviour="move_to_goal", law="move_to_goal",
            enable=True, filtered=filtered, core="c", sequence=next(self._sequence),
            parameters={"goal": [75.0, 0.0], "gain": 1.0, "arrive_radius_m": 0.2},
        )  # fmt: skip
        self.bus.publish(KEYS.control_requests("r1", "move_to_goal"), request)

    def estop(self, *, engaged: bool = True) -> tuple[str, float]:
        """Press; return the order's id and when."""
        order, now_s = f"e{next(self._orders)}", self.runtime.now_s()
        self.bus.publish(KEYS.estop, EStop(id=order, engaged=engaged, robots=(), source="test"))
        return order, now_s

    def confirmation(self, order: str) -> tuple[float, EStopReceipt] | None:
        """Return the receipt that says the robot stands, and when it came."""
        return next(((at, each) for at, each in self.receipts if each.id == order and each.standing), None)

    def close(self) -> None:
        self.agent.close()


class Lab(RoverAgent):
    """Simulated time."""

    driver: SessionDriver

    def __init__(self, seed: int = 0, **settings: float) -> None:
        clock = SimClock(100.0)
        self.body = FreeBody(clock=clock)
        super().__init__(clock, lambda runtime: SessionDriver(runtime, self.body, seed), **settings)
        self.ready()

    @property
    def rover(self) -> Firmware:
        return self.driver.rover

    @property
    def truth(self) -> BodyState:
        return self.body.state()
