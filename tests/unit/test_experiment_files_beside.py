"""A scenario that an experiment file names is looked for beside that file, then in the present folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment import load_experiment
from fullswarm.evaluate.experiment.run import Options, run
from fullswarm.evaluate.scenarios.model import load_scenario, scenario_to_toml

FILE = """\
name = "mine"
seeds = "0"
[limits.usual]
speed_limit_m_s = 0.3
turn_limit_rad_s = 2.0
[[groups]]
name = "g"
behaviours = [{{name = "rendezvous_bc"}}]
scenarios = [{scenarios}]
robots = [2]
engines = ["kinematic"]
limits = ["usual"]
"""


def experiment_in(folder: Path, *scenarios: str) -> Path:
    folder.mkdir(exist_ok=True)
    file = folder / "mine.toml"
    file.write_text(FILE.format(scenarios=", ".join(f'"{each}"' for each in scenarios)))
    return file


def write_world(path: Path) -> None:
    path.write_text(scenario_to_toml(load_scenario("concave")))


def test_beside_the_file_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = experiment_in(tmp_path / "lab", "hall.toml", "yard.toml", "concave")
    monkeypatch.chdir(tmp_path)
    write_world(tmp_path / "lab" / "hall.toml")
    write_world(tmp_path / "hall.toml")
    write_world(tmp_path / "yard.toml")
    (group,) = load_experiment(file).groups
    assert group.scenarios == (str(tmp_path / "lab" / "hall.toml"), "yard.toml", "concave")


def test_what_is_nowhere_is_named_with_line_and_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = experiment_in(tmp_path / "lab", "hall.toml", "concave", "yard.toml")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as caught:
        load_experiment(file)
    assert str(caught.value).splitlines() == [
        f"{file}:9: groups[0].scenarios[{index}]: no file '{name}', looked in {tmp_path / 'lab'} and {tmp_path}"
        for index, name in ((0, "hall.toml"), (2, "yard.toml"))
    ]


def test_a_behaviour_that_does_not_exist_is_named_with_its_line(tmp_path: Path) -> None:
    file = experiment_in(tmp_path / "lab", "concave")
    text = file.read_text().replace(
        '[{name = "rendezvous_bc"}]', '[\n{name = "rendezvous_bc"},\n{name = "rendevous_bc"},\n]'
    )
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        run(Options(experiment=str(file)))
    assert str(caught.value).startswith(f"{file}:10: groups[0].behaviours[1]: behaviour 'rendevous_bc'")
    assert "rendezvous_bc" in str(caught.value)
