"""The report's main comparison: which one is chosen, how it is paired, and its interval."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy import stats

from fullswarm.evaluate.experiment import Trial
from fullswarm.evaluate.results import read_records
from fullswarm.evaluate.results.figures import effect_plot
from fullswarm.evaluate.results.headline import Headline, headline, signed
from fullswarm.evaluate.results.report import write_report
from tests.unit.results_fixture import a_record, a_trial, write_folder, write_trial


def found_in(folder: Path) -> Headline:
    found = headline(read_records(folder))
    assert found is not None
    return found


def write_events(out: Path, trial: Trial, events: int) -> None:
    record = a_record(trial)
    assert record.outcome is not None
    outcome = msgspec.structs.replace(record.outcome, robot_events=events, obstacle_events=0)
    write_trial(out, trial, record=msgspec.structs.replace(record, outcome=outcome), samples=2)


def test_with_and_without_the_filter_paired_by_seed(tmp_path: Path) -> None:
    write_folder(tmp_path, samples=2)
    found = found_in(tmp_path)
    assert (found.a, found.b, found.paired) == ("without the safety filter", "with the safety filter", True)
    assert found.seeds == 3  # the fourth has failed in one cell: a seed counts when it has all cells
    assert [each.name for each in found.cells] == [
        "uniform, 4 robots", "uniform, 8 robots", "concave, 4 robots", "concave, 8 robots",
    ]  # fmt: skip
    assert found.whole.b == 0.0
    assert found.verdict == "Collisions per trial: lower with the safety filter"


def test_the_interval_is_that_of_the_seeds_means(tmp_path: Path) -> None:
    counts = {"empty": (3, 5, 4), "corridor": (9, 8, 1)}
    events = {(scenario, seed): count for scenario, some in counts.items() for seed, count in enumerate(some)}
    for (scenario, seed), count in events.items():
        write_events(tmp_path, a_trial("move_to_goal", scenario, 4, seed), count)
        write_events(tmp_path, a_trial("move_to_goal_bc", scenario, 4, seed), 1)
    found = found_in(tmp_path)
    differences = [1.0 - (3 + 9) / 2, 1.0 - (5 + 8) / 2, 1.0 - (4 + 1) / 2]
    low, high = stats.t.interval(0.95, 2, np.mean(differences), stats.sem(differences))
    assert found.whole.difference == pytest.approx(np.mean(differences))
    assert (found.whole.low, found.whole.high) == pytest.approx((low, high))
    assert found.whole.differences == pytest.approx(tuple(differences))
    assert "paired over 3 seeds, mean over 2 cells" in found.sentence
    assert signed(low, 2) in found.sentence


def test_without_a_common_seed_the_sides_are_two_groups(tmp_path: Path) -> None:
    sides = {"move_to_goal": [4, 6, 9], "move_to_goal_bc": [0, 1, 0, 2]}
    for place, (behaviour, counts) in enumerate(sides.items()):
        for seed, count in enumerate(counts):
            write_events(tmp_path, a_trial(behaviour, "empty", 4, 10 * place + seed), count)
    found = found_in(tmp_path)
    known = stats.ttest_ind(sides["move_to_goal_bc"], sides["move_to_goal"], equal_var=False).confidence_interval()
    assert not found.paired
    assert (found.whole.low, found.whole.high) == pytest.approx((known.low, known.high))
    assert "two independent groups" in found.sentence
    assert found.whole.differences == ()


def test_two_behaviours_or_two_engines_are_the_comparison(tmp_path: Path) -> None:
    for seed, count in enumerate((2, 3)):
        write_events(tmp_path / "a", a_trial("navigate", "empty", 4, seed), count)
        write_events(tmp_path / "a", a_trial("move_to_goal", "empty", 4, seed), 1)
        write_events(tmp_path / "b", a_trial("navigate", "empty", 4, seed, "kinematic"), count)
        write_events(tmp_path / "b", a_trial("navigate", "empty", 4, seed, "pybullet"), count + 1)
    assert (found_in(tmp_path / "a").a, found_in(tmp_path / "a").b) == ("with move_to_goal", "with navigate")
    engines = found_in(tmp_path / "b")
    assert engines.b == "with engine “pybullet”"
    assert math.isnan(engines.whole.low)
    assert "no interval: the difference does not vary" in engines.sentence
    assert "no difference shown" in engines.verdict


def test_when_nothing_collides_another_quantity_is_compared(tmp_path: Path) -> None:
    for seed in range(3):
        for behaviour in ("move_to_goal", "navigate"):
            write_events(tmp_path, a_trial(behaviour, "concave", 4, seed), 0)
    assert found_in(tmp_path).quantity.title == "Robots that arrived"


def test_three_behaviours_are_no_single_comparison(tmp_path: Path) -> None:
    for behaviour in ("flocking", "move_to_goal", "navigate"):
        write_events(tmp_path, a_trial(behaviour, "empty", 4, 0), 1)
    assert headline(read_records(tmp_path)) is None
    text = write_report(tmp_path).read_text("utf-8")
    assert "No main comparison" in text
    assert "A B --by behaviour" in text


def test_conditions_with_other_seeds_are_left_out_and_counted(tmp_path: Path) -> None:
    for scenario, seeds in (("empty", range(4)), ("uniform", range(4)), ("concave", range(7, 8))):
        for seed in seeds:
            for behaviour, count in (("move_to_goal", 2 + seed), ("move_to_goal_bc", 0)):
                write_events(tmp_path, a_trial(behaviour, scenario, 4, seed), count)
    found = found_in(tmp_path)
    assert (found.seeds, found.left_out, len(found.cells)) == (4, 1, 2)
    assert "1 cell with other seeds left out" in effect_plot(found, "e").caption


def test_the_report_begins_with_the_sentence_and_its_figure(tmp_path: Path) -> None:
    write_folder(tmp_path, samples=2)
    text = write_report(tmp_path).read_text("utf-8")
    head = text[text.index("<header>") : text.index("</header>")]
    assert found_in(tmp_path).detail in head
    assert 'id="effect-title"' in head


def test_groups_of_one_cell_are_compared_by_group(tmp_path: Path) -> None:
    for group, count in (("near", 1), ("far", 3)):
        for seed in range(2):
            trial = a_trial("move_to_goal", "empty", 4, seed)
            trial = replace(trial, cell=replace(trial.cell, group=group), agent=(("safety_margin_m", count / 10),))
            write_events(tmp_path, trial, count + seed)
    assert {found_in(tmp_path).a, found_in(tmp_path).b} == {"with group “near”", "with group “far”"}


def test_signs() -> None:
    assert [signed(each, 1) for each in (-1.25, 0.0, -0.01, 2.0)] == ["−1.2", "0.0", "0.0", "+2.0"]
