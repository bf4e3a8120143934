"""Pictures of behaviours: the command, and the page that shows all of them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from fullswarm.cli.main import app
from fullswarm.core.behaviours import load_records, make_record
from fullswarm.lab import gallery

DOCS = Path(__file__).parents[2] / "docs"
TABLES = load_records()


def test_the_page_names_every_behaviour_and_shows_each_with_a_small_picture() -> None:
    page = (DOCS / "behaviours.md").read_text("utf-8")
    assert set(TABLES) <= set(re.findall(r"`(\w+)`", page))
    shown = re.findall(r"!\[.+\]\((behaviours/\w+\.png)\)", page)
    there = {f"behaviours/{path.name}" for path in (DOCS / "behaviours").iterdir()}
    assert set(shown) == there
    assert {name for name in TABLES if f"behaviours/{name}.png" not in there} == {
        name for name in TABLES if name.endswith("_bc") and name.removesuffix("_bc") in TABLES
    }
    sizes = [(DOCS / each).stat().st_size for each in shown]
    assert max(sizes) < 40_000
    assert sum(sizes) < 700_000


def test_the_page_tells_what_each_behaviour_is_and_needs() -> None:
    page = (DOCS / "behaviours.md").read_text("utf-8")
    for name in TABLES:
        record = make_record(name, TABLES)
        assert f": {record.summary}." in page
        for key, parameter in record.parameters.items():
            assert not parameter.required or f"`{key}`" in page


def test_scenes_give_all_that_behaviours_require() -> None:
    assert {name for name in gallery.SCENES if name not in TABLES} == set()
    for name in TABLES:
        record, scene = make_record(name, TABLES), gallery.scene_of(name, {}, {})
        required = {key for key, each in record.parameters.items() if each.required}
        assert required <= set(scene.parameters), name
        assert set(scene.parameters) <= set(record.parameters), name


def test_a_picture_is_drawn_with_the_wanted_robots_and_parameters(tmp_path: Path) -> None:
    out = tmp_path / "spread.png"
    arguments = ["--count", "3", "--seconds", "2", "--seed", "5", "--set", "spacing_m=1.0", "-o", str(out)]
    done = CliRunner().invoke(app, ["behaviours", "picture", "dispersion_bc", *arguments])
    assert done.exit_code == 0, done.output
    assert "3 robots, 2 s, 0 of them touched something" in done.output
    with Image.open(out) as picture:
        assert picture.width == gallery.WIDTH_PX
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 10


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["picture"], "needs a behaviour"),
        (["picture", "dispersoin"], "did you mean 'dispersion'"),
        (["picture", "dispersion", "--set", "spacing_m=-1"], "spacing_m = -1 is outside"),
        (["picture", "dispersion", "-o", "spread.txt"], ".png or .svg"),
        (["flocking", "--count", "3"], "go with `picture` only"),
    ],
)
def test_mistakes_are_explained(
    arguments: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["behaviours", *arguments])
    assert done.exit_code == 2
    assert says in done.output
    assert "Traceback" not in done.output
    assert not list(tmp_path.iterdir())
