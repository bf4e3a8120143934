"""What a trial measures besides its outcome: trajectory, what the swarm says, what is true, how it ended."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fullswarm.evaluate.experiment import Trial, load_experiment, plan, scenario_of
from fullswarm.evaluate.lockstep_swarm import measure, run_trial
from fullswarm.evaluate.trial_folder import save_arrays

WALL = ("robots=4,scenario=concave,engine=kinematic,behaviour=move_to_goal",)
OPEN = ("robots=8,scenario=empty_dense,engine=kinematic,behaviour=move_to_goal_bc",)


def trial(cells: tuple[str, ...] = OPEN, **changes: object) -> Trial:
    (one,) = plan(load_experiment("paper"), (0,), cells, engine="kinematic")
    return replace(one, **changes)  # type: ignore[arg-type]  # names are given by the test


def test_the_trajectory_begins_with_the_request_and_ends_with_the_trial() -> None:
    one = trial()
    found = measure(one)
    path, scenario = found.trajectory, scenario_of(one)
    assert path is not None
    assert found.end_reason == "all arrived"
    assert path.time_s[0] == 0.0
    assert path.time_s[-1] == pytest.approx(found.outcome.simulated_s, abs=0.021)
    assert np.diff(path.time_s)[:-1] == pytest.approx(0.2)
    assert 0.0 < path.time_s[-1] - path.time_s[-2] <= 0.2 + 1e-9
    assert path.pose.shape == (len(path.time_s), 8, 3)
    assert path.ids == tuple(f"r{row}s0" for row in range(8))
    left, low, right, high = scenario.spawn.region_m
    start, end = path.pose[0, :, :2], path.pose[-1, :, :2]
    assert ((start >= (left, low)) & (start <= (right, high))).all()
    assert (np.hypot(*(end - path.goals).T) <= path.goal_radius_m).all()
    assert not path.touching.any()
    assert path.bounds_m.tolist() == list(scenario.bounds_m)


def test_touching_is_told_by_sample_and_robot() -> None:
    found = measure(trial(WALL, time_limit_s=10.0))
    path = found.trajectory
    assert path is not None
    assert len(path.boxes) == 18
    assert found.outcome.obstacle_events > 0
    touched = path.touching.any(axis=0)
    events = found.per_robot["truth collisions.events"]
    assert touched.tolist() == [events[robot] > 0 for robot in path.ids]
    assert not path.touching[0].any()


def test_the_swarm_tells_the_truth_when_its_senses_are_perfect() -> None:
    found = measure(trial())
    assert found.truth["work.total_m"] > 8 * 8.0
    for name in ("work.total_m", "work.max_m", "coverage.fraction", "coverage.area_m2", "collisions.events"):
        assert found.onboard[name] == pytest.approx(found.truth[name], rel=1e-3), name
    assert found.per_robot["onboard work.distance_m"].keys() == found.per_robot["truth work.distance_m"].keys()
    assert found.onboard["work.elapsed_s"] == pytest.approx(found.outcome.simulated_s, abs=0.05)


def test_the_grid_is_what_the_fraction_counts() -> None:
    found = measure(trial())
    assert found.coverage is not None
    frame, covered = found.coverage
    assert covered.shape == (frame.rows, frame.columns)
    assert found.onboard["coverage.fraction"] == pytest.approx(covered.sum() / frame.cells)


def test_nothing_is_measured_before_the_request() -> None:
    """Robots that stand in contact from the start are counted once, and have driven nowhere."""
    found = measure(trial(time_limit_s=0.1))
    assert found.end_reason == "time limit"
    assert found.onboard["work.total_m"] < 8 * 0.1
    assert found.truth["work.total_m"] < 8 * 0.1


@pytest.mark.parametrize(
    ("stop", "reason"),
    [
        ((("coverage_at_least", 0.03),), "coverage_at_least"),
        ((("stop_on_collision", True),), "stop_on_collision"),
        ((("max_execution_s", 2.0),), "max_execution_s"),
    ],
)
def test_a_termination_condition_ends_the_trial(stop: tuple[tuple[str, float], ...], reason: str) -> None:
    one = trial(WALL, stop=stop)
    found = measure(one)
    assert found.end_reason == reason
    assert found.outcome.simulated_s < 20.0
    if reason == "coverage_at_least":
        assert 0.03 <= found.onboard["coverage.fraction"] < 0.05
    if reason == "stop_on_collision":
        assert found.outcome.events > 0
    if reason == "max_execution_s":
        assert found.outcome.simulated_s == pytest.approx(2.0, abs=0.05)
    assert run_trial(one).end_reason == reason


def test_a_bad_network_is_measured_too() -> None:
    one = trial(time_limit_s=3.0)  # in 2 s one lost report is half of the way
    found = measure(replace(one, cell=replace(one.cell, network="loss=20%,delay=50ms", noise_m=0.01)))
    assert found.end_reason == "time limit"
    assert found.onboard["work.robots"] == 8
    assert found.onboard["work.total_m"] == pytest.approx(found.truth["work.total_m"], rel=0.4)


# ------------------------------------------------------------------------------------- counted again by an outsider
def recounted(path: Path) -> dict[str, Any]:
    """Count contacts from the stored file alone, with nothing of the referee: all pairs, ways finely sampled."""
    with np.load(path) as file:
        stored = {name: file[name] for name in file.files}
    count, step_s, touch_m = len(stored["ids"]), float(stored["step_s"]), float(stored["touch_m"])
    closest, events, touched, pairs = np.full((count, count), np.inf), np.zeros((2, count), int), set(), set()
    last_s = np.full((2, count), -np.inf)
    xy, fine = np.cumsum(stored["xy"], axis=0) * 1e-5, np.linspace(0.0, 1.0, 40)[:, None, None]
    for step in range(1, len(xy)):
        part = np.concatenate([[0.0], stored["part_s"] / step_s])[:, None, None]
        corners = xy[step - 1] + (xy[step] - xy[step - 1]) * part
        for bend in np.flatnonzero(stored["bend_step"] == step):
            robot = stored["bend_robot"][bend]
            corners[1:, robot] = xy[step - 1, robot] + np.cumsum(stored["bend"][bend], axis=0) * 1e-5
        places = np.concatenate([a + (b - a) * fine for a, b in itertools.pairwise(corners)])
        hit = np.zeros((2, count), bool)
        for i in range(count):
            gaps = np.hypot(*(places - places[:, i : i + 1]).transpose(2, 0, 1)).min(axis=0)
            gaps -= stored["radius_m"] + stored["radius_m"][i]
            gaps[i] = np.inf
            closest[i] = np.minimum(closest[i], gaps)
            hit[0, i] = (gaps <= touch_m).any()
            pairs |= {(min(i, int(j)), max(i, int(j))) for j in np.flatnonzero(gaps <= touch_m)}
            for x, y, half_x, half_y, yaw, _ in stored["obstacles"]:
                turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
                outside = np.maximum(np.abs((places[:, i] - (x, y)) @ turn) - (half_x, half_y), 0.0)
                hit[1, i] |= np.hypot(*outside.T).min() - stored["radius_m"][i] <= touch_m
        for kind in range(2):
            events[kind] += hit[kind] & (step * step_s - last_s[kind] >= 0.25 - 1e-9)
            last_s[kind][hit[kind]] = step * step_s
        touched |= set(np.flatnonzero(hit.any(axis=0)).tolist())
    return {
        "robot_events": int(events[0].sum()),
        "obstacle_events": int(events[1].sum()),
        "pairs_touched": len(pairs),
        "robots_touched": len(touched),
        "closest": closest[np.triu_indices(count, 1)],
    }


@pytest.mark.parametrize(
    ("cell", "limit_s"),
    [
        ("robots=8,scenario=empty_dense,engine=kinematic,behaviour=move_to_goal", 8.0),
        ("robots=8,scenario=uniform,engine=kinematic,behaviour=move_to_goal", 6.0),
        ("robots=16,scenario=empty,engine=pybullet,behaviour=move_to_goal", 8.0),
    ],
)
def test_an_outsider_counts_the_same_contacts_from_what_is_stored(cell: str, limit_s: float, tmp_path: Path) -> None:
    engine = "pybullet" if "pybullet" in cell else "kinematic"
    (one,) = plan(load_experiment("paper"), (2,), (cell,), engine=engine)
    found = measure(replace(one, time_limit_s=limit_s))
    assert found.evidence is not None
    save_arrays(found.evidence, tmp_path / "evidence.npz")
    again, outcome = recounted(tmp_path / "evidence.npz"), found.outcome
    assert outcome.pairs_touched is not None
    assert outcome.pairs_touched > 3
    assert outcome.robots_touched == found.truth["collisions.robots_touched"]
    for name in ("robot_events", "obstacle_events", "pairs_touched", "robots_touched"):
        assert again[name] == getattr(outcome, name), name
    stored = found.evidence.closest_m
    assert (stored <= found.evidence.touch_m).sum() == outcome.pairs_touched
    near = again["closest"] < 0.05
    np.testing.assert_allclose(stored[near], again["closest"][near], atol=1e-3)
    # Ways within a step are taken as straight for pairs that are far from each other.
    np.testing.assert_allclose(stored, again["closest"], atol=0.02)
    assert found.truth["separation.min_m"] == pytest.approx(float(stored.min()))


def test_without_a_contact_the_closest_approaches_are_kept_alone_unless_all_is_asked_for() -> None:
    evidence = measure(trial()).evidence
    assert evidence is not None
    assert not evidence.has_contact
    assert len(evidence.xy) == len(evidence.command) > 100
    assert evidence.kept("always") is evidence
    less = evidence.kept("contacts")
    assert less.xy.size == less.heading.size == less.command.size == less.bend.size == 0
    assert len(less.closest_m) == 8 * 7 // 2
    assert less.closest_m.min() > less.touch_m
    assert less.closest_s.max() <= 20.0
