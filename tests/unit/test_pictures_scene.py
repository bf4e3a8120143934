"""Pictures of hand-made worlds: the right colours at the right places, and what a timeline tells."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from fullswarm.errors import ConfigError
from fullswarm.evaluate.pictures import Scene, Timeline, svg_text, write_still
from fullswarm.evaluate.pictures import scene as colours
from fullswarm.evaluate.pictures.scene import corners
from fullswarm.evaluate.pictures.timeline import onsets
from fullswarm.evaluate.trial_folder import Trajectory, save_arrays
from tests.unit.pictures_world import two_robots

BLUE, SKY = (colours.rgb(each) for each in colours.ROBOTS[:2])
RED, GOAL, BOX, FLOOR = (colours.rgb(each) for each in (colours.CONTACT, colours.GOAL, colours.BOX, colours.FLOOR))


def at(scene: Scene, x_m: float, y_m: float) -> tuple[int, ...]:
    """Return the colour of a place."""
    row, column = scene.pixel(x_m, y_m)
    return tuple(scene.frame()[row, column, :3].tolist())


@pytest.fixture
def scene() -> Scene:
    return Scene(Timeline(two_robots(touches=((30, 1),))), width_px=480)


def test_everything_is_where_it_is(scene: Scene) -> None:
    scene.update(2.0)
    assert at(scene, 2.8, 2.2) == BLUE  # beside the nose, which points east
    assert at(scene, 2.0, 2.0) == BLUE  # its trail
    assert at(scene, 7.7, 8.0) == SKY
    assert at(scene, 8.0, 6.9) == GOAL
    assert at(scene, 3.0, 7.8) == BOX  # turned upright
    assert at(scene, 3.8, 7.0) == FLOOR
    assert at(scene, 5.0, 5.0) == FLOOR
    assert at(scene, 4.0, 2.0) == FLOOR


def test_who_moved_leaves_no_trace_but_the_trail(scene: Scene) -> None:
    scene.update(0.5)
    scene.frame()
    scene.update(4.0, trail_s=1.0)
    assert at(scene, 1.6, 2.2) == FLOOR
    assert at(scene, 3.0, 2.0) == FLOOR  # older than a second
    assert at(scene, 4.3, 2.0) == BLUE
    fresh = Scene(Timeline(two_robots(touches=((30, 1),))), width_px=480)
    fresh.update(4.0, trail_s=1.0)
    assert (fresh.frame() == scene.frame()).all()


def test_heading_is_the_side_where_the_nose_sticks_out(scene: Scene) -> None:
    scene.update(2.0)
    ink = colours.rgb(colours.INK)
    assert at(scene, 3.7, 2.0) == ink
    assert at(scene, 8.0, 8.7) == ink
    assert at(scene, 8.0, 7.3) == GOAL


def test_a_contact_is_red_while_it_lasts(scene: Scene) -> None:
    scene.update(2.0)
    assert at(scene, 7.7, 8.0) == SKY
    moment = scene.update(3.05)
    assert moment.touching.tolist() == [False, True]
    assert at(scene, 7.7, 8.0) == RED
    assert np.abs(np.subtract(at(scene, 8.0 - 0.95, 8.0), RED)).max() < 40  # and has a ring, with soft edges
    scene.update(3.5)
    assert at(scene, 7.7, 8.0) == SKY
    assert scene.update(3.5, since_s=2.9).touching.tolist() == [False, True]


def test_sizes_are_even_and_as_asked() -> None:
    for width in (320, 321, 479, 720, 1001):
        scene = Scene(Timeline(two_robots()), width_px=width)
        scene.update(0.0)
        height, across, _ = scene.frame().shape
        assert (across, height) == (scene.width_px, scene.height_px)
        assert across == width - width % 2
        assert height % 2 == 0


@pytest.mark.parametrize("bounds", [(-20.0, -1.0, 20.0, 1.0), (0.0, 0.0, 2.0, 40.0), (-3.0, -3.0, 3.0, 3.0)])
def test_any_arena_can_be_drawn_to_scale(bounds: tuple[float, ...]) -> None:
    scene = Scene(Timeline(replace(two_robots(), bounds_m=np.array(bounds))), width_px=400)
    scene.update(1.0)
    scene.frame()
    assert scene.height_px < 3 * scene.width_px
    origin, east, north = (np.array(scene.pixel(*place)) for place in ((0, 0), (2, 0), (0, 2)))
    assert abs((east - origin)[1] + (north - origin)[0]) <= 1


def test_robots_that_are_lost_and_goals_that_are_none_are_not_drawn() -> None:
    trajectory = two_robots()
    trajectory.pose[20:, 0] = np.nan
    lost = replace(trajectory, goals=np.full((2, 2), np.nan), boxes=np.zeros((0, 5)))
    scene = Scene(Timeline(lost), width_px=400)
    moment = scene.update(3.0)
    assert moment.arrived == 0
    assert at(scene, 7.7, 8.0) == SKY
    assert at(scene, 2.0, 2.0) == BLUE  # its trail ends where it was seen last
    assert at(scene, 4.0, 2.0) == FLOOR


def test_a_long_caption_is_cut() -> None:
    plain, long = (Scene(Timeline(two_robots()), text, 400) for text in ("", "word " * 60))
    for each in (plain, long):
        each.update(0.0)
    differ = (plain.frame() != long.frame()).any(axis=(0, 2))
    assert differ.any()
    assert not differ[-4:].any()


# ------------------------------------------------------------------------------------------------- timeline
def test_between_samples_robots_are_between_places() -> None:
    moment = Timeline(two_robots()).at(1.234)
    assert moment.pose[0] == pytest.approx((2.234, 2.0, 0.0), abs=1e-5)
    assert moment.arrived == 1


@given(st.floats(-math.pi, math.pi), st.floats(-3.0, 3.0), st.floats(0.0, 1.0))
def test_headings_turn_the_short_way(start: float, turn: float, share: float) -> None:
    trajectory = two_robots()
    trajectory.pose[0, 0, 2], trajectory.pose[1, 0, 2] = start, start + turn
    heading = Timeline(trajectory).at(PERIOD * share).pose[0, 2]
    assert -math.pi - 1e-6 <= heading <= math.pi + 1e-6
    assert math.cos(heading - (start + share * turn)) == pytest.approx(1.0, abs=1e-6)


PERIOD = 0.1


def test_contacts_are_counted_at_their_onset() -> None:
    touches = ((5, 0), (6, 0), (8, 0), (11, 0), (11, 1))  # 0.2 s without is the same contact, 0.3 s is not
    timeline = Timeline(two_robots(touches=touches))
    assert [timeline.at(time_s).contacts for time_s in (0.45, 0.55, 1.05, 1.15)] == [0, 1, 1, 3]
    assert timeline.at(0.55).marks == pytest.approx(np.array([(1.5, 2.0)]))
    assert not onsets(np.zeros(0), np.zeros((0, 3), np.bool_)).any()


def test_a_window_lies_inside_the_trial() -> None:
    timeline = Timeline(two_robots())
    assert timeline.window(None, None) == (0.0, 4.0)
    assert timeline.window(-1.0, 99.0) == (0.0, 4.0)
    with pytest.raises(ConfigError, match="nothing was recorded from 5 s"):
        timeline.window(5.0, None)


def test_an_empty_trajectory_is_named() -> None:
    whole = two_robots()
    empty = replace(whole, time_s=whole.time_s[:0], pose=whole.pose[:0], touching=whole.touching[:0])
    with pytest.raises(ConfigError, match="empty"):
        Timeline(empty)


def test_corners_of_a_turned_box() -> None:
    found = corners(np.array([(1.0, 2.0, 4.0, 2.0, math.pi / 2)]))[0]
    assert sorted(map(tuple, found.round(9).tolist())) == [(0.0, 0.0), (0.0, 4.0), (2.0, 0.0), (2.0, 4.0)]


# --------------------------------------------------------------------------------------------------- stills
def test_a_png_shows_the_whole_way_or_a_moment(tmp_path: Path) -> None:
    whole, early, late = (tmp_path / f"{name}.png" for name in ("whole", "early", "late"))
    write_still(two_robots(), whole, width_px=400)
    write_still(two_robots(), early, width_px=400, until_s=1.0)
    write_still(two_robots(), late, width_px=400, from_s=3.0)
    scene = Scene(Timeline(two_robots()), width_px=400)
    scene.update(4.0)
    row, column = scene.pixel(3.0, 2.0)
    with Image.open(whole) as picture:
        pixels = np.asarray(picture.convert("RGB"))
    assert (pixels == scene.frame()[..., :3]).all()  # a still is a frame
    assert tuple(pixels[row, column]) == BLUE
    for path in (early, late):
        with Image.open(path) as picture:
            assert picture.convert("RGB").getpixel((column, row)) == FLOOR


def test_equal_trials_give_equal_files(tmp_path: Path) -> None:
    first, second = tmp_path / "a.png", tmp_path / "b.png"
    for path in (first, second):
        write_still(two_robots(), path)
    assert first.read_bytes() == second.read_bytes()
    text = svg_text(two_robots(), caption="a & b <c>")
    assert text == svg_text(two_robots(), caption="a & b <c>")
    assert text.count(colours.ROBOTS[0].lower()) >= 2  # disc and trail
    write_still(two_robots(), tmp_path / "c.svg", caption="a & b <c>")
    assert (tmp_path / "c.svg").read_text() == text


def test_a_picture_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot write"):
        write_still(two_robots(), tmp_path / "none" / "a.png")
    with pytest.raises(ConfigError, match=r"ends in \.png or \.svg"):
        write_still(two_robots(), tmp_path / "a.jpg")
    assert list(tmp_path.iterdir()) == []


def test_the_palette_holds_every_colour_of_a_frame() -> None:
    palette = {tuple(row) for row in colours.palette().tolist()}
    assert len(palette) == len(colours.palette()) <= 255
    for each in (*colours.ROBOTS, colours.CONTACT, colours.GOAL, colours.BOX, colours.FLOOR, colours.INK):
        assert colours.rgb(each) in palette


def test_a_trajectory_survives_its_file(tmp_path: Path) -> None:
    save_arrays(two_robots(), tmp_path / "t.npz")
    again = Trajectory.load(tmp_path / "t.npz")
    one, two = (Scene(Timeline(each), width_px=400) for each in (two_robots(), again))
    for each in (one, two):
        each.update(2.0)
    assert (one.frame() == two.frame()).all()
