"""What a control law remembers and knows: memory, time, names, members, random numbers, on one agent or on several."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fullswarm import memory
from fullswarm.agent.view import Params, View
from fullswarm.config import SwarmConfig
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Flags, Index
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.launch.network import with_network
from fullswarm.memory import allocate, rows
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator
from fullswarm.operator.params import ParamClient
from tests.unit.agent_bench import TICK_S, Bench
from tests.unit.laws import install

PLACES = [(2.0, 2.0, 0.0), (4.0, 2.0, 1.0), (3.0, 4.0, 2.0)]


@dataclass
class Memory:
    """Counts its calls and adds up time."""

    calls: Index = rows(fill=0)
    elapsed_s: Array = rows()
    place: Array = rows(2)


def counting(view: View, params: Params, kept: Memory) -> Array:
    kept.calls += 1
    kept.elapsed_s = kept.elapsed_s + view.dt_s
    kept.place[:] = view.position
    return np.zeros((len(view.position), 2)) + 0.0 * params.gain


COUNTING = SimpleNamespace(velocity=counting, Memory=Memory)


def kept(bench: Bench, row: int = 0) -> dict[str, list[float]]:
    return bench.agent.tasks.memory_of(row)


def about(calls: int) -> Any:
    """Return what equals a number of calls, or one less: a tick that falls on the end of a time may come after it."""
    return pytest.approx([calls], abs=1.01)


# ------------------------------------------------------------------ declarations
def test_rows_are_made_as_declared_and_assignments_write_into_them() -> None:
    @dataclass
    class Kept:
        number: Array = rows()
        pair: Array = rows(2, fill=1.5)
        count: Index = rows(fill=3)
        flag: Flags = rows(3, fill=True)

    made = allocate(Kept, 4)
    shapes = [(each.shape, each.dtype.kind) for each in (made.number, made.pair, made.count, made.flag)]
    assert shapes == [((4,), "f"), ((4, 2), "f"), ((4,), "i"), ((4, 3), "b")]
    assert (made.pair.tolist(), made.count.tolist(), made.flag.tolist()) == ([[1.5] * 2] * 4, [3] * 4, [[True] * 3] * 4)
    array = made.pair
    made.pair = made.pair + np.array([1.0, 2.0])
    made.pair += 1.0
    assert made.pair is array
    assert array.tolist() == [[3.5, 4.5]] * 4
    with pytest.raises(AttributeError, match=r"declares no 'pears' .*number, pair, count, flag"):
        made.pears = 1.0
    with pytest.raises(ValueError, match="broadcast"):
        made.pair = np.zeros((5, 2))
    other = allocate(Kept, 1)
    memory.copy_row(made, 2, other, 0)
    assert memory.as_lists(other, 0) == {"number": [0.0], "pair": [3.5, 4.5], "count": [3.0], "flag": [1.0, 1.0, 1.0]}


def test_a_wrong_declaration_is_refused_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    class Plain:
        number: Array = rows()

    @dataclass
    class Bare:
        number: float = 0.0

    @dataclass
    class Empty:
        pass

    for kind, text in ((Plain, "@dataclass"), (Bare, "number: Array = rows"), (Empty, "declares nothing")):
        with pytest.raises(ConfigError, match=r"Plain|Bare|Empty") as raised:
            allocate(kind, 1)
        assert text in f"{raised.value} {raised.value.hint}"
    with pytest.raises(ConfigError, match="whole numbers from 1"):
        rows(0)
    with pytest.raises(ConfigError, match="fill"):
        rows(fill="red")  # type: ignore[arg-type]  # what is tested
    bench = Bench(PLACES[:1])
    install(monkeypatch, bare=SimpleNamespace(velocity=counting, Memory=Bare))
    bench.enable("bare")
    assert not bench.acks[-1].accepted
    assert "number" in bench.acks[-1].reason


# ------------------------------------------------------------------ how long it is kept
def test_memory_lasts_as_long_as_the_request(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, counting=COUNTING)
    bench = Bench(PLACES)
    bench.enable("counting", {"gain": 1.0}, request_id="q1")
    bench.run(10 * TICK_S)
    assert kept(bench)["calls"] == about(10)
    assert kept(bench)["elapsed_s"] == pytest.approx([10 * TICK_S], abs=TICK_S)
    assert kept(bench, 1)["place"] == [4.0, 2.0]
    bench.enable("counting", {"gain": 2.0}, request_id="q1")  # renewed parameters
    bench.enable("counting", {"gain": [1.0, 2.0]}, request_id="q1")  # also where they regroup the robots
    bench.run(10 * TICK_S)
    assert kept(bench)["calls"] == about(20)
    bench.enable("counting", {"gain": 2.0}, robot="r2", request_id="q2")
    bench.run(5 * TICK_S)
    assert [kept(bench, row)["calls"] for row in range(3)] == [about(25), about(5), about(25)]
    bench.enable("stop", robot="r1", request_id="q3")
    bench.run(TICK_S)
    assert kept(bench) == {}
    bench.enable("counting", {"gain": 2.0}, robot="r1", request_id="q4")
    bench.run(2 * TICK_S)
    assert [kept(bench, row)["calls"] for row in range(3)] == [about(2), about(8), about(28)]
    bench.stop("s1")
    bench.run(TICK_S)
    assert [kept(bench, row) for row in range(3)] == [{}, {}, {}]


def test_the_frames_of_a_stick_go_on_with_one_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, counting=COUNTING)
    bench = Bench(PLACES[:1])
    for frame in range(5):
        bench.enable("counting", {"gain": 1.0}, request_id=f"frame-{frame}", team=7, expires_s=0.3)
        bench.run(2 * TICK_S)
    assert kept(bench)["calls"] == about(10)
    bench.enable("counting", {"gain": 1.0}, request_id="another", team=8, expires_s=0.3)  # another operator's
    bench.run(2 * TICK_S)
    assert kept(bench)["calls"] == about(2)


def test_on_board_a_law_that_remembers_is_called_once_per_tick_and_a_stop_still_acts_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def driving(view: View, params: Params, kept: Memory) -> Array:
        kept.calls += 1
        return np.array([[0.3, 0.0]])

    install(monkeypatch, driving=SimpleNamespace(velocity=driving, Memory=Memory))
    bench = Bench(PLACES[:1])
    bench.enable("driving")
    for _ in range(5):
        bench.enable("driving")  # the same request again
    bench.run(10 * TICK_S)
    assert kept(bench)["calls"] == about(10)
    assert bench.commanded[0, 0] > 0.0
    bench.estop(engaged=True, order="e1")  # between two ticks
    assert bench.commanded[0, 0] == 0.0


# ------------------------------------------------------------------ what it knows
def asked(monkeypatch: pytest.MonkeyPatch, question: Callable[[View], Any]) -> list[Any]:
    """Install a law "asking" that notes the answers to a question."""
    answers: list[Any] = []

    def asking(view: View, params: Params) -> Array:
        answers.append(question(view))
        return np.zeros((len(view.position), 2))

    install(monkeypatch, asking=asking)
    return answers


def test_a_law_knows_time_names_and_its_place_among_the_members(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = asked(
        monkeypatch,
        lambda view: (
            view.time_s.tolist(),
            view.dt_s,
            view.id.tolist(),
            view.members,
            view.index.tolist(),
            dict(zip(view.neighbour_id.tolist(), view.neighbour_index.tolist(), strict=True)),
        ),
    )
    bench = Bench(PLACES)
    members = ("r3", "r9", "r1", "r2")
    for robot in ("r1", "r3"):
        bench.enable("asking", robot=robot, members=members, request_id="q1")
    bench.run(0.5)
    time_s, dt_s, ids, found, index, neighbours = answers[-1]
    assert time_s == pytest.approx([0.5, 0.5], abs=TICK_S)
    assert dt_s == pytest.approx(TICK_S)
    assert (ids, found, index) == (["r1", "r3"], members, [2, 0])
    assert neighbours == {"r1": 2, "r2": 3, "r3": 0}
    bench.enable("asking", robot="r2", request_id="q1")  # a core that names no members
    bench.run(TICK_S)
    assert answers[-1][4] == [2, -1, 0]


def test_members_are_those_of_each_request_also_where_several_run_one_law(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = asked(monkeypatch, lambda view: (view.id.tolist(), view.members))
    bench = Bench(PLACES)
    bench.enable("asking", robot="r1", members=("r1", "r3"), request_id="q1")
    bench.enable("asking", robot="r2", members=("r2",), request_id="q2")
    bench.enable("asking", robot="r3", members=("r1", "r3"), request_id="q1")
    bench.run(2 * TICK_S)
    expected = [(["r1", "r3"], ("r1", "r3")), (["r2"], ("r2",))]
    assert answers == expected * 2  # from the first tick, once per request
    bench.enable("asking", robot="r2", members=("r2", "r4"), request_id="q3")
    bench.run(TICK_S)
    assert answers[-1] == (["r2"], ("r2", "r4"))


def test_a_law_knows_how_it_and_its_neighbours_move(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[Any, ...]] = []

    def asking(view: View, params: Params) -> Array:
        speed_m_s = np.hypot(*view.neighbour_velocity.T).tolist()
        seen.append((view.twist[:, 0].tolist(), view.odometry[:, 0].tolist(), view.battery.tolist(), speed_m_s))
        return np.array([[0.3, 0.0]] * len(view.position))

    install(monkeypatch, asking=asking)
    bench = Bench([(2.0, 2.0, 0.0), (2.0, 4.0, 0.0)])
    bench.enable("asking", robot="r1")
    bench.enable("stop", robot="r2")
    bench.run(2.0)
    twist, odometry, battery, others = seen[-1]
    assert twist == pytest.approx([0.3], abs=0.01)
    assert odometry == pytest.approx([bench.simulated.pose[0, 0] - 2.0], abs=0.02)
    assert (len(battery), others) == (1, [0.0])
    bench.enable("asking", robot="r2")
    bench.run(2.0)
    assert seen[-1][3] == pytest.approx([0.3, 0.3], abs=0.02)


def test_random_numbers_depend_on_seed_robot_behaviour_and_start_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def drawn(world: dict[str, Any], robots: str, behaviour: str = "asking", starts: int = 1) -> dict[str, list[float]]:
        answers = asked(monkeypatch, lambda view: dict(zip(view.id.tolist(), view.random.uniform(), strict=True)))
        bench = Bench(PLACES, world=world)
        for start in range(starts):
            answers.clear()
            for robot in robots.split():
                bench.enable("asking", robot=robot, request_id=f"q{start}", behaviour=behaviour)
            bench.run(3 * TICK_S)
        return {robot: [each[robot] for each in answers] for robot in robots.split()}

    all_three = drawn({}, "r1 r2 r3")
    assert len({tuple(each) for each in all_three.values()}) == 3
    assert drawn({}, "r2") == {"r2": all_three["r2"]}
    others = (drawn({"seed": 1}, "r2"), drawn({}, "r2", "wander"), drawn({}, "r2", starts=2))
    assert len({tuple(each["r2"]) for each in (all_three, *others)}) == 4


# ------------------------------------------------------------------ one agent of n robots, n agents of one
@dataclass
class Wandering:
    """Of the law below."""

    phase_rad: Array = rows()
    mean: Array = rows(2)
    seeking: Flags = rows(fill=True)


def wander(view: View, params: Params, kept: Any) -> Array:
    """Use everything that differs between robots."""
    kept.phase_rad += view.dt_s * (1.0 + view.index) + 0.01 * view.random.normal()
    kept.mean += 0.1 * view.sum(view.offset) / np.maximum(view.neighbours, 1.0)
    kept.seeking ^= view.random.uniform() < 0.02
    drift = view.sum(view.neighbour_velocity) + 0.05 * view.sum(np.stack([view.neighbour_index + 1.0] * 2, axis=1))
    away = np.where(kept.seeking, 1.0, -0.5)[:, None] * kept.mean
    moved: Array = 0.1 * away + 0.02 * drift
    return moved + 0.2 * np.stack([kept.phase_rad % 1.0, 0.3 * np.sin(view.time_s)], axis=1)


def test_robots_with_an_agent_each_move_as_those_of_one_agent_to_the_last_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, wander=SimpleNamespace(velocity=wander, Memory=Wandering))
    runs = [_setpoints(network) for network in (None, "loss=0%")]
    assert (np.abs(runs[0][-1]) > 0.0).all()
    assert np.array_equal(runs[0], runs[1])


def _setpoints(network: str | None) -> np.ndarray:
    robots = [{"id": f"r{row + 1}", "pose": pose} for row, pose in enumerate([*PLACES, (5.0, 4.0, -1.0)])]
    config = SwarmConfig.model_validate({"world": {"engine": "kinematic"}, "robot": robots})
    lockstep = Lockstep(with_network(config, network) if network else config)
    try:
        operator = Operator(lockstep.bus, Keys(), lockstep.runtime, "op")
        answers: list[RequestStatus] = []
        client = ParamClient(lockstep.bus, Keys(), lockstep.runtime, "op")
        client.ask("set", "behaviour/wander", lambda _: None, {"summary": "", "law": "wander"})
        lockstep.run(1.0)
        operator.request("wander", (), {}, answers.append)
        seen: list[np.ndarray] = []
        lockstep.runtime.every(
            TICK_S, lambda: seen.append(np.concatenate([each.setpoints for each in lockstep.agents]).copy())
        )
        lockstep.run(6.0)
        assert answers[-1].phase == "running"
        found: np.ndarray = np.array(seen)
        return found
    finally:
        lockstep.close()
