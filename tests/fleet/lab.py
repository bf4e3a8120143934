"""A fleet that is there, and a base that runs ``fullswarm``; nothing is done but through the front door."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import fullswarm
from fullswarm.deploy.release.keys import Keys
from fullswarm.deploy.release.keys import public as public_key
from tests.fleet import cgroups, network
from tests.fleet.containers import FOLDER, Container, remove_leftovers
from tests.fleet.network import BASE, Network
from tests.fleet.rootfs import ADMIN, rootfs
from tests.fleet.tools import ENVIRONMENT, Missing, end, start, until

SWARM = "lab"
PORT = "/dev/ttyCREATE"
HUB = f"tcp/{BASE}:7447"
LOCK = Path("/run/fullswarm-fleet.lock")
WAIT_S = 900.0
PYTHON = "3.11"
"""What the robots' Debian has."""
INSTANCES = Path("/proc/sys/fs/inotify/max_user_instances")
SOURCE = Path(fullswarm.__file__).parent
AGENT = """
[agent]
control_rate_hz = 10
state_rate_hz = 2
health_rate_hz = 2
bounds_m = [0, 0, 40, 40]
"""
"""Two cores carry 16 computers, their agents and their Creates: everything slowly, but everything."""


CONTAINER = "[Service]\nProtectKernelTunables=no\nProtectControlGroups=no\n"
"""Either takes away what nspawn puts over /proc/sys/kernel/random/boot_id, and the agent would see the base's."""


@dataclass(frozen=True)
class Done:
    """What a command of ours said."""

    code: int
    out: str
    words: str
    took_s: float

    @property
    def json(self) -> Any:
        """What it printed, read."""
        return json.loads(self.out)


class Lab:
    """Robots as containers with emulated Creates; hub and core on the base. A context manager.

    Parameters
    ----------
    robots
        How many.
    folder
        Where the base keeps keys, releases and the fleet file.
    """

    def __init__(self, robots: int, folder: Path) -> None:
        self.folder = folder
        self.robots = [f"r{row + 1}" for row in range(robots)]
        self.fleet = folder / "fleet.toml"
        self.keys = Keys(folder / "keys")
        self.environment = {
            **ENVIRONMENT,
            "FULLSWARM_KEYS": str(self.keys.folder),
            "FULLSWARM_RELEASES": str(folder / "releases"),
            "FULLSWARM_FLEET": str(self.fleet),
            "FULLSWARM_STATE": str(folder / "state"),
            "XDG_STATE_HOME": str(folder / "desired"),  # what robots should run: not in the home of who tests
            "FULLSWARM_HUB": HUB,
            "FULLSWARM_SWARM": SWARM,
            "PYTHONPATH": str(SOURCE.parent),
            "PYTHONDONTWRITEBYTECODE": "",  # as on a user's base: our modules are compiled once
            "COLUMNS": "200",
        }
        self.computers: dict[str, Container] = {}
        self.started: list[subprocess.Popen[str]] = []
        self._lock = LOCK.open("w")

    def __enter__(self) -> Self:
        until(self._alone, WAIT_S, "another run has ended its fleet")
        self._instances = INSTANCES.read_text()
        try:
            self._set_up()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _alone(self) -> bool:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def _set_up(self) -> None:
        card = rootfs()
        remove_leftovers()
        FOLDER.mkdir()
        INSTANCES.write_text(str(max(int(self._instances), 64 * (len(self.robots) + 2))))
        self.network = Network(self.robots)
        self._write_fleet()
        self.creates = Creates([FOLDER / f"{robot}.port" for robot in self.robots])
        for robot in self.robots:
            devices = {PORT: str((FOLDER / f"{robot}.port").resolve())}
            computer = Container(robot, self.network.address[robot], self.network.namespace(robot), card, devices)
            self.computers[robot] = computer
            self._flashed(computer)
        for computer in self.computers.values():
            computer.boot()
        self.serve("hub", "--listen", HUB, "--insecure-network")
        self.serve("core")
        for computer in self.computers.values():
            computer.wait()

    def _flashed(self, computer: Container) -> None:
        """Put on a card what `flash` puts there, so that nobody trusts anybody on first use."""
        host = self.keys.host_key(SWARM, computer.name)
        place = computer.root / "etc/ssh/ssh_host_ed25519_key"
        shutil.copy(host, place)
        place.chmod(0o600)
        computer.put(f"{place.relative_to(computer.root)}.pub", public_key(host) + "\n")
        mine = public_key(self.keys.fleet_key()) + "\n"
        for home, owner in (("root", 0), (f"home/{ADMIN}", (computer.root / "home" / ADMIN).stat().st_uid)):
            computer.put(f"{home}/.ssh/authorized_keys", mine, 0o600)
            os.chown(computer.root / home / ".ssh/authorized_keys", owner, owner)
        computer.put("etc/systemd/system/fullswarm-agent.service.d/lab.conf", CONTAINER)
        computer.put("etc/hostname", f"{computer.name}\n")
        computer.put("etc/hosts", f"127.0.0.1 localhost {computer.name}\n")

    def _write_fleet(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        tables = [f'swarm = "{SWARM}"\n[hub]\nendpoint = "{HUB}"\n{AGENT}']
        tables += [
            f'[[robot]]\nid = "{robot}"\ndriver = "create://{PORT}?model=create2"\n'
            f'host = "{self.network.address[robot]}"\nssh_user = "{ADMIN}"\n'
            f"pose = [{4.0 * (number % 4) + 2.0}, {4.0 * (number // 4) + 2.0}, 0.0]\n"
            for number, robot in enumerate(self.robots)
        ]
        self.fleet.write_text("\n".join(tables))

    def close(self) -> None:
        """Remove all of it."""
        for process in self.started:
            end(process)
        for computer in self.computers.values():
            computer.remove()
        if hasattr(self, "creates"):
            self.creates.close()
        network.remove()
        remove_leftovers()
        cgroups.remove()
        INSTANCES.write_text(self._instances)
        self._lock.close()

    # ------------------------------------------------------------------ the base
    def command(self, *words: str | Path) -> list[str]:
        """Return the words of a command of ours."""
        return [sys.executable, "-m", "fullswarm", *map(str, words)]

    def cli(
        self,
        *words: str | Path,
        code: int | None = 0,
        source: Path | None = None,
        more: dict[str, str] | None = None,
        timeout_s: float = 600.0,
    ) -> Done:
        """Run a command of ours; fails if it ends with another code, None: any.

        Parameters
        ----------
        source
            Another tree than ours to run.
        more
            What else is in its environment.
        """
        environment = {**self.environment, **(more or {})}
        if source is not None:
            environment["PYTHONPATH"] = str(source)
        began_s = time.monotonic()
        done = subprocess.run(
            self.command(*words), capture_output=True, text=True, check=False, env=environment, timeout=timeout_s,
            stdin=subprocess.DEVNULL, cwd=self.folder,
        )  # fmt: skip
        said = Done(done.returncode, done.stdout, done.stderr, time.monotonic() - began_s)
        story = f"{' '.join(map(str, words))}: exit {said.code}\n{said.out}\n{said.words}"
        assert "Traceback" not in said.words, story
        assert code is None or said.code == code, story
        return said

    def start(self, *words: str | Path, log: str) -> subprocess.Popen[str]:
        """Start a command of ours and go on; it ends with the lab at the latest."""
        # Ctrl-C reaches it also where these tests run in a background that has none.
        command = ["env", "--default-signal=INT", *self.command(*words)]
        self.started.append(start(command, self.folder / log, self.environment))
        return self.started[-1]

    def serve(self, *words: str) -> None:
        """Start something that the base needs all the time."""
        self.start(*words, log=f"{words[0]}.log")

    def bundle(self, changed: dict[str, str] | None = None, **environment: str) -> str:
        """Make a release of our source, with these texts appended to files of it; return its id."""
        tree = None
        if changed is not None:
            tree = self.folder / f"source-{len(list(self.folder.glob('source-*')))}"
            shutil.copytree(SOURCE, tree / "fullswarm", ignore=shutil.ignore_patterns("__pycache__"))
            for path, text in changed.items():
                file = tree / path
                file.write_text(file.read_text() + text)
        done = self.cli("bundle", "--target", "x86_64", "--python", PYTHON, "--json", source=tree, more=environment)
        return str(done.json["id"])

    def bundle_for(self, target: str) -> str:
        """Make a release of our source for another kind of machine; return its id."""
        return str(self.cli("bundle", "--target", target, "--json").json["id"])

    # ------------------------------------------------------------------ the robots
    def heal(self, *robots: str) -> None:
        """End all mishaps of these robots, none: of all: mend cables, empty disks, turn clocks back, switch on."""
        chosen = robots or tuple(self.robots)
        self.network.mend(*robots)
        for robot in chosen:
            computer = self.computers[robot]
            self.creates.order("speak", self.robots.index(robot))
            computer.empty()
            if not computer.up:
                computer.boot()
            if computer.clock_turned:
                computer.turn_clock()
        for robot in chosen:
            self.computers[robot].wait()

    def blank(self, robot: str, sudoers: str = "") -> None:
        """Give a robot a card on which nothing of ours is; `sudoers` instead of a sudo that asks nothing."""
        computer = self.computers[robot]
        computer.wipe()
        self._flashed(computer)
        if sudoers:
            computer.put("etc/sudoers.d/010_lab", sudoers, 0o440)

    def mute(self, robot: str) -> None:
        """Let a robot's Create say nothing any more."""
        self.creates.order("mute", self.robots.index(robot))

    def release_of(self, robot: str) -> str:
        """Return what a robot's `current` names, seen without its network; empty for nothing."""
        link = self.computers[robot].root / "opt/fullswarm/current"
        return link.readlink().name if link.is_symlink() else ""

    def releases(self) -> dict[str, str]:
        """Return what each robot's `current` names."""
        return {robot: self.release_of(robot) for robot in self.robots}

    def status(self) -> dict[str, str]:
        """Return the lifecycle of each robot that the operator sees."""
        seen = self.cli("status", "--json").json
        return {
            row["robot"]: row["lifecycle"] for row in seen["robots"] if row["age_s"] is not None and row["age_s"] < 3.0
        }

    def stopped(self) -> dict[str, bool]:
        """Return of each robot that the operator sees whether its emergency stop is latched."""
        seen = self.cli("status", "--json").json
        return {row["robot"]: row["estop"] for row in seen["robots"]}

    def wait_ready(self, robots: Iterable[str] | None = None, timeout_s: float = 60.0) -> float:
        """Wait until the operator sees these robots READY; None: all."""
        wanted = set(self.robots if robots is None else robots)
        seen: dict[str, str] = {}

        def ready() -> bool:
            seen.update(self.status())
            return {robot for robot, lifecycle in seen.items() if lifecycle in ("READY", "ACTIVE")} >= wanted

        return until(ready, timeout_s, f"ready: {sorted(wanted)}", lambda: f"{seen}\n{self.story(wanted)}")

    def story(self, robots: Iterable[str]) -> str:
        """Return what robots that did not do as they should have to say."""
        return "\n".join(
            f"--- {robot}\n{self.computers[robot].journal('fullswarm-agent')}" for robot in list(robots)[:3]
        )

    def starts(self) -> dict[str, object]:
        """Return a mark of each agent's process that changes when it is restarted."""
        return {
            robot: (agent["pid"], agent["restarts"])
            for robot, computer in self.computers.items()
            if isinstance(agent := computer.facts()["agent"], dict)
        }


class Creates:
    """The process with the emulated Creates."""

    def __init__(self, ports: list[Path]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fleet.creates", *map(str, ports)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
            env=ENVIRONMENT, cwd=SOURCE.parent,
        )  # fmt: skip
        self._lock = threading.Lock()
        self._expect("ready")

    def order(self, order: str, row: int) -> None:
        """Let the Create of this row do something."""
        assert self._process.stdin
        with self._lock:
            self._process.stdin.write(f"{order} {row}\n")
            self._process.stdin.flush()
            self._expect(f"done {order} {row}")

    def _expect(self, line: str) -> None:
        assert self._process.stdout
        heard = self._process.stdout.readline().strip()
        assert heard == line, f"the Creates say '{heard}', not '{line}'"

    def close(self) -> None:
        """Switch them off."""
        self._process.communicate()


def when(computer: Container, event: str, release: str) -> Callable[[], bool]:
    """Return a condition: an update of this computer to `release` has come to `event`."""
    home = computer.root / "opt/fullswarm"
    link, mark = home / "current", home / "pending"

    def switched() -> bool:
        return link.is_symlink() and link.readlink().name == release

    moments: dict[str, Callable[[], bool]] = {
        "start": lambda: True,
        "shipping": lambda: (home / "releases" / f".incoming-{release}").exists(),
        "shipped": lambda: (home / "releases" / release).exists(),
        "armed": mark.exists,
        "switched": switched,
        "committed": lambda: switched() and not mark.exists(),
    }
    return moments[event]


__all__ = ["Creates", "Done", "Lab", "Missing", "when"]
