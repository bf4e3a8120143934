"""SimDriver and WorldServer over real UDP on loopback."""

from __future__ import annotations

import itertools
import math
import socket
import time
from collections.abc import Callable, Iterator

import pytest

from fullswarm.bus import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import RangesConfig, SwarmConfig, WorldConfig
from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Twist
from fullswarm.drivers.sim.driver import SimDriver
from fullswarm.drivers.sim.session import Session
from fullswarm.errors import ConfigError, DriverError
from fullswarm.keys import Keys
from fullswarm.launch.world import WorldNode
from fullswarm.messages import PoseFix
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.simulation.server import WorldServer
from fullswarm.simulation.world import World
from fullswarm.testing.faults import JumpClock

CONFIG = WorldConfig(engine="kinematic", address="127.0.0.1:0", bounds_m=(0.0, 0.0, 8.0, 8.0), speed_limit_m_s=0.4)


class Bench:
    """A world on a port, ticked from the test's own loop, and drivers that are closed at the end."""

    def __init__(self) -> None:
        self.world = World(CONFIG, ("r1", "r2"), [(1.0, 1.0, 0.0), (4.0, 4.0, 0.0)])
        self.server: WorldServer | None = WorldServer(self.world)
        self.address = self.server.address
        self.drivers: list[SimDriver] = []

    def driver(self, robot: str) -> SimDriver:
        driver = SimDriver(f"sim://{self.address}/{robot}")
        self.drivers.append(driver)
        driver.open()
        return driver

    def stop_world(self) -> None:
        assert self.server is not None
        self.server.close()
        self.world.close()
        self.server = None

    def start_world(self) -> None:
        self.world = World(CONFIG, ("r1", "r2"), [(1.0, 1.0, 0.0), (4.0, 4.0, 0.0)])
        self.server = WorldServer(self.world, self.address)

    def until(self, condition: Callable[[], bool], each: Callable[[], object] = lambda: None) -> float:
        """Run the world at 50 Hz until `condition`; return the seconds that it took."""
        begin = time.monotonic()
        due = begin
        while not condition():
            assert time.monotonic() - begin < 4.0, "condition not met"
            each()
            if self.server is not None:
                self.server.tick()
            due += 0.02
            time.sleep(max(0.0, due - time.monotonic()))
        return time.monotonic() - begin

    def close(self) -> None:
        for driver in self.drivers:
            driver.close()
            driver.close()
        if self.server is not None:
            self.server.close()
            self.server.close()
        self.world.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.close()


def time_of(driver: SimDriver) -> float:
    """Return the world's time in the newest reading, which stays unread."""
    assert isinstance(driver._session, Session)
    return driver._session._time_s


def x_of(driver: SimDriver) -> float:
    reading = driver.read()
    return -math.inf if reading is None or reading.pose is None else reading.pose.x_m


def test_a_driver_drives_its_body(bench: Bench) -> None:
    driver = bench.driver("r1")
    assert driver.state.value == "OPEN"
    assert driver.read() is None
    bench.until(lambda: driver.state is Lifecycle.READY)
    assert driver.command(Twist(0.3, 0.0)) == STAND
    driver.activate()
    bench.until(lambda: x_of(driver) > 1.1, lambda: driver.command(Twist(0.3, 0.0)))
    assert driver.command(Twist(9.0, 9.0)) == Twist(0.4, 4.25)  # the world's limits, not the URL's 0.5
    reading = driver.read()
    assert reading is not None
    assert reading.twist.linear_m_s == pytest.approx(0.3)
    assert reading.odometry.x_m == pytest.approx(x_of(driver) - 1.0, abs=1e-6)
    assert reading.obstacles.shape == (2, 6)  # west and south wall
    assert driver.firmware.startswith("kinematic ")
    with pytest.raises(ValueError, match="finite"):
        driver.command(Twist(math.nan, 0.0))
    bench.until(lambda: not bench.world.twist.any())
    assert driver.state.value == "ACTIVE"
    driver.close()
    assert driver.state.name == "CLOSED"
    assert bench.server is not None
    bench.until(lambda: bench.server is not None and bench.server.connected == ())


def test_a_contact_that_is_over_before_the_driver_is_read_is_read_once(bench: Bench) -> None:
    driver = bench.driver("r1")
    bench.until(lambda: x_of(driver) > 0.0)
    contacts = iter((2, 1, 0))

    def touch() -> None:
        bench.world.contacts[0] = next(contacts, 0)
        bench.world.hazards[0] = int(bench.world.contacts[0] == 2)

    bench.world.watchers.append(touch)
    sent_s = bench.world.time_s
    bench.until(lambda: time_of(driver) >= sent_s + 0.1)
    reading = driver.read()
    assert reading is not None
    assert (reading.contacts, reading.hazards) == (2, Hazard.BUMP)
    read_s = bench.world.time_s
    bench.until(lambda: time_of(driver) > read_s)
    reading = driver.read()
    assert reading is not None
    assert (reading.contacts, reading.hazards) == (0, Hazard.NONE)


def test_a_fix_tells_of_contacts_since_the_one_before() -> None:
    runtime = Runtime(SimClock(), Mailbox())
    bus, keys = LocalBus(runtime.mailbox), Keys("swarm")
    config = SwarmConfig.model_validate(
        {
            "world": {"engine": "kinematic", "address": "127.0.0.1:0"},
            "robot": [{"id": "r1", "pose": (2.0, 2.0, 0.0), "emulate": "create2"}],
        }
    )
    fixes: list[PoseFix] = []
    bus.subscribe(keys.pose_fix("r1"), PoseFix, fixes.append)
    node = WorldNode(bus, runtime, config, "world-here")
    try:
        runtime.run(0.2)
        steps = itertools.count()

        def touch() -> None:
            node.world.contacts[0] = int(next(steps) == 3)  # 5 ms of the 50 ms between two fixes

        node.world.watchers.append(touch)
        runtime.run(0.2)
    finally:
        node.close()
    assert [each.contacts for each in fixes if each.contacts] == [1]
    assert len(fixes) >= 7


def test_lamps_are_kept_in_the_world_also_by_one_that_is_started_again(bench: Bench) -> None:
    driver = bench.driver("r2")
    bench.until(lambda: driver.state is Lifecycle.READY)
    driver.actuate("lamp", "green")
    assert bench.until(lambda: bench.world.actuators[1]["lamp"] == "green") < 0.15  # sooner than the next greeting
    assert bench.world.actuators[0]["lamp"] == "off"
    with pytest.raises(ValueError, match="'lamp' takes off"):
        driver.actuate("lamp", "pink")
    bench.stop_world()
    bench.start_world()
    bench.until(lambda: bench.world.actuators[1]["lamp"] == "green")
    driver.close()
    with pytest.raises(DriverError, match="while CLOSED"):
        driver.actuate("lamp", "red")


def test_a_silent_driver_means_a_standing_body(bench: Bench) -> None:
    driver = bench.driver("r1")
    bench.until(lambda: driver.state is Lifecycle.READY)
    driver.activate()
    bench.until(lambda: bench.world.twist[0, 0] > 0.29, lambda: driver.command(Twist(0.3, 0.0)))
    begin_s = bench.world.time_s
    bench.until(lambda: bench.world.twist[0, 0] == 0.0)
    assert bench.world.time_s - begin_s < 0.3 + 0.15 + 0.06  # watchdog, ramp, a few periods
    assert driver.state is Lifecycle.ACTIVE  # readings still come


def test_a_restarted_world_is_found_again_but_nothing_moves(bench: Bench) -> None:
    driver = bench.driver("r1")
    bench.until(lambda: driver.state is Lifecycle.READY)
    driver.activate()
    bench.until(lambda: x_of(driver) > 1.05, lambda: driver.command(Twist(0.3, 0.0)))
    bench.stop_world()
    took_s = bench.until(lambda: driver.state is Lifecycle.FAULT, lambda: driver.command(Twist(0.3, 0.0)))
    assert 0.3 < took_s < 3.0
    assert "no reading for 0.5 s" in driver.fault
    assert bench.address in driver.fault
    bench.start_world()
    bench.until(lambda: driver.state is not Lifecycle.FAULT, lambda: driver.command(Twist(0.3, 0.0)))
    assert driver.state is Lifecycle.READY
    assert driver.fault == ""
    assert driver.command(Twist(0.3, 0.0)) == STAND
    reading = driver.read()
    assert reading is not None
    assert reading.odometry.x_m == 0.0
    assert bench.world.pose[0, 0] == 1.0


def test_the_second_driver_of_a_robot_is_refused_until_the_first_leaves(bench: Bench) -> None:
    first = bench.driver("r1")
    bench.until(lambda: first.state is Lifecycle.READY)
    second = bench.driver("r1")
    bench.until(lambda: second.state is Lifecycle.FAULT)
    assert "'r1' already has a driver" in second.fault
    assert first.state is Lifecycle.READY
    first.close()
    bench.until(lambda: second.state is Lifecycle.READY)


def test_a_driver_without_a_world_or_robot_says_so(bench: Bench) -> None:
    unknown = bench.driver("r9")
    bench.until(lambda: unknown.state is Lifecycle.FAULT)
    assert "no robot 'r9'" in unknown.fault
    assert "known: r1, r2" in unknown.fault
    bench.stop_world()
    alone = bench.driver("r2")
    bench.until(lambda: alone.state is Lifecycle.FAULT)
    assert "is the world running" in alone.fault
    bench.start_world()
    bench.until(lambda: alone.state is Lifecycle.READY)


def test_noise_and_strangers_do_no_harm(bench: Bench) -> None:
    assert bench.server is not None
    host, port = bench.address.split(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"\xff" * 50, (host, int(port)))
        server = bench.server
        bench.until(lambda: server.dropped > 0)
    driver = bench.driver("r1")
    bench.until(lambda: driver.state is Lifecycle.READY)


def test_the_world_listens_on_loopback_only() -> None:
    world = World(CONFIG, ("r1",))
    for address, words in (("0.0.0.0:0", "network"), ("127.0.0.1", "not an address")):
        with pytest.raises(ConfigError, match=words):
            WorldServer(world, address)
    WorldServer(world, "0.0.0.0:0", insecure_network=True).close()
    server = WorldServer(world)
    with pytest.raises(ConfigError, match="another world"):
        WorldServer(world, server.address)
    server.close()
    world.close()


def test_a_pause_of_the_drivers_own_process_is_no_silence_of_the_world(bench: Bench) -> None:
    """SIGSTOP, a suspended computer: the body stands, but what the robot was asked for is not over."""
    clock = JumpClock()
    driver = SimDriver(f"sim://{bench.address}/r1", clock)
    bench.drivers.append(driver)
    driver.open()
    bench.until(lambda: driver.state is Lifecycle.READY)
    driver.activate()
    bench.until(lambda: bench.world.twist[0, 0] > 0.29, lambda: driver.command(Twist(0.3, 0.0)))
    clock.jump(3.0)
    states = {driver.state}
    bench.until(lambda: not bench.world.twist.any(), lambda: states.add(driver.state))
    assert states == {Lifecycle.ACTIVE}
    bench.stop_world()
    took_s = bench.until(lambda: driver.state is Lifecycle.FAULT)
    assert took_s < 3.0, "and a silence that comes then is one"


def test_a_range_sensor_with_wide_beams_says_so(bench: Bench) -> None:
    bench.stop_world()
    ranges = RangesConfig(count=3, fov_rad=1.0, cone_rad=0.4, max_m=1.3, sigma_m=0.0, dropout=0.0)
    bench.world = World(CONFIG.model_copy(update={"ranges": ranges}), ("r1",), [(1.0, 1.0, math.pi)])
    bench.server = WorldServer(bench.world, bench.address)
    driver = bench.driver("r1")
    bench.until(lambda: (reading := driver.read()) is not None and bool(reading.ranges))
    reading = driver.read()
    assert reading is not None
    (scan,) = reading.ranges
    assert scan.cone_rad == 0.4
    assert scan.distances_m == pytest.approx([1.0 / math.cos(0.3), 1.0, 1.0 / math.cos(0.3)], abs=1e-3)
