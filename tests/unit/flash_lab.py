"""Images, releases and fleets for the tests of ``fullswarm flash``: small, but made by the real tools."""

from __future__ import annotations

import hashlib
import json
import lzma
import os
import platform
import random
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from fullswarm.cli.main import app
from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.keys import Keys, sign_release
from fullswarm.deploy.release.manifest import Manifest, Target, id_for
from fullswarm.deploy.release.store import Store

PACKAGES = {
    "mcopy": "mtools",
    "mkfs.vfat": "dosfstools",
    "fsck.vfat": "dosfstools",
    "sfdisk": "fdisk",
    "ssh-keygen": "openssh-client",
    "lsblk": "util-linux",
}
MEGA = 1 << 20
PI_FILES = {
    "cmdline.txt": b"console=serial0,115200 console=tty1 root=PARTUUID=35684e8a-02 rootfstype=ext4 rootwait quiet\n",
    "config.txt": b"arm_64bit=1\n",
}
TRIXIE_FILES = {**PI_FILES, "user-data": b"#cloud-config\n# nothing yet\n" * 50, "meta-data": b"instance-id: rpios\n"}
SECRET = "correct battery horse"
FAT = 8 * MEGA
FLEET = """\
swarm = "lab"
[hub]
endpoint = "tcp/10.0.0.1:7447"
[[robot]]
id = "r1"
driver = "create:///dev/ttyUSB0"
host = "10.0.0.11"
[[robot]]
id = "r2"
driver = "create:///dev/ttyUSB0"
"""


def tool(name: str) -> str:
    """Return the path of a program; skip the test when it is missing."""
    found = shutil.which(name, path=os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin", "/sbin")))
    if found is None:
        pytest.skip(f"needs {name}: apt install {PACKAGES.get(name, name)}")
    return found


def make_fat(path: Path, size: int, label: str, files: Mapping[str, bytes], bits: int = 16) -> None:
    path.touch()
    os.truncate(path, size)
    subprocess.run([tool("mkfs.vfat"), "-F", str(bits), "-n", label, path], check=True, capture_output=True)
    stage = path.with_name(f"{path.name}.files")
    for name, content in files.items():
        (stage / name).parent.mkdir(parents=True, exist_ok=True)
        (stage / name).write_bytes(content)
    if files:
        tops = [str(each) for each in sorted(stage.iterdir())]
        subprocess.run([tool("mcopy"), "-s", "-i", path, *tops, "::"], check=True)


def make_image(
    path: Path,
    files: Mapping[str, bytes] = TRIXIE_FILES,
    *,
    label: str = "bootfs",
    fat: int = 24 * MEGA,
    table: str = "dos",
    bits: int = 16,
    root: int = 6 * MEGA,
    seed: int = 1,
) -> Path:
    """Make a disk image: a boot FAT, then a root partition of noise and holes."""
    boot = path.with_name(f"{path.name}.fat")
    make_fat(boot, fat, label, files, bits)
    total = MEGA + fat + root + MEGA
    path.touch()
    os.truncate(path, total)
    kind, other = ("c", "83") if table == "dos" else ("U", "L")
    script = f"label: {table}\nstart=2048, size={fat // 512}, type={kind}\nsize={root // 512}, type={other}\n"
    subprocess.run([tool("sfdisk"), "-q", path], input=script.encode(), check=True)
    noise = random.Random(seed).randbytes(root // 2)
    with path.open("r+b") as file:
        file.seek(MEGA)
        file.write(boot.read_bytes())
        file.seek(MEGA + fat + root // 2)
        file.write(noise)
    return path


def make_release(store: Store, keys: Keys, *, payload: Mapping[str, bytes] | None = None) -> str:
    """Put a tiny signed release for this machine into `store`; return its id."""
    tool("ssh-keygen")
    fresh = store.folder / "fresh"
    files = {
        "app/fullswarm/__init__.py": b'__version__ = "9"\n',
        "lib/thing/__init__.py": b"x = 1\n",
        "lib/thing/data.bin": random.Random(5).randbytes(50_000),
        **(payload or {}),
    }
    for name, content in files.items():
        (fresh / name).parent.mkdir(parents=True, exist_ok=True)
        (fresh / name).write_bytes(content)
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    glibc = platform.libc_ver()[1] or "2.28"
    target = Target("x86_64", platform.machine(), min(glibc, "2.28"), version)
    nameless = Manifest("", "9.0", target)
    name = id_for(nameless, manifest.sums_of(fresh))
    (fresh / "manifest.json").write_text(Manifest(name, "9.0", target).to_json())
    (fresh / "SHA256SUMS").write_text(manifest.sums_of(fresh))
    sign_release(fresh, keys)
    store.add(fresh)
    return name


def files_of(image: Path, at: int = MEGA) -> dict[str, bytes]:
    """Return all files of a FAT inside an image, as mtools sees them."""
    drive = f"{image}@@{at}"
    listed = subprocess.run([tool("mdir"), "-/", "-b", "-i", drive, "::"], check=True, capture_output=True, text=True)
    names = [line.removeprefix("::/") for line in listed.stdout.splitlines() if line and not line.endswith("/")]
    return {
        name: subprocess.run(
            [tool("mcopy"), "-n", "-i", drive, f"::/{name}", "-"], check=True, capture_output=True
        ).stdout
        for name in names
    }


def fsck(image: Path, size: int, at: int = MEGA) -> None:
    """Let fsck.vfat judge the FAT inside an image."""
    alone = image.with_name("judged.fat")
    with image.open("rb") as file:
        file.seek(at)
        alone.write_bytes(file.read(size))
    done = subprocess.run([tool("fsck.vfat"), "-n", alone], capture_output=True, text=True, check=False)
    alone.unlink()
    assert done.returncode == 0, done.stdout


class Lab:
    """A base with keys, a release, a fleet file and an image, all in one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.keys, self.store = Keys(folder / "keys"), Store(folder / "releases")
        self.fleet, self.plain, self.image = folder / "lab.toml", folder / "raspios.img", folder / "raspios.img.xz"

    def make(self) -> None:
        make_release(self.store, self.keys)
        self.keys.fleet_key()
        self.fleet.write_text(FLEET)
        make_image(self.plain, TRIXIE_FILES, fat=FAT, bits=12, root=2 * MEGA)
        self.image.write_bytes(lzma.compress(self.plain.read_bytes(), preset=0))
        digest = hashlib.sha256(self.image.read_bytes()).hexdigest()
        Path(f"{self.image}.sha256").write_text(f"{digest}  raspios.img.xz\n")

    @property
    def release(self) -> str:
        return self.store.ids()[-1]

    def flash(self, *words: str, feed: str = "", **environment: str) -> Result:
        given = {
            "FULLSWARM_KEYS": str(self.keys.folder),
            "FULLSWARM_RELEASES": str(self.store.folder),
            "FULLSWARM_FLEET": str(self.fleet),
            **environment,
        }
        result = CliRunner().invoke(app, ["flash", *words], input=feed, env=given)
        assert "Traceback" not in result.output
        assert SECRET not in result.output
        return result

    def to_file(self, *words: str, **environment: str) -> tuple[Result, dict[str, Any]]:
        out = str(self.folder / "r1.img")
        usual = ("r1", "--target", "x86_64", "--image", str(self.image), "--output", out, "--json")
        result = self.flash(*usual, *words, **environment)
        return result, json.loads(result.stdout) if result.stdout else {}
