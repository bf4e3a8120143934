"""The report: whole in itself, the same bytes for the same trials, every trouble named."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fullswarm.evaluate.results import read_records, write_plots, write_report
from fullswarm.evaluate.results.cards import card_of
from fullswarm.evaluate.results.figures import collisions_plot, means_plot, trajectories_plot, unlinked
from fullswarm.evaluate.results.report import cells_grid, filter_grid, interval, p_text, trials_grid
from fullswarm.evaluate.results.sample import bare, conditions, is_filtered
from fullswarm.evaluate.trial_folder import COVERAGE_FILE, RESULT_FILE, TRAJECTORY_FILE
from tests.unit.results_fixture import FAILURE, a_record, a_trial, write_folder, write_trial

VOID = {"meta", "br", "hr", "img", "link", "input"}


class Page(HTMLParser):
    """Checks that tags close, and keeps links and ids."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def of(self, name: str) -> list[str]:
        return [value for _, attribute, value in self.attributes if attribute == name]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = write_folder(tmp_path_factory.mktemp("results"), seeds=2)
    broken = write_trial(out, a_trial("move_to_goal", "empty", 4, 0))
    (broken / RESULT_FILE).write_text("{")
    return out


@pytest.fixture(scope="module")
def text(folder: Path) -> str:
    return write_report(folder).read_text("utf-8")


def test_the_report_is_whole_in_itself(folder: Path, text: str) -> None:
    page = Page(text)
    assert page.open == []
    assert not re.search(r"https?:|(?:href|src|url)[=(][\"']?//|@import|<script|<link|<iframe", text)
    assert all(each.startswith(("data:", "#")) for tag, name, each in page.attributes if name == "href" and tag != "a")
    assert page.of("src") == []
    for link in (value for tag, name, value in page.attributes if tag == "a" and name == "href"):
        assert link[1:] in page.of("id") if link.startswith("#") else (folder / link).exists(), link


def test_ids_on_the_page_are_unique_and_all_used_ones_exist(text: str) -> None:
    page = Page(text)
    ids = page.of("id")
    assert len(ids) == len(set(ids))
    used = set(re.findall(r"url\(#([^)]+)\)", text)) | set(re.findall(r'<use[^>]* href="#([^"]+)"', text))
    assert used <= set(ids)
    assert used


def test_light_dark_and_paper(text: str) -> None:
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text
    assert "var(--ink" in text


def test_every_trouble_is_named(folder: Path, text: str) -> None:
    assert "law raised &lt;ValueError&gt;: no way &amp; no hope" in text
    assert FAILURE not in text  # a reason is text, never markup
    failed = next(each for each in read_records(folder) if each.record.outcome is None)
    assert f'href="trials/{failed.path.name}/"' in text
    assert "unreadable" in text
    assert "trials failed" in text


def test_the_same_trials_give_the_same_bytes(folder: Path, text: str) -> None:
    assert write_report(folder).read_text("utf-8") == text


def test_nothing_but_the_results_is_left(folder: Path, text: str) -> None:
    assert text
    assert sorted(each.name for each in folder.iterdir()) == ["index.sqlite", "report.html", "results.csv", "trials"]


def test_plots_for_documentation(folder: Path, tmp_path: Path) -> None:
    paths = write_plots(folder, tmp_path / "deep" / "docs")
    names = {each.name for each in paths}
    assert {"collisions.svg", "means.svg", "trajectories-concave.svg", "coverage-uniform.svg", "table.md"} <= names
    for path in paths:
        if path.suffix == ".svg":
            assert ET.fromstring(path.read_text("utf-8")).tag.endswith("svg")
            assert path.stat().st_size < 200_000
            assert not re.search(r"<dc:date>|\d{4}-\d\d-\d\dT", path.read_text("utf-8"))
    table = (tmp_path / "deep" / "docs" / "table.md").read_text("utf-8")
    assert "| concave | move_to_goal | 4 |" in table
    tables = [each.splitlines() for each in re.findall(r"(?:^\|.*\n)+", table, re.MULTILINE)]
    assert len(tables) == 2
    assert all(line.count("|") == lines[0].count("|") for lines in tables for line in lines)


def test_a_report_of_failed_trials_alone(tmp_path: Path) -> None:
    write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0), FAILURE)
    text = write_report(tmp_path).read_text("utf-8")
    assert "No trial has figures" in text
    assert "no way &amp; no hope" in text


def test_broken_recordings_cost_their_pictures_only(tmp_path: Path) -> None:
    for seed in range(2):
        path = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, seed))
        (path / TRAJECTORY_FILE).write_bytes(b"PK\x03\x04 no archive")
        (path / COVERAGE_FILE).write_bytes(b"")
    text = write_report(tmp_path).read_text("utf-8")
    assert "Collisions per trial" in text
    assert "Trajectories and coverage" not in text


def test_missing_trials_are_named(tmp_path: Path) -> None:
    path = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    asked = {"name": "paper", "small": True, "seeds": "0-1", "trials": [path.name, "move_to_goal-lost"]}
    (tmp_path / "experiment.json").write_bytes(msgspec.json.encode(asked))
    text = write_report(tmp_path).read_text("utf-8")
    assert "move_to_goal-lost" in text
    assert "experiment run paper --small --seeds 0-1 --out" in text


def test_conditions_have_figures_of_their_own(tmp_path: Path) -> None:
    for engine in ("kinematic", "pybullet"):
        write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0, engine))
    assert [each.name for each in conditions(read_records(tmp_path))] == [
        "kinematic engine, limits “paper”",
        "pybullet engine, limits “paper”",
    ]
    ids = Page(write_report(tmp_path).read_text("utf-8")).of("id")
    assert {"collisions-title", "collisions-2-title"} <= set(ids)
    assert len(ids) == len(set(ids))


def test_groups_that_differ_by_nothing_else_have_figures_of_their_own(tmp_path: Path) -> None:
    for group in ("near", "far"):
        for robots in (4, 8)[: 1 + (group == "far")]:
            trial = a_trial("move_to_goal", "empty", robots, 0)
            write_trial(tmp_path, replace(trial, cell=replace(trial.cell, group=group)))
    found = conditions(read_records(tmp_path))
    assert sorted((each.name, len(each.samples)) for each in found) == [
        ("kinematic engine, limits “paper”, far", 2),
        ("kinematic engine, limits “paper”, near", 1),
    ]
    text = write_report(tmp_path).read_text("utf-8")
    assert {"collisions-title", "collisions-2-title"} <= set(Page(text).of("id"))
    assert trials_grid(read_records(tmp_path)).headers[0] == "Group"
    assert trials_grid(read_records(tmp_path)[:1]).headers[0] == "Scenario"


@pytest.mark.parametrize(
    ("how", "fleet", "end"),
    [("live create2", None, "--live --network loss=5% --emulate create2"),
     ("fleet", "lab.toml", "--network loss=5% --fleet lab.toml"),
     ("lockstep", None, "--network loss=5%")],
)  # fmt: skip
def test_the_command_for_what_is_missing_is_whole(tmp_path: Path, how: str, fleet: str | None, end: str) -> None:
    path = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0), FAILURE)
    asked = {"name": "paper", "file": "/my hall.toml", "network": "loss=5%", "trials": [path.name]}
    (tmp_path / "experiment.json").write_bytes(msgspec.json.encode({**asked, "how": how, "fleet": fleet}))
    text = write_report(tmp_path).read_text("utf-8")
    assert f"experiment run &#39;/my hall.toml&#39; {end} --out" in text


def test_trials_of_older_settings_are_told(tmp_path: Path) -> None:
    paths = [write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, seed), FAILURE) for seed in range(2)]
    (tmp_path / "experiment.json").write_bytes(msgspec.json.encode({"name": "paper", "trials": [paths[0].name]}))
    text = write_report(tmp_path).read_text("utf-8")
    assert "trials of older settings: in no other figure" in text
    assert paths[1].name not in text


def test_trials_that_began_outside_the_safe_set_are_counted_apart(tmp_path: Path) -> None:
    for seed in range(2):
        trial = a_trial("move_to_goal", "empty", 4, seed)
        record = a_record(trial)
        assert record.outcome
        outcome = msgspec.structs.replace(record.outcome, safe_start=seed == 0)
        write_trial(tmp_path, trial, record=msgspec.structs.replace(record, outcome=outcome))
    (condition,) = conditions(read_records(tmp_path))
    row = [entry.text for entry in cells_grid(condition).rows[0]]
    assert row[3] == "1 (1 apart)"
    assert row[4] == "4.0"  # of the one that counts; one trial has no interval


def test_the_filter_s_table_says_fewer(folder: Path) -> None:
    (condition,) = conditions(read_records(folder))
    grid = filter_grid(condition)
    assert grid is not None
    assert len(grid.rows) == 4
    for row in grid.rows:
        assert row[5].text == "0.00"
        assert row[5].tone == "good"
        assert row[7].text.endswith("/ 0 / 0")


def test_the_box_plot_shows_every_trial(tmp_path: Path) -> None:
    write_folder(tmp_path, behaviours=("move_to_goal",), scenarios=("empty",), sizes=(4,), seeds=6)
    (condition,) = conditions(read_records(tmp_path))
    plot = collisions_plot(condition, "c")
    assert plot is not None
    links = re.findall(r'<a xlink:href="#(trial-[^"]+)"', plot.svg)
    counted = [each for each in read_records(tmp_path) if each.counts]
    assert links == [f"trial-{each.path.name}" for each in counted]
    assert len(links) == 5
    assert "<a" not in unlinked(plot.svg)
    assert ET.fromstring(unlinked(plot.svg)).tag.endswith("svg")
    assert means_plot(condition, "m") is not None


def test_trajectories_are_of_the_median_seed(tmp_path: Path) -> None:
    write_folder(tmp_path, behaviours=("move_to_goal",), scenarios=("empty",), sizes=(4, 32), seeds=3)
    (condition,) = conditions(read_records(tmp_path))
    plot = trajectories_plot(condition, "empty", "t")
    assert plot is not None
    # 4 robots; seeds 0 and 1 have 4 and 5 collisions, 2 failed: the lower median is seed 0.
    assert "4 robots, seed 0" in plot.caption


def test_labels() -> None:
    assert bare("navigate_bc map=own") == "navigate map=own"
    assert is_filtered("navigate_bc map=own")
    assert not is_filtered("navigate map=a_bc")
    assert interval(1.25, 0.5, 2.0, 1) == "1.2 [0.5, 2.0]"
    assert interval(np.nan, 0.0, 1.0, 1) == "–"
    assert [p_text(each) for each in (0.0001, 0.25)] == ["< 0.001", "0.250"]


def test_of_many_conditions_only_so_many_arenas_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for engine in ("kinematic", "pybullet"):
        write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0, engine))
    monkeypatch.setattr("fullswarm.evaluate.results.report.MOST_ARENAS", 1)
    ids = Page(write_report(tmp_path).read_text("utf-8")).of("id")
    assert [each for each in ids if each.startswith(("trajectories", "coverage"))] == ["trajectories-empty-title"]


def test_panels_that_are_compared_have_one_scale(tmp_path: Path) -> None:
    write_folder(tmp_path, behaviours=("move_to_goal",), sizes=(4,), seeds=3)
    (condition,) = conditions(read_records(tmp_path))
    plot = collisions_plot(condition, "c")
    assert plot is not None
    # Text of the vertical axes: of both panels the same, though one scenario has more collisions than the other.
    ticks = re.findall(r"<text[^>]*text-anchor: end[^>]*>([\d.]+)</text>", plot.svg)
    assert ticks
    assert ticks[: len(ticks) // 2] == ticks[len(ticks) // 2 :]


def test_each_trial_has_a_card_with_its_files_and_the_commands_that_show_it(folder: Path, text: str) -> None:
    records = read_records(folder)
    assert text.count('<section class="card"') == len(records)
    one = next(each for each in records if each.counts)
    card = card_of(one, folder)
    assert f'<section class="card" id="{card.anchor}">' in text
    commands = [command for command, _ in card.commands]
    assert f"fullswarm experiment replay {folder.name} --trial {one.path.name} --to trial.mp4" in commands
    assert f"fullswarm experiment trial {folder.name}/trials/{one.path.name}" in commands
    assert not any("fullswarm replay" in each for each in commands)
    assert all((folder / href).exists() for _, href in card.files)
    assert ("Started", "2026-11-21 04:00:00 UTC") in card.facts
    assert not re.search(r"\d\.\d{5}", " ".join(value for _, value in card.facts))


def test_a_card_names_the_recording_and_pictures_that_are_there(tmp_path: Path) -> None:
    path = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    (path / "film.gif").write_bytes(b"GIF89a")
    (tmp_path / "recordings").mkdir()
    recording = tmp_path / "recordings" / f"{path.name}.mcap"
    recording.write_bytes(b"")
    card = card_of(read_records(tmp_path)[0], tmp_path)
    assert ("recording", f"recordings/{recording.name}") in card.files
    assert ("film.gif", f"trials/{path.name}/film.gif") in card.files
    assert f"fullswarm replay {tmp_path.name}/recordings/{recording.name}" in [command for command, _ in card.commands]


def test_the_filter_s_p_values_are_corrected_for_their_number(folder: Path) -> None:
    (condition,) = conditions(read_records(folder))
    grid = filter_grid(condition)
    assert grid is not None
    assert grid.headers[-2:] == ["p (signed-rank)", "p (Holm)"]
    for row in grid.rows:
        assert float(row[-1].text) >= float(row[-2].text)
