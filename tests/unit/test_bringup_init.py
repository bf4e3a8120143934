from __future__ import annotations

import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from fullswarm import registry
from fullswarm.bringup.init import lab_files
from fullswarm.cli.main import app
from fullswarm.config import load_swarm
from fullswarm.core.behaviours import all_records
from fullswarm.errors import ConfigError
from fullswarm.testing import check_behaviour


def init(*words: str) -> Result:
    result = CliRunner().invoke(app, ["init", *words])
    assert "Traceback" not in result.output
    return result


def test_the_fleet_file_is_valid_and_its_commented_drivers_exist(tmp_path: Path) -> None:
    assert init(str(tmp_path / "my-lab")).exit_code == 0
    config = load_swarm(tmp_path / "my-lab" / "lab.toml")
    assert config.robots == ("r1", "r2", "r3", "r4")
    assert config.groups == {"scouts": ("r1", "r2"), "rest": ("r3", "r4")}
    text = (tmp_path / "my-lab" / "lab.toml").read_text()
    urls = [line.split('"')[1] for line in text.splitlines() if line.startswith("#   driver")]
    assert len(urls) == 4
    for url in urls:
        registry.driver_class(url)(url)  # refuses a wrong one, touches nothing


def test_the_law_and_the_record_fit_each_other() -> None:
    files = lab_files("my-lab")
    record = tomllib.loads(files["my_lab/ring.toml"])["ring"]
    law = ModuleType("ring")
    exec(compile(files["my_lab/ring.py"], "ring.py", "exec"), law.__dict__)
    defaults = {name: each["default"] for name, each in record["parameters"].items() if "default" in each}
    check_behaviour(law, {**defaults, "centre": [5.0, 5.0]})


def test_a_dry_run_lists_and_writes_nothing(tmp_path: Path) -> None:
    result = init(str(tmp_path / "my-lab"), "--dry-run")
    assert result.exit_code == 0
    assert f"{tmp_path}/my-lab/lab.toml" in result.stdout.splitlines()
    assert list(tmp_path.iterdir()) == []


def test_the_next_steps_are_named(tmp_path: Path) -> None:
    result = init(str(tmp_path / "My_Lab2"))
    assert "fullswarm request ring_bc --set centre=4,4 --wait" in result.stderr
    assert (tmp_path / "My_Lab2" / "my_lab2" / "ring.py").is_file()
    assert "@" not in (tmp_path / "My_Lab2" / "pyproject.toml").read_text()


@pytest.mark.parametrize(
    ("folder", "says"),
    [
        ("9lives", "is not a valid name of a lab"),
        ("my lab", "is not a valid name of a lab"),
        ("class", "is not a valid name of a lab"),
        ("numpy", "a Python package 'numpy' exists already"),
        ("json", "a Python package 'json' exists already"),
        ("tests", "a Python package 'tests' exists already"),
        ("fullswarm", "a Python package 'fullswarm' exists already"),
        ("full", "is not empty: a.txt (name a new folder; nothing was written)"),
        ("none/../full", "is not empty"),
        ("file", "is a file (name a new folder)"),
        ("file/lab", "cannot be written: Not a directory"),
    ],
)
def test_a_folder_that_cannot_be_is_refused(tmp_path: Path, folder: str, says: str) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a.txt").touch()
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))
    result = init(str(tmp_path / folder))
    assert result.exit_code == 2
    assert says in result.stderr
    assert sorted(tmp_path.rglob("*")) == before


# ---------------------------------------------------------------- records that other packages bring
def bring(monkeypatch: pytest.MonkeyPatch, file: Path, text: str) -> None:
    file.write_text(text)
    monkeypatch.setattr(registry, "record_files", lambda: (file,))


def test_the_core_knows_the_records_of_installed_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bring(monkeypatch, tmp_path / "ring.toml", lab_files("my-lab")["my_lab/ring.toml"])
    records = all_records()
    assert records["ring_bc"] == {"like": "ring", "filtered": True}
    assert "move_to_goal" in records


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[ring]\nlaw = "ring"\ncolour = "red"\n', "behaviour 'ring'"),
        ('[flocking]\nsummary = "x"\nlaw = "ring"\n', "'flocking' is taken by fullswarm itself"),
        ("[ring\n", "line 1"),
    ],
)
def test_a_broken_record_of_a_package_names_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, says: str
) -> None:
    file = tmp_path / "ring.toml"
    bring(monkeypatch, file, text)
    with pytest.raises(ConfigError, match=r"ring\.toml") as caught:
        all_records()
    assert says in str(caught.value)


def test_record_files_lie_beside_their_laws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package, info = tmp_path / "some_lab", tmp_path / "some_lab-1.dist-info"
    for folder in (package, info):
        folder.mkdir()
    for name in ("__init__.py", "with_record.py", "without.py", "with_record.toml"):
        (package / name).touch()
    entries: list[Any] = ["a = some_lab.with_record", "b = some_lab.without", "c = gone_lab.law"]
    (info / "entry_points.txt").write_text("\n".join(["[fullswarm.behaviours]", *entries]))
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: some-lab\nVersion: 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert package / "with_record.toml" in registry.record_files()
    assert all("without" not in file.name for file in registry.record_files())
