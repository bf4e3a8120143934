"""Defines what a physics engine does for the world, and makes the one that a name chooses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import import_module
from typing import Protocol

from fullswarm.config import EngineName, WorldConfig
from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.kernels import Array
from fullswarm.simulation.contacts import ContactReferee


class Engine(Protocol):
    """Physics of n bodies, advanced by whole world steps. Bodies are solid: none may pass through another."""

    pose: Array  # (n, 3) x, y (m), heading in [-pi, pi]; the same array at all times
    twist: Array  # (n, 2) m/s along the heading, rad/s, measured over the last step
    referee: ContactReferee  # the contacts of the last step
    firmware: str  # name and version of what computes the physics

    def step(self, twists: Array) -> None:
        """Advance by one world step of ``1 / rate_hz`` seconds with the set-points `twists` (n, 2)."""
        ...

    def place_movers(self, places: Array) -> None:
        """Put the movers (the last obstacles of the referee) at `places` (m, 2) before the next step."""
        ...

    def close(self) -> None:
        """Release the physics. Closing twice is fine."""
        ...


ENGINES: dict[EngineName, tuple[str, str]] = {
    "kinematic": ("kinematic", "KinematicEngine"),
    "pybullet": ("pybullet_engine", "PyBulletEngine"),
    "pybullet-wheels": ("pybullet_wheels", "WheelsEngine"),
    "drivetrain": ("drivetrain", "DrivetrainEngine"),
}
"""Module and class of each engine; imported on use, because PyBullet is an extra."""


def check_config(config: WorldConfig) -> None:
    """Refuse a world without room: raise `ConfigError` for empty bounds or a box without area."""
    x_min, y_min, x_max, y_max = config.bounds_m
    radius_m = max([config.radius_m, *(body.radius_m or 0.0 for body in config.bodies.values())])
    if x_max - x_min <= 2 * radius_m or y_max - y_min <= 2 * radius_m:
        raise ConfigError(
            f"bounds {config.bounds_m} leave no room for a robot of {radius_m} m radius",
            where="world.bounds_m",
            hint="give x_min, y_min, x_max, y_max in metres",
        )
    for index, box in enumerate(config.boxes):
        if box[2] <= 0 or box[3] <= 0 or not all(map(math.isfinite, box)):
            raise ConfigError(
                f"box {index} measures {box[2]} x {box[3]} m", where="world.boxes", hint="sizes must be positive"
            )


def make_engine(config: WorldConfig, starts: Array, bodies: Sequence[WorldConfig] | None = None) -> Engine:
    """Return the engine that `config` names, its bodies at `starts` (n, 3).

    Parameters
    ----------
    bodies : n settings, of each body, as `WorldConfig.of_body` returns them; None: all are the world's

    Raises
    ------
    MissingExtra
        PyBullet is wanted and not installed.
    """
    check_config(config)
    module, name = ENGINES[config.engine]
    bodies = (config,) * len(starts) if bodies is None else bodies
    fastest_m_s = max((body.speed_limit_m_s for body in bodies), default=config.speed_limit_m_s)
    config = config.model_copy(update={"speed_limit_m_s": fastest_m_s})
    try:
        engine: Engine = getattr(import_module(f"fullswarm.simulation.{module}"), name)(config, starts, bodies)
        return engine
    except ModuleNotFoundError as error:
        if error.name != "pybullet":
            raise
        raise MissingExtra(
            f"the engine '{config.engine}' needs PyBullet, which is not installed",
            where="world.engine",
            hint="pip install 'fullswarm[sim]', or choose engine = \"kinematic\"",
        ) from error
