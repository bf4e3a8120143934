"""`fullswarm flash --seed-only`: a card, an image or a mounted boot partition is told anew what robot it is."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from fullswarm.config import RobotConfig
from fullswarm.deploy.flash import mtools, payload, plan
from fullswarm.deploy.flash.card import Card
from fullswarm.deploy.flash.fat import Volume, boot_volume
from fullswarm.deploy.flash.order import Line, Request, agree
from fullswarm.deploy.flash.payload import Shipment, Surroundings
from fullswarm.deploy.flash.write import explain
from fullswarm.deploy.release.keys import Keys, fingerprint
from fullswarm.errors import ConfigError


def run(
    request: Request,
    robots: Sequence[RobotConfig],
    targets: Sequence[Card | Path],
    around: Surroundings,
    keys: Keys,
    shipment: Shipment,
    begin: Callable[[], None],
) -> list[Line]:
    """Write the robots' files over those of their boot partitions, in place; `begin` is called before the first.

    Raises
    ------
    ConfigError
        Anything is wrong; partitions before the one named may have been written then.
    """
    work = [_Place.of(robot, target) for robot, target in zip(robots, targets, strict=True)]
    built = [place.build(around, keys, shipment, request.first_boot) for place in work]
    if not request.dry_run:
        agree(targets, request.agreed)
        begin()
    lines = []
    for place, (files, instance, kind) in zip(work, built, strict=True):
        judged = "" if request.dry_run else place.put(files)
        robot = place.robot.id
        state = "planned" if request.dry_run else "seeded"
        details = {
            "instance": instance,
            "host_key": fingerprint(keys.host_key(around.config.swarm, robot)),
            "first_boot": kind,
            "boot_partition": judged,
            "release": shipment.id,
            "wifi": [network.ssid for network in around.networks],
        }
        lines.append(Line(robot, place.title, state, "" if request.dry_run else judged, details))
    return lines


class _Place:
    """A boot partition: in a disk, or as a mounted folder."""

    def __init__(self, robot: RobotConfig, path: Path, title: str, volume: Volume | None) -> None:
        self.robot, self.path, self.title, self._volume = robot, path, title, volume

    @classmethod
    def of(cls, robot: RobotConfig, target: Card | Path) -> _Place:
        path = Path(target.path) if isinstance(target, Card) else target
        title = target.title if isinstance(target, Card) else str(target)
        if path.is_dir():
            return cls(robot, path, title, None)
        try:
            number = os.open(path, os.O_RDWR | os.O_CLOEXEC | (os.O_EXCL if path.is_block_device() else 0))
        except OSError as error:
            raise explain(error, path, 0) from error
        try:
            return cls(robot, path, title, boot_volume(number, str(path)))
        finally:
            os.close(number)

    def build(
        self, around: Surroundings, keys: Keys, shipment: Shipment, wanted: str
    ) -> tuple[dict[str, bytes], str, str]:
        """Return the files, checked for room; the instance id; how the first boot is told."""
        if self._volume is None:
            return self._for_folder(around, keys, shipment, wanted)
        made = plan.seed_files(self.robot, around, keys, shipment, self.path, self._volume, wanted)
        old = sum(len(mtools.get(self.path, self._volume, name) or b"") for name in made[0])
        roomy = replace(self._volume, free_bytes=self._volume.free_bytes + old)  # what is overwritten makes room
        mtools.check_room(roomy, made[0], str(self.path))
        return made

    def _for_folder(
        self, around: Surroundings, keys: Keys, shipment: Shipment, wanted: str
    ) -> tuple[dict[str, bytes], str, str]:
        from fullswarm.deploy.robot.support_package import support_package

        there = frozenset(each.name.lower() for each in self.path.iterdir())
        access = plan.access_for(self.robot, around.config.swarm, keys)
        wish = payload.wish_for(self.robot, access, around)
        kind = payload.first_boot_kind(there, self.path.name, wanted)
        tool = support_package(self.robot, around.config, access.signers)
        hub = around.config.hub.endpoint

        def read(name: str) -> bytes | None:
            file = self.path / name
            return file.read_bytes() if file.is_file() else None

        return payload.build(kind, wish, access, shipment, tool, hub, "", read), wish.instance, kind

    def put(self, files: dict[str, bytes]) -> str:
        """Write; return how the partition was judged."""
        if self._volume is not None:
            mtools.put(self.path, self._volume, files)
            with self.path.open("rb") as disk:
                os.fsync(disk.fileno())
            return mtools.fsck(self.path, self._volume)
        for name, content in files.items():
            target = self.path / name
            try:
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("wb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
            except OSError as error:
                raise explain(error, target, 0) from error
            if target.read_bytes() != content:
                raise ConfigError("reads back different from what was written", where=str(target), hint="another card")
        return f"{len(files)} files written; unmount it before you pull the card out"
