"""Sources of fixes in a fleet file: one table or several, maps and anchors, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.config import SwarmConfig, load_swarm
from fullswarm.config.fleet_file import write_swarm
from fullswarm.errors import ConfigError
from fullswarm.localization.fixes import on_board_settings, settings_of

ROBOTS = '[[robot]]\nid = "r1"\n[[robot]]\nid = "r2"\nfixes = "gnss:///dev/ttyACM0"\n'


def load(tmp_path: Path, text: str) -> SwarmConfig:
    path = tmp_path / "lab.toml"
    path.write_text(text)
    return load_swarm(path)


def test_one_source(tmp_path: Path) -> None:
    text = """
        [fixes]
        source = "natnet://192.168.1.5"
        axes = "y-up"
        map = { "Rigid Body 1" = "r1" }
        objects = { "Person 1" = 0.3 }
        [anchors]
        A1 = [0.0, 5.0, 2.5]
    """
    config = load(tmp_path, text + ROBOTS)
    settings = settings_of(config, config.fixes[0])
    assert (settings.url, settings.axes) == ("natnet://192.168.1.5", "y-up")
    assert (settings.names.robots, settings.names.objects) == ({"Rigid Body 1": "r1"}, {"Person 1": 0.3})
    assert settings.anchors.places_m == {"A1": (0.0, 5.0, 2.5)}
    write_swarm(config, tmp_path / "again.toml")
    assert load_swarm(tmp_path / "again.toml") == config


def test_several_sources(tmp_path: Path) -> None:
    two = '[[fixes]]\nsource = "vicon://a"\n[[fixes]]\nsource = "uwb:///dev/ttyACM0"\nrobot = "r2"\n'
    config = load(tmp_path, two + ROBOTS)
    assert [each.source for each in config.fixes] == ["vicon://a", "uwb:///dev/ttyACM0"]


def test_a_sensor_on_board(tmp_path: Path) -> None:
    config = load(tmp_path, "[world]\norigin = [48.0, 11.0]\n" + ROBOTS)
    assert on_board_settings(config, "r1") is None
    settings = on_board_settings(config, "r2")
    assert settings is not None
    assert (settings.url, settings.robot, settings.origin_deg) == ("gnss:///dev/ttyACM0", "r2", (48.0, 11.0))


def test_a_robot_that_the_file_does_not_have(tmp_path: Path) -> None:
    config = load(tmp_path, '[fixes]\nsource = "vicon://a"\nmap = { b = "r3" }\n' + ROBOTS)
    with pytest.raises(ConfigError, match="no robot 'r3'"):
        settings_of(config, config.fixes[0])


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('[fixes]\nsource = "vicon://a"\naxes = "up"\n', r"lab.toml:3: fixes.axes"),
        ('[fixes]\nsorce = "vicon://a"\n', "did you mean 'source'"),
        ('[fixes]\nsource = "vicon://a"\nmap = { b = "r 3" }\n', "lab.toml:3"),
        ("fixes = 5\n", "fixes"),
        ("[anchors]\nA = [1, 2]\n", "anchors"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, table: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load(tmp_path, table + ROBOTS)
