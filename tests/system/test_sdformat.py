"""SDF worlds against libsdformat, with which Gazebo reads them: exports are valid, imports stand in their places."""

from __future__ import annotations

import math
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fullswarm.drivers.create_oi.protocol import GENERATIONS
from fullswarm.evaluate.scenarios import boxes_for, load_scenario, spawn
from fullswarm.evaluate.scenarios.export_sdf import scenario_to_sdf
from fullswarm.evaluate.scenarios.importers import read_world

pytest.importorskip("defusedxml")

SOURCE = Path(__file__).with_name("sdf_world.cc")
BUILD_S, RUN_S = 300.0, 60.0
VERSIONS = ("sdformat15", "sdformat14", "sdformat13", "sdformat12")
CRATE = """<sdf version="1.9"><model name="crate"><static>true</static><pose>5 5 0 0 0 0</pose>
<frame name="corner"><pose>0.5 0.25 0 0 0 0.3</pose></frame>
<link name="link"><pose>0.1 0 0.25 0 0 0.2</pose><collision name="c"><pose>0 0.05 0 0 0 0.1</pose>
<geometry><box><size>1 0.5 0.5</size></box></geometry></collision></link></model></sdf>"""
LINK = """<link name="link"><pose>0 0 0.25 0 0 0</pose><collision name="c"><geometry><box><size>0.4 0.8 0.5</size></box>
</geometry></collision></link>"""
WORLD = f"""<sdf version="1.9"><world name="room">
<frame name="door"><pose degrees="true">4 4 0 0 0 90</pose></frame>
<include><name>first</name><uri>model://crate</uri><pose relative_to="door">1 0 0 0 0 0.4</pose></include>
<include><name>second</name><uri>model://crate</uri><placement_frame>corner</placement_frame>
  <pose relative_to="first">2 1 0 0 0 0.5</pose></include>
<include><name>third</name><uri>model://crate</uri></include>
<model name="outer"><static>true</static><pose>-4 -1 0 0 0 0.7</pose>{LINK}
  <model name="inner"><static>true</static><pose relative_to="link">1 2 0 0 0 -0.2</pose>{LINK}</model>
  <frame name="mark" attached_to="inner::link"><pose>0.5 0 0 0 0 0</pose></frame>
</model>
<model name="beside"><static>true</static><pose relative_to="outer::inner::link">0 -3 -0.5 0 0 0</pose>{LINK}</model>
<model name="marked"><static>true</static><pose relative_to="outer::mark">0 2 -0.5 0 0 0</pose>{LINK}</model>
</world></sdf>"""


@dataclass(frozen=True)
class Line:
    """A model, or a collision shape, as libsdformat places it."""

    kind: str
    name: str
    x: float
    y: float
    z: float
    yaw: float
    rest: str


@pytest.fixture(scope="session")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the program that reads a world, built here."""
    tools = [shutil.which(each) for each in ("g++", "pkg-config")]
    if not all(tools):
        pytest.skip("needs g++ and pkg-config")
    for version in VERSIONS:
        flags = subprocess.run(
            [str(tools[1]), "--cflags", "--libs", version], capture_output=True, text=True, timeout=RUN_S
        )
        if flags.returncode == 0:
            break
    else:
        pytest.skip("needs libsdformat: apt install libsdformat-dev")
    program = tmp_path_factory.mktemp("sdf") / "sdf_world"
    command = [str(tools[0]), "-std=c++17", str(SOURCE), "-o", str(program), *flags.stdout.split()]
    subprocess.run(command, check=True, timeout=BUILD_S)
    return program


def lines_of(reader: Path, world: Path) -> list[Line]:
    done = subprocess.run([reader, world, world.parent], capture_output=True, text=True, timeout=RUN_S)
    assert done.returncode == 0, done.stderr
    assert not done.stderr.strip()
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    return [Line(kind, name, float(x), float(y), float(z), float(yaw), rest) for kind, name, x, y, z, yaw, rest in rows]


def near(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    """Compare x, y, sizes and yaw; turned by half a turn a box is the same."""
    return np.allclose(one[:4], other[:4], atol=1e-6) and abs(math.remainder(one[4] - other[4], math.pi)) < 1e-6


def box_of(line: Line) -> tuple[float, float, float, float, float]:
    _, size_x, size_y, _ = line.rest.split()
    return line.x, line.y, float(size_x), float(size_y), line.yaw


@pytest.mark.parametrize(("name", "model"), [("concave", "create2"), ("uniform", "create1")])
@pytest.mark.parametrize("driven", [False, True])
def test_an_exported_world_is_valid_and_stands_where_the_scenario_says(
    reader: Path, tmp_path: Path, name: str, model: str, driven: bool
) -> None:
    scenario, path = load_scenario(name), tmp_path / "world.sdf"
    path.write_text(scenario_to_sdf(scenario, 3, 4, model=model, driven=driven))
    lines = lines_of(reader, path)
    boxes = [box_of(each) for each in lines if each.kind == "collision" and each.name.startswith("box_")]
    expected = boxes_for(scenario, 3)
    assert len(boxes) == len(expected)
    assert all(near(one, other) for one, other in zip(boxes, expected, strict=True))
    assert sum(each.name.startswith("fullswarm_wall_") for each in lines if each.kind == "model") == 4
    robots = [each for each in lines if each.kind == "model" and each.name.startswith("robot_")]
    assert all(each.rest == "moves" for each in robots)
    np.testing.assert_allclose([(r.x, r.y, r.yaw) for r in robots], spawn(scenario, 4, 3, 0.17), atol=1e-6)
    bodies = [each.rest.split() for each in lines if each.kind == "collision" and each.name == "robot_1"]
    assert float(bodies[0][1]) == GENERATIONS[model].radius_m
    wheels = [each for each in lines if each.name == "robot_1" and each.rest.startswith("cylinder 0.036")]
    assert len(wheels) == 2 * driven
    if driven:
        assert math.dist((wheels[0].x, wheels[0].y), (wheels[1].x, wheels[1].y)) == pytest.approx(
            GENERATIONS[model].wheel_base_m
        )


def test_frames_nested_and_included_models_stand_where_gazebo_puts_them(reader: Path, tmp_path: Path) -> None:
    (tmp_path / "crate").mkdir()
    (tmp_path / "crate" / "model.sdf").write_text(CRATE)
    (tmp_path / "crate" / "model.config").write_text(
        "<model><name>crate</name><version>1.0</version><sdf version='1.9'>model.sdf</sdf></model>"
    )
    path = tmp_path / "room.sdf"
    path.write_text(WORLD)
    expected = [box_of(each) for each in lines_of(reader, path) if each.kind == "collision"]
    boxes = read_world(path).scenario.boxes
    assert len(boxes) == len(expected) == 7
    for each in expected:
        assert any(near(each, box) for box in boxes), each
