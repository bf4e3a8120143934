"""Wrong fleet files: each is refused at load with its line, the key, and what to write."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from fullswarm.config import RobotConfig, SwarmConfig, WorldConfig, load_swarm
from fullswarm.config.arena import start_problems
from fullswarm.config.suggestions import CONFUSED
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import ConfigError
from fullswarm.simulation.starts import pose_errors

EXAMPLES = Path(__file__).parents[2] / "examples"
ONE = '[[robot]]\nid = "r1"\n'
TWO = f'{ONE}[[robot]]\nid = "r2"\n'

# name, file, its wrong line, the key there, and what the message must say
MISTAKES: list[tuple[str, str, int, str, str]] = [
    # ---- not TOML
    ("duplicate key", f"{ONE}[agent]\nspeed_gain = 1\nspeed_gain = 2\n", 5, "agent.speed_gain",
     "stands twice, first in line 4"),
    ("duplicate table", f"[agent]\nspeed_gain = 1\n{ONE}[agent]\nevade = true\n", 5, "[agent]",
     "stands twice, first in line 1: put its keys under one heading"),
    ("duplicate key in braces", f'{ONE}[world]\nnoise = {{position_m = 1, position_m = 2}}\n', 4,
     "world.noise.position_m", "stands twice"),
    ("one bracket", '[robot]\nid = "r1"\n[robot]\nid = "r2"\n', 3, "[robot]", "[[robot]] for each of several"),
    ("no value", f"{ONE}[agent]\nspeed_gain =\n", 4, "", "in 'speed_gain =' (write a value behind the equals sign)"),
    ("two equals signs", f"{ONE}[agent]\nspeed_gain = = 1\n", 4, "", "in 'speed_gain = = 1'"),
    ("open quote", '[[robot]]\nid = "r1\n', 2, "", "is a quote not closed in that line?"),
    ("no quotes", "[[robot]]\nid = r1\n", 2, "", "text goes in quotes"),
    ("YAML", "[[robot]]\nid: r1\n", 2, "", "write key = value, with an equals sign"),
    ("unit behind a number", f"{ONE}[agent]\nsensing_radius_m = 3 m\n", 4, "", "write the number alone"),
    ("capital", f"{ONE}[world]\nwalls = True\n", 4, "", "write true or false, in small letters"),
    ("empty file", "", 1, "", "names no robot: write [[robot]] with an id, or [fleet] count = 4"),
    ("no robot", 'swarm = "lab"\n[world]\n', 1, "", "names no robot"),
    # ---- unknown keys
    ("start", f"{ONE}start = [1, 2, 0]\n", 3, "robot[0].start", "did you mean 'pose'? write pose = [x, y, heading]"),
    ("x", f"{ONE}x = 1\n", 3, "robot[0].x", "did you mean 'pose'?"),
    ("name", '[[robot]]\nname = "r1"\n', 2, "robot[0].name", "did you mean 'id'? write id = "),
    ("port", f'{ONE}port = "/dev/ttyUSB0"\n', 3, "robot[0].port", "did you mean 'driver'? write driver = \"create://"),
    ("type", f'{ONE}type = "create"\n', 3, "robot[0].type", "did you mean 'driver'?"),
    ("speed", f"{ONE}speed = 0.3\n", 3, "robot[0].speed", "did you mean 'agent.speed_limit_m_s'?"),
    ("robots", f"{ONE}[[robots]]\nid = 'r2'\n", 3, "robots", "did you mean 'robot'? write [[robot]] for each robot"),
    ("far from all", f"{ONE}[agent]\nzzz = 1\n", 4, "agent.zzz", "unknown key, the nearest of "),
    ("misspelt", f"{ONE}[agent]\nsensing_radius = 3\n", 4, "agent.sensing_radius", "did you mean 'sensing_radius_m'?"),
    ("in the wrong table", f"control_rate_hz = 50\n{ONE}", 1, "control_rate_hz", "it belongs in [agent]"),
    ("size of the world", f"{ONE}[world]\nsize = [10, 10]\n", 4, "world.size", "did you mean 'bounds_m'?"),
    # ---- drivers
    ("scheme", f'{ONE}driver = "craete:///dev/ttyUSB0"\n', 3, "robot[0].driver",
     "no driver for 'craete', did you mean 'create'? known: can+odrive, can+vesc, create, "),
    ("path", f'{ONE}driver = "/dev/ttyUSB0"\n', 3, "robot[0].driver", "create:///dev/ttyUSB0"),
    ("option of a URL", f'{ONE}driver = "create:///dev/ttyUSB0?modell=create2"\n', 3, "robot[0].driver", "modell"),
    ("one serial port", (f'{ONE}driver = "create:///dev/ttyUSB0"\n[[robot]]\nid = "r2"\ndriver = '
     '"create:///dev/ttyUSB0"\n'), 6, "robot[1].driver", "the port /dev/ttyUSB0 is taken by r1: give each"),
    ("one UDP port", '[world]\n[[robot]]\nid = "s"\n[[robot]]\nid = "r"\ndriver = "mavlink+udp://127.0.0.1:7450"\n', 6,
     "robot[1].driver", "the UDP port 7450 is taken by the simulated world"),
    ("CAN ids", "".join(f'[[robot]]\nid = "{each}"\ndriver = "can+odrive://can0?wheel_radius=0.05&base=0.3&left=1'
                        '&right=2"\n' for each in "ab"), 6, "robot[1].driver", "the CAN node 1 of can0"),
    ("no emulator", f'{ONE}emulate = "null"\n', 3, "robot[0].emulate", "have no emulator, known: "),
    ("emulated behind another driver", f'{ONE}emulate = "create2"\ndriver = "mavlink+udp://127.0.0.1:14550"\n', 4,
     "robot[0].driver", "'create2' is emulated behind create:, not mavlink+udp: leave the driver out"),
    # ---- names
    ("one id twice", f'{ONE}[[robot]]\nid = "r1"\n', 4, "robot[1].id", "'r1' is already taken by the robot in line 1"),
    ("group", f'{TWO}[groups]\nscouts = ["r1", "r11"]\n', 6, "groups.scouts[1]",
     "no robot 'r11' in this file, did you mean 'r1'?"),
    ("body of nobody", f"{ONE}[world.bodies.r7]\nradius_m = 0.1\n", 3, "world.bodies.r7", "no robot 'r7'"),
    # ---- places
    ("box outside", f"{ONE}[world]\nboxes = [[30, 5, 1, 1, 0]]\n", 4, "world.boxes[0]",
     "lies outside the arena, bounds_m = [0, 0, 20, 20]"),
    ("start outside", f"[world]\n{ONE}pose = [25, 5, 0]\n", 4, "robot[0].pose", "r1 at (25.00, 5.00) lies outside"),
    ("start in mm", f"[world]\n{ONE}pose = [2500, 1500, 0]\n", 4, "robot[0].pose",
     "if this is in mm, write [2.5, 1.5, ...]"),
    ("start in a box", f"[world]\nboxes = [[5, 5, 2, 2, 0]]\n{ONE}pose = [6.1, 5, 0]\n", 5, "robot[0].pose",
     "overlaps box 0"),
    ("start in a wall", f"[world]\n{ONE}pose = [0.1, 5, 0]\n", 4, "robot[0].pose", "overlaps a wall: its radius is"),
    ("starts in one another", ('[[robot]]\nid = "a"\npose = [5, 5, 0]\n[[robot]]\nid = "b"\npose = [5.2, 5, 0]\n'
     "[world]\n"), 3, "robot[0].pose", "a and b overlap, 0.20 m apart: their radii need 0.34 m"),
    ("dock outside", f'[world]\n{ONE}[[dock]]\nid = "d"\npose = [30, 5, 0]\n', 6, "dock[0].pose", "outside the arena"),
    # ---- units
    ("degrees", f"{ONE}pose = [1, 1, 90]\n[world]\n", 3, "robot[0].pose[2]", "90 degrees are 1.571"),
    ("degrees of a box", f"{ONE}[world]\nboxes = [[5, 5, 1, 1, 45]]\n", 4, "world.boxes[0][4]",
     "45 degrees are 0.7854"),
    ("300 km", f"{ONE}[agent]\nsensing_radius_m = 300000\n", 4, "agent.sensing_radius_m",
     "must be less than or equal to 1000 m, not 300000: if these are mm, write 300"),
    ("kilometres", f"{ONE}[agent]\nsensing_radius_m = 0.003\n", 4, "agent.sensing_radius_m",
     "ends within the robot itself"),
    ("millimetres", f"{ONE}[world]\nradius_m = 170\n", 4, "world.radius_m", "if these are mm, write 0.17"),
    ("centimetres", f"{ONE}[world]\nradius_m = 17\n", 4, "world.radius_m",
     "a body of 17 m radius does not fit into an arena of 20 by 20 m"),
    ("mm/s", f"{ONE}[agent]\nspeed_limit_m_s = 300\n", 4, "agent.speed_limit_m_s", "if these are mm/s, write 0.3"),
    ("ms", f"{ONE}[agent]\ncommand_ttl_s = 300\n", 4, "agent.command_ttl_s", "if these are ms, write 0.3"),
    ("percent", f"{ONE}[agent]\nbattery_low = 15\n", 4, "agent.battery_low", "a share of 1: 15 % is 0.15"),
    ("percent in quotes", f'{ONE}[agent]\nbattery_low = "15%"\n', 4, "agent.battery_low",
     "must be a number, not '15%': write 0.15, without quotes"),
    ("number in quotes", f'{ONE}[agent]\nsensing_radius_m = "3 m"\n', 4, "agent.sensing_radius_m",
     "write 3, without quotes, in m"),
    ("period", f"{ONE}[agent]\ncontrol_rate_hz = 0.02\n", 4, "agent.control_rate_hz", "a period in s, write 50"),
    ("degrees per second", f"{ONE}[agent]\nturn_limit_rad_s = 90\n", 4, "agent.turn_limit_rad_s",
     "if these are degrees per second, write 1.571"),
    # ---- files
    ("map", f'{ONE}[world]\nmap = "hall.yaml"\n', 4, "world.map", "hall.yaml"),
    ("calibration", f'{ONE}[[camera]]\nname = "c"\nsource = "world://"\ncalibration = "no.toml"\n', 6,
     "camera[0].calibration", "no.toml: `fullswarm track calibrate` writes it"),
    ("folder of the store", f'{ONE}[core]\nstore = "/nowhere/core.db"\n', 4, "core.store",
     "there is no folder /nowhere: make it"),
]  # fmt: skip


def written(folder: Path, text: str) -> Path:
    file = folder / "fleet.toml"
    file.write_text(text, encoding="utf-8")
    return file


def complaints(file: Path) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        load_fleet(file, here=True)
    assert caught.value.exit_code == 2
    return str(caught.value).replace(f"{file.parent}/", "").splitlines()


@pytest.mark.parametrize(("text", "line", "key", "says"), [each[1:] for each in MISTAKES], ids=[m[0] for m in MISTAKES])
def test_a_wrong_fleet_file_is_refused_with_line_key_and_what_to_write(
    tmp_path: Path, text: str, line: int, key: str, says: str
) -> None:
    (complaint,) = complaints(written(tmp_path, text))
    assert complaint.startswith(f"fleet.toml:{line}: {key + ': ' if key else ''}"), complaint
    assert says in complaint
    assert len(complaint) < 330, "one line that a person reads"


def test_there_are_at_least_forty_of_them() -> None:
    assert len({name for name, *_ in MISTAKES}) == len(MISTAKES) >= 40


def test_all_mistakes_of_a_file_come_at_once_sorted_by_line(tmp_path: Path) -> None:
    text = """\
[world]
boxes = [[30, 5, 1, 1, 0], [5, 5, 1, 1, 90]]
[[robot]]
id = "a"
pose = [25, 5, 0]
[[robot]]
id = "b"
driver = "craete:///dev/ttyUSB0"
[groups]
all = ["a", "bb"]
[[dock]]
id = "d"
pose = [40, 5, 0]
"""
    found = complaints(written(tmp_path, text))
    assert [each.split(": ")[:2] for each in found] == [
        ["fleet.toml:2", "world.boxes[0]"],
        ["fleet.toml:2", "world.boxes[1][4]"],
        ["fleet.toml:5", "robot[0].pose"],
        ["fleet.toml:8", "robot[1].driver"],
        ["fleet.toml:10", "groups.all[1]"],
        ["fleet.toml:13", "dock[0].pose"],
    ]


def test_every_repeated_key_is_named_at_once(tmp_path: Path) -> None:
    found = complaints(
        written(tmp_path, "swarm = 'a'\nswarm = 'b'\n[hub]\n[agent]\nevade = true\nevade = false\n[hub]\n")
    )
    assert found[:2] == [
        "fleet.toml:2: swarm: stands twice, first in line 1: remove one of the two",
        "fleet.toml:6: agent.evade: stands twice, first in line 5: remove one of the two",
    ]
    assert found[2].startswith("fleet.toml:7: [hub]: stands twice, first in line 3: put its keys under one heading")


def test_text_that_is_not_utf8_is_refused_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "fleet.toml").write_bytes(b'[[robot]]\nid = "caf\xe9"\n')
    (complaint,) = complaints(tmp_path / "fleet.toml")
    assert complaint == "fleet.toml:2: is not UTF-8 text (byte 19 of the file) (save it as UTF-8 in the editor)"


def test_a_password_in_a_line_that_is_not_toml_is_not_shown(tmp_path: Path) -> None:
    (complaint,) = complaints(written(tmp_path, f'{ONE}driver = "ros://anna:secret@host:9090" x\n'))
    assert "secret" not in complaint


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.toml")))
def test_the_examples_load_without_a_warning(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    config = load_fleet(EXAMPLES / name, here=True)
    assert config.robot
    assert capsys.readouterr().err == ""


def test_what_is_odd_is_a_warning_and_stops_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = f"{ONE}[agent]\nspeed_limit_m_s = 2.0\n[world]\nbounds_m = [0, 0, 20000, 20000]\n[groups]\nscouts = []\n"
    file = written(tmp_path, text)
    assert load_fleet(file, here=True).robots == ("r1",)
    assert capsys.readouterr().err.replace(f"{tmp_path}/", "").splitlines() == [
        "warning: fleet.toml:4: agent.speed_limit_m_s: 2 m/s has no effect: the simulated bodies drive 0.5 m/s at most",
        "warning: fleet.toml:6: world.bounds_m: the arena is 20 km wide: is it in m?",
        "warning: fleet.toml:8: groups.scouts: names no robot",
    ]
    load_fleet(file)  # a robot's own computer does not repeat it
    assert capsys.readouterr().err == ""


def test_what_is_advised_exists() -> None:
    """A suggested key of a table is one of its schema."""
    from fullswarm.config import mission_file, models
    from fullswarm.config.fleet_file import FleetShorthand
    from fullswarm.evaluate.experiment import model as experiments
    from fullswarm.evaluate.scenarios import model as scenarios

    for name, confused in CONFUSED.items():
        places = (models, mission_file, experiments, scenarios)
        schema = next((getattr(each, name) for each in places if hasattr(each, name)), FleetShorthand)
        for written_key, meant in confused.items():
            assert written_key not in schema.model_fields
            if "." not in meant.key and " " not in meant.key and meant.key not in ("fleet", "robot", "groups"):
                assert meant.key in schema.model_fields, (name, written_key)


# ---------------------------------------------------------------- against the simulated world's own judgement
PLACES = st.tuples(st.floats(-1.0, 7.0), st.floats(-1.0, 7.0), st.floats(-3.0, 3.0))
BOXES = st.tuples(st.floats(0.0, 6.0), st.floats(0.0, 6.0), st.floats(0.1, 3.0), st.floats(0.1, 3.0), st.floats(-3, 3))


@given(st.lists(PLACES, max_size=6), st.lists(BOXES, max_size=3), st.booleans())
@settings(max_examples=60, deadline=None)
def test_a_start_pose_is_refused_where_the_simulated_world_would_refuse_it(
    places: list[tuple[float, float, float]], boxes: list[tuple[float, ...]], walls: bool
) -> None:
    world = WorldConfig.model_validate({"bounds_m": (0.0, 0.0, 6.0, 6.0), "boxes": boxes, "walls": walls})
    robots = tuple(RobotConfig(id=f"r{k}", pose=place) for k, place in enumerate(places))
    config = SwarmConfig(world=world, robot=robots)
    poses = np.array(places, float).reshape(-1, 3)
    theirs = {robot for robot, _ in pose_errors(world, config.robots, poses)}
    found = list(start_problems(config))
    ours = {config.robot[index].id for index, _ in found}
    # Without walls a body may be outside for the world, but the geofence would hold it there.
    outside = set() if walls else {config.robot[index].id for index, what in found if "outside" in what}
    assert ours - outside == theirs - outside


# ---------------------------------------------------------------- whatever stands in a file
TEXTS = [path.read_text(encoding="utf-8") for path in sorted(EXAMPLES.glob("*.toml"))]
VALUES: st.SearchStrategy[Any] = st.one_of(
    st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(), st.text(max_size=8),
    st.lists(st.integers(-5, 5), max_size=6), st.just({}), st.just([{}]), st.just([[]]), st.just({"id": [1]}),
    st.sampled_from(["sim://", "create", "mavlink+udp://127.0.0.1:x", "can+odrive://", "ros://[", "://", "%", "null://"]),
)  # fmt: skip


def _places(value: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [found for key, inner in items for found in ((*way, key), *_places(inner, (*way, key)))]


def _at(value: Any, way: tuple[Any, ...]) -> Any:
    for part in way:
        value = value[part]
    return value


def _judge(file: Path) -> None:
    """Load a file: it is fine, or refused with lines that begin with its name."""
    for load in (load_fleet, load_swarm):
        try:
            load(file, here=True) if load is load_fleet else load(file)
        except ConfigError as error:
            strange = [line for line in str(error).splitlines() if not line.startswith(f"{file}:")]
            if strange:
                pytest.fail(f"not in words: {strange}")


@given(st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_mutated_example_is_fine_or_refused_in_words(tmp_path: Path, data: st.DataObject) -> None:
    document = copy.deepcopy(tomllib.loads(data.draw(st.sampled_from(TEXTS))))
    for _ in range(data.draw(st.integers(1, 3))):
        ways = _places(document)
        way = data.draw(st.sampled_from(ways))
        parent = _at(document, way[:-1])
        kind = data.draw(st.sampled_from(["value", "key", "drop", "swap"]))
        if kind == "value":
            parent[way[-1]] = data.draw(VALUES)
        elif kind == "key" and isinstance(parent, dict):
            parent[data.draw(st.sampled_from(["start", "x", "name", "port", "zz", "id", "pose", "a.b"]))] = parent.pop(
                way[-1]
            )
        elif kind == "drop":
            del parent[way[-1]]
        else:
            other = data.draw(st.sampled_from(ways))
            parent[way[-1]] = copy.deepcopy(_at(document, other))
    _judge(written(tmp_path, tomlkit.dumps(document)))


@given(st.sampled_from(TEXTS), st.integers(0, 3000), st.integers(0, 40), st.text("[]{}=.,'\"#\n 1ar\\\t“é", max_size=6))
@example("[a]\n[a", 0, 0, "")
@example("a = {b = 1, b = 2", 0, 0, "")
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_torn_text_is_fine_or_refused_in_words(tmp_path: Path, text: str, at: int, cut: int, put: str) -> None:
    _judge(written(tmp_path, text[:at] + put + text[at + cut :]))
