"""Broken worlds: a ConfigError that says where, whatever is in the file; never another exception."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.evaluate.scenarios.importers import FORMATS, read_world

pytest.importorskip("defusedxml")
pytest.importorskip("yaml")

FILES = Path(__file__).parent / "scenario_files"
SOURCES = {"sdf": "hall.sdf", "argos": "hall.argos", "stage": "hall.world",
    "player": "hall.cfg", "menge": "hallS.xml", "irsim": "hall.yaml",
           "map": "hall_map.yaml"}  # fmt: skip
PICTURE = "hall_map.pgm"
"""Of the map; it lies beside it."""

ABSURD = ["0", "-1", "1e999", "nan", "1e300", "", "x", "1e-300", "99999999", "-0.0", "1e16", "[", "{}", "null", "true"]


def sdf(inside: str) -> str:
    return f'<sdf version="1.9"><world name="w">\n{inside}\n</world></sdf>'


def box_model(size: str, pose: str = "0 0 0 0 0 0") -> str:
    return sdf(
        f'<model name="m"><static>1</static>\n<pose>{pose}</pose>\n<link name="l"><collision name="c"><geometry>'
        f"<box>\n<size>{size}</size></box></geometry></collision></link></model>"
    )


def argos(inside: str) -> str:
    return f'<argos-configuration><arena size="4,4,1">\n{inside}\n</arena></argos-configuration>'


def menge(inside: str) -> str:
    return f'<Experiment>\n<ObstacleSet type="explicit">\n{inside}\n</ObstacleSet></Experiment>'


BROKEN = [
    ("sdf", "<sdf", "not valid XML"),
    ("sdf", "", "not valid XML"),
    ("sdf", '<sdf version="1.9"><model name="m"/></sdf>', "no <world>"),
    ("sdf", sdf(""), "neither an obstacle nor a robot"),
    ("sdf", box_model("1 1"), ":5: size: '1 1' should be 3"),
    ("sdf", box_model("1 one 1"), "not made of numbers"),
    ("sdf", box_model("1 nan 1"), "finite"),
    ("sdf", box_model("1 -1 1"), "above zero"),
    ("sdf", box_model("1 1 1", "0 0 0"), ":3: pose"),
    ("sdf", sdf('<model name="a"><pose relative_to="b"/></model>'), "no frame 'b'"),
    ("sdf", sdf('<frame name="a" attached_to="a"/><model name="m"><pose relative_to="a"/></model>'), "itself"),
    ("sdf", sdf('<model name="m"><static>1</static><link name="l"><collision name="c"/></link></model>'), "<geometry>"),
    ("sdf", '<!DOCTYPE x [<!ENTITY a "b">]><sdf><world>&a;</world></sdf>', "entities"),
    ("sdf", "<a>" * 500 + "</a>" * 500, "deep"),
    ("argos", "<argos-configuration/>", "<arena>"),
    ("argos", '<argos-configuration><arena size="4,4"/></argos-configuration>', ":1: arena size"),
    ("argos", argos('<box id="b" size="1,0,1"><body position="0,0,0"/></box>'), ":2: box b"),
    ("argos", argos('<box id="b" size="1,1,1"><body position="0,0"/></box>'), "position"),
    ("argos", argos('<box id="b" size="1,1,1"><body position="0,0,0" orientation="0,45,0"/></box>'), "about z"),
    ("argos", argos("<box/>"), "attribute 'size'"),
    ("argos", argos("<distribute><entity quantity='1'><box/></entity></distribute>"), "<position>"),
    (
        "argos",
        argos("<distribute><position method='grid'/><entity quantity='1'><box/></entity></distribute>"),
        "center",
    ),
    (
        "argos",
        argos(
            "<distribute><position method='uniform' min='9,9,0' max='10,10,0'/><entity quantity='2'>"
            "<box id='b' size='1,1,1'/></entity></distribute>"
        ),
        "out of the arena",
    ),
    ("stage", "", "no model"),
    ("stage", "model(", "not closed"),
    ("stage", "model( size )", "no value"),
    ("stage", "model(\n size [1 )", ":2: .*']'|:2: .*]"),
    ("stage", "model(\n\n pose [1 2 x 4] )", "not made of numbers"),
    ("stage", "model( size [0 1 1] )", "above zero"),
    ("stage", "model( block( points 2 point[0] [0 0] ) )", "without point"),
    ("stage", "define a b( ) define b a( ) a( )", "by itself"),
    ("stage", "model @", "not expected here: '@'"),
    ("stage", "define a ( )", "after 'define'"),
    ("menge", "<Scene/>", "neither a Menge scene"),
    ("menge", menge('<Obstacle closed="1"><Vertex p_x="0" p_y="0"/></Obstacle>'), ":3: .*two <Vertex>"),
    ("menge", menge('<Obstacle closed="1"><Vertex p_x="0"/><Vertex p_x="0" p_y="0"/></Obstacle>'), "p_y"),
    (
        "menge",
        '<Experiment><AgentGroup><Generator type="rect_grid" count_x="1e9" count_y="9"/></AgentGroup></Experiment>',
        "agents",
    ),
    ("menge", '<Project scene="nowhere.xml"/>', "nowhere.xml"),
    ("irsim", "world: [1", "not valid YAML"),
    ("irsim", "hello: 1", "not an IR-SIM world"),
    ("irsim", "world: 3", "world should be"),
    ("irsim", "world: {width: wide}", "world.width"),
    ("irsim", "world: {width: -1}", "above zero"),
    ("irsim", "obstacle:\n - {state: [1]}", r"obstacle\[0\].state"),
    ("irsim", "obstacle:\n - {shape: {name: circle, radius: 0}}", "above zero"),
    ("irsim", "obstacle:\n - {shape: {name: polygon}}", "vertices"),
    ("irsim", "obstacle:\n - {number: 1000000}", "number"),
    ("irsim", "obstacle:\n - {number: .nan}", "number"),
    ("irsim", "obstacle: [4]", r"obstacle\[0\]"),
    ("irsim", "world: !!python/object/apply:os.system ['true']", "not valid YAML"),
]


@pytest.mark.parametrize(("form", "text", "what"), BROKEN)
def test_a_broken_world_is_told_with_its_place(tmp_path: Path, form: str, text: str, what: str) -> None:
    path = tmp_path / "broken"
    path.write_text(text)
    with pytest.raises(ConfigError, match=what) as caught:
        read_world(path, form)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("form", FORMATS)
@given(data=st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_files_raise_nothing_else(tmp_path: Path, form: str, data: st.DataObject) -> None:
    picture = form == "map" and data.draw(st.booleans())
    source = (FILES / (PICTURE if picture else SOURCES[form])).read_bytes()
    for name in (PICTURE, "hall.world"):
        (tmp_path / name).write_bytes((FILES / name).read_bytes())
    start = data.draw(st.integers(0, len(source)))
    length = data.draw(st.integers(0, 40))
    inserted = data.draw(st.one_of(st.binary(max_size=6), st.sampled_from([b"-1", b"1e999", b"nan", b"[", b"<", b"]"])))
    path = tmp_path / "damaged"
    path.write_bytes((FILES / SOURCES[form]).read_bytes())
    (tmp_path / PICTURE if picture else path).write_bytes(source[:start] + inserted + source[start + length :])
    try:
        imported = read_world(path, form)
    except ConfigError:
        return
    assert imported.scenario.bounds_m[0] < imported.scenario.bounds_m[2]


@pytest.mark.parametrize("form", FORMATS)
@given(data=st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_absurd_numbers_raise_nothing_else(tmp_path: Path, form: str, data: st.DataObject) -> None:
    text = (FILES / SOURCES[form]).read_text()
    for _ in range(data.draw(st.integers(1, 3))):
        places = list(re.finditer(r"-?\d+\.?\d*", text))
        place = places[data.draw(st.integers(0, len(places) - 1))]
        text = text[: place.start()] + data.draw(st.sampled_from(ABSURD)) + text[place.end() :]
    path = tmp_path / "absurd"
    path.write_text(text)
    for name in (PICTURE, "hall.world"):
        (tmp_path / name).write_bytes((FILES / name).read_bytes())
    try:
        imported = read_world(path, form)
    except ConfigError:
        return
    assert all(abs(each) < 1e7 for box in imported.scenario.boxes for each in box)


@pytest.mark.parametrize(("name", "module"), [("hall.sdf", "defusedxml"), ("hall.yaml", "yaml")])
def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, name: str, module: str) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtra, match=r"fullswarm\[experiments\]"):
        read_world(FILES / name)


def test_a_world_that_includes_itself_is_told(tmp_path: Path) -> None:
    path = tmp_path / "self.world"
    path.write_text('include "self.world"\n')
    with pytest.raises(ConfigError, match="include one another"):
        read_world(path)


def test_a_yaml_bomb_is_told_briefly(tmp_path: Path) -> None:
    path = tmp_path / "bomb.yaml"
    lines = ["a0: &a0 [1, 1]"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    path.write_text("\n".join([*lines, "world: *a11"]))
    with pytest.raises(ConfigError) as caught:
        read_world(path)
    assert len(str(caught.value)) < 1000
