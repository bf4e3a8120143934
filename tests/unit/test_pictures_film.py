"""Films of a hand-made world: frames, durations, sizes, and what goes wrong."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from PIL.GifImagePlugin import GifImageFile

from fullswarm.errors import ConfigError, FullswarmError, MissingExtra
from fullswarm.evaluate.pictures import Film, Scene, Timeline, write_film
from fullswarm.evaluate.pictures import scene as colours
from fullswarm.evaluate.pictures.film import HOLD_MS, durations_ms, frame_times
from tests.unit.pictures_world import two_robots

WIDTH = 400


def place(x_m: float, y_m: float) -> tuple[int, int]:
    """Return column and row of a place."""
    row, column = Scene(Timeline(two_robots()), width_px=WIDTH).pixel(x_m, y_m)
    return column, row


def gif_frames(path: Path) -> tuple[list[Image.Image], list[int]]:
    """Return all frames and how long each stands, in milliseconds."""
    with GifImageFile(path) as film:
        pictures, durations = [], []
        for number in range(film.n_frames):
            film.seek(number)
            pictures.append(film.convert("RGB"))
            durations.append(film.info["duration"])
    return pictures, durations


def mp4_frames(path: Path, size: tuple[int, int]) -> tuple[str, NDArray[np.uint8]]:
    """Return what ffmpeg says of a film, and its frames (k, height, width, 3)."""
    # Not the package's own reader: it leaves a pipe open.
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    run = subprocess.run(command, capture_output=True, check=True)
    width, height = size
    return run.stderr.decode(), np.frombuffer(run.stdout, np.uint8).reshape(-1, height, width, 3)


def test_a_gif_has_the_frames_and_durations_asked_for(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    path = tmp_path / "a.gif"
    count = write_film(two_robots(), path, Film(speed=2.0, fps=10, width_px=WIDTH), lambda *each: told.append(each))
    pictures, durations = gif_frames(path)
    assert count == len(pictures) == 21  # 4 s at twice the speed, and both ends
    assert durations == [100] * 20 + [100 + HOLD_MS]
    assert told == [(number, 21) for number in range(1, 22)]
    blue = colours.rgb(colours.ROBOTS[0])
    for number in (0, 10, 20):  # each 0.2 s later, so 0.2 m further
        assert pictures[number].getpixel(place(1.0 + 0.2 * number - 0.2, 2.2)) == blue
    assert pictures[20].getpixel(place(0.8, 2.2)) == colours.rgb(colours.FLOOR)
    assert {each.size for each in pictures} == {(WIDTH, Scene(Timeline(two_robots()), width_px=WIDTH).height_px)}


def test_what_does_not_move_stands_in_one_frame_of_the_same_length(tmp_path: Path) -> None:
    film = two_robots(seconds=0.0)
    path = tmp_path / "a.gif"
    assert write_film(film, path, Film(width_px=WIDTH)) == 1
    with Image.open(path) as picture:
        assert picture.size[0] == WIDTH


def test_a_short_contact_is_seen_in_a_fast_film(tmp_path: Path) -> None:
    path = tmp_path / "a.gif"
    write_film(two_robots(touches=((11, 1),)), path, Film(speed=4.0, fps=4, width_px=WIDTH))  # frames at 0, 1, 2 … s
    pictures, _ = gif_frames(path)
    colour = [picture.getpixel(place(7.7, 8.0)) for picture in pictures]
    sky, red = colours.rgb(colours.ROBOTS[1]), colours.rgb(colours.CONTACT)
    assert colour == [sky, sky, red, sky, sky]


@given(st.integers(1, 300), st.floats(0.1, 50.0))
def test_durations_keep_the_rate_in_sum(count: int, fps: float) -> None:
    spans = durations_ms(count, fps)
    assert len(spans) == count
    assert sum(spans) - HOLD_MS == pytest.approx(1000.0 * count / fps, abs=5.0)
    assert min(spans) >= 10
    assert all(span % 10 == 0 for span in spans)


def test_an_mp4_is_h264_with_even_sizes_and_all_frames(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    count = write_film(two_robots(), path, Film(speed=1.0, fps=12.5, from_s=1.0, until_s=3.0, width_px=WIDTH + 1))
    size = (WIDTH, Scene(Timeline(two_robots()), width_px=WIDTH).height_px)
    about, frames = mp4_frames(path, size)
    assert count == len(frames) == 26
    stream = re.search(r"Video: h264 .*yuv420p.* (\d+)x(\d+).* ([0-9.]+) fps", about)
    assert stream is not None, about
    assert (int(stream[1]), int(stream[2]), float(stream[3])) == (*size, 12.5)
    assert size[1] % 2 == 0
    column, row = place(2.0 - 0.2, 2.2)
    blue = np.array(colours.rgb(colours.ROBOTS[0]))
    assert np.abs(frames[0][row, column] - blue).max() < 30  # compressed
    assert np.abs(frames[-1][row, column] - blue).max() > 100


def test_frames_end_where_the_trial_ends() -> None:
    times = frame_times(Timeline(two_robots()), Film(speed=3.0, fps=10))
    assert times[0] == 0.0
    assert times[-1] == 4.0
    assert np.diff(times)[:-1] == pytest.approx(0.3)
    assert np.diff(times)[-1] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("a.avi", Film(), r"ends in \.gif or \.mp4"),
        ("a.gif", Film(fps=60.0), "50 frames per second at most"),
        ("a.gif", Film(speed=0.001), "frames are too many"),
        ("a.gif", Film(speed=0.02, width_px=3000), "too many for a GIF"),
        ("a.mp4", Film(speed=0.0), "must be positive"),
        ("a.mp4", Film(from_s=9.0), "nothing was recorded"),
        ("a.mp4", Film(width_px=100), "320 to 3840"),
    ],
)
def test_what_cannot_be_filmed_is_said_at_once(name: str, settings: Film, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        write_film(two_robots(), tmp_path / name, settings)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_an_interrupted_film_leaves_the_old_one(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(b"the old one")

    def interrupt(done: int, of: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(two_robots(), path, Film(width_px=WIDTH), interrupt)
    assert [each.name for each in tmp_path.iterdir()] == [name]
    assert path.read_bytes() == b"the old one"


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_a_folder_that_is_not_there_is_named(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="none"):
        write_film(two_robots(), tmp_path / "none" / name, Film(width_px=WIDTH))


@pytest.mark.parametrize(
    ("name", "package"), [("a.mp4", "imageio_ffmpeg"), ("a.gif", "PIL"), ("a.gif", "matplotlib.figure")]
)
def test_a_missing_package_is_named(name: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtra, match=r"experiments"):
        write_film(two_robots(), tmp_path / name, Film(width_px=WIDTH))


def test_a_film_that_ffmpeg_did_not_finish_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imageio_ffmpeg, "count_frames_and_secs", lambda _: (7, 0.7))
    with pytest.raises(FullswarmError, match="ffmpeg wrote 7 of 11 frames"):
        write_film(two_robots(), tmp_path / "a.mp4", Film(width_px=WIDTH))
    assert list(tmp_path.iterdir()) == []
