"""Robots that cannot be where they say: two in one place, or one in a frame of its own."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from fullswarm.agent.motion.robot_controller import StopReason
from fullswarm.agent.pose.conflicts import APART, DWELL_S, OVERLAP
from fullswarm.bus.versions import difference
from fullswarm.config import load_swarm
from fullswarm.drivers.fleet_file import check_frames, in_frame, own_frame
from fullswarm.errors import ConfigError
from fullswarm.messages import RobotStates, Version, versions
from fullswarm.reasons import NONE, Code
from tests.unit.agent_bench import TICK_S, Bench

FAR = {"goal": [18.0, 10.0], "gain": 0.5, "arrive_radius_m": 0.05}
STICKS = {"linear": 1.0, "angular": 0.0, "speed_m_s": 0.5, "turn_rad_s": 1.0}
RADIUS_M = 0.17


class Ghost:
    """Another robot's agent, that tells where its robot is."""

    def __init__(self, bench: Bench, *, own_frame: bool = False) -> None:
        self._bench, self._own_frame = bench, own_frame
        self._sequence = itertools.count(1)
        self.place: tuple[float, float] | None = None
        bench.runtime.every(0.05, self._tell)

    def _tell(self) -> None:
        if self.place is None:
            return
        states = RobotStates(
            host="ghost", sequence=next(self._sequence), stamp_s=self._bench.runtime.now_s(), robots=("ghost",),
            x_m=(self.place[0],), y_m=(self.place[1],), heading_rad=(0.0,), speed_m_s=(0.0,), turn_rad_s=(0.0,),
            radius_m=(RADIUS_M,), own_frame=self._own_frame,
        )  # fmt: skip
        self._bench.bus.publish(self._bench.keys.state("all", "ghost"), states)

    def stand_beside(self, overlap: float) -> None:
        """Be told where the robot stands now, but for a gap that leaves discs overlapping by a share of a radius."""
        x_m, y_m, _ = self._bench.agent.pose[0].tolist()
        self.place = (x_m, y_m + 2.0 * RADIUS_M - overlap * RADIUS_M)


@pytest.fixture
def bench() -> Bench:
    return Bench([(2.0, 10.0, 0.0)])


def reason(bench: Bench) -> StopReason:
    return StopReason(int(bench.agent.controller.reason[0]))


@pytest.mark.parametrize("filtered", [False, True])
def test_two_robots_in_one_place_are_an_alarm_that_ends_what_they_do(bench: Bench, *, filtered: bool) -> None:
    ghost = Ghost(bench)
    bench.enable("move_to_goal", FAR, filtered=filtered)
    for _ in range(10):  # wherever the robot drives: in a frame of its own the other one drives to the same place
        ghost.stand_beside(1.0)
        bench.run(0.1)
    assert not bench.commanded.any()
    assert bench.agent.tasks.of[0] is None
    assert "ghost" in bench.agent.inbox.ended[0].text
    bench.enable("move_to_goal", FAR, request_id="q2")
    assert not bench.acks[-1].accepted
    assert "by hand" in bench.acks[-1].reason


def test_driving_by_hand_moves_it_apart_and_then_it_drives_again(bench: Bench) -> None:
    ghost = Ghost(bench)
    ghost.stand_beside(1.0)
    bench.run(DWELL_S + 0.3)
    assert bench.agent.pose_conflicts.overlap[0]
    began_s = bench.runtime.now_s()
    while bench.runtime.now_s() - began_s < 3.0:
        bench.enable(
            "drive", STICKS, request_id=f"d{bench.runtime.now_s()}", expires_s=0.3,
            stamp_s=bench.runtime.now_s(),
        )  # fmt: skip
        bench.run(0.1)
    assert bench.agent.pose[0, 0] > 2.5
    assert not bench.agent.pose_conflicts.overlap[0]
    bench.enable("move_to_goal", FAR, request_id="q3")
    assert bench.acks[-1].accepted
    bench.run(0.5)
    assert reason(bench) is StopReason.MOVING


@pytest.mark.parametrize("overlap", [-0.2, 0.0, 0.1, 0.4])
def test_bodies_that_touch_are_no_alarm(bench: Bench, overlap: float) -> None:
    ghost = Ghost(bench)
    noise = np.random.default_rng(5)
    for _ in range(100):
        ghost.stand_beside(overlap)
        assert ghost.place is not None
        x_m, y_m = ghost.place
        shake = noise.normal(0.0, 0.02 if overlap <= 0.0 else 0.002, 2)
        ghost.place = x_m + float(shake[0]), y_m + float(shake[1])
        bench.run(0.1)
        assert not bench.agent.pose_conflicts.overlap[0]


def test_a_moment_is_no_alarm_and_half_apart_does_not_end_one(bench: Bench) -> None:
    ghost = Ghost(bench)
    ghost.stand_beside(1.0)
    bench.run(DWELL_S - 0.2)
    assert not bench.agent.pose_conflicts.overlap[0]
    bench.run(0.5)
    assert bench.agent.pose_conflicts.overlap[0]
    ghost.stand_beside((OVERLAP + APART) / 2.0)
    bench.run(0.5)
    assert bench.agent.pose_conflicts.overlap[0]
    ghost.stand_beside(APART - 0.1)
    bench.run(0.3)
    assert not bench.agent.pose_conflicts.overlap[0]


def test_silence_ends_the_alarm(bench: Bench) -> None:
    ghost = Ghost(bench)
    ghost.stand_beside(1.0)
    bench.run(DWELL_S + 0.3)
    assert bench.agent.pose_conflicts.overlap[0]
    ghost.place = None
    bench.run(1.0)
    assert not bench.agent.pose_conflicts.overlap[0]


def test_a_robot_in_a_frame_of_its_own_bars_whoever_hears_it(bench: Bench) -> None:
    ghost = Ghost(bench, own_frame=True)
    bench.enable("move_to_goal", FAR)
    bench.run(0.5)
    assert reason(bench) is StopReason.MOVING
    ghost.place = (15.0, 3.0)  # far away, as it says
    bench.run(0.5)
    assert not bench.commanded.any()
    assert "[world] origin" in bench.agent.inbox.ended[0].text


def test_a_robot_beside_one_whose_messages_it_cannot_read_stands_and_says_what_to_update(bench: Bench) -> None:
    bench.enable("move_to_goal", FAR)
    bench.run(1.0)
    assert reason(bench) is StopReason.MOVING
    old = Version(name="r9", software="0.0.9", kinds={"RobotStates": 1})
    bench.agent.pose_conflicts.other_version = difference(old, versions())
    bench.run(0.3)
    assert not bench.commanded.any()
    health = bench.agent.health(bench.runtime.now_s()).robots[0]
    assert (health.stop_code, health.stop_parameters["process"]) == (Code.VERSION, "r9")
    bench.enable("move_to_goal", FAR, request_id="again")
    bench.run(0.1)
    assert (bench.acks[-1].accepted, bench.acks[-1].code) == (False, Code.VERSION)
    bench.agent.pose_conflicts.other_version = NONE
    bench.run(0.3)
    bench.enable("move_to_goal", FAR, request_id="later")
    bench.run(0.5)
    assert reason(bench) is StopReason.MOVING


def test_a_robot_in_a_frame_of_its_own_drives_only_while_it_is_alone(bench: Bench) -> None:
    descriptions = (replace(bench.agent.fleet.descriptions[0], own_frame=True),)
    bench.agent.fleet.descriptions = descriptions
    bench.agent.pose_conflicts.own_frame = True
    bench.enable("move_to_goal", FAR)
    bench.run(0.5)
    assert reason(bench) is StopReason.MOVING or math.isfinite(bench.agent.pose[0, 0])
    ghost = Ghost(bench)
    ghost.place = (15.0, 3.0)
    bench.run(0.5)
    assert not bench.commanded.any()
    assert "switched on" in bench.agent.inbox.ended[0].text
    bench.run(TICK_S)


# ------------------------------------------------------------------ fleets
ROVERS = '[[robot]]\nid = "r1"\ndriver = "mavlink+udp://127.0.0.1:14550"\n[[robot]]\nid = "r2"\ndriver = "{driver}"\n'


def fleet(tmp_path: object, text: str) -> str:
    from pathlib import Path

    path = Path(str(tmp_path)) / "fleet.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("driver", ["mavlink+udp://127.0.0.1:14560?sysid=2", "create:///dev/ttyUSB0", "sim://r2"])
def test_a_fleet_without_a_common_frame_is_refused_with_what_to_write(tmp_path: object, driver: str) -> None:
    text = ROVERS.format(driver=driver)
    with pytest.raises(ConfigError, match=r"r1") as refused:
        check_frames(load_swarm(fleet(tmp_path, text)))
    assert "[world] origin = [latitude, longitude]" in refused.value.hint
    check_frames(load_swarm(fleet(tmp_path, f"[world]\norigin = [52.5163, 13.3777]\n{text}")))


def test_one_rover_alone_and_rovers_told_their_place_need_no_origin(tmp_path: object) -> None:
    check_frames(load_swarm(fleet(tmp_path, '[[robot]]\nid = "r1"\ndriver = "mavlink+udp://127.0.0.1:14550"\n')))
    told = ROVERS.format(driver="mavlink+udp://127.0.0.1:14560?pose=external").replace(
        "1:14550", "1:14550?pose=external"
    )
    check_frames(load_swarm(fleet(tmp_path, told)))
    origin = ROVERS.format(driver="create:///dev/ttyUSB0").replace("1:14550", "1:14550?origin=52.5163,13.3777")
    check_frames(load_swarm(fleet(tmp_path, origin)))


def test_the_fleets_origin_goes_into_the_url_of_whoever_needs_it() -> None:
    origin = (52.5163, 13.3777)
    assert (
        in_frame("mavlink+udp://127.0.0.1:14550?sysid=2", origin)
        == "mavlink+udp://127.0.0.1:14550?sysid=2&origin=52.5163,13.3777"
    )
    assert not own_frame(in_frame("mavlink+udp://127.0.0.1:14550", (-35.3632621, 149.1652374)))
    for url in (
        "create:///dev/ttyUSB0",
        "sim://r1",
        "mavlink+udp://127.0.0.1:1?pose=external",
        "mavlink+udp://127.0.0.1:1?origin=1,2",
    ):
        assert in_frame(url, origin) == url
