"""What is on a robot's card before fullswarm comes: a small Debian with systemd, sshd and Python, built once.

It lies in ``~/.cache/fullswarm-tests`` (``FULLSWARM_TEST_CACHE``) in a folder named by its recipe, and is only read.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
from pathlib import Path

from tests.fleet.tools import ENVIRONMENT, Missing

SUITE = "bookworm"
PACKAGES = (
    "systemd", "systemd-sysv", "udev", "dbus", "openssh-server", "sudo", "python3", "zstd", "iproute2", "libfaketime",
)  # fmt: skip
ADMIN = "fullswarm-admin"
SETUP = rf"""
set -eu
cd "$1"
rm -f etc/ssh/ssh_host_* etc/resolv.conf
: > etc/machine-id
printf 'UseDNS no\nPasswordAuthentication no\nMaxStartups 100\n' > etc/ssh/sshd_config.d/lab.conf
chroot . useradd --create-home --shell /bin/bash {ADMIN}
install -d -m 700 root/.ssh home/{ADMIN}/.ssh
chroot . chown {ADMIN}: /home/{ADMIN}/.ssh
printf '{ADMIN} ALL=(ALL) NOPASSWD: ALL\n' > etc/sudoers.d/010_lab
chmod 440 etc/sudoers.d/010_lab
for unit in apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer e2scrub_all.timer fstrim.timer \
            systemd-timesyncd.service console-getty.service getty@.service systemd-networkd.service; do
  ln -sf /dev/null "etc/systemd/system/$unit"
done
rm -rf var/lib/apt/lists/* var/cache/apt/*.bin usr/share/doc usr/share/man
"""
BUILD_S = 1500.0


def cache() -> Path:
    """Return the folder for what is built once."""
    return Path(os.environ.get("FULLSWARM_TEST_CACHE") or Path.home() / ".cache" / "fullswarm-tests")


def rootfs() -> Path:
    """Return the robot's root file system, made now if it is not there.

    Raises
    ------
    Missing
        It cannot be made here.
    """
    recipe = "\n".join((SUITE, *PACKAGES, SETUP))
    folder = cache() / f"rootfs-{hashlib.sha256(recipe.encode()).hexdigest()[:12]}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (folder.parent / "rootfs.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another run may build it at the moment
        if not folder.exists():
            _build(folder)
    return folder


def _build(folder: Path) -> None:
    new = folder.with_name("rootfs.new")
    shutil.rmtree(new, ignore_errors=True)
    setup = folder.with_name("setup.sh")
    setup.write_text(SETUP)
    skipped = (f"--dpkgopt=path-exclude=/usr/share/{each}/*" for each in ("man", "doc", "locale"))
    command = [
        "mmdebstrap", "--mode=root", "--variant=minbase", "--format=directory", f"--include={','.join(PACKAGES)}",
        *skipped, f"--customize-hook=sh {setup} \"$1\"", SUITE, str(new),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=ENVIRONMENT, timeout=BUILD_S)
    setup.unlink()
    if done.returncode:
        shutil.rmtree(new, ignore_errors=True)
        last = "\n".join(done.stderr.strip().splitlines()[-5:])
        raise Missing(f"mmdebstrap could not build a Debian {SUITE}; is there a network with Debian packages?\n{last}")
    new.rename(folder)
