"""A secured hub on a free port of loopback with an identity of each role, and sessions of zenoh that obey nothing."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from fullswarm.bus.hub import Hub
from fullswarm.bus.zenoh_bus import ZenohBus, client_config, untyped
from fullswarm.identity import Credentials, Grant, Role
from fullswarm.runtime import Mailbox
from tests.certificates import Authority, grant_of

NAMES: dict[str, Role] = {
    "r1": "robot",
    "r2": "robot",
    "core": "core",
    "centralised": "centralised",
    "world": "world",
    "anna": "operator",
    "console": "console",
    "eve": "observer",
    "camera": "source",
}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class SecuredHub:
    """The hub, its authority, and the credentials of `NAMES`."""

    folder: Path
    swarm: str = "test"
    authority: Authority = field(init=False)
    identities: dict[str, Credentials] = field(init=False)
    hub: Hub = field(init=False)

    def __post_init__(self) -> None:
        self.authority = Authority(self.folder)
        self.identities = {name: self.authority.issue(name, role) for name, role in NAMES.items()}
        own = self.authority.issue("hub", "hub")
        self.hub = Hub(f"tls/127.0.0.1:{free_port()}", credentials=own, swarm=self.swarm, grants=self.grants())

    def grants(self, *without: str) -> tuple[Grant, ...]:
        """Return grants for all identities but some."""
        return tuple(grant_of(each) for name, each in self.identities.items() if name not in without)

    def bus(self, name: str, mailbox: Mailbox | None = None) -> ZenohBus:
        """Return the bus of one identity."""
        return ZenohBus(mailbox or Mailbox(), hub=self.hub.endpoint, credentials=self.identities[name])

    @contextmanager
    def session(self, name: str) -> Iterator[zenoh.Session]:
        """Open a bare session with the certificate of one identity: what a program of an attacker has."""
        session = zenoh.open(client_config(self.hub.endpoint, multicast=False, credentials=self.identities[name]))
        try:
            yield session
        finally:
            untyped(session.close)
