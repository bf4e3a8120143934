"""Worlds of other simulators: what comes out of the example of each format."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios import Box, boxes_for, distance_to_box, load_scenario, spawn
from fullswarm.evaluate.scenarios.importers import FORMATS, Imported, guess_format, read_world
from fullswarm.evaluate.scenarios.model import scenario_to_toml

pytest.importorskip("defusedxml")
pytest.importorskip("yaml")

FILES = Path(__file__).parent / "scenario_files"
EXAMPLES = {
    "hall.sdf": "sdf",
    "hall.argos": "argos",
    "hall.world": "stage",
    "hall.cfg": "player",
    "hall.xml": "menge",
    "hallS.xml": "menge",
    "hall.yaml": "irsim",
}


def load(name: str) -> Imported:
    return read_world(FILES / name)


def has(imported: Imported, box: Box) -> bool:
    """Whether a rectangle is among the boxes; turned by π it is the same."""

    def same(other: Box) -> bool:
        turn = math.remainder(other[4] - box[4], math.pi)
        return other[:4] == pytest.approx(box[:4], abs=1e-9) and abs(turn) < 1e-9

    return any(map(same, imported.scenario.boxes))


def solid(imported: Imported, x: float, y: float) -> bool:
    return any(distance_to_box(x, y, box) == 0.0 for box in imported.scenario.boxes)


def noted(imported: Imported, *words: str) -> bool:
    return any(all(word in note for word in words) for note in imported.notes)


# ---------------------------------------------------------------- all of them
@pytest.mark.parametrize(("name", "form"), EXAMPLES.items())
def test_the_format_is_guessed(name: str, form: str) -> None:
    assert guess_format(FILES / name) == form
    assert form in FORMATS


@pytest.mark.parametrize("name", EXAMPLES)
def test_what_is_imported_can_be_used_and_written(name: str, tmp_path: Path) -> None:
    imported = load(name)
    scenario = imported.scenario
    poses = spawn(scenario, 4, 1, 0.17)
    assert np.array_equal(poses, spawn(scenario, 4, 1, 0.17))
    boxes = boxes_for(scenario, 1)
    assert boxes != boxes_for(scenario, 2) or scenario.random_boxes is None
    assert all(distance_to_box(x, y, box) > 0.17 for x, y, _ in poses for box in boxes)
    file = tmp_path / "mine.toml"
    file.write_text(scenario_to_toml(scenario, imported.notes), "utf-8")
    assert load_scenario(file) == scenario


def test_a_gazebo_classic_world_is_not_taken_for_stage(tmp_path: Path) -> None:
    path = tmp_path / "classic.world"
    path.write_text((FILES / "hall.sdf").read_text())
    assert guess_format(path) == "sdf"


@pytest.mark.parametrize("text", ["", "hello", "<html></html>"])
def test_an_unknown_file_is_told_with_the_choice(tmp_path: Path, text: str) -> None:
    path = tmp_path / "file.txt"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"known format.*argos"):
        read_world(path)


def test_an_unknown_format_and_a_missing_file_are_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'sdf'"):
        read_world(FILES / "hall.sdf", "sdff")
    with pytest.raises(ConfigError, match=r"nowhere\.sdf"):
        read_world(tmp_path / "nowhere.sdf")


# ---------------------------------------------------------------- Gazebo
def test_sdf_poses_are_composed() -> None:
    imported = load("hall.sdf")
    # Model at (1, 2) turned by 90°, link 0.5 ahead, collision 0.25 to the left and turned by 0.1.
    assert has(imported, (0.75, 2.5, 2.0, 0.4, math.pi / 2 + 0.1))
    # Relative to a frame at (4, 4) turned by 90 degrees.
    assert has(imported, (4.0, 4.5, 0.6, 0.2, math.pi / 2))
    # A cylinder on its side, from y = 2.4 to 3.6.
    assert solid(imported, -3.0, 2.41)
    assert not solid(imported, -3.0, 2.39)
    assert not solid(imported, -2.85, 3.0)


def test_sdf_discs_and_polylines_are_solid() -> None:
    imported = load("hall.sdf")
    assert solid(imported, -1.71, 0.0)
    assert not solid(imported, -1.67, 0.0)
    assert solid(imported, 3.49, -2.51)
    assert not solid(imported, 3.6, -2.4)


def test_sdf_says_what_it_left_out() -> None:
    imported = load("hall.sdf")
    assert noted(imported, "bookshelf", "not read")
    assert noted(imported, "statue", "mesh")
    assert noted(imported, "lamp", "above the floor")
    assert noted(imported, "crate", "can be moved")
    assert noted(imported, "log", "tilted")
    assert not noted(imported, "sun")
    assert not solid(imported, 0.0, 0.0)


def test_sdf_robots_are_starts() -> None:
    starts = load("hall.sdf").starts
    assert sorted((s.x, s.y, s.yaw) for s in starts) == [(-4.0, -4.0, -0.5), (-4.0, -3.0, 0.5)]


def test_robots_drive_on_the_plane_wherever_it_is(tmp_path: Path) -> None:
    path = tmp_path / "high.sdf"
    text = (FILES / "hall.sdf").read_text()
    path.write_text(text.replace('<model name="ground">', '<model name="ground"><pose>0 0 2 0 0 0</pose>'))
    imported = read_world(path)
    assert solid(imported, 0.0, 0.0)  # the lamp, 0.4 m above this floor
    assert noted(imported, "shelf", "floor")


def test_a_quaternion_is_read_and_a_flat_plate_is_floor(tmp_path: Path) -> None:
    def model(name: str, pose: str, size: str) -> str:
        return (
            f'<model name="{name}"><static>true</static>{pose}<link name="l"><collision name="c"><geometry><box>'
            f"<size>{size}</size></box></geometry></collision></link></model>"
        )

    half = math.sqrt(0.5)
    turned = f'<pose rotation_format="quat_xyzw">1 2 0.1   0 0 {half} {half}</pose>'
    path = tmp_path / "q.sdf"
    path.write_text(
        '<sdf version="1.9"><world name="q">'
        + model("block", turned, "3 1 0.2")
        + model("carpet", "<pose>0 0 0.005 0 0 0</pose>", "2 2 0.01")
        + model("outer", "", "1 1 1").replace(
            "</model>", model("inner", "<pose>4 0 0 0 0 0</pose>", "1 1 1") + "</model>"
        )
        + "</world></sdf>"
    )
    imported = read_world(path)
    assert has(imported, (1.0, 2.0, 3.0, 1.0, math.pi / 2))
    assert has(imported, (4.0, 0.0, 1.0, 1.0, 0.0))
    assert len(imported.scenario.boxes) == 3
    assert noted(imported, "carpet", "floor")


# ---------------------------------------------------------------- ARGoS
def test_argos_arena_boxes_and_robots() -> None:
    imported = load("hall.argos")
    scenario = imported.scenario
    assert scenario.bounds_m == (-3.0, -3.0, 5.0, 3.0)
    assert scenario.time_limit_s == 120.0
    assert has(imported, (2.0, 1.0, 2.0, 0.5, math.radians(30)))
    assert solid(imported, -1.19, -1.0)
    assert not solid(imported, -1.23, -1.0)
    assert scenario.random_boxes is not None
    assert (scenario.random_boxes.count, scenario.random_boxes.region_m) == (4, (0.0, -2.0, 3.0, 0.0))
    (start,) = imported.starts
    assert (start.x, start.y, start.yaw) == pytest.approx((4.0, 2.0, math.pi / 2))
    assert scenario.spawn.region_m == (-2.5, -2.5, 4.5, 2.5)


def test_argos_grids_stand_around_their_centre() -> None:
    imported = load("hall.argos")
    for x in (2.5, 3.0, 3.5):
        for y in (1.5, 2.5):
            assert has(imported, (x, y, 0.1, 0.1, math.pi / 4))
    assert noted(imported, "cylinder", "one kind of random boxes")


# ---------------------------------------------------------------- Stage
def test_stage_defines_are_inherited() -> None:
    imported = load("hall.world")
    assert imported.scenario.bounds_m == (-6.0, -6.0, 10.0, 6.0)
    assert imported.scenario.walls
    assert has(imported, (1.0, 2.0, 1.2, 0.8, math.pi / 2))
    assert has(imported, (-1.0, 2.0, 0.5, 0.5, 0.0))


def test_stage_blocks_are_stretched_to_the_size() -> None:
    imported = load("hall.world")
    assert solid(imported, 4.9, -2.45)
    assert solid(imported, 4.9, -1.6)
    assert not solid(imported, 3.5, -1.7)
    assert solid(imported, 3.1, -2.47)


def test_stage_robots_come_from_an_included_file() -> None:
    imported = load("hall.world")
    assert [(s.x, s.y, round(math.degrees(s.yaw))) for s in imported.starts] == [(-4.0, -4.0, 45), (-4.0, -3.0, -90)]
    assert noted(imported, "not_there.inc")
    assert noted(imported, "unknown_thing", "hall.world:58")
    assert noted(imported, "shelf above")
    assert noted(imported, "mat", "obstacle_return")


def test_stage_bitmaps_are_traced_with_the_top_row_up(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    picture = image.new("L", (6, 4), 255)
    for x in range(6):
        picture.putpixel((x, 3), 0)  # the lowest row
    picture.putpixel((0, 0), 0)  # the upper left corner
    picture.putpixel((5, 0), 128)  # not dark enough
    picture.save(tmp_path / "plan.png")
    world = tmp_path / "plan.world"
    world.write_text('model( bitmap "plan.png" size [6 4 1] pose [10 20 0 0] boundary 1 )\n')
    imported = read_world(world)
    assert imported.scenario.bounds_m == (7.0, 18.0, 13.0, 22.0)
    assert has(imported, (10.0, 18.5, 6.0, 1.0, 0.0))
    assert has(imported, (7.5, 21.5, 1.0, 1.0, 0.0))
    assert len(imported.scenario.boxes) == 2
    assert imported.scenario.walls
    assert noted(imported, "plan.png", "2 boxes")


def test_a_stage_bitmap_that_is_not_there_is_named(tmp_path: Path) -> None:
    world = tmp_path / "plan.world"
    world.write_text('model( bitmap "cave.png" size [6 4 1] boundary 1 )\n')
    assert noted(read_world(world), "cave.png", "left out")


def test_robots_of_a_missing_include_are_known_by_their_type(tmp_path: Path) -> None:
    world = tmp_path / "w.world"
    world.write_text('include "pioneer.inc"\ndefine mine pioneer2dx ( color "red" )\nmine( pose [1 2 0 180] )')
    (start,) = read_world(world).starts
    assert (start.x, start.y, start.yaw) == pytest.approx((1.0, 2.0, math.pi))


def test_stage_parts_stand_on_their_owner(tmp_path: Path) -> None:
    world = tmp_path / "w.world"
    world.write_text("model( pose [1 1 0 90] size [1 1 1] model( pose [2 0 0 45] size [0.4 0.2 1] ) )")
    imported = read_world(world)
    assert has(imported, (1.0, 1.0, 1.0, 1.0, math.pi / 2))
    assert has(imported, (1.0, 3.0, 0.4, 0.2, math.radians(135)))


def test_old_stage_blocks_and_poses(tmp_path: Path) -> None:
    world = tmp_path / "old.world"
    world.write_text(
        "define p model ( size [2 1] polygons 1 polygon[0].points 4 polygon[0].point[0] [0 0]\n"
        "polygon[0].point[1] [0 5] polygon[0].point[2] [5 5] polygon[0].point[3] [5 0] )\n"
        "p ( pose [1 2 90] )"
    )
    assert has(read_world(world), (1.0, 2.0, 2.0, 1.0, math.pi / 2))


# ---------------------------------------------------------------- Menge
def test_menge_obstacles_agents_and_goals() -> None:
    imported = load("hall.xml")
    assert has(imported, (1.0, 0.5, 2.0, 1.0, 0.0))
    # Clockwise, and around everything: the arena.
    assert imported.scenario.bounds_m == (-6.0, -4.0, 6.0, 4.0)
    assert imported.scenario.walls
    assert not solid(imported, 5.0, 3.0)
    assert solid(imported, 3.5, -2.0)
    starts = {(round(s.x, 9), round(s.y, 9)) for s in imported.starts}
    assert {(-4.5, 1.5), (-4.5, -1.5), (-3.0, 1.0), (-4.0, 0.5)} <= starts
    assert len(imported.starts) == 8
    # The goals: a disc of 0.5 m at (4.5, 2), and a point at (4.5, -3).
    assert imported.scenario.goal.centre_m == (4.5, -0.5)
    assert imported.scenario.goal.radius_m == pytest.approx(3.0)
    assert noted(imported, "nav_mesh")


def test_a_hollow_menge_polygon_that_is_no_arena_has_walls(tmp_path: Path) -> None:
    path = tmp_path / "roomS.xml"
    path.write_text((FILES / "hallS.xml").read_text().replace('p_x="-4.5" p_y="1.5"', 'p_x="-7" p_y="0"'))
    imported = read_world(path)
    assert solid(imported, 6.0, 3.0)
    assert not solid(imported, 5.0, 3.0)
    assert not imported.scenario.walls
    assert noted(imported, "hollow")


def test_a_menge_scene_alone_finds_its_behaviour() -> None:
    assert load("hallS.xml").scenario.goal == load("hall.xml").scenario.goal


# ---------------------------------------------------------------- IR-SIM
def test_irsim_world_obstacles_and_robots() -> None:
    imported = load("hall.yaml")
    scenario = imported.scenario
    assert scenario.bounds_m == (-1.0, 2.0, 11.0, 12.0)
    assert has(imported, (6.0, 9.0, 1.5, 1.2, 1.0))
    assert has(imported, (3.0, 6.0, 0.5, 0.5, 0.0))
    assert solid(imported, 5.99, 5.0)
    assert not solid(imported, 6.03, 5.0)
    # A unit square from its corner, turned by 0.5 about it.
    x, y = square_centre(3.0, 7.0, 0.5)
    assert has(imported, (x, y, 1.0, 1.0, 0.5))
    assert solid(imported, 8.5, 5.0)
    assert not solid(imported, 4.5, 2.6)
    assert [(s.x, s.y, s.yaw) for s in imported.starts] == [(1.0, 3.0, 0.0), (2.0, 3.0, 1.57)]
    assert scenario.random_boxes is not None
    assert scenario.random_boxes.size_m == (0.8, 0.8)
    assert scenario.goal.centre_m == (9.0, 8.5)


def square_centre(x: float, y: float, turn: float) -> tuple[float, float]:
    return x + 0.5 * math.cos(turn) - 0.5 * math.sin(turn), y + 0.5 * math.sin(turn) + 0.5 * math.cos(turn)


def test_what_lies_out_of_the_arena_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "far.yaml"
    path.write_text(
        "world: {width: 10, height: 10}\n"
        "obstacle:\n  - {number: 2, state: [[4, 8], [31, 38]], shape: {name: rectangle, length: 1, width: 1}}\n"
        "robot:\n  - {number: 2, state: [[1, 1, 0], [-5, 0, 0]]}\n"
    )
    imported = read_world(path)
    assert imported.scenario.boxes == ((4.0, 8.0, 1.0, 1.0, 0.0),)
    assert len(imported.starts) == 1
    assert noted(imported, "1 boxes", "out of the arena")
    assert noted(imported, "1 robots", "out")


def test_irsim_robots_on_a_circle_are_antipodal(tmp_path: Path) -> None:
    path = tmp_path / "circle.yaml"
    path.write_text("world: {width: 10, height: 10}\nrobot:\n  - number: 6\n    distribution: {name: circle}\n")
    goal = read_world(path).scenario.goal
    assert goal.antipodal
    assert goal.centre_m == pytest.approx((5.0, 5.0))
