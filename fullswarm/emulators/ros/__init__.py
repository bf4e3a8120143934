"""Emulated ROS bases, and the functions that the make's record names.

- ``emulator.py``: the base at the other end of a driver's URL, and what a person can do to it
- ``firmware.py``: the base as its topics show it: velocities in, odometry, battery, hazards and e-stop out
- ``definitions.py``: message types of ROS 2, by the rosbags library
- ``zenoh_port.py``: the robot's end of zenoh: rmw_zenoh, zenoh-bridge-ros2dds
- ``rosbridge.py``: the base behind a rosbridge_server
"""

from __future__ import annotations

from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from fullswarm.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    from fullswarm.drivers.make import Bench
    from fullswarm.emulators.ros.emulator import RosEmulator
    from fullswarm.simulation.bodies import Body


def start(url: str, body: Body) -> RosEmulator:
    """Switch on the base that a driver's URL names."""
    from fullswarm.emulators.ros.emulator import RosEmulator

    return RosEmulator(url, body).start()


def on_bench(bench: Bench, body: Body) -> RosEmulator:
    """Switch on a base for `fullswarm emulate`: that of a model, or any URL of the driver.

    Raises
    ------
    ConfigError
        Unknown model.
    """
    from fullswarm.drivers.ros import MAKE

    models = {each.name: each for each in (MAKE.emulation.models if MAKE.emulation else ())}
    name = bench.model or next(iter(models))
    if name not in models:
        raise ConfigError(f"no model '{name}'", where="--model", hint=did_you_mean(name, models))
    return start(bench.url or models[name].driver_url(""), body)


def clients(url: str) -> dict[str, str]:
    """Return how other clients open the base at a driver's URL."""
    parts = urlsplit(url)
    address = parts.path.strip("/").partition("/")[0]
    if parts.netloc == "ws":
        return {"roslibpy": f"Ros('ws://{address}')", "websocket": f"ws://{address}"}
    return {"zenoh": f"tcp/{address}"}
