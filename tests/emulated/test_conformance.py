"""Every make against its emulator, by the published check that outside packages run as well."""

from __future__ import annotations

import itertools
import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

from fullswarm.config import WorldConfig
from fullswarm.drivers.base import Driver
from fullswarm.drivers.can.driver import CanBaseDriver
from fullswarm.drivers.can.emulator import EmulatedBase
from fullswarm.drivers.create_oi.driver import CreateDriver
from fullswarm.drivers.create_oi.emulator import CreateEmulator
from fullswarm.drivers.mavlink.body import BodyState, UnicycleBody
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.mavlink.emulator import RoverEmulator
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.drivers.sim.driver import SimDriver
from fullswarm.drivers.sim.emulator import WorldServer
from fullswarm.drivers.sim.world import World
from fullswarm.testing import check_driver

Rig = tuple[Callable[[], Driver], Callable[[], object] | None]
BASE = "interface=virtual&left=1&right=2&right_sign=-1&wheel_radius=0.05&base=0.3"

_channels = itertools.count()


@contextmanager
def null() -> Iterator[Rig]:
    yield lambda: NullDriver("null://r1"), None


@contextmanager
def sim() -> Iterator[Rig]:
    """A world that is faster than the URL promises, and slow to stop by itself; no axis is the robot's heading."""
    config = WorldConfig(
        engine="kinematic", address="127.0.0.1:0", bounds_m=(0.0, 0.0, 8.0, 8.0), speed_limit_m_s=1.0, watchdog_s=5.0
    )
    world = World(config, ("r1",), [(4.0, 4.0, 2.5)])
    server = WorldServer(world)
    try:
        yield lambda: SimDriver(f"sim://{server.address}/r1?speed_limit_m_s=0.4&watchdog_s=5"), server.tick
    finally:
        server.close()
        world.close()


@contextmanager
def create() -> Iterator[Rig]:
    with CreateEmulator() as robot:
        yield lambda: CreateDriver(robot.url), None


@contextmanager
def mavlink() -> Iterator[Rig]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with RoverEmulator(f"udp://127.0.0.1:{port}", UnicycleBody(BodyState(2.0, -1.0, 2.5))) as rover:
        # Slow, because a rover takes its time to brake, and it is braked a dozen times.
        yield lambda: MavlinkDriver(f"{rover.url}?speed=0.3&turn=0.8"), None


def can(scheme: str, options: str) -> Callable[[], AbstractContextManager[Rig]]:
    @contextmanager
    def rig() -> Iterator[Rig]:
        url = f"{scheme}://conformance-{next(_channels)}?{BASE}&{options}"
        with EmulatedBase(url):
            yield lambda: CanBaseDriver(url), None

    return rig


RIGS: dict[str, Callable[[], AbstractContextManager[Rig]]] = {
    "null": null,
    "sim": sim,
    "create": create,
    "mavlink": mavlink,
    "odrive": can("can+odrive", "watchdog=0.5"),
    "vesc": can("can+vesc", "gear=10&pole_pairs=7"),
}


@pytest.mark.parametrize("make", RIGS)
def test_keeps_the_contract(make: str) -> None:
    with RIGS[make]() as (driver, pump):
        check_driver(driver, pump=pump)
