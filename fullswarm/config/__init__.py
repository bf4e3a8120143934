"""Settings of a swarm: TOML → typed, with every error at once and where it stands.

`load_swarm` reads a fleet file. :mod:`~fullswarm.config.models` is the schema; its defaults are what a file need
not say.

Files:

``explain.py``    pydantic's complaints in plain words: which key, what is wrong, what was probably meant
``limits.py``     Ranges that fleet files, the core's database, requests and robots hold to alike: (least, greatest)
``load.py``       Reads a fleet file: all errors at once, each with its file, line and key
``models.py``     Settings of a swarm: TOML → typed, with every error at once and where it stands
``parameter.py``  A parameter of a behaviour: its type, its range, and the check that core and robots make alike
``positions.py``  Where things stand in a TOML file
``write.py``      Typed settings → TOML: what a supervisor hands to its processes, and what stands beside a result
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
