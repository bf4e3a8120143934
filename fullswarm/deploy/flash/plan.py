"""Decides and checks everything before a byte is written: request, confirmation, image, release, first boot, cards."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from fullswarm import output
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.deploy.flash import card, fat, image
from fullswarm.deploy.flash.card import Card
from fullswarm.deploy.flash.fat import HEAD_BYTES, Volume, read_partitions
from fullswarm.deploy.flash.payload import BootPartition, Shipment, Surroundings, boot_files
from fullswarm.deploy.fleet.releases import with_option
from fullswarm.deploy.release.keys import Keys, fingerprint
from fullswarm.deploy.robot.support_package import check_hub
from fullswarm.errors import ConfigError, did_you_mean

_PYTHON_OF = {"bookworm": "3.11", "trixie": "3.13", "jammy": "3.10", "noble": "3.12"}


@dataclass(frozen=True, slots=True)
class FlashRequest:
    """The options of the command line."""

    robots: tuple[str, ...]
    fleet: Path
    image: Path | None = None
    devices: tuple[str, ...] = ()
    outputs: tuple[Path, ...] = ()
    seed_only: bool = False
    release: str | None = None
    target: str = "rpi-arm64"
    wifi: tuple[str, ...] = ()
    wifi_file: Path | None = None
    country: str | None = None
    static: str | None = None
    sha256: str | None = None
    first_boot: str = "auto"
    agreed: tuple[str, ...] = ()
    most_bytes: int = card.MOST_BYTES
    wait_minutes: float | None = None
    hub: str | None = None
    full_sudo: bool = False
    dry_run: bool = False
    as_json: bool = False


@dataclass(slots=True)
class CardResult:
    """One row of the result: a robot, its card, and the outcome."""

    robot: str
    target: str
    state: str = "planned"
    note: str = ""
    details: dict[str, Any] = field(default_factory=dict)


def confirm_loss(
    targets: Sequence[Card | Path],
    agreed: Sequence[str],
    loss: str = "its system stays, the files that tell which robot it is will be lost",
) -> None:
    """Ask the user to confirm, by its serial number, that each card may lose data.

    Parameters
    ----------
    loss
        What is lost; by default what ``--seed-only`` overwrites.

    Raises
    ------
    ConfigError
        Not confirmed, or a card has changed since.
    """
    cards = [each for each in targets if isinstance(each, Card)]
    for each in card.check_agreed(cards, agreed):
        what = f"{loss}: {each.title}"
        if not sys.stdin.isatty():
            raise ConfigError(what, where=each.path, hint=f"to confirm: --yes {each.token}")
        output.progress(what)
        sys.stderr.write(f"Type {each.token} to write it: ")
        sys.stderr.flush()
        if sys.stdin.readline().strip() != each.token:
            raise ConfigError("not confirmed; nothing was written", where=each.path, hint=f"type {each.token}")
    for each in cards:
        if not card.same_card(each):
            raise ConfigError("has changed since it was confirmed", where=each.path, hint="start again")


# ---------------------------------------------------------------- what is written
@dataclass(frozen=True, slots=True)
class Prepared:
    """One robot's boot partition, edited and checked, in a file of its own."""

    robot: str
    volume: Volume
    edited: Path
    details: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Source:
    """The head of an image: everything up to the end of its boot partition, decompressed."""

    disk: Path
    volume: Volume
    least_bytes: int  # end of its last partition


def robots_of(config: SwarmConfig, names: Sequence[str]) -> tuple[RobotConfig, ...]:
    """Return the robots that are named.

    Raises
    ------
    ConfigError
        There is no such robot, it is simulated, or named twice; or robots could not reach the hub.
    """
    robots = {each.id: each for each in config.robot}
    found = []
    for name in names:
        if name not in robots:
            raise ConfigError(f"no robot '{name}' in the fleet file", where="flash", hint=did_you_mean(name, robots))
        if names.count(name) > 1:
            raise ConfigError("is named twice", where=f"robot {name}", hint="one card per robot")
        if robots[name].simulated and not robots[name].host:
            hint = f'a computer of its own needs its driver: driver = "create:///dev/…" under [[robot]] {name}'
            raise ConfigError("is simulated: there is nothing to flash", where=f"robot {name}", hint=hint)
        check_hub(robots[name], config)
        found.append(robots[name])
    return tuple(found)


def release_for(
    release: str | None, target: str, picture: Path | None, keys: Keys, extras: frozenset[str] = frozenset()
) -> Shipment:
    """Return the release that goes onto the cards, verified with the keys of this base; `extras`: what robots need.

    Raises
    ------
    ConfigError
        There is none, it is signed on another base, or was changed; it is for another Python than the image's, or lacks
        what the robots need.
    """
    from fullswarm.deploy.release.keys import verify_release
    from fullswarm.deploy.release.manifest import Manifest
    from fullswarm.deploy.release.store import Store

    store = Store.default()
    name = "" if picture is None else picture.name.lower()
    python = next((minor for codename, minor in _PYTHON_OF.items() if codename in name), None)
    folder = store.latest(target, python) if release is None else store.get(release)
    option = (f" --python {python}" if python else "") + with_option(extras)
    if folder is None:
        what = f"there is no release for {target}" + (f" and Python {python}, as this image has it" if python else "")
        raise ConfigError(what, where=str(store.folder), hint=f"fullswarm bundle --target {target}{option}")
    verify_release(folder, keys.allowed_signers())
    shipment = Shipment.pack(folder)
    if python is not None and shipment.python != python:
        hint = f"fullswarm bundle --target {target}{option}"
        what = f"is for Python {shipment.python}; this image has {python}"
        raise ConfigError(what, where=f"release {shipment.id}", hint=hint)
    if python is None and picture is not None:
        output.progress(f"image: its Python is unknown from its name; this release needs {shipment.python}")
    if lacking := extras - set(Manifest.read(folder).extras):
        hint = f"fullswarm bundle --target {target} --python {shipment.python}{with_option(extras)}"
        what = f"lacks what its robots' agents need: {', '.join(sorted(lacking))}"
        raise ConfigError(what, where=f"release {shipment.id}", hint=hint)
    return shipment


def read_head(picture: Path, folder: Path, report: image.Report) -> Source:
    """Decompress what comes before the end of the boot partition into `folder`.

    Raises
    ------
    ConfigError
        The image is damaged, or a robot cannot boot from it.
    """
    disk = folder / "head.img"
    image.copy_head(picture, HEAD_BYTES, disk)
    head = disk.read_bytes()
    partitions = read_partitions(head, str(picture))
    # The boot partition is one of the first; what follows is large and is read only once, for the cards.
    for upto in sorted({each.end_bytes for each in partitions}):
        there = image.copy_head(picture, upto, disk, report)
        if there < upto:
            what = f"ends after {there / 1e6:.0f} MB, within partition data that goes to {upto / 1e6:.0f} MB"
            raise ConfigError(what, where=str(picture), hint="download it again")
        volume = _boot_of(disk, str(picture), last=upto == max(each.end_bytes for each in partitions))
        if volume is not None:
            return Source(disk, volume, max(each.end_bytes for each in partitions))
    raise AssertionError("the last partition has returned or raised")


def _boot_of(disk: Path, where: str, *, last: bool) -> Volume | None:
    number = os.open(disk, os.O_RDONLY | os.O_CLOEXEC)
    try:
        volume = fat.boot_volume(number, where)
        # One without a usual name, such as an EFI system partition, is chosen only when no other follows.
        return volume if last or volume.label.lower() in fat.BOOT_LABELS else None
    except ConfigError:
        if last:
            raise
        return None
    finally:
        os.close(number)


def prepare(
    robot: RobotConfig, around: Surroundings, keys: Keys, shipment: Shipment, source: Source, wanted: str
) -> Prepared:
    """Edit a copy of the boot partition for one robot, and check it with fsck.vfat.

    Raises
    ------
    ConfigError
        The first-boot configuration is not sound, the partition has no room, or the result is not a sound FAT.
    """
    partition = BootPartition.of_disk(source.disk, source.volume)
    files, instance, kind = boot_files(robot, around, keys, shipment, partition, wanted)
    fat.check_room(source.volume, files, f"image for {robot.id}")
    edited = source.disk.with_name(f"{robot.id}.fat")
    edited.touch(mode=0o600)
    fat.copy_range(source.disk, source.volume.start_bytes, source.volume.size_bytes, edited)
    alone = replace(source.volume, start_bytes=0)
    fat.put_files(edited, alone, files)
    details = details_of(robot, around, keys, shipment, instance, kind, fat.fsck(edited, alone))
    return Prepared(robot.id, source.volume, edited, details)


def details_of(
    robot: RobotConfig, around: Surroundings, keys: Keys, shipment: Shipment, instance: str, kind: str, fsck: str
) -> dict[str, Any]:
    """Return what the result says about a robot's boot partition; `fsck`: how fsck.vfat found it."""
    return {
        "instance": instance,
        "host_key": fingerprint(keys.host_key(around.config.swarm, robot.id)),
        "first_boot": kind,
        "boot_partition": fsck,
        "release": shipment.id,
        "wifi": [network.ssid for network in around.networks],
    }
