"""What a machine test needs of the computer that it runs on; without it the test is skipped and says how to get it."""

from __future__ import annotations

import os
import shutil
import sys

import pytest

PACKAGES = {  # program → Debian package
    "mmdebstrap": "mmdebstrap",
    "qemu-system-x86_64": "qemu-system-x86",
    "qemu-aarch64-static": "qemu-user-static",
    "mke2fs": "e2fsprogs",
    "sfdisk": "fdisk",
    "mcopy": "mtools",
    "mkfs.vfat": "dosfstools",
    "ssh-keygen": "openssh-client",
}


def require(*programs: str, root: bool = True) -> None:
    """Skip the test unless this is Linux, its user may make a root filesystem, and the programs are there."""
    if sys.platform != "linux":
        pytest.skip("machines are made from Debian packages: needs Linux")
    if root and os.geteuid() != 0:
        pytest.skip("making a Debian root filesystem needs root: run the tests as root, in a container if you like")
    lacking = sorted(each for each in programs if which(each) is None)
    if lacking:
        wanted = " ".join(sorted({PACKAGES[each] for each in lacking}))
        pytest.skip(f"needs {', '.join(lacking)}: apt install {wanted}")


def which(program: str) -> str | None:
    """Return the path of a program, also of one that only root has in its path."""
    return shutil.which(program, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
