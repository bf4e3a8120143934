"""A core with robots that answer control requests and report their health, on a simulated clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import CoreConfig, RobotConfig, SwarmConfig
from fullswarm.core.node import CoreNode
from fullswarm.keys import Keys
from fullswarm.messages import (
    BehaviourRequest,
    Command,
    ControlAck,
    ControlRequest,
    EStop,
    HealthReport,
    Message,
    RequestStatus,
    Result,
    RobotHealth,
    StopRequest,
    Value,
)
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.store import Store

KEYS = Keys()
Drop = Callable[[str, Message], bool]


def health(
    robot: str,
    *,
    behaviour: str = "",
    request_id: str = "",
    core: str = "",
    sequence: int = 0,
    estop: bool = False,
    result: Result | None = None,
) -> RobotHealth:
    return RobotHealth(
        robot=robot, driver="null://", make="", model="", firmware="", lifecycle="ACTIVE",
        behaviour=behaviour, request_id=request_id, core=core, sequence=sequence, estop=estop, result=result,
    )  # fmt: skip


class LossyBus(LocalBus):
    """Loses what `drop` says."""

    drop: Drop = staticmethod(lambda _key, _message: False)

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        if not self.drop(key, message):
            super().publish(key, message, sender=sender)


class Robot:
    """A robot as the agent plays it: newest sequence wins, a repeated one is answered again, not done again."""

    def __init__(self, bus: LossyBus, runtime: Runtime, robot: str) -> None:
        self.bus, self.runtime, self.robot = bus, runtime, robot
        self.log: list[tuple[str, str, str]] = []  # on/off, behaviour, request
        self.commands: list[Command] = []
        self.stops: set[str] = set()
        self.refuse = ""
        self.starts = 0
        self.task: ControlRequest | None = None
        self.result: Result | None = None
        self.alive = False

    def start(self) -> Robot:
        self.starts += 1
        self.task, self.alive, self.estop, self.result = None, True, False, None
        self.newest, self.answer = ("", 0), ControlAck(
            request_id="", robot=self.robot, behaviour="", enabled=False, accepted=False
        )  # fmt: skip
        self.subscriptions = [
            self.bus.subscribe(KEYS.control_requests(self.robot), ControlRequest, self.control),
            self.bus.subscribe(KEYS.stop, StopRequest, self.stopped),
            self.bus.subscribe(KEYS.estop, EStop, self.latched),
            self.bus.subscribe(KEYS.command(self.robot), Command, self.commands.append),
        ]
        self.timer = self.runtime.every(0.5, self.report, first_s=0.0)
        return self

    def kill(self) -> None:
        self.alive = False
        self.timer.cancel()
        for subscription in self.subscriptions:
            subscription.close()

    def stopped(self, stop: StopRequest) -> None:
        if stop.id not in self.stops and (not stop.robots or self.robot in stop.robots):
            self.stops.add(stop.id)
            self.halt()

    def latched(self, order: EStop) -> None:
        if not order.robots or self.robot in order.robots:
            self.estop = order.engaged
            self.halt()

    def halt(self) -> None:
        """Drop the task as a stop that only the robot heard does."""
        self.task = None
        self.report()

    def finish(self, *, arrived: bool = True) -> None:
        """End the task as its own control law does."""
        if self.task is not None:
            outcome: Literal["arrived", "failed"] = "arrived" if arrived else "failed"
            self.result = Result(request_id=self.task.request_id, robot=self.robot, outcome=outcome)
            self.task = None
            self.report()

    def control(self, request: ControlRequest) -> None:
        if request.core == self.newest[0] and request.sequence <= self.newest[1]:
            if request.sequence == self.newest[1]:
                self.bus.publish(KEYS.ack(self.robot), self.answer)
            return
        self.newest = (request.core, request.sequence)
        accepted = not (request.enable and self.refuse)
        if accepted:
            self.task, self.result = request if request.enable else None, None
            self.log.append(("on" if request.enable else "off", request.behaviour, request.request_id))
        self.answer = ControlAck(
            request_id=request.request_id, robot=self.robot, behaviour=request.behaviour,
            enabled=self.task is not None, accepted=accepted, reason="" if accepted else self.refuse,
            core=request.core, sequence=request.sequence,
        )  # fmt: skip
        self.report()
        self.bus.publish(KEYS.ack(self.robot), self.answer)

    def report(self) -> None:
        task = self.task
        state = health(self.robot, estop=self.estop, result=self.result) if task is None else health(
            self.robot, behaviour=task.behaviour, request_id=task.request_id, core=task.core, sequence=task.sequence,
            estop=self.estop,
        )  # fmt: skip
        self.bus.publish(
            KEYS.health(self.robot),
            HealthReport(host=self.robot, process=f"{self.robot}-{self.starts}", version="", robots=(state,)),
        )

    @property
    def behaviour(self) -> str:
        return self.task.behaviour if self.task else ""


@dataclass
class Swarm:
    """`count` configured robots r0, r1, … and a core; `late` of them are not started."""

    count: int = 3
    late: int = 0
    store: Store = field(default_factory=Store)
    interval_s: float = 0.05
    statuses: list[RequestStatus] = field(default_factory=list)
    messages: list[tuple[float, str, Message]] = field(default_factory=list)

    def __post_init__(self) -> None:
        mailbox = Mailbox()
        self.runtime, self.bus = Runtime(SimClock(), mailbox), LossyBus(mailbox)
        self.config = SwarmConfig(
            robot=tuple(RobotConfig(id=f"r{k}") for k in range(self.count)),
            core=CoreConfig(schedule_interval_s=self.interval_s),
        )
        self.bus.subscribe("**", Message, self._note)
        self.bus.subscribe(KEYS.behaviour_status, RequestStatus, self.statuses.append)
        self.cores = 0
        self.start_core()
        self.robots = {f"r{k}": Robot(self.bus, self.runtime, f"r{k}") for k in range(self.count)}
        for k in range(self.count - self.late):
            self.robots[f"r{k}"].start()
        self.run(0.01)

    def _note(self, message: Message) -> None:
        self.messages.append((self.runtime.now_s(), type(message).__name__, message))

    def start_core(self, store: Store | None = None) -> None:
        self.cores += 1
        self.store = store or self.store
        self.core = CoreNode(self.bus, self.runtime, self.config, self.store, f"core-{self.cores}")

    def run(self, duration_s: float) -> None:
        self.runtime.run(duration_s)

    def ask(self, request_id: str, behaviour: str, *robots: str, **parameters: Value) -> None:
        request = BehaviourRequest(id=request_id, behaviour=behaviour, robots=robots, parameters=parameters)
        self.bus.publish(KEYS.behaviour_request, request)

    def phases(self, request_id: str) -> list[str]:
        return [each.phase for each in self.statuses if each.request_id == request_id]

    def status(self, request_id: str) -> RequestStatus:
        return [each for each in self.statuses if each.request_id == request_id][-1]

    def sent(self, kind: type[Message]) -> list[Message]:
        return [message for _, name, message in self.messages if name == kind.__name__]

    def behaviours(self) -> list[str]:
        return [robot.behaviour for robot in self.robots.values()]

    def close(self) -> None:
        self.core.close()
        self.store.close()
        self.bus.close()


def fresh() -> Iterator[Swarm]:
    """Give a test a swarm of its own and close it: ``swarm = pytest.fixture(fresh)``."""
    made = Swarm()
    yield made
    made.close()
