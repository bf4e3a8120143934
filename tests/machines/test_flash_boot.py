"""From an image to a robot that drives: `fullswarm flash`, a first boot without internet, a base, a Create."""

from __future__ import annotations

import gzip
import hashlib
import io
import sys
import tarfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from fullswarm.deploy.flash import fat
from fullswarm.deploy.flash.result import read_report
from fullswarm.errors import ConfigError
from tests.machines.base import INSIDE, ROBOT, SWARM, Base
from tests.machines.card_image import Image, card_image
from tests.machines.machine import booted
from tests.machines.needs import require
from tests.machines.watch import Watch

pytestmark = pytest.mark.slow
TUNNEL = Path(__file__).with_name("tunnel.py")
LIMIT_S = 1800.0
"""From power-on: two minutes of a processor's time, on a machine that may have other work."""
FORWARD_M = 0.2
Tell = Callable[[str], None]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Base]:
    require("mmdebstrap", "qemu-system-x86_64", "mke2fs", "sfdisk", "mkfs.vfat", "mcopy", "ssh-keygen")
    with Base(tmp_path_factory.mktemp("card")) as made:
        made.bundle()
        yield made


@pytest.fixture(scope="module")
def image(base: Base) -> Image:
    return card_image()


def flashed(base: Base, image: Image, name: str) -> Path:
    card = base.folder / f"{name}.img"
    base.run("flash", ROBOT, "--fleet", base.fleet, "--image", image.disk, "--output", card, "--target", "x86_64")
    return card


def hardware(base: Base, card: Path) -> Sequence[str]:
    """The card, the robot on the second serial port, and a network that ends at the base's hub."""
    tunnel = f"guestfwd=tcp:{INSIDE[0]}:{INSIDE[1]}-cmd:{sys.executable} {TUNNEL} {base.port}"
    return (
        "-drive", f"file={card},format=raw,if=virtio,cache=unsafe",
        "-chardev", f"serial,id=robot,path={Path(base.robot.port).resolve()}", "-serial", "chardev:robot",
        "-netdev", f"user,id=lan,restrict=on,{tunnel}", "-device", "virtio-net-pci,netdev=lan",
        "-device", "virtio-rng-pci",
    )  # fmt: skip


def told(card: Path) -> str:
    """What the first boot has left on the card; empty: nothing yet."""
    try:
        return read_report(card)
    except ConfigError:
        return ""


def test_a_flashed_card_boots_installs_itself_offline_and_drives(base: Base, image: Image, tell: Tell) -> None:
    card = flashed(base, image, "good")
    with Watch(base.hub, SWARM, ROBOT) as watch, booted(
        base.folder, image.kernel, image.initramfs, options=hardware(base, card), live=True
    ) as machine:  # fmt: skip
        there_s = watch.until(lambda: watch.lifecycle == "READY", "READY", LIMIT_S, machine.story)
        watch.until(lambda: '"READY"' in base.run("status", "--json", code=None), "in status", LIMIT_S, machine.story)
        base.run("request", "move_to_goal", "--set", "goal=1,0", "--robots", ROBOT)
        moved_s = watch.until(lambda: base.robot.body.state().x_m > FORWARD_M, "it moves", LIMIT_S, machine.story)
        base.run("stop")
        watch.until(lambda: base.robot.body.state().speed_m_s == 0.0, "it stops", LIMIT_S, machine.story)
        watch.until(lambda: bool(told(card)), "the report on the card", LIMIT_S, machine.story)
    tell(f"card: READY {there_s:.0f} s after power-on, {FORWARD_M} m driven {moved_s:.0f} s after the request")
    assert told(card).splitlines()[0].endswith(": OK"), told(card)


def test_a_card_whose_release_was_changed_says_so_on_the_card(base: Base, image: Image, tell: Tell) -> None:
    card = flashed(base, image, "changed")
    tamper(card)
    with Watch(base.hub, SWARM, ROBOT) as watch, booted(
        base.folder, image.kernel, image.initramfs, options=hardware(base, card), live=True
    ) as machine:  # fmt: skip
        took_s = watch.until(lambda: bool(told(card)), "the report on the card", LIMIT_S, machine.story)
        assert watch.lifecycle == ""
    tell(f"changed card: report {took_s:.0f} s after power-on")
    assert "FAILED while taking the release" in told(card)


def tamper(card: Path) -> None:
    """Add a line to a program in the release, and let the card's own checksums fit: only the signature tells."""
    with card.open("rb") as disk:
        volume = fat.boot_volume(disk.fileno(), str(card))
    packed, sums = (fat.get_file(card, volume, f"fullswarm/{name}") for name in ("release.tar.gz", "card.sha256"))
    assert packed
    assert sums
    changed = _with_a_line(packed)
    text = sums.decode().replace(hashlib.sha256(packed).hexdigest(), hashlib.sha256(changed).hexdigest())
    fat.put_files(card, volume, {"fullswarm/release.tar.gz": changed, "fullswarm/card.sha256": text.encode()})


def _with_a_line(packed: bytes) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=io.BytesIO(packed)) as old, tarfile.open(fileobj=out, mode="w") as new:
        for member in old:
            file = old.extractfile(member)
            data = file.read() if file else b""
            if member.name == "app/fullswarm/agent/node.py":
                data += b"\n# changed on the way\n"
                member.size = len(data)
            new.addfile(member, io.BytesIO(data) if file else None)
    assert b"changed on the way" in out.getvalue()
    return gzip.compress(out.getvalue(), 1)
