"""``fullswarm flash`` from the command line, onto files: what is written, what is refused, what it says."""

from __future__ import annotations

import gzip
import hashlib
import json
import lzma
import os
import shutil
import stat
import subprocess
from pathlib import Path

import pytest
import yaml

from fullswarm.deploy.flash import card
from fullswarm.deploy.fleet.login import Pins
from fullswarm.deploy.release.keys import public
from fullswarm.deploy.robot.support_package import RULE
from tests.unit.flash_lab import FAT, FLEET, MEGA, PI_FILES, SECRET, Lab, files_of, fsck, make_image, make_release, tool


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    made = Lab(tmp_path_factory.mktemp("base"))
    made.make()
    return made


@pytest.fixture
def lab(tmp_path: Path, first: Lab) -> Lab:
    shutil.copytree(first.folder, tmp_path / "base")
    return Lab(tmp_path / "base")


def test_a_card_holds_all_that_its_robot_needs(lab: Lab) -> None:
    result, said = lab.to_file("--wifi", "lab", "--country", "de", FULLSWARM_WIFI_PASSPHRASE=SECRET)
    assert result.exit_code == 0, result.output
    out = lab.folder / "r1.img"
    fsck(out, FAT)
    files = files_of(out)
    user, net, meta = (yaml.safe_load(files[name]) for name in ("user-data", "network-config", "meta-data"))
    assert user["hostname"] == "r1"
    assert user["users"][0]["ssh_authorized_keys"] == [public(lab.keys.fleet_key())]
    assert user["users"][0]["sudo"] == RULE
    assert user["ssh_keys"]["ed25519_private"] == lab.keys.host_key("lab", "r1").read_text()
    assert net["wifis"]["wlan0"]["regulatory-domain"] == "DE"
    assert meta["instance-id"] == said["cards"][0]["instance"]
    assert b"cfg80211.ieee80211_regdom=DE" in files["cmdline.txt"]
    assert b"systemd.run" not in files["cmdline.txt"]
    assert b"PRIVATE" not in files["fullswarm/after-user-data"]
    assert SECRET.encode() not in out.read_bytes()
    lines = files["fullswarm/card.sha256"].decode().splitlines()
    sums = {line[66:]: line[:64] for line in lines}
    assert {name: hashlib.sha256(files[f"fullswarm/{name}"]).hexdigest() for name in sums} == sums
    # what is not the boot partition is the image, byte by byte, and the result says what was written
    before, after = lab.plain.read_bytes(), out.read_bytes()
    assert (after[:MEGA], after[MEGA + FAT :]) == (before[:MEGA], before[MEGA + FAT :])
    assert said["cards"][0]["sha256"] == hashlib.sha256(after).hexdigest()
    assert said["cards"][0]["boot_partition"] == "fsck.vfat: clean"
    assert stat.S_IMODE(out.stat().st_mode) == 0o600  # a private host key is in it
    assert Pins(lab.keys.known_hosts, lab.folder).keys("r1", "10.0.0.11", 22) == [
        " ".join(public(lab.keys.host_key("lab", "r1")).split()[:2])
    ]
    assert not list(lab.folder.glob("*.partial"))


def test_two_robots_get_two_cards_from_one_image(lab: Lab) -> None:
    outs = [str(lab.folder / f"{name}.img") for name in ("a", "b")]
    result = lab.flash(
        "r1", "r2", "--target", "x86_64", "--image", str(lab.image), "--output", outs[0], "--output", outs[1], "--json"
    )
    assert result.exit_code == 0, result.output
    first, second = (files_of(Path(each)) for each in outs)
    assert [yaml.safe_load(each["user-data"])["hostname"] for each in (first, second)] == ["r1", "r2"]
    assert first["fullswarm/secret/host_key"] != second["fullswarm/secret/host_key"]
    assert first["fullswarm/release.tar.gz"] == second["fullswarm/release.tar.gz"]
    known = lab.keys.known_hosts.read_text()
    assert "10.0.0.11 ssh-ed25519" in known
    assert "r2.local ssh-ed25519" in known


def test_an_image_without_cloud_init_gets_firstrun(lab: Lab) -> None:
    bookworm = make_image(lab.folder / "old.img", PI_FILES, fat=FAT, bits=12, root=MEGA)
    out = lab.folder / "r1.img"
    words = ("--target", "x86_64", "--static", "10.0.0.1/24", "--wifi", "lab", "--country", "DE")
    result = lab.flash("r1", "--image", str(bookworm), "--output", str(out), *words, FULLSWARM_WIFI_PASSPHRASE=SECRET)
    assert result.exit_code == 0, result.output
    files = files_of(out)
    assert b"systemd.run=/boot/firmware/firstrun.sh" in files["cmdline.txt"]
    assert files["firstrun.sh"].startswith(b"#!/bin/sh")
    assert b"address1=10.0.0.11/24,10.0.0.1" in files["fullswarm/secret/wifi-1.nmconnection"]
    assert "user-data" not in files
    assert SECRET.encode() not in out.read_bytes()


def test_a_dry_run_checks_all_and_writes_no_card(lab: Lab) -> None:
    result, said = lab.to_file("--dry-run")
    assert result.exit_code == 0, result.output
    assert (said["dry_run"], said["cards"][0]["state"]) == (True, "planned")
    assert not (lab.folder / "r1.img").exists()
    assert not lab.keys.known_hosts.exists()


def test_a_second_flash_is_another_instance_with_the_same_host_key(lab: Lab) -> None:
    (_, first), (_, second) = lab.to_file(), lab.to_file()
    assert first["cards"][0]["instance"] != second["cards"][0]["instance"]
    assert first["cards"][0]["host_key"] == second["cards"][0]["host_key"]
    assert lab.keys.known_hosts.read_text().count("10.0.0.11") == 1


def test_another_computer_known_at_the_address_is_forgotten(lab: Lab) -> None:
    lab.keys.known_hosts.write_text("10.0.0.11 ssh-ed25519 AAAAold\n10.0.0.99 ssh-ed25519 AAAAother\n")
    result, _ = lab.to_file()
    assert "another host key was pinned at its address" in result.stderr
    known = lab.keys.known_hosts.read_text()
    assert "AAAAold" not in known
    assert "10.0.0.99 ssh-ed25519 AAAAother" in known


def test_seed_only_tells_a_written_card_anew(lab: Lab) -> None:
    lab.to_file()
    out = lab.folder / "r1.img"
    before = files_of(out)
    result = lab.flash(
        "r1", "--target", "x86_64", "--output", str(out), "--seed-only", "--wifi", "x", "--country", "SE",
        FULLSWARM_WIFI_PASSPHRASE="",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    fsck(out, FAT)
    after = files_of(out)
    assert after["meta-data"] != before["meta-data"]
    assert b'regulatory-domain: "SE"' in after["network-config"]
    assert out.read_bytes()[MEGA + FAT :] == lab.plain.read_bytes()[MEGA + FAT :]


def test_seed_only_fills_a_mounted_boot_partition(lab: Lab) -> None:
    boot = lab.folder / "bootfs"
    boot.mkdir()
    for name, content in PI_FILES.items():
        (boot / name).write_bytes(content)
    result = lab.flash("r1", "--target", "x86_64", "--output", str(boot), "--seed-only", "--json")
    assert result.exit_code == 0, result.output
    assert (boot / "firstrun.sh").exists()
    assert json.loads(result.stdout)["cards"][0]["first_boot"] == "firstrun"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["r9", "--output", "x.img"], "no robot 'r9' in the fleet file"),
        (["r1", "r1", "--output", "x.img", "--output", "y.img"], "is named twice"),
        (["r1"], "name either devices or files"),
        (["r1", "r2", "--output", "x.img"], "2 robots, but 1 cards"),
        (["r1", "--output", "none/x.img"], "there is no folder none"),
        (["r1", "--output", "x.img", "--release", "1.0-000000000000"], "there is no release '1.0-000000000000'"),
        (["r1", "--output", "x.img", "--sha256", "0" * 64], "its SHA-256 is"),
        (["r1", "--output", "x.img", "--wifi-file", "none.toml"], "cannot be read"),
        (["r1", "--output", "x.img", "--wifi", "lab"], "no terminal to type the passphrase"),
        (["r1", "--output", "x.img", "--static", "10.9.0.1/24"], "cannot be its address"),
        (["r2", "--output", "x.img", "--static", "10.0.0.1/24"], "not an address"),
        (["r1", "--device", "/dev/nosuchcard"], "no such block device"),
        (["r1", "--output", "x.img", "--target", "rpi-arm64"], "fullswarm bundle --target rpi-arm64"),
        ([], "robots missing"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(
    lab: Lab, words: list[str], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(lab.folder)
    target = [] if "--target" in words else ["--target", "x86_64"]
    result = lab.flash(*words, "--image", str(lab.image), *target)
    assert result.exit_code == 2, result.output
    assert says in result.stderr
    assert not (lab.folder / "x.img").exists()


def test_wifi_without_a_country_is_refused(lab: Lab) -> None:
    result, _ = lab.to_file("--wifi", "lab", FULLSWARM_WIFI_PASSPHRASE=SECRET)
    assert (result.exit_code, "--country DE" in result.stderr) == (2, True)


def test_robots_that_could_not_reach_the_hub_are_refused(lab: Lab) -> None:
    lab.fleet.write_text(FLEET.replace("10.0.0.1:7447", "127.0.0.1:7447"))
    result, _ = lab.to_file()
    assert (result.exit_code, "r1 cannot reach tcp/127.0.0.1:7447" in result.stderr) == (2, True)


def test_a_release_of_another_base_or_one_that_was_changed_is_refused(lab: Lab) -> None:
    (lab.store.folder / lab.release / "lib/thing/__init__.py").write_text("x = 2\n")
    result, _ = lab.to_file()
    assert (result.exit_code, "was changed" in result.stderr) == (2, True)
    result = lab.flash(
        "r1", "--target", "x86_64", "--image", str(lab.image), "--output", str(lab.folder / "x.img"),
        FULLSWARM_KEYS=str(lab.folder / "other"),
    )  # fmt: skip
    assert (result.exit_code, "signature" in result.stderr) == (2, True)


def test_a_python_that_the_image_has_not_is_refused(lab: Lab) -> None:
    other = lab.folder / "raspios-jammy.img"
    other.write_bytes(lab.plain.read_bytes())
    out = str(lab.folder / "x.img")
    result = lab.flash("r1", "--release", lab.release, "--image", str(other), "--output", out)
    assert (result.exit_code, "this image has 3.10" in result.stderr) == (2, True)


def test_a_card_is_written_only_when_its_serial_number_is_given(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = lab.folder / "card"
    fake.touch()
    os.truncate(fake, 40 * MEGA)
    device = card.Card(str(fake), 40 * MEGA, "Generic", "0815", "usb", removable=True)
    monkeypatch.setattr(card, "list_cards", lambda: (device,))
    words = ("r1", "--target", "x86_64", "--image", str(lab.image), "--device", str(fake))
    result = lab.flash(*words)
    assert (result.exit_code, "to confirm: --yes 0815" in result.stderr) == (2, True)
    assert fake.read_bytes() == bytes(40 * MEGA)
    assert lab.flash(*words, "--yes", "4711").exit_code == 2
    result = lab.flash(*words, "--yes", "0815")
    assert result.exit_code == 0, result.output
    assert "user-data" in files_of(fake)


def test_seed_only_does_not_speak_of_losing_everything(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.to_file()
    fake = str(lab.folder / "r1.img")
    device = card.Card(fake, 40 * MEGA, "Generic", "0815", "usb", removable=True)
    monkeypatch.setattr(card, "list_cards", lambda: (device,))
    words = ("r1", "--target", "x86_64", "--device", fake)
    erased = lab.flash(*words, "--image", str(lab.image))
    assert (erased.exit_code, "everything on it will be lost" in erased.stderr) == (2, True)
    seeded = lab.flash(*words, "--seed-only")
    assert (seeded.exit_code, "everything" in seeded.stderr) == (2, False)
    assert "its system stays, the files that tell which robot it is will be lost" in seeded.stderr
    assert "--yes 0815" in seeded.stderr


@pytest.mark.parametrize("suffix", [".gz", ".xz", ".zst"])
def test_an_image_that_ends_too_early_fails_the_cards_that_it_was_written_to(lab: Lab, suffix: str) -> None:
    packed, outs = lab.folder / f"cut.img{suffix}", [str(lab.folder / f"{name}.img") for name in ("a", "b")]
    big = lab.plain.read_bytes() + os.urandom(9 * MEGA)
    if suffix == ".zst":
        packed.write_bytes(subprocess.run([tool("zstd"), "-qc"], input=big, capture_output=True, check=True).stdout)
    else:
        packed.write_bytes(lzma.compress(big, preset=0) if suffix == ".xz" else gzip.compress(big, 1))
    os.truncate(packed, packed.stat().st_size - MEGA)
    words = ("r1", "r2", "--target", "x86_64", "--image", str(packed), "--output", outs[0], "--output", outs[1])
    result = lab.flash(*words, "--json")
    assert result.exit_code == 1, result.output
    for row, out in zip(json.loads(result.stdout)["cards"], outs, strict=True):
        assert (row["target"], row["state"]) == (out, "FAILED")
        assert "half written, not usable" in row["note"]
        assert "cut.img" in row["note"]
        assert "is damaged" in row["note"]
        assert "download it again, then flash this card again" in row["note"]
        assert not Path(out).exists()
    assert not lab.keys.known_hosts.exists()


def test_keys_that_root_has_left_are_named(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Path.exists

    def exists(path: Path) -> bool:
        if path.name == "r1_ed25519":
            raise PermissionError(13, "Permission denied", str(path))
        return real(path)

    monkeypatch.setattr(Path, "exists", exists)
    result, _ = lab.to_file()
    assert result.exit_code == 2, result.output
    assert f"{lab.keys.folder}/hosts/lab/r1_ed25519: cannot be read or written: permission denied" in result.stderr
    assert "sudo chown -R" in result.stderr


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: it gives files away")
def test_under_sudo_the_keys_are_the_users(lab: Lab) -> None:
    def owners() -> set[int]:
        return {each.lstat().st_uid for each in (lab.keys.folder, *lab.keys.folder.rglob("*"))}

    lab.to_file(SUDO_UID="4711")
    assert owners() == {0}  # nothing above the keys is that user's: they are root's own
    os.chown(lab.folder, 4711, 4711)
    lab.to_file(SUDO_UID="4711")
    assert owners() == {4711}
    assert lab.store.folder.stat().st_uid == 0


def test_a_card_that_is_too_small_is_refused(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(card, "list_cards", lambda: (card.Card("/dev/sdz", 8 * MEGA, removable=True),))
    result = lab.flash("r1", "--target", "x86_64", "--image", str(lab.image), "--device", "/dev/sdz", "--yes", "sdz")
    assert (result.exit_code, "the image needs" in result.stderr) == (2, True)


def test_an_image_without_room_is_refused(lab: Lab) -> None:
    make_release(lab.store, lab.keys, payload={"lib/big": os.urandom(9_000_000)})
    result, _ = lab.to_file()
    assert result.exit_code == 2
    assert "MB free" in result.stderr
    assert not (lab.folder / "r1.img").exists()


# ---------------------------------------------------------------- reports
def test_a_report_is_read_from_a_card(lab: Lab) -> None:
    lab.to_file()
    result = lab.flash("--report", str(lab.folder / "r1.img"))
    assert (result.exit_code, "did not reach its first boot" in result.stderr) == (2, True)
    result = lab.flash("--report", str(lab.plain))
    assert (result.exit_code, "was not written by fullswarm" in result.stderr) == (2, True)
    folder = lab.folder / "boot"
    folder.mkdir()
    for text, code in (("fullswarm, first boot of r1: OK\n", 0), ("fullswarm, first boot of r1: FAILED\n", 1)):
        (folder / "fullswarm-report.txt").write_text(text)
        result = lab.flash("--report", str(folder))
        assert (result.exit_code, result.stdout) == (code, text)
    said = json.loads(lab.flash("--report", str(folder), "--json").stdout)
    assert (said["ok"], said["report"]) == (False, "fullswarm, first boot of r1: FAILED\n")


def test_a_user_with_all_of_sudo_is_asked_for(lab: Lab) -> None:
    result, _ = lab.to_file("--full-sudo")
    assert result.exit_code == 0, result.output
    files = files_of(lab.folder / "r1.img")
    assert yaml.safe_load(files["user-data"])["users"][0]["sudo"] == "ALL=(ALL) NOPASSWD:ALL"
    assert b"SUDO=all\n" in files["fullswarm/card.env"]
