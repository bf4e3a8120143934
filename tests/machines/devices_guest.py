"""The devices guest: Debian's kernel and Python, fullswarm and its packages, all in one initramfs."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

from tests.machines.cache import cached
from tests.machines.debian import Recipe, root_filesystem
from tests.machines.initramfs import Archive
from tests.machines.packages import REPOSITORY, site_packages

RECIPE = Recipe(
    "devices-root",
    ("linux-image-amd64", "python3.11", "libstdc++6", "libgcc-s1", "kmod", "udev", "busybox-static", "iproute2"),
)
DRIVERS = (  # folders and files of the kernel's modules that the guest takes along
    "drivers/hid/hid.ko", "drivers/hid/hid-generic.ko", "drivers/hid/uhid.ko", "drivers/input/", "drivers/net/can/vcan",
    "drivers/net/can/dev/", "drivers/usb/class/", "drivers/usb/common/", "drivers/usb/core/", "drivers/usb/gadget/",
    "fs/configfs/", "net/can/",
)  # fmt: skip
UNUSED = ("boot/", "usr/share/", "var/", "usr/lib/x86_64-linux-gnu/perl", "usr/lib/initramfs-tools", "usr/lib/klibc/",
          "usr/lib/python3.11/test/", "usr/lib/python3.11/idlelib/", "usr/lib/python3/dist-packages/")  # fmt: skip


def kernel_and_initramfs(folder: Path, *udev_rules: Path) -> tuple[Path, Path]:
    """Make the guest, with these udev rules of ours; return its kernel and its initramfs."""
    root = root_filesystem(RECIPE)
    site = site_packages("x86_64-manylinux_2_28", "can", "joystick")
    stem = cached("devices-base", (RECIPE, DRIVERS, UNUSED, site.name), lambda path: _pack_base(path, root, site))
    path, tree = folder / "initramfs", folder / "app"
    shutil.copytree(REPOSITORY / "fullswarm", tree / "fullswarm", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(
        REPOSITORY / "tests" / "machines", tree / "tests" / "machines", ignore=shutil.ignore_patterns("__pycache__")
    )
    (tree / "tests" / "__init__.py").touch()
    compile_all(root, tree)
    shutil.copyfile(stem, path)
    with Archive(path) as archive:  # Linux unpacks one archive after the other
        archive.tree(tree, "app")
        archive.file("init", (REPOSITORY / "tests/machines/guest/init.sh").read_bytes(), executable=True)
        for each in udev_rules:
            archive.file(f"etc/udev/rules.d/{each.name}", each.read_bytes())
    return next((root / "boot").glob("vmlinuz-*")), path


def _pack_base(path: Path, root: Path, site: Path) -> None:
    compile_all(root, root / "usr/lib/python3.11")
    compile_all(root, site)
    with Archive(path) as archive:
        archive.tree(root, wanted=_wanted)
        archive.tree(site, "site", lambda inside: not inside.endswith((".pyi", ".exe")))
        archive.file("etc/passwd", b"root:x:0:0::/root:/bin/sh\nnobody:x:65534:65534::/:/bin/sh\n")
        archive.file("etc/group", b"root:x:0:\ntty:x:5:\ndialout:x:20:\ninput:x:104:\nnogroup:x:65534:\n")
        archive.device("dev/console", 5, 1)


def _wanted(inside: str) -> bool:
    if inside.startswith("lib/modules/"):
        _, _, module = inside.partition("/kernel/")
        return not module or module.startswith(DRIVERS) or (not module.endswith(".ko") and any(
            each.startswith(f"{module}/") for each in DRIVERS))  # fmt: skip
    return not inside.startswith(UNUSED)


def compile_all(root: Path, folder: Path) -> None:
    """Compile Python files with the guest's own Python, run here: an emulated processor would take minutes."""
    libraries = f"{root}/lib/x86_64-linux-gnu:{root}/usr/lib/x86_64-linux-gnu"
    subprocess.run(
        [f"{root}/lib64/ld-linux-x86-64.so.2", "--library-path", libraries, f"{root}/usr/bin/python3.11", "-m",
         "compileall", "-q", "-f", "-j", "2", "--invalidation-mode", "unchecked-hash", str(folder)],
        env={**os.environ, "PYTHONHOME": str(root / "usr")}, check=False, capture_output=True,
    )  # fmt: skip
