"""SDF worlds that include models: where their files are looked for, and where what is in them stands."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios import Box
from fullswarm.evaluate.scenarios.importers import Imported, read_world, sdf_models

pytest.importorskip("defusedxml")

BOX = """<link name="link"><pose>0 0 0.25 0 0 0</pose><collision name="c"><geometry><box><size>{size}</size></box>
</geometry></collision></link>"""
CRATE = f"""<sdf version="1.9"><model name="crate"><static>true</static><pose>5 5 0 0 0 0</pose>
{BOX.format(size="1 0.5 0.5")}<frame name="corner"><pose>0.5 0.25 0 0 0 0</pose></frame></model></sdf>"""


def model(folder: Path, name: str, text: str, config: str | None = "model.sdf") -> None:
    (folder / name).mkdir(parents=True)
    (folder / name / (config or "model.sdf")).write_text(text)
    if config:
        (folder / name / "model.config").write_text(
            f"<model><name>{name}</name><sdf version='1.9'>{config}</sdf></model>"
        )


def world(folder: Path, body: str) -> Path:
    path = folder / "room.sdf"
    path.write_text(f'<sdf version="1.9"><world name="room">{body}</world></sdf>')
    return path


def include(uri: str, inside: str = "") -> str:
    return f"<include><uri>{uri}</uri>{inside}</include>"


def the_box(imported: Imported) -> Box:
    (box,) = imported.scenario.boxes
    return box


@pytest.mark.parametrize("place", [".", "models", "elsewhere"])
def test_models_are_found_where_gazebo_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    model(tmp_path / place, "crate", CRATE, "crate-1_9.sdf")
    monkeypatch.setenv("GZ_SIM_RESOURCE_PATH", f"/nowhere:{tmp_path / 'elsewhere'}")
    found = read_world(world(tmp_path, include("model://crate", "<pose>1 2 0 0 0 1.5707963267948966</pose>")))
    assert the_box(found) == pytest.approx((1.0, 2.0, 1.0, 0.5, math.pi / 2.0))


def test_without_a_pose_of_the_include_the_models_own_counts(tmp_path: Path) -> None:
    model(tmp_path, "crate", CRATE, None)
    assert the_box(read_world(world(tmp_path, include("crate"))))[:2] == pytest.approx((5.0, 5.0))


def test_the_placement_frame_is_put_at_the_pose(tmp_path: Path) -> None:
    model(tmp_path, "crate", CRATE)
    inside = "<placement_frame>corner</placement_frame><pose>1 2 0 0 0 0</pose>"
    assert the_box(read_world(world(tmp_path, include("model://crate", inside))))[:2] == pytest.approx((0.5, 1.75))


def test_poses_may_be_relative_to_an_included_model_by_its_name(tmp_path: Path) -> None:
    model(tmp_path, "crate", CRATE)
    body = include("model://crate", "<name>first</name><pose>1 0 0 0 0 1.5707963267948966</pose>")
    body += include("model://crate", '<name>second</name><pose relative_to="first">2 0 0 0 0 0</pose>')
    boxes = sorted(read_world(world(tmp_path, body)).scenario.boxes)
    assert [each[:2] for each in boxes] == [pytest.approx((1.0, 0.0)), pytest.approx((1.0, 2.0))]


def test_frames_of_nested_models_and_joints(tmp_path: Path) -> None:
    body = f"""<model name="outer"><static>true</static><pose>1 0 0 0 0 0</pose>
        <link name="base"><pose>0 3 0 0 0 0</pose></link>
        <joint name="hinge" type="fixed"><pose>0 1 0 0 0 0</pose><parent>world</parent><child>base</child></joint>
        <model name="inner"><pose>0 0 0 0 0 1.5707963267948966</pose>
            <link name="arm"><pose>2 0 0 0 0 0</pose></link></model>
    </model>
    <model name="a"><static>true</static><pose relative_to="outer::inner::arm">0 0 0 0 0 0</pose>
        {BOX.format(size="1 1 1")}</model>
    <model name="b"><static>true</static><pose relative_to="outer::hinge">0 0 0 0 0 0</pose>
        {BOX.format(size="1 1 1")}</model>"""
    boxes = sorted(read_world(world(tmp_path, body)).scenario.boxes, key=lambda box: box[1])
    assert [each[:2] for each in boxes] == [pytest.approx((1.0, 2.0)), pytest.approx((1.0, 4.0))]


def test_a_create_needs_no_file_and_is_a_start(tmp_path: Path) -> None:
    body = include("model://create", "<name>r1</name><pose>1 2 0 0 0 0.5</pose>")
    model(tmp_path, "crate", CRATE)
    (start,) = read_world(world(tmp_path, body + include("model://crate"))).starts
    assert (start.x, start.y, start.yaw) == pytest.approx((1.0, 2.0, 0.5))


@pytest.mark.parametrize(
    ("uri", "note"),
    [
        ("model://lost", "not found"),
        ("https://fuel.gazebosim.org/1.0/openrobotics/models/shelf", "not downloaded"),
        ("model://../outside", "no name of a model"),
        ("../outside", "no name of a model"),
        ("file:///etc", "not found"),
        ("", "no name of a model"),
    ],
)
def test_what_is_not_read_is_named(tmp_path: Path, uri: str, note: str) -> None:
    (tmp_path / "world").mkdir()
    model(tmp_path, "outside", CRATE)
    model(tmp_path / "world", "crate", CRATE)
    found = read_world(world(tmp_path / "world", include(uri, "<pose>1 2 0 0 0 0</pose>") + include("model://crate")))
    assert any(note in each and "at 1.00, 2.00" in each for each in found.notes)
    assert len(found.scenario.boxes) == 1


def test_a_model_may_not_lead_out_of_its_folder(tmp_path: Path) -> None:
    (tmp_path / "secret.sdf").write_text(CRATE)
    model(tmp_path / "world", "crate", CRATE, None)
    model(tmp_path / "world", "sly", CRATE, None)
    (tmp_path / "world" / "sly" / "model.config").write_text("<model><sdf>../../secret.sdf</sdf></model>")
    found = read_world(world(tmp_path / "world", include("model://sly") + include("model://crate")))
    assert len(found.scenario.boxes) == 1


def test_models_that_include_themselves_or_multiply_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def including(*uris: str) -> str:
        body = "".join(include(f"model://{uri}", f"<name>m{place}</name>") for place, uri in enumerate(uris))
        return f'<sdf version="1.9"><model name="x"><static>true</static>{body}</model></sdf>'

    model(tmp_path, "ring", including("ring"))
    with pytest.raises(ConfigError, match="includes itself"):
        read_world(world(tmp_path, include("model://ring")))
    for level in range(8):
        model(tmp_path, f"level{level}", including(*[f"level{level + 1}"] * 4))
    model(tmp_path, "level8", CRATE)
    monkeypatch.setattr(sdf_models, "MOST_INCLUDES", 500)
    with pytest.raises(ConfigError, match="more than 500 models are included"):
        read_world(world(tmp_path, include("model://level0")))


def test_a_broken_model_is_named_with_its_line(tmp_path: Path) -> None:
    model(tmp_path, "crate", CRATE.replace("1 0.5 0.5", "1 wide"))
    with pytest.raises(ConfigError, match=r"crate/model\.sdf:\d"):
        read_world(world(tmp_path, include("model://crate")))
    model(tmp_path, "torn", "<sdf>")
    with pytest.raises(ConfigError, match=r"torn/model\.sdf"):
        read_world(world(tmp_path, include("model://torn")))
