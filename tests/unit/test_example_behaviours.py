"""The example behaviours, found by their entry points: their own tests, and their length."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "behaviours"
NAMES = sorted(each.stem for each in (EXAMPLE / "example_behaviours").glob("[!_]*.py"))


def install(folder: Path) -> None:
    """Install the examples as pip would: their entry points in a folder that will be on the path."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text("utf-8"))["project"]
    info = folder / "fullswarm_example_behaviours-0.1.0.dist-info"
    info.mkdir()
    lines = [f"{name} = {module}" for name, module in project["entry-points"]["fullswarm.behaviours"].items()]
    (info / "entry_points.txt").write_text("\n".join(["[fullswarm.behaviours]", *lines]))
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fullswarm-example-behaviours\nVersion: 0.1.0\n")


@pytest.mark.parametrize("name", NAMES)
def test_law_and_record_together_have_at_most_40_lines(name: str) -> None:
    folder = EXAMPLE / "example_behaviours"
    law, record = ((folder / f"{name}{ending}").read_text("utf-8") for ending in (".py", ".toml"))
    assert len(law.splitlines()) + len(record.splitlines()) <= 40
    assert re.search(rf"^{name} = ", (EXAMPLE / "pyproject.toml").read_text("utf-8"), re.M)


@pytest.mark.parametrize("test", sorted((EXAMPLE / "tests").glob("test_*.py")), ids=lambda path: path.stem)
def test_they_pass_their_own_tests(test: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{EXAMPLE}:{EXAMPLE / 'tests'}")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(test)]
    found = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=EXAMPLE)
    assert found.returncode == 0, found.stdout + found.stderr
