"""Policies in ONNX files as control laws of a package, in processes of `fullswarm up`."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from fullswarm.envs import Spaces
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.messages import RobotStates
from tests.system.test_example_behaviours import ROBOTS, Up

pytestmark = pytest.mark.alone

PAGE = Path(__file__).parents[2] / "docs" / "how-to-use-from-python.md"
SPACES = Spaces(neighbours=1)
GOAL = [5.0, 5.0]
AROUND = np.array([[0.0, 1.0], [-1.0, 0.0]])
"""The policy of the test turns the way to the goal by 90°: robots drive around it, at its distance."""


def write_model(file: Path, matrix: Array) -> None:
    """Write a model that multiplies an observation by a matrix (size, 2)."""
    size = len(matrix)
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["observation", "matrix"], ["action"])],
        "linear",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["k", size])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["k", 2])],
        [numpy_helper.from_array(matrix.astype(np.float32), "matrix")],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), str(file))


def around(scale: float = 1.0, size: int = SPACES.size) -> Array:
    matrix = np.zeros((size, 2))
    matrix[:2] = scale * AROUND  # of goal_x and goal_y
    return matrix


class Policies(Up):
    """A swarm with the package of the documentation, `homing`, and `unsound`, whose actions are not finite."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        page = PAGE.read_text(encoding="utf-8")
        law = re.findall(r"```python\n(.*?)```", page, re.DOTALL)[-1]
        record = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)[0]
        for name in ("homing", "unsound"):
            (folder / f"{name}.py").write_text(law.replace("net.onnx", f"{name}.onnx"))
            (folder / f"{name}.toml").write_text(record.replace("homing", name))
        (folder / "pyproject.toml").write_text(
            '[project.entry-points."fullswarm.behaviours"]\nhoming = "homing"\nunsound = "unsound"\n'
        )
        write_model(folder / "unsound.onnx", around(math.nan))
        self.velocity: dict[str, Array] = {}
        super().__init__(folder, folder)
        self.bus.subscribe(Keys("swarm").state(), RobotStates, self._note_velocities)
        self.until(lambda: set(self.velocity) == set(self.place) == set(ROBOTS), "all report their states", 10.0)

    def _note_velocities(self, states: RobotStates) -> None:
        for row, robot in enumerate(states.robots):
            heading, speed = states.heading_rad[row], states.speed_m_s[row]
            self.velocity[robot] = speed * np.array([math.cos(heading), math.sin(heading)])

    def command(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run a command of an operator."""
        (hub,) = re.findall(r'endpoint = "(.*)"', (self.folder / "lab.toml").read_text())
        return subprocess.run(
            [sys.executable, "-m", "fullswarm", *words], capture_output=True, text=True, timeout=60.0, check=False,
            env={**os.environ, "FULLSWARM_HUB": hub},
        )  # fmt: skip

    def follows(self) -> bool:
        """Whether each robot moves as the policy says, to 10 % of its speed: an action is up to 0.3 s old."""
        per_m = SPACES.speed_m_s / SPACES.goal_m
        wanted = per_m * (np.array(GOAL) - self.places) @ AROUND
        found = np.array([self.velocity[robot] for robot in ROBOTS])
        return bool((np.linalg.norm(found - wanted, axis=1) < 0.1 * np.linalg.norm(wanted, axis=1)).all())

    def reasons(self) -> list[str]:
        return [row.health.stop_reason if row.health else "" for row in self.view.snapshot().robots]


@pytest.fixture(scope="module")
def swarm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Policies]:
    live = Policies(tmp_path_factory.mktemp("policies"))
    yield live
    live.close()


def test_robots_refuse_a_model_that_cannot_be_used_and_say_why(swarm: Policies) -> None:
    model = swarm.folder / "homing.onnx"
    before = swarm.places
    for write, why in (
        (lambda: None, r"homing\.onnx: no such file"),
        (lambda: model.write_bytes(b"nothing"), r"homing\.onnx: is no ONNX model"),
        (lambda: write_model(model, around(size=7)), rf"homing\.onnx: takes .*\(k, {SPACES.size}\)"),
    ):
        write()
        done = swarm.command("request", "homing_bc", "--set", "goal=5,5", "--wait")
        assert done.returncode == 1
        assert re.search(rf"homing_bc: r1, r2, r3: \S+/homing\.py:\d+: 'homing' does not import: \S+{why}", done.stderr)
    swarm.runtime.run(0.5)
    assert np.abs(swarm.places - before).max() == 0.0


def test_robots_move_as_the_model_says_as_soon_as_it_can_be_used(swarm: Policies) -> None:
    write_model(swarm.folder / "homing.onnx", around())
    asked = swarm.request("homing_bc", {"goal": [*GOAL]})
    swarm.until(swarm.follows, "they move as the policy says", 20.0)
    radius_m, angle, follows = [], [], []
    for _ in range(60):
        swarm.runtime.run(0.1)
        follows.append(swarm.follows())
        away = swarm.places - GOAL
        radius_m.append(np.linalg.norm(away, axis=1))
        angle.append(np.arctan2(away[:, 1], away[:, 0]))
    assert np.mean(follows) > 0.9
    assert (np.ptp(radius_m, axis=0) < 0.05 * radius_m[0]).all()
    turned = np.unwrap(angle, axis=0)[-1] - np.unwrap(angle, axis=0)[0]
    assert turned == pytest.approx([-0.59] * 3, rel=0.15)  # 0.1 rad/s for 5.9 s, clockwise
    assert asked.status is not None
    assert asked.status.phase == "running"


def test_actions_that_are_not_finite_stop_the_robots_with_the_reason(swarm: Policies) -> None:
    swarm.request("unsound_bc", {"goal": [*GOAL]})
    why = "law 'unsound': ConfigError: an action is not finite"
    swarm.until(lambda: swarm.reasons() == [why] * 3, "they stop and say why", 10.0)
    swarm.until(lambda: all(not each.any() for each in swarm.velocity.values()), "they stand", 5.0)
    shown = swarm.command("status", "--json")
    assert shown.stdout.count(why) == 3
    swarm.request("homing_bc", {"goal": [*GOAL]})
    swarm.until(swarm.follows, "they move as the policy says, again", 20.0)
