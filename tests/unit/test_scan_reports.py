"""Scans of range sensors on the bus: how they are packed, who gets them when, and what a hostile query costs."""

from __future__ import annotations

import math
import struct

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.agent.state import AgentState
from fullswarm.agent.telemetry.scans import MOST_ASKERS, ScanReporter
from fullswarm.bus.codec import decode, encode
from fullswarm.bus.lanes import service_of
from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.drivers.base import FleetReading, Pose, RangeScan
from fullswarm.errors import MessageError
from fullswarm.identity.access import TOPICS
from fullswarm.identity.binding import check_of
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.maps.scans import BIN_RAD, FARTHEST_M, Bins, even, pack, sensor_at, thinned, unpack
from fullswarm.messages import MOST_RAYS, RangeQuery, RangeReport, SensorScan
from fullswarm.operator.scans import ScanFeed, scans_in
from fullswarm.runtime import Lane, Mailbox, Runtime

KEYS = Keys()
ANGLES = np.linspace(-math.pi, math.pi, 360, endpoint=False)


def packed(first_rad: float, step_rad: float, distances_m: Array) -> SensorScan:
    return SensorScan(
        sensor="s", mount=(0.1, 0.2, 0.3), robot_at=(1.0, 2.0, 0.5 * math.pi), first_rad=first_rad, step_rad=step_rad,
        distances=pack(distances_m), max_m=6.0, stamp_s=1.0,
    )  # fmt: skip


# ---------------------------------------------------------------- packing
def test_distances_are_two_bytes_of_millimetres_each() -> None:
    found = pack(np.array([0.0, 1.2344, 65.533, 65.6, math.inf, math.nan, -0.1]))
    assert struct.unpack("<7H", found) == (0, 1234, 65533, 65534, 65534, 65535, 0)


@given(st.lists(st.floats(0.0, FARTHEST_M) | st.just(math.inf) | st.just(math.nan), max_size=50))
def test_distances_come_back_to_a_millimetre(distances_m: list[float]) -> None:
    scan = packed(0.0, 0.1, np.array(distances_m))
    found = unpack(msgspec.structs.replace(scan, distances=scan.distances + b"x")).distances_m
    assert found.tolist() == pytest.approx(distances_m, abs=0.0005001, nan_ok=True)


def test_rays_of_equal_steps_stay_as_they_are_whichever_way_round_they_were_measured() -> None:
    distances_m = np.arange(360.0)
    assert even(ANGLES, distances_m).step_rad == pytest.approx(math.radians(1.0))
    clockwise = even(-ANGLES, distances_m)
    assert clockwise.first_rad == pytest.approx(-math.pi + math.radians(1.0))
    assert clockwise.distances_m.tolist() == distances_m[::-1].tolist()
    over_the_back = np.remainder(ANGLES + 0.5 * math.pi + math.pi, 2.0 * math.pi) - math.pi
    found = even(over_the_back, distances_m)
    assert len(found.distances_m) == 360
    assert found.first_rad == pytest.approx(-0.5 * math.pi)
    single = even(np.array([0.7]), np.array([2.0]))
    assert (single.first_rad, single.step_rad, single.distances_m.tolist()) == (0.7, 0.0, [2.0])
    assert len(even(np.zeros(0), np.zeros(0)).distances_m) == 0


@given(st.lists(st.tuples(st.floats(-3.0, 3.0), st.floats(0.1, 9.0)), min_size=1, max_size=60))
def test_each_ray_is_in_a_bin_near_its_angle_that_is_no_farther(rays: list[tuple[float, float]]) -> None:
    rays.sort()
    found = even(*np.array(rays).T)
    assert len(found.distances_m) <= MOST_RAYS
    bins_rad = found.first_rad + found.step_rad * np.arange(len(found.distances_m))
    for angle_rad, distance_m in rays:
        off_rad = np.abs(np.remainder(bins_rad - angle_rad + math.pi, 2.0 * math.pi) - math.pi)
        near = off_rad <= 0.5 * max(BIN_RAD, found.step_rad) + 1e-9
        assert np.nanmin(found.distances_m[near]) <= distance_m
    assert {each for each in found.distances_m.tolist() if not math.isnan(each)} <= {each for _, each in rays}


def test_a_scan_with_too_many_rays_keeps_the_nearest_of_neighbours() -> None:
    angles, distances_m = np.linspace(-3.0, 3.0, 5000), np.full(5000, 5.0)
    distances_m[2500] = 1.0
    found = even(angles, distances_m)
    assert len(found.distances_m) == MOST_RAYS
    assert np.flatnonzero(found.distances_m == 1.0).tolist() == [1024]
    few = thinned(Bins(-1.0, 0.01, np.array([3.0, math.nan, 1.0, math.inf, math.nan])), 3)
    assert few.distances_m.tolist() == pytest.approx([3.0, 1.0, math.nan], nan_ok=True)
    assert [few.first_rad, few.step_rad] == pytest.approx([-0.995, 0.02])


def test_a_sensor_is_where_its_robot_was() -> None:
    at = sensor_at(packed(0.0, 0.1, np.ones(3)))
    assert at == pytest.approx((0.8, 2.1, 0.5 * math.pi + 0.3))


@pytest.mark.parametrize(
    "changed", [{"distances": bytes(2 * MOST_RAYS + 2)}, {"step_rad": -1.0}, {"max_m": 0.0},
                {"robot_at": (math.nan, 0.0, 0.0)}, {"first_rad": math.inf}, {"sensor": "x" * 65}],
)  # fmt: skip
def test_a_scan_that_cannot_be_is_refused(changed: dict[str, object]) -> None:
    scan = msgspec.structs.replace(packed(0.0, 0.1, np.ones(3)), **changed)
    data = encode(RangeReport(robot="r1", scans=(scan,), stamp_s=0.0))
    with pytest.raises(MessageError):
        decode(data, RangeReport)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, 20.1, math.nan, math.inf])
def test_a_query_for_an_impossible_rate_is_refused(rate_hz: float) -> None:
    with pytest.raises(MessageError):
        decode(encode(RangeQuery(source="x", rate_hz=rate_hz)), RangeQuery)


def test_a_program_gets_points_in_the_world() -> None:
    scan = packed(0.0, 0.5 * math.pi, np.array([1.0, math.inf, 2.0, math.nan]))
    (found,) = scans_in(RangeReport(robot="r1", scans=(scan,), stamp_s=1.0))
    assert found.angles_rad.tolist() == pytest.approx([0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi])
    heading_rad = 0.5 * math.pi + 0.3
    ahead = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    assert found.points_m == pytest.approx(np.array([0.8, 2.1]) + np.array([[1.0], [-2.0]]) * ahead)
    lost = msgspec.structs.replace(scan, robot_at=None)
    (nowhere,) = scans_in(RangeReport(robot="r1", scans=(lost,), stamp_s=1.0))
    assert (nowhere.at, nowhere.points_m.shape) == (None, (0, 2))


# ---------------------------------------------------------------- on request
class Bench:
    """Two robots whose lidars turn ten times a second, on a simulated clock."""

    def __init__(self) -> None:
        mailbox = Mailbox()
        self.bus, self.runtime = LocalBus(mailbox), Runtime(SimClock(), mailbox)
        flags = np.zeros(2, bool)
        self.state = AgentState(
            radius=np.full(2, 0.17), pose=np.array([[1.0, 2.0, 0.0], [math.nan] * 3]), estop=flags,
            stop_reason=np.zeros(2, np.int64), battery_low=flags, at_standstill=flags, standstill_since_s=np.zeros(2),
        )  # fmt: skip
        self.state.twist = np.array([[0.5, 0.0], [0.0, 0.0]])
        self.reporter = ScanReporter(self.bus, KEYS, self.runtime, ("r1", "r2"), self.state)
        self.reports: list[RangeReport] = []
        self.bus.subscribe(KEYS.range_report(), RangeReport, self.reports.append)
        self.runtime.every(0.1, self.turn)

    def turn(self) -> None:
        now_s = self.runtime.now_s()
        scans = tuple(
            (row, RangeScan(now_s - 0.02, ANGLES, np.full(360, 2.0), 6.0, Pose(0.1, 0.0, 0.0), "front"))
            for row in (0, 1)
        )
        none = np.zeros(2)
        self.state.reading = FleetReading(
            none, self.state.pose, self.state.pose, self.state.twist, none.astype(np.uint8), none.astype(np.int64),
            none, np.zeros((0, 6)), none, ranges=scans,
        )  # fmt: skip

    def ask(self, source: str = "page", **fields: object) -> None:
        self.bus.publish(KEYS.range_query, RangeQuery(source=source, **fields))  # type: ignore[arg-type]

    def run(self, seconds: float) -> None:
        self.runtime.run(seconds)

    def count(self, robot: str, seconds: float) -> int:
        self.reports.clear()
        self.run(seconds)
        return sum(each.robot == robot for each in self.reports)


def test_without_a_query_nothing_is_published_and_no_timer_runs() -> None:
    bench = Bench()
    bench.run(2.0)
    assert (bench.reports, bench.reporter._timer) == ([], None)


def test_a_query_counts_for_three_seconds() -> None:
    bench = Bench()
    bench.run(0.5)
    bench.ask(robots=("r1",))
    assert 14 <= bench.count("r1", 3.5) <= 16
    assert {each.robot for each in bench.reports} == {"r1"}
    assert (bench.count("r1", 2.0), bench.reporter._timer) == (0, None)


@pytest.mark.parametrize(("rate_hz", "least", "most"), [(1.0, 2, 3), (5.0, 12, 13), (20.0, 24, 26)])
def test_scans_come_at_the_rate_asked_for_and_none_comes_twice(rate_hz: float, least: int, most: int) -> None:
    bench = Bench()
    bench.run(0.5)
    bench.ask(rate_hz=rate_hz)
    assert least <= bench.count("r2", 2.5) <= most
    mine = [each.scans[0].stamp_s for each in bench.reports if each.robot == "r2"]
    assert len(set(mine)) == len(mine)


def test_a_report_has_the_pose_of_the_robot_when_it_measured() -> None:
    bench = Bench()
    bench.run(0.5)
    bench.ask()
    bench.run(0.2)
    known, unknown = (next(each for each in bench.reports if each.robot == robot) for robot in ("r1", "r2"))
    (scan,) = known.scans
    age_s = known.stamp_s - scan.stamp_s
    assert scan.robot_at == pytest.approx((1.0 - 0.5 * age_s, 2.0, 0.0))
    assert (scan.sensor, scan.mount, scan.max_m, len(scan.distances)) == ("front", (0.1, 0.0, 0.0), 6.0, 720)
    assert unknown.scans[0].robot_at is None
    assert decode(encode(known), RangeReport) == known
    assert len(encode(known)) < 1000


def test_the_highest_rate_counts_and_askers_are_bounded() -> None:
    bench = Bench()
    bench.run(0.5)
    for k in range(10_000):
        bench.ask(f"hostile {k}", rate_hz=20.0)
    assert bench.count("r1", 2.0) <= 21
    assert len(bench.reporter._queries) <= MOST_ASKERS
    bench.ask("slow", rate_hz=1.0)
    assert bench.count("r1", 1.0) >= 9


def test_an_asker_that_names_other_robots_ends_its_query() -> None:
    bench = Bench()
    bench.run(0.5)
    bench.ask(robots=("r1",))
    assert bench.count("r1", 1.0) > 0
    bench.ask(robots=("r9",))
    bench.run(0.1)
    assert bench.count("r1", 1.0) == 0
    bench.reporter.close()
    bench.ask()
    assert bench.count("r1", 1.0) == 0


def test_a_program_gets_the_newest_scans_of_its_robots_while_it_asks() -> None:
    bench = Bench()
    feed = ScanFeed(bench.bus, KEYS, bench.runtime, "program", ("r1",), 10.0)
    bench.run(5.0)  # longer than one query counts
    found = feed.take()
    assert found is not None
    assert [(each.robot, each.sensor) for each in found] == [("r1", "front")]
    assert bench.runtime.now_s() - found[0].stamp_s < 0.25
    assert feed.take() is None
    bench.ask("another")  # for all
    bench.run(0.5)
    assert {each.robot for each in bench.reports} == {"r1", "r2"}
    assert {each.robot for each in feed.take() or ()} == {"r1"}
    feed.close()
    feed.close()
    bench.ask("another", robots=("r9",))
    bench.run(0.1)
    assert bench.count("r1", 2.0) == 0


# ---------------------------------------------------------------- who may
@pytest.mark.parametrize(
    ("rest", "sender", "message", "allowed"),
    [
        ("range/query", "anna", RangeQuery(source="x"), True),
        ("range/query", "console", RangeQuery(source="x"), True),
        ("range/query", "core", RangeQuery(source="x"), False),
        ("range/report/r1", "r1", RangeReport(robot="r1", scans=(), stamp_s=0.0), True),
        ("range/report/r1", "r1", RangeReport(robot="r2", scans=(), stamp_s=0.0), False),
        ("range/report/r2", "r1", RangeReport(robot="r2", scans=(), stamp_s=0.0), False),
    ],
)
def test_only_people_ask_and_a_robot_reports_itself_alone(
    rest: str, sender: str, message: RangeQuery | RangeReport, allowed: bool
) -> None:
    check = check_of(rest, sender, secured=True)
    assert (check is None or check(message) == "") is allowed


def test_the_access_list_lets_neither_robots_nor_observers_ask() -> None:
    rights = {topic.key: set(topic.publish) for topic in TOPICS}
    assert rights["range/query"] == {"operator", "console"}
    assert rights["range/report/<robot>"] == {"robot"}


def test_scans_are_served_last() -> None:
    assert service_of("s/range/report/r1").lane is service_of("s/range/query").lane is Lane.READS
