"""Whoever dies, wheels come to zero in time; when it is back, the robots go on. Real processes, real kills."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from fullswarm.keys import Keys
from fullswarm.messages import ControlRequest
from tests.system.live import START_S, LiveSwarm

PERIOD_S = 1 / 50
TTL_S = 0.3
CORE_SILENCE_S = 1.0
LOOK_S = 0.2
"""The world applies set-points each 20 ms, and this machine may be busy; the bounds themselves are exact in
tests/unit/test_agent_node.py."""

CONFIG = {
    "world": {"engine": "kinematic", "bounds_m": [0, 0, 40, 40], "watchdog_s": 5.0},
    "robot": [{"id": f"r{row}", "pose": [2.0, 2.0 + 2 * row, 0.0]} for row in range(3)],
}
FAR = {"goal": [38.0, 20.0], "gain": 0.5}


@pytest.fixture(scope="module")
def swarm() -> Iterator[LiveSwarm]:
    live = LiveSwarm(CONFIG, watch=True)
    yield live
    live.close()


@pytest.fixture(autouse=True)
def all_alive(swarm: LiveSwarm) -> None:
    assert swarm.world
    for name in swarm.supervisor.children:
        assert swarm.supervisor.alive(name)


def time_to_zero_s(swarm: LiveSwarm, bound_s: float) -> float:
    took_s = swarm.until(swarm.stands, bound_s + LOOK_S + 5.0, "all set-points are zero")
    assert took_s <= bound_s + LOOK_S
    swarm.rest(0.5)
    assert swarm.stands(), "and they stay zero"
    return took_s


def start(swarm: LiveSwarm, behaviour: str, **parameters: object) -> None:
    swarm.request(behaviour, parameters or FAR)  # type: ignore[arg-type]  # values of a test
    swarm.until(swarm.driven, 10.0, "all robots are driven")


def test_the_core(swarm: LiveSwarm) -> None:
    start(swarm, "move_to_goal")
    swarm.supervisor.kill("core")
    time_to_zero_s(swarm, CORE_SILENCE_S + PERIOD_S)
    swarm.supervisor.revive("core")
    swarm.until(swarm.driven, START_S, "the new core has taken up what the robots report")
    assert swarm.all_run("move_to_goal")


def test_the_core_while_a_centralised_behaviour_runs(swarm: LiveSwarm) -> None:
    start(swarm, "formation_assigned", shape="line", centre=[30.0, 20.0], spacing_m=2.0)
    swarm.supervisor.kill("core")
    # Commands pass through the core: the time-to-live ends them, long before the silent heartbeat does.
    time_to_zero_s(swarm, TTL_S + PERIOD_S)
    swarm.supervisor.revive("core")
    swarm.until(swarm.driven, START_S, "commands flow again")


def test_the_process_of_a_centralised_behaviour(swarm: LiveSwarm) -> None:
    start(swarm, "formation_assigned", shape="line", centre=[10.0, 20.0], spacing_m=2.0)
    swarm.supervisor.kill("centralised")
    time_to_zero_s(swarm, TTL_S + PERIOD_S)
    swarm.supervisor.revive("centralised")
    swarm.until(swarm.driven, START_S, "the core has told the new process what to do")


def test_the_hub(swarm: LiveSwarm) -> None:
    start(swarm, "move_to_goal")
    swarm.supervisor.kill("hub")
    time_to_zero_s(swarm, TTL_S + PERIOD_S)
    swarm.supervisor.revive("hub")
    swarm.until(swarm.driven, START_S, "the robots go on by themselves")


def test_a_request_made_while_the_hub_is_dead_happens_once(swarm: LiveSwarm) -> None:
    start(swarm, "move_to_goal")
    orders: dict[str, set[tuple[str, int]]] = {}

    def see(request: ControlRequest) -> None:
        if request.enable:
            orders.setdefault(request.robot, set()).add((request.request_id, request.sequence))

    watching = swarm.bus.subscribe(Keys(swarm.config.swarm).control_requests(), ControlRequest, see)
    swarm.supervisor.kill("hub")
    asked = swarm.operator.request("rendezvous", (), {})
    swarm.rest(1.0)
    assert asked.status is None, "nobody can have heard it yet"
    swarm.supervisor.revive("hub")
    swarm.until(lambda: asked.status is not None and asked.status.phase == "running", START_S, "it is confirmed")
    swarm.rest(1.0)
    watching.close()
    assert swarm.all_run("rendezvous")
    for robot in swarm.config.robots:
        mine = {sequence for request_id, sequence in orders[robot] if request_id == asked.request.id}
        assert len(mine) == 1, f"{robot} was told {len(mine)} times"


def test_an_operator_who_drives(swarm: LiveSwarm) -> None:
    swarm.operator.stop()
    swarm.until(swarm.stands, 5.0, "they stand")
    driver = swarm.spawn("drive", "--linear", "0.8")
    swarm.until(swarm.driven, 20.0, "all robots are driven by hand")
    driver.send_signal(signal.SIGKILL)
    driver.communicate()
    time_to_zero_s(swarm, TTL_S + PERIOD_S)


def test_an_operator_who_lets_go(swarm: LiveSwarm) -> None:
    driver = swarm.spawn("drive", "--linear", "0.8")
    swarm.until(swarm.driven, 20.0, "all robots are driven by hand")
    driver.send_signal(signal.SIGINT)
    time_to_zero_s(swarm, TTL_S + PERIOD_S)
    driver.communicate(timeout=5)


def test_a_stop_ends_the_driving_of_somebody_else(swarm: LiveSwarm) -> None:
    driver = swarm.spawn("drive", "--linear", "0.8")
    swarm.until(swarm.driven, 20.0, "all robots are driven by hand")
    swarm.operator.stop()
    time_to_zero_s(swarm, TTL_S + PERIOD_S)
    _, err = driver.communicate(timeout=10)
    assert driver.returncode == 1
    assert "stopped by" in err
    swarm.rest(1.0)
    assert swarm.stands()


def test_an_agent(swarm: LiveSwarm) -> None:
    start(swarm, "move_to_goal")
    swarm.supervisor.kill("r1")
    # Its body still has the last set-point (the world's own watchdog is 5 s here), and what it said last is still
    # fresh: neither may be taken for the new agent's.
    swarm.until(lambda: swarm.row("r1").age_s > 1.0, 5.0, "nothing comes from the dead agent")
    revived_s = swarm.clock.now_s()
    swarm.supervisor.revive("r1")
    swarm.until(lambda: swarm.all_run("move_to_goal"), START_S, "the new agent runs what was asked")
    swarm.until(lambda: swarm.driven_since("r1", revived_s), 10.0, "and drives")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_every_process_ends_within_a_second(swarm: LiveSwarm, number: signal.Signals) -> None:
    names = ["r0", "centralised", "core", "hub"]
    for name in names:
        process = swarm.supervisor.children[name].process
        assert process is not None
        process.send_signal(number)
        took_s = swarm.until(lambda process=process: process.poll() is not None, 10.0, f"{name} ends")  # type: ignore[misc]
        assert took_s <= 1.0 + LOOK_S
        assert process.returncode == (130 if number == signal.SIGINT else 0)
        assert "Traceback" not in swarm.supervisor.log_tail(name, 50)
    for name in reversed(names):
        swarm.supervisor.revive(name)
    swarm.rest(1.5)  # what the old processes said last must be too old to count
    swarm.until(swarm.ready, 60.0, "all are back")
