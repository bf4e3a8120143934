"""What cloud-init is told on the first boot: user-data, meta-data, network-config, and a check of all three.

Only standard keys are used, so that Raspberry Pi OS, Ubuntu and Debian understand the same seed.
"""

from __future__ import annotations

import ipaddress
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from fullswarm.deploy.flash import seed_rules
from fullswarm.deploy.flash.seed_rules import HOME, SERVICE, valid_hostname
from fullswarm.deploy.flash.wifi import Network
from fullswarm.errors import ConfigError, MissingExtra

WIRED, WIRELESS = "eth0", "wlan0"

# Each boot, before anything else. A radio that was never given a country comes up blocked, and Raspberry Pi OS asks for
# a user on the screen until it has one; neither is wanted on a robot.
_UNBLOCK = "command -v rfkill >/dev/null && rfkill unblock wifi; exit 0"
_NO_WIZARD = (
    "systemctl -q is-enabled userconfig 2>/dev/null || exit 0; "
    "systemctl disable --now userconfig; systemctl enable --now getty@tty1; exit 0"
)

UNIT = f"""\
[Unit]
Description=fullswarm: install from the card
After=local-fs.target regenerate_ssh_host_keys.service ssh.service
Wants=network.target

[Service]
Type=oneshot
ExecStart=/bin/sh {HOME}/first_boot.sh
TimeoutStartSec=1800

[Install]
WantedBy=multi-user.target
"""

WAIT_ONLINE = "/etc/systemd/system/systemd-networkd-wait-online.service.d/60-fullswarm.conf"
# A port without a cable must not hold up each boot for two minutes.
ANY_LINK = """\
[Service]
ExecStart=
ExecStart=/lib/systemd/systemd-networkd-wait-online --any --timeout=10
"""


class _Quoted(str):
    """Text that YAML must not take for a number or a truth value: a key of digits, a network called `no`."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Static:
    """A fixed address."""

    address: ipaddress.IPv4Interface
    router: ipaddress.IPv4Address


@dataclass(frozen=True, slots=True)
class Wish:
    """What one robot is told."""

    robot: str
    hostname: str
    user: str
    login_keys: tuple[str, ...]  # public keys that may log in
    host_private: str = field(repr=False)
    host_public: str
    networks: tuple[Network, ...] = ()
    country: str = ""
    static: Static | None = None
    instance: str = ""


def new_instance(robot: str) -> str:
    """Return a fresh instance id: cloud-init sets a machine up once per id, and its network only then."""
    return f"fullswarm-{robot}-{uuid.uuid4().hex[:12]}"


def hostname_of(robot: str, host: str) -> str:
    """Return the name of a robot's computer.

    Raises
    ------
    ConfigError
        Its id cannot be a host's name, and the fleet file has no other way to reach it.
    """
    name = robot.replace("_", "-").strip("-").lower()
    if valid_hostname(robot):
        return robot
    if not host or not valid_hostname(name):
        hint = f'give it an id of letters, digits and "-", or write host = "10.0.0.11" for {robot}'
        raise ConfigError(f"'{robot}' cannot be the name of a computer", where=f"robot {robot}", hint=hint)
    return name


def static_of(host: str, router: str | None, robot: str) -> Static | None:
    """Return the fixed address of a robot: its `host` of the fleet file, in the network of `router` (10.0.0.1/24).

    Raises
    ------
    ConfigError
        The host is not an address of that network.
    """
    if router is None:
        return None
    try:
        gateway = ipaddress.IPv4Interface(router)
        if "/" not in router:
            raise ValueError
    except ValueError:
        hint = "address and prefix of the router, e.g. --static 10.0.0.1/24"
        raise ConfigError(f"'{router}' is not a router's address", where="--static", hint=hint) from None
    try:
        address = ipaddress.IPv4Address(host)
    except ValueError:
        hint = f'write host = "{gateway.network.network_address + 11}" or the like into the fleet file'
        raise ConfigError(f"its host is '{host}', not an address", where=f"robot {robot}", hint=hint) from None
    network = gateway.network
    taken = (gateway.ip, network.network_address, network.broadcast_address)
    if address not in network or address in taken:
        hint = f"free addresses of {network} are robots'; {gateway.ip} is the router"
        raise ConfigError(f"{address} is no address for it", where=f"robot {robot}", hint=hint)
    return Static(ipaddress.IPv4Interface(f"{address}/{network.prefixlen}"), gateway.ip)


def build(wish: Wish, card_env: str) -> dict[str, bytes]:
    """Return the seed's files, checked.

    Raises
    ------
    ConfigError
        They would not make a robot that can be reached.
    MissingExtra
        PyYAML is not installed.
    """
    documents = {
        "user-data": user_data(wish, card_env),
        "meta-data": {"dsmode": "local", "instance-id": wish.instance, "local-hostname": wish.hostname},
        "network-config": network_config(wish),
    }
    seed = {name: _dump(document, name) for name, document in documents.items()}
    check(seed)
    return seed


def user_data(wish: Wish, card_env: str) -> dict[str, Any]:
    """Return ``user-data``: who may log in, by which key the robot is known, and the installation from the card."""
    script = files("fullswarm.deploy.flash").joinpath("first_boot.sh").read_text("utf-8")
    return {
        **after_install(wish),
        "ssh_deletekeys": True,
        "ssh_keys": {"ed25519_private": wish.host_private, "ed25519_public": wish.host_public},
        "bootcmd": [["sh", "-c", _UNBLOCK], ["sh", "-c", _NO_WIZARD]],
        "write_files": [
            {"path": f"{HOME}/first_boot.sh", "permissions": "0755", "content": script},
            {"path": f"{HOME}/card.env", "permissions": "0644", "content": card_env},
            {"path": f"/etc/systemd/system/{SERVICE}", "permissions": "0644", "content": UNIT},
            {"path": WAIT_ONLINE, "permissions": "0644", "content": ANY_LINK},
        ],
        # A unit instead of the commands themselves: it tries again after a power cut, cloud-init would not.
        "runcmd": [
            ["systemctl", "daemon-reload"],
            ["systemctl", "enable", SERVICE],
            ["systemctl", "restart", "--no-block", SERVICE],
        ],
    }


def after_install(wish: Wish) -> dict[str, Any]:
    """Return what of ``user-data`` later boots need: nothing secret."""
    login = {"name": wish.user, "lock_passwd": True, "ssh_authorized_keys": list(wish.login_keys)}
    if wish.user != "root":
        login |= {
            "gecos": "fullswarm",
            "shell": "/bin/bash",
            "groups": ["adm", "systemd-journal"],
            "sudo": "ALL=(ALL) NOPASSWD:ALL",
        }
    return {
        "hostname": wish.hostname,
        "manage_etc_hosts": True,
        "users": [login],
        "ssh_pwauth": False,
        "disable_root": wish.user != "root",
        "package_update": False,
        "package_upgrade": False,
    }


def network_config(wish: Wish) -> dict[str, Any]:
    """Return ``network-config``, version 2.

    The wired port is called by its name: a ``match`` breaks Debian's own renderer. It is optional, so that no boot
    waits for a cable. The fixed address goes to Wi-Fi when there is one.
    """
    wired: dict[str, Any] = {"dhcp4": True, "optional": True}
    config: dict[str, Any] = {"version": 2, "ethernets": {WIRED: wired}}
    fixed = wired
    if wish.networks:
        points = {_Quoted(each.ssid): _access_point(each) for each in wish.networks}
        fixed = {"dhcp4": True, "optional": True, "regulatory-domain": _Quoted(wish.country), "access-points": points}
        config["wifis"] = {WIRELESS: fixed}
    if wish.static is not None:
        router = str(wish.static.router)
        fixed |= {
            "dhcp4": False,
            "addresses": [str(wish.static.address)],
            "routes": [{"to": "0.0.0.0/0", "via": router}],
            "nameservers": {"addresses": [router]},
        }
        if fixed is wired:
            fixed["renderer"] = "networkd"  # without it a fixed address silently becomes DHCP again
    return config


def _access_point(network: Network) -> dict[str, Any]:
    point: dict[str, Any] = {"password": _Quoted(network.key)} if network.key else {}
    return point | {"hidden": True} if network.hidden else point


def after_user_data(wish: Wish) -> bytes:
    """Return the ``user-data`` that replaces the first one once the robot is installed."""
    return _dump(after_install(wish), "user-data")


def _dump(document: Mapping[str, Any], name: str) -> bytes:
    yaml = _yaml()

    class Dumper(yaml.SafeDumper):  # type: ignore[misc, name-defined]
        def ignore_aliases(self, data: object) -> bool:
            del data
            return True

    def quoted(dumper: Any, text: str) -> Any:
        return dumper.represent_scalar("tag:yaml.org,2002:str", str(text), style='"')

    def plain(dumper: Any, text: str) -> Any:
        return dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None)

    Dumper.add_representer(_Quoted, quoted)
    Dumper.add_representer(str, plain)
    head = "#cloud-config\n" if name == "user-data" else ""
    text = yaml.dump(dict(document), Dumper=Dumper, sort_keys=False, allow_unicode=False, width=1000)
    return f"{head}{text}".encode("ascii")


def _yaml() -> Any:
    try:
        import yaml
    except ImportError as error:
        raise MissingExtra("flash needs PyYAML", hint="pip install 'fullswarm[deploy]'") from error
    return yaml


def check(seed: Mapping[str, bytes]) -> None:
    """Check a seed as it would be written.

    Raises
    ------
    ConfigError
        All that would leave a robot unreachable, insecure or not installed, one line each.
    """
    documents = {}
    for name in ("user-data", "meta-data", "network-config"):
        try:
            documents[name] = _yaml().safe_load(seed[name])
        except KeyError:
            raise ConfigError("is missing", where=name) from None
        except _yaml().YAMLError as error:
            raise ConfigError(f"is not valid YAML: {error}", where=name) from None
    problems = list(seed_rules.problems(documents))
    if not seed["user-data"].startswith(b"#cloud-config\n"):
        problems.append("user-data: its first line is not #cloud-config")
    if problems:
        raise ConfigError("\n".join(problems))
