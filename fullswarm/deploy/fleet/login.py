"""From a robot of the fleet file to a connection that is logged in: pinned host key, the fleet's key, jump hosts."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fullswarm.deploy.fleet.hostkeys import HostKeyProblem, Pins
from fullswarm.deploy.fleet.remote import Remote, closing
from fullswarm.deploy.fleet.untrusted import clean
from fullswarm.errors import FullswarmError, Unreachable

if TYPE_CHECKING:
    from fullswarm.config import RobotConfig

CONNECT_S = 20.0
ALIVE_S = 10.0
ALIVE_COUNT = 3
"""A link on which nothing at all comes back for 30 s is over."""
ATTEMPTS = 2
"""sshd turns some away at random while many log in (``MaxStartups``)."""
AGAIN_S = 1.0


class LoginRefused(FullswarmError):
    """The computer answers, but none of our keys opens it."""

    exit_code = 3


@dataclass(frozen=True, slots=True)
class Address:
    """Where a robot's computer answers, and as whom we log in."""

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
        """For messages."""
        return f"{self.robot} ({self.host}:{self.port})" if self.port != 22 else f"{self.robot} ({self.host})"


@dataclass(frozen=True, slots=True)
class Login:
    """How we log in.

    Parameters
    ----------
    fleet_key
        Private key that robots know after their first install.
    own_keys
        Also try the user's agent and own keys: for a first contact.
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
            None of our keys is let in.
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

        with _told(address, self.pins):
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
                with _told(address, self.pins, met):
                    async with asyncio.timeout(self.connect_s):
                        return await self._dial(address, which, met), number > 1
            except LoginRefused:
                if number == len(keys):
                    raise
        raise AssertionError("the last key has raised or returned")

    async def _dial(self, address: Address, keys: dict[str, Any], met: list[str]) -> Any:
        """Connect; `met` gets the robot's name once its own computer is at the other end, behind all jump hosts."""
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
            compression_algs=None,  # what is big is packed already
            **keys,
        )


@contextlib.contextmanager
def _told(address: Address, pins: Pins, met: Sequence[str] | None = None) -> Any:
    """Turn what asyncssh and sockets raise into our errors; the cause stays, to decide whether to try again.

    Parameters
    ----------
    met
        Empty until the robot's own computer was at the other end; None: any host key of that one is taken.
    """
    import asyncssh

    check = "is it switched on and in this network? `host` in the fleet file says where"
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
            f"`fullswarm deploy {address.robot}` once, with a key of yours that it lets in "
            f"(`ssh-copy-id {port}{address.user}@{address.host}`); `ssh_user` in the fleet file says who"
        )
        raise LoginRefused(f"does not let '{address.user}' in with our keys", where=address.where, hint=hint) from None
    except TimeoutError:
        raise Unreachable("does not answer", where=address.where, hint=check) from None
    except (OSError, asyncssh.ConnectionLost, asyncssh.DisconnectError) as error:
        lost = error if isinstance(error, ConnectionError) else ConnectionResetError()
        cause = lost if isinstance(error, ConnectionError | asyncssh.Error) else error
        raise Unreachable(_words_for(error), where=address.where, hint=check) from cause
    except (asyncssh.Error, ValueError) as error:
        raise Unreachable(clean(str(error)), where=address.where, hint=check) from None


def _jump_host(address: Address, reason: str) -> HostKeyProblem:
    """Return the error for a jump host whose key ``~/.ssh/known_hosts`` has not; asyncssh ends with `for host NAME`."""
    _, found, name = reason.rpartition(" for host ")
    name = clean(name).split()[0] if found and name.strip() else ""
    return HostKeyProblem(
        f"is behind the jump host{f' {name}' if name else ''}, whose host key is not in ~/.ssh/known_hosts",
        where=address.where,
        hint=f"`ssh {name or 'JUMPHOST'}` once, by its name in ~/.ssh/config if it has one, and confirm its key",
    )


def _words_for(error: Exception) -> str:
    """Say what went wrong on the way without asyncio's own wording (``[Errno 111] Connect call failed ('…', 22)``)."""
    if isinstance(error, ConnectionRefusedError):
        return "refuses the connection: no SSH server on that port"
    if isinstance(error, socket.gaierror):
        return "host name could not be resolved"
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno).lower()
    return clean(str(error)) or "does not answer"
