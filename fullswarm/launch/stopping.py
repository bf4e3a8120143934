"""Checks a fleet file before a start: whether its robots sense each other early enough to stop, and filter their poses.

Every agent checks it for its own robot; here it is known for the whole fleet before a process is started.
"""

from __future__ import annotations

from collections.abc import Iterable

from fullswarm import registry
from fullswarm.agent.pose.estimator import unfiltered
from fullswarm.agent.safety.startup import check_stopping, summary
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.drivers.base import Description
from fullswarm.errors import FullswarmError
from fullswarm.launch.processes import driver_url


def descriptions_of(config: SwarmConfig, robots: Iterable[RobotConfig]) -> list[Description]:
    """Return what is known of robots before connecting; nothing of one whose driver is not installed here."""
    found: list[Description] = []
    for each in robots:
        try:
            url = driver_url(config, each)
            description: Description = registry.driver_class(url)(url).description
        except FullswarmError:
            continue  # opening it reports what is wrong
        found.append(description)
    return found


def check_fleet(config: SwarmConfig) -> tuple[str, str]:
    """Return what its robots need to stop, in words, and a warning about its estimator or the empty text.

    Raises
    ------
    ConfigError
        Its robots cannot stop in time.
    """
    descriptions = descriptions_of(config, config.robot)
    check_stopping(config, descriptions)
    return summary(config, descriptions), unfiltered(config, descriptions)
