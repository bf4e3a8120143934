"""`fullswarm scenario`: stdout is data, stderr notes, exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from fullswarm.cli.scenario import scenario_app
from fullswarm.evaluate.scenarios import boxes_for, load_scenario, scenario_names
from fullswarm.evaluate.scenarios.maps import BOX, GOAL, ROBOT, START, text_map
from tests.unit.ros_map import read_map

pytest.importorskip("defusedxml")
pytest.importorskip("yaml")

FILES = Path(__file__).parent / "scenario_files"


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(scenario_app, [str(word) for word in words], env={"COLUMNS": "80"})


def test_list_names_every_scenario() -> None:
    assert [each["name"] for each in json.loads(run("list", "--json").stdout)] == list(scenario_names())
    plain = run("list")
    assert plain.exit_code == 0
    assert all(name in plain.stdout for name in scenario_names())


def test_show_gives_all_numbers() -> None:
    shown = json.loads(run("show", "uniform", "--seed", "3", "--robots", "5", "--json").stdout)
    assert shown["scenario"]["name"] == "uniform"
    assert len(shown["placed"]["starts"]) == len(shown["placed"]["goals"]) == 5
    boxes = boxes_for(load_scenario("uniform"), 3)
    assert [tuple(box) for box in shown["placed"]["boxes"]] == list(boxes)


def test_show_draws_a_map() -> None:
    shown = run("show", "concave", "--robots", "3")
    assert shown.exit_code == 0
    picture = shown.stdout.split("seed 0\n")[1].rpartition("\n# ")[0]
    assert picture.count(ROBOT) == 3
    assert max(map(len, picture.splitlines())) <= 80


def test_the_map_has_everything_where_it_is() -> None:
    scenario = load_scenario("empty").model_copy(
        update={"boxes": ((15.0, 5.0, 4.0, 4.0, 0.0),), "bounds_m": (0.0, 0.0, 20.0, 20.0)}
    )
    lines = text_map(scenario, scenario.boxes, [(2.0, 19.0), (2.0, 1.0)]).splitlines()[1:-1]
    inside = [line[1:-1] for line in lines]
    assert (len(inside), {len(line) for line in inside}) == (32, {64})
    assert inside[1][6] == ROBOT
    assert inside[30][6] == ROBOT
    assert inside[24][48] == BOX
    assert inside[8][48] != BOX
    assert any(GOAL in line for line in inside)
    assert any(START in line for line in inside)


@pytest.mark.parametrize("name", ["hall.sdf", "hall.argos", "hall.world", "hall.xml", "hall.yaml"])
def test_import_writes_a_scenario_that_can_be_shown(tmp_path: Path, name: str) -> None:
    out = tmp_path / "mine.toml"
    result = run("import", FILES / name, "--out", out)
    assert result.exit_code == 0
    assert result.stdout == ""
    assert "note: " in result.stderr
    assert run("show", out).exit_code == 0


def test_import_without_out_prints_toml_or_json(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(run("import", FILES / "hall.argos").stdout, "utf-8")
    told = json.loads(run("import", FILES / "hall.argos", "--json").stdout)
    assert load_scenario(path).model_dump(mode="json", exclude_none=True) == told["scenario"]
    assert told["starts"] == [[4.0, 2.0, pytest.approx(1.5707963)]]
    assert told["notes"]


def test_export_and_import_again(tmp_path: Path) -> None:
    out = tmp_path / "uniform.sdf"
    assert run("export", "uniform", "--robots", "3", "--seed", "2", "--out", out).exit_code == 0
    told = json.loads(run("import", out, "--json").stdout)
    assert [tuple(box) for box in told["scenario"]["boxes"]] == [
        pytest.approx(box) for box in boxes_for(load_scenario("uniform"), 2)
    ]
    assert len(told["starts"]) == 3


def test_export_as_a_map(tmp_path: Path) -> None:
    assert run("export", "concave", "--format", "pgm", "--cell", "0.5", "--out", tmp_path / "map.pgm").exit_code == 0
    grid = read_map(tmp_path / "map.yaml")
    assert (grid.frame.rows, grid.frame.columns) == (42, 42)


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("show", "nowhere"), "there is no scenario"),
        (("show", "concav"), "did you mean 'concave'"),
        (("show", "antipodal_table", "--robots", "500"), "do not fit"),
        (("import", "nowhere.sdf"), "nowhere.sdf"),
        (("export", "empty", "--format", "dxf", "--out", "x"), "no format 'dxf'"),
        (("export", "empty", "--out", "/nowhere/x.sdf"), "cannot write"),
    ],
)
def test_errors_are_one_line_and_exit_with_2(words: tuple[str, ...], what: str) -> None:
    result = run(*words)
    assert result.exit_code == 2
    assert what in result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""
