"""`fullswarm request FILE.toml` and `fullswarm mission`, on a real core and a simulated clock."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from fullswarm.cli.main import app
from fullswarm.operator import session
from fullswarm.operator.session import Session, Target
from tests.unit.core_swarm import KEYS
from tests.unit.mission_lab import MissionLab

FILE = """
name = "walk"
[[steps]]
name = "ask"
robots = ["r0"]
behaviour = "flocking_bc"
done = { confirm = "Well?" }
[[steps]]
name = "go"
robots = ["r0"]
behaviour = "move_to_goal_bc"
parameters = { goal = [1.0, 0.0] }
done = { arrived = "all" }
"""


class Shell:
    """One swarm for all commands of a test."""

    def __init__(self, folder: Path) -> None:
        self.lab, self.file = MissionLab(folder / "core.db"), folder / "walk.toml"
        self.file.write_text(FILE, encoding="utf-8")

    @contextmanager
    def connect(self, target: Target, within_s: float | None = None) -> Iterator[Session]:
        del within_s
        yield Session(self.lab.swarm.bus, KEYS, self.lab.swarm.runtime, "tcp/hub", target.operator)
        self.lab.run(0.3)

    def run(self, *arguments: str) -> Result:
        return CliRunner().invoke(app, list(arguments))


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Shell]:
    made = Shell(tmp_path)
    monkeypatch.setattr(session, "connect", made.connect)
    yield made
    made.lab.close()


def test_a_mission_from_its_start_to_its_end(shell: Shell) -> None:
    assert shell.run("mission", "show").exit_code == 0
    started = shell.run("request", str(shell.file))
    assert started.exit_code == 0, started.output
    assert "running  ask: flocking_bc for r0" in started.stdout
    assert shell.run("mission", "pause", "walk").exit_code == 0
    assert shell.lab.swarm.behaviours()[0] == ""
    assert "paused" in shell.run("mission", "show").stdout
    assert shell.run("mission", "resume").exit_code == 0
    wrong = shell.run("mission", "confirm", "--step", "main/go")
    assert wrong.exit_code == 2
    assert "no step of mission 'walk' waits" in wrong.stderr
    assert shell.run("mission", "confirm", "walk", "--step", "main/ask").exit_code == 0
    shell.lab.until("done")
    (shown,) = json.loads(shell.run("mission", "show", "--json").stdout)
    assert shown["phase"] == "done"
    late = shell.run("mission", "abort", "walk")
    assert late.exit_code == 2
    assert "has ended already: done" in late.stderr


@pytest.mark.parametrize(("end", "code"), [("confirm", 0), ("abort", 1)])
def test_a_mission_is_followed_until_its_end(shell: Shell, end: str, code: int) -> None:
    def act() -> None:
        shell.lab.ask(end)

    shell.lab.swarm.runtime.after(2.0, act)
    done = shell.run("request", str(shell.file), "--wait")
    assert done.exit_code == code, done.output
    assert "Confirm: fullswarm mission confirm walk" in done.stderr
    assert done.stderr.splitlines()[-1].startswith(f"mission walk: {'done' if code == 0 else 'aborted: by anna'}")


def test_what_does_not_fit_the_swarm_is_named_with_its_lines(shell: Shell) -> None:
    shell.file.write_text(FILE.replace("flocking_bc", "floking_bc").replace("goal =", "gaol ="), encoding="utf-8")
    for check in ([], ["--check"]):
        done = shell.run("request", str(shell.file), *check)
        assert done.exit_code == 2
        assert "2 things are wrong" in done.stderr
        assert f"{shell.file}:6: steps[0].behaviour: unknown behaviour 'floking_bc'" in done.stderr
        assert f"{shell.file}:12: steps[1].parameters: " in done.stderr
    assert shell.lab.missions.statuses() == ()


def test_a_check_starts_nothing(shell: Shell) -> None:
    done = shell.run("request", str(shell.file), "--check")
    assert done.exit_code == 0, done.output
    assert shell.lab.missions.statuses() == ()


def test_options_of_a_behaviour_do_not_fit_a_file_nor_the_other_way(shell: Shell) -> None:
    assert shell.run("request", str(shell.file), "--robots", "r1").exit_code == 2
    assert shell.run("request", "flocking_bc", "--check").exit_code == 2
    missing = shell.run("request", "nowhere.toml")
    assert (missing.exit_code, "no such file" in missing.stderr) == (2, True)
