"""A square of 2 m, driven through the real port of each make in a PyBullet world without slip, compared with the truth.

Odometry closes the loop: what it gets wrong becomes an error of the place. On the wall clock: ten squares take minutes.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Driver, Lifecycle, Pose, Twist
from fullswarm.drivers.make import emulated_as
from fullswarm.geometry import wrap
from fullswarm.launch.network import emulated_url, port_folder
from fullswarm.launch.world import start_emulator
from fullswarm.registry import driver_class
from fullswarm.simulation.bodies import SteppedBodies, WorldBody
from fullswarm.simulation.world import World

SIDE_M, SPEED_M_S, TURN_RAD_S = 2.0, 0.4, 1.2
NEAR_M = 0.03
SHARE = 0.01  # of the path


@contextmanager
def rig(make: str, folder: Path) -> Iterator[tuple[Driver, WorldBody]]:
    """A driver on an emulated robot in a PyBullet world that a thread steps on the wall clock."""
    config = SwarmConfig.model_validate(
        {"swarm": "odometry", "world": {"bounds_m": [-9, -9, 9, 9], "rate_hz": 200.0, "substeps": 1},
         "robot": [{"id": "r1", "emulate": make, "pose": [0.5, -0.5, 0.7]}]}
    )  # fmt: skip
    url = emulated_url(config, config.robot[0])
    if ":///" in url:
        url = url.replace(str(port_folder(config)), str(folder))
    else:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            url = url.replace(str(emulated_as("rover")[1].first_port), str(probe.getsockname()[1]))
    world = World(config.world_or_default, ("r1",), [config.robot[0].pose])
    bodies = SteppedBodies(world, ("r1",))
    closing = threading.Event()

    def run() -> None:
        began_s, steps = time.monotonic(), 0
        while not closing.wait(0.003):
            while steps * world.dt_s < time.monotonic() - began_s:
                bodies.before_step()
                world.step()
                bodies.after_step()
                steps += 1

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    emulator = start_emulator(make, url, bodies.of["r1"])
    driver: Driver = driver_class(url)(url)
    try:
        driver.open()
        _until(lambda: driver.state is Lifecycle.READY, driver)
        driver.activate()
        _until(lambda: driver.state is Lifecycle.ACTIVE, driver)
        yield driver, bodies.of["r1"]
    finally:
        driver.close()
        emulator.close()
        closing.set()
        thread.join()
        world.close()


def _until(condition: Any, driver: Driver, timeout_s: float = 10.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, f"{driver.url}: {driver.state} {driver.fault}"
        time.sleep(0.01)


def _odometry(driver: Driver) -> Pose:
    reading = driver.read()
    assert reading is not None
    return reading.odometry


def _drive_to(driver: Driver, x_m: float, y_m: float, way: float) -> float:
    """Turn, then drive (`way` -1: backwards) to a place of the odometry's frame; return the path driven."""
    start = _odometry(driver)
    end_s = time.monotonic() + 30.0
    turning = True
    while True:
        assert time.monotonic() < end_s, f"{driver.url} never arrives: {driver.read()}"
        if driver.state is Lifecycle.READY:
            driver.activate()  # on a busy machine a link may be silent for once; encoders go on counting
        at = _odometry(driver)
        dx, dy = x_m - at.x_m, y_m - at.y_m
        if math.hypot(dx, dy) < NEAR_M:
            break
        off = wrap(math.atan2(way * dy, way * dx) - at.heading_rad)
        turning = abs(off) > (0.05 if turning else 0.6)
        rate = max(-TURN_RAD_S, min(TURN_RAD_S, 3.0 * off))
        ahead = 0.0 if turning else way * min(SPEED_M_S, max(0.05, math.hypot(dx, dy)))
        driver.command(Twist(ahead, rate))
        time.sleep(0.02)
    return math.hypot(x_m - start.x_m, y_m - start.y_m)


def _square(driver: Driver, laps: int, way: float) -> float:
    corners = [(SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M), (0.0, 0.0)]
    return sum(_drive_to(driver, x_m, y_m, way) for _ in range(laps) for x_m, y_m in corners)


def _error_m(driver: Driver, body: WorldBody, begin: tuple[float, float, float], origin: Pose) -> float:
    """Return how far the odometry's place is from the body's, in the frame in which the odometry began."""
    for _ in range(60):
        driver.command(Twist())
        time.sleep(0.02)
    state, told = body.state(), _odometry(driver)
    c, s = math.cos(begin[2]), math.sin(begin[2])
    dx, dy = state.x_m - begin[0], state.y_m - begin[1]
    x_m, y_m = c * dx + s * dy, c * dy - s * dx
    return math.hypot(told.x_m - origin.x_m - x_m, told.y_m - origin.y_m - y_m)


def _check(make: str, folder: Path, laps: int, way: float, record: Callable[[str, object], None]) -> None:
    with rig(make, folder) as (driver, body):
        state, origin = body.state(), _odometry(driver)
        begin = (state.x_m, state.y_m, state.heading_rad)
        path_m = _square(driver, laps, way)
        error_m = _error_m(driver, body, begin, origin)
    record("error, share of the path", error_m / path_m)
    assert error_m <= SHARE * path_m


@pytest.mark.parametrize("make", ["create2", "odrive", "rover"])
def test_one_side_forwards_and_back(make: str, tmp_path: Path) -> None:
    with rig(make, tmp_path) as (driver, body):
        state, origin = body.state(), _odometry(driver)
        begin = (state.x_m, state.y_m, state.heading_rad)
        path_m = _drive_to(driver, 1.0, 0.0, 1.0) + _drive_to(driver, 0.0, 0.0, -1.0)
        error_m = _error_m(driver, body, begin, origin)
        # A rover's odometry is its filter's position: both ends of the way are off by its stated noise, on both axes.
        filtered = driver.description.standstill.wander_m > 0.0
        noise_m = 4.0 * driver.description.pose_sigma_m if filtered else 0.0
    assert error_m <= SHARE * path_m + 0.005 + noise_m


@pytest.mark.slow
@pytest.mark.parametrize("way", [1.0, -1.0], ids=["forwards", "backwards"])
@pytest.mark.parametrize("make", ["create2", "odrive", "rover"])
def test_ten_squares(make: str, way: float, tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    _check(make, tmp_path, 10, way, record_property)
