"""Environments and policies: the checkers of Gymnasium and PettingZoo, what is observed, and policies as behaviours."""

from __future__ import annotations

import itertools
import math
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pettingzoo.test import parallel_api_test, parallel_seed_test

import fullswarm.envs
from fullswarm import Lab, registry
from fullswarm.core.behaviours import load_records
from fullswarm.envs import ParallelSwarmEnv, Spaces, State, SwarmEnv, policy
from fullswarm.errors import BehaviourFailed, ConfigError
from fullswarm.testing import check_behaviour

Array = NDArray[np.float64]
STARTS = [[1.0, 1.0, 0.0], [1.0, 3.0, 0.5], [3.0, 1.0, 3.0]]
GOALS = [[6.0, 6.0], [6.0, 1.0], [1.0, 6.0]]
FORMS = [
    {},
    {"spaces": Spaces(action="twist", neighbours=1, obstacles=2, pose=False)},
    {"spaces": Spaces(scaled=False, period_s=0.04)},
]
"""Settings with all kinds of spaces."""


def steered(observation: NDArray[np.float32]) -> Array:
    """Turn to the goal and drive; depends on each number of the observation."""
    x, y = float(observation[0]), float(observation[1])
    rest = 0.05 * math.sin(float(np.sum(observation * np.arange(1, len(observation) + 1))))
    return np.array([2.0 * math.hypot(x, y) + rest, math.atan2(y, x)])


@pytest.fixture
def parallel() -> Iterator[Callable[..., ParallelSwarmEnv]]:
    made: list[ParallelSwarmEnv] = []

    def make(**changes: Any) -> ParallelSwarmEnv:
        made.append(ParallelSwarmEnv(**{"starts": STARTS, "goals": GOALS, "robots": 3, **changes}))
        return made[-1]

    yield make
    for env in made:
        env.close()


# ------------------------------------------------------------------ other people's checkers; a warning is an error
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.filterwarnings("ignore:.*recommend using a symmetric and normalized space")  # actions in SI are not
def test_gymnasium_finds_nothing_to_complain_about(form: dict[str, Any]) -> None:
    env = gymnasium.make(fullswarm.envs.ID, robots=2, render_mode="rgb_array", **form)
    check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("form", FORMS)
def test_pettingzoo_finds_nothing_to_complain_about(form: dict[str, Any]) -> None:
    env = ParallelSwarmEnv(robots=3, time_limit_s=3.0, goal_radius_m=1.5, **form)
    parallel_api_test(env, num_cycles=40)
    parallel_seed_test(lambda: ParallelSwarmEnv(robots=2, **form), num_cycles=5)
    env.close()


# ------------------------------------------------------------------ what is observed and commanded
@settings(max_examples=10)
@given(seed=st.integers(0, 2**16), action=st.sampled_from(["twist", "planar"]))
def test_an_observation_is_what_complex_numbers_give(seed: int, action: Any) -> None:
    spaces = Spaces(neighbours=2, obstacles=1, sensing_m=2.5, goal_m=3.0, scaled=False, action=action)
    with closing(ParallelSwarmEnv(robots=4, bounds=(0, 0, 5, 5), spaces=spaces)) as env:
        env.reset(seed=seed)
        drive = np.random.default_rng(seed).uniform(-1, 1, (4, 2))
        for _ in range(5):
            seen, *_ = env.step(dict(zip(env.agents, drive, strict=True)))
        state, names = env.episode.state, spaces.names
    at = state.pose[:, 0] + 1j * state.pose[:, 1]
    turn = np.exp(-1j * state.pose[:, 2]) if action == "twist" else np.ones(4)
    velocity = state.twist[:, 0] * np.exp(1j * state.pose[:, 2])
    for row, robot in enumerate(seen):
        found = dict(zip(names, seen[robot].tolist(), strict=True))
        goal = (complex(*state.goal[row]) - at[row]) * turn[row]
        assert complex(found["goal_x"], found["goal_y"]) == pytest.approx(goal * min(1, 3 / abs(goal)), abs=1e-5)
        twist = state.twist[row, 0], float(np.clip(state.twist[row, 1], -2.0, 2.0))
        assert (found["speed"], found["turn"]) == pytest.approx(twist, abs=1e-5)
        assert (found["x"] + 2.5, found["y"] + 2.5) == pytest.approx(tuple(state.pose[row, :2]), abs=1e-5)
        assert math.atan2(found["sin"], found["cos"]) == pytest.approx(state.pose[row, 2], abs=1e-5)
        others = sorted((other for other in range(4) if other != row), key=lambda other: abs(at[other] - at[row]))
        for k, other in enumerate(others[:2]):
            got = {name: found[f"neighbour{k}_{name}"] for name in ("x", "y", "vx", "vy", "seen")}
            if abs(at[other] - at[row]) > 2.5:
                assert set(got.values()) == {0.0}
                continue
            assert complex(got["x"], got["y"]) == pytest.approx((at[other] - at[row]) * turn[row], abs=1e-3)
            relative = (velocity[other] - velocity[row]) * turn[row]
            assert complex(got["vx"], got["vy"]) == pytest.approx(relative, abs=0.05)  # as it was sent last
            assert got["seen"] == 1.0
        wall = min(at[row].real, at[row].imag, 5 - at[row].real, 5 - at[row].imag)
        assert math.hypot(found["obstacle0_x"], found["obstacle0_y"]) == pytest.approx(wall, abs=1e-5)


def test_scaled_numbers_are_shares_of_the_largest() -> None:
    plain = Spaces(scaled=False, bounds_m=(0.0, 0.0, 8.0, 4.0))
    observations = []
    for spaces in (plain, Spaces(bounds_m=plain.bounds_m)):
        env = ParallelSwarmEnv(robots=3, starts=STARTS, bounds=(0, 0, 8, 4), goals=STARTS_XY, spaces=spaces)
        with closing(env):
            observations.append(env.reset(seed=1)[0]["r2"])
    np.testing.assert_allclose(observations[1], observations[0] / plain.largest, rtol=1e-6)
    np.testing.assert_allclose(Spaces(action="twist").velocities([[0.5, -3.0]], 1), [[0.25, -2.0]])
    np.testing.assert_allclose(plain.velocities([[0.7, -0.2]], 1), [[0.5, -0.2]])


STARTS_XY = [row[:2] for row in STARTS]


def test_a_twist_is_driven_and_a_planar_velocity_too(parallel: Any) -> None:
    ends: dict[str, State] = {}
    for spaces in (Spaces(action="twist", scaled=False), Spaces(action="planar", scaled=False)):
        env = parallel(spaces=spaces)
        env.reset()
        for _ in range(60):
            env.step({"r1": np.array([0.2, 0.4] if spaces.action == "twist" else [0.177, 0.177])})
        ends[spaces.action] = env.episode.state
        np.testing.assert_array_equal(env.episode.state.twist[1:], 0.0)  # without an action they stand
    np.testing.assert_allclose(ends["twist"].twist[0], [0.2, 0.4], atol=0.01)
    assert ends["planar"].twist[0, 0] == pytest.approx(math.hypot(0.177, 0.177), abs=0.01)
    assert ends["planar"].pose[0, 2] == pytest.approx(math.pi / 4, abs=0.05)


# ------------------------------------------------------------------ episodes
def test_a_seed_repeats_an_episode_and_the_next_one_differs() -> None:
    def two_episodes(seed: int) -> list[Any]:
        env = SwarmEnv(robots=3)
        found = []
        for given_seed in (seed, None):
            observation, _ = env.reset(seed=given_seed)
            found.append(observation)
            found += [env.step(np.array([0.5, 0.2], np.float32))[0] for _ in range(3)]
        env.close()
        return found

    one, again, other = two_episodes(5), two_episodes(5), two_episodes(6)
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one[:4], one[4:])
    assert not np.array_equal(one, other)


def test_an_episode_ends_at_the_goal_or_at_the_time_limit() -> None:
    env = SwarmEnv(robots=1, starts=[[1, 1, 0]], goals=[[2, 1]], time_limit_s=8.0)
    env.reset()
    ends = [env.step(np.array([1.0, 0.0]))[1:4] for _ in range(20)]
    arrived = [terminated for _, terminated, _ in ends].index(True)
    assert 0.8 / 0.5 <= (arrived + 1) * 0.1 <= 0.8 / 0.5 + 1.0  # 0.8 m at 0.5 m/s, and the acceleration
    total = sum(reward for reward, *_ in ends[: arrived + 1])
    assert total == pytest.approx(0.8 + 1.0 - 0.05 * 0.1 * (arrived + 1), abs=0.06)
    env.reset()
    over = [env.step(np.zeros(2))[3] for _ in range(80)]
    assert over == [False] * 79 + [True]
    env.close()


def test_an_agent_that_has_arrived_leaves_and_its_robot_stands(parallel: Any) -> None:
    env = parallel(goals=[[1.6, 1.0], *GOALS[1:]])
    env.reset()
    while "r1" in env.agents:
        _, rewards, done, over, info = env.step(dict.fromkeys(env.agents, np.array([1.0, 0.0])))
    assert (done["r1"], done["r2"], over["r1"], info["r1"]["arrived"]) == (True, False, False, True)
    assert rewards["r1"] > 0.9
    with pytest.raises(ConfigError, match="'r1' is no agent now"):
        env.step({"r1": np.zeros(2)})
    for _ in range(10):
        observations, *_ = env.step({})
    assert list(observations) == env.agents == ["r2", "r3"]
    assert env.episode.state.twist[0, 0] == pytest.approx(0.0, abs=1e-6)


def test_actions_pass_the_filter_unless_it_is_off(parallel: Any) -> None:
    touched: dict[bool, bool] = {}
    changed: dict[bool, float] = {}
    for filtered in (True, False):
        env = parallel(starts=[[2, 4, 0], [6, 4, math.pi], [1, 1, 0]], filtered=filtered, contact_ends=True)
        env.reset()
        for _ in range(80):
            if "r1" not in env.agents:
                break
            _, _, done, _, info = env.step({"r1": np.array([1.0, 0.0]), "r2": np.array([-1.0, 0.0])})
            changed[filtered] = changed.get(filtered, 0.0) + info["r1"]["changed_m_s"]
        touched[filtered] = info["r1"]["touched"]
        assert done["r1"] is touched[filtered]
    assert touched == {True: False, False: True}
    assert changed[True] > 1.0
    assert changed[False] == 0.0


def test_a_reward_is_a_function_of_the_states(parallel: Any) -> None:
    seen: list[tuple[State, State]] = []

    def faster(before: State, after: State) -> Array:
        seen.append((before, after))
        return after.twist[:, 0] - before.twist[:, 0]

    env = parallel(reward=faster)
    env.reset()
    *_, (_, rewards, *_) = (env.step({"r1": np.array([1.0, 0.0])}) for _ in range(2))
    (_, middle), (start, end) = seen
    assert middle is start
    assert rewards == {"r1": end.twist[0, 0] - start.twist[0, 0], "r2": 0.0, "r3": 0.0}
    np.testing.assert_allclose(end.command, [[0.5, 0.0], [0.0, 0.0], [0.0, 0.0]])


def test_a_picture_shows_how_robots_move() -> None:
    env = gymnasium.make(fullswarm.envs.ID, render_mode="rgb_array", robots=2)
    env.reset(seed=1)
    before: Any = env.render()
    for _ in range(10):
        env.step(np.array([1.0, 0.3], np.float32))
    after: Any = env.render()
    assert before.shape == after.shape
    assert before.shape[1:] == (480, 3)
    assert 100 < (before != after).any(axis=2).sum() < 0.1 * before.shape[0] * before.shape[1]
    env.close()


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"robot": 3}, "did you mean 'robots'"),
        ({"time_limit_s": 0.0}, "time_limit_s"),
        ({"goals": [[1, 1]]}, r"goals have shape \(1, 2\), expected \(4, 2\)"),
        ({"spaces": Spaces(period_s=0.05)}, "no multiple of the control period"),
        ({"render_mode": "human"}, "rgb_array"),
        ({"others": "move_to_gaol"}, "did you mean 'move_to_goal"),
        ({"robots": 30, "bounds": (0, 0, 3, 3)}, "no room"),
    ],
)
def test_a_wrong_setting_is_named(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        SwarmEnv(**wrong).reset()


@pytest.mark.parametrize(
    "wrong", [{"neighbours": -1}, {"period_s": 0.0}, {"action": "thrust"}, {"sensing_m": math.inf}]
)
def test_wrong_spaces_are_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="Spaces"):
        Spaces(**wrong)


def test_on_a_bad_network_an_episode_begins_when_all_robots_do() -> None:
    env = ParallelSwarmEnv(
        robots=3, starts=STARTS, goals=GOALS, settings={"network.conditions": "loss=40%,delay=100ms"}
    )
    observations, infos = env.reset(seed=1)
    assert all(np.abs(each[:2]).max() > 0.1 for each in observations.values())
    assert {each["time_s"] for each in infos.values()} == {0.0}
    for _ in range(20):
        env.step(dict.fromkeys(env.agents, np.array([1.0, 0.0])))
    assert (env.episode.state.pose[:, 0] - np.array(STARTS)[:, 0] > 0.5).all()
    env.close()
    with pytest.raises(ConfigError, match="not all robots have begun within 10 s"):
        ParallelSwarmEnv(robots=2, settings={"network.conditions": "loss=100%"}).reset()


# ------------------------------------------------------------------ policies as behaviours
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("filtered", [True, False])
def test_a_policy_moves_robots_as_in_its_environment_to_the_last_bit(
    parallel: Any, form: dict[str, Any], filtered: bool
) -> None:
    env = parallel(goal_radius_m=1e-6, filtered=filtered, settings={"world.noise.position_m": 0.005}, **form)
    observations, _ = env.reset(seed=3)
    recorded: list[Array] = []
    while env.agents and len(recorded) < 40:
        recorded.append(env.episode.state.pose)
        observations, *_ = env.step({name: steered(seen) for name, seen in observations.items()})

    seed = int(np.random.Generator(np.random.PCG64(np.random.SeedSequence(3))).integers(2**31))
    lab = Lab(starts=STARTS, bounds=(0, 0, 8, 8), seed=seed, settings={"world.noise.position_m": 0.005})
    with lab:
        law = policy(steered, env.spaces, batched=False, each=True)
        lab.request(law, targets=GOALS, filtered=filtered)
        lab.step()
        for expected in recorded:
            np.testing.assert_array_equal(lab.poses, expected)
            lab.run(env.spaces.period_s)
    assert np.abs(recorded[-1] - recorded[0]).max() > 0.5


def test_a_policy_serves_many_robots_and_one(parallel: Any) -> None:
    def batch(observations: NDArray[np.float32]) -> tuple[Array, None]:  # as Stable-Baselines3 returns it
        return np.array([steered(each) for each in observations]), None

    ways = []
    for act, batched in ((batch, True), (steered, False)):
        with Lab(starts=STARTS, bounds=(0, 0, 8, 8)) as lab:
            lab.request(policy(act, Spaces(action="twist"), batched=batched), goal=[6, 6])
            lab.run(20)
            ways.append(lab.poses)
            assert lab.metrics["collisions.events"] == 0.0
    np.testing.assert_array_equal(ways[0], ways[1])
    assert (np.hypot(*(ways[0][:, :2] - [6, 6]).T) < 1.5).all()


def test_others_of_an_environment_may_run_a_policy() -> None:
    env = SwarmEnv(robots=3, starts=STARTS, goals=GOALS, others=policy(steered, Spaces(action="twist"), batched=False))
    env.reset()
    for _ in range(50):
        env.step(np.zeros(2))
    moved = np.hypot(*(env.episode.state.pose[:, :2] - np.array(STARTS_XY)).T)
    assert moved[0] == pytest.approx(0.0, abs=1e-9)
    assert (moved[1:] > 1.0).all()
    env.close()


def test_a_policy_that_answers_wrongly_stops_its_robots() -> None:
    for answer, says in (
        (np.zeros(3), r"shape \(3,\), expected \(3, 2\)"),
        (np.zeros((1, 2)), r"shape \(1, 2\), expected \(3, 2\)"),
        (np.full((3, 2), np.nan), "not finite"),
        (None, "expected"),
    ):
        with Lab(starts=STARTS, bounds=(0, 0, 8, 8)) as lab:
            lab.request(policy(lambda _: answer), goal=[6, 6])  # noqa: B023  (called within the loop)
            with pytest.raises(BehaviourFailed, match=says):
                lab.run(1)
    with pytest.raises(ConfigError, match="no policy"):
        policy(3)  # type: ignore[arg-type]


def linear_model(path: Path, size: int, batch: int | str = "k") -> Array:
    """Write a model that multiplies by a matrix (size, 2); return the matrix."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    matrix = np.random.default_rng(1).normal(0.0, 0.3, (size, 2)).astype(np.float32)
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["observation", "matrix"], ["action"])],
        "linear",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, [batch, size])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, [batch, 2])],
        [numpy_helper.from_array(matrix, "matrix")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, str(path))
    return matrix.astype(float)


@pytest.mark.parametrize("batch", ["k", 1])
def test_a_model_in_the_onnx_format_is_a_policy(tmp_path: Path, batch: int | str) -> None:
    matrix = linear_model(tmp_path / "net.onnx", Spaces().size, batch)
    ways = []
    for source in (tmp_path / "net.onnx", lambda observations: observations @ matrix):
        with Lab(starts=STARTS, bounds=(0, 0, 8, 8)) as lab:
            request = lab.request(policy(source), goal=[6, 6])
            lab.run(5)
            ways.append(lab.poses)
            assert request.running
    np.testing.assert_allclose(ways[0], ways[1], atol=1e-3)
    assert np.abs(ways[0] - STARTS).max() > 0.1


def test_a_model_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "net.onnx"
    with pytest.raises(ConfigError, match="no such file"):
        policy(file)
    linear_model(file, 7)
    with pytest.raises(ConfigError, match=rf"takes \['k', 7\].*\(k, {Spaces().size}\)"):
        policy(str(file))
    file.write_bytes(b"nothing")
    with pytest.raises(ConfigError, match=r"net\.onnx: is no ONNX model"):
        policy(file)


OUTSIDE = """
from __future__ import annotations
from pathlib import Path
from fullswarm.envs import Spaces, policy

_law = policy(Path(__file__).with_name("net.onnx"), Spaces(neighbours=1))
velocity, Memory = _law.velocity, _law.Memory
"""
RECORD = """
[homing]
summary = "Drive to a goal as learned"
law = "homing"
team = "swarm"
static = { hearing_m = 3.0, coordination = false }
[homing.parameters]
goal = { type = "point", unit = "m", required = true, doc = "where to" }

[homing_bc]
like = "homing"
filtered = true
"""


@pytest.fixture
def outside(tmp_path: Path) -> ModuleType:
    linear_model(tmp_path / "net.onnx", Spaces(neighbours=1).size)
    (tmp_path / "homing.py").write_text(OUTSIDE)
    (tmp_path / "homing.toml").write_text(RECORD)
    return registry.load_file(tmp_path / "homing.py")


def test_a_package_of_its_own_has_a_policy_as_its_law(outside: ModuleType) -> None:
    check_behaviour(outside, {"goal": [5.0, 5.0]}, seeds=range(2))
    with Lab(starts=STARTS, bounds=(0, 0, 8, 8)) as lab:
        assert lab.request(outside, goal=[6, 6]).behaviour == "homing"
        lab.run(3)
        assert np.abs(lab.poses - STARTS).max() > 0.1


def test_an_installed_policy_is_requested_by_its_name(
    outside: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pyproject.toml").write_text('[project.entry-points."fullswarm.behaviours"]\nhoming = "homing"\n')
    monkeypatch.setenv(registry.DEVELOP, str(tmp_path))  # counts as installed
    monkeypatch.syspath_prepend(str(tmp_path))
    ways = []
    for behaviour in ("homing_bc", outside):
        registry.law_module.cache_clear()
        with Lab(starts=STARTS, bounds=(0, 0, 8, 8)) as lab:
            lab.request(behaviour, goal=[6, 6])
            lab.run(3)
            ways.append(lab.poses)
    np.testing.assert_array_equal(ways[0], ways[1])
    assert np.abs(ways[0] - STARTS).max() > 0.1
    sys.modules.pop("homing", None)
    registry.law_module.cache_clear()


def test_the_examples_of_the_documentation_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    linear_model(tmp_path / "net.onnx", Spaces().size)
    page = (Path(__file__).parents[2] / "docs" / "how-to-use-from-python.md").read_text(encoding="utf-8")
    page = re.sub(r"## A (live swarm|mission)\n.*?(?=\n## )", "", page, flags=re.DOTALL)  # run elsewhere
    *blocks, package = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    model = SimpleNamespace(predict=lambda observations: (observations[:, :2], None))
    names: dict[str, Any] = {"np": np, "model": model, "spaces": Spaces()}
    for block in blocks:
        exec(block, names)
    names["lab"].stop()
    names["lab"].request(names["circle"], robots=["r4"])
    names["lab"].run(1.0)
    linear_model(tmp_path / "net.onnx", Spaces(neighbours=1).size)
    (tmp_path / "homing.py").write_text(package)
    (record,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "homing.toml").write_text(record)
    assert set(load_records(tmp_path / "homing.toml")) == {"homing", "homing_bc"}
    names["lab"].request(registry.load_file(tmp_path / "homing.py"), goal=[2, 2])
    names["lab"].run(1.0)
    assert names["lab"].metrics["collisions.events"] == 0
    names["lab"].close()


def test_a_robot_runs_a_policy_without_gymnasium_and_pictures() -> None:
    code = (
        "import sys; sys.modules |= dict.fromkeys(['gymnasium', 'pettingzoo', 'matplotlib', 'scipy', 'pandas'])\n"
        "from fullswarm.envs import Spaces, policy; policy(len, Spaces())\n"
        "assert not [name for name in sys.modules if name.startswith(('fullswarm.lab', 'fullswarm.simulation'))]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="has no attribute 'Environment'"):
        _ = fullswarm.envs.Environment
    assert set(fullswarm.envs._LAZY) <= set(dir(fullswarm.envs))
    assert all(hasattr(fullswarm.envs, name) for name in itertools.chain(fullswarm.envs._LAZY))
