"""All that goes onto the boot partition of one robot's card."""

from __future__ import annotations

import hashlib
import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.deploy.flash.first_boot import (
    FirstBoot,
    Static,
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
class Access:
    """How a robot is entered, and how it shows that it is itself."""

    login_keys: tuple[str, ...]  # public
    host_private: str = field(repr=False)
    host_public: str
    signers: str  # whose releases it takes


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What all robots of one command share."""

    config: SwarmConfig
    networks: tuple[Network, ...] = ()
    country: str = ""
    router: str | None = None  # 10.0.0.1/24: fixed addresses


def wish_for(robot: RobotConfig, access: Access, around: Surroundings) -> FirstBoot:
    """Return what a robot is told, with a fresh instance id.

    Raises
    ------
    ConfigError
        Its name, user or address cannot be.
    """
    if not valid_user(robot.ssh_user):
        hint = "a plain Linux login: a-z, 0-9, '-' and '_'"
        raise ConfigError(f"'{robot.ssh_user}' cannot be a user", where=f"robot {robot.id}: ssh_user", hint=hint)
    static: Static | None = static_of(robot.host, around.router, robot.id)
    return FirstBoot(
        robot=robot.id,
        hostname=hostname_of(robot.id, robot.host),
        user=robot.ssh_user,
        login_keys=access.login_keys,
        host_private=access.host_private,
        host_public=access.host_public,
        networks=around.networks,
        country=around.country,
        static=static,
        instance=new_instance(robot.id),
    )


def first_boot_kind(there: frozenset[str], label: str, wanted: str = "auto") -> str:
    """Return how the image is set up on its first boot, by what its boot partition holds.

    Raises
    ------
    ConfigError
        It shows neither way.
    """
    if wanted != "auto":
        return wanted
    if there & {"user-data", "meta-data"} or label.lower() in ("cidata", "system-boot"):
        return CLOUD_INIT
    if "cmdline.txt" in there:
        return FIRSTRUN
    what = f"its boot partition '{label}' knows neither cloud-init (user-data) nor Raspberry Pi's cmdline.txt"
    hint = "use Raspberry Pi OS or Ubuntu for Raspberry Pi; --first-boot cloud-init if you know that it has it"
    raise ConfigError(what, where="image", hint=hint)


def build(
    kind: str,
    wish: FirstBoot,
    access: Access,
    shipment: Shipment,
    kit: bytes,
    hub: str,
    volume_id: str,
    read: Callable[[str], bytes | None],
) -> dict[str, bytes]:
    """Return the files by their path in the boot partition; `read` gives what is there now.

    Raises
    ------
    ConfigError
        The seed is not sound, or the partition lacks what Raspberry Pi's first boot needs.
    """
    environment = card_env(
        {
            "ROBOT": wish.robot,
            "NAME": wish.hostname,
            "ADMIN": wish.user,
            "COUNTRY": wish.country,
            "HUB": hub,
            "RELEASE": shipment.id,
            "FILES": str(shipment.files),
            "BYTES": str(shipment.size_bytes),
            "VOLUME": volume_id,
            "INSTANCE": wish.instance,
        }
    )
    large = {"kit.tar": kit, "head.tar": shipment.head, "release.tar.gz": shipment.body}
    sums = "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in large.items())
    files = {
        **{f"{FOLDER}/{name}": content for name, content in large.items()},
        f"{FOLDER}/card.sha256": sums.encode(),
        f"{FOLDER}/card.env": environment.encode(),
        f"{FOLDER}/secret/host_key": access.host_private.encode(),
        f"{FOLDER}/secret/host_key.pub": f"{access.host_public}\n".encode(),
    }
    line = read("cmdline.txt")
    checked = cloud_init_files(wish, environment)  # firstrun.sh says the same in other words: the same rules hold
    if kind == CLOUD_INIT:
        files |= checked
        files[f"{FOLDER}/after-user-data"] = after_user_data(wish)
        if line is not None:
            text = command_line(line.decode("utf-8", "replace"), country=wish.country, run_script=False)
            files |= {"cmdline.txt": text, "ssh": b""}  # an empty `ssh` switches its server on, on Raspberry Pi OS
        return files
    if line is None:
        raise ConfigError("its boot partition has no cmdline.txt", where="image", hint="use --first-boot cloud-init")
    return files | firstrun_files(wish, {"cmdline.txt": line})


def card_env(values: Mapping[str, str]) -> str:
    """Return a file that a shell can read: ``NAME=word`` lines of plain words.

    Raises
    ------
    ConfigError
        A value is no plain word.
    """
    for name, value in values.items():
        if not _PLAIN.match(value):
            raise ConfigError(f"{name} '{value}' is no plain word", where="card", hint="letters, digits and ./:@%+-")
    return "".join(f"{name}={shlex.quote(value)}\n" for name, value in values.items())
