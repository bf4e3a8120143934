"""The referee of a world: every graze is seen on every engine, and nothing that is none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fullswarm.config import WorldConfig
from fullswarm.kernels import Array
from fullswarm.simulation.contacts import TOUCH_M, touch_m
from fullswarm.simulation.engine import Engine, make_engine

R = 0.17
TRIES = 8
SPEEDS_M_S = (0.5, 1.0, 2.0, 4.0)
OVERLAPS_M = (0.005, 0.03, 0.1, 0.2)
CLEAR_M = 0.005
APART_M = 20.0


def config_of(name: str, **more: object) -> WorldConfig:
    return WorldConfig.model_validate({"engine": name, "walls": False, "bounds_m": (-99.0, -99.0, 99.0, 99.0), **more})


def driven(config: WorldConfig, starts: list[tuple[float, float, float]], twists: Array) -> tuple[Array, set[str]]:
    """Return where the bodies were after each step, (t, n, 2), and which pairs the referee named."""
    engine = make_engine(config, np.array(starts))
    places, seen = [engine.pose[:, :2].copy()], set()
    for twist in twists:
        engine.step(np.tile(twist, (len(starts), 1)))
        places.append(engine.pose[:, :2].copy())
        seen |= {str(sorted(pair)) for pair in engine.referee.pairs.tolist()}
    engine.close()
    return np.array(places), seen


def least_m(first: Array, second: Array) -> float:
    """Return the smallest distance of two bodies that move straight between places (t, 2)."""
    apart = first - second
    moved = np.diff(apart, axis=0)
    part = np.clip(-(apart[:-1] * moved).sum(1) / np.maximum((moved * moved).sum(1), 1e-15), 0.0, 1.0)
    return float(np.hypot(*(apart[:-1] + part[:, None] * moved).T).min())


def meets(name: str, speed_m_s: float, overlap_m: float, seed: int) -> bool:
    """Tell whether two robots that pass each other head-on are seen to touch.

    Wheels slip, so both drive their ways at a distance first; then one is put where the ways overlap by `overlap_m`.
    """
    rng = np.random.default_rng(seed)
    ramp = math.ceil(speed_m_s / 2.0 / 0.02) if name == "pybullet-wheels" else 0
    run_m = 0.3 + 0.1 * speed_m_s + 0.01 * speed_m_s * ramp + rng.uniform(0.0, 0.02 * speed_m_s)
    steps = int(100.0 * run_m / speed_m_s) + ramp // 2 + 5
    twists = np.array([[speed_m_s * min(1.0, (step + 1) / (ramp + 1)), 0.0] for step in range(steps)])
    turn = rng.uniform(-math.pi, math.pi)
    along, left = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])

    def starts(aside_m: float) -> list[tuple[float, float, float]]:
        first, second = -run_m * along, run_m * along + aside_m * left
        return [(*first.tolist(), turn), (*second.tolist(), math.remainder(turn + math.pi, 2 * math.pi))]

    config = config_of(name)
    free, seen = driven(config, starts(APART_M), twists)
    assert not seen
    low, high = 0.0, 1.0
    for _ in range(50):
        aside_m = (low + high) / 2
        near = least_m(free[:, 0], free[:, 1] - (APART_M - aside_m) * left) < 2 * R - overlap_m
        low, high = (aside_m, high) if near else (low, aside_m)
    return bool(driven(config, starts(high), twists)[1])


def graze_table(
    name: str, overlaps_m: tuple[float, ...], speeds_m_s: tuple[float, ...] = SPEEDS_M_S
) -> list[list[int]]:
    """Return in how many of the tries the robots were seen to touch: a row per speed, a column per overlap."""
    return [
        [sum(meets(name, speed_m_s, overlap_m, seed) for seed in range(TRIES)) for overlap_m in overlaps_m]
        for speed_m_s in speeds_m_s
    ]


@pytest.mark.parametrize("name", ["kinematic", "pybullet"])
def test_every_graze_is_seen_and_nothing_that_is_none(name: str) -> None:
    assert graze_table(name, (-CLEAR_M, *OVERLAPS_M)) == [[0, TRIES, TRIES, TRIES, TRIES]] * 4


def test_a_graze_of_wheels_is_seen() -> None:
    assert graze_table("pybullet-wheels", (-CLEAR_M, 0.005), (2.0,)) == [[0, TRIES]]


@pytest.mark.slow
def test_every_graze_of_wheels_is_seen_and_nothing_that_is_none() -> None:
    assert graze_table("pybullet-wheels", (-CLEAR_M, *OVERLAPS_M)) == [[0, TRIES, TRIES, TRIES, TRIES]] * 4


@pytest.mark.parametrize("name", ["kinematic", "pybullet"])
@pytest.mark.parametrize(("overlap_m", "sees"), [(-CLEAR_M, False), (0.002, True), (0.05, True)])
def test_a_corner_that_is_grazed_is_seen(name: str, overlap_m: float, sees: bool) -> None:
    """A robot passes the corner of a turned box: the nearest point of the box to its way."""
    for speed_m_s in SPEEDS_M_S:
        for seed in range(4):
            start_m = -1.0 - np.random.default_rng(seed).uniform(0.0, 0.02 * speed_m_s)
            config = config_of(name, boxes=((0.0, 0.0, 0.6, 0.6, math.pi / 4),))
            y_m = 0.3 * math.sqrt(2.0) + R - overlap_m
            twists = np.tile([speed_m_s, 0.0], (int(2.5 / speed_m_s / 0.02), 1))
            _, seen = driven(config, [(start_m, y_m, 0.0)], twists)
            assert bool(seen) is sees, (speed_m_s, seed)


def test_who_looks_closely_does_not_change_what_happens() -> None:
    """Bullet is asked after each substep only while bodies are near each other: the motion is the same to the bit."""
    starts = np.array([(1.0 + 0.5 * (i % 4), 1.0 + 0.5 * (i // 4), 0.9 * i) for i in range(12)])
    rng = np.random.default_rng(5)
    close, far = (make_engine(config_of("pybullet"), starts) for _ in range(2))
    far.referee.look_ahead = lambda pose, furthest_m: []  # type: ignore[method-assign]  # nobody is ever near
    for _ in range(120):
        twists = rng.uniform(-1.0, 1.0, (12, 2)) * [2.0, 3.0]
        close.step(twists)
        far.step(twists)
    assert close.referee.path.any()
    assert close.pose.tobytes() == far.pose.tobytes()
    close.close()
    far.close()


@pytest.mark.parametrize("name", ["kinematic", "pybullet"])
def test_a_crowd_is_counted_as_by_all_pairs(name: str) -> None:
    """All pairs, all parts of all paths, finely sampled, against lists of neighbours and exact distances."""
    config = config_of(name, boxes=((3.0, 3.0, 0.7, 0.4, 0.5),))
    angles = np.linspace(0.0, 2 * math.pi, 24, endpoint=False)
    ring = [(3.0 + 2.5 * math.cos(a), 3.0 + 2.5 * math.sin(a), math.remainder(a + 3.0, 2 * math.pi)) for a in angles]
    engine = make_engine(config, np.array(ring))
    everyone = list(range(24))
    if name == "pybullet":  # whose path knows of those alone who may touch
        listed = engine.referee.look_ahead

        def all_rows(pose: Array, furthest_m: float) -> list[int]:
            listed(pose, furthest_m)
            return everyone

        engine.referee.look_ahead = all_rows  # type: ignore[method-assign]
    rng, met = np.random.default_rng(1), 0
    for _ in range(100):
        engine.step(np.stack([rng.uniform(0.0, 4.0, 24), rng.uniform(-2.0, 2.0, 24)], axis=1))
        found = {tuple(sorted(pair)) for pair in engine.referee.pairs.tolist()}
        assert found == sampled(engine, config)
        met += len(found)
    engine.close()
    assert met > 50


def sampled(engine: Engine, config: WorldConfig) -> set[tuple[int, ...]]:
    """Return the touching pairs, from 400 places on each part of the path."""
    part = np.linspace(0.0, 1.0, 400)[None, :, None, None]
    path = engine.referee.path
    places = (path[:-1, None] * (1.0 - part) + path[1:, None] * part).reshape(-1, path.shape[1], 2)
    found: set[tuple[int, ...]] = set()
    for i in range(path.shape[1]):
        apart = np.hypot(*(places - places[:, i : i + 1]).transpose(2, 0, 1)).min(axis=0)
        found |= {(i, j) for j in range(i + 1, path.shape[1]) if apart[j] - 2 * R <= TOUCH_M}
        x, y, size_x, size_y, yaw = config.boxes[0]
        turned = (places[:, i] - (x, y)) @ np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        outside = np.maximum(np.abs(turned) - (size_x / 2, size_y / 2), 0.0)
        if np.hypot(*outside.T).min() - R <= TOUCH_M:
            found.add((-1, i))
    return found


def test_the_touching_gap_grows_with_speed_and_smallness() -> None:
    assert touch_m(config_of("pybullet")) == touch_m(config_of("pybullet", speed_limit_m_s=4.0)) == TOUCH_M
    small_and_fast = touch_m(config_of("pybullet", speed_limit_m_s=4.0, radius_m=0.05))
    assert small_and_fast == pytest.approx(1e-4 + math.hypot(0.1, 0.032) - 0.1)


def test_more_neighbours_than_room_are_all_listed() -> None:
    engine = make_engine(config_of("kinematic"), np.array([(0.36 * i, 0.0, 0.0) for i in range(30)]))
    referee = engine.referee
    referee.allocate(1)
    assert referee.look_ahead(engine.pose, 0.01) == list(range(30))
    assert len(referee.candidates.pairs) >= 29


@pytest.mark.parametrize("name", ["kinematic", "pybullet", "pybullet-wheels"])
def test_bodies_of_different_sizes_meet_where_their_own_rims_do(name: str) -> None:
    """A large robot drives at a small one that stands before a box: they touch when their own two radii say so."""
    config = config_of(name, boxes=((2.0, 0.0, 0.5, 2.0, 0.0),))
    bodies = [config.model_copy(update={"radius_m": radius_m}) for radius_m in (0.34, 0.1)]
    engine = make_engine(config, np.array([(0.0, 0.0, 0.0), (1.4, 0.0, 0.0)]), bodies)
    first: dict[tuple[int, ...], float] = {}
    for _ in range(150):
        engine.step(np.array([[0.5, 0.0], [0.0, 0.0]]))
        for pair in engine.referee.pairs.tolist():
            first.setdefault(tuple(sorted(pair)), engine.pose[0, 0])
    engine.close()
    assert first[(0, 1)] == pytest.approx(1.4 - 0.44, abs=0.02)
    assert (engine.pose[1, 0] - engine.pose[0, 0]) == pytest.approx(0.44, abs=0.02)
    if name != "pybullet-wheels":  # whose brakes hold the small one
        assert first[(-1, 1)] > first[(0, 1)]
        assert engine.pose[1, 0] == pytest.approx(1.75 - 0.1, abs=0.02)
