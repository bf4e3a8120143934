"""A ROS base on each transport: each way in which it must come to a standstill, and what differs between ROS releases.

The base here is the worst one, a TurtleBot 3 as delivered: it keeps its last velocity for ever. What stops it is thus
the driver, its relay process, or its guardian.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import Hazard, Lifecycle, Twist
from fullswarm.drivers.guardian import ProcessPort, guarded
from fullswarm.drivers.probe.ask import ask_url
from fullswarm.drivers.ros.driver import RosDriver
from fullswarm.emulators.ros.emulator import RosEmulator
from fullswarm.errors import DriverError
from fullswarm.testing.trial import _free_port
from tests.waiting import until

CLOCK = MonotonicClock()
HOLDS = "model=turtlebot3"
TRANSPORTS = {"zenoh": "ros://tcp/127.0.0.1:{}/t1?", "bridge": "ros://tcp/127.0.0.1:{}/t1?rmw=bridge&",
              "rosbridge": "ros://ws/127.0.0.1:{}/t1?"}  # fmt: skip
BRAKES_S = 0.5
"""0.11 m/s at 1 m/s² takes 0.11 s; the rest is a busy machine's."""


def free_url(transport: str, options: str) -> str:
    return TRANSPORTS[transport].format(_free_port("tcp")) + options


@contextmanager
def driving(url: str, *, hashes: bool = True) -> Iterator[tuple[RosEmulator, RosDriver]]:
    """Yield a base and its driver, driving."""
    with ExitStack() as stack:
        robot = stack.enter_context(RosEmulator(url, hashes=hashes))
        driver = guarded(RosDriver(url))
        stack.callback(driver.close)
        driver.open()
        until(lambda: driver.state is Lifecycle.READY)
        driver.activate()
        until(lambda: moving(robot), each=lambda: driver.command(Twist(0.11, 0.0)))
        yield robot, driver


def moving(robot: RosEmulator) -> bool:
    return robot.body.state().speed_m_s > 0.1


def rests_within(robot: RosEmulator, limit_s: float) -> None:
    began_s = CLOCK.now_s()
    until(lambda: robot.body.state().speed_m_s == 0.0, limit_s + 5.0)
    assert CLOCK.now_s() - began_s < limit_s


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_no_command_for_too_long_stops_it(transport: str) -> None:
    with driving(free_url(transport, HOLDS)) as (robot, driver):
        rests_within(robot, 0.3 + BRAKES_S)
        assert driver.state is Lifecycle.ACTIVE


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_silent_odometry_stops_it_and_stuck_odometry_too(transport: str) -> None:
    with driving(free_url(transport, HOLDS)) as (robot, driver):
        robot.stick_sensors(True)
        until(lambda: driver.state is Lifecycle.FAULT, each=lambda: driver.command(Twist(0.11, 0.0)))
        assert "no new odometry" in driver.fault
        rests_within(robot, BRAKES_S)
        robot.stick_sensors(False)
        until(lambda: driver.state is Lifecycle.READY)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_cut_link_stops_a_base_that_watches_its_commands(transport: str) -> None:
    with driving(free_url(transport, f"{HOLDS}&watchdog=0.5")) as (robot, driver):
        robot.unplug()
        rests_within(robot, 0.5 + BRAKES_S)
        until(lambda: driver.state is Lifecycle.FAULT)
        robot.replug()
        until(lambda: driver.state is Lifecycle.READY)


DRIVES = """
import sys, time
from fullswarm import registry
from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.guardian import guarded
driver = guarded(registry.driver_class(sys.argv[1])(sys.argv[1]))
driver.open()
while True:
    if driver.state is Lifecycle.READY:
        driver.activate()
    driver.command(Twist(0.11, 0.0))
    time.sleep(0.05)
"""


@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_killed_or_frozen_driver_stops_a_base_that_keeps_its_velocity(transport: str, number: signal.Signals) -> None:
    url = free_url(transport, HOLDS)
    with (
        RosEmulator(url) as robot,
        subprocess.Popen([sys.executable, "-c", DRIVES, url], stdin=subprocess.DEVNULL) as driver,
    ):
        try:
            until(lambda: moving(robot), 20.0)
            os.kill(driver.pid, number)
            # When frozen, the guardian waits for 0.3 s.
            rests_within(robot, BRAKES_S + (0.3 if number == signal.SIGSTOP else 0.0))
        finally:
            driver.kill()


@pytest.mark.parametrize("transport", ["zenoh", "bridge"])
def test_a_killed_relay_is_a_fault_and_the_next_one_stops_the_base(transport: str) -> None:
    with driving(free_url(transport, HOLDS)) as (robot, driver):
        port = driver._port
        assert isinstance(port, ProcessPort)
        os.kill(port.pid, signal.SIGKILL)
        until(lambda: driver.state is Lifecycle.FAULT, each=lambda: driver.command(Twist(0.11, 0.0)))
        until(lambda: driver.state is Lifecycle.READY)
        rests_within(robot, BRAKES_S)


# ---------------------------------------------------------------- what differs between releases and robots
def test_a_robot_without_type_hashes_is_driven_as_well() -> None:
    with driving(free_url("zenoh", HOLDS), hashes=False) as (robot, _):
        assert robot.base.commands > 0


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_stamped_commands_are_taken_by_a_base_that_drops_late_ones(transport: str) -> None:
    with driving(free_url(transport, "model=rosbot&stamped=1")) as (robot, _):
        assert robot.base.options.checks_age


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_hazards_battery_and_estop_arrive(transport: str) -> None:
    with driving(free_url(transport, "model=create3&estop=e_stop")) as (robot, driver):
        robot.set_battery(0.5)
        robot.set_cliff(front_left=True)

        def arrived() -> bool:
            driver.command(Twist(0.1, 0.0))
            reading = driver.read()
            return reading is not None and Hazard.CLIFF in reading.hazards and reading.battery == pytest.approx(0.5)

        until(arrived)
        robot.press_estop(True)
        until(lambda: driver.state is Lifecycle.FAULT)
        assert "emergency stop" in driver.fault


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_scans_arrive_and_their_place_on_the_robot_is_that_of_the_model(transport: str) -> None:
    with driving(free_url(transport, "model=turtlebot3&watchdog=0.5&scan=scan")) as (robot, driver):
        robot.set_distances([1.25] * 90 + [math.inf] * 270)

        def arrived() -> bool:
            driver.command(Twist(0.1, 0.0))
            reading = driver.read()
            return reading is not None and bool(reading.ranges) and reading.ranges[0].distances_m[45] == 1.25

        until(arrived)
        (scan,) = driver.read().ranges  # type: ignore[union-attr]
        assert driver.description.ranges_max_m == scan.max_m == 3.5
        assert scan.mount.x_m == -0.032
        assert 0.0 <= CLOCK.now_s() - scan.stamp_s < 1.0
        assert not (scan.distances_m[90:] < math.inf).any()


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_restart_of_the_base_moves_no_odometry(transport: str) -> None:
    with driving(free_url(transport, f"{HOLDS}&watchdog=0.5")) as (robot, driver):
        before = driver.read()
        robot.reboot()
        until(lambda: driver.state is Lifecycle.FAULT)
        until(lambda: driver.state is Lifecycle.READY)
        after = driver.read()
        assert before is not None
        assert after is not None
        assert after.odometry_breaks == before.odometry_breaks + 1
        assert abs(after.odometry.x_m - before.odometry.x_m) < 0.2


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_the_probe_finds_it_and_sends_no_command(transport: str) -> None:
    url = free_url(transport, HOLDS)
    with RosEmulator(url) as robot:
        asked = ask_url(url)
        assert asked.problem == ""
        assert (asked.robots[0].make, asked.robots[0].url) == ("ROBOTIS", url)
        assert robot.base.commands == 0
    assert "no program listens" in ask_url(url).problem
    with pytest.raises(DriverError, match="no program listens"):
        RosDriver(url).open()


def test_a_wrong_namespace_is_named() -> None:
    url = free_url("zenoh", HOLDS)
    with RosEmulator(url):
        driver = RosDriver(url.replace("/t1", "/t2"))
        try:
            driver.open()
            until(lambda: "namespace" in driver.fault)
            assert driver.state is not Lifecycle.READY
        finally:
            driver.close()
