"""Two ways lead to a robot: which of them is broken must be told apart."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from fullswarm.bringup import preflight
from fullswarm.bringup.preflight_ssh import ComputerFacts, RobotComputer
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.deploy.fleet.login import HostKeyProblem, LoginRefused
from fullswarm.errors import ConfigError, FullswarmError, Unreachable
from fullswarm.operator import session
from fullswarm.operator.session import Session, Target
from tests.unit.agent_bench import Bench

AWAY = Unreachable("does not answer", where="r1 (10.0.0.11)", hint="is it switched on?")
NO_HUB = Unreachable("no hub answers", where="tcp/10.0.0.1:7447")
BOARD = RobotComputer(
    (0.01,), ComputerFacts(protocol=1, robot="r1", current="1-f", disk_free_bytes=10**10), {}, clock_off_s=0.0
)


def fleet(robot: dict[str, Any] | None = None, hub: str = "tcp/10.0.0.1:7447") -> SwarmConfig:
    given = {"id": "r1", "driver": "create:///dev/ttyUSB0", "host": "10.0.0.11", **(robot or {})}
    return SwarmConfig.model_validate({"hub": {"endpoint": hub}, "robot": [given]})


class Lab:
    """What is reached how: set `bus` to the bench's robot, nobody or an error, `ssh` to a Board or an error."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.bus: str | FullswarmError = "r1"
        self.ssh: RobotComputer | FullswarmError = BOARD
        self._capsys = capsys
        monkeypatch.setattr(session, "connect", self._connect)
        monkeypatch.setattr(preflight, "inspect", self._look)
        monkeypatch.setenv("FULLSWARM_KEYS", "not needed")
        monkeypatch.setattr("fullswarm.bringup.preflight.login_for", lambda *_: None)

    @contextmanager
    def _connect(self, _: Target) -> Iterator[Session]:
        if isinstance(self.bus, FullswarmError):
            raise self.bus
        bench = Bench([(2.0, 2.0, 0.0)])
        if self.bus != "r1":
            bench.agent.close()
        yield Session(bench.bus, bench.keys, bench.runtime, "tcp/hub", "ann")

    async def _look(self, *_: object) -> RobotComputer:
        if isinstance(self.ssh, FullswarmError):
            raise self.ssh
        return self.ssh

    def run(self, config: SwarmConfig | None = None) -> tuple[int, dict[str, dict[str, str]], dict[str, Any]]:
        """Return the exit code, the checks by name, and all that was printed."""
        code = preflight.run(config or fleet(), "r1", None, as_json=True)
        said = json.loads(self._capsys.readouterr().out)
        return code, {each["name"]: each for each in said["checks"]}, said


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Lab:
    return Lab(monkeypatch, capsys)


def test_both_ways_lead_there(lab: Lab) -> None:
    code, checks, said = lab.run()
    assert said["reached"] == {"bus": True, "ssh": True}
    assert (checks["ssh"]["status"], checks["bus"]["status"]) == ("ok", "ok")
    assert checks["e-stop"]["what"] == "not pressed: not wanted"
    assert code == 1  # the agent's unit of this computer is not active


def test_heard_but_not_reached_by_ssh(lab: Lab) -> None:
    lab.ssh = AWAY
    code, checks, said = lab.run()
    assert (code, said["reached"]) == (1, {"bus": True, "ssh": False})
    assert checks["ssh"]["status"] == "failure"
    assert "received on the bus, so it is switched on" in checks["ssh"]["what"]
    assert checks["round trip (bus)"]["status"] == "ok"


def test_reached_by_ssh_but_not_heard(lab: Lab) -> None:
    lab.bus = "nobody"
    code, checks, said = lab.run()
    assert (code, said["reached"]) == (1, {"bus": False, "ssh": True})
    assert "the hub answers, but r1 is not received" in checks["bus"]["what"]
    assert "although its computer answers" in checks["bus"]["what"]
    assert checks["bus"]["mend"] == "its agent does not run: fullswarm logs r1"
    assert "round trip (ssh)" in checks


def test_a_hub_on_the_loopback_is_no_robots_hub(lab: Lab) -> None:
    lab.bus = "nobody"
    _, checks, _ = lab.run(fleet(hub="tcp/127.0.0.1:7447"))
    assert "loopback" in checks["bus"]["mend"]


def test_no_hub_is_told_from_a_robot_that_is_away(lab: Lab) -> None:
    lab.bus = NO_HUB
    code, checks, said = lab.run()
    assert (code, said["reached"]) == (1, {"bus": False, "ssh": True})
    assert "only the hub is missing" in checks["bus"]["what"]


def test_nothing_of_it_answers(lab: Lab) -> None:
    lab.bus, lab.ssh = "nobody", AWAY
    code, checks, said = lab.run()
    assert (code, said["reached"]) == (3, {"bus": False, "ssh": False})
    assert set(checks) == {"stopping distance", "ssh", "bus"}  # the first needs no robot
    assert checks["bus"]["mend"] == "is it switched on and in this network?"


@pytest.mark.parametrize(
    "error", [LoginRefused("does not let us in", hint="x"), HostKeyProblem("another key", hint="y")]
)
def test_a_computer_that_turns_us_away_is_there(lab: Lab, error: FullswarmError) -> None:
    lab.bus, lab.ssh = "nobody", error
    code, checks, _ = lab.run()
    assert code == 3
    assert checks["ssh"]["mend"] == error.hint
    assert "although its computer answers" in checks["bus"]["what"]


def test_a_simulated_robot_has_no_computer(lab: Lab) -> None:
    lab.ssh = AWAY
    code, checks, _ = lab.run(fleet({"driver": "", "host": ""}))
    assert (code, checks["ssh"]["status"]) == (0, "ok")


def test_a_name_that_the_fleet_does_not_have() -> None:
    with pytest.raises(ConfigError, match="no robot 'r7'"):
        preflight.run(fleet(), "r7", None, as_json=True)


@pytest.mark.parametrize(
    ("driver", "port"),
    [
        ("create:///dev/serial/by-id/x%20y", ("/dev/serial/by-id/x y", "")),
        ("mavlink+serial:///dev/ttyACM0?baud=57600", ("/dev/ttyACM0", "")),
        ("mavlink+udpin://0.0.0.0:14550", ("", "")),
        ("can+odrive://can0?left=1", ("", "can0")),
        ("can+odrive:///dev/ttyACM0?interface=slcan", ("/dev/ttyACM0", "")),
        ("can+odrive://lab?interface=virtual", ("", "")),
        ("sim://r1", ("", "")),
        ("", ("", "")),
    ],
)
def test_the_port_of_a_driver(driver: str, port: tuple[str, str]) -> None:
    assert preflight.port_of(RobotConfig(id="r1", driver=driver)) == port
