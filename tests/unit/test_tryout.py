"""`fullswarm try`: a file as a behaviour, in a window or as a picture; what is wrong with it in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot as plt
from PIL import Image
from typer.testing import CliRunner, Result

from fullswarm.cli.main import app

Run = Callable[..., Result]

DRIFT = """
def drift(view, *, speed_m_s=0.2):
    return speed_m_s * [[1.0, 0.0]]
"""
PATROL = """
from dataclasses import dataclass
from beside import SPEED
from fullswarm.memory import rows

@dataclass
class Memory:
    calls: "np.ndarray" = rows()

def twist(view, params, memory):
    memory.calls += 1
    view.finish(memory.calls > 50, "arrived", "50 calls")
    return SPEED * (memory.calls[:, None] > 0) * [[1.0, 0.0]]
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path / "nowhere"))  # restores the path at the end

    def call(text: str, *words: str, name: str = "law.py") -> Result:
        Path(name).write_text(text)
        return CliRunner().invoke(app, ["try", name, *words], env={"COLUMNS": "200"})

    return call


def test_a_file_is_run_and_drawn(run: Run) -> None:
    result = run(DRIFT, "speed_m_s=0.1", "--robots", "3", "--seconds", "2")
    assert result.exit_code == 0, result.output
    assert "wrote drift.png" in result.stderr
    with Image.open("drift.png") as picture:
        assert picture.size[0] == 720
    rows = {line.split()[0]: line.split()[-2:] for line in result.stdout.splitlines()[1:]}
    assert float(rows["work.mean_m"][0]) == pytest.approx(0.18, abs=0.02)  # 2 s at 0.1 m/s, and they turn first
    assert rows["work.mean_m"][1] == "m"
    assert "arrival.fraction" not in rows


def test_options_reach_the_laboratory(run: Run) -> None:
    options = ("--robots", "2", "--seconds", "1", "--seed", "3", "--save", "film.gif", "--speed", "1", "--json")
    results = [json.loads(run(DRIFT, "--size", "3", *options).stdout) for _ in range(2)]
    assert results[0] == results[1]
    assert results[0]["time_s"] == 1.0
    other = json.loads(run(DRIFT, "--size", "3", *options[:5], "4", *options[6:]).stdout)
    assert other["metrics"]["shape.spacing_m"] != results[0]["metrics"]["shape.spacing_m"]
    with Image.open("film.gif") as film:
        assert getattr(film, "n_frames", 0) == 11


def test_a_file_may_have_memory_results_and_neighbours(run: Run) -> None:
    Path("beside.py").write_text("SPEED = 0.25\n")
    result = run("import numpy as np\n" + PATROL, "--robots", "2", "--seconds", "2")
    assert result.exit_code == 0, result.output
    assert "r1: arrived, 50 calls\nr2: arrived, 50 calls" in result.stdout
    assert "wrote law.png" in result.stderr


def test_a_behaviour_is_tried_by_its_name(run: Run) -> None:
    words = ["try", "move_to_goal_bc", "goal=4,4", "--robots", "2", "--seconds", "1", "--save", "goal.svg"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert "arrival.fraction" in result.stdout
    assert Path("goal.svg").read_text().startswith("<?xml")


@pytest.mark.parametrize(
    ("text", "words", "says"),
    [
        ("def velocity(view)\n    return 1\n", (), r"law.py:1: SyntaxError: expected ':'"),
        ("import no_such_module\n", (), "law.py:1: ModuleNotFoundError"),
        ("import sys\n\nsys.exit(3)\n", (), "law.py:3: SystemExit: 3"),
        ("RADIUS_M = 3\n", (), "law.py: has no control law (define velocity(view)"),
        ("def one(view): ...\ndef two(view): ...\n", (), "which of its functions is it: one, two?"),
        ("def velocity(view, params):\n    return 1 / 0\n", (), "law.py:2: ZeroDivisionError: division by zero (after"),
        ("def law(view):\n    return deeper(view)\ndef deeper(view):\n    x\n", (), "which of its functions"),
        ("def _deep(v):\n    v.x\ndef law(v):\n    _deep(v)\n", (), "law.py:2: AttributeError: 'View' object has no"),
        (
            "import numpy as np\ndef law(view):\n    return np.zeros(3)\n",
            (),
            "law returned (3,), not an array of shape",
        ),
        ("def law(view):\n    return None\n", (), "law returned NoneType, not an array"),
        ("def law(view):\n    return view.position * float('nan')\n", (), "law returned NaN or infinity"),
        ("def law(view, *, gain):\n    return gain\n", (), "law: the argument 'gain' has no default"),
        ("def law(a, b, c, d):\n    return a\n", (), "law takes 4 arguments"),
        (DRIFT, ("sped_m_s=1",), "parameter 'sped_m_s' is unknown (did you mean 'speed_m_s'?)"),
        (DRIFT, ("speed_m_s",), "'speed_m_s' is not key=value (e.g. speed=0.3)"),
        (DRIFT, ("robots=3",), "no parameter can be called 'robots'"),
        (DRIFT, ("--save", "drift.bmp"), "cannot make a '.bmp' (it ends in .png, .svg, .gif, .mp4)"),
        (DRIFT, ("--save", "nowhere/drift.png"), "no such folder"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(run: Run, text: str, words: tuple[str, ...], says: str) -> None:
    result = run(text, *words, "--robots", "2", "--seconds", "1")
    assert result.exit_code == 2, result.output
    assert says in result.stderr
    assert result.stderr.count("\n") == 1
    assert "Traceback" not in result.output
    assert list(Path.cwd().glob("*.png")) == []


def test_options_of_a_file_are_refused_for_a_name() -> None:
    for option in ("--no-filter", "--twist"):
        result = CliRunner().invoke(app, ["try", "flocking_bc", option])
        assert (result.exit_code, result.stdout) == (2, "")
        assert "filtered and twist are for functions, and 'flocking_bc' is a name" in result.stderr


def test_a_file_that_is_not_there_is_named() -> None:
    result = CliRunner().invoke(app, ["try", "nowhere.py"])
    assert (result.exit_code, result.stderr) == (2, "error: nowhere.py: no such file\n")


# ------------------------------------------------------------------ in a window
@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Any:
    from tests.unit import screenless_backend

    before = mpl.get_backend()
    plt.switch_backend("module://tests.unit.screenless_backend")
    monkeypatch.setattr(screenless_backend, "shown", [])
    yield screenless_backend
    plt.close("all")
    plt.switch_backend(before)


def test_a_window_shows_how_the_robots_move(run: Run, screen: Any) -> None:
    result = run(DRIFT, "--robots", "2", "--seconds", "3", "--speed", "4")
    assert result.exit_code == 0, result.output
    assert "wrote" not in result.stderr
    assert len(screen.shown) >= 15  # 3 s, 4 of them per second, 20 frames per second
    first, last = screen.shown[0], screen.shown[-1]
    assert first.shape[1] == pytest.approx(720, abs=2)
    assert 100 < np.any(first != last, axis=2).sum() < 0.1 * first.shape[0] * first.shape[1]
    driven = json.loads(run(DRIFT, "--robots", "2", "--seconds", "3", "--json", "--save", "x.png").stdout)
    mean_m = next(line.split()[-2] for line in result.stdout.splitlines() if line.startswith("work.mean_m"))
    assert float(mean_m) == pytest.approx(driven["metrics"]["work.mean_m"], rel=0.01)


def test_who_closes_the_window_ends_the_run(run: Run, screen: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screen, "close_after", 5)
    result = run(DRIFT, "--robots", "2", "--seconds", "60", "--json")
    assert result.exit_code == 0, result.output
    assert 0.3 < json.loads(result.stdout)["time_s"] < 2.0


def test_an_error_closes_the_window(run: Run, screen: Any) -> None:
    text = "import math\ndef law(view):\n    return view.twist * (math.nan if view.time_s[0] > 0.5 else 1)\n"
    result = run(text, "--robots", "2", "--seconds", "3")
    assert result.exit_code == 2, result.output
    assert "law returned NaN or infinity" in result.stderr
    assert "Traceback" not in result.output
    assert plt.get_fignums() == []
