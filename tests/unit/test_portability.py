"""What must work on every operating system imports no module that only some have; the rest says what it needs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fullswarm.portability import lock, need_linux, need_posix, seen_by_others

WITHOUT = """
import builtins, os, signal, sys, time
MODULES = {"fcntl", "grp", "msvcrt", "pty", "pwd", "readline", "resource", "termios", "tty"}
imported = builtins.__import__

def import_(name, globals=None, *rest, **more):
    # The standard library and other packages have ways of their own on each system; they keep these modules.
    asks = (globals or {}).get("__name__", "")
    if name.partition(".")[0] in MODULES and (asks == "fullswarm" or asks.startswith("fullswarm.")):
        raise ModuleNotFoundError(f"No module named {name!r}, which {asks} imports", name=name)
    return imported(name, globals, *rest, **more)

builtins.__import__ = import_
"""
"""Run by each Python of the test, also by processes that multiprocessing spawns: it is their ``sitecustomize``."""
EVERYWHERE = """
import importlib, pkgutil
import fullswarm
for parent in sorted({each.name for each in pkgutil.walk_packages(fullswarm.__path__, "fullswarm.")}):
    if not parent.endswith(("__main__", "_process", ".as_rps")):
        importlib.import_module(parent)
"""


def without(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python in `folder` where fullswarm's own files cannot import modules of POSIX."""
    (folder / "sitecustomize.py").write_text(WITHOUT)
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(folder), "NUMBA_DISABLE_JIT": "1"},
        capture_output=True, text=True, timeout=120.0, check=False,
    )  # fmt: skip


def test_every_module_imports_without_those_of_posix(tmp_path: Path) -> None:
    done = without(tmp_path, "-c", EVERYWHERE)
    assert (done.returncode, done.stderr.splitlines()[-1:]) == (0, [])


def test_the_block_blocks(tmp_path: Path) -> None:
    done = without(tmp_path, "-c", "from fullswarm.portability import lock; lock(1, wait=False)")
    assert "No module named 'fcntl', which fullswarm.portability imports" in done.stderr


def test_a_demo_in_lockstep_runs_without_them(tmp_path: Path) -> None:
    done = without(tmp_path, "-m", "fullswarm", "demo", "--lockstep", "--seconds", "5", "--json")
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["robots"]) == 8


def test_help_and_an_experiment_in_spawned_processes_run_without_them(tmp_path: Path) -> None:
    shown = without(tmp_path, "-m", "fullswarm", "--help")
    assert (shown.returncode, shown.stderr) == (0, "")
    cell = ("--seeds", "0", "--cells", "behaviour=move_to_goal_bc,scenario=empty,robots=8", "--json", "--jobs", "1")
    done = without(tmp_path, "-m", "fullswarm", "experiment", "run", "paper", "--small", *cell)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["trials_done"] == 1


def test_one_process_holds_a_lock_and_another_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "lock"
    attempt = "import sys, fullswarm.portability as each; each.lock(open(sys.argv[1], 'a').fileno(), wait=False)"
    with file.open("a") as opened:
        lock(opened.fileno(), wait=False)
        held = subprocess.run([sys.executable, "-c", attempt, file], capture_output=True, text=True, check=False)
    free = subprocess.run([sys.executable, "-c", attempt, file], capture_output=True, text=True, check=False)
    assert "BlockingIOError" in held.stderr
    assert (free.returncode, free.stderr) == (0, "")


def test_a_command_that_needs_another_system_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    from fullswarm.errors import ConfigError

    monkeypatch.setattr(sys, "platform", "darwin")
    need_posix("this command")
    with pytest.raises(ConfigError, match=r"darwin: this command works on Linux only \(use Linux"):
        need_linux("this command")


def test_a_mode_of_linux_shows_who_else_may_read() -> None:
    assert seen_by_others(0o640)
    assert seen_by_others(0o602)
    assert not seen_by_others(0o600)
