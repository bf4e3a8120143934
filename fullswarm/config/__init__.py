"""Settings of a swarm: TOML → typed, with every error at once and its line.

`load_swarm` reads a fleet file. :mod:`~fullswarm.config.models` is the schema with the defaults.

Files:

``arena.py``        what a fleet file places in its arena, and numbers that were meant in another unit
``docks.py``        the slots of docks, and what is wrong with docks and thresholds
``fleet_file.py``   reads and writes fleet files: all errors at once, each with its file, line and key
``mission_file.py`` reads mission files, and checks a mission as far as no swarm is needed
``models.py``       the schema and its ranges
``parameter.py``    a parameter of a behaviour: its type, its range, and the check that core and robots share
``suggestions.py``  what is meant by an unknown key, and by a number beyond its range
``toml_errors.py``  reads TOML and explains what is wrong in it, with the line of each error
"""

from __future__ import annotations

from fullswarm.bus.endpoint import DEFAULT_HUB
from fullswarm.config.fleet_file import FleetShorthand, load_swarm
from fullswarm.config.models import (
    DEFAULT_WORLD,
    AgentConfig,
    BatteryConfig,
    BodyConfig,
    ChargingConfig,
    CoreConfig,
    DockConfig,
    DrivetrainConfig,
    EngineName,
    FixesConfig,
    HubConfig,
    MoverConfig,
    NoiseConfig,
    PerformanceConfig,
    Point,
    RangesConfig,
    RobotConfig,
    RobotId,
    Section,
    SightConfig,
    SwarmConfig,
    WorldConfig,
)

__all__ = [
    "DEFAULT_HUB",
    "DEFAULT_WORLD",
    "AgentConfig",
    "BatteryConfig",
    "BodyConfig",
    "ChargingConfig",
    "CoreConfig",
    "DockConfig",
    "DrivetrainConfig",
    "EngineName",
    "FixesConfig",
    "FleetShorthand",
    "HubConfig",
    "MoverConfig",
    "NoiseConfig",
    "PerformanceConfig",
    "Point",
    "RangesConfig",
    "RobotConfig",
    "RobotId",
    "Section",
    "SightConfig",
    "SwarmConfig",
    "WorldConfig",
    "load_swarm",
]
