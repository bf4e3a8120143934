"""Every engine: free bodies follow the exact arc, solid bodies touch and do not overlap, runs repeat."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from fullswarm.config import WorldConfig
from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.kernels import Array
from fullswarm.simulation.engine import Engine, make_engine
from fullswarm.simulation.obstacles import static_obstacles

R = 0.17
# Metres of arc error per second of driving, and metres of penetration: wheels slip and rock on their casters.
TOLERANCE = {"kinematic": (1e-9, 1e-3), "pybullet": (1e-6, 1e-3), "pybullet-wheels": (0.02, 1e-3)}


ENGINES = pytest.mark.parametrize("name", TOLERANCE)


def config_of(name: str, **more: object) -> WorldConfig:
    return WorldConfig.model_validate({"engine": name, **more})


class Rig:
    """Makes engines and closes them."""

    def __init__(self) -> None:
        self.made: list[Engine] = []

    def __call__(self, config: WorldConfig, *starts: tuple[float, float, float]) -> Engine:
        self.made.append(make_engine(config, np.array(starts)))
        return self.made[-1]


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    for engine in rig.made:
        engine.close()
        engine.close()


def drive(engine: Engine, twists: Array, steps: int, ramp_steps: int = 0) -> Array:
    """Return all contact counts, (steps, n)."""
    seen = []
    for step in range(steps):
        engine.step(twists * min(1.0, (step + 1) / (ramp_steps + 1)))
        seen.append(engine.referee.contacts.copy())
    return np.array(seen, dtype=float)


@ENGINES
@pytest.mark.parametrize(
    ("v", "w"), [(0.5, 0.0), (0.4, 1.0), (-0.3, 0.7), (0.0, 2.0), (0.5, -4.25)], ids=["0", "1", "2", "3", "4"]
)
def test_free_body_follows_the_arc(name: str, v: float, w: float, rig: Rig) -> None:
    engine = rig(config_of(name), (5.0, 6.0, 0.4))
    twist = np.array([[v, w]])
    if name == "pybullet-wheels":
        drive(engine, twist, 40, ramp_steps=20)
    x, y, heading = engine.pose[0].tolist()
    drive(engine, twist, 50)
    half = w / 2
    chord = v * (math.sin(half) / half if half else 1.0)
    wanted = x + chord * math.cos(heading + half), y + chord * math.sin(heading + half)
    tolerance = TOLERANCE[name][0]
    assert math.dist(engine.pose[0, :2], wanted) < tolerance
    assert abs(math.remainder(engine.pose[0, 2] - heading - w, 2 * math.pi)) < tolerance
    assert abs(engine.pose[0, 2]) <= math.pi
    assert engine.twist[0] == pytest.approx([v, w], abs=10 * tolerance)
    assert engine.referee.contacts[0] == 0


@ENGINES
def test_head_on_pair_ends_touching_not_overlapping(name: str, rig: Rig) -> None:
    engine = rig(config_of(name), (5.0, 5.0, 0.0), (6.0, 5.0, math.pi), (5.0, 8.0, 0.0))
    twists, closest, seen = np.array([[0.5, 0.0], [0.5, 0.0], [0.1, 0.0]]), math.inf, []
    for _ in range(60):
        engine.step(twists)
        closest = min(closest, math.dist(engine.pose[0, :2], engine.pose[1, :2]))
        seen.append(engine.referee.contacts.tolist())
    assert 2 * R - TOLERANCE[name][1] < closest < 2 * R + TOLERANCE[name][1]
    assert seen[0] == [0, 0, 0]
    assert seen[-1] == [1, 1, 0]
    assert engine.referee.pairs.tolist() == [[0, 1]]
    assert abs(engine.twist[0, 0]) < 0.1
    for _ in range(20):
        engine.step(-twists)
    assert engine.referee.contacts.tolist() == [0, 0, 0]
    assert engine.referee.pairs.shape == (0, 2)


@ENGINES
def test_wall_stops_a_body(name: str, rig: Rig) -> None:
    config = config_of(name, bounds_m=(0.0, 0.0, 4.0, 3.0))
    engine = rig(config, (3.6, 1.5, 0.0))
    drive(engine, np.array([[0.5, 0.0]]), 40)
    assert engine.pose[0, 0] == pytest.approx(4.0 - R, abs=1e-3)
    assert engine.referee.contacts[0] == 1
    assert engine.referee.pairs.tolist() == [[0, -2]]  # the wall at x_max is the second obstacle
    assert static_obstacles(config)[1].tolist() == [4.5, 1.5, 0.5, 2.5, 0.0, 0.0]


@ENGINES
def test_rotated_box_is_met_at_its_corner(name: str, rig: Rig) -> None:
    config = config_of(name, boxes=((5.0, 5.0, 1.0, 1.0, math.pi / 4),), walls=False)
    engine = rig(config, (3.8, 5.0, 0.0), (5.0, 3.0, 0.0))
    closest = math.inf
    for _ in range(50):
        engine.step(np.array([[0.4, 0.0], [0.4, 0.0]]))
        closest = min(closest, 5.0 - math.sqrt(0.5) - R - engine.pose[0, 0] + abs(engine.pose[0, 1] - 5.0))
    assert closest > -1e-3
    assert engine.referee.contacts.tolist() == [1, 0]
    assert engine.referee.pairs.tolist() == [[0, -1]]


@pytest.mark.parametrize("name", ["kinematic", "pybullet"])
@pytest.mark.parametrize("speed", [0.5, 4.0])
def test_a_pile_stays_solid(name: str, speed: float, rig: Rig) -> None:
    starts = [(3.0 + 0.5 * (i % 4), 3.0 + 0.5 * (i // 4), 0.0) for i in range(16)]
    engine = rig(config_of(name), *starts)
    worst = 0.0
    for _ in range(40):
        away = np.arctan2(3.75 - engine.pose[:, 1], 3.75 - engine.pose[:, 0]) - engine.pose[:, 2]
        engine.step(np.stack([speed * np.cos(away), 3.0 * np.sin(away)], axis=1))
        apart = np.hypot(*(engine.pose[:, None, :2] - engine.pose[None, :, :2]).transpose(2, 0, 1))
        worst = max(worst, float(np.max(2 * R - apart - np.eye(16))))
    assert engine.referee.contacts.max() >= 3
    assert worst < 1e-3


@ENGINES
def test_same_inputs_same_bytes(name: str, rig: Rig) -> None:
    rng = np.random.default_rng(3)
    twists = rng.uniform(-0.5, 0.5, (25, 9, 2)) * [1.0, 4.0]
    starts = [(1.0 + 0.4 * (i % 3), 1.0 + 0.4 * (i // 3), 0.7 * i - 3.0) for i in range(9)]
    engines = [rig(config_of(name, bounds_m=(0.0, 0.0, 3.0, 3.0)), *starts) for _ in range(2)]
    for step in twists:
        for engine in engines:
            engine.step(step)
    assert engines[0].pose.tobytes() == engines[1].pose.tobytes()
    assert engines[0].twist.tobytes() == engines[1].twist.tobytes()
    assert not np.array_equal(engines[0].pose, np.array(starts))


def test_nothing_is_printed_by_bullet() -> None:
    # In a process of its own: Bullet prints its banner at the first import only.
    program = (
        "from fullswarm.config import WorldConfig\n"
        "from fullswarm.simulation.world import World\n"
        "world = World(WorldConfig(), ('a',)); world.step(); world.close()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True, timeout=60)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_a_world_without_room_is_refused() -> None:
    with pytest.raises(ConfigError, match="no room"):
        make_engine(config_of("kinematic", bounds_m=(0.0, 0.0, 0.3, 5.0)), np.zeros((1, 3)))
    with pytest.raises(ConfigError, match="box 0"):
        make_engine(config_of("kinematic", boxes=((1.0, 1.0, 0.0, 1.0, 0.0),)), np.zeros((1, 3)))


@pytest.mark.parametrize("name", ["pybullet", "pybullet-wheels"])
def test_a_missing_pybullet_says_what_to_install(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(MissingExtra, match=r"fullswarm\[sim\]"):
        make_engine(config_of(name), np.zeros((1, 3)))
