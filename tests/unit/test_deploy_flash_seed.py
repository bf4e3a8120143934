"""What a robot is told on its first boot: the seed, its rules, Wi-Fi, and the same for images without cloud-init."""

from __future__ import annotations

import configparser
import ipaddress
import re
import shutil
import string
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.deploy.flash import payload, wifi
from fullswarm.deploy.flash.first_boot import (
    FirstBoot,
    Static,
    after_user_data,
    check_cloud_init,
    cloud_init_files,
    command_line,
    connection,
    hostname_of,
    new_instance,
    static_of,
)
from fullswarm.deploy.flash.wifi import COUNTRIES, Network
from fullswarm.errors import ConfigError

PRIVATE = "-----BEGIN OPENSSH PRIVATE KEY-----\nb3BlbnNzaC1rZXktdjEAAAAA\n-----END OPENSSH PRIVATE KEY-----\n"
PUBLIC = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIEx fullswarm lab r1"

ssids = st.text(min_size=1, max_size=32).filter(lambda text: text.isprintable() and len(text.encode()) <= 32)
passphrases = st.text(string.printable[:95], min_size=8, max_size=63)
networks = st.lists(
    st.builds(
        Network, ssids, st.one_of(st.just(""), st.text("0123456789abcdef", min_size=64, max_size=64)), st.booleans()
    ),
    max_size=4,
    unique_by=lambda each: each.ssid,
)
hostnames = st.from_regex(r"\A[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?\Z")
statics = st.builds(
    lambda last, prefix: Static(ipaddress.IPv4Interface(f"10.1.2.{last}/{prefix}"), ipaddress.IPv4Address("10.1.2.1")),
    st.integers(2, 120),
    st.integers(8, 25),
)


def wish(**given: Any) -> FirstBoot:
    facts: dict[str, Any] = {
        "robot": "r1",
        "hostname": "r1",
        "user": "fullswarm-admin",
        "login_keys": (PUBLIC,),
        "host_private": PRIVATE,
        "host_public": PUBLIC,
        "instance": new_instance("r1"),
    }
    return FirstBoot(**{**facts, **given})


@settings(max_examples=40)
@given(networks, st.sampled_from(sorted(COUNTRIES)), hostnames, st.one_of(st.none(), statics))
def test_every_sound_wish_becomes_a_seed_that_says_exactly_that(
    nets: list[Network], country: str, hostname: str, static: Static | None
) -> None:
    built = cloud_init_files(
        wish(networks=tuple(nets), country=country, hostname=hostname, static=static), "ROBOT=r1\n"
    )
    user, meta, net = (yaml.safe_load(built[name]) for name in ("user-data", "meta-data", "network-config"))
    assert user["hostname"] == meta["local-hostname"] == hostname
    assert user["ssh_keys"]["ed25519_private"] == PRIVATE
    assert [each["content"] for each in user["write_files"] if each["path"].endswith("card.env")] == ["ROBOT=r1\n"]
    points = net["wifis"]["wlan0"]["access-points"] if nets else {}
    assert {ssid: point.get("password", "") for ssid, point in points.items()} == {each.ssid: each.key for each in nets}
    if nets:
        assert net["wifis"]["wlan0"]["regulatory-domain"] == country  # also NO, which is no truth value
    if static is not None and not nets:
        assert net["ethernets"]["eth0"]["renderer"] == "networkd"
    if static is not None:
        fixed = net["wifis"]["wlan0"] if nets else net["ethernets"]["eth0"]
        assert (fixed["addresses"], fixed["dhcp4"]) == ([str(static.address)], False)


def test_nothing_secret_stays_after_the_installation() -> None:
    after = after_user_data(wish()).decode()
    assert "PRIVATE" not in after
    assert set(yaml.safe_load(after)) < set(yaml.safe_load(cloud_init_files(wish(), "A=1\n")["user-data"]))
    assert after.startswith("#cloud-config\n")


def test_each_flash_has_another_instance() -> None:
    assert new_instance("r1") != new_instance("r1")


DAMAGE: list[tuple[str, str, str, str]] = [
    ("user-data", "#cloud-config", "#cloud config", "its first line is not #cloud-config"),
    ("user-data", "hostname: r1", "hostname: r_1", "'r_1' cannot be a hostname"),
    ("user-data", "ssh_pwauth: false", "ssh_pwauth: true", "logged in to by key"),
    ("user-data", "lock_passwd: true", "lock_passwd: false", "must have no password"),
    ("user-data", "lock_passwd: true", "lock_passwd: true\n  plain_text_passwd: quack", "must have no password"),
    ("user-data", "ssh_pwauth: false", "ssh_pwauth: false\nchpasswd: {expire: false}", "passwords are not allowed"),
    ("user-data", "- ssh-ed25519 AAAA", "- ssh-ed25519AAAA", "not an SSH public key"),
    ("user-data", "name: fullswarm-admin", "name: Admin", "'Admin' cannot be a user"),
    ("user-data", "BEGIN OPENSSH PRIVATE KEY", "BEGIN SOMETHING", "not a private host key"),
    ("user-data", "/opt/fullswarm/flash/card.env", "/opt/card.env", "lacks a part of the first boot"),
    ("user-data", "runcmd:", "runcmds:", "another shape"),
    ("meta-data", "instance-id:", "instance_id:", "instance-id is missing"),
    ("network-config", "version: 2", "version: 1", "version must be 2"),
    ("network-config", 'regulatory-domain: "DE"\n', "optional: true\n", "the radio would stay off"),
    ("network-config", 'regulatory-domain: "DE"\n', 'regulatory-domain: "UK"\n', "the radio would stay off"),
    ("network-config", "dhcp4: true", "dhcp4: false", "neither DHCP nor an address"),
    ("network-config", "eth0:\n", "eth0:\n    match: {name: en*}\n", "a match breaks"),
    ("network-config", 'password: "', 'password: "x', "not 64 hexadecimal digits"),
    ("network-config", "access-points:", "access-point:", "no network to join"),
    ("network-config", "version: 2", "version: [2", "is not valid YAML"),
    ("network-config", "version: 2", "- 2", "is not"),
]


@pytest.mark.parametrize(("name", "old", "new", "says"), DAMAGE)
def test_a_seed_that_would_leave_a_robot_dark_is_refused(name: str, old: str, new: str, says: str) -> None:
    built = cloud_init_files(wish(networks=(wifi.network("lab", "passphrase"),), country="DE"), "A=1\n")
    text = built[name].decode()
    assert old in text
    with pytest.raises(ConfigError, match=re.escape(says)):
        check_cloud_init({**built, name: text.replace(old, new).encode()})


def test_a_fixed_address_without_networkd_is_refused() -> None:
    static = Static(ipaddress.IPv4Interface("10.0.0.11/24"), ipaddress.IPv4Address("10.0.0.1"))
    built = cloud_init_files(wish(static=static), "A=1\n")
    for old, new, says in (
        ("renderer: networkd", "optional: true", "becomes DHCP"),
        ("via: 10.0.0.1", "via: 10.9.0.1", "is not in its own network"),
    ):
        text = built["network-config"].decode().replace(old, new)
        with pytest.raises(ConfigError, match=says):
            check_cloud_init({**built, "network-config": text.encode()})


@settings(max_examples=40)
@given(st.sampled_from(["user-data", "meta-data", "network-config"]), st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
        st.sampled_from(["version", "users", "ethernets", "wifis", "name", "access-points", "write_files", "x"]), inner
    ),
))  # fmt: skip
def test_no_document_makes_the_rules_fail_otherwise(name: str, document: object) -> None:
    built = cloud_init_files(wish(), "A=1\n")
    text = "#cloud-config\n" + yaml.safe_dump(document)
    with pytest.raises(ConfigError):
        check_cloud_init({**built, name: text.encode()})


@pytest.mark.skipif(shutil.which("cloud-init") is None, reason="needs cloud-init's own schema: apt install cloud-init")
@pytest.mark.parametrize("static", [False, True])
def test_cloud_init_itself_finds_nothing_wrong(tmp_path: Path, static: bool) -> None:
    fixed = Static(ipaddress.IPv4Interface("10.0.0.11/24"), ipaddress.IPv4Address("10.0.0.1")) if static else None
    file = tmp_path / "user-data"
    file.write_bytes(cloud_init_files(wish(static=fixed), "A=1\n")["user-data"])
    done = subprocess.run(["cloud-init", "schema", "-c", file], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


# ---------------------------------------------------------------- names and addresses
def test_a_robots_computer_gets_a_name_that_a_network_takes() -> None:
    assert hostname_of("r1", "") == "r1"
    assert hostname_of("Lab_Robot_1", "10.0.0.11") == "lab-robot-1"
    with pytest.raises(ConfigError, match="is not a valid host name"):
        hostname_of("r_1", "")


@pytest.mark.parametrize(
    ("host", "router", "says"),
    [
        ("10.0.0.11", "10.0.0.1", "is not a router's address"),
        ("10.0.0.11", "lab/24", "is not a router's address"),
        ("r1.local", "10.0.0.1/24", "its host is 'r1.local', not an address"),
        ("", "10.0.0.1/24", "not an address"),
        ("10.0.1.11", "10.0.0.1/24", "cannot be its address"),
        ("10.0.0.1", "10.0.0.1/24", "cannot be its address"),
        ("10.0.0.255", "10.0.0.1/24", "cannot be its address"),
    ],
)
def test_fixed_addresses_that_cannot_be_are_refused(host: str, router: str, says: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(says)):
        static_of(host, router, "r1")


# ---------------------------------------------------------------- Wi-Fi
def test_a_key_is_the_one_of_the_standard() -> None:
    # IEEE 802.11i-2004, H.4.3
    assert wifi.network("IEEE", "password").key == "f42c6fc52df0ebef9ebb4b90b38a5f902e83fe1b135a70e23aed762e9710a12e"
    assert wifi.network("lab", "AB" * 32).key == "ab" * 32


@settings(max_examples=40)
@given(ssids, passphrases)
def test_every_passphrase_becomes_a_key_and_never_shows(ssid: str, passphrase: str) -> None:
    network = wifi.network(ssid, passphrase)
    assert re.fullmatch("[0-9a-f]{64}", network.key)
    assert network.key not in repr(network)


@pytest.mark.parametrize("text", ["short", "x" * 64, "with\nnewline", "naïveté-naïveté"])
def test_what_is_no_passphrase_is_refused_without_repeating_it(text: str) -> None:
    with pytest.raises(ConfigError, match="is invalid") as caught:
        wifi.network("lab", text)
    assert text not in str(caught.value)


@pytest.mark.parametrize("ssid", ["", "x" * 33, "é" * 17, "a\tb"])
def test_what_is_no_network_name_is_refused(ssid: str) -> None:
    with pytest.raises(ConfigError, match="is not a valid Wi-Fi network name"):
        wifi.network(ssid, "passphrase")


@pytest.mark.parametrize(
    ("country", "says"),
    [
        (None, "the radio stays off"),
        ("", "the radio"),
        ("UK", "the United Kingdom is GB"),
        ("Germany", "is no"),
    ],
)
def test_wifi_without_a_country_is_refused(country: str | None, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        wifi.check_country(country, wireless=True)


def test_a_cable_needs_no_country() -> None:
    assert wifi.check_country(None, wireless=False) == ""
    assert wifi.check_country("no", wireless=False) == "NO"


def test_networks_come_from_a_private_file_and_the_environment(tmp_path: Path) -> None:
    file = tmp_path / "wifi.toml"
    file.write_text('country = "de"\n[[network]]\nssid = "a"\npassphrase = "passphrase"\n[[network]]\nssid = "open"\n')
    with pytest.raises(ConfigError, match=r"others may read the passphrases in it.*chmod 600"):
        wifi.gather(file, (), None, lambda _: "")
    file.chmod(0o600)
    nets, country = wifi.gather(file, ("b",), None, lambda _: "", {wifi.PASSPHRASE: "passphrase"})
    assert ([each.ssid for each in nets], country) == (["a", "open", "b"], "DE")
    assert [bool(each.key) for each in nets] == [True, False, True]
    asked: list[str] = []
    wifi.gather(None, ("b",), "US", lambda ssid: asked.append(ssid) or "passphrase", {})  # type: ignore[func-returns-value]
    assert asked == ["b"]
    with pytest.raises(ConfigError, match="'a' is given twice"):
        wifi.gather(file, ("a",), None, lambda _: "passphrase", {})


@pytest.mark.parametrize(
    "text", ["", "[[network]]\nssid = 5\n", "[[network]]\nssid = 'a'\npsk = 'x'\n", "networks = []\n", "[[network\n"]
)
def test_a_wrong_network_file_says_what_to_write(tmp_path: Path, text: str) -> None:
    file = tmp_path / "wifi.toml"
    file.write_text(text)
    file.chmod(0o600)
    with pytest.raises(ConfigError, match=r"\[\[network\]\] ssid"):
        wifi.read_file(file)


# ---------------------------------------------------------------- without cloud-init
def test_the_command_line_stays_one_line_and_can_be_written_again() -> None:
    old = "console=tty1 root=PARTUUID=1-02 rootwait quiet init=/usr/lib/raspberrypi-sys-mods/firstboot\n"
    once = command_line(old, country="DE", run_script=True).decode()
    twice = command_line(once, country="US", run_script=True).decode()
    assert once.count("\n") == 1
    assert "systemd.run=/boot/firmware/firstrun.sh systemd.run_success_action=reboot" in once
    assert twice == once.replace("regdom=DE", "regdom=US")
    assert command_line(twice, country="", run_script=False).decode() == old
    for wrong in ("", "a\nb\n", "console=tty1\n"):
        with pytest.raises(ConfigError, match="not one line"):
            command_line(wrong, country="", run_script=False)


@given(ssids)
def test_networkmanager_reads_any_name(ssid: str) -> None:
    text = connection("x", wifi.Network(ssid, "a" * 64, hidden=True), None)
    parsed = configparser.ConfigParser(interpolation=None)
    parsed.read_string(text)
    assert bytes(int(each) for each in parsed["wifi"]["ssid"].split(";") if each) == ssid.encode()
    assert parsed["wifi-security"]["psk"] == "a" * 64


@pytest.mark.parametrize(
    ("there", "label", "kind"),
    [
        ({"user-data", "cmdline.txt"}, "bootfs", payload.CLOUD_INIT),
        ({"cmdline.txt", "config.txt"}, "bootfs", payload.FIRSTRUN),
        ({"cmdline.txt"}, "system-boot", payload.CLOUD_INIT),
        (set(), "CIDATA", payload.CLOUD_INIT),
        ({"efi/"}, "EFI", None),
    ],
)
def test_how_an_image_is_told_shows_in_its_boot_partition(there: set[str], label: str, kind: str | None) -> None:
    if kind is None:
        with pytest.raises(ConfigError, match="neither cloud-init"):
            payload.first_boot_kind(frozenset(there), label)
        assert payload.first_boot_kind(frozenset(there), label, payload.CLOUD_INIT) == payload.CLOUD_INIT
    else:
        assert payload.first_boot_kind(frozenset(there), label) == kind


@settings(max_examples=40)
@given(st.text(max_size=20))
def test_the_cards_environment_means_the_same_to_a_shell_or_is_refused(value: str) -> None:
    try:
        text = payload.card_env({"A": value})
    except ConfigError:
        return
    said = subprocess.run(["sh", "-c", f'{text}printf "%s" "$A"'], capture_output=True, text=True, check=True).stdout
    assert said == value
