"""Player configurations: the world they load, the robots they drive, and what is wrong in them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios import distance_to_box
from fullswarm.evaluate.scenarios.importers import guess_format, read_world

FILES = Path(__file__).parent / "scenario_files"
WORLD = """
define pioneer position ( size [ 0.5 0.4 0.3 ] )
floorplan ( size [ 10 10 1 ] )
pioneer ( name "r0" pose [ 1 2 0 90 ] )
pioneer ( name "r1" pose [ -1 -2 0 180 ] )
"""
SIMULATION = 'driver ( name "stage" provides ["simulation:0"] plugin "libstageplugin" worldfile "a.world" )\n'


def config(tmp_path: Path, text: str, world: str = WORLD) -> Path:
    (tmp_path / "a.world").write_text(world)
    path = tmp_path / "a.cfg"
    path.write_text(text)
    return path


def robot(model: str, address: str = "position2d:0") -> str:
    return f'driver ( name "stage" provides ["{address}"] model "{model}" )\n'


def test_the_world_and_the_robots_that_a_driver_has() -> None:
    found = read_world(FILES / "hall.cfg")
    whole = read_world(FILES / "hall.world")
    assert guess_format(FILES / "hall.cfg") == "player"
    assert found.scenario.bounds_m == whole.scenario.bounds_m
    (start,) = found.starts
    assert (start.x, start.y, start.yaw) == pytest.approx((-4.0, -3.0, -math.pi / 2.0))
    # The other one has no driver: it stands there, 0.33 m wide.
    assert any(distance_to_box(-4.0, -4.0, box) == 0.0 for box in found.scenario.boxes)
    assert len(found.scenario.boxes) == len(whole.scenario.boxes) + 1


def test_all_that_is_left_out_is_named() -> None:
    notes = "\n".join(read_world(FILES / "hall.cfg").notes)
    for words in (
        "robot r1 (6665:position2d:0) starts at -4.00, -3.00 m, heading -1.57 rad",
        "6665:laser:0, 6665:sonar:0 of r1",
        "driver vfh",
        "graphics2d:0 of p1",
        "roomba r0",
        'include "not_there.inc"',
    ):
        assert words in notes
    assert "hall.cfg:12" in notes


def test_robots_stand_in_the_order_of_the_configuration(tmp_path: Path) -> None:
    path = config(tmp_path, SIMULATION + robot("r1", "6666:position2d:0") + robot("r0", "odometry::6665:position2d:0"))
    assert [(round(each.x, 9), round(each.yaw, 6)) for each in read_world(path).starts] == [
        (-1.0, round(math.pi, 6)),
        (1.0, round(math.pi / 2.0, 6)),
    ]


def test_the_syntax_of_player_1(tmp_path: Path) -> None:
    old = SIMULATION.replace('"stage"', '"stg_simulation"').replace("provides", "devices")
    path = config(tmp_path, f'{old}driver ( name "stg_position" devices ["position:0"] model "r0" )')
    assert len(read_world(path).starts) == 1


def test_included_and_defined_parts_of_a_configuration(tmp_path: Path) -> None:
    (tmp_path / "robots.inc").write_text(robot("r0"))
    path = config(tmp_path, f'include "robots.inc"\n{SIMULATION}')
    assert len(read_world(path).starts) == 1


@pytest.mark.parametrize(
    ("text", "what", "line"),
    [
        (robot("r0"), "no driver provides simulation:0", ""),
        (SIMULATION + SIMULATION, "second driver", ":2"),
        (SIMULATION.replace("libstageplugin", "libgazeboplugin").replace('name "stage"', 'name "gz"'), "gazebo", ":1"),
        (SIMULATION.replace('worldfile "a.world"', ""), "names no worldfile", ":1"),
        (SIMULATION.replace("a.world", "b.world"), "no such file", ":1"),
        (SIMULATION + robot("r9"), "'r9' is not in a.world", ":2"),
        (SIMULATION + robot("r0") + robot("r0"), "has a driver already", ":3"),
        (SIMULATION + 'driver ( name "stage" provides ["position2d:0"] )', "names no model", ":2"),
        (SIMULATION + "driver ( name", "", ":2"),
        ('driver ( provides ["simulation:0" )', "", ":1"),
        ("", "no driver", ""),
    ],
)
def test_mistakes_are_named_with_their_line(tmp_path: Path, text: str, what: str, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_world(config(tmp_path, text))
    assert what in str(caught.value)
    assert f"a.cfg{line}" in str(caught.value)


def test_a_similar_name_is_offered_and_a_missing_include_of_the_world_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'r0'"):
        read_world(config(tmp_path, SIMULATION + robot("r00")))
    with pytest.raises(ConfigError, match=r"lost\.inc"):
        read_world(config(tmp_path, SIMULATION + robot("r9"), WORLD + 'include "lost.inc"\n'))


def test_a_configuration_that_includes_itself_ends(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="include one another"):
        read_world(config(tmp_path, 'include "a.cfg"\n'))
