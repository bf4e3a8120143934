"""Measures of a study against cases whose values follow by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.errors import ConfigError
from fullswarm.operator.console.study import RobotSample, Sample, count
from fullswarm.study.file import MeasuresSection
from fullswarm.study.measures import (
    Episode,
    Input,
    Neglect,
    TrialLog,
    attention_demand,
    effectiveness,
    episodes_of,
    fan_out,
    inputs_of,
    is_correct,
    measures_of,
    neglects_of,
    raw_tlx,
    read_log,
    restricted_mean,
    switches_of,
    weighted_tlx,
)

R1, R2, ALL = frozenset({"r1"}), frozenset({"r2"}), frozenset[str]()
SETTINGS = MeasuresSection()


def test_inputs_close_together_to_the_same_robots_are_one_episode() -> None:
    inputs = [Input(1.0, R1), Input(3.0, R1), Input(5.5, R1), Input(9.0, R1), Input(9.2, R2), Input(19.8, R1)]
    found = episodes_of(inputs, gap_s=3.0, least_s=0.5, end_s=20.0)
    assert found == [
        Episode(1.0, 5.5, R1),
        Episode(9.0, 9.2, R1),  # ends when another robot is addressed
        Episode(9.2, 9.7, R2),
        Episode(19.8, 20.0, R1),  # cut off by the end of the trial
    ]


def test_clearing_the_selection_and_other_pages_address_nothing() -> None:
    events: list[dict[str, Any]] = [
        {"at_s": 1.0, "kind": "select", "robots": ["r1"], "participant": True},
        {"at_s": 2.0, "kind": "select", "robots": [], "participant": True},
        {"at_s": 3.0, "kind": "request", "robots": [], "participant": True},
        {"at_s": 4.0, "kind": "view", "robots": [], "participant": True},
        {"at_s": 5.0, "kind": "request", "robots": ["r1"], "participant": False},
    ]
    assert inputs_of(events) == [Input(1.0, R1), Input(3.0, ALL)]
    assert switches_of([Input(0.0, R1), Input(1.0, R1), Input(2.0, R2), Input(3.0, R1), Input(4.0, ALL)]) == 3
    assert switches_of([]) == 0


def test_effectiveness_is_the_mean_speed_of_the_last_window() -> None:
    at_s = np.arange(0.0, 10.0, 0.5)
    speed = np.where(at_s < 5.0, 0.2, 0.0)
    found = effectiveness(at_s, speed, window_s=2.0, full_m_s=0.4)
    assert found[at_s == 4.5] == pytest.approx(0.5)
    assert found[at_s == 5.0] == pytest.approx(0.375)  # three of the four samples in (3, 5] move
    assert found[at_s == 6.5] == pytest.approx(0.0)
    assert effectiveness(at_s, np.full(20, 3.0), 2.0, 0.4).max() == 1.0
    assert effectiveness(at_s, np.full(20, np.nan), 2.0, 0.4).max() == 0.0


def neglect_of(good: list[bool], from_s: float, next_s: float | None, end_s: float) -> list[Neglect]:
    at_s = np.arange(len(good), dtype=float)
    episodes = [Episode(from_s - 0.5, from_s, R1)]
    if next_s is not None:
        episodes.append(Episode(next_s, end_s, R1))
    return neglects_of(episodes, "r1", end_s, at_s, np.array(good, float), SETTINGS)


def test_a_robot_is_tolerably_neglected_until_it_is_no_longer_effective() -> None:
    fell = [False, False, True, True, True, True, False, False, False, False, False]
    assert neglect_of(fell, 1.0, None, 10.0) == [Neglect(1.0, 10.0, 5.0, False)]
    assert neglect_of(fell, 1.0, 4.0, 10.0) == [Neglect(1.0, 4.0, 3.0, True)]  # attended to while still effective
    assert neglect_of([True] * 11, 1.0, None, 10.0) == [Neglect(1.0, 10.0, 9.0, True)]
    assert neglect_of([False] * 11, 1.0, None, 10.0) == [Neglect(1.0, 10.0, 0.0, False)]  # never set off


def test_an_episode_with_all_robots_ends_the_neglect_of_each() -> None:
    episodes = [Episode(0.0, 1.0, R1), Episode(4.0, 5.0, ALL), Episode(7.0, 8.0, R2)]
    at_s, good = np.arange(11.0), np.ones(11)
    assert [(each.from_s, each.to_s) for each in neglects_of(episodes, "r1", 10.0, at_s, good, SETTINGS)] == [
        (1.0, 4.0), (5.0, 10.0),
    ]  # fmt: skip
    assert [(each.from_s, each.to_s) for each in neglects_of(episodes, "r2", 10.0, at_s, good, SETTINGS)] == [
        (5.0, 7.0), (8.0, 10.0),
    ]  # fmt: skip


def test_the_mean_of_censored_times_is_the_area_under_kaplan_meier() -> None:
    assert restricted_mean([], []) is None
    assert restricted_mean([2.0, 4.0], [False, False]) == pytest.approx(3.0)  # nothing censored: the plain mean
    # 2 (fell), 3 (censored), 5 (fell): 1 until 2, 2/3 until 5
    assert restricted_mean([2.0, 3.0, 5.0], [False, True, False]) == pytest.approx(2.0 + 3.0 * 2.0 / 3.0)
    assert restricted_mean([4.0], [True]) == pytest.approx(4.0)


@given(st.lists(st.tuples(st.floats(0.1, 100.0), st.booleans()), min_size=1, max_size=30))
def test_it_agrees_with_scipy(cases: list[tuple[float, bool]]) -> None:
    from scipy import stats

    times, cut = [time for time, _ in cases], [censored for _, censored in cases]
    data = stats.CensoredData(
        uncensored=[time for time, censored in cases if not censored],
        right=[time for time, censored in cases if censored],
    )
    curve = stats.ecdf(data).sf
    edges = [0.0, *curve.quantiles]
    heights = [1.0, *curve.probabilities[:-1]]
    area = sum(height * (b - a) for height, a, b in zip(heights, edges, edges[1:], strict=False))
    assert restricted_mean(times, cut) == pytest.approx(area)


def test_demand_and_fan_out() -> None:
    assert attention_demand(5.0, 15.0) == 0.25
    assert fan_out(5.0, 15.0) == 4.0
    assert attention_demand(0.0, 0.0) is None
    assert fan_out(0.0, 3.0) is None


def test_answers_are_compared_with_the_truth() -> None:
    assert is_correct("3", "3.0", numeric=True, tolerance=0.0)
    assert is_correct("3", "4", numeric=True, tolerance=1.0)
    assert is_correct("3", "5", numeric=True, tolerance=1.0) is False
    assert is_correct("3", "", numeric=True, tolerance=1.0) is False
    assert is_correct("left", "left", numeric=False, tolerance=0.0)
    assert is_correct("", "left", numeric=False, tolerance=0.0) is None


def test_counts_leave_silent_robots_out() -> None:
    def robot(
        name: str, behaviour: str, *, moving: bool = False, estop: bool = False, silent: bool = False
    ) -> RobotSample:
        return RobotSample(name, 0.0, 0.0, 0.0, 0.1, behaviour, moving, estop, silent)

    sample = Sample(
        0.0,
        (
            robot("r1", "flocking_bc", moving=True),
            robot("r2", "flocking_bc"),
            robot("r3", "", estop=True),
            robot("r4", "", moving=True, silent=True),
        ),
    )
    truths = ("robots", "moving", "stopped", "estopped", "silent", "idle", "running flocking_bc")
    assert [count(truth, sample) for truth in truths] == [4, 1, 2, 1, 1, 1, 2]


def test_the_workload_of_a_worked_example() -> None:
    ratings = {
        "mental": 80, "physical": 20, "temporal": 60, "performance": 40, "effort": 70, "frustration": 30,
    }  # fmt: skip
    weights = {"mental": 5, "physical": 0, "temporal": 3, "performance": 2, "effort": 4, "frustration": 1}
    assert raw_tlx(ratings) == 50.0
    assert weighted_tlx(ratings, weights) == pytest.approx((400 + 180 + 80 + 280 + 30) / 15)


def test_all_of_a_trial() -> None:
    """One robot, addressed from 1 to 2 s; it moves until 8 s and stands then, to the end at 11 s."""
    events: list[dict[str, Any]] = [
        {"at_s": 1.0, "kind": "select", "robots": ["r1"], "participant": True},
        {"at_s": 2.0, "kind": "request", "robots": ["r1"], "participant": True},
        {"at_s": 5.0, "kind": "probe", "name": "n", "truth": "1", "numeric": True, "tolerance": 0.0},
        {"at_s": 5.5, "kind": "answer", "name": "n", "value": "1", "response_s": 0.5},
        {"at_s": 7.0, "kind": "probe", "name": "n", "truth": "1", "numeric": True, "tolerance": 0.0},
        {"at_s": 9.0, "kind": "answer", "name": "n", "value": "", "response_s": 2.0, "why": "timeout"},
        {"at_s": 11.0, "kind": "end", "metrics": {"work": {"total_m": 1.5}}},
    ]
    motion = tuple(
        Sample(at_s, (RobotSample("r1", 0.0, 0.0, 0.0, 0.2 if 2.0 < at_s <= 8.0 else 0.0, "x", True, False, False),))
        for at_s in np.arange(0.0, 11.01, 0.25).tolist()
    )
    found = {(each.name, each.of): each.value for each in measures_of(TrialLog(tuple(events), motion), SETTINGS)}
    assert found["interaction_time_total", ""] == 1.0
    assert found["neglect_time_mean", ""] == 9.0
    # Half of the last 2 s at 0.2 m/s is a mean of 0.1 m/s, which is full effectiveness; below one half after 9.5 s.
    assert found["neglect_tolerance", ""] == pytest.approx(9.75 - 2.0)
    assert found["neglects_censored", ""] == 0
    assert found["fan_out", ""] == pytest.approx((1.0 + 7.75) / 1.0)
    assert found["robot_attention_demand", ""] == pytest.approx(1.0 / 8.75)
    assert found["probe_accuracy", ""] == 0.5
    assert found["probe_response_time_mean", ""] == 0.5
    assert found["work_total_m", ""] == 1.5
    assert found["inputs", "request"] == 1


def test_a_line_that_was_cut_off_is_left_out_and_rubbish_is_reported(tmp_path: Path) -> None:
    (tmp_path / "motion.jsonl").write_text('{"at_s":1.0,"robots":[]}\n{"at_s":1.2,"ro')
    (tmp_path / "events.jsonl").write_text('{"at_s":1.0,"kind":"begin"}\n')
    log = read_log(tmp_path)
    assert (len(log.events), len(log.motion)) == (1, 1)
    (tmp_path / "events.jsonl").write_text("rubbish\n")
    with pytest.raises(ConfigError, match="is no log of a trial"):
        read_log(tmp_path)
