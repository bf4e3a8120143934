"""The hub: a zenoh router in a process of its own; every agent, the core and the operators are its clients.

A star costs a publisher the same at any size of the swarm; a full mesh of Python peers breaks at 32 robots.
"""

from __future__ import annotations

import zenoh

from fullswarm.bus.endpoint import DEFAULT_HUB, check_endpoint
from fullswarm.bus.zenoh_bus import config, reason_of, untyped
from fullswarm.errors import ConfigError

__all__ = ["DEFAULT_HUB", "Hub", "check_endpoint"]


class Hub:
    """Routes messages between the clients that connect to `endpoint`.

    Parameters
    ----------
    endpoint
        Where to listen, ``tcp/<host>:<port>``.
    insecure_network
        Allow an address that other machines reach.

    Raises
    ------
    ConfigError
        The address is malformed, or open to the network without `insecure_network`.
    """

    def __init__(self, endpoint: str = DEFAULT_HUB, *, insecure_network: bool = False) -> None:
        check_endpoint(endpoint, insecure_network)
        self.endpoint = endpoint
        self._session: zenoh.Session | None = None

    def open(self) -> None:
        """Listen; an open hub stays open.

        Raises
        ------
        ConfigError
            The port is in use, forbidden, or the address is not one of this machine.
        """
        if self._session is not None:
            return
        try:
            self._session = zenoh.open(config(mode="router", listen__endpoints=[self.endpoint]))
        except zenoh.ZError as error:
            raise _explained(self.endpoint, reason_of(error)) from error

    def close(self) -> None:
        """Disconnect all clients. Closing twice is fine."""
        session, self._session = self._session, None
        if session is not None:
            untyped(session.close)

    def __enter__(self) -> Hub:
        """Open the hub."""
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()


_CAUSES = {
    "Address already in use": (
        "another program listens on this port, perhaps a hub that already runs",
        "use that hub, stop it, or choose another port",
    ),
    "Cannot assign requested address": ("this machine has no such address", "use an address of this machine"),
    "Permission denied": ("this port needs administrator rights", "choose a port above 1023"),
}


def _explained(endpoint: str, reason: str) -> ConfigError:
    for sign, (what, hint) in _CAUSES.items():
        if sign in reason:
            return ConfigError(what, where=endpoint, hint=hint)
    return ConfigError(f"cannot listen: {reason}", where=endpoint)
