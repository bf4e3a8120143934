"""Which host key a robot must show: pinned in ``known_hosts``, or made by us when its card was flashed."""

from __future__ import annotations

import base64
import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

from fullswarm.deploy.release.keys import usable
from fullswarm.errors import FullswarmError

SSH_PORT = 22


class HostKeyProblem(FullswarmError):
    """A computer's identity is wrong, or not confirmed yet."""

    exit_code = 3


@dataclass(frozen=True, slots=True)
class Pins:
    """The keys that robots of one swarm are known by.

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
        """Public keys (``ssh-ed25519 AAAA…``) that this robot may show; none: it is not known yet."""
        return self._pinned(name_of(host, port)) or self._made_here(robot)

    def pin(self, host: str, port: int, key: str) -> None:
        """Remember a key that the user has confirmed."""
        line = f"{name_of(host, port)} {_bare(key)}\n".encode()
        with usable(self.known_hosts.parent, self.known_hosts):
            self.known_hosts.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            # One write to a file opened for appending: two commands at a time do not tear each other's lines.
            file = os.open(self.known_hosts, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
            try:
                os.write(file, line)
            finally:
                os.close(file)

    def pin_flashed(self, robot: str, host: str, port: int) -> None:
        """Write down for ``ssh`` what is known of a robot flashed here."""
        if not self._pinned(name_of(host, port)):
            for key in self._made_here(robot):
                self.pin(host, port, key)

    def changed(self, robot: str, host: str, port: int) -> HostKeyProblem:
        """Return the error for a computer that shows another key than the pinned one."""
        name = name_of(host, port)
        if self._pinned(name):
            mend = f"ssh-keygen -R '{name}' -f '{self.known_hosts}'"
        else:
            mend = f"rm '{self.flashed / f'{robot}_ed25519.pub'}'"
        return HostKeyProblem(
            "shows another host key than the one that is known: another computer at its address, or an interception",
            where=f"{robot} ({host})",
            hint=f"only if it was set up anew on purpose: {mend}, then `fullswarm deploy {robot}`",
        )

    def unknown(self, robot: str, host: str, key: str) -> HostKeyProblem:
        """Return the error for a computer that is not confirmed yet."""
        return HostKeyProblem(
            f"its host key is not known yet: {fingerprint(key)}",
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
                return [_bare((self.flashed / f"{robot}_ed25519.pub").read_text("utf-8"))]
        except FileNotFoundError:
            return []


def name_of(host: str, port: int) -> str:
    """The name a host has in ``known_hosts``."""
    return host if port == SSH_PORT else f"[{host}]:{port}"


def fingerprint(key: str) -> str:
    """``SHA256:…`` as ``ssh`` and ``ssh-keygen -l`` print it."""
    digest = hashlib.sha256(base64.b64decode(key.split()[1])).digest()
    return "SHA256:" + base64.b64encode(digest).decode().rstrip("=")


def _bare(key: str) -> str:
    return " ".join(key.split()[:2])


def _lines(file: Path) -> list[tuple[str, str]]:
    """Names and key of each line; comments, markers and hashed names are not ours."""
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
