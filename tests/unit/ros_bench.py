"""A bridge to ROS on a simulated clock: a real core, robots that answer it, and a side of ROS in memory."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Literal

from fullswarm.messages import BehaviourRequest, HealthReport, LeaseRequest, RobotHealth, RobotStates
from fullswarm.operator.client import Operator
from fullswarm.operator.leases import LeaseHolder
from fullswarm.ros_bridge.bridge import Bridge, Options
from fullswarm.ros_bridge.codec import STRING, TWIST, Codec
from fullswarm.ros_bridge.link import Incoming, Topic, Values
from tests.unit.core_swarm import KEYS, Swarm

WALL_S = 1_700_000_000
STATE_S = 0.05


class MemoryLink:
    """A side of ROS that keeps what it gets; messages go through the bytes of its ROS in both directions."""

    def __init__(self, ros: Literal[1, 2] = 2) -> None:
        self.codec = Codec(ros)
        self.where, self.up, self.dropped = f"ROS {ros}", True, 0
        self.offered: dict[str, Topic] = {}
        self.taken: dict[str, Topic] = {}
        self.published: list[tuple[str, bytes]] = []
        self.waiting: list[Incoming] = []
        self.served: list[str] = []
        self.closed = 0

    def advertise(self, topic: Topic) -> None:
        self.offered.setdefault(topic.name, topic)

    def subscribe(self, topic: Topic) -> None:
        self.taken.setdefault(topic.name, topic)

    def serve(self, name: str) -> None:
        self.served.append(name)

    def withdraw(self, name: str) -> None:
        self.offered.pop(name, None)
        self.taken.pop(name, None)

    def publish(self, name: str, values: Values) -> None:
        self.published.append((name, self.codec.encode(self.offered[name].kind, values)))

    def take(self) -> list[Incoming]:
        found, self.waiting = self.waiting, []
        return found

    def decode(self, kind: str, data: bytes) -> Any:
        return self.codec.decode(kind, data)

    def close(self) -> None:
        self.closed += 1

    # ------------------------------------------------------------ as a node of ROS
    def seen(self, name: str) -> list[Any]:
        kind = self.offered[name].kind
        return [self.codec.decode(kind, data) for topic, data in self.published if topic == name]

    def send(self, name: str, data: bytes, sender: str = "node", problem: str = "") -> None:
        self.waiting.append(Incoming(name, sender, data, problem))


class RosBench:
    """The bridge as operator ``ros@lab``, and a second operator, ``anna@lab``."""

    def __init__(self, *, commands: bool = True, namespace: str = "", ros: Literal[1, 2] = 2) -> None:
        self.swarm = Swarm(count=2)
        runtime, bus = self.swarm.runtime, self.swarm.bus
        self.link = MemoryLink(ros)
        self.operator = Operator(bus, KEYS, runtime, "bridge", name="ros@lab", clock="c")
        self.prefix = f"{namespace}/" if namespace else ""
        self.bridge = Bridge(
            bus, KEYS, runtime, self.operator, [self.link], Options(namespace, commands),
            lambda: round(1e9 * (WALL_S + runtime.now_s())),
        )  # fmt: skip
        self.anna = LeaseHolder(bus, KEYS, runtime, "anna@lab")
        self.pose: dict[str, tuple[float, float, float]] = {"r0": (1.0, 2.0, 0.5), "r1": (3.0, -1.0, -2.0)}
        self.fields: dict[str, Any] = {"speed_limit_m_s": (0.5,), "turn_limit_rad_s": (2.0,)}
        self.sequence = 0
        self.timer = runtime.every(STATE_S, self.report)

    def report(self) -> None:
        """Say where the robots are."""
        self.sequence += 1
        for number, (robot, (x_m, y_m, heading_rad)) in enumerate(self.pose.items()):
            self.swarm.bus.publish(KEYS.state("all", f"host{number}"), RobotStates(
                host=f"host{number}", sequence=self.sequence, stamp_s=self.swarm.runtime.now_s(), robots=(robot,),
                x_m=(x_m,), y_m=(y_m,), heading_rad=(heading_rad,), speed_m_s=(0.25,), turn_rad_s=(-0.5,),
                radius_m=(0.17,), **self.fields,
            ))  # fmt: skip

    def run(self, seconds: float) -> None:
        self.swarm.run(seconds)

    def health(self, robot: str, **fields: Any) -> None:
        state: dict[str, Any] = {
            "robot": robot, "driver": "null://", "make": "sim", "model": "disc", "firmware": "", "lifecycle": "ACTIVE",
        }  # fmt: skip
        report = HealthReport(host=robot, process="p", version="1", robots=(RobotHealth(**state | fields),))
        self.swarm.bus.publish(KEYS.health(robot), report)

    # ------------------------------------------------------------ as a node of ROS
    def twist(self, robot: str, linear: float, angular: float = 0.0) -> None:
        values = {"linear": {"x": linear}, "angular": {"z": angular}}
        self.link.send(f"{self.prefix}{robot}/cmd_vel", self.link.codec.encode(TWIST, values))

    def stream(self, robot: str, linear: float, seconds: float, angular: float = 0.0) -> None:
        """Send velocities at 20 Hz."""
        for _ in range(round(seconds / 0.05)):
            self.twist(robot, linear, angular)
            self.run(0.05)

    def ask(self, text: str | dict[str, Any]) -> None:
        data = text if isinstance(text, str) else json.dumps(text)
        self.link.send(f"{self.prefix}swarm/request", self.link.codec.encode(STRING, {"data": data}))
        self.run(0.05)

    def answers(self) -> list[dict[str, Any]]:
        return [json.loads(each.data) for each in self.link.seen(f"{self.prefix}swarm/answer")]

    def diagnostic(self, name: str) -> Any:
        newest = self.link.seen(f"{self.prefix}diagnostics")[-1]
        return next(each for each in newest.status if each.name == name)

    def call(self, name: str) -> list[tuple[bool, str]]:
        """Call a service; return the replies, which grow."""
        replies: list[tuple[bool, str]] = []
        reply = Incoming(name, "client", b"", reply=lambda success, text: replies.append((success, text)))
        self.link.waiting.append(reply)
        return replies

    # ------------------------------------------------------------ as the swarm has it
    def driven(self) -> list[BehaviourRequest]:
        """Return the frames of teleoperation so far."""
        found = [each for each in self.swarm.sent(BehaviourRequest) if isinstance(each, BehaviourRequest)]
        return [each for each in found if each.behaviour == "drive_bc"]

    def lease_requests(self) -> list[LeaseRequest]:
        found = [each for each in self.swarm.sent(LeaseRequest) if isinstance(each, LeaseRequest)]
        return [each for each in found if each.operator == "ros@lab"]

    def close(self) -> None:
        self.bridge.close()
        self.anna.close()
        self.operator.close()
        self.swarm.close()


def fresh() -> Iterator[RosBench]:
    """Give a test a bench of its own."""
    made = RosBench()
    yield made
    made.close()
