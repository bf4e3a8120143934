"""What lies under the console's map: where pictures are placed, what a tile's address means, files that are none."""

from __future__ import annotations

import io
import math
import sqlite3
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from starlette.applications import Starlette
from starlette.testclient import TestClient

from fullswarm.errors import ConfigError
from fullswarm.operator.console.underlay import LONGEST_SIDE, read_underlay

WIDTH, HEIGHT = 40, 20


def plan(folder: Path, name: str = "plan.png", size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    path = folder / name
    Image.new("RGB", size, "white").save(path)
    return path


def fetch(path: Path, name: str) -> tuple[int, str, bytes]:
    underlay = read_underlay(path)
    client = TestClient(Starlette(routes=[underlay.route()]))
    answer = client.get(underlay.frame()["address"] + name)
    return answer.status_code, answer.headers["content-type"], answer.content


def test_a_picture_without_a_sidecar_fills_the_arena(tmp_path: Path) -> None:
    frame = read_underlay(plan(tmp_path)).frame()
    assert (frame["kind"], frame["width"], frame["height"], frame["place"]) == ("picture", WIDTH, HEIGHT, None)
    code, media, data = fetch(tmp_path / "plan.png", "picture")
    assert (code, media) == (200, "image/png")
    assert Image.open(io.BytesIO(data)).size == (WIDTH, HEIGHT)


def test_a_map_of_ros_lies_where_its_yaml_says(tmp_path: Path) -> None:
    plan(tmp_path, "lab.pgm")
    sidecar = tmp_path / "lab.yaml"
    sidecar.write_text("image: lab.pgm\nresolution: 0.05\norigin: [-1.5, 2.0, 0.5]\n")
    assert read_underlay(sidecar).frame()["place"] == [0.05, -1.5, 2.0, 0.5]
    assert fetch(sidecar, "picture")[:2] == (200, "image/png")


@given(
    cell_m=st.floats(0.001, 10.0), yaw=st.floats(-3.1, 3.1), x=st.floats(-1e4, 1e4), y=st.floats(-1e4, 1e4),
    column=st.integers(0, WIDTH - 1), row=st.integers(0, HEIGHT - 1),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_a_world_file_puts_each_pixel_where_it_says(
    tmp_path_factory: pytest.TempPathFactory, cell_m: float, yaw: float, x: float, y: float, column: int, row: int
) -> None:
    folder = tmp_path_factory.mktemp("world")
    path = plan(folder)
    a, d = cell_m * math.cos(yaw), cell_m * math.sin(yaw)
    b, e = d, -a
    (folder / "plan.pgw").write_text("\n".join(f"{each:.15g}" for each in (a, d, b, e, x, y)))
    place = read_underlay(path).frame()["place"]
    # As the page draws it: from the lower left corner, turned, the pixel's middle.
    along, up = (column + 0.5) * place[0], (HEIGHT - row - 0.5) * place[0]
    cos, sin = math.cos(place[3]), math.sin(place[3])
    drawn = [place[1] + along * cos - up * sin, place[2] + along * sin + up * cos]
    assert drawn == pytest.approx([a * column + b * row + x, d * column + e * row + y], abs=1e-6 + 1e-9 * abs(x + y))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1\n2\n3", "six numbers"), ("a b c d e f", "six numbers"), ("0.1 0 0 0.1 0 0", "mirrors"),
        ("0.1 0 0 -0.2 0 0", "stretches"), ("0.1 0 0 -0.1 nan 0", "six numbers"), ("1e9 0 0 -1e9 0 0", "stretches"),
    ],
)  # fmt: skip
def test_a_world_file_that_cannot_be_drawn_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = plan(tmp_path)
    (tmp_path / "plan.pgw").write_text(text)
    with pytest.raises(ConfigError, match=words) as refused:
        read_underlay(path)
    assert "plan.pgw" in str(refused.value)


def test_a_large_picture_is_made_smaller_and_stays_where_it_is(tmp_path: Path) -> None:
    path = plan(tmp_path, size=(2 * LONGEST_SIDE, 10))
    frame = read_underlay(path).frame()
    assert (frame["width"], frame["height"]) == (2 * LONGEST_SIDE, 10)
    assert Image.open(io.BytesIO(fetch(path, "picture")[2])).width == LONGEST_SIDE


def tiles(path: Path, form: str = "png") -> Path:
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE metadata (name text, value text)")
        database.execute("CREATE TABLE tiles (zoom_level int, tile_column int, tile_row int, tile_data blob)")
        database.executemany("INSERT INTO metadata VALUES (?, ?)", [("format", form), ("attribution", "<a>Survey</a>")])
        database.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", [(2, 1, 3, b"north"), (3, 0, 0, b"south")])
    database.close()
    return path


def test_tiles_are_addressed_from_the_north_and_kept_from_the_south(tmp_path: Path) -> None:
    path = tiles(tmp_path / "field.mbtiles")
    frame = read_underlay(path).frame()
    assert (frame["kind"], frame["zooms"], frame["attribution"]) == ("tiles", [2, 3], "Survey")
    assert fetch(path, "2/1/0") == (200, "image/png", b"north")
    assert fetch(path, "3/0/7") == (200, "image/png", b"south")
    for name in ("2/1/3", "3/0/0", "9/1/1", "99/0/0", "2/4/0", "2/1", "picture", "2/-1/0"):
        assert fetch(path, name)[0] == 404, name


def test_only_a_page_that_was_told_the_address_gets_it(tmp_path: Path) -> None:
    underlay = read_underlay(plan(tmp_path))
    client = TestClient(Starlette(routes=[underlay.route()]))
    assert client.get("/underlay/guess/picture").status_code == 404
    assert read_underlay(tmp_path / "plan.png").key != underlay.key


@pytest.mark.parametrize("name", ["plan.png", "plan.yaml", "plan.mbtiles", "plan.jpg"])
@given(data=st.binary(max_size=300))
@settings(max_examples=40, deadline=None)
def test_garbage_is_refused_in_words(tmp_path_factory: pytest.TempPathFactory, name: str, data: bytes) -> None:
    path = tmp_path_factory.mktemp("garbage") / name
    path.write_bytes(data)
    with pytest.raises(ConfigError) as refused:
        read_underlay(path)
    assert name in str(refused.value)


@pytest.mark.parametrize(("name", "words"), [("none.png", "no such file"), ("plan.svg", "cannot be shown")])
def test_what_is_no_underlay_is_refused_with_what_to_give(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "plan.svg").write_text("<svg/>")
    with pytest.raises(ConfigError, match=words) as refused:
        read_underlay(tmp_path / name)
    assert "MBTiles" in str(refused.value)


def test_vector_tiles_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="pbf"):
        read_underlay(tiles(tmp_path / "field.mbtiles", "pbf"))
