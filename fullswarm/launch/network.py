"""Puts a bad network, if one is wanted, between a process and its bus."""

from __future__ import annotations

from fullswarm.bus.base import PROCESSES, NamedBus, SenderBus
from fullswarm.bus.network_faults import Network, check_names, faulty, parse_network
from fullswarm.config import SwarmConfig
from fullswarm.runtime import Scheduler

FILE_KEY = "network.conditions"


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
