"""Builds a robot's first-boot configuration: cloud-init's three files, or Raspberry Pi's ``firstrun.sh``.

Only standard keys of cloud-init are used, so that Raspberry Pi OS, Ubuntu and Debian understand the same files; each
rule that they are checked against comes from a robot that never became reachable. Raspberry Pi OS up to Bookworm has
no cloud-init: there the kernel's command line makes systemd run ``firstrun.sh`` instead of the usual system, then
reboot (systemd-run-generator(8)). The image's own first boot, which grows the file system, comes before that by itself.
"""

from __future__ import annotations

import ipaddress
import re
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from fullswarm.deploy.flash.wifi import COUNTRIES, Network
from fullswarm.deploy.robot.support_package import RULE
from fullswarm.errors import ConfigError, MissingExtra

HOME = "/opt/fullswarm/flash"
"""Folder of the first boot's script on the robot."""
SERVICE = "fullswarm-first-boot.service"
_HOSTNAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?\Z")
_USER = re.compile(r"[a-z_][a-z0-9_-]{0,31}\Z")
_LOGIN_KEY = re.compile(r"(ssh-ed25519|ssh-rsa|ecdsa-sha2-\S+|sk-ssh-\S+) [A-Za-z0-9+/=]+( .*)?\Z")
_NETWORK_KEY = re.compile(r"[0-9a-f]{64}\Z")
_PASSWORDS = frozenset({"passwd", "hashed_passwd", "plain_text_passwd", "password", "chpasswd"})
_PRIVATE = "-----BEGIN OPENSSH PRIVATE KEY-----"
WIRED, WIRELESS = "eth0", "wlan0"

# At each boot, before anything else: unblock a radio that had no country yet, and disable the wizard with which
# Raspberry Pi OS asks for a user on the screen.
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
# A port without a cable must not delay each boot by two minutes.
ANY_LINK = """\
[Service]
ExecStart=
ExecStart=/lib/systemd/systemd-networkd-wait-online --any --timeout=10
"""
MOUNT = "/boot/firmware"
"""Mount point of Bookworm's boot partition."""
_RUN_SCRIPT = (
    f"systemd.run={MOUNT}/firstrun.sh",
    "systemd.run_success_action=reboot",
    "systemd.run_failure_action=reboot",
    "systemd.unit=kernel-command-line.target",
)
_OURS = re.compile(r"(systemd\.(run|run_success_action|run_failure_action|unit)|cfg80211\.ieee80211_regdom)=")


def cloud_init_problems(documents: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong with cloud-init's parsed files, as ``file: what``."""
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
        yield "ssh_pwauth must be false: robots are logged in to by key"
    if found := _PASSWORDS & set(document):
        yield f"passwords are not allowed: {', '.join(sorted(found))}"
    users = document["users"]
    if not users:
        yield "users is empty: no login would be possible"
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
        yield "instance-id is missing or malformed: cloud-init would not configure the machine"


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
    """Return whether Linux accepts a name for a user."""
    return _USER.match(name) is not None


def valid_hostname(name: str) -> bool:
    """Return whether RFC 1123 accepts a name for a host."""
    return _HOSTNAME.match(name) is not None


# ---------------------------------------------------------------- cloud-init
class _Quoted(str):
    """Text that YAML must not read as a number or a boolean: a key of digits, a network called `no`."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Static:
    """A fixed address."""

    address: ipaddress.IPv4Interface
    router: ipaddress.IPv4Address


@dataclass(frozen=True, slots=True)
class FirstBoot:
    """The first-boot configuration of one robot."""

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
    full_sudo: bool = False  # else the user may run `fullswarm-robot` alone as root


def new_instance(robot: str) -> str:
    """Return a fresh instance id: cloud-init configures a machine, and its network, once per id."""
    return f"fullswarm-{robot}-{uuid.uuid4().hex[:12]}"


def hostname_of(robot: str, host: str) -> str:
    """Return the name of a robot's computer.

    Raises
    ------
    ConfigError
        Its id is not a valid host name, and the fleet file names no address.
    """
    name = robot.replace("_", "-").strip("-").lower()
    if valid_hostname(robot):
        return robot
    if not host or not valid_hostname(name):
        hint = f'give it an id of letters, digits and "-", or write host = "10.0.0.11" for {robot}'
        raise ConfigError(f"'{robot}' is not a valid host name", where=f"robot {robot}", hint=hint)
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
        raise ConfigError(f"{address} cannot be its address", where=f"robot {robot}", hint=hint)
    return Static(ipaddress.IPv4Interface(f"{address}/{network.prefixlen}"), gateway.ip)


def cloud_init_files(boot: FirstBoot, card_env: str) -> dict[str, bytes]:
    """Return cloud-init's files, checked.

    Raises
    ------
    ConfigError
        With them the robot would not be reachable.
    MissingExtra
        PyYAML is not installed.
    """
    documents = {
        "user-data": user_data(boot, card_env),
        "meta-data": {"dsmode": "local", "instance-id": boot.instance, "local-hostname": boot.hostname},
        "network-config": network_config(boot),
    }
    built = {name: _dump(document, name) for name, document in documents.items()}
    check_cloud_init(built)
    return built


def user_data(boot: FirstBoot, card_env: str) -> dict[str, Any]:
    """Return ``user-data``: the login, the host key, and the installation from the card."""
    script = files("fullswarm.deploy.flash").joinpath("first_boot.sh").read_text("utf-8")
    return {
        **after_install(boot),
        "ssh_deletekeys": True,
        "ssh_keys": {"ed25519_private": boot.host_private, "ed25519_public": boot.host_public},
        "bootcmd": [["sh", "-c", _UNBLOCK], ["sh", "-c", _NO_WIZARD]],
        "write_files": [
            {"path": f"{HOME}/first_boot.sh", "permissions": "0755", "content": script},
            {"path": f"{HOME}/card.env", "permissions": "0644", "content": card_env},
            {"path": f"/etc/systemd/system/{SERVICE}", "permissions": "0644", "content": UNIT},
            {"path": WAIT_ONLINE, "permissions": "0644", "content": ANY_LINK},
        ],
        # A unit instead of the commands themselves: it is retried after a power cut, cloud-init is not.
        "runcmd": [
            ["systemctl", "daemon-reload"],
            ["systemctl", "enable", SERVICE],
            ["systemctl", "restart", "--no-block", SERVICE],
        ],
    }


def after_install(boot: FirstBoot) -> dict[str, Any]:
    """Return the part of ``user-data`` that later boots need, without secrets."""
    login = {"name": boot.user, "lock_passwd": True, "ssh_authorized_keys": list(boot.login_keys)}
    if boot.user != "root":
        login |= {
            "gecos": "fullswarm",
            "shell": "/bin/bash",
            "groups": ["adm", "systemd-journal"],
            "sudo": "ALL=(ALL) NOPASSWD:ALL" if boot.full_sudo else RULE,
        }
    return {
        "hostname": boot.hostname,
        "manage_etc_hosts": True,
        "users": [login],
        "ssh_pwauth": False,
        "disable_root": boot.user != "root",
        "package_update": False,
        "package_upgrade": False,
    }


def network_config(boot: FirstBoot) -> dict[str, Any]:
    """Return ``network-config``, version 2.

    The wired port is given by its name: a ``match`` breaks Debian's own renderer. It is optional, so that no boot
    waits for a cable. The fixed address goes to Wi-Fi when there is one.
    """
    wired: dict[str, Any] = {"dhcp4": True, "optional": True}
    config: dict[str, Any] = {"version": 2, "ethernets": {WIRED: wired}}
    fixed = wired
    if boot.networks:
        points = {_Quoted(each.ssid): _access_point(each) for each in boot.networks}
        fixed = {"dhcp4": True, "optional": True, "regulatory-domain": _Quoted(boot.country), "access-points": points}
        config["wifis"] = {WIRELESS: fixed}
    if boot.static is not None:
        router = str(boot.static.router)
        fixed |= {
            "dhcp4": False,
            "addresses": [str(boot.static.address)],
            "routes": [{"to": "0.0.0.0/0", "via": router}],
            "nameservers": {"addresses": [router]},
        }
        if fixed is wired:
            fixed["renderer"] = "networkd"  # without it a fixed address silently becomes DHCP again
    return config


def _access_point(network: Network) -> dict[str, Any]:
    point: dict[str, Any] = {"password": _Quoted(network.key)} if network.key else {}
    return point | {"hidden": True} if network.hidden else point


def after_user_data(boot: FirstBoot) -> bytes:
    """Return the ``user-data`` that replaces the first one once the robot is installed."""
    return _dump(after_install(boot), "user-data")


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


def check_cloud_init(content: Mapping[str, bytes]) -> None:
    """Check cloud-init's files as they would be written.

    Raises
    ------
    ConfigError
        They would leave a robot unreachable, insecure or not installed; one line for each reason.
    """
    documents = {}
    for name in ("user-data", "meta-data", "network-config"):
        try:
            documents[name] = _yaml().safe_load(content[name])
        except KeyError:
            raise ConfigError("is missing", where=name) from None
        except _yaml().YAMLError as error:
            raise ConfigError(f"is not valid YAML: {error}", where=name) from None
    problems = list(cloud_init_problems(documents))
    if not content["user-data"].startswith(b"#cloud-config\n"):
        problems.append("user-data: its first line is not #cloud-config")
    if problems:
        raise ConfigError("\n".join(problems))


# ---------------------------------------------------------------- firstrun.sh
def command_line(text: str, *, country: str, run_script: bool) -> bytes:
    """Return ``cmdline.txt`` with the radio's country, and with the script to run; the rest stays.

    Raises
    ------
    ConfigError
        It is not one line.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    if len(lines) != 1 or "root=" not in text:
        what = f"is not one line that names the root partition ({len(lines)} lines)"
        raise ConfigError(what, where="cmdline.txt", hint="take the image from its source again")
    words = [word for word in lines[0].split() if not _OURS.match(word)]
    words += [f"cfg80211.ieee80211_regdom={country}"] if country else []
    words += _RUN_SCRIPT if run_script else ()
    return (" ".join(words) + "\n").encode()


def firstrun_files(boot: FirstBoot, there: Mapping[str, bytes]) -> dict[str, bytes]:
    """Return the files by which firstrun.sh does the same as cloud-init; `there` holds the FAT's own cmdline.txt."""
    here = files("fullswarm.deploy.flash")
    text = there["cmdline.txt"].decode("utf-8", "replace")
    payload = {
        "cmdline.txt": command_line(text, country=boot.country, run_script=True),
        "firstrun.sh": here.joinpath("firstrun.sh").read_bytes(),
        "fullswarm/first_boot.sh": here.joinpath("first_boot.sh").read_bytes(),
        "fullswarm/first-boot.service": UNIT.encode(),
        "fullswarm/secret/authorized_keys": "".join(f"{key}\n" for key in boot.login_keys).encode(),
    }
    for number, network in enumerate(boot.networks, start=1):
        text = connection(f"fullswarm-wifi-{number}", network, boot.static, priority=len(boot.networks) - number)
        payload[f"fullswarm/secret/wifi-{number}.nmconnection"] = text.encode()
    if boot.static is not None and not boot.networks:
        payload["fullswarm/secret/wired.nmconnection"] = wired(boot.static).encode()
    return payload


def connection(name: str, network: Network, static: Static | None, *, priority: int = 0) -> str:
    """Return a Wi-Fi network as NetworkManager keeps it; the name in bytes, so that any name works."""
    ssid = "".join(f"{byte};" for byte in network.ssid.encode("utf-8", "surrogatepass"))
    hidden = "hidden=true\n" if network.hidden else ""
    security = f"[wifi-security]\nkey-mgmt=wpa-psk\npsk={network.key}\n\n" if network.key else ""
    return (
        f"[connection]\nid={name}\ntype=wifi\nautoconnect-priority={priority}\n\n"
        f"[wifi]\nmode=infrastructure\nssid={ssid}\n{hidden}\n{security}{_addresses(static)}"
    )


def wired(static: Static) -> str:
    """Return the wired port with a fixed address as NetworkManager keeps it."""
    return f"[connection]\nid=fullswarm-wired\ntype=ethernet\n\n[ethernet]\n\n{_addresses(static)}"


def _addresses(static: Static | None) -> str:
    if static is None:
        return "[ipv4]\nmethod=auto\n\n[ipv6]\nmethod=auto\n"
    address = f"address1={static.address},{static.router}\ndns={static.router};\n"
    return f"[ipv4]\nmethod=manual\n{address}\n[ipv6]\nmethod=auto\n"
