"""Rovers with maps of their own, in the swarm's frame: sessions with emulated autopilots, in simulated time."""

from __future__ import annotations

import math

import pytest

from fullswarm.clock import SimClock
from fullswarm.drivers.base import Lifecycle, Pose
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import StreamParser, dialect
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.mavlink.maps import SphereMap
from fullswarm.drivers.mavlink.session import Session
from fullswarm.drivers.mavlink.settings import Options
from fullswarm.emulators.mavlink.firmware import Firmware
from fullswarm.emulators.mavlink.position import Chart
from fullswarm.emulators.mavlink.px4_firmware import Px4Firmware
from fullswarm.simulation.bodies import FreeBody
from tests.unit.mavlink_bench import LIMITS, STEP_S

BERLIN = (52.5163, 13.3777)
RESOLUTION_M = 0.01
"""An origin is told to 1e-7 degrees: 1.1 cm from one to the next."""


class Bench:
    """A session with a rover that stands somewhere in the swarm's frame and began its map there."""

    def __init__(self, pose: Pose, *, px4: bool = False, origin: p.Origin | None = None, boot_s: float = 0.2) -> None:
        self.clock = SimClock(100.0)
        self.body = FreeBody(pose, self.clock)
        self.rover: Firmware | Px4Firmware
        if px4:
            self.rover = Px4Firmware(self.body, chart=Chart(BERLIN, SphereMap()))
        else:
            self.rover = Firmware(self.body, boot_s=boot_s, chart=Chart(BERLIN))
        self.rover.power_on(100.0)
        self.rover.noise.scale = 0.0  # the frames are compared to the millimetre
        self.session = Session(Options(1, LIMITS, "bench", origin=origin), 100.0)
        self._down, self._up = StreamParser(), StreamParser()
        self.deaf_to: set[int] = set()
        self.heard: list[str] = []

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.clock.advance_to(self.clock.now_s() + STEP_S)
            now_s = self.clock.now_s()
            for frame in self.rover.tick(now_s):
                for message in self._down.feed(frame):
                    if message.get_msgId() not in self.deaf_to:
                        self.heard.append(message.get_type())
                        self.session.receive(message, now_s)
            for frame in self.session.tick(now_s):
                for message in self._up.feed(frame):
                    self.rover.receive(message, now_s)

    def ready(self) -> bool:
        return self.session.state is Lifecycle.READY

    @property
    def pose(self) -> tuple[float, float, float] | None:
        reading = self.session.read()
        told = None if reading is None else reading.pose
        return None if told is None else (told.x_m, told.y_m, told.heading_rad)


def at_swarm() -> p.Origin:
    return p.Origin(*BERLIN, 0.0)


@pytest.mark.parametrize("px4", [False, True])
@pytest.mark.parametrize("place", [Pose(0.0, 0.0, 0.3), Pose(10.0, -4.0, -2.0), Pose(-300.0, 250.0, 1.0)])
def test_each_rover_is_where_it_is_in_the_swarms_frame(place: Pose, *, px4: bool) -> None:
    bench = Bench(place, px4=px4, origin=at_swarm())
    bench.run(4.0)
    assert bench.ready()
    assert bench.pose == pytest.approx((place.x_m, place.y_m, place.heading_rad), abs=RESOLUTION_M)


@pytest.mark.parametrize("px4", [False, True])
def test_without_an_origin_each_counts_from_where_it_was_switched_on(*, px4: bool) -> None:
    bench = Bench(Pose(10.0, -4.0, 0.5), px4=px4)
    bench.run(4.0)
    assert bench.ready()
    assert bench.pose == pytest.approx((0.0, 0.0, 0.5), abs=RESOLUTION_M)


def test_metres_driven_are_those_on_the_ground_and_finer_than_the_origin_is_told() -> None:
    bench = Bench(Pose(0.0, 0.0, math.pi / 2.0), origin=at_swarm())
    bench.run(4.0)
    before = bench.pose
    bench.body.drive(1.0, 0.0)
    bench.clock.advance_to(bench.clock.now_s() + 50.0)
    bench.body.drive(0.0, 0.0)
    bench.run(1.0)
    state = bench.body.state()
    assert state.y_m > 45.0
    assert before is not None
    assert bench.pose is not None
    # ArduPilot's own metres would be 6 cm off here; a float of 50 m resolves 4 µm.
    assert bench.pose[1] - before[1] == pytest.approx(state.y_m, abs=1e-3)


def test_until_the_origin_is_told_there_is_no_pose_and_it_is_not_ready() -> None:
    bench = Bench(Pose(3.0, 4.0, 0.0), origin=at_swarm())
    bench.deaf_to.add(p.MESSAGE_ORIGIN)
    bench.run(6.0)
    assert not bench.ready()
    assert "origin" in bench.session.why
    assert bench.pose is None
    bench.deaf_to.clear()
    bench.run(2.0)
    assert bench.ready()
    assert bench.pose == pytest.approx((3.0, 4.0, 0.0), abs=RESOLUTION_M)


@pytest.mark.parametrize("px4", [False, True])
def test_a_reboot_elsewhere_gives_another_origin(*, px4: bool) -> None:
    bench = Bench(Pose(0.0, 0.0, 0.0), px4=px4, origin=at_swarm())
    bench.run(4.0)
    bench.body.drive(1.0, 0.0)
    bench.clock.advance_to(bench.clock.now_s() + 7.0)
    bench.body.drive(0.0, 0.0)
    bench.run(0.5)
    x_m = bench.body.state().x_m
    assert x_m > 5.0
    bench.rover.power_on(bench.clock.now_s())
    seen = []
    for _ in range(500):
        bench.run(STEP_S)
        if bench.pose is not None:
            seen.append(bench.pose[0])
    assert bench.ready()
    assert bench.pose == pytest.approx((x_m, 0.0, 0.0), abs=RESOLUTION_M)
    assert min(seen) > x_m - 0.1  # not for a moment is it back at the swarm's origin


def test_a_leap_of_the_map_is_not_believed_until_the_origin_is_told_anew() -> None:
    bench = Bench(Pose(8.0, 0.0, 0.0), origin=at_swarm())
    bench.run(4.0)
    bench.rover.chart.begin(0.0, 0.0)  # the filter began anew, without a word
    told = []
    for _ in range(200):
        bench.run(STEP_S)
        if bench.pose is not None:
            told.append(bench.pose[0])
    assert told
    assert max(abs(x_m - 8.0) for x_m in told) < 2.0 * RESOLUTION_M
    assert bench.session.read() is not None


def test_a_swarm_on_another_continent_is_refused_with_both_places() -> None:
    bench = Bench(Pose(0.0, 0.0, 0.0), origin=p.Origin(-35.36, 149.17, 0.0))
    bench.run(5.0)
    assert not bench.ready()
    assert "52.5163" in bench.session.why
    assert "[world] origin" in bench.session.why


def test_the_emulated_rover_says_its_origin_as_the_real_one_does() -> None:
    bench = Bench(Pose(10.0, 0.0, 0.0), boot_s=42.4)
    bench.run(19.0)
    assert "GPS_GLOBAL_ORIGIN" not in bench.heard
    bench.run(2.0)
    assert bench.heard.count("GPS_GLOBAL_ORIGIN") == 1  # unasked, when its filter sets it
    assert isinstance(bench.rover, Firmware)
    streams = bench.rover.channels[0].streams
    assert streams is not None
    message = streams.make(33, bench.clock.now_s())[0]
    latitude, longitude = bench.rover.chart.origin or (0.0, 0.0)
    assert (message.lat / 1e7, message.lon / 1e7) == pytest.approx((latitude, longitude), abs=2e-7)
    assert bench.rover.chart.place(latitude, longitude) == pytest.approx((10.0, 0.0), abs=RESOLUTION_M)


def test_a_target_on_the_rovers_own_map_is_a_place_in_the_world() -> None:
    chart = Chart(BERLIN)
    chart.begin(10.0, -4.0)
    assert chart.world_place(*chart.local(12.0, 3.0)) == pytest.approx((12.0, 3.0), abs=1e-6)
    assert chart.local(10.0, -4.0) == pytest.approx((0.0, 0.0), abs=RESOLUTION_M)


@pytest.mark.parametrize(("query", "own_frame"), [("", True), ("?origin=52.5,13.4", False), ("?pose=external", False)])
def test_the_description_says_whether_the_poses_are_the_swarms(query: str, *, own_frame: bool) -> None:
    assert dialect()
    assert MavlinkDriver(f"mavlink+udp://127.0.0.1:14550{query}").description.own_frame is own_frame
