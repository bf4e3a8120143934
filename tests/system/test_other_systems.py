"""What works on every operating system, run without the modules that only some have."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

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
import fullswarm.cli.main, fullswarm.evaluate.results.report, fullswarm.exporter.serve, fullswarm.lab
import fullswarm.operator.console.serve, fullswarm.operator.joystick.pilot, fullswarm.operator.swarm
import fullswarm.record.replay, fullswarm.testing
from fullswarm import AsyncSwarm, Lab, Swarm
"""
"""What the commands import that are to work with a hub elsewhere; the others run below."""


def without(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python in `folder` where fullswarm's own files cannot import modules of POSIX."""
    (folder / "sitecustomize.py").write_text(WITHOUT)
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(folder), "NUMBA_DISABLE_JIT": "1"},
        capture_output=True, text=True, timeout=120.0, check=False,
    )  # fmt: skip


def test_operators_commands_the_console_and_replay_import_without_them(tmp_path: Path) -> None:
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
