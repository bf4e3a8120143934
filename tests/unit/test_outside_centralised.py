"""A centralised behaviour of another package, found by its entry point: the example's own tests, and what is listed."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from fullswarm import registry
from fullswarm.core.behaviours import all_records, make_record
from fullswarm.errors import ConfigError

EXAMPLE = Path(__file__).parents[2] / "examples" / "outside_behaviour"


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Install the example as pip would: its folder and its entry points on the path."""
    info = tmp_path / "fullswarm_orbit-0.1.0.dist-info"
    info.mkdir()
    text = (EXAMPLE / "pyproject.toml").read_text("utf-8")
    entry_points = text.replace("project.entry-points.", "").replace('"fullswarm.', "fullswarm.").replace('"]', "]")
    start, end = entry_points.index("[fullswarm.behaviours]"), entry_points.index("[tool.setuptools]")
    lines = [line.partition("#")[0].strip() for line in entry_points[start:end].splitlines()]
    (info / "entry_points.txt").write_text("\n".join(lines).replace('"', ""))
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fullswarm-orbit\nVersion: 0.1.0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(EXAMPLE))
    monkeypatch.syspath_prepend(str(EXAMPLE / "tests"))
    yield importlib.import_module("test_line_up")
    for name in [name for name in sys.modules if name.startswith(("fullswarm_orbit", "test_line_up"))]:
        del sys.modules[name]
    registry.centralised_module.cache_clear()


def test_the_example_lines_robots_up(example: ModuleType) -> None:
    example.test_places_are_taken_in_the_order_along_the_line()
    example.test_robots_line_up()


def test_its_records_are_found_and_its_law_is_no_law_on_board(example: ModuleType) -> None:
    assert all_records()["line_up_bc"] == {"like": "line_up", "filtered": True}
    assert "line_up" in registry.centralised_names()
    assert "line_up" not in registry.law_names()
    assert registry.centralised_module("line_up").__name__ == "fullswarm_orbit.line_up"


def test_a_record_whose_centralised_law_is_not_installed_is_refused() -> None:
    with pytest.raises(ConfigError, match="no centralised law 'line_down'"):
        make_record("x", {"x": {"summary": "x", "law": "line_down", "centralised": True}})
