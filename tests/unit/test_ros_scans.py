"""Range scans in ROS: the values of the simulated sensor, frames, several sensors, and reports that cannot be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

import msgspec
import numpy as np
import pytest

from fullswarm.config import SwarmConfig
from fullswarm.launch.lockstep import Lockstep
from fullswarm.maps.scans import pack
from fullswarm.messages import MOST_SENSORS, RangeQuery, RangeReport, SensorScan
from fullswarm.operator.client import Operator
from fullswarm.ros_bridge.bridge import GONE_S, Bridge, Options
from tests.unit.core_swarm import KEYS
from tests.unit.ros_bench import WALL_S, MemoryLink, RosBench, fresh

bench = pytest.fixture(fresh)
FLEET = {
    "world": {
        "engine": "kinematic", "bounds_m": (0.0, 0.0, 6.0, 4.0), "boxes": [(4.0, 2.0, 0.5, 0.5, 0.4)],
        "ranges": {"count": 90, "fov_rad": 4.0, "max_m": 3.0, "x_m": 0.1, "y_m": -0.05, "yaw_rad": 0.2,
                   "sigma_m": 0.0, "dropout": 0.1},
    },
    "robot": [{"id": "r-1", "pose": (2.0, 2.0, 0.3)}],
}  # fmt: skip


class Lab:
    """A simulated robot with a lidar, and the bridge beside it."""

    def __init__(self, ros: Literal[1, 2]) -> None:
        self.swarm = Lockstep(SwarmConfig.model_validate(FLEET))
        bus, runtime, self.link = self.swarm.bus, self.swarm.runtime, MemoryLink(ros)
        operator = Operator(bus, KEYS, runtime, "bridge", name="ros@lab", clock="c")
        self.bridge = Bridge(
            bus, KEYS, runtime, operator, [self.link], Options(scans_hz=10.0),
            lambda: round(1e9 * (WALL_S + runtime.now_s())),
        )  # fmt: skip

    def close(self) -> None:
        self.bridge.close()
        self.swarm.close()


@pytest.fixture(params=[1, 2])
def lab(request: pytest.FixtureRequest) -> Iterator[Lab]:
    made = Lab(request.param)
    yield made
    made.close()


def test_ros_gets_what_the_simulated_sensor_measured(lab: Lab) -> None:
    lab.swarm.run(3.01)
    found = lab.link.seen("r_1/scan")
    assert 25 <= len(found) <= 31
    reading = lab.swarm.agent.reading
    assert reading is not None
    ((_, measured),) = reading.ranges
    lab.swarm.run(0.06)  # it is reported by then, and the next one is measured later
    assert lab.swarm.agent.reading is not None
    assert lab.swarm.agent.reading.ranges is reading.ranges
    newest = lab.link.seen("r_1/scan")[-1]
    assert np.isnan(measured.distances_m).any()
    assert np.isinf(measured.distances_m).any()
    assert newest.ranges == pytest.approx(measured.distances_m, abs=0.0006, nan_ok=True)
    rays_rad = newest.angle_min + newest.angle_increment * np.arange(len(newest.ranges))
    assert rays_rad == pytest.approx(measured.angles_rad, abs=1e-5)
    assert newest.angle_max == pytest.approx(rays_rad[-1], abs=1e-5)
    assert (newest.range_min, newest.range_max, newest.header.frame_id) == (0.0, 3.0, "r_1/ranges")
    stamp = newest.header.stamp
    assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(WALL_S + measured.stamp_s, abs=1e-6)


def test_the_frame_of_a_sensor_is_where_it_is_mounted(lab: Lab) -> None:
    lab.swarm.run(1.0)
    frames = {each.child_frame_id: each for each in lab.link.seen("tf_static")[-1].transforms}
    assert frames.keys() == {"r_1/odom", "r_1/ranges"}
    mount = frames["r_1/ranges"]
    assert mount.header.frame_id == "r_1/base_link"
    assert (mount.transform.translation.x, mount.transform.translation.y) == (0.1, -0.05)
    assert 2.0 * math.atan2(mount.transform.rotation.z, mount.transform.rotation.w) == pytest.approx(0.2)


# ---------------------------------------------------------------- reports as they may come
def scan(sensor: str = "front", **changed: object) -> SensorScan:
    made = SensorScan(
        sensor=sensor, mount=(0.1, 0.0, 0.0), robot_at=None, first_rad=0.0, step_rad=0.1,
        distances=pack(np.array([1.0, 2.0])), max_m=4.0, stamp_s=0.0,
    )  # fmt: skip
    return msgspec.structs.replace(made, **changed)


def report(bench: RosBench, *scans: SensorScan, robot: str = "r0") -> None:
    now_s = bench.swarm.runtime.now_s()
    sent = tuple(msgspec.structs.replace(each, stamp_s=now_s) for each in scans)
    bench.swarm.bus.publish(KEYS.range_report(robot), RangeReport(robot=robot, scans=sent, stamp_s=now_s))
    bench.run(0.1)


def scan_topics(bench: RosBench) -> set[str]:
    return {name for name in bench.link.offered if "/scan" in name}


def test_several_sensors_have_a_topic_each_and_names_that_ros_takes(bench: RosBench) -> None:
    bench.run(0.2)
    report(bench, scan("front"))
    assert scan_topics(bench) == {"r0/scan"}
    report(bench, scan("front"), scan("tof 0x29"), scan("odom"))
    assert scan_topics(bench) == {"r0/scan_front", "r0/scan_tof_0x29", "r0/scan_odom_sensor"}
    frames = {each.child_frame_id for each in bench.link.seen("tf_static")[-1].transforms}
    assert frames == {"r0/odom", "r1/odom", "r0/front", "r0/tof_0x29", "r0/odom_sensor"}


def test_a_sensor_that_is_moved_is_moved_in_ros_and_a_scan_is_published_once(bench: RosBench) -> None:
    bench.run(0.2)
    report(bench, scan())
    report(bench, scan(mount=(0.2, 0.0, 0.0)))
    sensor = bench.link.seen("tf_static")[-1].transforms[-1]
    assert (sensor.child_frame_id, sensor.transform.translation.x) == ("r0/front", 0.2)
    old = RangeReport(robot="r0", scans=(scan(stamp_s=7.0),), stamp_s=7.0)
    for _ in range(3):
        bench.swarm.bus.publish(KEYS.range_report("r0"), old)
    bench.run(0.2)
    assert len(bench.link.seen("r0/scan")) == 3


def test_a_robot_that_invents_sensors_or_floods_has_few_topics_and_messages(bench: RosBench) -> None:
    bench.run(0.2)
    for k in range(200):
        report(bench, scan(f"a{k}"), scan(f"b{k}"))
    assert len(scan_topics(bench)) == MOST_SENSORS
    count = len(bench.link.published)
    for _ in range(1000):
        now_s = bench.swarm.runtime.now_s()
        bench.swarm.bus.publish(KEYS.range_report("r0"), RangeReport(robot="r0", scans=(scan("a0"),), stamp_s=now_s))
    bench.run(1.0)
    assert len(bench.link.published) - count < 120
    report(bench, scan(), robot="nobody")
    assert not any("nobody" in name for name in bench.link.offered)


def test_a_robot_that_is_gone_has_no_scans_any_more(bench: RosBench) -> None:
    bench.run(0.2)
    report(bench, scan(), robot="r1")
    del bench.pose["r1"]
    bench.run(GONE_S + 3.0)
    assert scan_topics(bench) == set()


def test_the_bridge_asks_while_it_runs_and_not_with_a_rate_of_zero(bench: RosBench) -> None:
    asked: list[RangeQuery] = []
    bench.swarm.bus.subscribe(KEYS.range_query, RangeQuery, asked.append)
    bench.run(3.2)
    assert [(each.robots, each.rate_hz) for each in asked] == [((), 5.0)] * 3
    bench.bridge.close()
    bench.run(3.0)
    assert [each.robots for each in asked[3:]] == [("-",)]
    silent = Bridge(bench.swarm.bus, KEYS, bench.swarm.runtime, bench.operator, [MemoryLink()],
                    Options(scans_hz=0.0), lambda: 0)  # fmt: skip
    bench.run(3.0)
    silent.close()
    assert len(asked) == 4
