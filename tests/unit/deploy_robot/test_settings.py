"""The agent's settings, its health, and what is done for one that fails again and again."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.unit.deploy_robot.script import Robot


def test_settings_that_the_agent_does_not_take_are_taken_back(two: tuple[Robot, Path, Path]) -> None:
    robot, old, _ = two
    fleet = robot.root / "etc/fullswarm/fleet.toml"
    before = fleet.read_text()
    robot.program("journalctl", "echo 'no driver for bad://'")
    done = robot.install(swarm="bad")
    assert done.returncode == 1
    assert "the old ones are back" in done.stderr.splitlines()[-1]
    assert "Its last log line: no driver for bad://" in done.stderr.splitlines()[-1]
    assert (fleet.read_text(), robot.agent) == (before, old.name)
    assert not list(robot.root.rglob("*~"))
    assert robot.install().returncode == 0
    assert robot.install_kit() == ""


def test_settings_that_were_never_proven_are_taken_back_after_a_kill(two: tuple[Robot, Path, Path]) -> None:
    robot, old, _ = two
    before = (robot.root / "etc/fullswarm/fleet.toml").read_text()
    (robot.root / "dies-at").write_text("try-restart")
    assert robot.install(swarm="bad").returncode == -9
    assert robot.install(swarm="bad").returncode == 1
    assert ((robot.root / "etc/fullswarm/fleet.toml").read_text(), robot.agent) == (before, old.name)


def test_settings_stay_when_no_agent_ran_or_a_card_says_so(two: tuple[Robot, Path, Path]) -> None:
    robot, _, _ = two
    done = robot.install("--settings-stay", swarm="bad")
    assert (done.returncode, robot.agent) == (0, None)
    assert "does not start with the new settings" in done.stderr
    assert robot.install(swarm="other").returncode == 0
    assert robot.install(swarm="bad").returncode == 0
    assert '"bad"' in (robot.root / "etc/fullswarm/fleet.toml").read_text()


def test_new_settings_restart_the_agent_only_if_they_are_new(two: tuple[Robot, Path, Path]) -> None:
    robot, _, _ = two
    robot.asked()
    robot.install_kit()
    assert "restart" not in robot.asked()
    assert "changed: etc/fullswarm/fleet.toml\n" in robot.install(swarm="other").stdout
    assert "restart fullswarm-agent.service" in robot.asked()
    assert robot.facts["kit"] is not None


def test_health_is_asked_for_as_a_word_or_as_a_verdict(two: tuple[Robot, Path, Path]) -> None:
    robot, _, _ = two
    robot.tell(False)
    robot.ok("health", "--healthy")
    path = robot.root / "run/fullswarm/health.json"
    path.write_text(path.read_text().replace('"healthy": true', '"healthy": false'))
    robot.ok("health")
    done = robot.call("health", "--healthy")
    assert (done.returncode, b'"healthy": false' in done.stdout) == (1, True)
    robot.no(2, "health", "--well")


def test_health_that_is_old_or_of_another_release_is_none(two: tuple[Robot, Path, Path]) -> None:
    robot, _, new = two
    (robot.root / "agent").write_text(new.name)
    robot.tell(False)
    assert "still runs" in robot.no(1, "health")
    robot.age_health()
    assert re.search(r"health is 1\d s old", robot.no(1, "health"))
    (robot.root / "run/fullswarm/health.json").unlink()
    assert "no health yet" in robot.no(1, "health")


@pytest.mark.parametrize(
    ("result", "status", "dropped"),
    [
        ("exit-code", "70", True),
        ("exit-code", "1", True),
        ("exit-code", "2", False),
        ("success", "0", False),
        ("watchdog", "ABRT", False),
        ("signal", "KILL", False),
    ],
)
def test_an_agent_that_fails_twice_gets_new_bytecode_but_not_each_time(
    robot: Robot, result: str, status: str, dropped: bool
) -> None:
    torn = robot.root / "var/cache/fullswarm/opt/fullswarm/releases/x/app/a.pyc"
    ended = {"SERVICE_RESULT": result, "EXIT_STATUS": status}
    for time in (1, 2, 3):
        torn.parent.mkdir(parents=True, exist_ok=True)
        torn.write_bytes(b"half")
        assert robot.call("ended", environment=ended).returncode == 0
        assert torn.exists() is not (dropped and time == 2)
