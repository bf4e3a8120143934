"""The rules that a seed must keep, each learnt from a robot that never came up."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator, Mapping
from typing import Any

from fullswarm.deploy.flash.wifi import COUNTRIES

HOME = "/opt/fullswarm/flash"
"""Where the first boot keeps its script on the robot."""
SERVICE = "fullswarm-first-boot.service"
_HOSTNAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?\Z")
_USER = re.compile(r"[a-z_][a-z0-9_-]{0,31}\Z")
_LOGIN_KEY = re.compile(r"(ssh-ed25519|ssh-rsa|ecdsa-sha2-\S+|sk-ssh-\S+) [A-Za-z0-9+/=]+( .*)?\Z")
_NETWORK_KEY = re.compile(r"[0-9a-f]{64}\Z")
_PASSWORDS = frozenset({"passwd", "hashed_passwd", "plain_text_passwd", "password", "chpasswd"})
_PRIVATE = "-----BEGIN OPENSSH PRIVATE KEY-----"


def problems(documents: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong with the parsed documents of a seed, as ``file: what``."""
    for name, rules in (("user-data", _user), ("meta-data", _meta), ("network-config", _network)):
        document = documents[name]
        if not isinstance(document, dict):
            yield f"{name}: is not a table"
            continue
        try:
            yield from (f"{name}: {each}" for each in rules(document))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            yield f"{name}: has another shape than cloud-init expects ({type(error).__name__}: {error})"


def _user(document: dict[str, Any]) -> Iterator[str]:
    if not isinstance(document.get("hostname"), str) or not valid_hostname(document["hostname"]):
        yield f"'{document.get('hostname')}' cannot be a hostname"
    if document.get("ssh_pwauth") is not False:
        yield "ssh_pwauth must be false: robots are entered by key"
    if found := _PASSWORDS & set(document):
        yield f"no passwords belong here: {', '.join(sorted(found))}"
    users = document["users"]
    if not users:
        yield "no user could log in: users is empty"
    for user in users:
        if not valid_user(user["name"]):
            yield f"'{user['name']}' cannot be a user"
        if user.get("lock_passwd") is not True or _PASSWORDS & set(user):
            yield f"user {user['name']} must have no password"
        keys = user.get("ssh_authorized_keys") or ()
        if not keys:
            yield f"user {user['name']} could not log in: no SSH key"
        if any(not isinstance(key, str) or not _LOGIN_KEY.match(key) for key in keys):
            yield f"user {user['name']}: not an SSH public key"
    keys = document["ssh_keys"]
    if not str(keys["ed25519_private"]).startswith(_PRIVATE):
        yield "ssh_keys: not a private host key"
    if not str(keys["ed25519_public"]).startswith("ssh-ed25519 "):
        yield "ssh_keys: not a public host key"
    paths = {each["path"] for each in document["write_files"]}
    if not {f"{HOME}/first_boot.sh", f"{HOME}/card.env", f"/etc/systemd/system/{SERVICE}"} <= paths:
        yield "write_files lacks a part of the first boot"
    if not any(SERVICE in command for command in document["runcmd"]):
        yield f"runcmd does not start {SERVICE}"


def _meta(document: dict[str, Any]) -> Iterator[str]:
    instance = document.get("instance-id")
    if not isinstance(instance, str) or not re.fullmatch(r"[A-Za-z0-9_-]{8,128}", instance):
        yield "instance-id is missing or malformed: cloud-init would not set the machine up"


def _network(document: dict[str, Any]) -> Iterator[str]:
    if document.get("version") != 2:
        yield "version must be 2"
    wired, wifis = document.get("ethernets", {}), document.get("wifis", {})
    if not wired and not wifis:
        yield "has no interface: the robot would be unreachable"
    for name, interface in {**wired, **wifis}.items():
        if "match" in interface:
            yield f"{name}: a match breaks Debian's renderer; name the interface"
        if not interface.get("dhcp4") and not interface.get("addresses"):
            yield f"{name}: neither DHCP nor an address"
        yield from (f"{name}: {each}" for each in _fixed(interface))
    for name, interface in wired.items():
        if interface.get("addresses") and interface.get("renderer") != "networkd":
            yield f"{name}: a fixed address needs renderer: networkd, or it becomes DHCP"
    for name, interface in wifis.items():
        if interface.get("regulatory-domain") not in COUNTRIES:
            yield f"{name}: regulatory-domain is missing or no country: the radio would stay off"
        points = interface.get("access-points")
        if not points:
            yield f"{name}: no network to join"
            continue
        for ssid, point in points.items():
            if not isinstance(ssid, str) or not 1 <= len(ssid.encode("utf-8", "surrogatepass")) <= 32:
                yield f"{name}: {ssid!r} cannot name a network"
            key = point.get("password")
            if key is not None and (not isinstance(key, str) or not _NETWORK_KEY.match(key)):
                yield f"{name}: the key of '{ssid}' is not 64 hexadecimal digits"


def _fixed(interface: dict[str, Any]) -> Iterator[str]:
    networks = [ipaddress.ip_interface(each).network for each in interface.get("addresses", ())]
    for route in interface.get("routes", ()):
        if not any(ipaddress.ip_address(route["via"]) in network for network in networks):
            yield f"its router {route['via']} is not in its own network"


def valid_user(name: str) -> bool:
    """Tell whether Linux takes a name for a user."""
    return _USER.match(name) is not None


def valid_hostname(name: str) -> bool:
    """Tell whether RFC 1123 takes a name for a host."""
    return _HOSTNAME.match(name) is not None
