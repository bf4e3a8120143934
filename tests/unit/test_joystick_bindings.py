from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.errors import ConfigError
from fullswarm.operator.joystick import mapping
from fullswarm.operator.joystick.bindings import load_bindings, parse_bindings
from fullswarm.operator.joystick.mapping import CONTROLS
from fullswarm.operator.joystick.state import AXES, BUTTONS, shaped

SHARE = st.floats(-1.0, 1.0)
STICK = '[[sticks]]\nbehaviour = "drive"\naxes = { linear = "-righty" }\n'


@given(SHARE, SHARE, st.floats(0.0, 0.9), st.floats(0.0, 1.0))
def test_shaping_keeps_the_direction_and_stays_within_one(x: float, y: float, dead_zone: float, expo: float) -> None:
    across, along = shaped((x, y), dead_zone, expo)
    assert math.hypot(across, along) <= 1.0 + 1e-9
    if math.hypot(x, y) <= dead_zone:
        assert (across, along) == (0.0, 0.0)
    else:
        assert across * y == pytest.approx(along * x, abs=1e-9)
        assert across * x >= 0.0
        assert along * y >= 0.0


@given(SHARE, SHARE, st.floats(0.0, 0.9), st.floats(0.0, 1.0))
def test_further_out_is_never_less(one: float, other: float, dead_zone: float, expo: float) -> None:
    less, more = sorted((abs(one), abs(other)))
    assert shaped((less,), dead_zone, expo)[0] <= shaped((more,), dead_zone, expo)[0] + 1e-12


def test_the_ends_of_the_way_are_zero_and_one_and_no_number_is_zero() -> None:
    assert shaped((0.15, 0.0), 0.15, 0.5) == (0.0, 0.0)
    assert shaped((1.0, 0.0), 0.15, 0.5) == (1.0, 0.0)
    assert shaped((math.nan, 1.0), 0.15, 0.0) == (0.0, 0.0)


def test_the_bindings_that_come_with_the_package_bind_every_role() -> None:
    bindings = load_bindings()
    meanings = bindings.meanings()
    assert meanings["leftshoulder"] == "dead man"
    assert meanings["b"] == "estop"
    assert meanings["leftx"] == "move_left_bc / move_right_bc"
    assert {button for _, button in bindings.buttons} <= set(BUTTONS)


def test_all_errors_are_reported_at_once_with_their_lines() -> None:
    text = """[motion]
dead_zone = 2
[buttons]
dead_man = "leftsholder"
turbo = ""
[requests.z]
behaviour = "a b"
[requests.x]
behaviour = "flocking"
parameters = { gain = { x = 1 } }
[[sticks]]
behaviour = "drive"
axes = { linear = "-rigty" }
speed = 1
"""
    with pytest.raises(ConfigError) as caught:
        parse_bindings(text, "mine.toml")
    lines = str(caught.value).splitlines()
    assert lines[0] == "mine.toml:2: motion.dead_zone: must be less than or equal to 0.9, not 2"
    assert lines[1].endswith("'leftsholder' is not a button, did you mean 'leftshoulder'?")
    assert [line.split(":")[1] for line in lines] == ["2", "4", "6", "7", "10", "13", "14"]
    assert "must be a flag, number, word, point or list of points" in lines[4]
    assert "did you mean 'righty'?" in lines[5]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (f'[buttons]\nstop = "b"\n{STICK}', "'b' is both buttons.stop and buttons.estop"),
        (f'[requests.a]\nbehaviour = "flocking"\n{STICK}', "'a' is both buttons.stop and requests.a"),
        (f'[buttons]\ndead_man = ""\n{STICK}', "'' is not a button"),
        ("[motion]\n", "no stick drives"),
        ("[motion\n", "x.toml:1: not valid TOML"),
        ("a = " + "[" * 5000, "x.toml:1: not valid TOML"),
    ],
)
def test_bindings_that_contradict_themselves_are_refused(text: str, what: str) -> None:
    with pytest.raises(ConfigError, match=r"x\.toml") as caught:
        parse_bindings(text, "x.toml")
    assert what in str(caught.value)


def test_a_file_that_is_missing_or_no_text_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no\.toml: cannot be read: No such file.*copy .*bindings\.toml"):
        load_bindings(tmp_path / "no.toml")
    (tmp_path / "bad.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="not UTF-8"):
        load_bindings(tmp_path / "bad.toml")


@given(st.text(max_size=300))
def test_any_text_is_bindings_or_a_config_error(text: str) -> None:
    with suppress(ConfigError):
        parse_bindings(text)


# ---------------------------------------------------------------- SDL's mapping lines
SOURCE = st.one_of(
    st.integers(0, 31).map(lambda at: f"b{at}"),
    st.tuples(st.sampled_from(["", "+", "-"]), st.integers(0, 15), st.sampled_from(["", "~"])).map(
        lambda parts: f"{parts[0]}a{parts[1]}{parts[2]}"
    ),
    st.tuples(st.integers(0, 3), st.sampled_from([1, 2, 4, 8])).map(lambda parts: f"h{parts[0]}.{parts[1]}"),
)


@given(st.text(max_size=40), st.dictionaries(st.sampled_from((*AXES, *BUTTONS)), SOURCE, max_size=20))
def test_a_built_line_reads_back_the_same(name: str, controls: dict[str, str]) -> None:
    made = mapping.build("0123456789abcdef" * 2, name, controls, "Linux")
    assert mapping.parse(made.text) == made


@given(st.one_of(st.text(max_size=200), st.text("0123456789abcdef,:+-~h.leftxab", max_size=80)))
def test_any_line_is_a_mapping_or_a_value_error(line: str) -> None:
    with suppress(ValueError):
        mapping.parse(line)


@given(st.binary(max_size=300))
def test_any_file_is_mappings_or_a_config_error(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("db") / "gamecontrollerdb.txt"
    path.write_bytes(content)
    with suppress(ConfigError):
        mapping.read_file(path)


def test_writing_replaces_the_line_of_the_same_pad_and_keeps_everything_else(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "gamecontrollerdb.txt"
    first, other = (mapping.build(guid * 32, "Pad", {"a": "b0"}, "Linux") for guid in "ab")
    mapping.write_file(path, first)
    path.write_text("# mine\n" + path.read_text() + "something I keep\n")
    mapping.write_file(path, other)
    again = mapping.build("A" * 32, "Pad", {"a": "b7"}, "Linux")
    mapping.write_file(path, again)
    assert path.read_text().splitlines() == ["# mine", "something I keep", other.text, again.text]
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_a_folder_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        mapping.write_file(tmp_path / "file" / "db.txt", mapping.build("a" * 32, "Pad", {}, "Linux"))


def test_the_wizard_asks_for_every_control_of_the_default_bindings() -> None:
    asked = {control for control, _ in CONTROLS}
    assert set(load_bindings().meanings()) <= asked
