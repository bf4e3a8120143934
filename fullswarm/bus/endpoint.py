"""Where the hub listens: the default address, its syntax, and which computers reach it."""

from __future__ import annotations

import ipaddress
import re

from fullswarm.errors import ConfigError

DEFAULT_HUB = "tcp/127.0.0.1:7447"
"""The hub of this machine (7447 is zenoh's usual port)."""

_ENDPOINT = re.compile(r"tcp/(?:\[(?P<six>[0-9A-Fa-f:.]+)\]|(?P<name>[A-Za-z0-9._-]+)):(?P<port>[0-9]{1,5})\Z")


def host_of(endpoint: str) -> str:
    """Return the host of an endpoint such as ``tcp/127.0.0.1:7447`` or ``tcp/[::1]:7447``.

    Raises
    ------
    ConfigError
        It is not of that form.
    """
    match = _ENDPOINT.match(endpoint)
    if match is None or not 0 < int(match["port"]) < 65536:
        raise ConfigError(
            f"'{endpoint}' is not the address of a hub", hint=f"write tcp/<host>:<port>, like {DEFAULT_HUB}"
        )
    return str(match["six"] or match["name"])


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


def check_endpoint(endpoint: str, insecure_network: bool) -> None:
    """Refuse an address that other machines reach, unless the user allows it.

    Raises
    ------
    ConfigError
        Not an address, or not a loopback one although `insecure_network` is False.
    """
    if not is_loopback(host_of(endpoint)) and not insecure_network:
        raise ConfigError(
            "this address is open to the network, and the bus has no authentication: any computer on that network "
            "could drive the robots",
            where=endpoint,
            hint=f"use {DEFAULT_HUB}, or allow it with --insecure-network (insecure_network=True) on a network "
            "that you trust",
        )
