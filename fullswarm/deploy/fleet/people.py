"""Robots by name, keys, and the questions that only a person can answer."""

from __future__ import annotations

import asyncio
import getpass
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from fullswarm import output
from fullswarm.deploy.fleet.hostkeys import Pins, fingerprint
from fullswarm.deploy.fleet.login import Address, Login
from fullswarm.deploy.release.keys import usable
from fullswarm.errors import ConfigError, FullswarmError, did_you_mean

if TYPE_CHECKING:
    from fullswarm.config import RobotConfig, SwarmConfig
    from fullswarm.deploy.release.keys import Keys


def pick(config: SwarmConfig, named: Iterable[str], where: Path) -> tuple[RobotConfig, ...]:
    """Return the robots that were named, by id or @group, in that order; none named: all with a computer.

    Raises
    ------
    ConfigError
        A name is not in the fleet file, or the names select no robot: an empty word, an empty group.
    """
    words = tuple(named)
    by_id = {each.id: each for each in config.robot}
    picked: dict[str, RobotConfig] = {}
    for name in (part for each in words for part in each.split(",") if part):
        members = config.groups.get(name[1:]) if name.startswith("@") else (name,)
        if members is None or any(each not in by_id for each in members):
            known = [*by_id, *(f"@{each}" for each in config.groups)]
            raise ConfigError(f"no robot '{name}' in this fleet", where=str(where), hint=did_you_mean(name, known))
        picked.update({each: by_id[each] for each in members})
    if words and not picked:  # an unset variable of a script must not mean the whole fleet
        hint = "an empty word or group; leave the robots out for all of them"
        raise ConfigError(f"'{' '.join(words)}' stands for no robot", where=str(where), hint=hint)
    chosen = tuple(picked.values()) or tuple(each for each in config.robot if each.host or not each.simulated)
    if not chosen:
        raise ConfigError("no robot with a computer of its own", where=str(where), hint='host = "10.0.0.11" names one')
    return chosen


def login(config: SwarmConfig, keys: Keys, *, ask_password: bool = False, own_keys: bool = False) -> Login:
    """Return how to log in to the robots of a fleet; asks for sudo's password once if it shall.

    Raises
    ------
    ConfigError
        The keys are not this user's to read.
    """
    password = None
    if ask_password:
        password = getpass.getpass("sudo's password on the robots: ") if sys.stdin.isatty() else sys.stdin.readline()
        password = password.rstrip("\n")
    pins = Pins(keys.known_hosts, keys.folder / "hosts" / config.swarm)
    with usable(keys.folder):
        key = keys.fleet_key()
        key.open("rb").close()  # each robot would say it otherwise, and as if it were the robot's fault
    return Login(pins, key, own_keys, password)


async def get_to_know(entrance: Login, addresses: Sequence[Address], *, accept: bool) -> dict[str, FullswarmError]:
    """Pin the host keys of unknown computers, after the user has confirmed each.

    Returns
    -------
    dict
        The robots that could not be asked or were not confirmed, and why.
    """
    pins = entrance.pins
    fresh = [each for each in addresses if not pins.keys(each.robot, each.host, each.port)]
    shown = await asyncio.gather(*(entrance.host_key(each) for each in fresh), return_exceptions=True)
    problems: dict[str, FullswarmError] = {}
    for address, key in zip(fresh, shown, strict=True):
        if isinstance(key, FullswarmError):
            problems[address.robot] = key
        elif isinstance(key, BaseException):
            raise key
        elif accept or _confirmed(address, key):
            pins.pin(address.host, address.port, key)
            output.progress(f"{address.where}: host key {fingerprint(key)} is known from now on")
        else:
            problems[address.robot] = pins.unknown(address.robot, address.host, key)
    return problems


def _confirmed(address: Address, key: str) -> bool:
    if not sys.stdin.isatty():
        return False
    kind = key.split()[0]
    question = f"{address.where} shows the host key {fingerprint(key)} ({kind}). Is that this robot's?"
    return typer.confirm(question, default=False, err=True)
