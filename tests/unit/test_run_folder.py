"""Folders of a run: for this user only, removed at the end and after a crash; logs of bounded length."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from fullswarm.config import SwarmConfig
from fullswarm.errors import ConfigError
from fullswarm.launch.network import port_folder
from fullswarm.launch.run_folder import KEPT, KEPT_S, RunFolder, bound_log, user_folder


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for temporary files of the test's own."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / f"fullswarm-{os.getuid()}"


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_folders_are_for_this_user_only_and_the_runs_is_removed(temporary: Path) -> None:
    old = os.umask(0)
    try:
        run = RunFolder()
    finally:
        os.umask(old)
    assert mode(temporary) == mode(run.path) == 0o700
    assert run.path.parent == temporary
    (run.path / "hub.log").write_text("x")
    run.close()
    run.close()
    assert list(temporary.iterdir()) == []
    assert port_folder(SwarmConfig()).parent == temporary


def test_link_is_refused(temporary: Path, tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir(mode=0o700)
    temporary.symlink_to(tmp_path / "theirs")
    with pytest.raises(ConfigError, match="is not a folder"):
        port_folder(SwarmConfig())
    with pytest.raises(ConfigError, match=str(temporary)):
        RunFolder()
    assert list((tmp_path / "theirs").iterdir()) == []


def test_folder_of_another_user_or_open_to_others_is_refused(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    temporary.mkdir()
    temporary.chmod(0o777)
    with pytest.raises(ConfigError, match="can be written by other users"):
        user_folder()
    temporary.chmod(0o755)  # an older version made it so
    assert mode(user_folder()) == 0o700
    owner = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    temporary.rename(temporary.with_name(f"fullswarm-{owner + 1}"))
    with pytest.raises(ConfigError, match="belongs to another user"):
        user_folder()


def test_folder_of_a_run_that_was_killed_is_removed_by_the_next(temporary: Path, tmp_path: Path) -> None:
    code = "import sys; from fullswarm.launch.run_folder import RunFolder\nrun = RunFolder()\n"
    code += "print(run.path, flush=True); sys.stdin.read()"
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True
    ) as process:
        assert process.stdout is not None
        left = Path(process.stdout.readline().strip())
        RunFolder().close()
        assert left.is_dir()  # its run goes on
        process.send_signal(signal.SIGKILL)
        process.wait()
    RunFolder().close()
    assert not left.exists()
    assert list(temporary.iterdir()) == []


def test_folder_that_an_error_names_stays_for_some_days(temporary: Path) -> None:
    run = RunFolder()
    run.keep()
    run.close()
    RunFolder().close()
    assert run.path.is_dir()
    old_s = (run.path / KEPT).stat().st_mtime - KEPT_S - 1.0
    os.utime(run.path / KEPT, (old_s, old_s))
    RunFolder().close()
    assert list(temporary.iterdir()) == []


def test_long_log_begins_anew_while_its_process_writes_on(tmp_path: Path) -> None:
    path = tmp_path / "r1.log"
    with path.open("ab", buffering=0) as file:  # as the supervisor hands it to a process
        file.write(b"x" * 1000 + b"\n")
        bound_log(path, 2000)
        assert path.stat().st_size == 1001
        bound_log(path, 1000)
        file.write(b"new\n")
        assert path.read_bytes() == b"new\n"
        assert (tmp_path / "r1.log.1").stat().st_size == 1001
        file.write(b"y" * 1000)
        bound_log(path, 1000)
    assert sorted(each.name for each in tmp_path.glob("r1*")) == ["r1.log", "r1.log.1"]
    assert (tmp_path / "r1.log.1").read_bytes().startswith(b"new\n")
    bound_log(tmp_path / "none.log", 1)
