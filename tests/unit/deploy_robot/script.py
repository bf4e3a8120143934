"""A robot in a folder: the real ``fullswarm-robot`` with stand-ins for systemd, and a way to kill it at any step."""

from __future__ import annotations

import copy
import io
import json
import os
import re
import shutil
import subprocess
import tarfile
import uuid
from collections.abc import Mapping
from pathlib import Path

from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.deploy.release.keys import Keys, verify_release
from fullswarm.deploy.release.store import gzipped_archive, head_archive
from fullswarm.deploy.robot.support_package import support_package
from tests.deploy_release import tiny_release

PROGRAMS = Path(__file__).parents[3] / "fullswarm" / "deploy" / "robot"

SYSTEMCTL = """#!/bin/sh
# The agent "runs" the release that the file `agent` names; app/broken keeps one from starting, app/hangs for a minute,
# and a swarm called "bad" does, too. Whoever asks what the file `dies-at` says is killed, once.
echo "$*" >> "$FULLSWARM_ROOT/systemctl.log"
cd "$FULLSWARM_ROOT" || exit 1
[ "$1" != "$(cat dies-at 2>/dev/null)" ] || { rm dies-at; kill -KILL 0; }
job=$1
if [ "$job" = try-restart ]; then
    [ "$2" = fullswarm-agent.service ] && [ -e agent ] || exit 0
    job=restart
fi
case $job in
restart | start)
    rm -f agent run/fullswarm/health.json
    [ -e opt/fullswarm/current/manifest.json ] || exit 0
    [ ! -e opt/fullswarm/current/app/broken ] || exit 1
    ! grep -q '"bad"' etc/fullswarm/fleet.toml || exit 1
    [ ! -e opt/fullswarm/current/app/hangs ] || exec sleep 60
    id=$(readlink opt/fullswarm/current)
    echo "${id##*/}" > agent
    "$FULLSWARM_ROOT/tell" false READY ""
    ;;
is-active) [ -e agent ] ;;
show)
    if [ -e agent ]; then echo ActiveState=active; else echo ActiveState=inactive; fi
    echo NRestarts=0
    ;;
is-enabled) grep -q "enable --quiet $3" systemctl.log ;;
is-system-running) echo running ;;
esac
"""
TELL = """#!/bin/sh
# tell MOVING LIFECYCLE BEHAVIOUR: what the agent writes each second.
cat > "$FULLSWARM_ROOT/run/fullswarm/health.json" <<EOF
{
 "robot": "r1",
 "release": "$(cat "$FULLSWARM_ROOT/agent")",
 "boot_id": "$(cat "$FULLSWARM_BOOT_ID")",
 "machine_s": $(cut -d' ' -f1 /proc/uptime),
 "lifecycle": "$2",
 "behaviour": "$3",
 "moving": $1,
 "healthy": true,
 "why": []
}
EOF
"""
SYSTEMD_RUN = """#!/bin/sh
# Keeps the guard's command, one argument a line, until somebody fires it.
[ ! -e "$FULLSWARM_ROOT/no-guards" ] || exit 1
while [ "${1#--}" != "$1" ]; do shift; done
printf '%s\\n' "$@" > "$FULLSWARM_ROOT/guard"
"""
SYNC = "#!/bin/sh\n"
WRAPPER = """#!{sh}
# Counts, and kills the whole group in place of the call that is due. Programs of a pipe come here at the same time.
PATH={path}
printf x >> "$FULLSWARM_ROOT/calls"
[ "$KILL_AT" -eq 0 ] || [ "$(wc -c < "$FULLSWARM_ROOT/calls")" -lt "$KILL_AT" ] || kill -KILL 0
exec {program} "$@"
"""
WRAPPED = """awk cat chmod cmp comm cp cut date dd df dirname find flock getconf grep gzip head ln mkdir mkfifo mktemp
mv od readlink rm sed sha256sum sort ssh-keygen sync systemctl systemd-run tail tar tee tr uname xargs"""


class Robot:
    """A robot's file system in `root`, and its base's keys and releases beside it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.root = folder, folder / "root"
        self.keys = Keys(folder / "keys")
        self.boot_file = folder / "boot_id"
        self.store = folder / "store"
        self._programs()
        self.new_boot_id()
        (self.root / "run/fullswarm").mkdir(parents=True)
        self.install_kit()

    def _programs(self) -> None:
        self.bin = self.folder / "bin"
        self.bin.mkdir(parents=True)
        self.root.mkdir(parents=True)
        scripts = {"systemctl": SYSTEMCTL, "systemd-run": SYSTEMD_RUN, "sync": SYNC}
        for path, text in {
            self.root / "tell": TELL,
            **{self.bin / name: each for name, each in scripts.items()},
        }.items():
            path.write_text(text)
            path.chmod(0o755)

    def copy(self, folder: Path) -> Robot:
        """Return another robot in the same state."""
        other = copy.copy(self)
        shutil.copytree(self.folder, folder, symlinks=True)
        other.folder, other.root, other.bin = folder, folder / "root", folder / "bin"
        other.boot_file, other.keys, other.store = folder / "boot_id", Keys(folder / "keys"), folder / "store"
        return other

    def new_boot_id(self) -> None:
        self.boot_file.write_text(f"{uuid.uuid4()}\n")

    @property
    def environment(self) -> dict[str, str]:
        return {
            "PATH": f"{self.bin}:{os.environ['PATH']}",
            "HOME": str(self.folder),
            "FULLSWARM_ROOT": str(self.root),
            "FULLSWARM_BOOT_ID": str(self.boot_file),
        }

    def install_kit(self) -> str:
        """Install the kit as a base would; return what it said that it changed."""
        done = self.install()
        assert done.returncode == 0, done.stderr
        return done.stdout

    def install(
        self, *words: str, swarm: str = "lab", stdout: int = subprocess.PIPE
    ) -> subprocess.CompletedProcess[str]:
        """Run the installer of the kit for a fleet file."""
        robot = RobotConfig(id="r1", driver="null://r1")
        config = SwarmConfig(robot=(robot,)) if swarm == "lab" else SwarmConfig(swarm=swarm, robot=(robot,))
        spread = self.folder / f"kit-{uuid.uuid4().hex[:6]}"
        with tarfile.open(fileobj=io.BytesIO(support_package(robot, config, self.keys.roots()[-1]))) as tar:
            tar.extractall(spread, filter="data")
        done = subprocess.run(
            ["sh", spread / "install.sh", *words], env=self.environment, check=False, start_new_session=True,
            stdout=stdout, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        shutil.rmtree(spread)
        return done

    def program(self, name: str, script: str) -> None:
        """Put a stand-in before one of the system's programs."""
        path = self.bin / name
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o755)

    # ------------------------------------------------------------------ the program
    def call(
        self, *arguments: str, feed: bytes = b"", environment: Mapping[str, str] | None = None
    ) -> subprocess.CompletedProcess[bytes]:
        program = self.root / "opt/fullswarm/bin/fullswarm-robot"
        return subprocess.run(
            [program, *arguments], input=feed, capture_output=True, env={**self.environment, **(environment or {})},
            start_new_session=True, check=False, timeout=60,
        )  # fmt: skip

    def ok(self, *arguments: str, feed: bytes = b"") -> str:
        done = self.call(*arguments, feed=feed)
        assert done.returncode == 0, (arguments, done.returncode, done.stderr.decode())
        return done.stdout.decode()

    def no(self, code: int, *arguments: str, feed: bytes = b"") -> str:
        """Call what must not work; return what it says."""
        done = self.call(*arguments, feed=feed)
        assert done.returncode == code, (arguments, done.returncode, done.stdout, done.stderr.decode())
        return done.stderr.decode()

    # ------------------------------------------------------------------ releases
    def make(self, version: str, files: Mapping[str, str | bytes] | None = None, keys: Keys | None = None) -> Path:
        common = {"lib/big.py": "BIG = 1\n" * 1000, "lib/odd name.txt": "x", "lib/deep/er/one.py": ""}
        own = files if files is not None else {"app/fullswarm/__init__.py": f"__version__ = '{version}'\n"}
        return tiny_release(self.store, keys or self.keys, version, {**common, **own})

    def want(self, release: Path) -> list[str]:
        return self.ok("want", release.name, feed=head_archive(release)).splitlines()

    def ship(self, release: Path) -> None:
        missing = self.want(release)
        self.ok("receive", release.name, feed=b"".join(gzipped_archive(release, missing)))

    def run_release(self, release: Path) -> None:
        """Ship, switch and approve."""
        self.ship(release)
        self.ok("switch", release.name)
        self.ok("commit", release.name)

    # ------------------------------------------------------------------ what happens to it
    def fire_guard(self) -> None:
        """Let the guard's time run out, if it is armed."""
        guard = self.root / "guard"
        if guard.exists():
            command = guard.read_text().splitlines()
            guard.unlink()
            done = subprocess.run(command, env=self.environment, capture_output=True, start_new_session=True)
            assert done.returncode == 0, done.stderr.decode()

    def reboot(self) -> None:
        """Go down and come up: timers are gone, `boot` runs before the agent."""
        (self.root / "guard").unlink(missing_ok=True)
        shutil.rmtree(self.root / "run")
        (self.root / "run/fullswarm").mkdir(parents=True)
        self.new_boot_id()
        self.ok("boot")
        subprocess.run([self.bin / "systemctl", "start", "fullswarm-agent"], env=self.environment, check=False)

    def age_health(self) -> None:
        """Let the agent's last word be ten seconds old."""
        path = self.root / "run/fullswarm/health.json"
        path.write_text(
            re.sub(r'("machine_s": )(\d+)', lambda found: f"{found[1]}{int(found[2]) - 10}", path.read_text())
        )

    def tell(self, moving: bool, lifecycle: str = "READY", behaviour: str = "") -> None:
        command = [str(self.root / "tell"), str(moving).lower(), lifecycle, behaviour]
        subprocess.run(command, env=self.environment, check=True)

    # ------------------------------------------------------------------ looking
    def link(self, name: str) -> str | None:
        path = self.root / "opt/fullswarm" / name
        return path.readlink().name if path.is_symlink() else None

    @property
    def current(self) -> str | None:
        return self.link("current")

    @property
    def agent(self) -> str | None:
        path = self.root / "agent"
        return path.read_text().strip() if path.exists() else None

    @property
    def pending(self) -> bool:
        return (self.root / "opt/fullswarm/pending").exists()

    @property
    def releases(self) -> set[str]:
        return {each.name for each in (self.root / "opt/fullswarm/releases").iterdir() if each.name[0] != "."}

    @property
    def facts(self) -> dict[str, object]:
        value = json.loads(self.ok("facts"))
        assert isinstance(value, dict)
        return value

    def check(self) -> None:
        """Every release here is whole, and current names one of them."""
        for each in self.releases:
            verify_release(self.root / "opt/fullswarm/releases" / each, self.keys.allowed_signers())
        assert self.current is None or self.current in self.releases

    # ------------------------------------------------------------------ killing
    def wrap(self) -> None:
        """Put a counter before every program that the script calls."""
        wrapped = self.folder / "wrapped"
        wrapped.mkdir()
        for name in WRAPPED.split():
            program = shutil.which(name, path=self.environment["PATH"])
            assert program, name
            path = wrapped / name
            path.write_text(WRAPPER.format(sh="/bin/sh", path=os.environ["PATH"], program=program))
            path.chmod(0o755)

    def call_killed(self, at: int, *arguments: str, feed: bytes = b"") -> subprocess.CompletedProcess[bytes]:
        """Call, and kill all of it in place of its `at`-th call of another program (0: never)."""
        (self.root / "calls").write_text("")
        path = f"{self.folder / 'wrapped'}:{self.environment['PATH']}"
        return self.call(*arguments, feed=feed, environment={"PATH": path, "KILL_AT": str(at)})

    def asked(self) -> str:
        """Return what systemd was asked since the last time."""
        log = self.root / "systemctl.log"
        text = log.read_text()
        log.write_text("")
        return text

    @property
    def calls(self) -> int:
        return len((self.root / "calls").read_text())
