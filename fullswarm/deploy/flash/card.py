"""Decides which devices may be overwritten: unmounted cards, and only those that the user confirms by serial number."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from fullswarm.errors import ConfigError

MOST_BYTES = 300_000_000_000
"""Cards are smaller; a larger device counts as a backup disk unless the user confirms."""

SYS_BLOCK = Path("/sys/block")
_SYSTEM = frozenset({"/", "/boot", "/boot/firmware", "/boot/efi", "/home", "/usr", "/var", "[SWAP]"})
_OWNED = frozenset({"crypt", "lvm", "raid0", "raid1", "raid5", "raid10", "mpath", "dm"})


@dataclass(frozen=True, slots=True)
class Card:
    """A whole block device."""

    path: str
    size_bytes: int
    model: str = ""
    serial: str = ""
    transport: str = ""  # usb, mmc, sata, nvme, …; empty: unknown
    kind: str = "disk"  # lsblk's type
    parent: str = ""  # of a partition: its disk
    removable: bool = False
    soldered: bool = False  # eMMC: lsblk calls it mmc and hot-pluggable, as it does a card in its slot
    read_only: bool = False
    mounts: tuple[tuple[str, str], ...] = ()  # device, where; its own and those of its partitions
    owners: tuple[str, ...] = ()  # encrypted volumes, RAIDs and the like on it

    @property
    def token(self) -> str:
        """What the user types to confirm that its content may be lost: its serial number, if it has one."""
        return self.serial or Path(self.path).name

    @property
    def title(self) -> str:
        """Model, serial number and size for people."""
        name = self.model or "unnamed device"
        serial = f"serial {self.serial}" if self.serial else "no serial number"
        return f"{self.path}: {name}, {serial}, {self.size_bytes / 1e9:.1f} GB"


def list_cards() -> tuple[Card, ...]:
    """Return all block devices of this machine.

    Raises
    ------
    ConfigError
        There is no lsblk, or it fails.
    """
    program = shutil.which("lsblk")
    if program is None:
        raise ConfigError("lsblk is not installed", where="flash", hint="apt install util-linux")
    done = subprocess.run([program, "-J", "-O", "-b"], capture_output=True, check=False)  # noqa: S603  (our words)
    if done.returncode != 0:
        raise ConfigError(f"lsblk fails: {done.stderr.decode('utf-8', 'replace').strip()}", where="flash")
    return parse_lsblk(done.stdout)


def parse_lsblk(text: bytes | str) -> tuple[Card, ...]:
    """Return the devices, partitions included, of the output of ``lsblk -J -O -b``."""
    document = json.loads(text)
    return tuple(card for entry in document.get("blockdevices", ()) for card in _cards(entry, entry))


def _cards(entry: dict[str, Any], disk: dict[str, Any]) -> Iterator[Card]:
    below = list(_walk(entry))
    name = _text(entry, "name")
    transport = _text(entry, "tran") or _text(disk, "tran") or ("mmc" if name.startswith("mmcblk") else "")
    yield Card(
        path=_text(entry, "path") or f"/dev/{name}",
        size_bytes=_number(entry.get("size")),
        model=" ".join(filter(None, (_text(disk, "vendor"), _text(disk, "model")))),
        serial=_text(disk, "serial"),
        transport=transport,
        kind=_text(entry, "type") or "disk",
        parent="" if entry is disk else _text(disk, "path"),
        removable=_flag(disk.get("rm")) or _flag(disk.get("hotplug")),
        soldered=_is_emmc(_text(disk, "name")),
        read_only=_flag(entry.get("ro")),
        mounts=tuple((_text(each, "path"), where) for each in below for where in _mounts(each)),
        owners=tuple(_text(each, "name") for each in below if _text(each, "type") in _OWNED),
    )
    for child in entry.get("children", ()):
        yield from _cards(child, disk)


def _is_emmc(name: str) -> bool:
    """Tell eMMC (the kernel's ``MMC``) from a card (``SD``); its boot partitions look like disks of their own."""
    disk = re.match(r"mmcblk\d+", name)
    try:
        return disk is not None and (SYS_BLOCK / disk[0] / "device/type").read_text("ascii").strip() == "MMC"
    except (OSError, ValueError):
        return False


def _walk(entry: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield entry
    for child in entry.get("children", ()):
        yield from _walk(child)


def _mounts(entry: dict[str, Any]) -> list[str]:
    places = entry.get("mountpoints") or [entry.get("mountpoint")]
    return [str(each) for each in places if each]


def _text(entry: dict[str, Any], key: str) -> str:
    return str(entry.get(key) or "").strip()


def _number(value: object) -> int:
    return int(value) if isinstance(value, int) or (isinstance(value, str) and value.isdigit()) else 0


def _flag(value: object) -> bool:
    return value in (True, 1, "1")  # older lsblk writes "1"


def choose(cards: Sequence[Card], devices: Sequence[str], most_bytes: int = MOST_BYTES) -> tuple[Card, ...]:
    """Return the cards that `devices` name, in that order; each may be overwritten.

    Raises
    ------
    ConfigError
        A device is missing, named twice, or must not be overwritten.
    """
    chosen: list[Card] = []
    for device in devices:
        path = str(Path(device).resolve()) if Path(device).is_symlink() else device
        card = next((each for each in cards if each.path == path), None)
        if card is None:
            fit = [each.title for each in cards if refusal(each, most_bytes) is None]
            there = f"cards here: {'; '.join(fit)}" if fit else "no card is plugged in that could be written"
            raise ConfigError("no such block device", where=device, hint=there)
        if why := refusal(card, most_bytes):
            what, hint = why
            raise ConfigError(f"is not written: {what}", where=card.title, hint=hint)
        if card in chosen:
            raise ConfigError("is named twice", where=device, hint="one card per robot")
        chosen.append(card)
    return tuple(chosen)


def refusal(card: Card, most_bytes: int = MOST_BYTES) -> tuple[str, str] | None:
    """Return why a device must not be overwritten and what to do about it, or None when it may be."""
    system = [where for _, where in card.mounts if where in _SYSTEM]
    if system:
        return f"this computer's system is on it ({', '.join(system)})", "plug a card in and name that"
    if card.kind == "part":
        return f"it is a partition of {card.parent}", f"name the whole card: --device {card.parent}"
    if card.kind != "disk":
        return f"it is a {card.kind} device, not a card", "to write a file use --output"
    if card.soldered:
        return "it is the eMMC of this computer, no card", "plug a card in and name that"
    if not card.removable and card.transport not in ("usb", "mmc"):
        what = f"it is built in ({card.transport or 'no USB, no card reader'})"
        return what, "plug a card in with a reader; `lsblk -o PATH,RM,TRAN,SIZE,MODEL` shows what is there"
    if card.size_bytes == 0:
        return "there is no card in the reader", "put one in"
    if card.owners:
        return f"it is part of {', '.join(card.owners)}", "it holds data; use another card"
    if card.mounts:
        devices = sorted({device for device, _ in card.mounts})
        return f"it is mounted ({', '.join(where for _, where in card.mounts)})", f"sudo umount {' '.join(devices)}"
    if card.read_only:
        return "it is write-protected", "slide the lock on the card's side up"
    if card.size_bytes > most_bytes:
        what = f"{card.size_bytes / 1e9:.0f} GB is large for a card"
        return what, f"if it really is one: --max-size {card.size_bytes // 1_000_000_000 + 1}"
    return None


def check_agreed(cards: Sequence[Card], agreed: Sequence[str]) -> tuple[Card, ...]:
    """Return the cards that are not confirmed for overwriting yet; `agreed` are serial numbers.

    Raises
    ------
    ConfigError
        A serial number is that of none of the cards.
    """
    tokens = {card.token for card in cards}
    for each in agreed:
        if each not in tokens:
            hint = f"these are: {', '.join(sorted(tokens))}; is the right card plugged in?"
            raise ConfigError(f"no chosen card has the serial number '{each}'", where="--yes", hint=hint)
    return tuple(card for card in cards if card.token not in agreed)


def same_card(card: Card) -> bool:
    """Return whether the device still is the one that was confirmed."""
    return any(msgspec.to_builtins(each) == msgspec.to_builtins(card) for each in list_cards())
