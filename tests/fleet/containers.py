"""One robot's computer: a systemd-nspawn container over the shared root file system, on a disk of its own.

The disk is a tmpfs that outlives the container, so that a robot whose power was pulled comes back with what it had
written. What that cannot show: pages that a real card had not yet got; here every write survives.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
from collections.abc import Sequence
from pathlib import Path

from tests.fleet import cgroups
from tests.fleet.tools import end, run, start, until

FOLDER = Path("/run/fullswarm-fleet")
"""Where all of it is mounted; whatever an earlier run has left here is removed."""

DISK = "1500m"
BOOT_S = 120.0
PRELOAD, PRETENDED, STEADY = "/etc/ld.so.preload", "/etc/faketimerc", "FAKETIME_DONT_FAKE_MONOTONIC"
AGAIN = 'while "$@"; [ $? -eq 133 ]; do :; done'
"""So ends nspawn when the computer in it wants to boot again."""
FAKETIME = "/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1"


class Container:
    """A computer; :meth:`boot` it.

    Parameters
    ----------
    address
        Where its sshd answers.
    namespace
        The network that it is on.
    devices
        Inside → outside: the devices that are plugged in.
    """

    def __init__(self, name: str, address: str, namespace: Path, rootfs: Path, devices: dict[str, str]) -> None:
        self.name, self.address, self._namespace, self._devices = name, address, namespace, devices
        self._process: subprocess.Popen[str] | None = None
        self._pid = 0
        self._home = FOLDER / name
        self._disk, self.root, self._rootfs = self._home / "disk", self._home / "root", rootfs
        self._again = self._home / "again"  # the same, that nspawn does not make read-only
        for place in (self._disk, self.root, self._again):
            place.mkdir(parents=True)
        self._format()

    def _format(self) -> None:
        name, disk = self.name, self._disk
        run("mount", "-t", "tmpfs", "-o", f"size={DISK},nr_inodes=0,mode=755", f"{name}-disk", disk)
        for each in ("upper", "work"):
            (disk / each).mkdir()
        layers = f"lowerdir={self._rootfs},upperdir={disk}/upper,workdir={disk}/work"
        run("mount", "-t", "overlay", "-o", layers, f"{name}-root", self.root)
        run("mount", "--bind", self.root, self._again)

    # ------------------------------------------------------------------ power
    @property
    def up(self) -> bool:
        """It has power; whether sshd answers is :meth:`answers`."""
        return self._process is not None and self._process.poll() is None

    def boot(self, *, writable: Sequence[str] = ()) -> None:
        """Give it power; does not wait. With folders in `writable` all others but /run and /tmp are read-only."""
        assert not self.up
        devices = [f"--bind={outside}:{inside}" for inside, outside in self._devices.items()]
        devices += [f"--bind={self._again}{folder}:{folder}" for folder in writable] + ["--read-only"] * bool(writable)
        self._pid = 0
        self._process = start(
            ["sh", "-c", f'{cgroups.entering(self.name)} || exit; {AGAIN}', "sh",
             "systemd-nspawn", "--quiet", "--register=no", "--keep-unit", "--boot", f"--directory={self.root}",
             f"--machine={self.name}", f"--network-namespace-path={self._namespace}", "--link-journal=no",
             "--resolv-conf=off", "--timezone=off", "--console=read-only", *devices],
            self._home / "console.log",
        )  # fmt: skip

    def pull(self) -> None:
        """Take its power away: no process of it gets another instruction."""
        if not self.up or self._process is None:
            return
        for pid in self.processes():  # nobody lives to see, and to act on, that another has gone
            if pid != self.pid:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGSTOP)
        os.kill(self.pid, signal.SIGKILL)  # the kernel ends all others with the first
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            end(self._process)
        until(lambda: not processes(self._disk), 10.0, f"{self.name} is off")

    @property
    def pid(self) -> int:
        """Its first process, as seen from outside; another one after a reboot."""
        if not self._pid or not Path(f"/proc/{self._pid}/ns").exists():
            until(self._find, BOOT_S, f"{self.name} has a first process", self.console)
        return self._pid

    def processes(self) -> Sequence[int]:
        """Return all that run on it, as seen from outside."""
        return processes(self._disk)

    def _find(self) -> bool:
        assert self._process is not None
        for pid in processes(self._disk):
            try:
                words = Path(f"/proc/{pid}/status").read_text()
            except OSError:
                continue
            numbers = next((each for each in words.splitlines() if each.startswith("NSpid:")), "").split()
            if len(numbers) > 2 and numbers[-1] == "1":
                self._pid = pid
                return True
        return False

    def answers(self) -> bool:
        """Whether sshd says its name."""
        try:
            with socket.create_connection((self.address, 22), timeout=1.0) as line:
                return line.recv(4) == b"SSH-"
        except OSError:
            return False

    def wait(self) -> float:
        """Wait until sshd answers; return how long that took, in s."""
        return until(self.answers, BOOT_S, f"{self.name} answers", self.console)

    def console(self) -> str:
        """Return the end of what it said on its console."""
        return (self._home / "console.log").read_text(errors="replace")[-2000:]

    # ------------------------------------------------------------------ by hand
    def do(self, *command: str, check: bool = True, feed: Path = Path("/dev/null")) -> str:
        """Run a program on it as root, past its network; a file is its stdin."""
        return run("nsenter", f"--target={self.pid}", "--mount", "--uts", "--ipc", "--net", "--pid", "--root", "--wd",
                   *command, check=check, feed=feed)  # fmt: skip

    def put(self, path: str, content: str, mode: int = 0o644) -> None:
        """Write a file; the computer may be off."""
        place = self.root / path.lstrip("/")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(content)
        place.chmod(mode)

    def facts(self) -> dict[str, object]:
        """Return what its ``fullswarm-robot facts`` says."""
        found: dict[str, object] = json.loads(self.do("/opt/fullswarm/bin/fullswarm-robot", "facts"))
        return found

    def journal(self, unit: str, lines: int = 40) -> str:
        """Return the end of a unit's journal."""
        return self.do("journalctl", "--no-pager", "-o", "cat", "-u", unit, "-n", str(lines), check=False)

    # ------------------------------------------------------------------ mishaps
    def fill(self, left_kib: int = 64) -> None:
        """Let its disk have no more than so much room."""
        room = os.statvfs(self._disk)
        used_kib = (room.f_blocks - room.f_bfree) * room.f_frsize // 1024
        run("mount", "-o", f"remount,size={used_kib + left_kib}k", self._disk)

    def empty(self) -> None:
        """Give its disk its room back."""
        run("mount", "-o", f"remount,size={DISK}", self._disk)

    def turn_clock(self, moment: str = "") -> None:
        """Let all that starts from now on believe that it is this moment (``1970-01-01 00:10:00``), for ever; "": now.

        A container shares its kernel's clock, so this is libfaketime for all but systemd and journald.
        """
        order, names = ("set", f"{STEADY}=1") if moment else ("unset", STEADY)
        self.do("systemctl", f"{order}-environment", names)  # deadlines are meant as they are
        if moment:
            self.put(PRETENDED, f"@{moment}\n")
            self.put(PRELOAD, f"{FAKETIME}\n")
        else:
            self.put(PRELOAD, "")
        self.do("systemctl", "restart", "ssh")

    @property
    def clock_turned(self) -> bool:
        """Whether what starts on it is told a wrong time."""
        place = self.root / PRELOAD.lstrip("/")
        return place.exists() and place.stat().st_size > 0

    # ------------------------------------------------------------------ the end
    def wipe(self) -> None:
        """Take the power away, and give it a card on which only the system is."""
        self.pull()
        _unmount(self._home)
        self._format()

    def remove(self) -> None:
        """Take the power and the disk away."""
        self.pull()
        _unmount(self._home)
        cgroups.remove(self.name)


def processes(folder: Path) -> Sequence[int]:
    """Return the processes whose root file system is written to disks in this folder."""
    found = []
    for each in Path("/proc").iterdir():
        if each.name.isdigit():
            try:
                mounts = (each / "mountinfo").read_text()
            except OSError:
                continue  # gone meanwhile
            # Field 4 is where it is mounted, as that process sees it.
            roots = (line for line in mounts.splitlines() if line.split(maxsplit=5)[4] == "/")
            if any(f"upperdir={folder}/" in line for line in roots):
                found.append(int(each.name))
    return found


def remove_leftovers() -> None:
    """Remove what an earlier run has left: its processes, mounts and files."""
    for pid in processes(FOLDER):
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
    until(lambda: not processes(FOLDER), 10.0, "the last run's containers are off")
    _unmount(FOLDER)
    cgroups.remove()
    run("rm", "-rf", "--one-file-system", FOLDER)


def _unmount(folder: Path) -> None:
    mounts = [line.split()[4] for line in Path("/proc/self/mountinfo").read_text().splitlines()]
    for each in reversed([each for each in mounts if Path(each) == folder or folder in Path(each).parents]):
        run("umount", "--lazy", each)
