"""What `make demo` runs: the front door."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from typing import Any
from urllib.error import URLError
from urllib.request import urlopen

import psutil
import pytest

ROBOTS = [f"r{number}" for number in range(1, 9)]
ACTS = ["move_to_goal_bc", "flocking_bc", "rendezvous_bc"]


def fullswarm(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "fullswarm", *arguments], capture_output=True, text=True, timeout=180, check=False
    )


def check(document: dict[str, Any]) -> None:
    assert [robot["id"] for robot in document["robots"]] == ROBOTS
    for robot in document["robots"]:
        assert robot["driver"].startswith("sim://")
        assert robot["make"] == "sim"
        assert robot["firmware"].startswith("pybullet")
        assert robot["state"] == "READY"
    assert [request["behaviour"] for request in document["requests"]] == ACTS
    for request in document["requests"]:
        assert request["acknowledged_after_s"] is not None
        assert request["confirmed_by"] == ROBOTS
    assert document["work_m"] > 10.0
    assert 0.03 < document["coverage"] < 1.0
    assert document["collisions"] == 0


@pytest.mark.alone
def test_the_live_demo_prints_one_document() -> None:
    done = fullswarm("demo", "--headless", "--seconds", "12", "--json")
    assert done.returncode == 0, done.stderr
    assert "Open " not in done.stderr, "there is no console"
    document = json.loads(done.stdout)
    check(document)
    assert 0.8 < document["real_time_factor"] < 1.2


MIXED = {"c1": "create", "c2": "create", "c3": "create", "m1": "mavlink", "m2": "mavlink", "m3": "mavlink",
         "o1": "can+odrive", "o2": "can+vesc"}  # fmt: skip


@pytest.mark.alone
def test_three_makes_drive_in_one_world() -> None:
    done = fullswarm("demo", "--fleet", "mixed", "--headless", "--seconds", "30", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert {
        robot["id"]: robot["driver"].partition(":")[0].removesuffix("+udp") for robot in document["robots"]
    } == MIXED
    for robot in document["robots"]:
        assert robot["state"] == "READY"
        assert robot["make"]
        assert robot["firmware"]
    assert [request["behaviour"] for request in document["requests"]] == ["formation_bc", "move_to_goal_bc"]
    for request in document["requests"]:
        assert request["acknowledged_after_s"] is not None
        assert request["arrived"] == list(MIXED)
    assert document["collisions"] == 0
    assert 0.8 < document["real_time_factor"] < 1.2


def test_lockstep_repeats_to_the_byte() -> None:
    first, second = (fullswarm("demo", "--lockstep", "--seconds", "14", "--seed", "7", "--json") for _ in range(2))
    assert first.returncode == 0, first.stderr
    check(json.loads(first.stdout))
    assert first.stdout == second.stdout
    noisy = ("demo", "--lockstep", "--json", "--set", "world.noise.position_m=0.01", "--seconds", "4")
    one, other = fullswarm(*noisy, "--seed", "1"), fullswarm(*noisy, "--seed", "2")
    assert one.stdout != other.stdout, "the seed must matter where there is noise"


def test_the_table_and_the_summary_are_for_people() -> None:
    done = fullswarm("demo", "--lockstep", "--seconds", "12")
    assert done.returncode == 0
    for text in ("r8", "move_to_goal_bc", "8 robots", "work", "coverage", "collisions"):
        assert text in done.stdout


def test_ctrl_c_ends_the_demo_and_leaves_no_process() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "fullswarm", "demo", "--headless"], stderr=subprocess.PIPE, text=True
    )
    assert process.stderr
    starting = process.stderr.readline()
    assert "starting 8 robots" in starting
    folder = starting.rpartition(" ")[2].strip()
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "Traceback" not in rest
    lines = [" ".join(each.info["cmdline"] or ()) for each in psutil.process_iter(["cmdline"])]
    assert not [line for line in lines if folder in line]


QUICK = ("--seconds", "6", "--set", "world.engine=kinematic")


def test_a_demo_that_stays_prints_its_address_and_ends_in_order_with_ctrl_c() -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "fullswarm", "demo", "--stay", "--no-open", *QUICK],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stderr
        said = ""
        while "the show is over" not in said:
            line = process.stderr.readline()
            assert line, said
            said += line
        assert re.search(r"^Open http://127\.0\.0\.1:\d+/#token=\S{16,}$", said, re.MULTILINE)
        assert "Space stops all" in said
        address = said.partition("Open ")[2].partition("#")[0]
        with urlopen(address) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        summary, rest = process.communicate(timeout=30)
    assert process.returncode == 0, "Ctrl-C is its ordinary end"
    assert "move_to_goal_bc" in summary
    assert "rendezvous_bc" in summary
    assert "token=" not in summary, "stdout is for data, and is often kept"
    assert "Traceback" not in rest
    with pytest.raises(URLError):
        urlopen(address)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("demo", "--fleet", "nowhere.toml"), "no such file"),
        (("demo", "--lockstep", "--set", "world.enginee=x"), "did you mean 'engine'"),
        (("hub", "--listen", "tcp/0.0.0.0:7447"), "--insecure-network"),
        (("agent", "r9", "--fleet", "examples/demo.toml"), "r9"),
    ],
)
def test_bad_input_gets_a_clear_error(arguments: tuple[str, ...], complaint: str) -> None:
    done = fullswarm(*arguments)
    assert done.returncode == 2
    assert complaint in done.stderr
    assert "Traceback" not in done.stderr


def test_help_imports_nothing_heavy() -> None:
    script = (
        "import sys\nfrom fullswarm.cli.main import app\n"
        "try: app(['--help'])\nexcept SystemExit: pass\n"
        "heavy = {'numpy', 'scipy', 'pybullet', 'matplotlib', 'pymavlink', 'zenoh', 'numba', 'osqp', 'pydantic'}\n"
        "print('HEAVY', sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "HEAVY []" in done.stdout
