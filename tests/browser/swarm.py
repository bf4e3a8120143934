"""`fullswarm demo` as its user starts it, and an observer on its bus: the page is checked against that."""

from __future__ import annotations

import json
import math
import os
import queue
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.keys import Keys
from fullswarm.messages import RobotHealth
from fullswarm.operator.client import Operator
from fullswarm.operator.view import FleetView, RobotRow
from fullswarm.runtime import Runtime

START_S = 90.0
"""Generous: a dozen interpreters start at once on a machine that may have other work."""
OTHER = "berta@lab"


class Demo:
    """The process and its children; `address` is the page's.

    Parameters
    ----------
    folder : the shell's; None: the one of the tests
    """

    def __init__(self, *options: str, folder: Path | None = None) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fullswarm", "demo", "--stay", "--no-open", *options],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=folder,
        )  # fmt: skip
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()
        self.said = ""
        self.hub = self.tells(r"FULLSWARM_HUB=(\S+)")
        self.address = self.tells(r"(http://\S+#token=\S+)")

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self._lines.put(line)

    def tells(self, pattern: str, timeout_s: float = START_S) -> str:
        """Wait until it has said `pattern`; return its first group, or all of it."""
        deadline_s = MonotonicClock().now_s() + timeout_s
        while (found := re.search(pattern, self.said)) is None:
            try:
                self.said += self._lines.get(timeout=max(0.0, deadline_s - MonotonicClock().now_s()))
            except queue.Empty:
                raise AssertionError(f"the demo never said {pattern!r}, but:\n{self.said}") from None
        return found[found.re.groups and 1]

    def child(self, *words: str) -> psutil.Process:
        """Return the process that `fullswarm WORDS` runs in."""
        for each in psutil.Process(self.process.pid).children():
            if each.cmdline()[2 : 3 + len(words)] == ["fullswarm", *words]:
                return each
        raise AssertionError(f"the demo has no process '{' '.join(words)}'")

    @contextmanager
    def other_operator(self, *command: str) -> Iterator[None]:
        """Run a command of an operator called `OTHER` meanwhile."""
        environment = {**os.environ, "FULLSWARM_HUB": self.hub, "FULLSWARM_OPERATOR": OTHER}
        with subprocess.Popen(
            [sys.executable, "-m", "fullswarm", *command], env=environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        ) as process:  # fmt: skip
            try:
                yield
            finally:
                process.terminate()

    @contextmanager
    def read_only_console(self) -> Iterator[str]:
        """Run a second console that may only show; give its address."""
        command = ["console", "--read-only", "--json", "--listen", "127.0.0.1:0", "--hub", self.hub]
        with subprocess.Popen(
            [sys.executable, "-m", "fullswarm", *command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        ) as process:
            assert process.stdout is not None
            try:
                yield json.loads(process.stdout.readline())["url"]
            finally:
                process.terminate()

    def hold_restarts(self, hold: bool) -> None:
        """Keep the demo from restarting ended processes, as on a machine without a supervisor."""
        self.process.send_signal(signal.SIGSTOP if hold else signal.SIGCONT)

    def close(self) -> None:
        self.process.send_signal(signal.SIGCONT)
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(30.0)
        finally:
            for each in psutil.Process(self.process.pid).children() if self.process.poll() is None else ():
                each.kill()
            self.process.kill()
            self.process.wait()
            if self.process.stderr is not None:
                self.process.stderr.close()


class Observer:
    """Receives the swarm's messages itself, independent of the page. It serves the bus only while it waits."""

    def __init__(self, hub: str) -> None:
        self.runtime = Runtime(MonotonicClock())
        self.bus = ZenohBus(self.runtime.mailbox, hub=hub)
        keys = Keys("swarm")
        self.view = FleetView(self.bus, keys, self.runtime)
        self.operator = Operator(self.bus, keys, self.runtime, f"observer:{os.getpid()}")

    def until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> float:
        """Listen until `condition` holds; return how long that took, in s."""
        began_s = self.runtime.now_s()

        def check() -> None:
            if condition() or self.runtime.now_s() - began_s > timeout_s:
                timer.cancel()
                self.runtime.pause()

        timer = self.runtime.every(0.005, check, first_s=0.0)
        self.runtime.run()
        took_s = self.runtime.now_s() - began_s
        assert condition(), f"waited {took_s:.1f} s for: {what}\n" + "\n".join(map(str, self.view.snapshot().robots))
        return took_s

    def rest(self, seconds: float) -> None:
        """Listen for a while: what must not happen gets the time to happen."""
        self.runtime.run(seconds)

    def fresh(self) -> Observer:
        """Hear what has come meanwhile: it listens only while it waits."""
        self.rest(0.3)
        return self

    def rows(self, robots: Iterable[str] = ()) -> list[RobotRow]:
        wanted = set(robots)
        return [row for row in self.view.snapshot().robots if not wanted or row.robot in wanted]

    def healths(self, robots: Iterable[str] = ()) -> list[RobotHealth]:
        return [row.health for row in self.rows(robots) if row.health is not None]

    def places(self, robots: Iterable[str] = ()) -> dict[str, tuple[float, float]]:
        """Return where each robot is, m."""
        return {row.robot: (row.x_m, row.y_m) for row in self.rows(robots)}

    def stand(self, robots: Iterable[str] = ()) -> bool:
        return all(abs(row.speed_m_s) < 0.005 for row in self.rows(robots))

    def all_stand_with(self, behaviour: str) -> bool:
        return all(health.behaviour == behaviour for health in self.healths()) and self.stand()

    def is_calm(self) -> bool:
        """Whether all eight stand, want nothing and are free of e-stops."""
        free = not any(health.estop for health in self.healths())
        return len(self.healths()) == 8 and free and self.all_stand_with("")

    def all_run(self, behaviour: str) -> bool:
        return all(health.behaviour == behaviour for health in self.healths())

    def close(self) -> None:
        self.operator.close()
        self.view.close()
        self.bus.close()


def far(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Return the distance of two points, m."""
    return math.hypot(one[0] - other[0], one[1] - other[1])
