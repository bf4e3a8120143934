"""Raspberry Pi OS up to Bookworm has no cloud-init: the same, by ``firstrun.sh`` and one boot into it.

The kernel's command line makes systemd run the script instead of the usual system, then reboot
(systemd-run-generator(8)). The image's own first boot, which grows the file system, comes before that by itself.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.resources import files

from fullswarm.deploy.flash.seed import UNIT, Static, Wish
from fullswarm.deploy.flash.wifi import Network
from fullswarm.errors import ConfigError

MOUNT = "/boot/firmware"
"""Where Bookworm has its boot partition."""
_RUN = (
    f"systemd.run={MOUNT}/firstrun.sh",
    "systemd.run_success_action=reboot",
    "systemd.run_failure_action=reboot",
    "systemd.unit=kernel-command-line.target",
)
_OURS = re.compile(r"(systemd\.(run|run_success_action|run_failure_action|unit)|cfg80211\.ieee80211_regdom)=")


def command_line(text: str, *, country: str, run_script: bool) -> bytes:
    """Return ``cmdline.txt`` with the radio's country, and with the script's run; what was there before stays.

    Raises
    ------
    ConfigError
        It is not one line of words.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    if len(lines) != 1 or "root=" not in text:
        what = f"is not one line that names the root partition ({len(lines)} lines)"
        raise ConfigError(what, where="cmdline.txt", hint="take the image from its source again")
    words = [word for word in lines[0].split() if not _OURS.match(word)]
    words += [f"cfg80211.ieee80211_regdom={country}"] if country else []
    words += _RUN if run_script else ()
    return (" ".join(words) + "\n").encode()


def build(wish: Wish, boot: Mapping[str, bytes]) -> dict[str, bytes]:
    """Return the files by which firstrun.sh does what cloud-init would; `boot` holds the FAT's own cmdline.txt."""
    here = files("fullswarm.deploy.flash")
    text = boot["cmdline.txt"].decode("utf-8", "replace")
    payload = {
        "cmdline.txt": command_line(text, country=wish.country, run_script=True),
        "firstrun.sh": here.joinpath("firstrun.sh").read_bytes(),
        "fullswarm/first_boot.sh": here.joinpath("first_boot.sh").read_bytes(),
        "fullswarm/first-boot.service": UNIT.encode(),
        "fullswarm/secret/authorized_keys": "".join(f"{key}\n" for key in wish.login_keys).encode(),
    }
    for number, network in enumerate(wish.networks, start=1):
        text = connection(f"fullswarm-wifi-{number}", network, wish.static, priority=len(wish.networks) - number)
        payload[f"fullswarm/secret/wifi-{number}.nmconnection"] = text.encode()
    if wish.static is not None and not wish.networks:
        payload["fullswarm/secret/wired.nmconnection"] = wired(wish.static).encode()
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
