"""Ports of this machine for a swarm that must not disturb another one."""

from __future__ import annotations

import socket
from urllib.parse import urlsplit

from fullswarm.bus.endpoint import host_of
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.errors import Unreachable

LOOPBACK = "127.0.0.1"
ANY = 0
"""The system chooses a free one."""


def on_free_ports(config: SwarmConfig, *, wished: bool = True) -> SwarmConfig:
    """Give hub, world and emulated robots free ports of this machine.

    Parameters
    ----------
    wished
        The settings' own port where it is free. Not for swarms that start side by side: they would all find the usual
        port free and then take it.

    Raises
    ------
    ConfigError
        The hub's or the world's address is wrong.
    Unreachable
        This machine has no free port.
    """
    from fullswarm.drivers.sim.protocol import parse_address

    world = config.world_or_default
    host_of(config.hub.endpoint)  # says what is wrong with it
    hub_port = _free(socket.SOCK_STREAM, int(config.hub.endpoint.rpartition(":")[2]), wished)
    world_port = _free(socket.SOCK_DGRAM, parse_address(world.address, where="world.address")[1], wished)
    free = config.model_copy(
        update={
            "hub": config.hub.model_copy(update={"endpoint": f"tcp/{LOOPBACK}:{hub_port}"}),
            "world": world.model_copy(update={"address": f"{LOOPBACK}:{world_port}"}),
        }
    )
    return free.model_copy(update={"robot": tuple(_on_free_port(free, each, wished) for each in free.robot)})


def free_port(usual: int) -> int:
    """Return a free TCP port of loopback, `usual` if it can be.

    Raises
    ------
    Unreachable
        This machine has no free port.
    """
    return _free(socket.SOCK_STREAM, usual, wished=True)


def _on_free_port(config: SwarmConfig, robot: RobotConfig, wished: bool) -> RobotConfig:
    """Write the driver of an emulated robot down; its port, if it is one of the network, is free."""
    from fullswarm.drivers import emulated
    from fullswarm.drivers.make import emulated_as

    if not robot.emulate or robot.driver:
        return robot
    url = emulated.driver_url(config, robot)
    port = urlsplit(url).port
    if port is not None:
        kind = socket.SOCK_STREAM if emulated_as(robot.emulate)[1].place == "tcp" else socket.SOCK_DGRAM
        url = url.replace(f":{port}", f":{_free(kind, port, wished)}", 1)
    return robot.model_copy(update={"driver": url})


def _free(kind: socket.SocketKind, usual: int, wished: bool) -> int:
    for port in (usual, ANY) if wished else (ANY,):
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind((LOOPBACK, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise Unreachable("this machine has no free port", where=LOOPBACK, hint="end some of the programs that use them")
