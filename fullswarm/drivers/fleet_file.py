"""Loads a fleet file and checks what only the drivers know: schemes of URLs, and who would share a port."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from urllib.parse import SplitResult, parse_qs, urlsplit

from fullswarm import registry
from fullswarm.config import RobotConfig, SwarmConfig, load_swarm
from fullswarm.drivers.make import emulated
from fullswarm.errors import did_you_mean

CAN_DEFAULT, CAN_PORT, SYSTEM = "socketcan", "43113", "1"


def load_fleet(path: Path | str, overrides: Iterable[str] = (), *, here: bool = False) -> SwarmConfig:
    """Read and check a fleet file as `load_swarm` does, and its robots' drivers as well.

    Parameters
    ----------
    here : the agents will run on this computer, but for those with a `host` of their own: each of them needs a driver
        that is installed here and a port of its own. Otherwise only a slip of the pen is refused.

    Raises
    ------
    ConfigError
        All that is wrong, one line each: ``file:line: key: what``.
    """
    return load_swarm(path, overrides, partial(problems, here=here))


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
        guess = did_you_mean(scheme, schemes)
        if scheme not in schemes and (guess.startswith("did you mean") or (here and not robot.elsewhere)):
            yield robot.id, "driver", f"no driver for '{scheme or robot.url}', {guess}"
    if here:
        yield from _starts(config)
    taken: dict[tuple[str, ...], RobotConfig] = {}
    for robot in config.robot:
        if not robot.driver or not (here or robot.elsewhere):
            continue
        for claim in _claims(robot):
            other = taken.setdefault((robot.host if robot.elsewhere else "", *claim), robot)
            if other is not robot:
                yield robot.id, "driver", f"{' '.join(claim)} is taken by {other.id}: {_advice(claim)}"
                break


def _starts(config: SwarmConfig) -> Iterator[tuple[str, str, str]]:
    """Yield what is wrong with the start poses of simulated robots that have one."""
    placed = [(each.id, each.pose) for each in config.robot if each.simulated and each.pose is not None]
    if not placed:
        return
    import numpy as np

    from fullswarm.drivers.sim.starts import complaints

    poses = np.array([pose for _, pose in placed], float)
    for robot, what in complaints(config.world_or_default, [robot for robot, _ in placed], poses):
        yield robot, "pose", what


def _advice(claim: tuple[str, ...]) -> str:
    if claim[0] == "the CAN node":
        return "give each wheel a node id of its own"
    if claim[0] == "the MAVLink system":
        return "give each rover a system id of its own (SYSID_THISMAV) and name it with ?sysid="
    return "give each robot a port of its own"


def _claims(robot: RobotConfig) -> Iterator[tuple[str, ...]]:
    """Yield what only one robot of a computer can have."""
    parts = urlsplit(robot.url)
    options = {name: values[-1] for name, values in parse_qs(parts.query, keep_blank_values=True).items()}
    scheme, kind = parts.scheme, parts.scheme.partition("+")[0]
    if kind == "create" or scheme == "mavlink+serial":
        yield _device(parts.path, robot)
    elif kind == "can":
        yield from _can(parts, options, robot)
    elif scheme == "mavlink+udp":
        # Whoever listens on all addresses listens on each; one socket per port is all that a computer's agents need.
        yield "the UDP port", _port(parts)
    elif kind == "mavlink":
        host, system = parts.hostname or "", options.get("sysid", SYSTEM)
        yield "the MAVLink system", system, "at", f"{scheme.removeprefix('mavlink+')} {host}:{_port(parts)}"
    elif scheme == "sim":
        yield "the simulated robot", f"{parts.netloc}{parts.path}"
    elif scheme != "null":
        yield "the URL", robot.url


def _can(parts: SplitResult, options: dict[str, str], robot: RobotConfig) -> Iterator[tuple[str, ...]]:
    """Yield a serial adapter as a whole, of a bus the nodes of both wheels."""
    channel, interface = parts.netloc + parts.path, options.get("interface", CAN_DEFAULT)
    if interface == "slcan":
        yield _device(channel, robot)
        return
    bus = f"{channel}:{options.get('port', CAN_PORT)}" if interface == "udp_multicast" else channel
    for node in (options.get("left", ""), options.get("right", "")):
        yield "the CAN node", node, "of", bus, f"({parts.scheme.removeprefix('can+')})"


def _device(path: str, robot: RobotConfig) -> tuple[str, ...]:
    """Name a serial device; links such as those of /dev/serial/by-id are followed where they are."""
    return "the port", path if robot.elsewhere else os.path.realpath(path)


def _port(parts: SplitResult) -> str:
    try:
        return str(parts.port)
    except ValueError:  # the driver says what is wrong with it
        return parts.netloc
