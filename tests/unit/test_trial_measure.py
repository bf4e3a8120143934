"""What a trial measures besides its outcome: trajectory, what the swarm says, what is true, how it ended."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fullswarm.launch.evaluate.trial import measure, run_trial
from fullswarm.perf.experiment import Trial, load_experiment, plan, scenario_of

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
    one = trial(time_limit_s=2.0)
    found = measure(replace(one, cell=replace(one.cell, network="loss=20%,delay=50ms", noise_m=0.01)))
    assert found.end_reason == "time limit"
    assert found.onboard["work.robots"] == 8
    assert found.onboard["work.total_m"] == pytest.approx(found.truth["work.total_m"], rel=0.5)
