from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.core.centralised.behaviours import formation_assigned, voronoi_centralised
from fullswarm.core.centralised.joint_filter import Arena, JointFilter, to_twists
from fullswarm.core.centralised.law import Law, State, load
from fullswarm.core.centralised.node import CentralisedNode
from fullswarm.core.centralised.view import View
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.memory import rows
from fullswarm.messages import CentralisedCommands, CentralisedRequest, Heartbeat, RobotStates, Value
from fullswarm.parameters import Params
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.store import Store
from tests.unit.core_swarm import KEYS, Swarm, fresh

TURN = np.array([3.0, 4.25])


def arena(speed_m_s: float = 0.5) -> Arena:
    return Arena(np.array([-10.0, -10.0]), np.array([10.0, 10.0]), speed_m_s, 2.0, 0.03)


# ---------------------------------------------------------------- laws
@given(st.integers(2, 6), st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_the_assignment_is_the_best_of_all(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    positions, targets = rng.uniform(0, 10, (count, 2)), rng.uniform(0, 10, (count, 2))
    chosen = formation_assigned.assign(positions, targets, np.full(count, -1))

    def cost(order: tuple[int, ...]) -> float:
        return float(((positions - targets[list(order)]) ** 2).sum())

    assert cost(tuple(chosen.tolist())) == pytest.approx(min(map(cost, itertools.permutations(range(count)))))


def test_an_assignment_changes_only_when_it_is_clearly_better() -> None:
    targets = np.array([[0.0, 0.0], [1.0, 0.0]])
    kept = np.array([0, 1])
    assert formation_assigned.assign(np.array([[0.52, 1.0], [0.48, 1.0]]), targets, kept).tolist() == [0, 1]
    assert formation_assigned.assign(np.array([[0.9, 0.0], [0.1, 0.0]]), targets, kept).tolist() == [1, 0]


def ask(state: State, positions: Array, params: dict[str, Value], *present: int) -> Array:
    """Call a law for the robots `present` of a request, all when none are named."""
    index = np.array(present or range(len(positions)))
    count, zeros = len(index), np.zeros(len(index))
    members = tuple(f"r{row}" for row in range(len(positions)))
    view = View(
        index, members, positions[index], zeros, np.zeros((count, 2)), zeros, state.appeared(index), 0.0, 0.05,
        (0.0, 0.0, 9.0, 9.0),
    )  # fmt: skip
    return state.call(view, Params([params] * count))


def of(law: str | Law, count: int) -> State:
    return State(load(law) if isinstance(law, str) else law, tuple(f"r{row}" for row in range(count)), 0.0)


def test_formation_goes_on_with_those_who_are_left() -> None:
    state = of("formation_assigned", 3)
    params: dict[str, Value] = {"targets": [[0.0, 0.0], [5.0, 0.0], [9.0, 0.0]], "gain": 1.0}
    positions = np.array([[0.0, 1.0], [5.0, 1.0], [9.0, 1.0]])
    assert ask(state, positions, params).tolist() == [[0.0, -1.0]] * 3
    assert ask(state, positions, params, 0, 2).tolist() == [[0.0, -1.0]] * 2


@given(st.integers(1, 12), st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_voronoi_centroids_are_those_of_the_exact_cells(count: int, seed: int) -> None:
    low, high = np.array([0.0, -2.0]), np.array([6.0, 3.0])
    points = np.random.default_rng(seed).uniform(low, high, (count, 2))
    cells = [shapely.box(*low, *high) for _ in points]
    for i, j in itertools.permutations(range(count), 2):  # the same cells, cut out plane by plane
        middle, away = (points[i] + points[j]) / 2, points[i] - points[j]
        across = np.array([-away[1], away[0]])
        half = [
            middle + 50 * across,
            middle + 50 * across + 50 * away,
            middle - 50 * across + 50 * away,
            middle - 50 * across,
        ]
        scale = 50 / np.linalg.norm(away)
        half = [middle + (corner - middle) * scale for corner in half]
        cells[i] = cells[i].intersection(shapely.Polygon(half))
    found = voronoi_centralised.centroids(points, low, high)
    assert found == pytest.approx(np.array([[cell.centroid.x, cell.centroid.y] for cell in cells]), abs=2e-3)


def test_voronoi_bears_robots_on_one_spot_and_outside() -> None:
    low, high = np.array([0.0, 0.0]), np.array([4.0, 4.0])
    found = voronoi_centralised.centroids(np.array([[2.0, 2.0], [2.0, 2.0], [9.0, -3.0], [4.0, 4.0]]), low, high)
    assert np.isfinite(found).all()
    assert (found >= low).all()
    assert (found <= high).all()
    alone = voronoi_centralised.centroids(np.array([[0.5, 3.0]]), low, high)
    assert alone == pytest.approx(np.array([[2.0, 2.0]]), abs=1e-3)


def test_the_centroid_follows_the_stick_and_the_places_are_kept() -> None:
    state = of("teleop_centroid", 3)
    params: dict[str, Value] = {"vx": 1.0, "vy": 0.0, "speed_m_s": 0.4, "gain": 2.0}
    positions = np.array([[0.0, 0.0], [2.0, 0.0], [1.0, 3.0]])
    first = ask(state, positions, params)
    assert first == pytest.approx(np.array([[0.4, 0.0]] * 3))
    pushed = positions + np.array([[0.3, 0.0], [0.0, 0.0], [0.0, 0.0]])
    then = ask(state, pushed, params)
    assert then.mean(axis=0) == pytest.approx([0.4, 0.0])
    assert then[0, 0] < 0.4 < then[1, 0]
    fewer = ask(state, positions, params, 1, 2)
    assert fewer == pytest.approx(np.array([[0.4, 0.0]] * 2))


# ---------------------------------------------------------------- what a law remembers, and what it sees
@dataclass
class Memory:
    calls: Array = rows(fill=0)


def counting(view: View, params: Params, memory: Memory) -> Array:
    memory.calls += 1
    if params.fails[0, 0]:
        raise RuntimeError("after it has written")
    return np.stack([memory.calls.astype(float), view.appeared.astype(float)], axis=1)


COUNTING = Law("counting", counting, planar=True, memory=Memory)


def test_each_robot_keeps_its_own_memory_whoever_else_is_there() -> None:
    state, spots, quiet = of(COUNTING, 3), np.zeros((3, 2)), {"fails": 0.0}
    assert ask(state, spots, {**quiet}).tolist() == [[1, 1], [1, 1], [1, 1]]
    assert ask(state, spots, {**quiet}, 0, 2).tolist() == [[2, 0], [2, 0]]
    with pytest.raises(RuntimeError):
        ask(state, spots, {"fails": 1.0})
    assert ask(state, spots, {**quiet}).tolist() == [[3, 0], [2, 1], [3, 0]]  # the failure has left nothing
    other = state.copy()
    state.narrow(("r2", "r1"))
    assert ask(state, spots[:2], {**quiet}).tolist() == [[4, 1], [3, 1]]
    assert ask(other, spots, {**quiet}).tolist() == [[4, 0], [3, 0], [4, 0]]


@pytest.mark.parametrize("answer", [np.zeros(2), np.zeros((2, 3)), np.full((2, 2), math.nan)])
def test_an_answer_that_is_none_is_refused(answer: Array) -> None:
    with pytest.raises(ValueError, match=r"shape|finite"):
        ask(of(Law("odd", lambda *_: answer, planar=True, memory=None), 2), np.zeros((2, 2)), {})


def test_pairs_are_all_others_in_the_terms_of_a_law_on_board() -> None:
    positions = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])
    twist, heading = np.array([[1.0, 0.0], [2.0, 0.0], [0.5, 0.0]]), np.array([0.0, math.pi / 2, math.pi])
    view = View(
        np.array([0, 1, 3]), ("a", "b", "c", "d"), positions, heading, twist, np.full(3, 0.2), np.zeros(3, bool),
        1.5, 0.05, (0.0, 0.0, 9.0, 9.0),
    )  # fmt: skip
    others = [[1, 2], [0, 2], [0, 1]]
    for robot in range(3):
        mine = view.of == robot
        assert view.other[mine].tolist() == others[robot]
        assert view.offset[mine].tolist() == (positions[others[robot]] - positions[robot]).tolist()
        assert view.distance[mine] == pytest.approx(np.linalg.norm(positions[others[robot]] - positions[robot], axis=1))
    assert view.sum(view.offset) == pytest.approx(positions.sum(axis=0) - 3.0 * positions)
    assert (view.id.tolist(), view.neighbour_id.tolist()) == (["a", "b", "d"], ["b", "d", "a", "d", "a", "b"])
    assert view.neighbour_index.tolist() == [1, 3, 0, 3, 0, 1]
    assert view.neighbour_velocity[view.of == 0] == pytest.approx(np.array([[0.0, 2.0], [-0.5, 0.0]]))
    assert view.time_s.tolist() == [1.5] * 3


# ---------------------------------------------------------------- joint filter
def by_definition(wished: Array, positions: Array, radii: Array, world: Arena) -> Array:
    """Solve the same programme with another solver, straight from its definition."""
    count, constraints = len(wished), []
    for i, j in itertools.combinations(range(count), 2):
        offset = positions[i] - positions[j]
        distance = float(np.linalg.norm(offset))
        if distance > 3.0:
            continue
        budget = world.gain_per_s * max(distance - radii[i] - radii[j] - world.margin_m, 0.0)
        row = np.zeros(2 * count)
        row[2 * i : 2 * i + 2], row[2 * j : 2 * j + 2] = offset / distance, -offset / distance
        constraints.append({"type": "ineq", "fun": lambda u, row=row, budget=budget: budget + row @ u})
    room = radii[:, None] + world.margin_m
    low = -np.minimum(world.gain_per_s * np.maximum(positions - world.low - room, 0), world.speed_m_s)
    high = np.minimum(world.gain_per_s * np.maximum(world.high - positions - room, 0), world.speed_m_s)
    answer = minimize(
        lambda u: 0.5 * ((u - wished.ravel()) ** 2).sum(),
        np.zeros(2 * count),
        jac=lambda u: u - wished.ravel(),
        bounds=list(zip(low.ravel(), high.ravel(), strict=True)),
        constraints=constraints,
        method="SLSQP",
        options={"maxiter": 300, "ftol": 1e-12},
    )
    return np.asarray(answer.x, float).reshape(-1, 2)


@given(st.integers(2, 6), st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_joint_filter_equals_another_solver(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    world, radii = arena(), rng.uniform(0.1, 0.3, count)
    positions = rng.uniform(-1.5, 1.5, (count, 2)) + rng.choice([0.0, 9.0])
    wished = rng.uniform(-0.6, 0.6, (count, 2))
    found, _ = JointFilter().filter(wished, positions, radii, world)
    assert found == pytest.approx(by_definition(wished, positions, radii, world), abs=3e-3)


def test_an_updated_programme_gives_what_a_fresh_one_gives() -> None:
    rng = np.random.default_rng(4)
    world, radii, kept = arena(), np.full(8, 0.17), JointFilter()
    positions = rng.uniform(-1.0, 1.0, (8, 2))
    for _ in range(20):
        wished = rng.uniform(-0.5, 0.5, (8, 2))
        found, _ = kept.filter(wished, positions, radii, world)
        fresh, _ = JointFilter().filter(wished, positions, radii, world)
        assert found == pytest.approx(fresh, abs=2e-3)
        positions = positions + 0.05 * found
    assert kept.setups == 1  # all pairs stay near: the pattern never changed


def test_the_programme_is_set_up_again_when_pairs_come_and_go() -> None:
    world, radii, joint = arena(), np.full(2, 0.17), JointFilter()
    gaps = [2.9, 3.2, 3.4, 3.6, 3.2, 2.9]
    pairs = []
    for gap in gaps:
        positions = np.array([[0.0, 0.0], [gap, 0.0]])
        pairs.append(len(joint.filter(np.zeros((2, 2)), positions, radii, world)[1].first))
    assert pairs == [1, 1, 1, 0, 0, 1]
    assert joint.setups == 3


def test_a_head_on_pair_is_kept_apart_and_overlapping_robots_may_part() -> None:
    world, radii, joint = arena(), np.full(2, 0.17), JointFilter()
    positions, headings, dt_s = np.array([[-2.0, 0.0], [2.0, 0.01]]), np.array([0.0, math.pi]), 0.05
    nearest = math.inf
    for _ in range(400):
        wished = np.array([[0.5, 0.0], [-0.5, 0.0]])
        allowed, pairs = joint.filter(wished, positions, radii, world)
        twists = to_twists(allowed, pairs, positions, headings, radii, world, TURN)
        headings = headings + dt_s * twists[:, 1]
        positions = positions + dt_s * twists[:, :1] * np.stack([np.cos(headings), np.sin(headings)], axis=1)
        nearest = min(nearest, float(np.linalg.norm(positions[0] - positions[1])))
    assert 0.34 < nearest < 0.5  # never touching, and the wish to meet was followed that far
    overlapping = np.array([[0.0, 0.0], [0.2, 0.0]])
    apart, _ = joint.filter(np.array([[-0.3, 0.0], [0.3, 0.0]]), overlapping, radii, world)
    assert apart == pytest.approx(np.array([[-0.3, 0.0], [0.3, 0.0]]), abs=2e-3)
    closer, _ = joint.filter(np.array([[0.3, 0.0], [-0.3, 0.0]]), overlapping, radii, world)
    assert closer == pytest.approx(np.zeros((2, 2)), abs=2e-3)


@given(st.integers(2, 8), st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_no_gap_closes_too_fast_with_the_velocities_that_unicycles_really_have(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    world, radii, joint = arena(), np.full(count, 0.17), JointFilter()
    positions, headings = rng.uniform(-1.5, 1.5, (count, 2)), rng.uniform(-math.pi, math.pi, count)
    allowed, pairs = joint.filter(rng.uniform(-0.5, 0.5, (count, 2)), positions, radii, world)
    twists = to_twists(allowed, pairs, positions, headings, radii, world, TURN)
    real = twists[:, :1] * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    closing = -(pairs.unit * (real[pairs.first] - real[pairs.second])).sum(axis=1)
    assert (closing <= pairs.budget_m_s + 1e-6).all()
    assert (twists[:, 0] >= 0.0).all()
    assert (twists[:, 0] <= world.speed_m_s).all()


def test_a_robot_that_must_turn_far_stands_while_turning() -> None:
    world, radii, joint = arena(), np.full(2, 0.17), JointFilter()
    positions = np.array([[0.0, 0.0], [5.0, 0.0]])
    allowed, pairs = joint.filter(np.array([[-0.4, 0.0], [0.4, 0.0]]), positions, radii, world)
    twists = to_twists(allowed, pairs, positions, np.zeros(2), radii, world, TURN)
    assert twists[0] == pytest.approx([0.0, 4.25])
    assert twists[1] == pytest.approx([0.4, 0.0], abs=2e-3)


def test_walls_hold() -> None:
    world, joint = arena(), JointFilter()
    positions = np.array([[9.79, 0.0]])
    allowed, pairs = joint.filter(np.array([[0.5, 0.3]]), positions, np.array([0.17]), world)
    assert allowed[0] == pytest.approx([0.02, 0.3], abs=2e-3)
    twists = to_twists(allowed, pairs, positions, np.array([0.3]), np.array([0.17]), world, TURN)
    assert twists[0, 0] * math.cos(0.3) <= 0.02 + 1e-6


def test_without_an_answer_everybody_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fullswarm.core.centralised.joint_filter.SETTINGS", {"verbose": False, "max_iter": 1})
    positions = np.array([[0.0, 0.0], [0.5, 0.1]])
    found, _ = JointFilter().filter(np.array([[0.5, 0.1], [-0.5, 0.0]]), positions, np.full(2, 0.17), arena())
    assert (found == 0.0).all()


# ---------------------------------------------------------------- node and core together
class Drivers:
    """Robots that integrate their commands, 20 Hz."""

    def __init__(self, swarm: Swarm, places: dict[str, tuple[float, float]]) -> None:
        self.swarm, self.pose = swarm, {robot: [*place, 0.0] for robot, place in places.items()}
        self.silent: set[str] = set()
        swarm.runtime.every(0.05, self.step)

    def step(self) -> None:
        for robot, pose in self.pose.items():
            commands = self.swarm.robots[robot].commands
            if commands:
                pose[0] += 0.05 * commands[-1].linear_m_s * math.cos(pose[2])
                pose[1] += 0.05 * commands[-1].linear_m_s * math.sin(pose[2])
                pose[2] += 0.05 * commands[-1].angular_rad_s
            if robot not in self.silent:
                states = RobotStates(
                    host=robot, sequence=1, stamp_s=0.0, robots=(robot,), x_m=(pose[0],), y_m=(pose[1],),
                    heading_rad=(pose[2],), speed_m_s=(0.0,), turn_rad_s=(0.0,), radius_m=(0.17,),
                )  # fmt: skip
                self.swarm.bus.publish(KEYS.state("all", robot), states)


swarm = pytest.fixture(fresh)


TARGETS: list[float | list[float]] = [[8.0, 8.0], [2.0, 2.0], [2.0, 5.0]]


@pytest.mark.parametrize("behaviour", ["formation_assigned", "formation_assigned_bc"])
def test_a_centralised_formation_from_request_to_arrival(swarm: Swarm, behaviour: str) -> None:
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "c-1")
    drivers = Drivers(swarm, {"r0": (1.0, 1.0), "r1": (7.0, 7.0), "r2": (1.0, 5.0)})
    swarm.ask("a", behaviour, targets=TARGETS)
    swarm.run(0.2)
    assert swarm.status("a").phase == "running"
    task = swarm.robots["r0"].task
    assert task is not None
    assert task.centralised
    swarm.run(15.0)
    ends = {robot: pose[:2] for robot, pose in drivers.pose.items()}
    assert ends["r0"] == pytest.approx([2.0, 2.0], abs=0.1)
    assert ends["r1"] == pytest.approx([8.0, 8.0], abs=0.1)
    assert ends["r2"] == pytest.approx([2.0, 5.0], abs=0.1)
    command = swarm.robots["r0"].commands[-1]
    assert (command.ttl_s, command.request_id) == (swarm.config.agent.command_ttl_s, "a")
    swarm.ask("b", "flocking")
    swarm.run(0.3)
    counts = [len(robot.commands) for robot in swarm.robots.values()]
    swarm.run(1.0)
    assert [len(robot.commands) for robot in swarm.robots.values()] == counts
    node.close()


def test_robots_that_left_or_fell_silent_get_no_command(swarm: Swarm) -> None:
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "c-1")
    drivers = Drivers(swarm, {"r0": (1.0, 1.0), "r1": (7.0, 7.0), "r2": (1.0, 5.0)})
    swarm.ask("a", "voronoi_centralised")
    swarm.run(1.0)
    assert all(robot.commands for robot in swarm.robots.values())
    swarm.ask("b", "flocking", "r0")
    drivers.silent.add("r1")
    swarm.run(0.7)
    counts = {robot: len(each.commands) for robot, each in swarm.robots.items()}
    swarm.run(1.0)
    after = {robot: len(each.commands) for robot, each in swarm.robots.items()}
    assert (after["r0"], after["r1"]) == (counts["r0"], counts["r1"])
    assert after["r2"] == pytest.approx(counts["r2"] + 20, abs=1)
    node.close()


def test_the_node_is_told_again_after_its_restart_and_after_losses(swarm: Swarm) -> None:
    Drivers(swarm, {"r0": (1.0, 1.0), "r1": (7.0, 7.0), "r2": (1.0, 5.0)})
    swarm.ask("a", "voronoi_centralised")
    swarm.run(0.5)
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "c-1")
    lost = iter([True, True, True])
    swarm.bus.drop = lambda key, message: isinstance(message, CentralisedRequest) and next(lost, False)
    swarm.run(1.0)
    assert swarm.robots["r0"].commands
    sequence = swarm.robots["r0"].commands[-1].sequence
    node.close()
    swarm.run(0.5)
    count = len(swarm.robots["r0"].commands)
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "c-2")
    swarm.run(0.5)
    assert len(swarm.robots["r0"].commands) > count
    assert swarm.robots["r0"].commands[-1].sequence > sequence
    lost = iter([True])
    swarm.ask("s", "stop")
    swarm.run(0.5)
    count = len(swarm.sent(CentralisedCommands))
    swarm.run(0.5)
    assert len(swarm.sent(CentralisedCommands)) == count  # although the word to end was lost
    node.close()


def test_the_core_may_restart_without_memory_under_a_centralised_behaviour(swarm: Swarm) -> None:
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "c-1")
    Drivers(swarm, {"r0": (1.0, 1.0), "r1": (7.0, 7.0), "r2": (1.0, 5.0)})
    swarm.ask("a", "voronoi_centralised")
    swarm.run(0.5)
    swarm.core.close()
    swarm.store.close()
    swarm.start_core(Store())
    swarm.run(5.0)
    count = len(swarm.robots["r0"].commands)
    swarm.run(1.0)
    assert len(swarm.robots["r0"].commands) == pytest.approx(count + 20, abs=1)
    task = swarm.robots["r0"].task
    assert task is not None
    assert (task.request_id, task.core) == ("a", "core-2")
    swarm.ask("b", "flocking")
    swarm.run(1.0)
    count = len(swarm.sent(CentralisedCommands))
    swarm.run(0.5)
    assert len(swarm.sent(CentralisedCommands)) == count
    node.close()


def test_a_stick_on_the_centroid_streams_and_lapses(swarm: Swarm) -> None:
    node = CentralisedNode(swarm.bus, swarm.runtime, swarm.config, "c-1")
    drivers = Drivers(swarm, {"r0": (1.0, 1.0), "r1": (3.0, 1.0), "r2": (2.0, 3.0)})
    for k in range(40):
        swarm.ask(f"i{k}", "teleop_centroid", vx=1.0)
        swarm.run(0.05)
    moved = np.array([pose[0] for pose in drivers.pose.values()]) - [1.0, 3.0, 2.0]
    assert moved == pytest.approx(np.full(3, 1.0), abs=0.15)  # 2 s at 0.5 m/s, alike
    swarm.run(1.0)
    count = len(swarm.sent(CentralisedCommands))
    swarm.run(1.0)
    assert len(swarm.sent(CentralisedCommands)) == count
    assert swarm.status("i39").phase == "ended"
    node.close()


@pytest.mark.parametrize("parameters", [{"safety_margin_m": -5.0}, {"barrier_gain_per_s": math.nan}])
def test_a_request_that_would_switch_the_filter_off_is_not_computed(parameters: dict[str, float]) -> None:
    runtime = Runtime(SimClock(), Mailbox())
    bus, keys = LocalBus(runtime.mailbox), Keys("swarm")
    node = CentralisedNode(bus, runtime, SwarmConfig(), "n")
    active: list[tuple[str, ...]] = []
    bus.subscribe(keys.heartbeat("centralised"), Heartbeat, lambda beat: active.append(beat.active))
    for request_id, asked in (("bad", parameters), ("good", {})):
        request = CentralisedRequest(
            request_id=request_id, behaviour="teleop_centroid_bc", law="teleop_centroid", enable=True, robots=("r1",),
            parameters={**asked}, filtered=True, core="c", sequence=1,
        )  # fmt: skip
        bus.publish(keys.centralised_request("teleop_centroid_bc"), request)
    runtime.run(0.5)
    assert active[-1] == ("good",)
    node.close()
