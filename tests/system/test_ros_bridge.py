"""`fullswarm ros bridge` beside a real `fullswarm up`: ROS 2 on a router of its own, and ROS 1 where rospy is there."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from fullswarm import Swarm
from fullswarm.bus.zenoh_bus import client_config
from fullswarm.config import SwarmConfig
from fullswarm.errors import Unreachable
from fullswarm.launch.network import on_free_ports
from fullswarm.operator.view import RobotRow
from tests.system.ros_side import RosSide, free_port
from tests.waiting import until

FLEET = """
[hub]
endpoint = "{hub}"
[world]
address = "{world}"
engine = "kinematic"
bounds_m = [0.0, 0.0, 10.0, 10.0]
[world.bodies.r2]
ranges = {{ count = 8, max_m = 5.0, x_m = 0.1, sigma_m = 0.0, dropout = 0.0 }}
[[robot]]
id = "r1"
pose = [2.0, 2.0, 0.0]
[[robot]]
id = "r2"
pose = [6.0, 6.0, 0.0]
"""
ODOMETRY, DIAGNOSTICS = "nav_msgs/msg/Odometry", "diagnostic_msgs/msg/DiagnosticArray"
SYSTEM_PYTHON = "/usr/bin/python3"
PACKAGES = "python3-rospy python3-rosmaster python3-tf2-msgs"


def spawn(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-m", "fullswarm", *arguments], stderr=subprocess.PIPE, text=True)


class Lab:
    """A swarm of two robots, ROS 2 on a router, and a bridge between them."""

    def __init__(self, folder: Path) -> None:
        free = on_free_ports(SwarmConfig(), prefer_configured=False)
        file = folder / "fleet.toml"
        file.write_text(FLEET.format(hub=free.hub.endpoint, world=free.world_or_default.address))
        self.hub = ("--hub", free.hub.endpoint)
        self.up = spawn("up", str(file))
        self.ros = RosSide()
        self.bridge: subprocess.Popen[str] | None = None
        self.swarm: Swarm | None = None

    def start(self) -> None:
        """Start a bridge, if none runs; return when both robots are shown and stand."""
        if self.bridge is None or self.bridge.poll() is not None:
            self.bridge = spawn("ros", "bridge", *self.hub, "--ros2", self.ros.endpoint, "--allow-commands",
                                "--operator", "ros@lab")  # fmt: skip
            self.ros.received["diagnostics"].clear()  # of the one before
        since_s = time.monotonic()
        until(lambda: self.idle(since_s), 60.0, lambda: f"both robots are shown and stand; {self.problem()}")

    def idle(self, since_s: float) -> bool:
        """Tell whether both robots stand and the bridge, which has received leases, drives neither."""
        robots = ("r1", "r2")
        return bool(self.ros.received["diagnostics"]) and all(
            self.speed(robot, since_s) == 0.0 and self.diagnostic(f"swarm: {robot} cmd_vel") == "idle"
            for robot in robots
        )

    def problem(self) -> str:
        return "the bridge runs" if self.bridge is None or self.bridge.poll() is None else self.bridge.communicate()[1]

    def ready(self) -> None:
        """Wait until the swarm is there, seen through a client of its own."""
        until(self._connects, 60.0, "the hub answers")
        until(lambda: [self.health(robot) for robot in ("r1", "r2")] == ["READY", "READY"], 60.0, "robots are ready")

    def _connects(self) -> bool:
        try:
            self.swarm = Swarm(self.hub[1], operator="anna@lab")
        except Unreachable:
            return False
        return True

    def row(self, robot: str) -> RobotRow | None:
        found = self.swarm.state.robots if self.swarm is not None else ()
        return next((each for each in found if each.robot == robot), None)

    def health(self, robot: str) -> str:
        row = self.row(robot)
        return "" if row is None or row.health is None else row.health.lifecycle

    def stands(self, robot: str) -> bool:
        row = self.row(robot)
        return row is not None and abs(row.speed_m_s) < 0.005

    def holder(self, robot: str) -> str:
        return "" if self.swarm is None else self.swarm.state.holders.get(robot, "")

    def odometry(self, robot: str) -> Any:
        return self.ros.messages(f"{robot}/odom", ODOMETRY)[-1]

    def speed(self, robot: str, since_s: float = 0.0) -> float | None:
        """Return the newest speed that has come since; None: nothing has."""
        found = list(self.ros.received[f"{robot}/odom"])
        if not found or found[-1][0] <= since_s:
            return None
        return float(self.odometry(robot).twist.twist.linear.x)

    def diagnostic(self, name: str) -> str:
        newest = self.ros.messages("diagnostics", DIAGNOSTICS)[-1]
        return next((each.message for each in newest.status if each.name == name), "")

    def drive(self, robot: str, condition: Any, what: str) -> None:
        """Publish velocities at 20 Hz until something holds."""
        due_s = 0.0

        def publish() -> None:
            nonlocal due_s
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + 0.05
                self.ros.twist(f"{robot}/cmd_vel", 0.2)

        until(condition, 20.0, what, each=publish)

    def moves(self, robot: str) -> bool:
        return (self.speed(robot) or 0.0) > 0.1

    def stop_s(self, robot: str) -> float:
        """Wait until a robot stands; return how long that took."""
        return until(lambda: abs(self.speed(robot) or 0.0) < 0.01, 5.0, f"{robot} stands")

    def close(self) -> None:
        if self.swarm is not None:
            self.swarm.close()
        for process in (self.bridge, self.up):
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGINT)
                process.communicate(timeout=30)
        self.ros.close()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    lab = Lab(tmp_path_factory.mktemp("lab"))
    try:
        lab.ready()
        yield lab
    finally:
        lab.close()


@pytest.fixture
def lab(made: Lab) -> Lab:
    made.start()
    return made


def test_ros_2_gets_odometry_at_20_hz_and_nothing_passes_between_the_two_zenohs(lab: Lab) -> None:
    for robot in ("r1", "r2"):
        lab.ros.received[f"{robot}/odom"].clear()
    leaked: list[str] = []

    def receive(sample: zenoh.Sample) -> None:
        leaked.append(str(sample.key_expr))

    with zenoh.open(client_config(lab.hub[1], multicast=False)) as session:
        subscriber = session.declare_subscriber("**", zenoh.handlers.Callback(receive, indirect=False))
        time.sleep(3.0)
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    for robot, place in (("r1", (2.0, 2.0)), ("r2", (6.0, 6.0))):
        assert 18.0 <= len(lab.ros.received[f"{robot}/odom"]) / 3.0 <= 22.0
        position = lab.odometry(robot).pose.pose.position
        assert (position.x, position.y) == pytest.approx(place, abs=0.1)
    assert leaked
    assert all(key.startswith("swarm/") for key in leaked)
    assert all(key.startswith("0/") for key in lab.ros.keys)
    static = lab.ros.late("tf_static", "tf2_msgs/msg/TFMessage")
    until(lambda: bool(static), what="the latched frames arrive")
    assert {each.child_frame_id for each in static[-1].transforms} == {"r1/odom", "r2/odom", "r2/ranges"}


def test_ros_2_gets_the_scans_of_a_range_sensor(lab: Lab) -> None:
    lab.ros.received["r2/scan"].clear()
    took_s = until(lambda: len(lab.ros.received["r2/scan"]) > 10, 10.0, "scans arrive")
    assert took_s > 1.7  # five a second
    newest, robot = lab.ros.messages("r2/scan", "sensor_msgs/msg/LaserScan")[-1], lab.odometry("r2").pose.pose
    heading_rad = 2.0 * math.atan2(robot.orientation.z, robot.orientation.w)
    x_m, y_m = robot.position.x + 0.1 * math.cos(heading_rad), robot.position.y + 0.1 * math.sin(heading_rad)
    assert newest.header.frame_id == "r2/ranges"
    for k, distance_m in enumerate(newest.ranges):
        angle_rad = heading_rad + newest.angle_min + k * newest.angle_increment
        assert float(distance_m) == pytest.approx(to_wall_m(x_m, y_m, angle_rad), abs=0.02)


def to_wall_m(x_m: float, y_m: float, angle_rad: float) -> float:
    """Return how far the edge of the arena is, which is 10 m wide; infinite beyond the sensor's range."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    ways = [((10.0 if c > 0.0 else 0.0) - x_m) / c] if abs(c) > 1e-9 else []
    ways += [((10.0 if s > 0.0 else 0.0) - y_m) / s] if abs(s) > 1e-9 else []
    return min(ways) if min(ways) <= 5.0 else math.inf


def test_cmd_vel_drives_a_robot_until_it_ends(lab: Lab) -> None:
    lab.drive("r1", lambda: lab.moves("r1"), "r1 moves")
    assert lab.stop_s("r1") < 1.0
    assert lab.speed("r2") == 0.0


def test_a_killed_bridge_leaves_no_robot_moving(lab: Lab) -> None:
    lab.drive("r1", lambda: lab.moves("r1"), "r1 moves")
    assert lab.bridge is not None
    lab.bridge.kill()
    lab.bridge.communicate()
    # Its odometry comes to ROS no more; the swarm's own client has it.
    assert until(lambda: lab.stands("r1"), 5.0, "r1 stands") < 1.2


def test_a_bridge_that_is_ended_stops_its_robots_and_returns_them(lab: Lab) -> None:
    lab.drive("r1", lambda: lab.moves("r1"), "r1 moves")
    assert lab.bridge is not None
    lab.bridge.send_signal(signal.SIGTERM)
    said = lab.bridge.communicate(timeout=20)[1]
    assert lab.bridge.returncode == 0, said
    assert "Traceback" not in said
    until(lambda: lab.holder("r1") == "" and lab.stands("r1"), 2.5, "r1 stands, and the lease is returned")


def test_a_robot_that_another_operator_holds_is_not_driven(lab: Lab) -> None:
    assert lab.swarm is not None
    with lab.swarm.lease("r1"):
        refused = "refused: r1 is held by anna@lab"
        lab.drive("r1", lambda: lab.diagnostic("swarm: r1 cmd_vel") == refused, "the refusal is shown")
        assert lab.speed("r1") == 0.0


def test_a_request_in_json_drives_and_a_stop_ends_it(lab: Lab) -> None:
    lab.ros.received["swarm/answer"].clear()
    lab.ros.ask(id="go", behaviour="move_to_goal_bc", robots=["r2"], parameters={"goal": [3.0, 6.0]})
    until(lambda: (lab.speed("r2") or 0.0) != 0.0, 10.0, "r2 moves")
    lab.ros.ask(id="halt", op="stop")
    until(lambda: lab.speed("r2") == 0.0, 5.0, "r2 stands")
    until(lambda: "halt" in str(answers(lab)), 5.0, "the stop is answered")
    assert any(each["id"] == "go" and each.get("running") == ["r2"] for each in answers(lab))


def answers(lab: Lab) -> list[Any]:
    return [json.loads(each.data) for each in lab.ros.messages("swarm/answer", "std_msgs/msg/String")]


def test_ros_1_gets_odometry_and_drives_by_request_and_velocity(lab: Lab, tmp_path: Path) -> None:
    imports = "import rospy, tf2_msgs.msg"
    found = subprocess.run([SYSTEM_PYTHON, "-c", imports], capture_output=True, check=False, timeout=30)
    if found.returncode or not Path("/usr/bin/rosmaster").exists():
        pytest.skip(f"ROS 1 is not installed: apt-get install --no-install-recommends {PACKAGES}")
    uri = f"http://127.0.0.1:{free_port()}"
    environment = {**os.environ, "ROS_MASTER_URI": uri, "ROS_IP": "127.0.0.1", "ROS_LOG_DIR": str(tmp_path)}
    master = subprocess.Popen(
        ["/usr/bin/rosmaster", "--core", "-p", uri.rpartition(":")[2]], env=environment, stdout=subprocess.DEVNULL
    )
    bridge = None
    try:
        until(lambda: answers_xmlrpc(uri), 20.0, "the ROS master answers")
        bridge = subprocess.Popen(
            [sys.executable, "-m", "fullswarm", "ros", "bridge", *lab.hub, "--ros1", uri, "--allow-commands",
             "--operator", "ros1@lab"],
            env=environment, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        request = {"id": "go", "behaviour": "move_to_goal_bc", "robots": ["r2"], "parameters": {"goal": [9.0, 6.0]}}
        node = subprocess.run(
            [SYSTEM_PYTHON, str(Path(__file__).with_name("rospy_node.py")), "r2", json.dumps(request)],
            env=environment, capture_output=True, text=True, check=False, timeout=60,
        )  # fmt: skip
        assert node.returncode == 0, node.stderr
        told = json.loads(node.stdout.splitlines()[-1])
        assert 18.0 <= told["hz"] <= 22.0
        assert told["requested_m"] > 0.1
        assert told["turn_rad_s"] > 0.3
        assert told["after_rad_s"] == 0.0
        assert told["frames"] == ["r1/odom"]
        assert told["scan_frame"] == "r2/ranges"
        assert len(told["scan"]) == 8
        assert any(0.5 < each < 5.0 for each in told["scan"])
        bridge.send_signal(signal.SIGINT)
        assert bridge.communicate(timeout=20)[1].count("Traceback") == 0
        assert bridge.returncode == 0
    finally:
        for process in (bridge, master):
            if process is not None:
                process.kill()
                process.wait()


def answers_xmlrpc(uri: str) -> bool:
    from xmlrpc.client import ServerProxy

    try:
        with ServerProxy(uri) as proxy:
            proxy.getPid("/test")
    except OSError:
        return False
    return True
