"""Scenarios as TOML, SDF and maps: what is written reads back as it was."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fullswarm.drivers.create_oi.protocol import GENERATIONS
from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios import (
    Box,
    Goal,
    RandomBoxes,
    Scenario,
    Spawn,
    boxes_for,
    distance_to_box,
    load_scenario,
    parse_scenario,
    scenario_names,
    spawn,
)
from fullswarm.evaluate.scenarios.export_sdf import scenario_to_sdf
from fullswarm.evaluate.scenarios.importers import read_world
from fullswarm.evaluate.scenarios.maps import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    Map,
    coverage_map,
    scenario_map,
    write_map,
)
from fullswarm.evaluate.scenarios.model import scenario_to_toml
from fullswarm.perf.coverage import GridFrame
from tests.unit.ros_map import read_map

pytest.importorskip("defusedxml")
pytest.importorskip("yaml")

SIZE = st.floats(0.05, 3.0)
BOXES = st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9), SIZE, SIZE, st.floats(-math.pi, math.pi)), max_size=6)
TEXT = st.text(st.characters(codec="utf-8"), max_size=30)
IN_A_FOLDER = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    low, high = sorted(draw(st.tuples(st.floats(-8, -1), st.floats(1, 8))))
    random_boxes = RandomBoxes(count=draw(st.integers(1, 5)), region_m=(low, low, high, high))
    return Scenario(
        name=draw(TEXT.filter(bool)),
        description=draw(TEXT),
        bounds_m=(-10.5, -10.0, 10.0, draw(st.floats(10, 20))),
        walls=draw(st.booleans()),
        boxes=tuple(draw(BOXES)),
        random_boxes=draw(st.sampled_from([None, random_boxes])),
        spawn=Spawn(
            region_m=(-10.0, low, -9.0, high),
            shape=draw(st.sampled_from(["rectangle", "ellipse"])),
            heading_rad=draw(st.none() | st.floats(-3, 3)),
        ),
        goal=Goal(centre_m=(low, high), radius_m=draw(st.floats(0.1, 5)), antipodal=draw(st.booleans())),
        time_limit_s=draw(st.floats(1e-3, 1e6)),
    )


def same_boxes(first: tuple[Box, ...], second: tuple[Box, ...]) -> bool:
    return len(first) == len(second) and all(
        one[:4] == pytest.approx(other[:4], abs=1e-9) and abs(math.remainder(one[4] - other[4], 2 * math.pi)) < 1e-9
        for one, other in zip(first, second, strict=True)
    )


# ---------------------------------------------------------------- TOML
@given(scenarios(), st.lists(TEXT, max_size=3))
@settings(max_examples=80, deadline=None)
def test_toml_reads_back_equal(scenario: Scenario, notes: list[str]) -> None:
    assert parse_scenario(scenario_to_toml(scenario, notes), "mine.toml") == scenario


@pytest.mark.parametrize("name", scenario_names())
def test_the_packages_scenarios_survive_toml(name: str) -> None:
    scenario = load_scenario(name)
    assert parse_scenario(scenario_to_toml(scenario), "mine.toml") == scenario


def test_notes_are_comments_of_one_line_each() -> None:
    text = scenario_to_toml(load_scenario("empty"), ["one\ntwo = 3"])
    assert text.startswith("# one two = 3\n")


# ---------------------------------------------------------------- SDF
@given(boxes=BOXES, walls=st.booleans(), driven=st.booleans(), goal=st.floats(-9, 9))
@IN_A_FOLDER
def test_an_exported_world_reads_back(tmp_path: Path, boxes: list[Box], walls: bool, driven: bool, goal: float) -> None:
    scenario = Scenario(
        name="mine",
        bounds_m=(-12.0, -11.0, 13.0, 14.5),
        walls=walls,
        boxes=tuple(boxes),
        spawn=Spawn(region_m=(11.1, -10.0, 12.5, 10.0)),
        goal=Goal(centre_m=(goal, -goal), radius_m=0.7),
    )
    path = tmp_path / "mine.sdf"
    path.write_text(scenario_to_sdf(scenario, 3, 5, driven=driven), "utf-8")
    imported = read_world(path)
    assert same_boxes(imported.scenario.boxes, scenario.boxes)
    assert imported.scenario.walls == walls
    assert imported.scenario.bounds_m == pytest.approx(scenario.bounds_m) or not walls
    assert imported.scenario.goal == scenario.goal
    starts = np.array([(each.x, each.y, each.yaw) for each in imported.starts])
    np.testing.assert_allclose(starts, spawn(scenario, 5, 3, 0.17), atol=1e-9)


@pytest.mark.parametrize("seed", [0, 7])
def test_an_exported_seeds_random_boxes_become_fixed_ones(tmp_path: Path, seed: int) -> None:
    scenario = load_scenario("uniform")
    path = tmp_path / "uniform.sdf"
    path.write_text(scenario_to_sdf(scenario, seed, 8), "utf-8")
    imported = read_world(path)
    assert same_boxes(imported.scenario.boxes, boxes_for(scenario, seed))
    assert imported.scenario.bounds_m == scenario.bounds_m
    assert len(imported.starts) == 8


@pytest.mark.parametrize("model", ["create1", "create2", "roomba500"])
def test_the_exported_robot_has_the_drivers_dimensions(model: str) -> None:
    record = GENERATIONS[model]
    root = ET.fromstring(scenario_to_sdf(load_scenario("empty"), 0, 1, model=model, driven=True))
    robot = root.find("world/model[@name='robot_1']")
    assert robot is not None
    assert float(robot.findtext("link/collision/geometry/cylinder/radius") or 0) == record.radius_m
    wheels = [float((each.findtext("pose") or "").split()[1]) for each in robot.findall("link")[1:]]
    assert wheels == [record.wheel_base_m / 2, -record.wheel_base_m / 2]
    assert float(robot.findtext("plugin/wheel_separation") or 0) == record.wheel_base_m
    assert float(robot.findtext("plugin/max_linear_velocity") or 0) == 0.5
    assert sum(float(mass.text or 0) for mass in robot.iter("mass")) == pytest.approx(3.6)


def test_an_unknown_robot_is_named() -> None:
    with pytest.raises(ConfigError, match="did you mean 'create2'"):
        scenario_to_sdf(load_scenario("empty"), 0, 1, model="create_2")


def test_an_exported_world_has_what_gazebo_needs() -> None:
    root = ET.fromstring(scenario_to_sdf(load_scenario("concave"), 0, 2, driven=True))
    assert root.attrib == {"version": "1.9"}
    assert root.find("world/light[@type='directional']") is not None
    assert root.find("world/model[@name='ground_plane']/link/collision/geometry/plane/normal") is not None
    robot = root.find("world/model[@name='robot_2']")
    assert robot is not None
    links = {link.attrib["name"] for link in robot.iter("link")}
    for joint in robot.iter("joint"):
        assert {joint.findtext("parent"), joint.findtext("child")} <= links
    assert {each.text for tag in ("left_joint", "right_joint") for each in robot.iter(tag)} == {
        joint.attrib["name"] for joint in robot.iter("joint")
    }
    assert all(float(mass.text or "0") > 0 for mass in robot.iter("mass"))
    assert len({model.attrib["name"] for model in root.iter("model")}) == len(list(root.iter("model")))


# ---------------------------------------------------------------- maps
@given(rows=st.integers(1, 12), columns=st.integers(1, 12), seed=st.integers(0, 999), cell=st.floats(0.01, 2))
@IN_A_FOLDER
def test_a_map_reads_back(tmp_path: Path, rows: int, columns: int, seed: int, cell: float) -> None:
    rng = np.random.default_rng(seed)
    frame = GridFrame(rng.uniform(-5, 5), rng.uniform(-5, 5), cell, rows, columns)
    covered = rng.random((rows, columns)) < 0.5
    grid = coverage_map(frame, covered, rng.random((rows, columns)) < 0.2)
    _, sidecar = write_map(grid, tmp_path / "seen")
    back = read_map(sidecar)
    assert back.frame == frame
    assert np.array_equal(back.pixels, grid.pixels)


def test_the_pictures_first_row_is_the_top(tmp_path: Path) -> None:
    frame = GridFrame(0.0, 0.0, 1.0, 2, 3)
    picture, _ = write_map(coverage_map(frame, np.array([[1, 0, 0], [0, 0, 0]])), tmp_path / "seen.pgm")
    assert picture.read_bytes() == b"P5\n3 2\n255\n" + bytes([UNKNOWN] * 3 + [FREE] + [UNKNOWN] * 2)


def test_pixels_mean_the_same_to_map_server(tmp_path: Path) -> None:
    import yaml

    grid = coverage_map(GridFrame(0.0, 0.0, 0.1, 1, 1), np.ones((1, 1)))
    told = yaml.safe_load(write_map(grid, tmp_path / "7 o'clock")[1].read_text())
    assert told["image"] == "7 o'clock.pgm"
    share = {pixel: (255 - pixel) / 255 for pixel in (OCCUPIED, UNKNOWN, FREE)}
    assert share[OCCUPIED] > told["occupied_thresh"]
    assert share[FREE] < told["free_thresh"] < share[UNKNOWN] < told["occupied_thresh"]


@given(boxes=BOXES)
@settings(max_examples=30, deadline=None)
def test_a_scenarios_map_holds_every_box_and_no_more_than_a_cell(boxes: list[Box]) -> None:
    cell = 0.5
    scenario = load_scenario("empty").model_copy(update={"boxes": tuple(boxes), "bounds_m": (-12.0, -12.0, 12.0, 12.0)})
    grid = scenario_map(scenario, 0, cell)
    assert (grid.frame.rows, grid.frame.columns) == (50, 50)
    assert grid.frame.origin_x_m == -12.5
    assert (grid.pixels[0] == OCCUPIED).all()
    assert (grid.pixels[:, -1] == OCCUPIED).all()
    inner = grid.pixels[1:-1, 1:-1]
    for row, y in enumerate(np.arange(-11.75, 12.0, cell)):
        for column, x in enumerate(np.arange(-11.75, 12.0, cell)):
            away = min((distance_to_box(x, y, box) for box in boxes), default=math.inf)
            if away == 0.0:
                assert inner[row, column] == OCCUPIED
            if away > cell / math.sqrt(2):
                assert inner[row, column] == FREE


def test_a_box_on_cell_edges_fills_its_cells_only() -> None:
    scenario = load_scenario("empty").model_copy(update={"boxes": ((5.0, 5.0, 2.0, 1.0, 0.0),), "walls": False})
    occupied = scenario_map(scenario, 0, 0.5).pixels == OCCUPIED
    assert occupied.sum() == 8
    assert occupied[9:11, 8:12].all()


def test_wrong_grids_and_files_are_told(tmp_path: Path) -> None:
    frame = GridFrame(0.0, 0.0, 1.0, 2, 3)
    with pytest.raises(ConfigError, match="shape"):
        coverage_map(frame, np.zeros((3, 2)))
    with pytest.raises(ConfigError, match="cannot write"):
        write_map(Map(frame, np.zeros((2, 3), np.uint8)), tmp_path / "nowhere" / "map")
