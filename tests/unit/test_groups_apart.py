"""Two groups in one arena: what one does changes nothing of the other's motion, to the last bit."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator
from fullswarm.operator.params import ParamClient
from tests.unit.agent_bench import TICK_S
from tests.unit.laws import install
from tests.unit.test_agent_memory import Wandering, wander

OURS, THEIRS = ("r1", "r3", "r4", "r6"), ("r2", "r5", "r7")  # the rows of the arrays alternate
SIDE_M = 60.0
CORNERS = ((-1.5, -1.5), (1.5, -1.0), (-1.0, 1.5), (1.0, 1.0))
NAMES = ("flocking", "rendezvous", "voronoi_coverage", "formation", "move_to_goal", "wander", "agree")


def agree(view: Any, params: Any, kept: Any) -> np.ndarray:
    """Consensus-like: move by a sum over neighbours that is remembered, and by members and random numbers."""
    kept.mean += view.dt_s * view.sum(view.offset) / np.maximum(view.neighbours, 1.0)
    kept.phase_rad += view.random.normal() * view.dt_s * len(view.members)
    found: np.ndarray = 0.3 * kept.mean + 0.05 * np.stack([np.cos(kept.phase_rad), np.sin(kept.phase_rad)], axis=1)
    return found


@pytest.fixture(autouse=True)
def _laws(monkeypatch: pytest.MonkeyPatch) -> None:
    install(
        monkeypatch,
        wander=SimpleNamespace(velocity=wander, Memory=Wandering),
        agree=SimpleNamespace(velocity=agree, Memory=Wandering),
    )


def parameters(behaviour: str, middle: np.ndarray, count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return what a behaviour needs, near the group."""
    if behaviour.startswith("formation"):
        return {"targets": (middle + rng.uniform(-2.0, 2.0, (count, 2))).tolist()}
    if behaviour.startswith("move_to_goal"):
        return {"goal": (middle + rng.uniform(-2.0, 2.0, 2)).tolist()}
    return {}


def run(
    starts: dict[str, list[float]], asked: Sequence[tuple[str, tuple[str, ...], dict[str, Any]]], team: str = ""
) -> np.ndarray:
    """Return the poses of our group in each tick."""
    robots = [{"id": robot, "pose": pose} for robot, pose in starts.items()]
    world = {"engine": "kinematic", "bounds_m": (0.0, 0.0, SIDE_M, SIDE_M)}
    groups = {"ours": OURS, "theirs": [each for each in THEIRS if each in starts]}
    lockstep = Lockstep(SwarmConfig.model_validate({"world": world, "robot": robots, "groups": groups}))
    try:
        client = ParamClient(lockstep.bus, Keys(), lockstep.runtime, "op")
        for law in ("wander", "agree"):
            client.ask("set", f"behaviour/{law}", lambda _: None, {"summary": "", "law": law})
            client.ask("set", f"behaviour/{law}_bc", lambda _: None, {"like": law, "filtered": True})
        lockstep.run(0.5)
        statuses: list[list[RequestStatus]] = []
        for behaviour, members, given in asked:
            statuses.append([])
            Operator(lockstep.bus, Keys(), lockstep.runtime, f"op{len(statuses)}").request(
                behaviour, members, given, statuses[-1].append, team=team
            )
        rows = [list(starts).index(robot) for robot in OURS]
        seen: list[np.ndarray] = []
        lockstep.runtime.every(TICK_S, lambda: seen.append(lockstep.world.pose[rows].copy()))
        lockstep.run(3.0)
        assert all(each[-1].phase == "running" for each in statuses), statuses
        return np.array(seen)
    finally:
        lockstep.close()


@pytest.mark.parametrize("seed", range(20))
def test_a_group_moves_as_if_the_other_were_not_there(seed: int) -> None:
    rng = np.random.default_rng(seed)
    filtered = "_bc" if seed % 2 else ""
    # Behind the filter they are farther apart than it reaches, 3 m; without it they sense each other, and do not touch.
    middles = {OURS: np.array([20.0, 20.0]), THEIRS: np.array([20.0 + (20.0 if filtered else 5.5), 20.0])}
    ours, theirs = (str(each) for each in rng.choice(NAMES, 2))
    if seed < 4:
        theirs = ours  # one law serves both groups
    starts = {
        robot: [*(middles[group] + CORNERS[place] + rng.uniform(-0.5, 0.5, 2)).tolist(), float(rng.uniform(-3.0, 3.0))]
        for robot, place, group in sorted((each, place, group) for group in middles for place, each in enumerate(group))
    }
    asked = [
        (name + filtered, group, parameters(name, middles[group], len(group), rng))
        for name, group in ((ours, OURS), (theirs, THEIRS))
    ]
    team = "group" if seed % 5 == 3 else ""
    both = run(starts, asked, team)
    alone = run({robot: starts[robot] for robot in OURS}, asked[:1], team)
    assert np.abs(both[-1] - both[0]).max() > 0.01
    assert np.array_equal(both, alone)
