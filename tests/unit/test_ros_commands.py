"""What ROS may do with a swarm: velocities with leases and dead-man, requests in JSON, limits on both."""

from __future__ import annotations

import itertools
import json
import math
import struct

import pytest

from fullswarm.messages import BehaviourRequest, EStop, StopRequest
from fullswarm.ros_bridge.cmd_vel import DEAD_MAN_S
from tests.unit.core_swarm import KEYS
from tests.unit.ros_bench import RosBench, fresh

bench = pytest.fixture(fresh)
TWIST = struct.Struct("<4x6d")


def raw(*values: float) -> bytes:
    """Return a Twist in CDR, made by hand."""
    return b"\0\1\0\0" + TWIST.pack(*values)[4:]


def moving(request: BehaviourRequest) -> bool:
    return bool(request.parameters["linear"] or request.parameters["angular"])


def holder(bench: RosBench, robot: str) -> str:
    lease = bench.anna.leases.get(robot)
    return "" if lease is None else lease.operator


# ---------------------------------------------------------------- velocities
def test_a_velocity_becomes_the_share_of_the_robots_full_speed(bench: RosBench) -> None:
    bench.run(1.5)
    bench.stream("r0", 0.2, 1.0, angular=-0.5)
    newest = bench.driven()[-1]
    assert (newest.robots, newest.operator, newest.take) == (("r0",), "ros@lab", False)
    assert newest.parameters["linear"] == pytest.approx(0.4)
    assert newest.parameters["angular"] == pytest.approx(-0.25)
    assert (newest.parameters["speed_m_s"], newest.parameters["turn_rad_s"]) == (0.5, 2.0)
    assert bench.swarm.behaviours() == ["drive_bc", ""]
    assert bench.diagnostic("swarm: r0 cmd_vel").message == "driving"


def test_what_is_faster_than_the_robot_is_its_full_speed(bench: RosBench) -> None:
    bench.run(1.5)
    bench.stream("r0", -1e6, 0.2, angular=1e300)
    assert (bench.driven()[-1].parameters["linear"], bench.driven()[-1].parameters["angular"]) == (-1.0, 1.0)


def test_a_stream_that_ends_stops_the_robot_and_returns_it(bench: RosBench) -> None:
    bench.run(1.5)
    bench.stream("r0", 0.2, 1.0)
    ended_s = bench.swarm.runtime.now_s()
    bench.run(1.5)
    assert holder(bench, "r0") == ""
    zeros = [each for each in bench.driven() if not moving(each)]
    assert DEAD_MAN_S - 0.06 <= zeros[0].stamp_s - ended_s <= DEAD_MAN_S + 0.03
    count = len(bench.driven())
    bench.run(1.0)
    assert len(bench.driven()) == count


def test_the_robot_is_held_while_it_is_driven(bench: RosBench) -> None:
    bench.run(1.5)
    bench.stream("r0", 0.2, 1.5)
    assert (holder(bench, "r0"), holder(bench, "r1")) == ("ros@lab", "")


def test_a_zero_stops_at_once_and_starts_nothing(bench: RosBench) -> None:
    bench.run(1.5)
    bench.stream("r0", 0.0, 1.0)
    assert (bench.driven(), bench.lease_requests()) == ([], [])
    bench.stream("r0", 0.2, 0.5)
    bench.twist("r0", 0.0)
    bench.run(0.07)  # with the next frame
    assert not moving(bench.driven()[-1])
    bench.stream("r0", 0.0, 3.0)  # a controller that publishes zeros for ever must not hold the robot
    assert holder(bench, "r0") == ""


def test_a_robot_of_another_operator_is_refused_with_its_name_and_not_driven_when_it_lets_go(bench: RosBench) -> None:
    bench.run(1.5)
    bench.anna.hold(["r0"])
    bench.run(1.5)
    bench.stream("r0", 0.2, 1.0)
    assert bench.driven() == []
    refused = bench.diagnostic("swarm: r0 cmd_vel")
    assert (refused.level, refused.message) == (1, "refused: r0 is held by anna@lab")
    bench.anna.release()
    bench.stream("r0", 0.2, 2.0)
    assert bench.driven() == []  # it would start to move without anything that ROS has newly decided
    bench.run(0.5)
    bench.stream("r0", 0.2, 0.5)
    assert moving(bench.driven()[-1])


def test_a_robot_that_is_taken_over_is_released(bench: RosBench) -> None:
    bench.run(1.5)
    bench.stream("r0", 0.2, 1.5)
    bench.anna.hold(["r0"], take=True)
    bench.stream("r0", 0.2, 1.0)
    count = len(bench.driven())
    assert not moving(bench.driven()[-1])
    bench.stream("r0", 0.2, 1.0)
    assert (len(bench.driven()), holder(bench, "r0")) == (count, "anna@lab")
    assert "anna@lab" in bench.diagnostic("swarm: r0 cmd_vel").message


@pytest.mark.parametrize("order", ["stop", "estop", "clear"])
def test_a_stop_of_anyone_ends_driving_until_the_stream_has_paused(bench: RosBench, order: str) -> None:
    bench.run(1.5)
    bench.stream("r0", 0.2, 0.5)
    if order == "stop":
        bench.swarm.bus.publish(KEYS.stop, StopRequest(id="s", source="console"))
    else:
        bench.swarm.bus.publish(KEYS.estop, EStop(id="s", engaged=order == "estop", source="console"))
    bench.stream("r0", 0.2, 1.0)
    count = len(bench.driven())
    assert not moving(bench.driven()[-1])
    bench.stream("r0", 0.2, 1.0)
    assert len(bench.driven()) == count
    assert "console" in bench.diagnostic("swarm: r0 cmd_vel").message


def test_a_refusal_of_the_core_is_shown_with_its_reason(bench: RosBench) -> None:
    bench.run(1.5)
    bench.swarm.robots["r0"].refuse = "its driver is in FAULT"
    bench.stream("r0", 0.2, 1.5)
    assert "its driver is in FAULT" in bench.diagnostic("swarm: r0 cmd_vel").message
    assert bench.swarm.behaviours() == ["", ""]


def test_without_a_core_nothing_is_driven(bench: RosBench) -> None:
    bench.swarm.core.close()
    bench.stream("r0", 0.2, 1.0)
    assert bench.driven() == []
    assert "no core" in bench.diagnostic("swarm: r0 cmd_vel").message


def test_a_robot_without_stated_limits_is_not_driven(bench: RosBench) -> None:
    bench.fields = {}
    bench.run(1.5)
    bench.stream("r0", 0.2, 1.0)
    assert bench.driven() == []
    assert "limits" in bench.diagnostic("swarm: r0 cmd_vel").message


def test_a_flood_of_velocities_reaches_the_swarm_at_a_bounded_rate(bench: RosBench) -> None:
    bench.run(1.5)
    for k in range(100):
        for j in range(50):
            bench.twist("r0", 0.1 + 0.001 * (k + j))
        bench.run(0.01)
    assert 15 <= len(bench.driven()) <= 55


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", [0, 1, 5])
def test_a_velocity_that_is_not_finite_is_refused_and_named(bench: RosBench, bad: float, place: int) -> None:
    bench.run(1.5)
    values = [0.1] * 6
    values[place] = bad
    bench.link.send("r0/cmd_vel", raw(*values), sender="gid 7")
    bench.run(1.5)
    assert bench.driven() == []
    entry = bench.diagnostic("swarm: bridge")
    assert (entry.level, entry.message) == (1, "gid 7 on /r0/cmd_vel: a velocity that is not finite")


def test_malformed_velocities_neither_drive_nor_end_a_drive(bench: RosBench) -> None:
    bench.run(1.5)
    for _ in range(20):
        for data in (b"", b"\0\1\0\0", raw(*[0.1] * 6)[:-1], raw(*[0.1] * 6) + b"12345678", b"\xff" * 52):
            bench.link.send("r0/cmd_vel", data)
        bench.twist("r0", 0.2)
        bench.run(0.05)
    assert bench.swarm.behaviours()[0] == "drive_bc"
    assert all(each.parameters["linear"] == pytest.approx(0.4) for each in bench.driven())
    bench.run(1.0)
    numbers = {each.key: each.value for each in bench.diagnostic("swarm: bridge").values}
    assert numbers["refused or malformed"] == "100"


def test_the_end_of_the_bridge_stops_what_ros_drives_and_returns_it(bench: RosBench) -> None:
    bench.run(1.5)
    bench.stream("r0", 0.2, 0.5)
    done: list[float] = []
    bench.bridge.finish(lambda: done.append(bench.swarm.runtime.now_s()))
    bench.stream("r0", 0.2, 1.5)  # ROS has not noticed, and goes on
    assert len(done) == 1
    assert (moving(bench.driven()[-1]), holder(bench, "r0")) == (False, "")
    idle: list[int] = []
    bench.bridge.finish(lambda: idle.append(1))
    assert idle == [1]


def test_a_robot_that_disappears_is_released(bench: RosBench) -> None:
    bench.run(1.5)
    bench.stream("r0", 0.2, 0.5)
    del bench.pose["r0"]
    bench.stream("r0", 0.2, 14.0)
    assert "r0/cmd_vel" not in bench.link.taken
    bench.run(1.5)
    assert (moving(bench.driven()[-1]), holder(bench, "r0")) == (False, "")


# ---------------------------------------------------------------- requests
def test_a_request_is_passed_to_the_core_and_each_phase_is_answered_once(bench: RosBench) -> None:
    bench.run(0.2)
    bench.ask({"id": "a1", "behaviour": "rendezvous_bc", "robots": ["r0"]})
    bench.run(3.0)
    assert bench.swarm.behaviours() == ["rendezvous_bc", ""]
    answers = bench.answers()
    assert {each["id"] for each in answers} == {"a1"}
    assert (answers[-1]["phase"], answers[-1]["running"]) == ("running", ["r0"])
    plain = [{name: value for name, value in each.items() if name != "stamp_s"} for each in answers]
    assert all(before != after for before, after in itertools.pairwise(plain))


def test_what_the_core_refuses_is_answered_with_its_reason(bench: RosBench) -> None:
    bench.run(1.5)
    bench.ask({"id": "a", "behaviour": "fly"})
    bench.anna.hold(["r0"])
    bench.run(1.5)
    bench.ask({"id": "b", "behaviour": "rendezvous", "robots": ["r0"]})
    bench.run(0.5)
    first, second = bench.answers()
    assert (first["id"], first["phase"], second["id"], second["phase"]) == ("a", "refused", "b", "refused")
    assert "anna@lab" in second["reason"]


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", "7", '{"behaviour": 3}', '{"behaviour": "x", "wheels": 4}', '{"op": "clear"}', "{}",
     '{"behaviour": "flocking", "robots": ["../r0"]}', '{"op": "stop", "robots": ["@pair"]}', "[" * 100_000,
     '{"behaviour": "flocking", "parameters": {"a": {}}}', json.dumps({"behaviour": "x" * 70})],
)  # fmt: skip
def test_what_is_no_request_is_answered_counted_and_does_nothing(bench: RosBench, text: str) -> None:
    bench.run(0.2)
    bench.ask(text)
    bench.run(1.0)
    assert bench.swarm.behaviours() == ["", ""]
    assert bench.swarm.sent(StopRequest) == []
    (answer,) = bench.answers()
    assert (answer["phase"], bool(answer["reason"])) == ("refused", True)
    assert bench.diagnostic("swarm: bridge").level == 1


def test_a_flood_of_requests_is_limited_and_answered_once_a_second(bench: RosBench) -> None:
    bench.run(1.0)
    for k in range(200):
        bench.link.send("swarm/request", bench.link.codec.encode(
            "std_msgs/msg/String", {"data": json.dumps({"id": str(k), "behaviour": "rendezvous", "robots": ["r0"]})}
        ))  # fmt: skip
        bench.run(0.01)
    asked = {each.id for each in bench.swarm.sent(BehaviourRequest) if isinstance(each, BehaviourRequest)}
    assert 10 <= len(asked) <= 22
    refused = [each for each in bench.answers() if "requests a second" in str(each.get("reason"))]
    assert len(refused) <= 4


def test_a_flood_of_stops_stops_at_once_and_does_not_flood_the_swarm(bench: RosBench) -> None:
    bench.run(0.2)
    bench.ask({"behaviour": "rendezvous"})
    bench.run(0.5)
    for k in range(300):
        bench.link.send("swarm/request", bench.link.codec.encode(
            "std_msgs/msg/String", {"data": json.dumps({"id": str(k), "op": "stop"})}
        ))  # fmt: skip
    bench.run(0.1)
    assert bench.swarm.behaviours() == ["", ""]
    bench.run(1.0)
    assert len({each.id for each in bench.swarm.sent(StopRequest) if isinstance(each, StopRequest)}) <= 3


def test_stops_of_different_robots_that_come_together_all_count(bench: RosBench) -> None:
    bench.run(0.2)
    bench.ask({"behaviour": "rendezvous"})
    bench.run(0.5)
    for robot in ("r0", "r1"):
        data = {"data": json.dumps({"id": robot, "op": "stop", "robots": [robot]})}
        bench.link.send("swarm/request", bench.link.codec.encode("std_msgs/msg/String", data))
    bench.run(1.0)
    assert bench.swarm.behaviours() == ["", ""]
    assert [each["id"] for each in bench.answers() if each.get("op") == "stop"] == ["r0", "r1"]


def test_an_estop_is_latched_and_names_who_has_not_confirmed(bench: RosBench) -> None:
    bench.run(0.2)
    bench.ask({"id": "e", "op": "estop"})
    bench.run(6.0)
    assert [robot.estop for robot in bench.swarm.robots.values()] == [True, True]
    (answer,) = bench.answers()
    assert (answer["id"], answer["missing"]) == ("e", ["r0", "r1"])  # robots of this bench send no receipts


def test_a_request_ends_driving_first_so_that_its_zeros_do_not_end_the_request(bench: RosBench) -> None:
    bench.run(1.5)
    bench.stream("r0", 0.2, 0.5)
    bench.ask({"id": "a", "behaviour": "rendezvous_bc"})
    bench.run(2.0)
    assert bench.swarm.behaviours() == ["rendezvous_bc", "rendezvous_bc"]


def test_a_request_that_no_core_answers_is_given_up(bench: RosBench) -> None:
    bench.run(0.2)
    bench.swarm.core.close()
    bench.ask({"id": "a", "behaviour": "rendezvous"})
    bench.run(6.0)
    assert bench.answers()[-1]["reason"] == "the core does not answer"
    bench.swarm.start_core()
    bench.run(3.0)
    assert bench.swarm.behaviours() == ["", ""]


@pytest.mark.parametrize("ros", [1, 2])
def test_both_kinds_of_ros_drive_and_request(ros: int) -> None:
    bench = RosBench(ros=1 if ros == 1 else 2)
    bench.run(1.5)
    bench.stream("r1", 0.5, 0.3)
    assert bench.swarm.behaviours() == ["", "drive_bc"]
    bench.ask({"id": "a", "behaviour": "rendezvous_bc"})
    bench.run(1.0)
    assert bench.swarm.behaviours() == ["rendezvous_bc", "rendezvous_bc"]
    bench.close()


# ---------------------------------------------------------------- services
def test_services_stop_all_robots_and_latch_their_estops(bench: RosBench) -> None:
    bench.run(0.2)
    assert bench.link.served == ["swarm/stop", "swarm/estop"]
    bench.ask({"behaviour": "rendezvous"})
    bench.run(0.5)
    replies = bench.call("swarm/stop")
    bench.run(1.0)
    assert bench.swarm.behaviours() == ["", ""]
    assert replies == [(True, "a stop was sent to all robots")]
    replies = bench.call("swarm/estop")
    bench.run(6.0)
    assert [robot.estop for robot in bench.swarm.robots.values()] == [True, True]
    assert replies == [(False, "confirmed by no robot; not by r0, r1")]  # robots of this bench send no receipts
