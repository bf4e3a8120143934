"""A lockstep swarm on a bad network: nobody collides, every request happens once, who is cut off stops."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fullswarm.agent.orders.tasks import Task, Tasks
from fullswarm.bus.base import NamedBus
from fullswarm.bus.local import LocalBus
from fullswarm.bus.network_faults import FaultyBus
from fullswarm.config import SwarmConfig, load_swarm
from fullswarm.config.fleet_file import write_swarm
from fullswarm.core.leases import EXPIRE_S
from fullswarm.demo.run import demo_config, run_lockstep
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.launch.network import on_network, with_network
from fullswarm.messages import Leases, Ping
from fullswarm.operator.client import Operator
from fullswarm.operator.leases import LeaseHolder

BAD = "loss=20%,delay=100ms±50"
PERIOD_S = 1 / 50


class Trial:
    """Robots r0, r1, … in a row, and an operator."""

    def __init__(self, conditions: str, seed: int = 0, robots: int = 6, apart_m: float = 1.0) -> None:
        self.lockstep = Lockstep(
            SwarmConfig.model_validate(
                {
                    "world": {"engine": "kinematic", "bounds_m": [0, 0, 30, 30]},
                    "robot": [{"id": f"r{k}", "pose": (2.0, 2.0 + apart_m * k, 0.0)} for k in range(robots)],
                    "network": {"conditions": conditions, "seed": seed},
                }
            )
        )
        numbers = count()
        bus = self.lockstep.bus_of("operator")
        self.operator = Operator(bus, Keys(), self.lockstep.runtime, "op", new_id=lambda: f"q{next(numbers)}")

    def run(self, seconds: float) -> None:
        self.lockstep.run(seconds)

    @property
    def collisions(self) -> int:
        return sum(int(agent.calculators.collisions.sum()) for agent in self.lockstep.agents)

    def driven(self, robot: int) -> bool:
        return bool(self.lockstep.world.target[robot].any())

    def until_stands_s(self, robot: int, limit_s: float) -> float:
        began_s = self.lockstep.runtime.now_s()
        while self.driven(robot) and self.lockstep.runtime.now_s() - began_s < limit_s:
            self.run(PERIOD_S)
        assert not self.driven(robot)
        return self.lockstep.runtime.now_s()


@contextmanager
def trial(conditions: str, **settings: Any) -> Iterator[Trial]:
    made = Trial(conditions, **settings)
    try:
        yield made
    finally:
        made.operator.close()
        made.lockstep.close()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("conditions", [BAD, f"{BAD},duplicate=20%,reorder=20%"])
def test_nobody_collides_and_each_request_happens_once(
    conditions: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: Counter[tuple[str, str]] = Counter()
    enable = Tasks.enable

    def spy(tasks: Tasks, row: int, task: Task) -> None:
        begun[task.request.robot, task.request.request_id] += 1
        enable(tasks, row, task)

    monkeypatch.setattr(Tasks, "enable", spy)
    with trial(conditions, seed=seed) as made:
        made.run(2.0)
        asked = []
        for goal in ([9.0, 4.0], [2.0, 9.0], [6.0, 6.0]):
            parameters = {"goal": goal, "arrive_radius_m": 1.5}
            asked.append(made.operator.request("move_to_goal_bc", (), parameters))  # type: ignore[arg-type]
            made.run(6.0)
        assert all(each.status is not None for each in asked)
        robots = made.lockstep.config.robots
        # Asked again and again, answered again and again, carried out once.
        assert begun == {(robot, each.request.id): 1 for robot in robots for each in asked}
        assert made.collisions == 0
        travelled_m = sum(float(agent.calculators.distance_m.sum()) for agent in made.lockstep.agents)
        assert travelled_m > 20.0


def test_a_robot_that_is_cut_off_stops_and_comes_back() -> None:
    with trial("partition=r1|*@4s-8s", apart_m=3.0) as made:
        made.run(1.0)
        made.operator.request("move_to_goal_bc", (), {"goal": [25.0, 10.0]})
        made.run(2.99)
        assert all(made.driven(row) for row in range(6))
        stood_s = made.until_stands_s(1, 3.0)
        assert 4.5 < stood_s <= 5.0 + 2 * PERIOD_S  # the heartbeat's silence, one period, one of the world
        made.run(7.9 - stood_s)
        assert [made.driven(row) for row in range(6)] == [True, False, True, True, True, True]
        made.run(2.0)
        assert all(made.driven(row) for row in range(6)), "the core has told it what is wanted, without a new request"


def test_nothing_is_exempt() -> None:
    """Not the e-stop: the answer names the robot that did not hear it; it gets the order when it hears again."""
    with trial("partition=r1|*@2s-9s", robots=3, apart_m=3.0) as made:
        made.run(3.0)
        order = made.operator.estop(True, known=lambda: ("r0", "r1", "r2"), deadline_s=5.0)
        made.run(1.0)
        assert order.unconfirmed() == ("r1",)
        assert [bool(agent.controller.estop[0]) for agent in made.lockstep.agents] == [True, False, True]
        made.run(7.0)
        assert all(agent.controller.estop[0] for agent in made.lockstep.agents), "the core has passed it on"


def test_a_stop_gets_through_a_loss() -> None:
    with trial("loss=50%", robots=4, apart_m=3.0) as made:
        made.run(2.0)
        made.operator.request("move_to_goal_bc", (), {"goal": [25.0, 10.0]})
        made.run(4.0)
        assert any(made.driven(row) for row in range(4))
        made.operator.stop()
        made.run(2.0)
        assert not any(made.driven(row) for row in range(4))


# ---------------------------------------------------------------- leases and pings
def test_leases_do_not_pass_a_partition() -> None:
    """A lease that the core no longer hears of expires; what is asked for meanwhile is granted afterwards."""
    with trial("partition=operator|*@3s-9s", robots=2) as made:
        lockstep, keys = made.lockstep, Keys()
        said: list[Leases] = []
        lockstep.bus.subscribe(keys.leases, Leases, said.append)  # as the core sent them

        def holders() -> dict[str, str]:
            return {lease.robot: lease.operator for lease in said[-1].leases}

        here = LeaseHolder(lockstep.bus_of("operator"), keys, lockstep.runtime, "anna")
        core_side = LeaseHolder(lockstep.bus_of("world"), keys, lockstep.runtime, "bert")
        here.hold(("r0",))
        made.run(2.9)
        assert holders() == {"r0": "anna"}
        here.hold(("r1",))  # heard: the partition begins later
        made.run(0.2)
        sequence = here._sequence
        made.run(EXPIRE_S + 1.0)
        assert holders() == {}, "nothing renewed them"
        assert here._sequence == sequence, "nor does the operator hear the core"
        core_side.hold(("r1",))
        made.run(0.2)
        assert holders() == {"r1": "bert"}
        made.run(3.0)
        assert holders() == {"r0": "anna", "r1": "bert"}, "asked for again after the partition, but not taken"
        assert here.held() == ("r0",)


@pytest.mark.parametrize("delay_ms", [0, 100])
def test_a_ping_takes_the_way_there_and_back(delay_ms: int) -> None:
    with trial(f"delay={delay_ms}ms", robots=1) as made:
        made.run(1.0)
        bus, keys, came_s = made.lockstep.bus_of("operator"), Keys(), list[float]()
        bus.subscribe(keys.pong("r0"), Ping, lambda _: came_s.append(made.lockstep.runtime.now_s()))
        bus.publish(keys.ping("r0"), Ping(id="p1", robot="r0"))
        made.run(1.0)
        assert came_s == [pytest.approx(1.0 + 2 * delay_ms / 1000, abs=1e-6)]


def shown(capsys: pytest.CaptureFixture[str], conditions: str | None, seed: int) -> str:
    config = demo_config(None, ("world.engine=kinematic",), conditions)
    run_lockstep(config, 6.0, seed, as_json=True)
    out = capsys.readouterr().out
    return out[out.index("{\n") :]  # log lines before it have the time of day


def test_a_seed_repeats_to_the_byte(capsys: pytest.CaptureFixture[str]) -> None:
    first = shown(capsys, BAD, 5)
    assert shown(capsys, BAD, 5) == first
    assert shown(capsys, BAD, 6) != first
    assert json.loads(first)["collisions"] == 0


def test_without_the_flag_nothing_stands_in_between() -> None:
    config = demo_config(None, ("world.engine=kinematic",))
    lockstep = Lockstep(config)
    try:
        assert not isinstance(lockstep.bus_of("core"), FaultyBus)
        assert len(lockstep.agents) == 1
        assert isinstance(lockstep.bus, LocalBus)
        assert isinstance(on_network(lockstep.bus, lockstep.runtime, config, "r1"), NamedBus)
    finally:
        lockstep.close()
    lockstep = Lockstep(with_network(config, "loss=0%"))
    try:
        assert isinstance(lockstep.bus_of("core"), FaultyBus)
        assert [agent.identity.host for agent in lockstep.agents] == list(config.robots)
    finally:
        lockstep.close()


def test_it_goes_through_a_fleet_file(tmp_path: Path) -> None:
    config = demo_config(None, (), f"{BAD},partition=r1+r2|*@5s-10s")
    write_swarm(config, tmp_path / "fleet.toml")
    assert load_swarm(tmp_path / "fleet.toml") == config


def test_errors_of_a_fleet_file_name_line_and_key(tmp_path: Path) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text('[network]\nconditions = "loss=20"\n[[robot]]\nid = "a"\n')
    with pytest.raises(ConfigError, match=r"fleet.toml:2: network.conditions: 'loss=20' at character 1: '20' is not"):
        load_swarm(path)
    path.write_text('[network]\nconditions = "partition=b|*"\n[[robot]]\nid = "a"\n')
    with pytest.raises(ConfigError, match=r"network\.conditions: the partition names 'b'"):
        with_network(load_swarm(path), None)
    with pytest.raises(ConfigError, match="--network: the partition names 'b'"):
        with_network(load_swarm(path), "partition=b|*")


def test_bodies_of_a_bad_network_are_those_of_a_good_one() -> None:
    """An agent for each robot drives like one that carries all, when the network does nothing."""
    ends = []
    for conditions in (None, "loss=0%"):
        config = with_network(demo_config(None, ("world.engine=kinematic",)), conditions)
        lockstep = Lockstep(config)
        operator = Operator(lockstep.bus_of("operator"), Keys(), lockstep.runtime, "op", new_id=lambda: "q")
        lockstep.run(1.0)
        operator.request("move_to_goal", (), {"goal": [7.0, 7.0]})
        lockstep.run(2.0)
        ends.append(lockstep.world.pose.copy())
        operator.close()
        lockstep.close()
    assert np.abs(ends[0] - ends[1]).max() < 0.02
