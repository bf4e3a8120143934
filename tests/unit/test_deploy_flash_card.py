"""Which devices may be overwritten: lsblk's own words in, a verdict with a reason out."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.deploy.flash import card
from fullswarm.errors import ConfigError
from tests.unit.flash_lab import tool

GB = 1_000_000_000


def entry(name: str, **facts: Any) -> dict[str, Any]:
    """Return a device as `lsblk -J -O -b` of util-linux 2.38 prints it, without the columns nobody reads."""
    plain = {
        "name": name,
        "path": f"/dev/{name}",
        "size": 31_914_983_424,
        "type": "disk",
        "rm": True,
        "hotplug": True,
        "ro": False,
        "model": "STORAGE DEVICE",
        "vendor": "Generic ",
        "serial": "000000000821",
        "tran": "usb",
        "mountpoint": None,
        "mountpoints": [None],
    }
    return {**plain, **facts}


def part(name: str, *mounts: str | None, kind: str = "part", **facts: Any) -> dict[str, Any]:
    places = {"mountpoint": mounts[0] if mounts else None, "mountpoints": list(mounts) or [None]}
    return entry(name, type=kind, tran=None, model=None, vendor=None, serial=None, **places, **facts)


LAPTOP = entry(
    "nvme0n1", rm=False, hotplug=False, tran="nvme", model="SAMSUNG MZVL2512", vendor=None, serial="S64KNX0T",
    size=512_110_190_592,
    children=[
        part("nvme0n1p1", "/boot/efi"),
        part("nvme0n1p2", children=[part("luks-1", kind="crypt", children=[part("vg-root", "/", kind="lvm")])]),
    ],
)  # fmt: skip
CARD = entry("sdb", children=[part("sdb1"), part("sdb2")])
SLOT = entry("mmcblk0", rm=False, hotplug=False, tran=None, model=None, vendor=None, serial="0x9a1f", children=[])
TABLE = [
    (CARD, "/dev/sdb", None, None),
    (SLOT, "/dev/mmcblk0", None, None),
    (LAPTOP, "/dev/nvme0n1", "this computer's system is on it (/boot/efi, /)", "plug a card in"),
    (CARD, "/dev/sdb1", "it is a partition of /dev/sdb", "--device /dev/sdb"),
    (
        entry("sdb", children=[part("sdb1", "/media/ann/bootfs"), part("sdb2", "/media/ann/rootfs")]),
        "/dev/sdb",
        "it is mounted (/media/ann/bootfs, /media/ann/rootfs)",
        "sudo umount /dev/sdb1 /dev/sdb2",
    ),
    (entry("sdb", mountpoint="/mnt", mountpoints=["/mnt"]), "/dev/sdb", "mounted (/mnt)", "sudo umount /dev/sdb"),
    (entry("sdb", rm="1", hotplug="1", ro="1"), "/dev/sdb", "write-protected", "slide the lock"),
    (entry("sdb", size=0), "/dev/sdb", "no card in the reader", "put one in"),
    (entry("sdb", size=2000 * GB), "/dev/sdb", "2000 GB is large for a card", "--max-size 2001"),
    (
        entry("sda", rm=False, hotplug=False, tran="sata", children=[part("sda1")]),
        "/dev/sda",
        "it is built in (sata)",
        "plug a card in with a reader",
    ),
    (
        entry("vda", rm=False, hotplug=False, tran=None, serial=None, children=[]),
        "/dev/vda",
        "it is built in (no USB, no card reader)",
        "plug a card in with a reader",
    ),
    (
        entry("sdb", children=[part("sdb1", children=[part("luks-2", kind="crypt")])]),
        "/dev/sdb",
        "it is part of luks-2",
        "it holds data",
    ),
    (
        entry("sdb", children=[part("sdb1", children=[part("backup", "/backup", kind="crypt")])]),
        "/dev/sdb",
        "it is part of backup",
        "it holds data",
    ),
    (entry("loop0", type="loop", rm=False, hotplug=False, tran=None), "/dev/loop0", "a loop device", "--output"),
    (entry("sdb", children=[part("sdb1", "[SWAP]")]), "/dev/sdb", "this computer's system is on it ([SWAP])", "plug"),
    # a Raspberry Pi that flashes another one must not write the card it runs from itself
    (
        entry("mmcblk0", rm=False, tran=None, children=[part("mmcblk0p1", "/boot/firmware"), part("mmcblk0p2", "/")]),
        "/dev/mmcblk0",
        "this computer's system is on it (/boot/firmware, /)",
        "plug a card in",
    ),
    (CARD, "/dev/sdz", "no such block device", "cards here: /dev/sdb: Generic STORAGE DEVICE, serial 000000000821"),
    (LAPTOP, "/dev/sdz", "no such block device", "no card is plugged in"),
]  # fmt: skip


@pytest.mark.parametrize(("device", "name", "why", "mend"), TABLE)
def test_a_device_is_taken_or_refused_with_a_reason_and_a_remedy(
    device: dict[str, Any], name: str, why: str | None, mend: str | None
) -> None:
    cards = card.parse_lsblk(json.dumps({"blockdevices": [device]}))
    if why is None:
        assert [each.path for each in card.choose(cards, [name])] == [name]
        return
    with pytest.raises(ConfigError) as caught:
        card.choose(cards, [name])
    assert why in caught.value.what
    assert mend is not None
    assert mend in caught.value.hint


@settings(max_examples=50)
@given(
    st.sampled_from(["rm", "tran", "mountpoints", "ro", "size", "type", "children"]),
    st.one_of(st.none(), st.booleans(), st.integers(), st.text(max_size=5)),
)
def test_what_mounts_the_system_is_never_taken_whatever_else_lsblk_says(column: str, value: object) -> None:
    raw = {**LAPTOP, "rm": True, "hotplug": True, "tran": "usb", "size": 8 * GB}
    if column not in ("children", "mountpoints"):
        raw[column] = value
    for each in card.parse_lsblk(json.dumps({"blockdevices": [raw]})):
        if each.kind == "disk" and each.mounts:
            assert card.refusal(each) is not None


@pytest.mark.parametrize(("kind", "why"), [("MMC", "eMMC of this computer"), ("SD", None), (None, None)])
@pytest.mark.parametrize("name", ["mmcblk1", "mmcblk1boot0"])
def test_soldered_memory_is_no_card_though_lsblk_says_it_is_removable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str | None, why: str | None, name: str
) -> None:
    monkeypatch.setattr(card, "SYS_BLOCK", tmp_path)
    if kind is not None:
        (tmp_path / "mmcblk1/device").mkdir(parents=True)
        (tmp_path / "mmcblk1/device/type").write_text(f"{kind}\n")
    (found,) = card.parse_lsblk(json.dumps({"blockdevices": [entry(name, rm=False, tran=None)]}))
    refused = card.refusal(found)
    assert (refused is None) == (why is None)
    assert refused is None or (why or "") in refused[0]


def test_a_large_card_is_taken_when_somebody_says_so() -> None:
    cards = card.parse_lsblk(json.dumps({"blockdevices": [entry("sdb", size=1000 * GB)]}))
    assert card.choose(cards, ["/dev/sdb"], 1001 * GB)


def test_one_card_is_not_for_two_robots() -> None:
    cards = card.parse_lsblk(json.dumps({"blockdevices": [CARD]}))
    with pytest.raises(ConfigError, match="named twice"):
        card.choose(cards, ["/dev/sdb", "/dev/sdb"])


def test_only_a_serial_number_of_a_chosen_card_is_consent() -> None:
    cards = card.parse_lsblk(json.dumps({"blockdevices": [entry("sdb"), entry("sdc", serial=None)]}))
    assert [each.path for each in card.check_agreed(cards, ["000000000821"])] == ["/dev/sdc"]
    assert card.check_agreed(cards, ["000000000821", "sdc"]) == ()
    assert "no serial number" in cards[1].title
    with pytest.raises(ConfigError, match=r"no chosen card has the serial number '4711'.*000000000821, sdc"):
        card.check_agreed(cards, ["4711"])


def test_this_machines_own_devices_are_understood() -> None:
    raw = subprocess.run([tool("lsblk"), "-J", "-O", "-b"], capture_output=True, check=True).stdout
    names = {each["path"] for each in json.loads(raw)["blockdevices"]}
    cards = card.list_cards()
    assert names <= {each.path for each in cards}
    for each in cards:
        if "/" in [where for _, where in each.mounts]:
            assert card.refusal(each) is not None
