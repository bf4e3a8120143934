"""Robots behind real sshds on this machine: each with a root folder of its own, the real ``fullswarm-robot`` in it.

Only systemd and the agent are played, by two shell scripts: an agent that writes its health each half second as its
release's ``app/mode`` says, and timers that are `sleep`s.
"""

from __future__ import annotations

import getpass
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import pytest

from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.keys import Keys, sign_release
from fullswarm.deploy.release.manifest import Manifest, Target
from fullswarm.deploy.release.store import Store

SSHD = shutil.which("sshd", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")
needs_sshd = pytest.mark.skipif(
    SSHD is None or shutil.which("ssh-keygen") is None, reason="needs sshd: sudo apt install openssh-server"
)
THIS = Target("this", os.uname().machine, "2.17", f"{sys.version_info.major}.{sys.version_info.minor}")

SYSTEMCTL = r"""#!/bin/sh
# systemd, as far as fullswarm-robot asks it: one agent, one timer.
echo "$*" >> "$FULLSWARM_ROOT/systemctl.log"
stop() { [ -f "$1" ] && kill "$(cat "$1")" 2>/dev/null; rm -f "$1"; }
agent=$FULLSWARM_ROOT/agent.pid guard=$FULLSWARM_ROOT/guard.pid
case "$*" in
*is-system-running*) echo running ;;
*is-active*) [ -f "$agent" ] ;;
*try-restart*agent*) [ ! -f "$agent" ] || "$0" restart fullswarm-agent.service ;;
"restart fullswarm-agent.service")
    stop "$agent"
    release=$(readlink -e "$FULLSWARM_ROOT/opt/fullswarm/current") || exit 1
    [ "$(cat "$release/app/mode")" != dead ] || exit 1
    setsid sh "$FULLSWARM_ROOT/agent.sh" "$release" > /dev/null 2>&1 < /dev/null &
    echo $! > "$agent"
    for _ in 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20; do
        grep -q "\"${release##*/}\"" "$FULLSWARM_ROOT/run/fullswarm/health.json" 2>/dev/null && exit 0
        sleep 0.1
    done ;;
*fullswarm-guard.timer*) case "$*" in stop*) stop "$guard" ;; esac ;;
reboot) rm -f "$FULLSWARM_ROOT/boot_id"; cat /proc/sys/kernel/random/uuid > "$FULLSWARM_ROOT/boot_id" ;;
show*)
    printf 'SubState=running\nNRestarts=0\nMainPID=1\n'
    [ -f "$agent" ] && echo ActiveState=active || echo ActiveState=inactive ;;
esac
"""
SYSTEMD_RUN = r"""#!/bin/sh
echo "$*" >> "$FULLSWARM_ROOT/systemctl.log"
seconds=1
while :; do
    case $1 in --on-active=*) seconds=${1#*=}; shift ;; -*) shift ;; *) break ;; esac
done
setsid sh -c 'sleep "$0"; "$@"' "$seconds" "$@" > "$FULLSWARM_ROOT/guard.log" 2>&1 < /dev/null 9>&- &
echo $! > "$FULLSWARM_ROOT/guard.pid"
"""
SUDO = r"""#!/bin/sh
# Lets everybody do everything, like a rule without a password; only who is not root needs it.
echo "$*" >> "$FULLSWARM_ROOT/sudo.log"
while :; do case $1 in -p) shift 2 ;; -*) shift ;; *) break ;; esac; done
exec "$@"
"""
AGENT = r"""
file=$FULLSWARM_ROOT/run/fullswarm/health.json
while :; do
    mode=$(cat "$1/app/mode") life=READY moving=false healthy=true why=
    [ ! -f "$FULLSWARM_ROOT/moving" ] || { life=ACTIVE moving=true; }
    case $mode in
    sick) healthy=false why='"the driver does not answer"' ;;
    fault) healthy=false life=FAULT why='"fault: burnt"' ;;
    esac
    cat > "$file.new" <<HEALTH
{
 "robot": "$ROBOT_NAME",
 "release": "${1##*/}",
 "pid": $$,
 "boot_id": "$(cat "$FULLSWARM_BOOT_ID")",
 "machine_s": $(cut -d' ' -f1 /proc/uptime),
 "lifecycle": "$life",
 "behaviour": "$([ $moving = true ] && echo flocking)",
 "moving": $moving,
 "healthy": $healthy,
 "why": [$why]
}
HEALTH
    mv -f "$file.new" "$file"
    sleep 0.5
done
"""


@dataclass(slots=True)
class SshRobot:
    """One robot's computer: an sshd on a port of its own, and a root folder."""

    name: str
    root: Path
    port: int
    server: subprocess.Popen[bytes] | None = None
    environment: dict[str, str] = field(default_factory=dict)

    def start(self) -> None:
        """Switch it on."""
        assert SSHD is not None
        config = self.root / "sshd_config"
        variables = {
            "FULLSWARM_ROOT": self.root,
            "FULLSWARM_SYSTEMCTL": self.root / "bin/systemctl",
            "FULLSWARM_SYSTEMD_RUN": self.root / "bin/systemd-run",
            "FULLSWARM_BOOT_ID": self.root / "boot_id",
            "ROBOT_NAME": self.name,
            "HOME": self.root / "home",
            "PATH": f"{self.root / 'bin'}:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
            **self.environment,
        }
        config.write_text(
            f"""
Port {self.port}
ListenAddress 127.0.0.1
HostKey {self.root / "host_key"}
AuthorizedKeysFile {self.root / "home/.ssh/authorized_keys"}
PidFile none
StrictModes no
UsePAM no
PasswordAuthentication no
KbdInteractiveAuthentication no
PermitRootLogin prohibit-password
PrintMotd no
MaxStartups 100
SetEnv {" ".join(f"{key}={value}" for key, value in variables.items())}
"""
        )
        log = self.root / "sshd.log"
        self.server = subprocess.Popen([SSHD, "-D", "-f", str(config), "-E", str(log)])
        deadline = time.monotonic() + 20.0
        while True:
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1.0):
                return
            if time.monotonic() > deadline or self.server.poll() is not None:
                raise AssertionError(f"sshd does not start: {log.read_text() if log.exists() else '?'}")
            time.sleep(0.05)

    def stop(self) -> None:
        """Switch it off, with all that runs on it."""
        if self.server is not None:
            self.cut()
            self.server.terminate()
            self.server.wait(10.0)
            self.server = None

    def cut(self) -> int:
        """Cut every link that is open; return how many."""
        assert self.server is not None
        sessions = psutil.Process(self.server.pid).children(recursive=False)
        for each in sessions:
            with suppress(psutil.NoSuchProcess):
                for process in (*each.children(recursive=False), each):
                    if "sshd" in process.name():
                        process.kill()
        return len(sessions)

    def kill_all(self) -> None:
        """End everything of this robot, agent and guard included."""
        self.stop()
        for file in ("agent.pid", "guard.pid"):
            with suppress(OSError, ValueError):
                os.killpg(int((self.root / file).read_text()), signal.SIGKILL)

    @property
    def current(self) -> str | None:
        """The release that the link names."""
        link = self.root / "opt/fullswarm/current"
        return os.path.basename(os.readlink(link)) if link.is_symlink() else None  # noqa: PTH115, PTH119

    @property
    def log(self) -> list[str]:
        """What systemd was asked for."""
        file = self.root / "systemctl.log"
        return file.read_text().splitlines() if file.exists() else []

    @property
    def restarts(self) -> int:
        """How often the agent was started."""
        return self.log.count("restart fullswarm-agent.service")

    def pending(self) -> bool:
        """A switch is not committed yet."""
        return (self.root / "opt/fullswarm/pending").exists()


def free_port() -> int:
    """A port on which nobody listens just now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def make_robot(folder: Path, name: str, let_in: str) -> SshRobot:
    """Make a computer on which nothing of ours is installed; `let_in` is a public key."""
    root = folder / name
    for each in ("bin", "home/.ssh", "opt", "etc", "run/fullswarm", "var"):
        (root / each).mkdir(parents=True)
    for program, text in (("systemctl", SYSTEMCTL), ("systemd-run", SYSTEMD_RUN), ("sudo", SUDO)):
        (root / "bin" / program).write_text(text)
        (root / "bin" / program).chmod(0o755)
    (root / "agent.sh").write_text(AGENT)
    (root / "boot_id").write_text(Path("/proc/sys/kernel/random/boot_id").read_text())
    (root / "home/.ssh/authorized_keys").write_text(let_in + "\n")
    new_host_key(root)
    if os.geteuid() == 0:
        Path("/run/sshd").mkdir(mode=0o755, exist_ok=True)  # sshd's own, made by its unit elsewhere
    return SshRobot(name, root, free_port())


def new_host_key(root: Path) -> None:
    """Give a computer a host key, another one each time."""
    for each in ("host_key", "host_key.pub"):
        (root / each).unlink(missing_ok=True)
    command = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(root / "host_key")]
    subprocess.run(command, check=True, capture_output=True)


def make_release(
    store: Store,
    keys: Keys,
    version: str,
    *,
    mode: str = "good",
    target: Target = THIS,
    library_bytes: int = 300_000,
    files: Mapping[str, bytes] | None = None,
) -> str:
    """Make a signed release whose library is the same for the same size, and whose app is `version`'s own."""
    store.folder.mkdir(parents=True, exist_ok=True)
    fresh = store.folder / f".fresh-{version}"
    noise = random.Random(library_bytes)
    content = {
        "lib/big.so": noise.randbytes(library_bytes),
        "lib/small.py": b"x = 1\n",
        "app/mode": f"{mode}\n".encode(),
        "app/fullswarm/__init__.py": f"version = '{version}'\n".encode(),
        **(files or {}),
    }
    for path, data in content.items():
        (fresh / path).parent.mkdir(parents=True, exist_ok=True)
        (fresh / path).write_bytes(data)
    nameless = Manifest("", version, target)
    name = manifest.id_for(nameless, manifest.sums_of(fresh))
    (fresh / manifest.MANIFEST).write_text(Manifest(name, version, target).to_json())
    (fresh / manifest.SUMS).write_text(manifest.sums_of(fresh))
    sign_release(fresh, keys)
    store.add(fresh)
    return name


def wait_until(true: Callable[[], bool], what: str, within_s: float = 30.0) -> None:
    """Poll until something holds."""
    deadline = time.monotonic() + within_s
    while not true():
        assert time.monotonic() < deadline, f"not in {within_s} s: {what}"
        time.sleep(0.05)


def fleet_file(folder: Path, robots: list[SshRobot]) -> Path:
    """Write the fleet file that names these computers."""
    user = getpass.getuser()
    text = 'swarm = "lab"\n'
    for each in robots:
        text += f'[[robot]]\nid = "{each.name}"\ndriver = "null://{each.name}"\nhost = "127.0.0.1"\n'
        text += f'ssh_user = "{user}"\nssh_port = {each.port}\n'
    path = folder / "lab.toml"
    path.write_text(text)
    return path
