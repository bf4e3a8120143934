"""Calibration from rendered pictures: it finds the camera that rendered them, and refuses what is not good enough."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fullswarm.errors import ConfigError
from fullswarm.localization.camera.board import COLUMNS, ROWS, SQUARE_M, board_picture
from fullswarm.localization.camera.calibrate import LensCalibration, floor_from_board, floor_from_tags
from fullswarm.localization.camera.camera_file import read_camera, write_camera
from fullswarm.localization.camera.plan import FloorTag, TagPlan, plan_of
from fullswarm.simulation.pictures import Plate, lying
from tests.unit import camera_lab as lab

pytest.importorskip("cv2")


def test_the_lens_that_rendered_the_board_is_found() -> None:
    truth, found = lab.PICTURE.lens(), lab.lens_file().lens
    assert found.matrix[0][0] == pytest.approx(truth.focal_px, rel=0.003)
    assert (found.matrix[0][2], found.matrix[1][2]) == pytest.approx(truth.middle_px, abs=4.0)
    assert found.distortion[0] == pytest.approx(truth.radial[0], abs=0.02)
    assert found.rms_px < 0.4


def test_the_place_of_the_camera_is_found_and_survives_its_file(tmp_path: Path) -> None:
    mount, path = lab.pictures().maker.mount, tmp_path / "camera.toml"
    write_camera(lab.calibrated(), path)
    file = read_camera(path)
    assert file == lab.calibrated()
    assert file.floor is not None
    assert file.floor.position_m == pytest.approx((mount.x_m, mount.y_m, mount.z_m), abs=0.03)
    assert np.array(file.floor.rotation) == pytest.approx(mount.axes, abs=0.01)


def test_too_few_or_too_equal_views_are_refused() -> None:
    few = LensCalibration()
    for grey in lab.board_pictures()[:6]:
        few.add(grey, "test")
    with pytest.raises(ConfigError, match="6 different views of 6 pictures; 12 are needed"):
        few.lens("test")
    same = LensCalibration()
    added = [same.add(lab.board_pictures()[0], "test") for _ in range(5)]
    assert added == [True, False, False, False, False]


def test_a_board_in_the_middle_only_is_refused() -> None:
    middle = LensCalibration()
    middle._points, middle._pixels = [None] * 12, [np.full((12, 2), 500.0) + k for k in range(12)]
    middle.size_px, middle.looked = lab.SIZE, 12
    with pytest.raises(ConfigError, match="has been in 4% of the picture"):
        middle.lens("test")


def wrong_plan(**changes: tuple[float, float, float]) -> TagPlan:
    plan = plan_of(lab.fleet())
    floor = dict(plan.floor)
    for name, (x_m, y_m, heading_rad) in changes.items():
        tag = int(name[1:])
        floor[tag] = FloorTag(tag, x_m, y_m, heading_rad, floor[tag].size_m)
    return TagPlan(plan.robots, floor)


def test_a_floor_tag_at_another_place_than_stated_is_named() -> None:
    with pytest.raises(ConfigError, match=r"floor tag 505 seems to lie 20 cm from"):
        floor_from_tags(lab.lens_file(), [lab.pictures().picture({}, {})], wrong_plan(t505=(2.2, 2.15, 0.0)), "test")


def test_a_floor_tag_that_is_turned_is_named() -> None:
    turned = wrong_plan(t502=(2.0, 0.1, math.pi / 2.0))
    with pytest.raises(ConfigError, match=r"do not fit together|floor tag 502 is turned"):
        floor_from_tags(lab.lens_file(), [lab.pictures().picture({}, {})], turned, "test")


def test_three_floor_tags_are_too_few() -> None:
    plan = plan_of(lab.fleet())
    few = TagPlan(plan.robots, {tag: plan.floor[tag] for tag in (501, 502, 503)})
    with pytest.raises(ConfigError, match="has 3 floor tags; 4 are needed"):
        floor_from_tags(lab.lens_file(), [lab.pictures().picture({}, {})], few, "test")


def test_the_board_on_the_floor_shows_where_the_camera_hangs() -> None:
    maker = lab.pictures().maker
    x_m, y_m, turn = 1.4, 0.8, 0.4
    width, height = COLUMNS * SQUARE_M * 4, ROWS * SQUARE_M * 4  # four times as large as on A4: seen from afar
    cos, sin = math.cos(turn), math.sin(turn)
    centre = x_m + cos * width / 2 - sin * height / 2, y_m + sin * width / 2 + cos * height / 2
    # A plate's upper edge points along its heading: a quarter of a turn from the lower edge.
    board = lying(Plate(board_picture(40), (width, height)), *centre, turn + math.pi / 2.0)
    part = floor_from_board(
        lab.lens_file(), [maker.picture([board])], (x_m, y_m, turn), plan_of(lab.fleet()), "test", 4 * SQUARE_M
    )
    mount = maker.mount
    assert part.position_m == pytest.approx((mount.x_m, mount.y_m, mount.z_m), abs=0.06)
    assert {each.tag for each in part.tag} == {501, 502, 503, 504, 505, 506}
    for each in part.tag:
        stated = plan_of(lab.fleet()).floor[each.tag]
        assert (each.x_m, each.y_m) == pytest.approx((stated.x_m, stated.y_m), abs=0.04)


def test_pictures_without_a_board_are_refused() -> None:
    with pytest.raises(ConfigError, match="the board is not seen"):
        floor_from_board(lab.lens_file(), [lab.noise_only(0)], (0, 0, 0), plan_of(lab.fleet()), "test")


def test_pictures_of_another_shape_are_refused() -> None:
    with pytest.raises(ConfigError, match="the pictures are 640 x 480"):
        lab.calibrated().optics((640, 480), "camera.toml")
