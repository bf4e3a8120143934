"""No file imports a module of one operating system when it is imported; locks; commands that need another system."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer import Exit

import fullswarm
from fullswarm.cli.options import shell_command
from fullswarm.errors import ConfigError
from fullswarm.portability import lock, need_linux, need_posix, seen_by_others, user_id

PACKAGE = Path(fullswarm.__file__).parent
NOT_EVERYWHERE = {"fcntl", "grp", "msvcrt", "pty", "pwd", "readline", "resource", "termios", "tty", "winreg"}
LOCK = "import sys, fullswarm.portability as each; file = open(sys.argv[1], 'a'); each.lock(file.fileno(), wait=False)"


def imported_at_once(body: list[ast.stmt]) -> Iterator[str]:
    """Yield what a module imports when it is imported itself, but for what it tries to."""
    for each in body:
        match each:
            case ast.Import():
                yield from (alias.name for alias in each.names)
            case ast.ImportFrom():
                yield each.module or ""
            case ast.If() | ast.ClassDef() | ast.With():
                yield from imported_at_once([*each.body, *getattr(each, "orelse", [])])
            case _:
                pass


def test_no_file_imports_a_module_of_one_system_at_its_top() -> None:
    found = {
        f"{path.relative_to(PACKAGE)}: {name}"
        for path in PACKAGE.rglob("*.py")
        for name in imported_at_once(ast.parse(path.read_text("utf-8")).body)
        if name.partition(".")[0] in NOT_EVERYWHERE
    }
    assert found == set(), "import it in the function that uses it (decision 78)"


def test_one_process_holds_a_lock_and_another_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "lock"
    with file.open("a") as opened:
        lock(opened.fileno(), wait=False)
        held = subprocess.run([sys.executable, "-c", LOCK, file], capture_output=True, text=True, check=False)
    free = subprocess.run([sys.executable, "-c", LOCK, file], capture_output=True, text=True, check=False)
    assert "BlockingIOError" in held.stderr
    assert (free.returncode, free.stderr) == (0, "")


def test_what_needs_another_system_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    need_posix("this command")
    with pytest.raises(ConfigError, match=r"darwin: this command works on Linux only \(use Linux"):
        need_linux("this command")


def test_a_command_of_linux_ends_with_2_elsewhere_and_has_done_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ran = []

    @shell_command(needs="linux")
    def command() -> int:
        ran.append(True)
        return 0

    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(Exit) as ended:
        command(debug=False)
    assert (ended.value.exit_code, ran) == (2, [])
    assert "works on Linux only" in capsys.readouterr().err


def test_a_mode_shows_who_else_may_read() -> None:
    assert seen_by_others(0o640)
    assert seen_by_others(0o602)
    assert not seen_by_others(0o600)


def test_a_user_is_a_number_here() -> None:
    assert user_id().isdecimal()
