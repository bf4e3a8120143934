from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.config import SwarmConfig, load_swarm
from fullswarm.config.fleet_file import write_swarm
from fullswarm.config.toml_errors import KeyPath, line_numbers
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import ConfigError
from fullswarm.registry import driver_schemes

EXAMPLES = Path(__file__).parents[2] / "examples"


def complaints(tmp_path: Path, text: str, *overrides: str) -> list[str]:
    file = tmp_path / "fleet.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_swarm(file, overrides)
    assert caught.value.exit_code == 2
    return str(caught.value).replace(f"{tmp_path}/", "").splitlines()


def load(tmp_path: Path, text: str, *overrides: str) -> SwarmConfig:
    file = tmp_path / "fleet.toml"
    file.write_text(text, encoding="utf-8")
    return load_swarm(file, overrides)


def test_all_errors_come_at_once_with_their_lines(tmp_path: Path) -> None:
    text = """\
swarm = "my lab"
control_rate_hz = 50.0
[agent]
sensing_radius = 2.0
control_rate_hz = 1
estimator = "efk"
speed_gain = "fast"
[world]
bounds_m = [0, 0, 10]
boxes = [
  [1, 1, 1, 1, 0],   # fine
  [1, 1, 1, 1, "x"],
  [1, 2, 3, 4, 5, 6],
]
walls = 3
[world.noise]
position_m = -1
heading_rad = nan
[[robot]]
id = "r 1"
[core]
stoer = "x.db"
[[robot]]
driver = "sim://a"
"""
    assert complaints(tmp_path, text) == [
        "fleet.toml:1: swarm: 'my lab' cannot name a swarm: use letters, digits, '-' and '_', 64 at most",
        "fleet.toml:2: control_rate_hz: unknown key here, it belongs in [agent]",
        "fleet.toml:4: agent.sensing_radius: unknown key, did you mean 'sensing_radius_m'?",
        "fleet.toml:5: agent.control_rate_hz: must be greater than or equal to 5, not 1",
        "fleet.toml:6: agent.estimator: must be 'auto', 'direct' or 'ekf', not 'efk', did you mean 'ekf'?",
        "fleet.toml:7: agent.speed_gain: must be a number, not 'fast'",
        "fleet.toml:9: world.bounds_m: has too few values: 3",
        "fleet.toml:12: world.boxes[1][4]: must be a number, not 'x'",
        "fleet.toml:13: world.boxes[2]: has too many values: 6 instead of 5",
        "fleet.toml:15: world.walls: must be true or false, not 3",
        "fleet.toml:17: world.noise.position_m: must be greater than or equal to 0, not -1",
        "fleet.toml:18: world.noise.heading_rad: must be a finite number, not nan",
        "fleet.toml:20: robot[0].id: 'r 1' cannot name a robot: use letters, digits, '-' and '_', 64 at most",
        "fleet.toml:22: core.stoer: unknown key, did you mean 'store'?",
        "fleet.toml:23: robot[1].id: is missing",
    ]


def test_types_are_not_guessed(tmp_path: Path) -> None:
    text = '[agent]\nspeed_gain = true\ncontrol_rate_hz = "50"\n[world]\nsubsteps = 2.5\nnoise = 3\n'
    assert complaints(tmp_path, text) == [
        "fleet.toml:2: agent.speed_gain: must be a number, not true",
        "fleet.toml:3: agent.control_rate_hz: must be a number, not '50': write 50, without quotes, in Hz",
        "fleet.toml:5: world.substeps: must be a whole number, not 2.5",
        "fleet.toml:6: world.noise: must be a table, not 3",
    ]


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("a = 1\nb = = 2\n", 2, "not valid TOML: Invalid value, column 5 in 'b = = 2'"),
        (
            "[agent]\n\n[agent]\n",
            3,
            (
                "[agent]: stands twice, first in line 1: put its keys under one heading, or write "
                "[[agent]] for each of several"
            ),
        ),
        (
            "[agent]\nspeed_gain = 1\nspeed_gain = 2\n",
            3,
            "agent.speed_gain: stands twice, first in line 2: remove one of the two",
        ),
        ("a = [1,\n2", 2, "not valid TOML: Unclosed array in '2' (is a bracket not closed?)"),
        ("x = " + "[" * 5000, 1, "not valid TOML: nested too deeply"),
    ],
)
def test_a_syntax_error_names_its_line(tmp_path: Path, text: str, line: int, what: str) -> None:
    assert complaints(tmp_path, text) == [f"fleet.toml:{line}: {what}"]


def test_a_missing_file_says_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text("")
    with pytest.raises(ConfigError, match=r"fleet\.toml: no such file \(in that folder: lab\.toml\)"):
        load_swarm(tmp_path / "fleet.toml")
    with pytest.raises(ConfigError, match=r"no such file.*give the path"):
        load_swarm(tmp_path / "nowhere" / "fleet.toml")
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_swarm(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'swarm = "\xe9"')
    with pytest.raises(ConfigError, match="not UTF-8 text"):
        load_swarm(tmp_path / "latin.toml")


def test_robots_with_one_id_are_refused_even_beside_other_errors(tmp_path: Path) -> None:
    text = '[[robot]]\nid = "a"\n[[robot]]\nid = "a"\n[[robot]]\nid = 3\n[hub]\nendpoint = 7\n'
    assert complaints(tmp_path, text) == [
        "fleet.toml:4: robot[1].id: 'a' is already taken by the robot in line 1",
        "fleet.toml:6: robot[2].id: must be text in quotes, not 3",
        "fleet.toml:8: hub.endpoint: must be text in quotes, not 7",
    ]


def test_the_shorthand_expands_before_the_other_robots(tmp_path: Path) -> None:
    config = load(tmp_path, '[fleet]\ncount = 2\nprefix = "rob-"\n[[robot]]\nid = "extra"\n')
    assert config.robots == ("rob-1", "rob-2", "extra")
    assert [robot.url for robot in config.robot] == ["sim://rob-1", "sim://rob-2", "sim://extra"]


@pytest.mark.parametrize(
    ("driver", "urls"),
    [
        ("null", ["null://r1", "null://r2"]),
        ("create:///dev/ttyUSB{n}", ["create:///dev/ttyUSB1", "create:///dev/ttyUSB2"]),
        ("mavlink+tcp://{id}.local:5760", ["mavlink+tcp://r1.local:5760", "mavlink+tcp://r2.local:5760"]),
    ],
)
def test_the_shorthand_makes_a_url_per_robot(tmp_path: Path, driver: str, urls: list[str]) -> None:
    assert [each.url for each in load(tmp_path, f'[fleet]\ncount = 2\ndriver = "{driver}"\n').robot] == urls


def test_the_shorthand_is_checked_too(tmp_path: Path) -> None:
    assert complaints(tmp_path, "[fleet]\ncount = 0\nprefx = 'r'\n") == [
        "fleet.toml:2: fleet.count: must be greater than or equal to 1, not 0",
        "fleet.toml:3: fleet.prefx: unknown key, did you mean 'prefix'?",
    ]
    assert complaints(tmp_path, "fleet = 8\n") == ["fleet.toml:1: fleet: must be a table, not 8"]
    assert complaints(tmp_path, "[fleet]\nprefix = 'r'\n") == ["fleet.toml:1: fleet.count: is missing"]
    assert complaints(tmp_path, "[flet]\n") == ["fleet.toml:1: flet: unknown key, did you mean 'fleet'?"]
    assert complaints(tmp_path, "[fleet]\ncount = 2\n[[robot]]\nid = 'r2'\n") == [
        "fleet.toml:4: robot[0].id: 'r2' is already taken by [fleet]"
    ]
    assert complaints(tmp_path, "[fleet]\ncount = 2\ndriver = 'create:///dev/ttyUSB0'\n") == [
        "fleet.toml:3: fleet.driver: is the same for every robot: put {id} or {n} into it"
    ]


def test_overrides_change_values_before_the_check(tmp_path: Path) -> None:
    config = load(
        tmp_path,
        '[[robot]]\nid = "a"\n[agent]\nspeed_gain = 0\n',
        "agent.speed_gain=2",
        "world.boxes=[[7, 8, 3, 4, 0.5]]",
        "robot.a.driver=null://a",
        "robot.0.pose=[1, 2, 0]",
        "swarm=lab",
        'hub.endpoint="tcp/127.0.0.1:1"',
        "world.address=127.0.0.1:2",
    )
    assert config.agent.speed_gain == 2.0
    assert config.world is not None
    assert config.world.address == "127.0.0.1:2"
    assert config.world.boxes == ((7.0, 8.0, 3.0, 4.0, 0.5),)
    assert (config.robot[0].url, config.robot[0].pose) == ("null://a", (1.0, 2.0, 0.0))
    assert (config.swarm, config.hub.endpoint) == ("lab", "tcp/127.0.0.1:1")


def test_overrides_are_named_in_their_errors(tmp_path: Path) -> None:
    lines = complaints(
        tmp_path,
        '[agent]\nspeed_gain = 0\n[[robot]]\nid = "a"\n',
        "agent.speed_gain=-1",
        "agent.turn_gain=1",
        "nonsense",
        "agent.turn_gain_per_s=[1",
        "robot.b.driver=x",
        "swarm.name=x",
        "world={boxes = [1]}",
    )
    assert sorted(lines) == sorted(
        [
            "--set agent.speed_gain: must be greater than 0, not -1",
            "--set agent.turn_gain: unknown key, did you mean 'turn_gain_per_s'?",
            "--set nonsense: expected key=value, e.g. --set agent.sensing_radius_m=2.5",
            "--set agent.turn_gain_per_s: '[1' is not a TOML value; text goes in quotes",
            "--set robot.b.driver: there is no such place in fleet.toml (known: a)",
            "--set swarm.name: swarm: must be text in quotes",
            "--set world: world.boxes[0]: must be a list, not 1",
        ]
    )


@pytest.mark.parametrize("name", ["demo.toml", "kinematic.toml"])
def test_the_examples_load(name: str) -> None:
    config = load_swarm(EXAMPLES / name)
    assert config.world is not None
    assert len(config.robots) == {"demo.toml": 8, "kinematic.toml": 100}[name]


def test_lines_of_everything_toml_can_say() -> None:
    text = (
        "# [no]\r\nswarm = 'a' # = [\n[world]\nb = [\n 0, # ]\n [1,\n  2],\n]\n"
        '"k.1" . c = """\nx = 1\n\\""""""\nz = {p = 1, q.r = [1, "]"]}\nt = \'\'\'a\'\'\'\'\'\n'
        "[[robot]]\nid = 1\n [robot.sub]\n d = 1979-05-27 07:32:00\n[core]\n[[robot]]\nid = 2\n[ world . noise ]\nq=1"
    )
    tomllib.loads(text)  # the scanner asks for valid TOML
    wanted: dict[KeyPath, int] = {
        ("swarm",): 2,
        ("world",): 3,
        ("world", "b"): 4,
        ("world", "b", 0): 5,
        ("world", "b", 1): 6,
        ("world", "b", 1, 0): 6,
        ("world", "b", 1, 1): 7,
        ("world", "k.1"): 9,
        ("world", "k.1", "c"): 9,
        ("world", "z"): 12,
        ("world", "z", "p"): 12,
        ("world", "z", "q"): 12,
        ("world", "z", "q", "r"): 12,
        ("world", "z", "q", "r", 0): 12,
        ("world", "z", "q", "r", 1): 12,
        ("world", "t"): 13,
        ("robot",): 14,
        ("robot", 0): 14,
        ("robot", 0, "id"): 15,
        ("robot", 0, "sub"): 16,
        ("robot", 0, "sub", "d"): 17,
        ("core",): 18,
        ("robot", 1): 19,
        ("robot", 1, "id"): 20,
        ("world", "noise"): 21,
        ("world", "noise", "q"): 22,
    }
    assert line_numbers(text) == wanted


SCALARS = st.one_of(
    st.integers(-(10**6), 10**6).map(str),
    st.booleans().map(lambda flag: str(flag).lower()),
    st.text(st.sampled_from("a#[]{}=,.'\" \\"), max_size=6).map(
        lambda text: '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
    ),
    st.text(st.sampled_from('a#[]={}\n"'), max_size=6).map(lambda text: "'''\n" + text + "'''"),
)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=3).map(lambda items: "[\n" + " , # ]\n".join(items) + "\n]")
)


@given(st.lists(st.tuples(st.sampled_from(["k", '"q.]"', "a.b"]), VALUES), max_size=5))
def test_the_scanner_finds_every_key_that_tomllib_finds(pairs: list[tuple[str, str]]) -> None:
    text, wanted = "", {}
    for number, (key, value) in enumerate(pairs):
        wanted["t", number] = text.count("\n") + 1
        text += f"[[t]]\n{key} = {value}\n"
    found = line_numbers(text)
    assert {path: line for path, line in found.items() if len(path) == 2} == wanted
    assert set(found) - {("t",)} == set(_paths(tomllib.loads(text).get("t", []), ("t",)))


def _paths(value: object, path: KeyPath) -> list[KeyPath]:
    items: list[tuple[str | int, object]] = []
    if isinstance(value, dict):
        items = list(value.items())
    elif isinstance(value, list):
        items = list(enumerate(value))
    return [way for key, inner in items for way in [(*path, key), *_paths(inner, (*path, key))]]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[agent]\nsensing_radius_m = 300000\n",
         "fleet.toml:2: agent.sensing_radius_m: must be less than or equal to 1000 m, not 300000"),
        ("[agent]\nspeed_limit_m_s = 500\n",
         "fleet.toml:2: agent.speed_limit_m_s: must be less than or equal to 10 m/s, not 500"),
        ("[agent]\nsafety_margin_m = 30\n",
         "fleet.toml:2: agent.safety_margin_m: must be less than or equal to 1 m, not 30"),
        ("[agent]\ncontrol_rate_hz = 0.001\n", "fleet.toml:2: agent.control_rate_hz: must be greater than or equal"),
        ("[agent]\ncontrol_rate_hz = 1e6\n",
         "fleet.toml:2: agent.control_rate_hz: must be less than or equal to 500 Hz"),
        ("[world]\nrate_hz = 1e6\n", "fleet.toml:2: world.rate_hz: must be less than or equal to 1000 Hz"),
        ("[world]\nradius_m = 170\n", "fleet.toml:2: world.radius_m: must be less than or equal to 50 m, not 170"),
        ("[world]\nsubsteps = 100000\n", "fleet.toml:2: world.substeps: must be less than or equal to 100, not 100000"),
        ("[world]\nbounds_m = [20.0, 0.0, 0.0, 20.0]\n",
         "fleet.toml:2: world.bounds_m: [20, 0, 0, 20] is not an arena"),
        ("[world]\nboxes = [\n[5, 5, 1, 1, 0],\n[5, 5, 0, 1, 0],\n]\n",
         "fleet.toml:4: world.boxes[1]: has no size (0 by 1 m)"),
        ("[world]\nboxes = [\n[5, 5, 1, 1, 0],\n[25, 5, 1, 1, 0],\n]\n",
         "fleet.toml:4: world.boxes[1]: lies outside the arena, bounds_m = [0, 0, 20, 20]: write centre x, y, size"),
        ("[world]\nboxes = [[20.6, 5, 1, 1, 0]]\n", "fleet.toml:2: world.boxes[0]: lies outside the arena"),
    ],
)  # fmt: skip
def test_what_no_lab_has_is_refused_with_its_line(tmp_path: Path, text: str, line: str) -> None:
    (complaint,) = complaints(tmp_path, text)
    assert complaint.startswith(line)


def test_a_box_that_reaches_into_the_arena_is_one_of_it(tmp_path: Path) -> None:
    text = "[world]\nboxes = [[20.4, 5, 1, 1, 0], [20.6, 10, 1, 1, 0.785], [10, 10, 100, 0.1, 0]]\n"
    assert len(load(tmp_path, text).world_or_default.boxes) == 3


def robots(*drivers: str) -> str:
    return "\n".join(f'[[robot]]\nid = "r{k}"\ndriver = "{driver}"' for k, driver in enumerate(drivers, 1)) + "\n"


def fleet_complaints(tmp_path: Path, text: str, *, here: bool = True) -> list[str]:
    (tmp_path / "fleet.toml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_fleet(tmp_path / "fleet.toml", here=here)
    return [line.removeprefix(f"{tmp_path}/") for line in str(caught.value).splitlines()]


@pytest.mark.parametrize("here", [True, False])
def test_a_mistyped_scheme_is_refused_with_its_line(tmp_path: Path, here: bool) -> None:
    text = robots("craete:///dev/ttyUSB0", "null://r2", "mavlink+upd://127.0.0.1:14550")
    known = f"known: {', '.join(sorted(driver_schemes()))}"
    assert fleet_complaints(tmp_path, text, here=here) == [
        f"fleet.toml:3: robot[0].driver: no driver for 'craete', did you mean 'create'? {known}",
        f"fleet.toml:9: robot[2].driver: no driver for 'mavlink+upd', did you mean 'mavlink+udp'? {known}",
    ]
    assert fleet_complaints(tmp_path, '[fleet]\ncount = 4\ndriver = "simm"\n', here=here)[0] == (
        f"fleet.toml:3: fleet.driver: no driver for 'simm', did you mean 'sim'? {known}"
    )


def test_a_driver_of_another_package_is_missed_only_where_the_agent_runs(tmp_path: Path) -> None:
    text = robots("khepera:///dev/ttyUSB0")
    assert "no driver for 'khepera', known: " in fleet_complaints(tmp_path, text)[0]
    assert load_fleet(tmp_path / "fleet.toml").robots == ("r1",)
    (tmp_path / "fleet.toml").write_text(text + 'host = "robot-1.lab"\n')
    assert load_fleet(tmp_path / "fleet.toml", here=True).robots == ("r1",)


CAN = "can+odrive://can0?wheel_radius=0.05&base=0.3"
VESC = "wheel_radius=0.05&base=0.3&pole_pairs=15"


@pytest.mark.parametrize(
    ("one", "other", "what"),
    [
        ("create:///dev/ttyUSB0", "create:///dev/ttyUSB0?model=create1", "the port /dev/ttyUSB0"),
        ("create:///dev/ttyUSB0", "mavlink+serial:///dev/ttyUSB0?baud=57600", "the port /dev/ttyUSB0"),
        ("mavlink+serial:///dev/ttyUSB0?sysid=1", "mavlink+serial:///dev/ttyUSB0?sysid=2", "the port /dev/ttyUSB0"),
        ("mavlink+udp://127.0.0.1:14550?sysid=1", "mavlink+udp://0.0.0.0:14550?sysid=2", "the UDP port 14550"),
        ("mavlink+tcp://10.0.0.1:5760", "mavlink+tcp://10.0.0.1:5760?sysid=1",
         "the MAVLink system 1 at tcp 10.0.0.1:5760"),
        (f"{CAN}&left=1&right=2", f"{CAN}&left=2&right=3", "the CAN node 2 of can0"),
        (f"can+vesc:///dev/ttyACM0?interface=slcan&left=1&right=2&{VESC}",
         f"can+vesc:///dev/ttyACM0?interface=slcan&left=3&right=4&{VESC}", "the port /dev/ttyACM0"),
        ("sim://a", "sim://a", "the simulated robot a"),
    ],
)  # fmt: skip
def test_two_robots_on_one_port_are_refused(tmp_path: Path, one: str, other: str, what: str) -> None:
    (complaint,) = fleet_complaints(tmp_path, robots("null://x", one, other))
    assert complaint.startswith(f"fleet.toml:9: robot[2].driver: {what}")
    assert "is taken by r2: give each" in complaint


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("create:///dev/ttyUSB0", "create:///dev/ttyUSB1"),
        ("mavlink+udp://127.0.0.1:14550", "mavlink+udp://127.0.0.1:14560"),
        ("mavlink+tcp://10.0.0.1:5760?sysid=1", "mavlink+tcp://10.0.0.1:5760?sysid=2"),
        ("mavlink+udpout://10.0.0.1:14550?sysid=1", "mavlink+udpout://10.0.0.2:14550?sysid=1"),
        (f"{CAN}&left=1&right=2", f"{CAN}&left=3&right=4"),
        (f"{CAN}&left=1&right=2", f"can+vesc://can0?left=1&right=2&{VESC}"),  # other frames: standard and extended ids
        ("null://x", "null://x"),
    ],
)
def test_robots_that_share_a_wire_by_their_addresses_are_welcome(tmp_path: Path, one: str, other: str) -> None:
    (tmp_path / "fleet.toml").write_text(robots(one, other))
    assert len(load_fleet(tmp_path / "fleet.toml", here=True).robot) == 2


def test_the_same_port_of_two_computers_is_two_ports(tmp_path: Path) -> None:
    text = '[[robot]]\nid = "{0}"\ndriver = "create:///dev/ttyUSB0"\nhost = "{1}"\n'
    (tmp_path / "fleet.toml").write_text(text.format("r1", "pi-1.lab") + text.format("r2", "pi-2.lab"))
    assert len(load_fleet(tmp_path / "fleet.toml", here=True).robot) == 2
    same = text.format("r1", "pi-1.lab") + text.format("r2", "pi-1.lab")
    assert "the port /dev/ttyUSB0 is taken by r1" in fleet_complaints(tmp_path, same, here=False)[0]
    # Without `host` each has a computer of its own, unless `up` runs all agents on this one.
    (tmp_path / "fleet.toml").write_text(robots("create:///dev/ttyUSB0", "create:///dev/ttyUSB0"))
    assert len(load_fleet(tmp_path / "fleet.toml").robot) == 2


def test_start_poses_that_cannot_be_are_refused_with_their_line(tmp_path: Path) -> None:
    text = "[world]\nboxes = [[5, 5, 1, 1, 0]]\n" + "".join(
        f'[[robot]]\nid = "r{k}"\npose = [{x}, 5, 0]\n' for k, x in enumerate((30, 5, 10, 10.2))
    )
    assert fleet_complaints(tmp_path, text) == [
        "fleet.toml:5: robot[0].pose: r0 at (30.00, 5.00) lies outside the arena, bounds_m = [0, 0, 20, 20]",
        "fleet.toml:8: robot[1].pose: r1 at (5.00, 5.00) overlaps box 0, [5.0, 5.0, 1.0, 1.0, 0.0]",
        "fleet.toml:11: robot[2].pose: r2 and r3 overlap, 0.20 m apart: their radii need 0.34 m",
    ]


def test_an_origin_alone_is_no_simulated_world(tmp_path: Path) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text('[world]\norigin = [52.5163, 13.3777]\n[[robot]]\nid = "r1"\ndriver = "null://r1"\n')
    config = load_swarm(path)
    assert config.origin_deg == (52.5163, 13.3777)
    assert (config.world, config.bounds_m) == (None, SwarmConfig().bounds_m)
    write_swarm(config, path)
    assert load_swarm(path) == config
    path.write_text("[world]\norigin = [52.5163, 13.3777]\nbounds_m = [0, 0, 5, 5]\n")
    config = load_swarm(path)
    assert (config.origin_deg, config.bounds_m) == ((52.5163, 13.3777), (0.0, 0.0, 5.0, 5.0))


@pytest.mark.parametrize("origin", ["[91.0, 13.0]", "[52.0, 181.0]", "[90.0, 0.0]", "[52.0]", '"Berlin"'])
def test_an_origin_that_is_no_place_on_earth_is_refused_where_it_stands(tmp_path: Path, origin: str) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text(f"[world]\norigin = {origin}\n")
    with pytest.raises(ConfigError, match=r"fleet\.toml:2: world\.origin"):
        load_swarm(path)
