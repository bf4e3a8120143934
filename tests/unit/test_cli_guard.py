from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import pytest
import typer

from fullswarm.errors import ConfigError, SafetyStop, Unreachable
from fullswarm.output import run_guarded


def raising(error: BaseException) -> Callable[[], int | None]:
    def call() -> int | None:
        raise error

    return call


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (ConfigError("is wrong", where="a.toml:3", hint="mend it"), 2, "error: a.toml:3: is wrong (mend it)\n"),
        (ConfigError("a.toml:1: x\na.toml:2: y"), 2, "error: 2 things are wrong\na.toml:1: x\na.toml:2: y\n"),
        (Unreachable("nobody"), 3, "error: nobody\n"),
        (SafetyStop("r1"), 4, "error: r1\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (KeyError("k"), 70, "error: KeyError: 'k' (a bug in fullswarm; --debug shows where)\n"),
    ],
)
def test_errors_become_a_line_and_a_code(
    error: BaseException, code: int, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_guarded(raising(error)) == code
    out, err = capsys.readouterr()
    assert (out, err) == ("", text)
    if isinstance(error, Exception):
        with pytest.raises(type(error)):
            run_guarded(raising(error), debug=True)


def test_the_guard_lets_results_and_exits_through() -> None:
    assert run_guarded(lambda: None) == 0
    assert run_guarded(lambda: 1) == 1
    with pytest.raises(typer.Exit):
        run_guarded(raising(typer.Exit(3)))


HEAVY = {"numpy", "scipy", "pybullet", "matplotlib", "pymavlink", "zenoh", "msgspec", "pydantic", "rich", "structlog"}


def run_python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)


def test_help_of_every_command_imports_nothing_heavy() -> None:
    code = f"""
import contextlib, io, sys
from typer.main import get_command
from fullswarm.cli.main import app

def helps(command, words):
    for name, inner in getattr(command, "commands", {{}}).items():
        with contextlib.redirect_stdout(io.StringIO()) as shown:
            try:
                app([*words, name, "--help"])
            except SystemExit as end:
                assert end.code == 0, (words, name)
        assert "--help" in shown.getvalue(), (words, name)

try:
    app(["--help"])
except SystemExit as end:
    assert end.code == 0
helps(get_command(app), [])
sys.exit(", ".join(sorted({HEAVY!r} & set(sys.modules))) or 0)
"""
    done = run_python(code)
    assert (done.returncode, done.stderr) == (0, "")
    assert "estop" in done.stdout
    assert "Robots and ports:" in done.stdout, "commands stand under headings"


def test_status_says_that_there_is_no_hub_before_it_loads_what_talks_to_one() -> None:
    code = """
import sys
from fullswarm.cli.main import app
try:
    app(["status", "--hub", "tcp/127.0.0.1:9"])
except SystemExit as end:
    assert end.code == 3, end.code
sys.exit(", ".join(sorted({"zenoh", "structlog", "rich", "numpy"} & set(sys.modules))) or 0)
"""
    done = run_python(code)
    assert done.returncode == 0, done.stderr
    assert "no hub answers (start a swarm with `fullswarm up FLEET.toml`" in done.stderr


def test_a_reader_that_goes_away_is_no_error() -> None:
    code = (
        "import sys\n"
        "from fullswarm.output import run_guarded\n"
        "from fullswarm import output\n"
        "sys.exit(run_guarded(lambda: [output.data('x' * 1000) for _ in range(1000)] and 0))\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.read(10)
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(60) == 1
