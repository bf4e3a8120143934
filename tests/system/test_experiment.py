"""`fullswarm experiment run` as people call it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

UNFILTERED = """
name = "unfiltered"
seeds = "0"
[limits.paper]
speed_limit_m_s = 4.0
turn_limit_rad_s = 0.7853981633974483
accel_limit_m_s2 = 8.0
[[groups]]
name = "all"
behaviours = [{ name = "move_to_goal" }]
scenarios = ["empty_dense"]
robots = [16]
engines = ["kinematic"]
limits = ["paper"]
"""


def experiment(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "fullswarm", "experiment", "run", *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_json_of_a_small_run() -> None:
    done = experiment("safety", "--small", "--json", "--cells", "robots=8,limits=create,group=[ps]*", "--seeds", "4")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document.keys() == {"trials_done", "trials_failed", "wall_s", "simulated_s", "cells"}
    assert document["trials_done"] == len(document["cells"]) == 22
    assert document["trials_failed"] == 0
    wanted = {"behaviour", "scenario", "robots", "seeds", "engine", "limits", "collisions", "arrived_fraction"}
    for cell in document["cells"]:
        assert cell.keys() >= wanted | {"all_arrived_fraction"}
        assert (cell["robots"], cell["seeds"], cell["collisions"]) == (8, 1, 0)
    given = [each for each in document["cells"] if each["parameters"] == {"map": "given"}]
    assert len(given) == 10
    assert all(each["all_arrived_fraction"] == 1.0 for each in given)
    assert "22 of 22 trials" in done.stderr


def test_collisions_end_with_1(tmp_path: Path) -> None:
    (tmp_path / "unfiltered.toml").write_text(UNFILTERED, "utf-8")
    done = experiment(str(tmp_path / "unfiltered.toml"))
    assert done.returncode == 1, done.stderr
    assert "collided: move_to_goal empty_dense kinematic paper N=16: seeds [0]" in done.stdout
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("saftey",), "did you mean 'safety'"),
        (("safety", "--seeds", "9-1"), "--seeds"),
        (("safety", "--cells", "robot=4"), "did you mean 'robots'"),
        (("safety", "--jobs", "0"), "--jobs"),
    ],
)
def test_usage_errors_end_with_2(arguments: tuple[str, ...], words: str) -> None:
    done = experiment(*arguments)
    assert done.returncode == 2
    assert words in done.stderr
    assert not done.stdout
