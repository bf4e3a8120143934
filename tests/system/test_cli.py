"""The command line as a shell and a new user meet it: real processes, TAB, a lab of one's own, and mistakes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.live import LiveSwarm
from tests.waiting import until

FLEET = """
swarm = "lab"
[fleet]
count = 2
[[robot]]
id = "rover"
[groups]
scouts = ["r1", "rover"]
"""
ROOT = str(Path(__file__).parents[2])
NOBODY = {"FULLSWARM_HUB": "tcp/127.0.0.1:9"}


def tab(*words: str, shell: str = "bash", **environment: str) -> list[str]:
    """Press TAB at the end of the last word, in a real process, as the shell's script does."""
    line = " ".join(words)
    asked = {"COMP_WORDS": "\n".join(words), "COMP_CWORD": str(len(words) - 1), "_TYPER_COMPLETE_ARGS": line}
    if shell == "fish":
        asked["_TYPER_COMPLETE_FISH_ACTION"] = "get-args"
    done = subprocess.run(
        [sys.executable, "-m", "fullswarm"],
        env={**os.environ, **NOBODY, **asked, "_FULLSWARM_COMPLETE": f"complete_{shell}", **environment},
        capture_output=True, text=True, timeout=60.0, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def test_behaviours_of_the_package_without_a_hub() -> None:
    assert tab("fullswarm", "request", "move_to") == ["move_to_goal", "move_to_goal_bc"]


def test_parameters_of_the_behaviour_named_with_values_worth_trying() -> None:
    words = tab("fullswarm", "request", "navigate_bc", "--set", "")
    found = [word for word in words if word.startswith(("goal", "map"))]
    assert found == ["goal=", "goal=1.0,2.0", "map=", "map=given", "map=shared", "map=own"]


def test_bash_tears_words_apart_at_equals_and_gets_only_the_rest() -> None:
    assert tab("fullswarm", "request", "navigate_bc", "--set", "map", "=", "o") == ["own"]
    assert tab("fullswarm", "request", "navigate_bc", "--set", "map", "=") == ["given", "shared", "own"]


def test_robots_and_groups_of_the_fleet_file_in_the_environment(tmp_path: Path) -> None:
    fleet = tmp_path / "lab.toml"
    fleet.write_text(FLEET)
    line = ("fullswarm", "request", "flocking", "--robots")
    assert tab(*line, "r1,", FULLSWARM_FLEET=str(fleet)) == ["r1,rover", "r1,r2", "r1,@scouts"]
    assert tab(*line, "r1,", "@", "s", FULLSWARM_FLEET=str(fleet)) == ["@scouts"]
    assert tab("fullswarm", "stop", "", FULLSWARM_FLEET=str(fleet)) == ["rover", "r1", "r2"]  # no groups: no core


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("scenario", "show", "con"), "concave"),
        (("experiment", "run", "sa"), "safety"),
        (("params", "get", "--layer", ""), "core"),
        (("up", "lab.toml", "--set", "agent.sensing"), "agent.sensing_radius_m=3.0"),
    ],
)
def test_what_else_has_names(words: tuple[str, ...], offered: str) -> None:
    assert offered in tab("fullswarm", *words)


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_show_what_a_word_means(shell: str) -> None:
    (line,) = [line for line in tab("fullswarm", "request", "flocking_b", shell=shell) if "flocking_bc" in line]
    assert "Separation, alignment and cohesion" in line


@pytest.mark.parametrize(
    ("words", "environment"),
    [
        (("request", ""), {"FULLSWARM_HUB": "nonsense"}),
        (("request", "flocking", "--robots", ""), {"FULLSWARM_FLEET": "/no/such/file.toml"}),
        (("request", "flocking", "--set", "'half"), {}),
        (("request", "--swarm", "a b", "flocking", "--robots", ""), {}),
        (("nonsense", "--robots", ""), {}),
        (("request", ""), {"COMP_CWORD": "many"}),
    ],
)
def test_it_never_complains(words: tuple[str, ...], environment: dict[str, str]) -> None:
    tab("fullswarm", *words, **environment)


def test_tab_imports_hardly_more_than_help() -> None:
    """Its time is that of what it imports, which a busy machine does not change."""

    def imports(*words: str, **environment: str) -> set[str]:
        command = [sys.executable, "-X", "importtime", "-m", "fullswarm", *words]
        done = subprocess.run(command, env={**os.environ, **NOBODY, **environment}, capture_output=True, check=False)
        lines = done.stderr.decode().splitlines()
        return {line.rpartition("|")[2].strip() for line in lines if line.startswith("import time:")}

    asked = {"COMP_WORDS": "fullswarm\nrequest\nmo", "COMP_CWORD": "2", "_FULLSWARM_COMPLETE": "complete_bash"}
    for_help, for_tab = imports("--help"), imports(**asked)
    assert {"fullswarm.registry", "pydantic"} <= for_tab, "the records were read"
    assert not {"numpy", "zenoh", "msgspec", "structlog", "sqlite3", "asyncio"} & for_tab
    assert len(for_tab) < 2 * len(for_help)


# ---------------------------------------------------------------- a lab of one's own
@pytest.fixture(scope="module")
def lab() -> Iterator[Path]:
    """A lab made by `init` and made known the way an editable installation does it, but without a network."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "my-lab"
        done = fullswarm("init", str(place))
        assert done.returncode == 0, done.stderr
        setup = [sys.executable, "-W", "ignore", "-c", "import setuptools; setuptools.setup()", "-q", "egg_info"]
        subprocess.run(setup, cwd=place, check=True, capture_output=True, timeout=60.0)
        yield place


def fullswarm(*words: str, cwd: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "fullswarm", *words],
        env={**os.environ, **NOBODY, "PYTHONPATH": ROOT, **environment},
        cwd=cwd, capture_output=True, text=True, timeout=60.0, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip


def test_a_new_lab_passes_its_own_test(lab: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"],
        env={**os.environ, "PYTHONPATH": f"{lab}:{ROOT}"}, cwd=lab, capture_output=True, text=True, timeout=120.0,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout


def test_a_new_labs_behaviour_runs_on_a_live_swarm(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", f"{lab}:{ROOT}")
    robots = [{"id": "r1", "pose": [1.5, 1.5, 0.0]}, {"id": "r2", "pose": [6.5, 1.5, 1.57]}]
    world = {"engine": "kinematic", "bounds_m": [0, 0, 8, 8]}
    swarm = LiveSwarm({"world": world, "robot": robots, "groups": {"all": ["r1", "r2"]}}, watch=False)
    try:
        done = swarm.cli("request", "ring_bc", "--set", "centre=4,4", "--robots", "@all", "--wait")
        assert done.returncode == 0, done.stderr
        assert "confirmed by: r1, r2" in done.stdout
        assert [row["behaviour"] for row in swarm.json("status", "--robots", "@all")["robots"]] == ["ring_bc"] * 2
        # The shell learns all that from the running core.
        hub = swarm.config.hub.endpoint
        offers: tuple[tuple[str, list[str]], ...] = (
            ("request rin", ["ring", "ring_bc"]), ("stop ", ["r1", "r2"]), ("request ring --robots @", ["@all"]),
        )  # fmt: skip
        for line, offer in offers:  # it listens for 0.15 s, which a loaded core may miss: press again
            words = line.split(" ")
            until(lambda: tab("fullswarm", *words, FULLSWARM_HUB=hub) == offer, 20.0, f"TAB after {line}")  # noqa: B023
        wrong = swarm.cli("request", "ring_bc", "--robots", "@al")
        assert (wrong.returncode, "unknown group '@al' (did you mean '@all'?)" in wrong.stderr) == (2, True)
    finally:
        swarm.close()


# ---------------------------------------------------------------- reading without a swarm
@pytest.mark.parametrize(
    "words",
    ["info", "doctor", "scenario list", "scenario show concave", "robots find --port /dev/null"],
)
def test_a_read_that_needs_no_swarm_prints_json(words: str) -> None:
    done = fullswarm(*words.split(), "--json")
    assert isinstance(json.loads(done.stdout), dict | list), done.stderr
