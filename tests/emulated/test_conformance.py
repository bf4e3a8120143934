"""Every make against its emulator, by the published check that outside packages run as well, with hands that break."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from fullswarm.config import WorldConfig
from fullswarm.drivers.base import Pose, Twist
from fullswarm.drivers.can.driver import CanBaseDriver
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.drivers.sim.driver import SimDriver
from fullswarm.emulators.can.emulator import EmulatedBase
from fullswarm.emulators.mavlink.emulator import Px4Emulator, RoverEmulator
from fullswarm.simulation.bodies import FreeBody
from fullswarm.simulation.server import WorldServer
from fullswarm.simulation.world import World
from fullswarm.testing import Report, Rig, check_driver, emulated_rig, emulator_rig, serial_wire, udp_wire
from fullswarm.testing.trial import STARTS_AT
from tests.emulated.rover_link import IN_THE_WORLD

SIDE_BY_SIDE = 4
BASE = "interface=slcan&left=1&right=2&right_sign=-1&wheel_radius=0.05&base=0.3"


@contextmanager
def null() -> Iterator[Rig]:
    yield Rig(make=lambda: NullDriver("null://r1"), make_on=lambda clock: NullDriver("null://r1", clock))


@contextmanager
def sim() -> Iterator[Rig]:
    """A world that is faster than the URL promises, and slow to stop by itself."""
    config = WorldConfig(
        engine="kinematic", address="127.0.0.1:0", bounds_m=(0.0, 0.0, 8.0, 8.0), speed_limit_m_s=1.0, watchdog_s=1.0
    )
    world = World(config, ("r1",), [(4.0, 4.0, 2.5)])
    server = WorldServer(world)
    wire = udp_wire(server.address)
    url = f"sim://127.0.0.1:{wire.port}/r1?speed_limit_m_s=0.4&watchdog_s=1&sensing_m=6"
    try:
        yield Rig(
            make=lambda: SimDriver(url),
            make_on=lambda clock: SimDriver(url, clock),
            pump=server.tick,
            body_speed=lambda: Twist(*world.twist[0].tolist()),
            body_pose=lambda: Pose(*world.pose[0].tolist()),
            unplug=wire.unplug,
            replug=wire.replug,
            mute=wire.mute,
            garbage=wire.garbage,
            cut=wire.cut,
            obstacle=lambda: None,  # the walls are in sight
            other_process=True,
            fault_s=0.8,
        )
    finally:
        wire.close()
        server.close()
        world.close()


def mavlink(
    emulator: type[RoverEmulator] | type[Px4Emulator], options: str
) -> Callable[[], AbstractContextManager[Rig]]:
    @contextmanager
    def rig() -> Iterator[Rig]:
        body = FreeBody(STARTS_AT)
        with emulator("udpin://127.0.0.1:0", body) as rover, udp_wire(rover.url.rpartition("//")[2]) as wire:
            url = f"mavlink+udpout://127.0.0.1:{wire.port}?{options}"

            def pose() -> Pose:
                now = body.state()
                return Pose(now.x_m, now.y_m, now.heading_rad)

            rig = emulator_rig(rover, MavlinkDriver, url=url, wire=wire, fault_s=1.5)
            yield replace(rig, body_pose=pose, bump=None)

    return rig


def can(scheme: str, options: str) -> Callable[[], AbstractContextManager[Rig]]:
    """Over an adapter's serial line, which other processes reach and which can be cut in mid-frame."""

    @contextmanager
    def rig() -> Iterator[Rig]:
        with TemporaryDirectory(prefix="conformance-") as folder:
            port = Path(folder) / "adapter"
            with (
                EmulatedBase(f"{scheme}://{port}?{BASE}&{options}", FreeBody(STARTS_AT)) as base,
                serial_wire(str(port), 115200) as wire,
            ):
                url = f"{scheme}://{wire.port}?{BASE}&{options}"
                yield replace(emulator_rig(base, CanBaseDriver, url=url, wire=wire, fault_s=1.3), bump=None)

    return rig


ROS = ("turtlebot3", "turtlebot3_bridge", "turtlebot3_rosbridge", "turtlebot4")
"""rmw_zenoh, zenoh-bridge-ros2dds, rosbridge; a base that cannot reverse, has bumpers, takes stamped commands."""

RIGS: dict[str, Callable[[], AbstractContextManager[Rig]]] = {
    "null": null,
    "sim": sim,
    "create": partial(emulated_rig, "create2"),
    "odrive": can("can+odrive", "watchdog=0.5"),
    "vesc": can("can+vesc", "gear=10&pole_pairs=7"),
    # Slow, because a rover takes its time to brake, and it is braked a dozen times.
    "ardupilot": mavlink(RoverEmulator, f"speed=0.3&turn=0.8&{IN_THE_WORLD}"),
    "px4": mavlink(Px4Emulator, f"speed=0.3&turn=0.8&{IN_THE_WORLD}"),
    **{f"ros {word}": partial(emulated_rig, word) for word in ROS},
}

MOTORS = "motors off unless ACTIVE"
NO_DEVICE = {
    MOTORS, "odometry and true motion", "measured and true speed", "unplug", "close while unplugged",
    "unplug in mid-frame", "mute and stale data", "garbage", "frames cut short",
    "controller's process paused", "watchdog_s",
}  # fmt: skip
UNCHECKED: dict[str, set[str]] = {
    "null": NO_DEVICE,  # there is nothing at the other end
    # A simulated body has no motors to switch off; what bumps is a matter of the world: tests/unit/test_sim_world.py
    "sim": {"senses_bumps", MOTORS},
    # A ROS base obeys whoever publishes: no message switches its motors off.
    **{f"ros {word}": {MOTORS} for word in ROS},
}


def check(make: str) -> Report:
    with RIGS[make]() as rig:
        return check_driver(rig)


@pytest.fixture(scope="module")
def reports(request: pytest.FixtureRequest) -> Iterator[dict[str, Future[Report]]]:
    """Check the makes side by side, each in a process of its own: they mostly wait."""
    wanted = [make for make in RIGS if any(f"[{make}]" in item.nodeid for item in request.session.items)]
    with ProcessPoolExecutor(SIDE_BY_SIDE, multiprocessing.get_context("spawn")) as pool:
        # The slowest first.
        yield {make: pool.submit(check, make) for make in sorted(wanted, key=list(RIGS).index, reverse=True)}


@pytest.mark.parametrize("make", RIGS)
def test_keeps_the_contract(make: str, reports: dict[str, Future[Report]]) -> None:
    report = reports[make].result()
    sys.stdout.write(f"{report}\n")  # shown by `pytest -rP`
    assert set(report.skipped) == UNCHECKED.get(make, set())
