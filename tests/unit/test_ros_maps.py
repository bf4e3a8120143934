"""Maps of map_server: read, made boxes of, named in a fleet file; compared with PyYAML's and Pillow's reading."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.config import load_swarm
from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios import load_scenario
from fullswarm.evaluate.scenarios.importers import read_world
from fullswarm.evaluate.scenarios.maps import scenario_map, write_map
from fullswarm.maps.ros_map import _pgm, read_ros_map
from fullswarm.maps.tiles import FREE, OCCUPIED, UNKNOWN
from tests.unit.ros_map import read_map


@pytest.fixture
def concave(tmp_path: Path) -> Path:
    return write_map(scenario_map(load_scenario("concave"), 0, 0.1), tmp_path / "lab")[1]


def test_a_map_is_read_as_map_server_reads_it(concave: Path) -> None:
    ours, theirs = read_ros_map(concave), read_map(concave)
    assert np.array_equal(ours.states == OCCUPIED, theirs.pixels == 0)
    assert np.array_equal(ours.states == FREE, theirs.pixels == 254)
    assert ours.bounds_m == pytest.approx((-0.1, -0.1, 20.1, 20.1))
    area = sum(wide * high for _, _, wide, high, _ in ours.boxes())
    assert area == pytest.approx((theirs.pixels == 0).sum() * 0.01)


def test_a_fleet_file_names_a_map(concave: Path) -> None:
    fleet = concave.parent / "fleet.toml"
    fleet.write_text('[world]\nmap = "lab.yaml"\nengine = "kinematic"\n[fleet]\ncount = 2\n')
    world = load_swarm(fleet).world_or_default
    assert len(world.boxes) > 5
    assert world.bounds_m == pytest.approx((-0.1, -0.1, 20.1, 20.1))
    assert not world.walls
    fleet.write_text('[world]\nmap = "none.yaml"\n')
    with pytest.raises(ConfigError, match=r"fleet.toml:2: world.map: .*none.yaml"):
        load_swarm(fleet)


def test_a_map_is_imported_as_a_scenario(concave: Path) -> None:
    found = read_world(concave).scenario
    inside = [box for box in found.boxes if 8.0 < box[0] < 14.0 and box[2] < 6.0]
    assert min(box[0] - box[2] / 2 for box in inside) == pytest.approx(8.5, abs=0.11)


def test_a_turned_origin_and_unknown_cells(tmp_path: Path) -> None:
    (tmp_path / "a.pgm").write_bytes(b"P5 # a comment\n3 2\n255\n" + bytes([205, 205, 205, 0, 254, 254]))
    text = "image: a.pgm\nresolution: 0.5\norigin: [1.0, 2.0, 1.5707963]\nnegate: 0\nfree_thresh: 0.196\n"
    (tmp_path / "a.yaml").write_text(text)
    found = read_ros_map(tmp_path / "a.yaml")
    assert found.states.tolist() == [[OCCUPIED, FREE, FREE], [UNKNOWN] * 3]
    x, y, _, _, yaw = found.boxes()[0]
    assert (x, y, yaw) == pytest.approx((1.0 - 0.25, 2.0 + 0.25, math.pi / 2), abs=1e-5)


@given(st.binary(max_size=60))
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_a_picture_or_an_error_in_a_sentence(data: bytes) -> None:
    with contextlib.suppress(ConfigError):
        assert _pgm(b"P5\n" + data, "x").ndim == 2
