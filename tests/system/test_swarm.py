"""Core, world and eight agents as processes: all ten behaviours by request, a robot that dies, the shell."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from fullswarm.messages import Value
from tests.system.live import START_S, LiveSwarm

CONFIG = {
    "world": {"engine": "pybullet", "bounds_m": [0, 0, 10, 10], "boxes": [[5.0, 2.0, 1.0, 1.0, 0.3]]},
    "robot": [{"id": f"r{number}"} for number in range(1, 9)],
}
PLAIN: dict[str, dict[str, Value]] = {
    "move_to_goal": {"goal": [7.0, 7.0]},
    "flocking": {},
    "rendezvous": {},
    "formation": {"shape": "circle", "centre": [5.0, 6.0], "spacing_m": 1.0},
    "voronoi_coverage": {},
}


@pytest.fixture(scope="module")
def swarm() -> Iterator[LiveSwarm]:
    live = LiveSwarm(CONFIG, watch=False)
    yield live
    live.close()


def test_ten_behaviours_and_a_robot_that_dies(swarm: LiveSwarm) -> None:
    everybody = set(swarm.config.robots)
    missing: tuple[str, ...] = ()
    for number, (behaviour, parameters) in enumerate(PLAIN.items()):
        for name in (behaviour, f"{behaviour}_bc"):
            asked = swarm.request(name, parameters, missing=missing)
            assert set(swarm.status(asked).running) == everybody - set(missing)
        if number == 1:
            swarm.supervisor.kill("r3")
            missing = ("r3",)
            swarm.rest(2.0)
        elif number == 2:
            swarm.supervisor.revive("r3")
            missing = ()
            swarm.until(lambda: swarm.all_run("rendezvous_bc"), START_S, "r3 is back and runs what it missed")
    swarm.until(lambda: swarm.all_run("voronoi_coverage_bc"), 20.0, "all run what was asked last")


def test_status_and_watch_from_a_shell(swarm: LiveSwarm) -> None:
    status = swarm.json("status")
    assert {robot["robot"] for robot in status["robots"]} == set(swarm.config.robots)
    assert {*PLAIN, *(f"{name}_bc" for name in PLAIN)} <= set(swarm.json("behaviours"))


def test_a_request_from_a_shell(swarm: LiveSwarm) -> None:
    done = swarm.cli("request", "move_to_goal_bc", "--set", "goal=3,7", "--robots", "r1,r2", "--wait")
    assert done.returncode == 0, done.stderr
    row = swarm.row("r1")
    assert row.health
    assert row.health.behaviour == "move_to_goal_bc"
    other = swarm.row("r5")
    assert other.health
    assert other.health.behaviour != "move_to_goal_bc"


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("flokking",), "did you mean 'flocking'"),
        (("flocking", "--robots", "r99"), "r99"),
        (("move_to_goal",), "goal"),
        (("move_to_goal", "--set", "goal=1,2", "--set", "gain=99"), "gain"),
        (("move_to_goal", "--set", "gaol=1,2"), "did you mean 'goal'"),
    ],
)
def test_a_refusal_says_why(swarm: LiveSwarm, arguments: tuple[str, ...], complaint: str) -> None:
    refused = swarm.cli("request", *arguments)
    assert refused.returncode == 2
    assert complaint in refused.stderr
    assert "Traceback" not in refused.stderr


def test_settings_from_a_shell(swarm: LiveSwarm) -> None:
    assert swarm.cli("params", "set", "schedule_interval_s", "0.1").returncode == 0
    entries = swarm.json("params", "get", "schedule*")
    assert "0.1" in str(entries)
    refused = swarm.cli("params", "set", "schedule_interval_s", "-3")
    assert refused.returncode == 2
    assert "schedule_interval_s" in refused.stderr


def test_stop_and_estop_from_a_shell(swarm: LiveSwarm) -> None:
    swarm.request("flocking_bc")
    assert swarm.cli("stop").returncode == 0
    swarm.until(lambda: not any(row.health and row.health.moving for row in swarm.view.snapshot().robots), 5.0, "rest")
    swarm.request("flocking_bc")
    stopped = swarm.cli("estop", "--reason", "test")
    assert stopped.returncode == 0, stopped.stderr
    assert all(row.health and row.health.estop for row in swarm.view.snapshot().robots)
    refused = swarm.cli("request", "flocking_bc", "--wait", "--timeout", "3")
    assert refused.returncode == 4
    assert "e-stop is latched" in refused.stderr
    assert swarm.cli("estop", "--clear").returncode == 0
    swarm.rest(1.0)
    assert not any(row.health and (row.health.estop or row.health.moving) for row in swarm.view.snapshot().robots)


def test_an_operator_without_a_hub_is_told_so(swarm: LiveSwarm) -> None:
    lost = swarm.cli("status", "--hub", "tcp/127.0.0.1:9")
    assert lost.returncode == 3
    assert "no hub answers (start a swarm with `fullswarm up" in lost.stderr
