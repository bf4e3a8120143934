"""Logs in to the robots of a fleet file: pinned host key, fleet key, jump hosts, and what only a person can answer."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import getpass
import hashlib
import os
import socket
import sys
from collections.abc import AsyncIterator, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from fullswarm import output
from fullswarm.deploy.fleet.remote import Remote, clean, closing
from fullswarm.errors import ConfigError, FullswarmError, Unreachable, did_you_mean
from fullswarm.identity.private import usable

if TYPE_CHECKING:
    from fullswarm.config import RobotConfig, SwarmConfig
    from fullswarm.deploy.release.keys import Keys

SSH_PORT = 22
CONNECT_S = 20.0
ALIVE_S = 10.0
ALIVE_COUNT = 3
"""A link without any answer for 30 s counts as broken."""
ATTEMPTS = 2
"""sshd rejects some connections at random while many log in (``MaxStartups``)."""
AGAIN_S = 1.0


class HostKeyProblem(FullswarmError):
    """A computer's identity is wrong, or not confirmed yet."""

    exit_code = 3


@dataclass(frozen=True, slots=True)
class Pins:
    """The host keys of the robots of one swarm.

    Parameters
    ----------
    known_hosts
        In OpenSSH's format, so that ``ssh`` and ``ssh-keygen`` can use it too.
    flashed
        Folder of the host keys that were made on this machine, ``<robot>_ed25519.pub``.

    Raises
    ------
    ConfigError
        In each method: these files are not this user's to read or write.
    """

    known_hosts: Path
    flashed: Path

    def keys(self, robot: str, host: str, port: int) -> list[str]:
        """Return the public keys (``ssh-ed25519 AAAA…``) that this robot may show; none: it is not known yet."""
        return self._pinned(known_hosts_name(host, port)) or self._made_here(robot)

    def pin(self, host: str, port: int, key: str) -> None:
        """Remember a key that the user has confirmed."""
        line = f"{known_hosts_name(host, port)} {_without_comment(key)}\n".encode()
        with usable(self.known_hosts.parent, self.known_hosts):
            self.known_hosts.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            # One write to a file opened for appending, so that the lines of two commands do not mix.
            file = os.open(self.known_hosts, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
            try:
                os.write(file, line)
            finally:
                os.close(file)

    def pin_flashed(self, robot: str, host: str, port: int) -> None:
        """Pin the key of a robot flashed here, so that ``ssh`` knows it too."""
        if not self._pinned(known_hosts_name(host, port)):
            for key in self._made_here(robot):
                self.pin(host, port, key)

    def changed(self, robot: str, host: str, port: int) -> HostKeyProblem:
        """Return the error for a computer that shows another key than the pinned one."""
        name = known_hosts_name(host, port)
        if self._pinned(name):
            mend = f"ssh-keygen -R '{name}' -f '{self.known_hosts}'"
        else:
            mend = f"rm '{self.flashed / f'{robot}_ed25519.pub'}'"
        return HostKeyProblem(
            "shows another host key than the one that is known: another computer at its address, or an interception",
            where=f"{robot} ({host})",
            hint=f"only if it was set up again on purpose: {mend}, then `fullswarm deploy {robot}`",
        )

    def unknown(self, robot: str, host: str, key: str) -> HostKeyProblem:
        """Return the error for a computer that is not confirmed yet."""
        return HostKeyProblem(
            f"its host key is not known yet: {key_fingerprint(key)}",
            where=f"{robot} ({host})",
            hint=f"compare with `ssh-keygen -lf /etc/ssh/ssh_host_ed25519_key.pub` there, then `fullswarm deploy "
            f"{robot}` and confirm, or --accept-new-host-keys on a network you trust",
        )

    def _pinned(self, name: str) -> list[str]:
        with usable(self.known_hosts.parent):
            return [key for names, key in _lines(self.known_hosts) if name in names.split(",")]

    def _made_here(self, robot: str) -> list[str]:
        try:
            with usable(self.flashed):
                return [_without_comment((self.flashed / f"{robot}_ed25519.pub").read_text("utf-8"))]
        except FileNotFoundError:
            return []


def known_hosts_name(host: str, port: int) -> str:
    """Return the name of a host in ``known_hosts``."""
    return host if port == SSH_PORT else f"[{host}]:{port}"


def key_fingerprint(key: str) -> str:
    """Return ``SHA256:…`` as ``ssh`` and ``ssh-keygen -l`` print it."""
    digest = hashlib.sha256(base64.b64decode(key.split()[1])).digest()
    return "SHA256:" + base64.b64encode(digest).decode().rstrip("=")


def _without_comment(key: str) -> str:
    return " ".join(key.split()[:2])


def _lines(file: Path) -> list[tuple[str, str]]:
    """Names and key of each line; without comments, markers and hashed names."""
    try:
        text = file.read_text("utf-8")
    except FileNotFoundError:
        return []
    found = []
    for line in text.splitlines():
        words = line.split()
        if len(words) >= 3 and not line.startswith(("#", "@", "|")):
            found.append((words[0], f"{words[1]} {words[2]}"))
    return found


# ---------------------------------------------------------------- connections
class LoginRefused(FullswarmError):
    """The computer answers, but accepts none of our keys."""

    exit_code = 3


@dataclass(frozen=True, slots=True)
class Address:
    """The SSH address of a robot's computer, and the user to log in as."""

    robot: str
    host: str
    port: int
    user: str

    @classmethod
    def of(cls, robot: RobotConfig) -> Address:
        """Read it from the fleet file; a host that is not named is ``<id>.local``."""
        return cls(robot.id, robot.host or f"{robot.id}.local", robot.ssh_port, robot.ssh_user)

    @property
    def where(self) -> str:
        """The robot and its address, for messages."""
        return f"{self.robot} ({self.host}:{self.port})" if self.port != 22 else f"{self.robot} ({self.host})"


@dataclass(frozen=True, slots=True)
class Login:
    """Opens connections to robots.

    Parameters
    ----------
    fleet_key
        Private key that robots accept after their first install.
    own_keys
        Also try the user's agent and own keys: for a first install.
    """

    pins: Pins
    fleet_key: Path
    own_keys: bool = False
    sudo_password: str | None = None
    connect_s: float = CONNECT_S

    @contextlib.asynccontextmanager
    async def connect(self, address: Address) -> AsyncIterator[Remote]:
        """Log in.

        Raises
        ------
        HostKeyProblem
            Not pinned yet, or another key than the pinned one.
        LoginRefused
            None of our keys is accepted.
        Unreachable
            No answer in time.
        """
        if not self.pins.keys(address.robot, address.host, address.port):
            raise self.pins.unknown(address.robot, address.host, await self.host_key(address))
        connection, own_key = await self._open(address)
        async with closing(connection):
            yield Remote(address.robot, connection, self.sudo_password, own_key)

    async def host_key(self, address: Address) -> str:
        """Ask a computer for its host key, without logging in (``ssh-ed25519 AAAA…``); raises `Unreachable`."""
        import asyncssh

        with _translated(address, self.pins):
            async with asyncio.timeout(self.connect_s):
                key = await asyncssh.get_server_host_key(address.host, address.port)
        if key is None:
            raise Unreachable("showed no host key", where=address.where)
        return str(key.export_public_key("openssh").decode()).strip()

    async def _open(self, address: Address) -> tuple[Any, bool]:
        for attempt in range(1, ATTEMPTS + 1):
            try:
                return await self._once(address)
            except (LoginRefused, HostKeyProblem):
                raise
            except Unreachable as error:
                if attempt == ATTEMPTS or not isinstance(error.__cause__, ConnectionError):
                    raise
                await asyncio.sleep(AGAIN_S * attempt)
        raise AssertionError("the last attempt has raised or returned")

    async def _once(self, address: Address) -> tuple[Any, bool]:
        keys: list[dict[str, Any]] = [{"client_keys": [str(self.fleet_key)], "agent_path": None}]
        if self.own_keys:
            keys.append({})
        for number, which in enumerate(keys, start=1):
            try:
                met: list[str] = []
                with _translated(address, self.pins, met):
                    async with asyncio.timeout(self.connect_s):
                        return await self._dial(address, which, met), number > 1
            except LoginRefused:
                if number == len(keys):
                    raise
        raise AssertionError("the last key has raised or returned")

    async def _dial(self, address: Address, keys: dict[str, Any], met: list[str]) -> Any:
        """Connect; `met` gets the robot's name once its own computer is reached, behind all jump hosts."""
        import asyncssh

        def arrived() -> asyncssh.SSHClient:
            met.append(address.robot)
            return asyncssh.SSHClient()

        pinned = self.pins.keys(address.robot, address.host, address.port)
        trusted = [asyncssh.import_public_key(each) for each in pinned]
        return await asyncssh.connect(
            address.host,
            address.port,
            client_factory=arrived,
            username=address.user,
            known_hosts=(trusted, [], []),
            preferred_auth="publickey",
            keepalive_interval=ALIVE_S,
            keepalive_count_max=ALIVE_COUNT,
            compression_algs=None,  # large data is compressed already
            **keys,
        )


@contextlib.contextmanager
def _translated(address: Address, pins: Pins, met: Sequence[str] | None = None) -> Any:
    """Turn the errors of asyncssh and sockets into ours; the cause is kept, to decide whether to try again.

    Parameters
    ----------
    met
        Empty until the robot's own computer is reached; None: accept any host key of it.
    """
    import asyncssh

    check = "is it switched on and in this network? `host` in the fleet file is its address"
    try:
        yield
    except (asyncssh.HostKeyNotVerifiable, asyncssh.KeyExchangeFailed) as error:
        if not met and (met is not None or isinstance(error, asyncssh.HostKeyNotVerifiable)):
            raise _jump_host(address, error.reason) from None
        # Without a key of the kind that is pinned, the two find no algorithm in common.
        raise pins.changed(address.robot, address.host, address.port) from None
    except asyncssh.PermissionDenied:
        port = "" if address.port == 22 else f"-p {address.port} "
        hint = (
            f"`fullswarm deploy {address.robot}` once, with a key of yours that it accepts "
            f"(`ssh-copy-id {port}{address.user}@{address.host}`); `ssh_user` in the fleet file is the user"
        )
        raise LoginRefused(f"accepts none of our keys for '{address.user}'", where=address.where, hint=hint) from None
    except TimeoutError:
        raise Unreachable("does not answer", where=address.where, hint=check) from None
    except (OSError, asyncssh.ConnectionLost, asyncssh.DisconnectError) as error:
        lost = error if isinstance(error, ConnectionError) else ConnectionResetError()
        cause = lost if isinstance(error, ConnectionError | asyncssh.Error) else error
        raise Unreachable(_describe(error), where=address.where, hint=check) from cause
    except (asyncssh.Error, ValueError) as error:
        raise Unreachable(clean(str(error)), where=address.where, hint=check) from None


def _jump_host(address: Address, reason: str) -> HostKeyProblem:
    """Return the error for a jump host without a known key; asyncssh's text ends with `for host NAME`."""
    _, found, name = reason.rpartition(" for host ")
    name = clean(name).split()[0] if found and name.strip() else ""
    return HostKeyProblem(
        f"is behind the jump host{f' {name}' if name else ''}, whose host key is not in ~/.ssh/known_hosts",
        where=address.where,
        hint=f"`ssh {name or 'JUMPHOST'}` once, by its name in ~/.ssh/config if it has one, and confirm its key",
    )


def _describe(error: Exception) -> str:
    """Describe a connection's error without asyncio's wording (``[Errno 111] Connect call failed ('…', 22)``)."""
    if isinstance(error, ConnectionRefusedError):
        return "refuses the connection: no SSH server on that port"
    if isinstance(error, socket.gaierror):
        return "host name could not be resolved"
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno).lower()
    return clean(str(error)) or "does not answer"


# ---------------------------------------------------------------- for a command
def pick_robots(config: SwarmConfig, named: Iterable[str], where: Path) -> tuple[RobotConfig, ...]:
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
        raise ConfigError(f"'{' '.join(words)}' selects no robot", where=str(where), hint=hint)
    chosen = tuple(picked.values()) or tuple(each for each in config.robot if each.host or not each.simulated)
    if not chosen:
        raise ConfigError("no robot with a computer of its own", where=str(where), hint='host = "10.0.0.11" names one')
    return chosen


def login_for(config: SwarmConfig, keys: Keys, *, ask_password: bool = False, own_keys: bool = False) -> Login:
    """Return how to log in to the robots of a fleet; with `ask_password` asks for sudo's password once.

    Raises
    ------
    ConfigError
        This user may not read the keys.
    """
    password = None
    if ask_password:
        password = getpass.getpass("sudo's password on the robots: ") if sys.stdin.isatty() else sys.stdin.readline()
        password = password.rstrip("\n")
    pins = Pins(keys.known_hosts, keys.folder / "hosts" / config.swarm)
    with usable(keys.folder):
        key = keys.fleet_key()
        key.open("rb").close()  # or each robot would report it as its own error
    return Login(pins, key, own_keys, password)


async def confirm_host_keys(login: Login, addresses: Sequence[Address], *, accept: bool) -> dict[str, FullswarmError]:
    """Pin the host keys of unknown computers, after the user has confirmed each.

    Returns
    -------
    dict
        The robots whose key could not be read or was not confirmed, and why.
    """
    pins = login.pins
    fresh = [each for each in addresses if not pins.keys(each.robot, each.host, each.port)]
    shown = await asyncio.gather(*(login.host_key(each) for each in fresh), return_exceptions=True)
    problems: dict[str, FullswarmError] = {}
    for address, key in zip(fresh, shown, strict=True):
        if isinstance(key, FullswarmError):
            problems[address.robot] = key
        elif isinstance(key, BaseException):
            raise key
        elif accept or _confirmed(address, key):
            pins.pin(address.host, address.port, key)
            output.progress(f"{address.where}: host key {key_fingerprint(key)} is pinned")
        else:
            problems[address.robot] = pins.unknown(address.robot, address.host, key)
    return problems


def _confirmed(address: Address, key: str) -> bool:
    if not sys.stdin.isatty():
        return False
    kind = key.split()[0]
    question = f"{address.where} shows the host key {key_fingerprint(key)} ({kind}). Is that this robot's?"
    return typer.confirm(question, default=False, err=True)
