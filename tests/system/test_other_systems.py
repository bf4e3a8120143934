"""What works on every operating system, run by code that sees Windows: its names, and none of the modules of POSIX.

It is an imitation: only fullswarm's own files see it, and no system call behaves as there.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import urllib.request
from pathlib import Path

WINDOWS = r"""
import builtins, errno, os, select, signal, socket, sys, time, types

MODULES = {"fcntl", "grp", "pty", "pwd", "readline", "resource", "termios", "tty"}
MISSING = {
    os: "getuid geteuid getgid setsid killpg getpgrp tcgetpgrp fork uname getloadavg sysconf fdatasync pread pwrite"
    " pipe2 openpty ttyname set_blocking eventfd posix_fadvise O_CLOEXEC O_DIRECTORY O_NOFOLLOW O_NOCTTY O_NONBLOCK",
    signal: "SIGHUP SIGKILL SIGSTOP SIGCONT SIGUSR1 SIGUSR2 SIGALRM pthread_sigmask",
    errno: "EREMOTEIO ENOMEDIUM",
    select: "poll epoll POLLIN POLLOUT PIPE_BUF",
    socket: "AF_UNIX TCP_USER_TIMEOUT MSG_DONTWAIT SOCK_CLOEXEC SOCK_SEQPACKET SO_REUSEPORT",
    sys: "",
    time: "clock_gettime CLOCK_BOOTTIME CLOCK_MONOTONIC",
}
OTHERWISE = {(os, "name"): "nt", (sys, "platform"): "win32"}

def as_there(real):
    missing = set(MISSING[real].split())

    class Module(types.ModuleType):
        def __getattribute__(self, name):
            if name in missing:
                raise AttributeError(f"module {real.__name__!r} has no attribute {name!r} there", name=name)
            return OTHERWISE.get((real, name)) or getattr(real, name)

        def __setattr__(self, name, value):
            setattr(real, name, value)

    return Module(real.__name__)

THERE = {real.__name__: as_there(real) for real in MISSING}
imported = builtins.__import__

def import_(name, globals=None, locals=None, fromlist=(), level=0):
    # The standard library and other packages have ways of their own on each system; they see this one.
    asks = (globals or {}).get("__name__", "")
    if level == 0 and (asks == "fullswarm" or asks.startswith("fullswarm.")):
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}, which {asks} imports", name=name)
        if name in THERE:
            return THERE[name]
    return imported(name, globals, locals, fromlist, level)

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


def there(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python in `folder`, where fullswarm's own files see Windows."""
    (folder / "sitecustomize.py").write_text(WINDOWS)
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(folder), "NUMBA_DISABLE_JIT": "1"},
        capture_output=True, text=True, timeout=120.0, check=False,
    )  # fmt: skip


def test_operators_commands_the_console_and_replay_import_there(tmp_path: Path) -> None:
    done = there(tmp_path, "-c", EVERYWHERE)
    assert (done.returncode, done.stderr.splitlines()[-1:]) == (0, [])


def test_a_command_that_needs_posix_says_so_and_ends_with_2(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text("[fleet]\ncount = 1\n")
    for words in (("up", "lab.toml"), ("hub",), ("demo", "--headless", "--seconds", "5"), ("rehearse",)):
        done = there(tmp_path, "-m", "fullswarm", *words)
        assert (done.returncode, done.stdout) == (2, "")
        assert "does not work on this operating system" in done.stderr
        assert "WSL 2" in done.stderr


def test_the_console_serves_its_page_there(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(WINDOWS)
    process = subprocess.Popen(
        [sys.executable, "-m", "fullswarm", "console", "--listen", "127.0.0.1:0", "--hub", "tcp/127.0.0.1:9", "--json"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(tmp_path)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        url = json.loads(process.stdout.readline())["url"]
        with urllib.request.urlopen(url.partition("#")[0], timeout=10) as answer:
            assert b"<html" in answer.read()
    finally:
        process.terminate()
        process.communicate(timeout=20)


def test_a_demo_in_lockstep_runs_there(tmp_path: Path) -> None:
    done = there(tmp_path, "-m", "fullswarm", "demo", "--lockstep", "--seconds", "5", "--json")
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["robots"]) == 8


def test_help_and_an_experiment_in_spawned_processes_run_there(tmp_path: Path) -> None:
    shown = there(tmp_path, "-m", "fullswarm", "--help")
    assert (shown.returncode, shown.stderr) == (0, "")
    cell = ("--seeds", "0", "--cells", "behaviour=move_to_goal_bc,scenario=empty,robots=8", "--json", "--jobs", "1")
    done = there(tmp_path, "-m", "fullswarm", "experiment", "run", "paper", "--small", *cell)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["trials_done"] == 1
