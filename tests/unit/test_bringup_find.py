"""The command line of `robots find`, `robots test`, `doctor` and `emulate`: wrong usage, and what help says."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest
from typer.testing import CliRunner

from fullswarm.cli.main import app


@pytest.fixture
def keep_signals() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("keep_signals")
@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("emulate", "hovercraft"), "hovercraft"),
        (("emulate", "create", "--listen", "udp://127.0.0.1:1"), "--listen"),
        (("emulate", "create", "--do", "fly on"), "no command 'fly'"),
        (("emulate", "create", "--drop", "2"), "--drop"),
        (("robots", "find", "--can", "kvaser:0"), "no CAN interface"),
        (("robots", "find", "--udp", "many"), "not a UDP port"),
        (("robots", "test", "crate:///dev/ttyUSB0", "--yes"), "did you mean 'create'"),
        (("robots", "test", "create:///dev/ttyUSB0", "--yes", "--speed", "5"), "--speed"),
        (("robots", "check"), "name one of a URL, --emulated and --rig"),
        (("robots", "check", "--emulated", "crate"), "no emulated robot 'crate'"),
        (("robots", "check", "crate:///dev/ttyUSB0", "--yes"), "did you mean 'create'"),
        (("robots", "check", "--rig", "no_such_module:rig"), "does not import"),
        (("robots", "check", "--rig", "fullswarm.testing"), "module:function"),
        (("robots", "check", "null://r1", "--yes", "--wire"), "no relay fits"),
        (("doctor", "nowhere.toml"), "no such file"),
    ],
)
def test_usage_errors_are_one_clear_line(arguments: tuple[str, ...], word: str) -> None:
    done = CliRunner().invoke(app, list(arguments))
    assert (done.exit_code, done.stdout) == (2, "")
    assert word in done.stderr
    assert "Traceback" not in done.stderr


def test_the_verbs_hang_on_the_operators_robots() -> None:
    done = CliRunner().invoke(app, ["robots", "--help"], env={"COLUMNS": "120"})
    assert done.exit_code == 0
    assert all(word in done.stdout for word in ("find", "test", "check", "--json", "--hub", "--swarm"))


@pytest.mark.usefixtures("keep_signals")
def test_robots_check_prints_what_was_checked_or_what_is_wrong() -> None:
    done = CliRunner().invoke(app, ["robots", "check", "null://r1", "--still", "--json"])
    assert done.exit_code == 0
    told = json.loads(done.stdout)
    assert told["passed"]
    assert "lifecycle" in told["checked"]
    assert "exercise=False" in told["skipped"]["slow driving"]
    failed = CliRunner().invoke(app, ["robots", "check", "--rig", "tests.unit.tethered:dead_band", "--settle", "0.3"])
    assert failed.exit_code == 1
    assert "return what it does: zero" in failed.stdout
    assert "Traceback" not in failed.stderr


def test_a_mistyped_url_is_told_before_anything_heavy_is_imported() -> None:
    code = """
import sys
from typer.testing import CliRunner
from fullswarm.cli.main import app
done = CliRunner().invoke(app, ["robots", "test", "crate:///dev/ttyUSB0"])
heavy = {"numpy", "fullswarm.bringup.robot_test"} & set(sys.modules)
print(done.exit_code, "did you mean 'create'" in done.stderr, sorted(heavy))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split("\n")[0] == "2 True []"
