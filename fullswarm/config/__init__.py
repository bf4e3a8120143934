"""Settings of a swarm: TOML → typed, with every error at once and where it stands.

`load_swarm` reads a fleet file. :mod:`~fullswarm.config.models` is the schema; its defaults are what a file need
not say.
"""

from __future__ import annotations

from fullswarm.bus.endpoint import DEFAULT_HUB
from fullswarm.config.load import FleetShorthand, load_swarm
from fullswarm.config.models import (
    DEFAULT_WORLD,
    AgentConfig,
    CoreConfig,
    HubConfig,
    NoiseConfig,
    PerformanceConfig,
    Point,
    RobotConfig,
    RobotId,
    Section,
    SwarmConfig,
    WorldConfig,
)

__all__ = [
    "DEFAULT_HUB",
    "DEFAULT_WORLD",
    "AgentConfig",
    "CoreConfig",
    "FleetShorthand",
    "HubConfig",
    "NoiseConfig",
    "PerformanceConfig",
    "Point",
    "RobotConfig",
    "RobotId",
    "Section",
    "SwarmConfig",
    "WorldConfig",
    "load_swarm",
]
