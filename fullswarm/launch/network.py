"""Sets a swarm's network: an emulated bad one between a process and its bus, and free ports beside another swarm."""

from __future__ import annotations

import socket
from pathlib import Path
from urllib.parse import urlsplit

from fullswarm.bus.base import PROCESSES, NamedBus, SenderBus
from fullswarm.bus.endpoint import host_of
from fullswarm.bus.network_faults import Network, check_names, faulty, parse_network
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.drivers.fleet_file import in_frame
from fullswarm.drivers.make import emulated_as
from fullswarm.earth import SITL_ORIGIN_DEG
from fullswarm.errors import Unreachable
from fullswarm.launch.run_folder import user_folder
from fullswarm.runtime import Scheduler

FILE_KEY = "network.conditions"
LOOPBACK = "127.0.0.1"
ANY = 0
"""The system chooses a free one."""


def with_network(config: SwarmConfig, conditions: str | None) -> SwarmConfig:
    """Return the settings with the conditions of ``--network``, if given, in place of the file's; check the names.

    Raises
    ------
    ConfigError
        The conditions do not parse, or name a process that this swarm does not have.
    """
    if conditions is None:
        network_of(config)
        return config
    check_names(parse_network(conditions), (*config.robots, *PROCESSES))
    section = config.network.model_copy(update={"conditions": conditions})
    return config.model_copy(update={"network": section})


def network_of(config: SwarmConfig) -> Network | None:
    """Return the conditions of the fleet file; None: a good network.

    Raises
    ------
    ConfigError
        They name a process that this swarm does not have.
    """
    if config.network.conditions is None:
        return None
    network = parse_network(config.network.conditions, FILE_KEY)
    check_names(network, (*config.robots, *PROCESSES), FILE_KEY)
    return network


def on_network(bus: SenderBus, scheduler: Scheduler, config: SwarmConfig, name: str) -> SenderBus:
    """Return the bus of process `name` on the network of the settings."""
    network = network_of(config)
    if network is None:
        return NamedBus(bus, name)
    since_s = config.network.since_s
    return faulty(bus, scheduler, network, config.network.seed, name, scheduler.now_s() if since_s is None else since_s)


# ---------------------------------------------------------------- free ports
def port_folder(config: SwarmConfig) -> Path:
    """Return where the ports of a swarm's emulated robots are; the same for the world and the agents of one user.

    Raises
    ------
    ConfigError
        The user's folder for them is a link, or open to others.
    """
    world = config.world_or_default.address.rpartition(":")[2]
    return user_folder() / f"{config.swarm}-{world}"


def emulated_url(config: SwarmConfig, robot: RobotConfig) -> str:
    """Return the URL with which an emulated robot's agent opens its driver; the fleet file's own `driver` wins.

    Raises
    ------
    ConfigError
        Its word is unknown, e.g. because its package is not installed here.
    """
    url = robot.driver
    if not url:
        _, model = emulated_as(robot.emulate or "")
        alike = [each.id for each in config.robot if each.emulate == robot.emulate]
        url = model.driver_url(port_folder(config) / robot.id, alike.index(robot.id))
    return in_frame(url, config.origin_deg or SITL_ORIGIN_DEG)  # a simulated world always lies somewhere


def on_free_ports(config: SwarmConfig, *, prefer_configured: bool = True) -> SwarmConfig:
    """Give hub, world and emulated robots free ports of this machine.

    Parameters
    ----------
    prefer_configured
        The settings' own port where it is free. Not for swarms that start side by side: they would all find the usual
        port free and then take it.

    Raises
    ------
    ConfigError
        The hub's or the world's address is wrong.
    Unreachable
        This machine has no free port.
    """
    from fullswarm.drivers.ports import parse_address

    world = config.world_or_default
    host_of(config.hub.endpoint)  # raises what is wrong with it
    hub_port = _free(socket.SOCK_STREAM, int(config.hub.endpoint.rpartition(":")[2]), prefer_configured)
    world_port = _free(socket.SOCK_DGRAM, parse_address(world.address, where="world.address")[1], prefer_configured)
    free = config.model_copy(
        update={
            "hub": config.hub.model_copy(
                update={"endpoint": f"{config.hub.endpoint.partition('/')[0]}/{LOOPBACK}:{hub_port}"}
            ),
            "world": world.model_copy(update={"address": f"{LOOPBACK}:{world_port}"}),
        }
    )
    return free.model_copy(update={"robot": tuple(_on_free_port(free, each, prefer_configured) for each in free.robot)})


def free_port(usual: int) -> int:
    """Return a free TCP port of loopback, `usual` if it can be.

    Raises
    ------
    Unreachable
        This machine has no free port.
    """
    return _free(socket.SOCK_STREAM, usual, prefer_configured=True)


def _on_free_port(config: SwarmConfig, robot: RobotConfig, prefer_configured: bool) -> RobotConfig:
    """Write the driver of an emulated robot down; its port, if it is one of the network, is free."""
    if not robot.emulate or robot.driver:
        return robot
    url = emulated_url(config, robot)
    port = urlsplit(url).port
    if port is not None:
        kind = socket.SOCK_STREAM if emulated_as(robot.emulate)[1].place == "tcp" else socket.SOCK_DGRAM
        url = url.replace(f":{port}", f":{_free(kind, port, prefer_configured)}", 1)
    return robot.model_copy(update={"driver": url})


def _free(kind: socket.SocketKind, usual: int, prefer_configured: bool) -> int:
    for port in (usual, ANY) if prefer_configured else (ANY,):
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind((LOOPBACK, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise Unreachable("this machine has no free port", where=LOOPBACK, hint="end some of the programs that use them")
