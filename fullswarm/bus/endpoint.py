"""Where the hub listens: the default address, its syntax, which computers reach it, and whether it is secured."""

from __future__ import annotations

import ipaddress
import re
import socket

from fullswarm.errors import ConfigError, Unreachable
from fullswarm.identity import Credentials, Role

DEFAULT_HUB = "tcp/127.0.0.1:7447"
"""The hub of this machine (7447 is zenoh's usual port)."""

SECURED = "tls/"
"""How the endpoint of a secured hub starts: each side proves its name by a certificate, and the link is encrypted."""

_ENDPOINT = re.compile(r"(?:tcp|tls)/(?:\[(?P<six>[0-9A-Fa-f:.]+)\]|(?P<name>[A-Za-z0-9._-]+)):(?P<port>[0-9]{1,5})\Z")


def host_of(endpoint: str) -> str:
    """Return the host of an endpoint such as ``tcp/127.0.0.1:7447``, ``tcp/[::1]:7447`` or ``tls/10.0.0.2:7447``.

    Raises
    ------
    ConfigError
        It is not of that form.
    """
    match = _ENDPOINT.match(endpoint)
    if match is None or not 0 < int(match["port"]) < 65536:
        raise ConfigError(
            f"'{endpoint}' is not the address of a hub",
            hint=f"write tcp/<host>:<port>, like {DEFAULT_HUB}, or tls/<host>:<port> if it is secured",
        )
    return str(match["six"] or match["name"])


def no_hub(hub: str) -> Unreachable:
    """Return the error for a hub that does not answer."""
    return Unreachable(
        "no hub answers",
        where=hub,
        hint="start a swarm with `fullswarm up FLEET.toml`, or give the address of its hub with --hub",
    )


def nothing_listens(endpoint: str, within_s: float) -> bool:
    """Tell whether the host of an endpoint answers that nothing listens there; False also when it does not answer."""
    host = host_of(endpoint)
    try:
        socket.create_connection((host, int(endpoint.rpartition(":")[2])), within_s).close()
    except ConnectionRefusedError:
        return True
    except OSError:
        return False
    return False


def is_loopback(host: str) -> bool:
    """Tell whether only this machine can reach `host`. A name other than ``localhost`` is never trusted."""
    if host.lower() == "localhost":
        return True
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        return address.ipv4_mapped.is_loopback
    return address.is_loopback


def is_secured(endpoint: str) -> bool:
    """Tell whether the hub at `endpoint` asks for certificates."""
    return endpoint.startswith(SECURED)


def credentials_at(endpoint: str, swarm: str, name: str, role: Role) -> Credentials | None:
    """Return the files by which the process `name` of a swarm proves its name at a hub; None: the hub asks for none.

    Raises
    ------
    ConfigError
        The hub is secured, and a file is missing, incomplete or readable by others.
    """
    if not is_secured(endpoint):
        return None
    from fullswarm.identity.folder import credentials_for

    return credentials_for(swarm, name, role)


def check_endpoint(endpoint: str, insecure_network: bool) -> None:
    """Refuse an address that other machines reach without certificates, unless the user allows it.

    Raises
    ------
    ConfigError
        Not an address, or one that other machines reach, without TLS although `insecure_network` is False.
    """
    if is_loopback(host_of(endpoint)) or is_secured(endpoint) or insecure_network:
        return
    raise ConfigError(
        "this address is open to the network without authentication: any computer on that network could drive the "
        "robots",
        where=endpoint,
        hint=f"run `fullswarm keys init`, then listen with `--listen {SECURED}{endpoint.partition('/')[2]}` (in a "
        "fleet file: hub.endpoint); without keys only with --insecure-network (insecure_network=True), on a network "
        "that you trust",
    )
