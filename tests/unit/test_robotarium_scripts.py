"""Scripts of the four kinds that the Robotarium teaches, on its own simulator and on ours: the same end, no contact."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from numpy.typing import NDArray

from fullswarm.robotarium.robotarium import Robotarium
from tests.unit.rps_modules import ALIAS, fresh_rps

mpl.use("Agg")

Array = NDArray[np.float64]
SCRIPTS = Path(__file__).parents[2] / "examples" / "robotarium"
DIAMETER_M = 0.11
OURS = f"import {ALIAS}\n"

# Two pairs of robots drive at each other, and no certificate keeps them apart.
HEAD_ON = """
import numpy as np
import rps.robotarium as robotarium
from rps.utilities.controllers import *
start = np.array([[-0.5, 0.5, 0.9, 0.9], [0.0, 0.01, -0.5, 0.5], [0.0, 3.1, 1.5, -1.5]])
goals = np.array([[0.5, -0.5, 0.9, 0.9], [0.0, 0.0, 0.5, -0.5]])
r = robotarium.Robotarium(number_of_robots=4, show_figure=False, initial_conditions=start)
go, to_uni = create_si_position_controller(), create_si_to_uni_dynamics()
for _ in range(150):
    x = r.get_poses()
    r.set_velocities(np.arange(4), to_uni(go(x[:2], goals), x))
    r.step()
"""


def run(text: str) -> tuple[Any, Array]:
    """Run a script; return its testbed, and all poses (k, 3, N) that it has read."""
    read: list[Array] = []

    def noted(poses: Array) -> Array:
        read.append(np.array(poses))
        return poses

    names: dict[str, Any] = {"__name__": "__main__", "noted": noted}
    with fresh_rps():
        exec(compile(text.replace("r.get_poses()", "noted(r.get_poses())"), "script.py", "exec"), names)
    return names["r"], np.array(read)


def closest_m(poses: Array) -> float:
    """Return the least distance of two centres that moved straight between the poses (k, 3, N)."""
    first, second = np.triu_indices(poses.shape[2], 1)
    offset = poses[:, :2, first] - poses[:, :2, second]
    way = np.diff(offset, axis=0)
    share = -(offset[:-1] * way).sum(axis=1) / np.maximum((way**2).sum(axis=1), 1e-300)
    nearest = offset[:-1] + np.clip(share, 0.0, 1.0)[:, None] * way
    return float(np.linalg.norm(nearest, axis=1).min())


@pytest.mark.parametrize("script", sorted(SCRIPTS.glob("*.py")), ids=lambda path: path.stem)
def test_a_script_ends_as_on_the_simulator_of_the_robotarium(script: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = script.read_text(encoding="utf-8")
    theirs, _ = run(text)
    ours, poses = run(OURS + text)
    assert type(theirs).__module__ == "rps.robotarium"
    assert isinstance(ours, Robotarium)
    assert np.linalg.norm(theirs.poses[:2] - ours.poses[:2], axis=0).max() < 0.05
    assert closest_m(poses) > DIAMETER_M
    assert (np.abs(poses[:, :2]) <= np.array([[1.6], [1.0]])).all()
    report = ours.report()
    assert (report.contacts, report.too_near, report.outside) == (0, 0, 0)
    assert f"Robotarium: {report.steps} steps" in capsys.readouterr().out


def test_the_other_ways_to_replace_the_import_give_the_same_bytes() -> None:
    text = (SCRIPTS / "formation.py").read_text(encoding="utf-8").replace("STEPS = 600", "STEPS = 40")
    _, aliased = run(OURS + text)
    _, renamed = run(text.replace("rps.", "fullswarm.robotarium."))
    assert aliased.tobytes() == renamed.tobytes()


def test_robots_that_collide_on_the_simulator_do_not_touch_behind_the_filter() -> None:
    _, theirs = run(HEAD_ON)
    assert closest_m(theirs) < DIAMETER_M
    ours, poses = run(OURS + HEAD_ON)
    assert closest_m(poses) > DIAMETER_M
    assert ours.report().contacts == 0
    assert ours.report().filtered_m > 0.1


def test_without_the_filter_bodies_collide_and_the_report_counts_it() -> None:
    ours, poses = run(OURS + HEAD_ON.replace("show_figure=False", "show_figure=False, filtered=False"))
    report = ours.report()
    assert report.contacts >= 2
    first, second = np.triu_indices(4, 1)
    apart = np.linalg.norm(poses[:, :2, first] - poses[:, :2, second], axis=1)
    assert report.too_near == (apart <= DIAMETER_M).sum() > 0
    assert report.filtered_m == 0.0


@pytest.mark.parametrize("alone", [True, False])
def test_a_script_beside_one_that_is_named_coverage_runs(tmp_path: Path, alone: bool) -> None:
    (tmp_path / "coverage.py").write_text("raise SystemExit('numba has imported a script')\n")
    script = tmp_path / "mine.py"
    script.write_text(("" if alone else OURS) + HEAD_ON.replace("range(150)", "range(2)"))
    command = [sys.executable, *(["-m", "fullswarm.robotarium"] if alone else []), str(script)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_script_runs_from_the_command_line_as_it_is(tmp_path: Path) -> None:
    script = tmp_path / "mine.py"
    script.write_text(
        HEAD_ON.replace("range(150)", "range(5)") + "\nimport sys\nprint(type(r).__module__, sys.argv[1])\n"
    )
    command = [sys.executable, "-m", "fullswarm.robotarium"]
    done = subprocess.run([*command, str(script), "argument"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "fullswarm.robotarium.robotarium argument"
    missing = subprocess.run([*command, str(tmp_path / "none.py")], capture_output=True, text=True, timeout=120)
    assert missing.returncode == 2
    assert "no such file" in missing.stderr
    assert "Traceback" not in missing.stderr
