"""What control laws remember reaches operators and results: slowly, bounded, by name."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fullswarm.agent.telemetry.remembered import bounded
from fullswarm.bus.codec import encode
from fullswarm.evaluate.experiment.model import parse_experiment
from fullswarm.evaluate.experiment.plan import plan
from fullswarm.evaluate.lockstep_swarm import measure
from fullswarm.evaluate.trial import Keeper
from fullswarm.evaluate.trial_folder import TRIALS, read_memories
from fullswarm.kernels import Array, Flags, Index
from fullswarm.memory import rows
from fullswarm.messages import MEMORY_NUMBERS, BehaviourMemory
from fullswarm.operator.console.fleet import fleet
from fullswarm.operator.render import footer_lines
from fullswarm.operator.view import FleetView
from tests.unit.agent_bench import Bench
from tests.unit.laws import install


@dataclass
class Memory:
    leg: Index = rows(fill=0)
    integral: Array = rows(2)
    lost: Flags = rows(fill=False)
    bearing: Array = rows(fill=math.nan)


def count(view: Any, _: Any, kept: Memory) -> np.ndarray:
    kept.leg[:] = np.floor(view.time_s).astype(int)
    kept.integral += view.dt_s * np.array([1.0, -1.0])
    kept.lost[:] = view.id == "r2"
    return np.zeros_like(view.position)


@pytest.fixture(autouse=True)
def _law(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, count=SimpleNamespace(velocity=count, Memory=Memory))


def test_operators_see_what_laws_remember_by_name_and_only_while_they_do() -> None:
    bench = Bench([(2.0, 2.0, 0.0), (4.0, 2.0, 0.0)])
    sent: list[BehaviourMemory] = []
    bench.bus.subscribe(bench.keys.memory(), BehaviourMemory, sent.append)
    view = FleetView(bench.bus, bench.keys, bench.runtime)
    bench.enable("flocking", robot="r1")
    bench.run(3.0)
    assert sent == []
    bench.enable("count")
    bench.run(3.05)
    assert 2 <= len(sent) <= 4
    r1, r2 = sent[-1].robots
    assert (r1.robot, r1.behaviour, r1.request_id) == ("r1", "count", "q-count")
    assert r1.fields["leg"] == (2.0,)
    assert r1.fields["integral"] == pytest.approx((2.9, -2.9), abs=0.2)
    assert (r1.fields["lost"], r2.fields["lost"], r1.fields["bearing"]) == ((0.0,), (1.0,), (None,))
    seen = view.snapshot()
    (row, _) = seen.robots
    assert row.memory == r1
    assert seen.as_dict()["robots"][0]["memory"]["leg"] == [2.0]  # type: ignore[index]
    (line,) = [line for line in footer_lines(seen) if line.startswith("r1 remembers leg 2, integral 2.")]
    assert line.endswith("lost 0, bearing -")
    assert fleet(seen, 0.0)["robots"][0]["memory"].startswith("leg 2, integral")
    bench.stop("s")
    bench.run(1.1)
    assert sent[-1].robots == ()
    assert view.snapshot().robots[0].memory is None
    before = len(sent)
    bench.run(3.0)
    assert len(sent) == before


def test_a_large_memory_is_cut_and_says_so() -> None:
    fields, left_out = bounded({"a": [1.0] * 40, "b": [2.0] * 40, "c": [math.inf]})
    assert {name: len(values) for name, values in fields.items()} == {"a": 40, "b": MEMORY_NUMBERS - 40}
    assert left_out == 17
    assert bounded({"c": [math.inf, 1.0]}) == ({"c": (None, 1.0)}, 0)
    bench = Bench([(2.0, 2.0, 0.0)])
    sent: list[BehaviourMemory] = []
    bench.bus.subscribe(bench.keys.memory(), BehaviourMemory, sent.append)

    @dataclass
    class Grid:
        cells: Array = rows(50, 50)

    law = SimpleNamespace(velocity=lambda view, _, __: np.zeros_like(view.position), Memory=Grid)
    with pytest.MonkeyPatch.context() as patch:
        install(patch, grid=law)
        bench.enable("grid")
        bench.run(1.5)
    assert sent[-1].robots[0].left_out == 2500 - MEMORY_NUMBERS
    assert len(encode(sent[-1])) < 1000


EXPERIMENT = """
name = "remember"
seeds = "0"
[limits.l]
speed_limit_m_s = 0.5
turn_limit_rad_s = 3.0
[[groups]]
name = "g"
behaviours = [{ name = "BEHAVIOUR" }]
scenarios = ["empty_dense"]
robots = [2]
engines = ["kinematic"]
limits = ["l"]
time_limit_s = 3.0
"""


def test_a_trial_keeps_what_laws_remembered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fullswarm.agent.behaviours import move_to_goal

    def law(view: Any, params: Any, kept: Memory) -> np.ndarray:
        count(view, params, kept)
        return move_to_goal.velocity(view, params)

    install(monkeypatch, move_to_goal=SimpleNamespace(velocity=law, Memory=Memory))
    for behaviour in ("move_to_goal_bc", "rendezvous_bc"):
        (trial,) = plan(parse_experiment(EXPERIMENT.replace("BEHAVIOUR", behaviour), "x.toml"))
        Keeper(tmp_path / behaviour, "remember", measure)(trial)
    (folder,) = (tmp_path / "move_to_goal_bc" / TRIALS).iterdir()
    found = read_memories(folder)
    robots = sorted(set(found.robot.tolist()))
    assert len(robots) == 2
    assert set(found.name.tolist()) == {"leg", "integral.0", "integral.1", "lost", "bearing"}
    legs = found.value[(found.robot == robots[0]) & (found.name == "leg")]
    assert legs.tolist() == sorted(legs.tolist())
    assert len(legs) >= 3
    assert set(found.behaviour.tolist()) == {"move_to_goal_bc"}
    (other,) = (tmp_path / "rendezvous_bc" / TRIALS).iterdir()
    assert not (other / "memory.npz").exists()
    assert (other / "result.json").exists()
