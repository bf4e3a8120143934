"""A Debian image for a card, as Raspberry Pi OS has it: a FAT boot partition, then the root file system.

No mounts, no loop devices: the FAT is filled by mtools, the root by `mke2fs -d`, the table is written by sfdisk.
"""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

from tests.machines.cache import cached
from tests.machines.debian import Recipe, root_filesystem
from tests.machines.initramfs import Archive
from tests.machines.needs import which

RECIPE = Recipe(
    "card-root",
    ("linux-image-cloud-amd64", "systemd-sysv", "udev", "dbus", "openssh-server", "python3", "cloud-init", "netplan.io",
     "sudo", "locales", "iproute2", "kmod", "busybox-static"),
    variant="minbase",
    hooks=("--dpkgopt=path-exclude=/etc/kernel/postinst.d/initramfs-tools",),  # ours is smaller and boots faster
)  # fmt: skip
BOOT_MIB, ROOT_MIB = 256, 2048
MODULES = ("virtio_pci", "virtio_blk", "ext4")
_INIT = b"""#!/bin/busybox sh
/bin/busybox mkdir -p /proc /sys /dev /root
/bin/busybox mount -t devtmpfs dev /dev
/bin/busybox mount -t proc proc /proc
/bin/busybox mount -t sysfs sys /sys
for module in %s; do /bin/busybox modprobe $module; done
until /bin/busybox mount -t ext4 /dev/vda2 /root; do /bin/busybox sleep 0.1; done
exec /bin/busybox switch_root /root /sbin/init
"""


@dataclass(frozen=True)
class Image:
    """An image and what QEMU boots it with, in the place of a board's own loader."""

    disk: Path
    kernel: Path
    initramfs: Path


def card_image() -> Image:
    """Return the image; skip the test when Debian's packages are out of reach."""
    root = root_filesystem(RECIPE)
    folder = cached("card-image", (RECIPE, BOOT_MIB, ROOT_MIB, MODULES, _INIT), lambda path: _make(path, root))
    return Image(folder / "bookworm.img", folder / "vmlinuz", folder / "initramfs")


def _make(folder: Path, root: Path) -> None:
    folder.mkdir()
    (folder / "vmlinuz").write_bytes(next((root / "boot").glob("vmlinuz-*")).read_bytes())
    _pack_initramfs(folder / "initramfs", root)
    fat, ext4, disk = folder / "fat", folder / "ext4", folder / "bookworm.img"
    _sized(fat, BOOT_MIB)
    _run("mkfs.vfat", "-F", "32", "-n", "CIDATA", str(fat))
    _sized(ext4, ROOT_MIB)
    _run("mke2fs", "-q", "-t", "ext4", "-d", str(root), "-L", "rootfs", str(ext4))
    _sized(disk, BOOT_MIB + ROOT_MIB + 2)
    table = f"start=1MiB, size={BOOT_MIB}MiB, type=c\nstart={BOOT_MIB + 1}MiB, size={ROOT_MIB}MiB, type=83\n"
    _run("sfdisk", "--quiet", str(disk), said=table)
    for part, at_mib in ((fat, 1), (ext4, BOOT_MIB + 1)):
        _run("dd", f"if={part}", f"of={disk}", "bs=1M", f"seek={at_mib}", "conv=notrunc,sparse", "status=none")
        part.unlink()


def _pack_initramfs(path: Path, root: Path) -> None:
    version = next((root / "lib/modules").iterdir()).name
    wanted = _with_needed((root / f"lib/modules/{version}/modules.dep").read_text())
    with Archive(path) as archive:
        archive.file("bin/busybox", (root / "bin/busybox").read_bytes(), executable=True)
        archive.file("init", _INIT % " ".join(MODULES).encode(), executable=True)
        archive.device("dev/console", 5, 1)
        archive.tree(root / f"lib/modules/{version}", f"lib/modules/{version}",
                     lambda inside: inside in wanted or inside.startswith("modules."))  # fmt: skip


def _with_needed(dependencies: str) -> set[str]:
    """Return the paths of :data:`MODULES` and all that they need, from a ``modules.dep``."""
    needs = {file: rest.split() for file, _, rest in (line.partition(":") for line in dependencies.splitlines())}
    wanted: set[str] = set()
    for file, others in needs.items():
        if Path(file).name.partition(".")[0] in (*MODULES, "crc32c_generic", "crc32c-intel"):
            wanted |= {file, *others}
    return wanted


def _sized(path: Path, mib: int) -> None:
    with path.open("wb") as file:
        file.truncate(mib << 20)


def _run(program: str, *arguments: str, said: str = "") -> None:
    found = which(program)
    assert found is not None, program
    done = subprocess.run([found, *arguments], input=said, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{program}: {done.stderr}"
