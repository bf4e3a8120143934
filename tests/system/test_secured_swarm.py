"""Two commands secure a swarm: `fullswarm keys init` and `fullswarm up`, in real processes on loopback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.identity.folder import IDENTITY, KeysFolder
from fullswarm.keys import Keys
from fullswarm.launch.network import on_free_ports
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Mailbox, Runtime
from tests.waiting import until

START_S = 60.0
REVOKED_S = 2.0
HEALTH_S = 0.5
"""Period of the health reports."""
FLEET = """
swarm = "lab"
[hub]
endpoint = "{hub}"
[world]
address = "{world}"
engine = "kinematic"
[fleet]
count = 2
"""


class Lab:
    """A folder with a fleet file, keys and logs; commands run there as a user would."""

    def __init__(self, folder: Path) -> None:
        free = on_free_ports(SwarmConfig(), prefer_configured=False)
        self.hub = free.hub.endpoint.replace("tcp/", "tls/")
        self.folder, self.fleet = folder, folder / "lab.toml"
        self.fleet.write_text(FLEET.format(hub=self.hub, world=free.world_or_default.address))
        # Kernels in plain Python: a world that compiles for seconds on a busy machine would be taken for frozen.
        plain = {"NUMBA_DISABLE_JIT": "1"}
        self.environment = {**os.environ, **plain, IDENTITY: str(folder / "identity"), "FULLSWARM_OPERATOR": "anna"}
        self.up: subprocess.Popen[bytes] | None = None

    def run(self, *words: str, code: int = 0, env: Mapping[str, str] | None = None) -> str:
        """Run a command; return its stdout, or of one that fails its stderr."""
        done = subprocess.run(
            [sys.executable, "-m", "fullswarm", *words],
            env={**self.environment, **(env or {})}, capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
        assert done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        return done.stderr if code else done.stdout

    def ask(self, *words: str, code: int = 0, env: Mapping[str, str] | None = None) -> str:
        """Run a command that talks to the swarm."""
        return self.run(*words, "--hub", self.hub, "--swarm", "lab", code=code, env=env)

    def start(self) -> None:
        with (self.folder / "up.log").open("wb") as sink:
            command = [sys.executable, "-m", "fullswarm", "up", str(self.fleet)]
            self.up = subprocess.Popen(command, env=self.environment, stdout=sink, stderr=sink)

    def close(self) -> None:
        if self.up is not None:
            self.up.terminate()
            self.up.wait(20)

    def robots(self) -> dict[str, Any]:
        return {each["robot"]: each for each in json.loads(self.ask("status", "--json"))["robots"]}


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    made = Lab(tmp_path)
    yield made
    made.close()


def test_two_commands_secure_a_swarm(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("keys", "init", str(lab.fleet))
    assert "anna: issued (operator)" not in lab.run("keys", "init", str(lab.fleet))  # it was the first time
    lab.start()
    monkeypatch.setenv(IDENTITY, str(lab.folder / "identity"))
    runtime = Runtime(MonotonicClock(), Mailbox())
    bus = ZenohBus(runtime.mailbox, hub=lab.hub, credentials=KeysFolder.of("lab").credentials("anna", "operator"))
    view = FleetView(bus, Keys("lab"), runtime, ("r1", "r2"))

    def ages() -> dict[str, float]:
        runtime.run(0.02)
        return {each.robot: each.age_s for each in view.snapshot().robots}

    def there(*robots: str) -> Callable[[], bool]:
        return lambda: all(ages().get(each, 9.0) < 1.0 for each in robots)

    def states() -> dict[str, str]:
        runtime.run(0.02)
        return {each.robot: each.health.lifecycle for each in view.snapshot().robots if each.health}

    until(lambda: set(states().values()) == {"READY"} and len(states()) == 2, START_S, "both robots are ready")

    # a request drives them
    before = lab.robots()
    lab.ask("request", "move_to_goal", "--set", "goal=[3,3]", "--wait")
    until(lambda: _moved(before, lab.robots()), 20.0, "both robots have moved")

    # an operator without a certificate, and one of another authority
    error = lab.ask("stop", code=2, env={"FULLSWARM_OPERATOR": "mallory"})
    assert "'mallory' has no certificate in swarm 'lab'" in error
    assert "fullswarm keys issue mallory --role operator --swarm lab" in error
    other = {IDENTITY: str(lab.folder / "other")}
    lab.run("keys", "init", "--swarm", "lab", env=other)
    error = lab.ask("status", code=3, env=other)
    assert "another authority" in error
    error = lab.run("status", "--hub", lab.hub.replace("tls/", "tcp/"), "--swarm", "lab", code=3)
    assert "secured" in error

    # a robot that is revoked is out, and the other goes on
    until(there("r1", "r2"), 10.0, "both are there")
    lab.run("keys", "revoke", "r2", "--swarm", "lab")
    runtime.run(REVOKED_S)
    seen = ages()
    assert seen["r2"] > REVOKED_S - 1.0 - HEALTH_S, seen  # since the hub has noticed, within a second
    until(there("r1"), 5.0, "r1 is there")
    runtime.run(2.0)
    assert ages()["r2"] > 2.0
    bus.close()


def _moved(before: dict[str, Any], after: dict[str, Any]) -> bool:
    return all(
        abs(after[each]["x_m"] - before[each]["x_m"]) + abs(after[each]["y_m"] - before[each]["y_m"]) > 0.1
        for each in before
    )
