"""Loads a fleet file and checks what only the drivers know: schemes of URLs, and which robots would share a port."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from urllib.parse import urlsplit

from fullswarm import registry
from fullswarm.config import RobotConfig, SwarmConfig, load_swarm
from fullswarm.config.fleet_file import Check
from fullswarm.drivers.make import Claim, emulated, make_of
from fullswarm.errors import ConfigError, did_you_mean, nearest


def load_fleet(
    path: Path | str, overrides: Iterable[str] = (), *, here: bool = False, check: Check | None = None
) -> SwarmConfig:
    """Read and check a fleet file as `load_swarm` does, and its robots' drivers as well.

    Parameters
    ----------
    here : the agents will run on this computer, but for those with a `host` of their own: each of them needs a driver
        that is installed here and a port of its own. Otherwise only a misspelt scheme is refused.
    check : yields more that is wrong, as `problems` does; for start poses ``simulation.starts.start_problems``

    Raises
    ------
    ConfigError
        All that is wrong, one line each: ``file:line: key: what``.
    """

    def all_problems(config: SwarmConfig) -> Iterator[tuple[str, str, str]]:
        yield from problems(config, here=here)
        if check is not None:
            yield from check(config)

    return load_swarm(path, overrides, all_problems)


def problems(config: SwarmConfig, *, here: bool) -> Iterator[tuple[str, str, str]]:
    """Yield (robot, key, what is wrong)."""
    schemes: tuple[str, ...] = ()
    words = emulated() if any(robot.emulate for robot in config.robot) else {}
    for robot in config.robot:
        if robot.emulate and robot.emulate not in words:
            yield robot.id, "emulate", f"no emulated robot '{robot.emulate}', {did_you_mean(robot.emulate, words)}"
        scheme = urlsplit(robot.url).scheme
        if scheme in registry.DRIVERS:
            continue
        schemes = schemes or registry.driver_schemes()
        if scheme not in schemes and (nearest(scheme, schemes) or (here and not robot.elsewhere)):
            yield robot.id, "driver", f"no driver for '{scheme or robot.url}', {did_you_mean(scheme, schemes)}"
    taken: dict[tuple[str, ...], RobotConfig] = {}
    for robot in config.robot:
        if not robot.driver or not (here or robot.elsewhere):
            continue
        for claim in _claims(robot):
            other = taken.setdefault((robot.host if robot.elsewhere else "", *claim.words), robot)
            if other is not robot:
                yield robot.id, "driver", f"{' '.join(claim.words)} is taken by {other.id}: {claim.advice}"
                break


def _claims(robot: RobotConfig) -> tuple[Claim, ...]:
    try:
        return make_of(robot.url).claims_of(robot.url, elsewhere=robot.elsewhere)
    except ConfigError:  # no such driver here: said above, or another computer has it
        return (Claim(("the URL", robot.url)),)
