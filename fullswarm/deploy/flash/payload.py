"""Builds all files that go onto the boot partition of one robot's card."""

from __future__ import annotations

import hashlib
import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from fullswarm.clock import wall_time_s
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.deploy.flash import fat
from fullswarm.deploy.flash.fat import Volume
from fullswarm.deploy.flash.first_boot import (
    FirstBoot,
    after_user_data,
    cloud_init_files,
    command_line,
    firstrun_files,
    hostname_of,
    new_instance,
    static_of,
    valid_user,
)
from fullswarm.deploy.flash.wifi import Network
from fullswarm.deploy.release.keys import Keys, public
from fullswarm.errors import ConfigError

FOLDER = "fullswarm"
CLOUD_INIT, FIRSTRUN = "cloud-init", "firstrun"
REPORT = "fullswarm-report.txt"
_PLAIN = re.compile(r"[A-Za-z0-9_./:@%+\[\]-]*\Z")


@dataclass(frozen=True, slots=True)
class Shipment:
    """A signed release, packed for cards: the same for all robots."""

    id: str
    head: bytes = field(repr=False)  # manifest and signature, for `fullswarm-robot want`
    body: bytes = field(repr=False)  # gzipped tar of all other files, for `fullswarm-robot receive`
    files: int  # in `body`
    size_bytes: int  # unpacked
    python: str  # major.minor it runs on

    @classmethod
    def pack(cls, folder: Path) -> Shipment:
        """Pack a release."""
        from fullswarm.deploy.release import manifest
        from fullswarm.deploy.release.store import HEAD, gzipped_archive, head_archive

        facts = manifest.Manifest.read(folder)
        paths = [path for path in manifest.read_sums(folder) if path not in HEAD]
        size = sum((folder / path).stat().st_size for path in paths)
        body = b"".join(gzipped_archive(folder, paths))
        return cls(facts.id, head_archive(folder), body, len(paths), size, facts.target.python)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What all robots of one command share."""

    config: SwarmConfig
    networks: tuple[Network, ...] = ()
    country: str = ""
    router: str | None = None  # 10.0.0.1/24: fixed addresses
    full_sudo: bool = False


@dataclass(frozen=True, slots=True)
class BootPartition:
    """What a boot partition holds before it is written; `read` returns a file of it, None: it has none."""

    label: str
    volume_id: str  # empty: not known
    names: frozenset[str]
    read: Callable[[str], bytes | None]

    @classmethod
    def of_disk(cls, disk: Path, volume: Volume) -> BootPartition:
        """Return that of a disk or an image."""
        names = fat.file_names(disk, volume)
        return cls(volume.label, volume.volume_id, names, lambda path: fat.get_file(disk, volume, path))

    @classmethod
    def of_folder(cls, folder: Path) -> BootPartition:
        """Return that which is mounted at a folder."""

        def read(name: str) -> bytes | None:
            file = folder / name
            return file.read_bytes() if file.is_file() else None

        return cls(folder.name, "", frozenset(each.name.lower() for each in folder.iterdir()), read)


def first_boot_of(robot: RobotConfig, keys: Keys, around: Surroundings) -> FirstBoot:
    """Return a robot's first-boot configuration, with a fresh instance id.

    Its host key is made here, so that there is no trust on first use.

    Raises
    ------
    ConfigError
        Its name, user or address is invalid.
    """
    if not valid_user(robot.ssh_user):
        hint = "a plain Linux login: a-z, 0-9, '-' and '_'"
        raise ConfigError(f"invalid user '{robot.ssh_user}'", where=f"robot {robot.id}: ssh_user", hint=hint)
    host_key = keys.host_key(around.config.swarm, robot.id)
    return FirstBoot(
        robot=robot.id,
        hostname=hostname_of(robot.id, robot.host),
        user=robot.ssh_user,
        login_keys=(public(keys.fleet_key()),),
        host_private=host_key.read_text("utf-8"),
        host_public=public(host_key),
        networks=around.networks,
        country=around.country,
        static=static_of(robot.host, around.router, robot.id),
        instance=new_instance(robot.id),
        full_sudo=around.full_sudo,
    )


def first_boot_kind(there: frozenset[str], label: str, wanted: str = "auto") -> str:
    """Return how the image is set up on its first boot, by what its boot partition holds.

    Raises
    ------
    ConfigError
        It supports neither kind.
    """
    if wanted != "auto":
        return wanted
    if there & {"user-data", "meta-data"} or label.lower() in ("cidata", "system-boot"):
        return CLOUD_INIT
    if "cmdline.txt" in there:
        return FIRSTRUN
    what = f"its boot partition '{label}' has neither cloud-init's user-data nor Raspberry Pi's cmdline.txt"
    hint = "use Raspberry Pi OS or Ubuntu for Raspberry Pi; --first-boot cloud-init if you know that it has it"
    raise ConfigError(what, where="image", hint=hint)


def boot_files(
    robot: RobotConfig, around: Surroundings, keys: Keys, shipment: Shipment, partition: BootPartition, wanted: str
) -> tuple[dict[str, bytes], str, str]:
    """Return the files for a robot's boot partition by their path, the instance id, and the kind of first boot.

    Raises
    ------
    ConfigError
        The configuration is not sound, or the partition lacks what Raspberry Pi's first boot needs.
    """
    from fullswarm.deploy.robot.support_package import robot_credentials, support_package

    boot = first_boot_of(robot, keys, around)
    kind = first_boot_kind(partition.names, partition.label, wanted)
    environment = card_env(
        {
            "ROBOT": boot.robot,
            "NAME": boot.hostname,
            "ADMIN": boot.user,
            "COUNTRY": boot.country,
            "SUDO": "all" if boot.full_sudo else "robot",
            "HUB": around.config.hub.endpoint,
            "RELEASE": shipment.id,
            "FILES": str(shipment.files),
            "BYTES": str(shipment.size_bytes),
            "VOLUME": partition.volume_id,
            "INSTANCE": boot.instance,
        }
    )
    credentials = robot_credentials(robot, around.config, wall_time_s())
    package = support_package(robot, around.config, keys.roots()[-1], credentials=credentials)
    large = {"kit.tar": package, "head.tar": shipment.head, "release.tar.gz": shipment.body}
    sums = "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in large.items())
    files = {
        **{f"{FOLDER}/{name}": content for name, content in large.items()},
        f"{FOLDER}/card.sha256": sums.encode(),
        f"{FOLDER}/card.env": environment.encode(),
        f"{FOLDER}/secret/host_key": boot.host_private.encode(),
        f"{FOLDER}/secret/host_key.pub": f"{boot.host_public}\n".encode(),
    }
    line = partition.read("cmdline.txt")
    cloud_init = cloud_init_files(boot, environment)  # checked for firstrun.sh as well: the same rules hold
    if kind == CLOUD_INIT:
        files |= cloud_init
        files[f"{FOLDER}/after-user-data"] = after_user_data(boot)
        if line is not None:
            text = command_line(line.decode("utf-8", "replace"), country=boot.country, run_script=False)
            files |= {"cmdline.txt": text, "ssh": b""}  # an empty `ssh` switches its server on, on Raspberry Pi OS
    elif line is None:
        raise ConfigError("its boot partition has no cmdline.txt", where="image", hint="use --first-boot cloud-init")
    else:
        files |= firstrun_files(boot, {"cmdline.txt": line})
    return files, boot.instance, kind


def card_env(values: Mapping[str, str]) -> str:
    """Return a file that a shell can read: ``NAME=word`` lines of plain words.

    Raises
    ------
    ConfigError
        A value has other characters.
    """
    for name, value in values.items():
        if not _PLAIN.match(value):
            raise ConfigError(f"{name} '{value}' is not a plain word", where="card", hint="letters, digits and ./:@%+-")
    return "".join(f"{name}={shlex.quote(value)}\n" for name, value in values.items())
