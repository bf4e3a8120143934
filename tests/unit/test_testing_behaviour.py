"""The published check of laws: it lets our own pass, and names each defect of a broken one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fullswarm import registry
from fullswarm.agent.view import Params, View
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array
from fullswarm.memory import rows
from fullswarm.testing import check_behaviour

PARAMETERS: dict[str, dict[str, Any]] = {
    "move_to_goal": {"goal": [3.0, 4.0], "gain": 1.0, "arrive_radius_m": 0.05},
    "flocking": {
        "repulsion_radius_m": 0.8, "alignment_radius_m": 2.0, "attraction_radius_m": 3.0, "separation": 1.5,
        "alignment": 1.0, "cohesion": 0.5, "cruise_m_s": 0.2,
    },
    "rendezvous": {"gain": 1.0, "hearing_m": 30.0},
    "formation": {"target": [1.0, 2.0], "gain": 1.0},
    "voronoi_coverage": {"gain": 1.0, "hearing_m": 30.0, "reach_m": 30.0},
    "navigate": {"goal": [3.0, 4.0], "gain": 1.0, "arrive_radius_m": 0.05, "map": "shared"},
    "navigate_each": {"target": [3.0, 4.0], "gain": 1.0, "arrive_radius_m": 0.05, "map": "shared"},
    "move": {"magnitude": 0.5, "speed_m_s": 0.5, "direction": [0.0, 1.0]},
    "drive": {"linear": 0.3, "angular": -0.4, "speed_m_s": 0.5, "turn_rad_s": 2.0},
    "paper_bc": {
        "goal": [3.0, 4.0], "gain": 1.0, "arrive_radius_m": 0.05, "safety_margin_m": 0.03, "barrier_gain_per_s": 2.0,
    },
    "stop": {},
    "docking": {"place": [3.0, 4.0], "dock_rad": 0.5, "approach_m": 0.6, "speed_m_s": 0.1, "way": 0.0},
    "dispersion": {"spacing_m": 2.0, "gain": 0.5},
    "aggregation": {"gap_m": 0.6, "speed_m_s": 0.4, "turns_per_s": 0.1, "leave_per_s": 0.1, "away_s": 15.0},
    "leader_follower": {
        "leader_goal": [3.0, 4.0], "shape": "wedge", "spacing_m": 0.8, "speed_m_s": 0.3, "gain": 1.0, "hearing_m": 30.0,
    },
    "cyclic_pursuit": {
        "radius_m": 2.0, "speed_m_s": 0.3, "gain": 0.5, "direction": "clockwise", "hearing_m": 30.0,
    },
    "perimeter": {
        "corners": [[2.0, 2.0], [8.0, 2.0], [5.0, 7.0]], "speed_m_s": 0.1, "gain": 0.5, "hearing_m": 30.0,
    },
    "task_auction": {
        "tasks": [[1.0, 1.0], [5.0, 5.0], [8.0, 2.0]], "service_s": 0.0, "silent_s": 6.0, "speed_m_s": 0.4,
    },
    "pattern": {
        "picture": [[0.0, 0.0], [1.0, 0.0], [0.5, 1.0], [0.0, 1.0], [0.3, 0.2], [0.8, 0.7]], "centre": [5.0, 5.0],
        "width_m": 5.0, "gain": 0.5, "silent_s": 6.0,
    },
    "patrol": {
        "places": [[1.0, 1.0], [5.0, 5.0], [8.0, 2.0]], "speed_m_s": 0.4, "arrive_radius_m": 0.3, "gain": 2.0,
        "map": "shared",
    },
    "exploration": {"sight_m": 2.0, "speed_m_s": 0.4, "arrive_radius_m": 0.05, "gain": 2.0, "map": "shared"},
    "consensus": {"rate": 1.0, "wait_s": 0.0, "gain": 1.0},
    "average_consensus": {"quantity": "x", "wait_s": 15.0},
    "pursuit_evasion": {
        "evaders": 2, "speed_m_s": 0.4, "evader_m_s": 0.3, "capture_m": 0.6, "hearing_m": 30.0,
    },
    "flocking_adaptive": {
        "repulsion_radius_m": 0.8, "alignment_radius_m": 2.0, "attraction_radius_m": 2.7, "edge_m": 1.5,
        "separation": 1.5, "alignment": 1.0, "cohesion": 0.5, "cruise_m_s": 0.2,
    },
    "flocking_velocity": {
        "destination": [3.0, 4.0], "spacing_m": 1.0, "speed_m_s": 0.3, "stiffness": 1.0, "matching": 0.6,
        "navigation": 0.5,
    },
    "area_sweep": {"area": [[0.0, 0.0], [10.0, 8.0]], "lane_m": 0.8, "speed_m_s": 0.3},
}  # fmt: skip


SLOW = {"exploration": 1, "navigate": 6, "navigate_each": 6, "patrol": 3}
"""Swarms that are enough for laws that plan ways."""


@pytest.mark.parametrize("law", registry.LAWS)
def test_our_own_laws_pass(law: str) -> None:
    check_behaviour(law, PARAMETERS[law], seeds=range(SLOW.get(law, 20)))


def test_a_law_is_taken_by_module_and_for_any_number_of_robots() -> None:
    module = registry.law_module("flocking")
    for robots in (1, 2):
        check_behaviour(module, PARAMETERS["flocking"], robots=robots, seeds=range(3), bounds=(-9.0, -9.0, 9.0, 9.0))


def module(law: Callable[[View, Params], Any], name: str = "velocity") -> ModuleType:
    made = ModuleType("outside.mine")
    setattr(made, name, law)
    return made


def pull(view: View, _: Params) -> Array:
    """Head for the mean of the neighbours: a law without fault."""
    return view.sum(view.offset) / np.maximum(view.neighbours, 1.0)


def halves(view: View, _: Params) -> Array:
    view.offset[:] *= 0.5
    return view.sum(view.offset)


def wears_out(view: View, params: Params) -> Array:
    gain = params.gain
    gain *= 0.5
    return gain * pull(view, params)


def nearest(view: View, _: Params) -> Array:
    wish = np.zeros((len(view.position), 2))
    first = view.start[:-1][np.diff(view.start) > 0]
    wish[view.of[first]] = view.offset[first]
    return wish


def by_itself(view: View, params: Params) -> Array:
    gain: Array = getattr(params, "gain", np.ones(1))
    return gain * pull(view, params)


def with_default(view: View, params: Params) -> Array:
    gain: Array = vars(params).get("gain", np.full(1, 2.0))
    return gain * pull(view, params)


def by_dictionary(view: View, params: Params) -> Array:
    gain: Array = vars(params)["gain"]
    return gain * pull(view, params)


class Counting:
    """A law with a memory."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, view: View, params: Params) -> Array:
        self.calls += 1
        return pull(view, params) + self.calls


BROKEN_LAWS: list[tuple[Callable[[View, Params], Any], str]] = [
    (lambda view, _: pull(view, _)[:, 0], r"shape \(6,\) for 6 robots; return an array of shape \(6, 2\)"),
    (lambda view, _: view.position.tolist(), "a list for 6 robots"),
    (lambda view, _: np.zeros((len(view.position), 2), int), "int64, not floats"),
    (lambda view, _: view.sum(view.offset / view.distance[:, None]), "NaN or infinity, .*own place"),
    (lambda view, _: view.sum(view.offset) / view.neighbours, "NaN or infinity, "),
    (lambda view, p: (p.goal - view.position) / np.linalg.norm(p.goal - view.position, axis=1)[:, None],
     "exactly on their parameter 'goal'"),
    (lambda view, _: view.position - view.position.mean(axis=0), "must not mix"),
    (lambda view, p: p.gain[0] * pull(view, p), "must not mix"),
    (lambda view, _: view.sum(view.position[view.other % 9]), "raises IndexError"),
    (halves, r"modifies view\.offset"),
    (wears_out, r"modifies params\.gain"),
    (nearest, "order of the neighbours"),
    (Counting(), "answers the same question differently"),
    (lambda view, p: pull(view, p) + np.random.default_rng().random(), "answers the same question differently"),
    (with_default, "without the parameter 'gain' it answers something else"),
    (by_dictionary, r"KeyError.*read it as params\.gain"),
    (lambda view, p: p.speed * view.position, "needs a parameter 'speed'.*add it to the parameters of this check"),
]  # fmt: skip


@pytest.mark.parametrize(("law", "sentence"), BROKEN_LAWS)
def test_a_broken_law_is_told_what_is_wrong(law: Callable[[View, Params], Any], sentence: str) -> None:
    with pytest.raises(AssertionError, match=sentence) as caught:
        check_behaviour(module(law), {"gain": 1.0, "goal": [2.0, 3.0]}, seeds=range(3))
    assert str(caught.value).startswith("law 'mine': ")


def test_laws_without_fault_pass_whatever_they_are_called() -> None:
    for law, name in ((pull, "velocity"), (pull, "twist"), (by_itself, "velocity")):
        check_behaviour(module(law, name), {"gain": 1.0, "unused": "word"}, seeds=range(3))


@dataclass
class Memory:
    total: Array = rows(2)
    seen: Array = rows()


def integral(view: View, params: Params, kept: Memory) -> Array:
    """Use all that a law may know: a law without fault."""
    kept.total += view.dt_s * pull(view, params) + 0.01 * view.random.normal(0.0, 1.0, 2)
    kept.seen += view.time_s + view.index
    matched = view.sum(view.neighbour_velocity * (view.neighbour_index >= 0)[:, None])
    return kept.total + matched + 0.1 * kept.seen[:, None] + view.twist[:, :1]


def test_a_law_that_remembers_is_checked_over_some_calls() -> None:
    for law in (integral, lambda view, p, kept: integral(view, p, kept)):
        with_memory = module(law)  # type: ignore[arg-type]  # it takes its memory too
        with_memory.Memory = Memory  # type: ignore[attr-defined]
        check_behaviour(with_memory, {"gain": 1.0}, seeds=range(3))


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda view, kept: kept.total.__iadd__(kept.total.mean(axis=0) + view.position), "must not mix"),
        (lambda view, kept: kept.total.__iadd__(np.random.default_rng().random()), "differently.*view.random"),
        (lambda view, kept: setattr(kept, "others", 1.0), "declares no 'others'"),
        (lambda view, kept: setattr(kept, "total", np.zeros((9, 2))), "raises ValueError"),
        (lambda view, kept: kept.total.__imul__(np.inf), "NaN or infinity"),
    ],
)
def test_a_broken_law_with_memory_is_told_what_is_wrong(spoil: Callable[[View, Any], None], sentence: str) -> None:
    def broken(view: View, params: Params, kept: Memory) -> Array:
        spoil(view, kept)
        return pull(view, params) + kept.total

    with_memory = module(broken)  # type: ignore[arg-type]
    with_memory.Memory = Memory  # type: ignore[attr-defined]
    with pytest.raises(AssertionError, match=sentence):
        check_behaviour(with_memory, {}, seeds=range(3))


def talk(view: View, params: Params) -> Array:
    """Broadcast and write what follows from the own view: a law without fault."""
    heard = view.heard
    middle = (view.position + heard.sum(heard.total)) / (1.0 + heard.count)
    view.say(total=middle, seen=view.neighbours[:, 0])
    for row, count in enumerate(view.neighbours[:, 0]):
        view.table.put(row, "most", [count, float(view.index[row])])
    return params.gain * (middle - view.position)


def talking(law: Callable[[View, Params], Any], says: type = Memory, **merges: Callable[..., Any]) -> ModuleType:
    made = module(law)
    made.Says, made.MERGE = says, merges  # type: ignore[attr-defined]
    return made


def test_a_law_that_broadcasts_and_writes_is_checked() -> None:
    check_behaviour(talking(talk, most=max), {"gain": 1.0}, seeds=range(3))


@dataclass
class Long:
    much: Array = rows(40)


def says_the_mean(view: View, params: Params) -> Array:
    view.say(total=np.tile(view.position.mean(axis=0), (len(view.position), 1)), seen=0.0)
    return pull(view, params)


def says_a_part(view: View, params: Params) -> Array:
    view.say(total=1.0)
    return pull(view, params)


def says_the_first(view: View, params: Params) -> Array:
    heard = view.heard
    first = np.zeros(len(view.position))
    first[heard.of[::-1]] = heard.seen[::-1]
    view.say(total=view.position, seen=first)
    return pull(view, params)


def writes_the_count(view: View, params: Params) -> Array:
    for row in range(len(view.position)):
        view.table.put(row, "robots", float(len(view.position)))
    return pull(view, params)


@pytest.mark.parametrize(
    ("law", "sentence"),
    [
        (talking(says_the_mean), "r1 broadcasts .* among others and by itself"),
        (talking(says_the_first), "order of the neighbours changes it"),
        (talking(writes_the_count), "r1 writes .* into the table: among others and by itself"),
        (talking(says_a_part), "declared are total, seen"),
        (talking(talk, says=Long), "would broadcast 320 bytes"),
        (talking(talk, most=lambda a, b: a), "merge of 'most' depends on order"),
        (talking(talk, most=lambda a, b: a + b), "merge of 'most' depends on order"),
        (talking(talk, most=lambda a, b: a.best), "merge of 'most' raises AttributeError"),
    ],
)
def test_a_broken_law_that_broadcasts_is_told_what_is_wrong(law: ModuleType, sentence: str) -> None:
    with pytest.raises(AssertionError, match=sentence):
        check_behaviour(law, {"gain": 1.0}, seeds=range(3))


def test_what_is_no_law() -> None:
    with pytest.raises(AssertionError, match=r"neither velocity\(view, params\) nor twist"):
        check_behaviour(module(pull, "law"), {})
    with pytest.raises(ConfigError, match="did you mean 'flocking'"):
        check_behaviour("floking", {})


def test_laws_of_mixed_swarms_are_checked_with_roles_and_capabilities() -> None:
    found: set[tuple[str, bool]] = set()

    def velocity(view: View, params: Params) -> Array:
        found.update(zip(view.role.tolist(), view.can("carry").tolist(), strict=True))
        pull = np.where((view.neighbour_role == "leader") & view.neighbour_can("carry"), 1.0, 0.1)
        return view.sum(pull[:, None] * view.offset)

    check_behaviour(
        module(velocity), {}, seeds=range(3), roles=("leader", "follower", "leader"), capabilities=("carry",)
    )  # fmt: skip
    assert found == {("leader", True), ("leader", False), ("follower", True), ("follower", False)}

    def by_row(view: View, params: Params) -> Array:
        return np.full_like(view.position, float((view.role == "leader").sum()))  # of the robots that share the call

    with pytest.raises(AssertionError):
        check_behaviour(module(by_row), {}, seeds=range(3), roles=("leader", "follower"))
