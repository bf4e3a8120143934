"""The host keys that flashed robots will show: pinned in place of what was known at their addresses before."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from fullswarm.config import RobotConfig
from fullswarm.deploy.fleet.hostkeys import Pins, name_of
from fullswarm.deploy.release.keys import Keys, public


def pin(robot: RobotConfig, swarm: str, keys: Keys) -> bool:
    """Pin a robot's own host key at its address; True when another one was known there before."""
    host = robot.host or f"{robot.id}.local"
    own = " ".join(public(keys.host_key(swarm, robot.id)).split()[:2])
    pins = Pins(keys.known_hosts, keys.host_key(swarm, robot.id).parent)
    name = name_of(host, robot.ssh_port)
    replaced = _forget_others(keys.known_hosts, name, own)
    pins.pin_flashed(robot.id, host, robot.ssh_port)
    return replaced


@contextmanager
def on_trial(robots: Sequence[RobotConfig], swarm: str, keys: Keys) -> Iterator[Callable[[], None]]:
    """Drop the host keys that are made in here, unless what it gives is called because writing begins.

    Without a card that has it, a key would only make a strange computer of the robot that answers.
    """
    fresh = [each.id for each in robots if not keys.has_host_key(swarm, each.id)]
    try:
        yield fresh.clear
    finally:
        for robot in fresh:
            keys.forget_host_key(swarm, robot)


def _forget_others(file: Path, name: str, own: str) -> bool:
    if not file.exists():
        return False
    lines = file.read_text("utf-8").splitlines()
    kept = [line for line in lines if not _is_other(line, name, own)]
    if kept == lines:
        return False
    fresh = file.with_name(f"{file.name}.new")
    fresh.touch(mode=0o600)
    fresh.write_text("".join(f"{line}\n" for line in kept), "utf-8")
    os.replace(fresh, file)  # noqa: PTH105  (one word less than Path's)
    return True


def _is_other(line: str, name: str, own: str) -> bool:
    words = line.split()
    if len(words) < 3 or line.startswith(("#", "@", "|")):
        return False
    return name in words[0].split(",") and f"{words[1]} {words[2]}" != own
