"""The release for a Raspberry Pi on its own processor, emulated: what is in it loads, and its agent drives a robot."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from fullswarm.bus.hub import Hub
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from tests.machines.cache import cache_folder
from tests.machines.debian import Recipe, root_filesystem
from tests.machines.needs import require, which
from tests.machines.watch import Watch

pytestmark = pytest.mark.slow
ROOT = Recipe("arm64-root", ("python3.11", "libstdc++6", "libgcc-s1"), architecture="arm64")
NO_INDEX = 3
Tell = Callable[[str], None]
LIMIT_S = 600.0
"""Python starts in some ten seconds here; a machine with other work takes minutes."""

IMPORTS = """
import importlib, json, platform, sys
from pathlib import Path
app, refused, loaded = Path(sys.argv[1]), {}, 0
for path in sorted(app.rglob("*.py")):
    name = ".".join(path.relative_to(app).with_suffix("").parts).removesuffix(".__init__")
    part = path.relative_to(app).parts[1]
    if part in ("agent", "bus", "config", "drivers") or part.endswith(".py"):
        if path.name == "__main__.py":
            continue
        try:
            importlib.import_module(name)
            loaded += 1
        except ImportError as error:
            refused[name] = error.name or str(error)
print(json.dumps({"machine": platform.machine(), "loaded": loaded, "refused": refused}))
"""


@dataclass(frozen=True)
class Board:
    """A release and the emulated processor that runs it."""

    release: Path
    root: Path

    def command(self, *words: str) -> list[str]:
        """Return the command that runs the board's Python with these words, as a robot does: its two layers only."""
        emulator = which("qemu-aarch64-static")
        assert emulator is not None
        python = self.root / "usr/bin/python3.11"
        return [emulator, "-L", str(self.root), str(python), "-s", "-S", "-P", *words]

    @property
    def environment(self) -> dict[str, str]:
        """The board's environment; compiled files are kept for the next time."""
        path = f"{self.release / 'app'}{os.pathsep}{self.release / 'lib'}"
        compiled = str(cache_folder() / "arm64-compiled")
        return {"PATH": "/usr/bin:/bin", "HOME": "/nonexistent", "PYTHONPATH": path, "PYTHONPYCACHEPREFIX": compiled}


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Board:
    """The release for a Raspberry Pi, as the command makes it, and Debian's Python for that processor."""
    require("mmdebstrap", "qemu-aarch64-static", "ssh-keygen")
    place = tmp_path_factory.mktemp("base")
    store = place / "releases"
    made = subprocess.run(
        [sys.executable, "-m", "fullswarm", "bundle", "--target", "rpi-arm64", "--with", "can,mavlink", "--json"],
        env={**os.environ, "FULLSWARM_KEYS": str(place / "keys"), "FULLSWARM_RELEASES": str(store)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if made.returncode == NO_INDEX:
        pytest.skip(f"no package index can be reached: {made.stderr.strip()}")
    assert made.returncode == 0, made.stderr
    return Board(store / json.loads(made.stdout)["id"], root_filesystem(ROOT))


def test_all_that_a_robot_runs_loads_on_its_processor(board: Board, tell: Tell) -> None:
    began_s = time.monotonic()
    done = subprocess.run(
        board.command("-c", IMPORTS, str(board.release / "app")),
        env=board.environment, capture_output=True, text=True, check=False, timeout=LIMIT_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    tell(f"arm64: {said['loaded']} modules in {time.monotonic() - began_s:.0f} s")
    assert said["machine"] == "aarch64"
    assert said["loaded"] > 100
    assert said["refused"] == {}


@contextmanager
def agent(board: Board, fleet: Path, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("wb") as out, subprocess.Popen(
        board.command("-m", "fullswarm", "agent", "r1", "--fleet", str(fleet)),
        env={**board.environment, "FULLSWARM_STATE": str(log.parent / "state")}, stdout=out, stderr=out, cwd="/",
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


def test_its_agent_joins_the_base_and_finds_its_robot(board: Board, tmp_path: Path, tell: Tell) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    fleet, log = tmp_path / "fleet.toml", tmp_path / "agent.log"
    with Hub(endpoint), CreateEmulator() as robot:
        # Without a guardian: the kernel of this machine cannot start the board's Python by itself.
        fleet.write_text(f'swarm = "pi"\n[hub]\nendpoint = "{endpoint}"\n[agent]\ncontrol_rate_hz = 5\n'
                         f'[[robot]]\nid = "r1"\ndriver = "{robot.url}&guardian=0"\n')  # fmt: skip
        with Watch(endpoint, "pi", "r1") as watch, agent(board, fleet, log) as process:
            took_s = watch.until(
                lambda: watch.lifecycle == "READY" or process.poll() is not None, "READY", LIMIT_S, log.read_text
            )
            assert watch.lifecycle == "READY", log.read_text()
            assert robot.mode.name == "PASSIVE"
    tell(f"arm64: agent READY after {took_s:.0f} s")
