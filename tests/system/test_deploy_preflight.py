"""``fullswarm doctor --robot`` with a real hub, core and agent on an emulated Create, and a real sshd beside them."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from typer.testing import CliRunner

from fullswarm.cli.main import app
from fullswarm.deploy.release.keys import Keys, public
from fullswarm.deploy.release.store import Store
from tests.system.live import LiveSwarm
from tests.system.ssh_robots import SshRobot, fleet_file, make_release, make_robot, needs_sshd

pytestmark = needs_sshd

CONFIG = {
    "swarm": "preflight",
    "world": {"engine": "kinematic", "bounds_m": [0, 0, 30, 30]},
    "robot": [{"id": "r1", "emulate": "create2", "pose": [2.0, 2.0, 0.0]}],
}
ID = """#!/bin/sh
# This machine has no user `fullswarm`; a robot does.
if [ "$*" = "-Gn fullswarm" ]; then echo fullswarm dialout tty; else exec /usr/bin/id "$@"; fi
"""


class Robot:
    """A robot as people have it: an agent that talks on the bus, and a computer behind SSH."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        keys, self.folder = Keys(folder / "keys"), folder
        self.computer: SshRobot = make_robot(folder, "r1", public(keys.fleet_key()))
        program = self.computer.root / "bin/id"
        program.write_text(ID)
        program.chmod(0o755)
        make_release(Store(folder / "releases"), keys, "1.0")
        self.swarm = LiveSwarm(CONFIG, watch=True)
        stack.callback(self.swarm.close)
        assert self.swarm.node is not None
        emulator: Any = self.swarm.node.emulators["r1"]
        self.url = str(emulator.url)
        stack.callback(self.computer.kill_all)
        self.computer.start()
        self.fleet = fleet_file(folder, [self.computer])
        text = self.fleet.read_text().replace("null://r1", self.url).replace('"lab"', f'"{self.swarm.config.swarm}"')
        self.fleet.write_text(f'{text}[hub]\nendpoint = "{self.swarm.config.hub.endpoint}"\n')
        deployed = CliRunner().invoke(app, ["deploy", "--fleet", str(self.fleet), "--accept-new-host-keys"])
        assert deployed.exit_code == 0, deployed.output

    @property
    def port(self) -> Path:
        """Where the emulated Create is."""
        return Path(unquote(urlsplit(self.url).path))

    def doctor(self, *words: str) -> tuple[int, dict[str, dict[str, str]], dict[str, Any]]:
        """Return the exit code, the worst check of each name, and all that was said."""
        result = self.swarm.cli("doctor", "--robot", "r1", "--fleet", str(self.fleet), "--json", *words, timeout_s=90.0)
        said = json.loads(result.stdout)
        order = ["ok", "warning", "failure"]
        checks = sorted(said["checks"], key=lambda each: order.index(each["status"]))
        return result.returncode, {each["name"]: each for each in checks}, said

    @property
    def latched(self) -> bool:
        health = self.swarm.row("r1").health
        assert health is not None
        return health.estop


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    folder = tmp_path_factory.mktemp("preflight")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(folder))
        patch.setenv("XDG_STATE_HOME", str(folder / "state"))
        patch.setenv("FULLSWARM_KEYS", str(folder / "keys"))
        patch.setenv("FULLSWARM_RELEASES", str(folder / "releases"))
        patch.delenv("SSH_AUTH_SOCK", raising=False)
        with ExitStack() as stack:
            yield Robot(folder, stack)


def test_all_of_a_robot_is_looked_at_and_nothing_moves(robot: Robot) -> None:
    assert robot.swarm.node is not None
    body = robot.swarm.node.bodies.of["r1"]
    os.chmod(robot.port, 0o666)  # noqa: PTH101  (a terminal, not a path of ours)
    before = body.state()
    code, checks, said = robot.doctor("--yes")
    assert said["reached"] == {"bus": True, "ssh": True}
    for name in ("ssh", "round trip (ssh)", "clock", "bus", "driver", "battery", "port", "agent", "e-stop"):
        assert checks[name]["status"] == "ok", checks[name]
    assert checks["round trip (bus)"]["status"] != "failure"  # a busy machine may be slow
    assert "receipt after" in checks["e-stop"]["what"]
    assert checks["software"]["what"].startswith("1.0-")
    assert checks["software"]["mend"] == "fullswarm update r1"
    assert code == int(not said["ok"])
    robot.swarm.rest(1.0)
    assert not robot.latched
    after = body.state()
    assert (after.x_m, after.y_m, after.heading_rad) == (before.x_m, before.y_m, before.heading_rad)


@pytest.mark.slow
def test_without_a_terminal_and_a_yes_nothing_is_pressed(robot: Robot) -> None:
    _, checks, _ = robot.doctor()
    assert (checks["e-stop"]["status"], "no terminal to ask" in checks["e-stop"]["what"]) == ("warning", True)
    _, checks, _ = robot.doctor("--no-estop")
    assert checks["e-stop"]["status"] == "ok"


@pytest.mark.slow
def test_a_robot_that_is_latched_stays_latched(robot: Robot) -> None:
    assert robot.swarm.cli("estop", "r1").returncode == 0
    _, checks, _ = robot.doctor("--yes")
    assert "latched already" in checks["e-stop"]["what"]
    robot.swarm.rest(1.0)
    assert robot.latched
    assert robot.swarm.cli("estop", "--clear", "r1").returncode == 0


@pytest.mark.slow
def test_a_robot_that_drives_goes_on(robot: Robot) -> None:
    robot.swarm.request("move_to_goal", {"goal": [25.0, 25.0]})
    _, checks, _ = robot.doctor("--yes")
    assert checks["e-stop"]["what"] in (
        "not pressed: it moves",
        "not pressed: it runs move_to_goal, which this would end",
    )
    health = robot.swarm.row("r1").health
    assert health is not None
    assert health.behaviour == "move_to_goal"
    assert robot.swarm.cli("stop").returncode == 0


@pytest.mark.slow
def test_a_port_that_the_agent_may_not_open(robot: Robot) -> None:
    os.chmod(robot.port, 0o600)  # noqa: PTH101
    code, checks, _ = robot.doctor("--no-estop")
    assert (code, checks["port"]["status"]) == (1, "failure")
    assert "may not open it" in checks["port"]["what"]


def test_which_way_is_broken_is_told(robot: Robot) -> None:
    robot.computer.stop()
    code, checks, said = robot.doctor("--no-estop")
    assert (code, said["reached"]) == (1, {"bus": True, "ssh": False})
    assert "received on the bus" in checks["ssh"]["what"]

    robot.computer.start()
    robot.swarm.supervisor.kill("r1")
    code, checks, said = robot.doctor("--no-estop")
    assert (code, said["reached"]) == (1, {"bus": False, "ssh": True})
    assert "although its computer answers" in checks["bus"]["what"]

    robot.computer.stop()
    code, checks, said = robot.doctor("--no-estop")
    assert (code, said["reached"]) == (3, {"bus": False, "ssh": False})
    assert checks["bus"]["mend"] == "is it switched on and in this network?"
