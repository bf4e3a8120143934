"""The base of a fleet of one: hub, core, keys and releases of its own, and a Create on a port for the machine."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest

from fullswarm.emulators.create_oi.emulator import CreateEmulator
from tests.machines.packages import REPOSITORY

SWARM, ROBOT = "card", "r1"
INSIDE = ("10.0.2.100", 7447)
"""Where the hub is for a robot in QEMU's own network, which leads nowhere else."""
NO_INDEX = 3
AGENT = "[agent]\ncontrol_rate_hz = 10\nstate_rate_hz = 5\nhealth_rate_hz = 5\nbounds_m = [-5, -5, 5, 5]\n"
"""An emulated processor is ten times slower than the slowest that a robot has."""


class Base:
    """A context manager; `folder` keeps all that it makes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = int(probe.getsockname()[1])
        self.hub = f"tcp/127.0.0.1:{self.port}"
        self.fleet, self._here = folder / "fleet.toml", folder / "here.toml"
        for file, hub in ((self.fleet, f"tcp/{INSIDE[0]}:{INSIDE[1]}"), (self._here, self.hub)):
            file.write_text(f'swarm = "{SWARM}"\n[hub]\nendpoint = "{hub}"\n{AGENT}[[robot]]\nid = "{ROBOT}"\n'
                            f'driver = "create:///dev/ttyS1"\npose = [0, 0, 0]\n')  # fmt: skip
        self.environment = {
            **os.environ, "PYTHONPATH": str(REPOSITORY), "FULLSWARM_KEYS": str(folder / "keys"),
            "FULLSWARM_RELEASES": str(folder / "releases"), "FULLSWARM_STATE": str(folder / "state"),
            "FULLSWARM_HUB": self.hub, "FULLSWARM_SWARM": SWARM, "COLUMNS": "200",
        }  # fmt: skip
        self.robot = CreateEmulator(port=str(folder / "create"))
        self._served: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Self:
        self.robot.start()
        self._serve("hub", "--listen", self.hub)
        self._serve("core", "--fleet", str(self._here))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._served:
            process.terminate()
        for process in self._served:
            process.wait()
        self.robot.close()

    def _serve(self, *words: str) -> None:
        with (self.folder / f"{words[0]}.log").open("wb") as log:
            self._served.append(
                subprocess.Popen([sys.executable, "-m", "fullswarm", *words], stdin=subprocess.DEVNULL,
                                 stdout=log, stderr=log, env=self.environment)
            )  # fmt: skip

    def run(self, *words: str | Path, code: int | None = 0) -> str:
        """Run a command of ours; return what it printed. Fails on another exit code, None: on none."""
        done = subprocess.run(
            [sys.executable, "-m", "fullswarm", *map(str, words)], stdin=subprocess.DEVNULL, capture_output=True,
            text=True, check=False, env=self.environment,
        )  # fmt: skip
        assert code is None or done.returncode == code, f"{words}: exit {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout

    def bundle(self) -> str:
        """Make the release for Debian's Python; return its id. Skips the test when no package index is in reach."""
        words = [sys.executable, "-m", "fullswarm", "bundle", "--target", "x86_64", "--python", "3.11", "--json"]
        done = subprocess.run(words, capture_output=True, text=True, check=False, env=self.environment)
        if done.returncode == NO_INDEX:
            pytest.skip(f"no package index can be reached: {done.stderr.strip()}")
        assert done.returncode == 0, done.stderr
        return str(json.loads(done.stdout)["id"])
