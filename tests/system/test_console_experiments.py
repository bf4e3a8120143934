"""Experiments that a console runs, with real processes: stopped and continued, ended with a console that is killed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import psutil
from websockets.sync.client import connect
from websockets.typing import Origin

from fullswarm.clock import MonotonicClock
from tests.waiting import until

FILE = """
name = "many"
seeds = "0-199"
[limits.create]
speed_limit_m_s = 0.5
turn_limit_rad_s = 4.25
[[groups]]
name = "g"
behaviours = [{ name = "move_to_goal_bc" }]
scenarios = ["empty"]
robots = [2]
engines = ["kinematic"]
limits = ["create"]
time_limit_s = 10.0
"""
START_S, END_S = 120.0, 15.0
"""A machine with other work starts a worker in half a minute."""


class Page:
    """A console without a swarm, and a page of it."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-m", "fullswarm", "console", "--listen", "127.0.0.1:0", "--json"]
        hub = ["--hub", "tcp/127.0.0.1:1", "--experiments", str(folder)]  # nothing listens there, which it bears
        self.process = subprocess.Popen(
            [*command, *hub], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )  # fmt: skip
        assert self.process.stdout is not None
        origin, _, token = json.loads(self.process.stdout.readline())["url"].partition("/#token=")
        self.stack, self.ref = ExitStack(), 0
        self.frames: dict[str, dict[str, Any]] = {}
        self.line = self.stack.enter_context(
            connect(origin.replace("http", "ws") + "/ws", origin=Origin(origin), max_size=None, proxy=None)
        )
        self.line.send(json.dumps({"t": "hello", "token": token, "session": "session-1", "name": "anna"}))

    def read(self) -> None:
        while True:
            try:
                frame = json.loads(self.line.recv(timeout=0.0))
            except TimeoutError:
                return
            self.frames[frame["t"]] = frame

    def until(self, condition: Callable[[], bool], what: str, limit_s: float) -> None:
        until(condition, limit_s, lambda: f"{what}: {self.frames.get('experiment_list')}", each=self.read)

    def say(self, op: str, **fields: Any) -> str:
        self.ref += 1
        self.line.send(json.dumps({"t": "experiment", "op": op, "ref": self.ref, **fields}))
        self.until(lambda: self.frames.get("answer", {}).get("ref") == self.ref, f"an answer to {op}", 20.0)
        return str(self.frames["answer"]["reason"])

    @property
    def many(self) -> dict[str, Any]:
        entries = self.frames.get("experiment_list", {}).get("entries") or ()
        return next((each for each in entries if each["id"] == "file:many.toml"), {})

    @property
    def finished(self) -> int:
        return int((self.many.get("results") or {}).get("finished", 0))


def below(process: subprocess.Popen[str]) -> list[psutil.Process]:
    return psutil.Process(process.pid).children(recursive=True)


def test_it_is_stopped_continued_and_ends_with_a_console_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "many.toml").write_text(FILE)
    page = Page(tmp_path)
    try:
        assert page.say("watch") == ""
        page.until(lambda: bool(page.many), "the list", START_S)
        assert page.say("start", id="file:many.toml", small=False) == ""
        page.until(lambda: page.finished >= 1, "a trial has ended", START_S)
        run = [each for each in below(page.process) if "run" in each.cmdline()[3:6]]
        assert run
        assert all(each.nice() >= min(19, psutil.Process().nice() + 10) for each in run)
        assert page.say("stop", id="file:many.toml") == ""
        page.until(lambda: page.many["state"] == "stopped", "it is stopped", END_S)
        kept = len(list((tmp_path / "many" / "trials").glob("*/result.json")))
        assert 1 <= kept < 200
        assert not any(each.is_running() for each in run)

        assert page.say("start", id="file:many.toml", small=False) == ""
        page.until(lambda: page.finished > kept, "it goes on", START_S)
        left = below(page.process)
        assert any("run" in each.cmdline()[3:6] for each in left)
        page.process.kill()
        page.process.wait()
        began_s = MonotonicClock().now_s()
        gone, alive = psutil.wait_procs(left, END_S)
        assert not alive, f"after {MonotonicClock().now_s() - began_s:.1f} s: {alive}"
        assert gone
    finally:
        page.stack.close()
        for each in below(page.process) if page.process.poll() is None else ():
            each.kill()
        page.process.kill()
        page.process.wait()
        if page.process.stdout is not None:
            page.process.stdout.close()
