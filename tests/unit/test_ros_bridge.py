"""The bridge to ROS: what it shows of a swarm, robots that come and go, and values of its messages by rosbags."""

from __future__ import annotations

import hashlib
import json
import math
from typing import Any, Literal

import msgspec
import numpy as np
import pytest

from fullswarm.drivers.ros import protocol, zenoh_wire
from fullswarm.errors import ConfigError, MessageError
from fullswarm.maps.tiles import FREE, OCCUPIED, GridPlace, pack
from fullswarm.messages import SeenObstacles
from fullswarm.operator.session import Target
from fullswarm.ros_bridge import codec as types
from fullswarm.ros_bridge import values as v
from fullswarm.ros_bridge.bridge import GONE_S, Options, ros_name
from fullswarm.ros_bridge.codec import Codec
from fullswarm.ros_bridge.complaints import Complaints
from fullswarm.ros_bridge.session import Sides
from fullswarm.ros_bridge.session import bridge as run_bridge
from tests.unit.core_swarm import KEYS
from tests.unit.ros_bench import WALL_S, RosBench, fresh

bench = pytest.fixture(fresh)
STATE = v.RobotState(1.0, 2.0, 0.5, 0.25, -0.5, 0.17, 0.5, 2.0, 0.03, 0.02, 4.0, 5.0, False)


# ---------------------------------------------------------------- types
@pytest.mark.parametrize(
    ("kind", "known"),
    [
        # As rmw_zenoh has them in keys, in public repositories; the first two are also constants of the ros:// driver.
        (types.TWIST, zenoh_wire.HASHES[protocol.TWIST]),
        (types.STRING, "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
        (types.ODOMETRY, "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"),
        (types.TF, "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
    ],
)
def test_type_hashes_are_those_of_ros(kind: str, known: str) -> None:
    assert Codec(2).type_hash(kind) == known


def test_the_hash_of_the_service_is_that_of_rep_2016() -> None:
    def field(name: str, kind: int, nested: str = "", capacity: int = 0) -> dict[str, Any]:
        about = {"type_id": kind, "capacity": capacity, "string_capacity": 0, "nested_type_name": nested}
        return {"name": name, "type": about}

    service, message = "std_srvs/srv/Trigger", 1
    flag, byte, text, int32, uint32, int64, array, bounded = 15, 3, 17, 6, 7, 8, 48, 96
    fields = {
        "builtin_interfaces/msg/Time": [field("sec", int32), field("nanosec", uint32)],
        "service_msgs/msg/ServiceEventInfo": [
            field("event_type", byte), field("stamp", message, "builtin_interfaces/msg/Time"),
            field("client_gid", byte + array, capacity=16), field("sequence_number", int64),
        ],
        f"{service}_Event": [
            field("info", message, "service_msgs/msg/ServiceEventInfo"),
            field("request", message + bounded, f"{service}_Request", 1),
            field("response", message + bounded, f"{service}_Response", 1),
        ],
        f"{service}_Request": [field("structure_needs_at_least_one_member", byte)],
        f"{service}_Response": [field("success", flag), field("message", text)],
    }  # fmt: skip
    parts = ("request", "response", "event")
    own = [field(f"{part}_message", message, f"{service}_{part.capitalize()}") for part in parts]
    described = {
        "type_description": {"type_name": service, "fields": own},
        "referenced_type_descriptions": [{"type_name": name, "fields": fields[name]} for name in sorted(fields)],
    }
    digest = hashlib.sha256(json.dumps(described, separators=(", ", ": ")).encode()).hexdigest()
    assert Codec(2).type_hash(service) == f"RIHS01_{digest}"


@pytest.mark.parametrize(
    ("kind", "known"),
    [
        (types.ODOMETRY, "cd5e73d190d741a2f92e81eda573aca7"),  # `rosmsg md5` of ROS Noetic
        (types.TWIST, "9f195f881246fdfa2798d1d3eebca84a"),
        (types.STRING, "992ce8a1687cec8c8bd883ec73ca41d1"),
        (types.TF, "94810edda583a504dfda3829e70d7eec"),
    ],
)
def test_md5_sums_are_those_of_ros_1(kind: str, known: str) -> None:
    assert Codec(1).definition(kind)[1] == known


def test_the_driver_of_ros_robots_reads_the_odometry_that_the_bridge_writes() -> None:
    data = Codec(2).encode(types.ODOMETRY, v.odometry("r1", STATE, 7_000_000_009))
    report = protocol.read_cdr(protocol.ODOMETRY, data)
    assert isinstance(report, protocol.Odometry)
    assert (report.pose.x_m, report.pose.y_m) == (1.0, 2.0)
    assert report.pose.heading_rad == pytest.approx(0.5)


@pytest.mark.parametrize("ros", [1, 2])
def test_a_message_has_the_values_of_the_robot(ros: Literal[1, 2]) -> None:
    codec = Codec(ros)
    found = codec.decode(types.ODOMETRY, codec.encode(types.ODOMETRY, v.odometry("r1", STATE, 7_000_000_009)))
    assert (found.header.frame_id, found.child_frame_id) == ("r1/odom", "r1/base_link")
    assert (found.header.stamp.sec, found.header.stamp.nanosec) == (7, 9)
    turn = found.pose.pose.orientation
    assert 2.0 * math.atan2(turn.z, turn.w) == pytest.approx(0.5)
    assert (turn.x, turn.y) == (0.0, 0.0)
    covariance = found.pose.covariance.reshape(6, 6)
    assert np.diag(covariance) == pytest.approx([0.03**2, 0.03**2, 0.0, 0.0, 0.0, 0.02**2])
    assert (found.twist.twist.linear.x, found.twist.twist.angular.z) == (0.25, -0.5)


def test_an_unknown_field_is_an_error_and_not_left_out() -> None:
    with pytest.raises(KeyError, match="wheels"):
        Codec(2).encode(types.TWIST, {"wheels": 4})


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("kind", [types.TWIST, types.STRING, types.ODOMETRY])
def test_noise_is_a_message_error(ros: Literal[1, 2], kind: str) -> None:
    codec, random = Codec(ros), np.random.default_rng(3)
    for length in (0, 1, 4, 8, 52, 53, 300):
        for _ in range(50):
            data = b"\0\1\0\0" * (ros == 2) + random.bytes(length)
            try:
                codec.decode(kind, data)
            except MessageError:
                continue


# ---------------------------------------------------------------- what is shown
def test_each_robot_has_odometry_and_a_transform_for_each_of_its_states(bench: RosBench) -> None:
    bench.run(2.0)
    odometry = bench.link.seen("r1/odom")
    assert 38 <= len(odometry) <= 41
    newest = odometry[-1]
    assert (newest.pose.pose.position.x, newest.pose.pose.position.y) == (3.0, -1.0)
    stamp = newest.header.stamp
    assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(WALL_S + bench.swarm.runtime.now_s(), abs=0.06)
    moved = bench.link.seen("tf")[-1].transforms[0]
    assert (moved.header.frame_id, moved.child_frame_id) == ("r1/odom", "r1/base_link")
    assert (moved.transform.translation.x, moved.transform.translation.y) == (3.0, -1.0)


def test_the_frames_of_robots_lie_in_the_map_unless_they_count_from_places_of_their_own(bench: RosBench) -> None:
    bench.run(0.2)
    bench.fields["own_frame"] = True
    bench.pose = {"r7": (0.0, 0.0, 0.0)}
    bench.run(0.2)
    assert bench.link.offered["tf_static"].latched
    frames = bench.link.seen("tf_static")[-1].transforms
    assert [(each.header.frame_id, each.child_frame_id) for each in frames] == [("map", "r0/odom"), ("map", "r1/odom")]
    assert all(each.transform.rotation.w == 1.0 for each in frames)


def test_a_flood_of_states_is_not_passed_on(bench: RosBench) -> None:
    bench.run(0.1)
    for _ in range(1000):
        bench.report()
    bench.run(1.0)
    assert len(bench.link.seen("r0/odom")) < 100


def test_the_battery_is_shown_when_it_is_known(bench: RosBench) -> None:
    bench.run(0.5)
    assert "r0/battery_state" not in bench.link.offered
    bench.swarm.robots["r0"].kill()
    bench.health("r0", battery=0.4, charging=True)
    bench.run(1.0)
    newest = bench.link.seen("r0/battery_state")[-1]
    assert newest.percentage == pytest.approx(0.4)
    assert (newest.power_supply_status, math.isnan(newest.voltage)) == (1, True)


def test_the_map_is_published_once_per_change(bench: RosBench) -> None:
    place = GridPlace(-1.0, -2.0, 0.1, 32, 64)
    states = np.zeros((32, 64), np.uint8)
    states[0, 0], states[3, 40] = FREE, OCCUPIED
    bench.swarm.bus.publish(KEYS.grid("r0"), pack(place, states, [0, 1], "r0", 0.0))
    bench.run(6.0)
    (found,) = bench.link.seen("map")
    assert bench.link.offered["map"].latched
    assert (found.info.width, found.info.height) == (64, 32)
    assert found.info.resolution == pytest.approx(0.1)
    assert (found.info.origin.position.x, found.info.origin.position.y) == (-1.0, -2.0)
    cells = found.data.reshape(32, 64)
    assert (cells[0, 0], cells[3, 40], cells[5, 5]) == (0, 100, -1)
    other = np.zeros((32, 64), np.uint8)
    other[0, 0] = OCCUPIED  # another host measured it later; what it does not know changes nothing
    bench.swarm.bus.publish(KEYS.grid("r1"), pack(place, other, [0], "r1", 0.0))
    bench.run(3.0)
    cells = bench.link.seen("map")[-1].data.reshape(32, 64)
    assert (cells[0, 0], cells[3, 40]) == (100, 100)


def test_a_damaged_grid_is_named_and_changes_nothing(bench: RosBench) -> None:
    place = GridPlace(0.0, 0.0, 0.1, 32, 32)
    good = pack(place, np.zeros((32, 32), np.uint8), [0], "r0", 0.0)
    bench.swarm.bus.publish(KEYS.grid("r0"), msgspec.structs.replace(good, cells=b"x"))
    bench.run(2.5)
    assert "map" not in bench.link.offered
    assert "its cells are not those of 1 tiles" in bench.diagnostic("swarm: bridge").message


def test_rviz_gets_bodies_names_goals_and_obstacles(bench: RosBench) -> None:
    rows = ((5.0, 5.0, 1.0, 2.0, 0.3, 0.0),)
    bench.swarm.bus.publish(KEYS.obstacles("r0"), SeenObstacles(host="r0", rows=rows, stamp_s=0.0))
    bench.run(0.2)
    bench.ask({"behaviour": "move_to_goal_bc", "robots": ["r0"], "parameters": {"goal": [7.5, 8.5]}})
    bench.run(1.0)
    markers = bench.link.seen("swarm/markers")[-1].markers
    groups = [each.ns for each in markers]
    assert [groups.count(each) for each in ("bodies", "headings", "names", "obstacles")] == [2, 2, 2, 1]
    (goal,) = (each for each in markers if each.ns == "goals")
    assert (goal.pose.position.x, goal.pose.position.y, goal.header.frame_id) == (7.5, 8.5, "map")
    body = next(each for each in markers if each.ns == "bodies")
    assert (body.header.frame_id, body.scale.x, body.frame_locked) == ("r0/base_link", 0.34, True)
    (box,) = (each for each in markers if each.ns == "obstacles")
    assert (box.scale.x, box.scale.y) == (2.0, 4.0)
    assert len({(each.ns, each.id) for each in markers}) == len(markers)


def test_diagnostics_name_what_is_wrong_and_what_to_do(bench: RosBench) -> None:
    bench.run(0.5)
    for robot in bench.swarm.robots.values():
        robot.kill()
    bench.health("r0", estop=True)
    bench.health("r1", fault="the motor is hot", lifecycle="FAULT")
    bench.run(0.6)
    latched, faulty = bench.diagnostic("swarm: r0"), bench.diagnostic("swarm: r1")
    assert (latched.level, latched.message) == (2, "E-STOP")
    assert (faulty.level, faulty.hardware_id) == (2, "sim disc")
    assert "the motor is hot" in faulty.message
    assert "clear the e-stop" in {each.key: each.value for each in latched.values}["advice"]
    bench.timer.cancel()
    bench.run(3.0)
    assert bench.diagnostic("swarm: r0").level == 3


def test_robots_come_and_go(bench: RosBench) -> None:
    bench.run(0.5)
    assert {"r0/odom", "r1/odom"} <= bench.link.offered.keys()
    assert {"r0/cmd_vel", "r1/cmd_vel"} <= bench.link.taken.keys()
    del bench.pose["r1"]
    bench.pose["r2"] = (0.0, 0.0, 0.0)
    bench.run(GONE_S + 3.0)
    assert "r1/odom" not in bench.link.offered
    assert "r1/cmd_vel" not in bench.link.taken
    assert {"r0/odom", "r2/odom"} <= bench.link.offered.keys()
    bench.pose["r1"] = (9.0, 0.0, 0.0)
    bench.run(0.2)
    assert bench.link.seen("r1/odom")[-1].pose.pose.position.x == 9.0


@pytest.mark.parametrize(("robot", "name"), [("r1", "r1"), ("base-7", "base_7"), ("7up", "robot_7up")])
def test_a_name_is_one_that_ros_takes(robot: str, name: str) -> None:
    assert ros_name(robot) == name


def test_two_robots_of_one_name_in_ros_are_not_mixed_up(bench: RosBench) -> None:
    bench.pose = {"a-b": (1.0, 0.0, 0.0), "a_b": (2.0, 0.0, 0.0)}
    bench.run(1.0)
    assert {each.pose.pose.position.x for each in bench.link.seen("a_b/odom")} == {1.0}
    assert "'a-b' has the same name in ROS" in bench.diagnostic("swarm: bridge").message


@pytest.mark.parametrize("robot", ["", "a/b", "r*", "r 1", "$x", "é", "x" * 65, "#"])
def test_a_name_that_would_damage_a_key_is_not_shown(bench: RosBench, robot: str) -> None:
    bench.pose[robot] = (1.0, 0.0, 0.0)
    bench.health("r0", behaviour="a/**")
    bench.run(1.0)
    assert {"r0/odom", "r1/odom"} == {each for each in bench.link.offered if each.endswith("odom")}
    assert not any("**" in each for each in bench.link.offered)
    assert "no robot's name" in bench.diagnostic("swarm: bridge").message


def test_a_namespace_comes_before_every_topic() -> None:
    bench = RosBench(namespace="lab")
    bench.run(1.0)
    assert bench.link.offered
    assert all(name.startswith("lab/") for name in (*bench.link.offered, *bench.link.taken))
    bench.close()


def test_without_commands_nothing_is_taken_from_ros() -> None:
    bench = RosBench(commands=False)
    bench.run(0.5)
    assert bench.link.taken == {}
    bench.twist("r0", 0.5)
    bench.link.send("swarm/request", bench.link.codec.encode(types.STRING, {"data": '{"behaviour": "flocking"}'}))
    bench.run(1.0)
    assert (bench.driven(), bench.lease_requests(), bench.swarm.behaviours()) == ([], [], ["", ""])
    bench.close()


def test_the_papers_topics_show_which_behaviour_runs(bench: RosBench) -> None:
    bench.run(0.2)
    bench.ask({"behaviour": "move_to_goal_bc", "robots": ["r0"], "parameters": {"goal": [1.0, 2.0]}})
    bench.run(0.5)
    name = "r0/move_to_goal_bc/control_requests"
    assert bench.link.offered[name].latched
    told = json.loads(bench.link.seen(name)[-1].data)
    assert (told["enable"], told["parameters"]) == (True, {"goal": [1.0, 2.0]})
    bench.ask({"op": "stop"})
    bench.run(0.5)
    assert json.loads(bench.link.seen(name)[-1].data)["enable"] is False
    for behaviour in ("flocking", "rendezvous", "formation", "voronoi_coverage", "rendezvous_bc", "flocking_bc"):
        bench.ask({"behaviour": behaviour, "robots": ["r0"]})
        bench.run(1.0)
    assert sum(each.endswith("/control_requests") for each in bench.link.offered) <= 4


# ---------------------------------------------------------------- options
@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"ros2": None}, "no side of ROS is named"),
        ({"ros2": "tcp/localhost:7447"}, "the swarm's own hub"),
        ({"ros2": "tcp/[::1]:7447"}, "the swarm's own hub"),
        ({"ros2": "7447"}, "not the address"),
        ({"domain": 233}, "domain 233"),
        ({"namespace": "lab-1"}, "no ROS namespace"),
    ],
)
def test_options_that_cannot_work_are_refused_before_anything_is_connected(changed: dict[str, Any], words: str) -> None:
    given: dict[str, Any] = {"ros2": "tcp/127.0.0.1:7448", "domain": 0, "namespace": ""} | changed
    sides = Sides(given["ros2"], "zenoh", given["domain"], None, "")
    with pytest.raises(ConfigError, match=words):
        run_bridge(Target("tcp/127.0.0.1:7447"), sides, Options(given["namespace"]))


# ---------------------------------------------------------------- complaints
def test_a_sender_is_counted_each_time_and_logged_once_a_second(capsys: pytest.CaptureFixture[str]) -> None:
    found = Complaints()
    for k in range(1000):
        found.add("a", "noise", 10.0 + 0.001 * k)
    assert found.total == found.newest(11.0)["a"].times == 1000
    assert (capsys.readouterr().out.count("noise"), found.newest(20.0)) == (1, {})


def test_many_senders_take_bounded_memory_and_lines(capsys: pytest.CaptureFixture[str]) -> None:
    found = Complaints()
    for k in range(5000):
        found.add(f"sender {k}", "noise", 10.0)
    assert len(found.newest(10.0)) <= 64
    assert capsys.readouterr().out.count("noise") <= 8


def test_the_bridge_leaves_ros_when_it_closes(bench: RosBench) -> None:
    bench.run(0.2)
    bench.bridge.close()
    count = len(bench.link.published)
    bench.run(2.0)
    assert (bench.link.closed, len(bench.link.published)) == (1, count)
