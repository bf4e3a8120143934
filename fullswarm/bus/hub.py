"""The hub: a zenoh router in a process of its own; every agent, the core and the operators are its clients.

A star costs a publisher the same at any size of the swarm; a full mesh of Python peers breaks at 32 robots.
"""

from __future__ import annotations

from collections.abc import Sequence

import zenoh

from fullswarm.bus.codec import LARGEST_BYTES
from fullswarm.bus.endpoint import DEFAULT_HUB, check_endpoint, is_secured
from fullswarm.bus.zenoh_bus import config, reason_of, untyped
from fullswarm.errors import ConfigError
from fullswarm.identity import Credentials, Grant
from fullswarm.identity.access import ACCESS_KEY, rules

__all__ = ["DEFAULT_HUB", "Hub", "check_endpoint"]


class Hub:
    """Routes messages between the clients that connect to `endpoint`.

    Parameters
    ----------
    endpoint
        Where to listen: ``tcp/<host>:<port>``, or ``tls/<host>:<port>`` to ask every client for its certificate.
    insecure_network
        Allow an address that other machines reach without certificates.
    credentials
        Of the hub itself, for ``tls/``.
    swarm, grants
        For ``tls/``: the swarm that it serves, and the certificates that are valid in it; see
        :mod:`fullswarm.identity.access` for what each may do.

    Raises
    ------
    ConfigError
        The address is malformed, open to the network without `insecure_network`, or a secured one without credentials.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_HUB,
        *,
        insecure_network: bool = False,
        credentials: Credentials | None = None,
        swarm: str = "swarm",
        grants: Sequence[Grant] = (),
    ) -> None:
        check_endpoint(endpoint, insecure_network)
        if is_secured(endpoint) and credentials is None:
            raise ConfigError(
                "a secured hub needs a certificate",
                where=endpoint,
                hint="make the swarm's keys with `fullswarm keys init`",
            )
        self.endpoint = endpoint
        self._credentials, self._swarm, self._grants = credentials, swarm, tuple(grants)
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
            self._session = zenoh.open(config(mode="router", listen__endpoints=[self.endpoint], **self._security()))
        except zenoh.ZError as error:
            raise _explained(self.endpoint, reason_of(error)) from error
        if is_secured(self.endpoint):
            answer = zenoh.handlers.Callback(_admit, indirect=False)
            self._session.declare_queryable(ACCESS_KEY, answer)

    def reopen(self, grants: Sequence[Grant]) -> None:
        """Disconnect all clients and listen again, for `grants`; zenoh cannot change an open hub's access list.

        Clients connect again by themselves within 0.25 s. The hub's certificate is read anew.
        """
        self.close()
        self._grants = tuple(grants)
        self.open()

    def _security(self) -> dict[str, object]:
        if self._credentials is None or not is_secured(self.endpoint):
            return {}
        from fullswarm.bus.tls import link_settings

        oversized = {"id": "oversized", "flows": ["ingress"], "messages": ["put"], "key_exprs": ["**"]}
        return {
            **link_settings(self._credentials, listens=True),
            "access_control": rules(self._swarm, self._grants),
            "low_pass_filter": [{**oversized, "size_limit": LARGEST_BYTES}],
        }

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


def _admit(query: zenoh.Query) -> None:
    """Answer a client that the access list lets ask."""
    with query:
        query.reply(query.key_expr, b"")


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
