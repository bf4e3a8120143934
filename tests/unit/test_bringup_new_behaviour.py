"""`fullswarm behaviours new`: files that pass their tests at once, in a package that exists and in a new one."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fullswarm import registry
from fullswarm.bringup.init import lab_files, write
from fullswarm.cli.main import app

REPOSITORY = Path(__file__).parents[2]


def new(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["behaviours", "new", *arguments])
    return result.exit_code, result.stdout, result.stderr


def entry_points(project: Path) -> dict[str, dict[str, str]]:
    parsed = tomllib.loads((project / "pyproject.toml").read_text())
    found: dict[str, dict[str, str]] = parsed["project"]["entry-points"]
    return found


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "my-lab"
    write({folder / path: text for path, text in lab_files("my-lab").items()})
    (folder / "deeper").mkdir()
    monkeypatch.chdir(folder / "deeper")
    return folder


def test_what_it_writes_passes_at_once(lab: Path) -> None:
    code, stdout, stderr = new("follow-me")
    assert code == 0, stderr
    written = {os.path.normpath(lab / "deeper" / line) for line in stdout.splitlines()}
    assert {str(lab / "my_lab" / "follow_me.py"), str(lab / "tests" / "test_follow_me.py")} <= written
    assert new("gather", "--centralised")[0] == 0
    assert entry_points(lab) == {
        "fullswarm.behaviours": {"ring": "my_lab.ring", "follow_me": "my_lab.follow_me"},
        "fullswarm.centralised": {"gather": "my_lab.gather"},
    }
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "PYTHONDONTWRITEBYTECODE": "1"}
    tests = ["tests/test_follow_me.py", "tests/test_gather.py"]
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests], cwd=lab, env=environment,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "5 passed" in ran.stdout


def test_without_a_package_it_makes_a_lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, stderr = new("orbit_all")
    assert code == 0, stderr
    assert "fullswarm up lab.toml --reload" in stderr
    assert "pip install pytest" in stderr
    project = tmp_path / "orbit-all-lab"
    assert (project / "lab.toml").is_file()
    assert entry_points(project)["fullswarm.behaviours"]["orbit_all"] == "orbit_all_lab.orbit_all"
    assert (project / "orbit_all_lab" / "orbit_all.toml").is_file()
    monkeypatch.setenv(registry.DEVELOP, str(project))
    assert "orbit_all" in registry.law_names()
    assert project / "orbit_all_lab" / "orbit_all.toml" in registry.record_files()


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("Orbit", "not a valid name"),
        ("flocking", "exists already"),
        ("class", "not a valid name"),
        ("ring", "exists already"),
    ],
)
def test_names_that_are_taken_or_wrong_write_nothing(lab: Path, name: str, says: str) -> None:
    before = {path: path.stat().st_mtime_ns for path in lab.rglob("*")}
    code, stdout, stderr = new(name)
    assert (code, stdout) == (2, "")
    assert says in stderr
    assert {path: path.stat().st_mtime_ns for path in lab.rglob("*")} == before


def test_a_package_of_another_layout_is_found_or_asked_for(lab: Path) -> None:
    text = (lab / "pyproject.toml").read_text()
    (lab / "pyproject.toml").write_text(text.partition("[project.entry-points")[0])
    (lab / "src" / "mine").mkdir(parents=True)
    (lab / "src" / "mine" / "__init__.py").touch()
    assert new("sweep")[0] == 0
    assert (lab / "src" / "mine" / "sweep.py").is_file()
    assert entry_points(lab) == {"fullswarm.behaviours": {"sweep": "mine.sweep"}}
    assert tomllib.loads((lab / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"] == {
        "mine": ["*.toml"]
    }
    (lab / "pyproject.toml").write_text("[project\n")
    code, _, stderr = new("other")
    assert code == 2
    assert "pyproject.toml" in stderr


def test_new_needs_a_name_and_goes_with_nothing_else() -> None:
    assert "needs a name" in new()[2]
    result = CliRunner().invoke(app, ["behaviours", "flocking", "--centralised"])
    assert result.exit_code == 2
    assert "goes with `new` only" in result.stderr
