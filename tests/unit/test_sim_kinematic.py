"""The kinematic kernels: compiled equals plain, grid equals brute force, no contact is missed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.config import WorldConfig
from fullswarm.kernels import Array, Kernel
from fullswarm.simulation import contacts, fleet, kinematic, obstacles, world
from fullswarm.simulation.engine import make_engine
from fullswarm.simulation.obstacles import with_trigonometry

R = 0.17


def swarm(n: int, seed: int) -> tuple[WorldConfig, Array, Array]:
    """Return a world with two boxes, starts on a grid and twists that soon collide."""
    rng = np.random.default_rng(seed)
    side = math.ceil(math.sqrt(n))
    starts = np.array([(0.3 + 0.45 * (i % side), 0.3 + 0.45 * (i // side), 0.0) for i in range(n)])
    starts[:, 2] = rng.uniform(-math.pi, math.pi, n)
    size = 0.45 * side + 1.6
    boxes = ((size - 0.6, 1.0, 0.5, 0.5, 0.3), (size - 0.6, size - 0.6, 0.4, 0.9, 2.0))
    config = WorldConfig(engine="kinematic", bounds_m=(0.0, 0.0, size, size), boxes=boxes)
    twists = np.stack([rng.uniform(0.0, 0.5, n), rng.uniform(-1.5, 1.5, n)], axis=1)
    return config, starts, twists


def run(n: int, steps: int) -> tuple[Array, Array, int]:
    config, starts, twists = swarm(n, seed=n)
    engine = make_engine(config, starts)
    touched = 0
    for _ in range(steps):
        engine.step(twists)
        touched += int(engine.referee.contacts.sum())
    return engine.pose, engine.twist, touched


@pytest.mark.parametrize("n", [9, 60])
def test_compiled_equals_plain(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    kernels = [
        each
        for module in (contacts, fleet, kinematic, obstacles, world)
        for each in vars(module).values()
        if isinstance(each, Kernel)
    ]
    for each in kernels:
        monkeypatch.setattr(each, "run", each.plain)
    pose, twist, touched = run(n, 25)
    for each in kernels:
        each.compile()
        assert each.run is not each.plain
    compiled_pose, compiled_twist, compiled_touched = run(n, 25)
    assert touched == compiled_touched > 0
    np.testing.assert_allclose(compiled_pose, pose, atol=1e-12, rtol=0)
    np.testing.assert_allclose(compiled_twist, twist, atol=1e-12, rtol=0)


@given(n=st.integers(1, 60), spread=st.floats(0.1, 50.0), seed=st.integers(0, 1000), skin=st.floats(0.1, 2.0))
@settings(max_examples=40, deadline=None)
def test_the_grid_finds_the_same_pairs_as_brute_force(n: int, spread: float, seed: int, skin: float) -> None:
    rng = np.random.default_rng(seed)
    pose, radius = rng.uniform(-spread, spread, (n, 3)), rng.uniform(0.01, 1.0, n)
    found = []
    for which in ("brute", "grid"):
        candidates = np.zeros((n * n + 1, 4), np.int64)
        if which == "brute":
            count = contacts.near_bodies(pose, radius, skin, candidates, 0)
        else:
            grid = np.zeros(8 * n + 64, np.int64)
            count = contacts.near_bodies_grid(pose, radius, skin, candidates, grid, 0)
        found.append(sorted(map(tuple, candidates[:count, :2].tolist())))
    assert found[0] == found[1]


@given(
    x=st.floats(-3, 3), y=st.floats(-3, 3), yaw=st.floats(-4, 4), half=st.tuples(st.floats(0.1, 1), st.floats(0.1, 1))
)
@settings(max_examples=100, deadline=None)
def test_a_point_moved_back_along_the_normal_lies_on_the_box(
    x: float, y: float, yaw: float, half: tuple[float, float]
) -> None:
    box = with_trigonometry(np.array([[0.4, -0.2, *half, yaw, 0.0]]))
    gap, nx, ny = obstacles.obstacle_gap(x, y, box, 0)
    assert math.hypot(nx, ny) == pytest.approx(1.0)
    on_x, on_y = x - gap * nx - 0.4, y - gap * ny + 0.2
    local = abs(on_x * math.cos(yaw) + on_y * math.sin(yaw)), abs(on_y * math.cos(yaw) - on_x * math.sin(yaw))
    assert max(local[0] - half[0], local[1] - half[1]) == pytest.approx(0.0, abs=1e-9)


def test_more_candidates_than_room_are_all_found() -> None:
    config, starts, twists = swarm(49, seed=1)
    tight, roomy = make_engine(config, starts), make_engine(config, starts)
    tight.referee.allocate(1)
    for _ in range(5):
        tight.step(twists)
        roomy.step(twists)
    assert len(tight.referee.candidates.pairs) > 1
    assert tight.pose.tobytes() == roomy.pose.tobytes()


def test_a_list_kept_over_steps_misses_no_contact() -> None:
    config, starts, twists = swarm(30, seed=5)
    engine = make_engine(config, starts)
    for _ in range(60):
        engine.step(twists)
        for i in range(30):
            apart = np.hypot(*(engine.pose[:, :2] - engine.pose[i, :2]).T)
            apart[i] = 9.0
            assert apart.min() > 2 * R - 1e-3
