"""Runs `fullswarm up` for a long time and measures what grows.

``python -m benchmarks.soak [--robots 16] [--minutes 30] [--warm-up 42] [--series FILE]``: simulated robots, a console
with a page connected, and an operator that sends a request each second. Every ten seconds memory, file descriptors and
threads of all processes and the bytes of databases and logs are read. Prints their slopes, by least squares, beside the
level: what is flat has a slope near zero.

What is bounded grows until its bound, so that is reached first. The console keeps frames of 30 minutes and samples of
40 for those who look back, the core the last 8,192 requests: a warm-up of 42 minutes with four requests a second fills
all. With a shorter one the table shows how these fill. The audit log keeps each request, up to a bound; it has no limit
here. Exit code 1 if a process ended, or if any slope is above `LIMITS`. ``--series`` keeps all samples as JSON, with
those of the warm-up, to plot.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.network import on_free_ports
from fullswarm.launch.processes import STATE
from fullswarm.messages import RequestStatus, Value
from fullswarm.operator.client import Operator
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Mailbox, Runtime

SAMPLE_S = 10.0
WARM_UP_HZ, HZ = 4.0, 1.0
"""Requests."""
READY_S = 120.0
ANSWERED_S = 10.0
MB = 2.0**20
LIMITS = {"memory MB": 2.0, "descriptors": 1.0, "threads": 0.5, "databases kB": 500.0, "logs kB": 100.0}
"""Per hour, for each process or all files: above the noise of half an hour, below what would matter in a day."""


class Samples:
    """Time series by name."""

    def __init__(self) -> None:
        self.times_s: list[float] = []
        self.values: dict[tuple[str, str], list[float]] = defaultdict(list)
        self.warm_s = math.inf

    def take(self, root: psutil.Process, *folders: Path) -> None:
        """Read all processes below `root`, itself included, and the files in the folders."""
        self.times_s.append(time.monotonic())
        for process in (root, *root.children(recursive=True)):
            with contextlib.suppress(psutil.NoSuchProcess):
                name = _name(process.cmdline())
                if name == "spare":  # they wait, and come and go
                    continue
                self.values["memory MB", name].append(process.memory_info().rss / MB)
                self.values["descriptors", name].append(process.num_fds())
                self.values["threads", name].append(process.num_threads())
        files = [each for folder in folders for each in folder.rglob("*") if each.is_file()]
        databases = [each for each in files if ".db" in each.name]
        audit = [each for each in files if "audit" in each.parts]
        logs = [each for each in files if each not in audit and (".log" in each.name or ".out" in each.name)]
        self.values["databases kB", "all"].append(sum(each.stat().st_size for each in databases) / 1024)
        self.values["logs kB", "all"].append(sum(each.stat().st_size for each in logs) / 1024)
        self.values["audit kB", "all"].append(sum(each.stat().st_size for each in audit) / 1024)

    def save(self, file: Path) -> None:
        """Write all series as JSON: the times in seconds, and a list of values for each quantity and process."""
        series = {f"{what} of {name}": values for (what, name), values in self.values.items()}
        file.write_text(json.dumps({"times_s": self.times_s, "series": series}))

    def slopes(self) -> Iterator[tuple[str, str, float, float, int]]:
        """Yield what, of which, the last level, the slope per hour since `warm_s`, and how many values in all."""
        for (what, name), values in sorted(self.values.items()):
            times_s = np.array(self.times_s[-len(values) :])
            late = times_s >= self.warm_s
            slope = math.nan
            if late.sum() > 2:
                slope = float(np.polyfit((times_s[late] - self.warm_s) / 3600.0, np.array(values)[late], 1)[0])
            yield what, name, values[-1], slope, len(values)


def _processes(root: psutil.Process) -> int:
    """Return how many there are, but for the spare ones, which come and go."""
    return sum(_name(each.cmdline()) != "spare" for each in root.children(recursive=True))


def _name(command: list[str]) -> str:
    """Return what a process is, e.g. ``agent r1`` or ``core``."""
    words = command[command.index("fullswarm") + 1 :] if "fullswarm" in command else command[-1:]
    first = words[0] if words else "?"
    return f"{first} {words[1]}" if first == "agent" else first


class Page:
    """A page that reads all that the console sends, as a browser does."""

    def __init__(self, address: str) -> None:
        token = address.partition("#token=")[2]
        host = address.partition("//")[2].partition("/")[0]
        self.frames = 0
        origin: Any = f"http://{host}"
        self._open = contextlib.ExitStack()
        self._socket = self._open.enter_context(connect(f"ws://{host}/ws", origin=origin, max_size=None, proxy=None))
        self._socket.send(json.dumps({"t": "hello", "token": token, "session": "soak-session-1", "name": "soak"}))
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            for _ in self._socket:
                self.frames += 1

    def close(self) -> None:
        """Leave."""
        self._open.close()


class Requester:
    """Sends a request each second and counts answers."""

    def __init__(self, config: SwarmConfig) -> None:
        self.runtime = Runtime(MonotonicClock(), Mailbox())
        self.bus = ZenohBus(self.runtime.mailbox, hub=config.hub.endpoint)
        self.view = FleetView(self.bus, Keys(config.swarm), self.runtime, config.robots)
        self.operator = Operator(self.bus, Keys(config.swarm), self.runtime, "soak")
        self._robots, self._bounds = config.robots, config.bounds_m
        self.sent = 0
        self.answered: set[str] = set()

    def ready(self) -> bool:
        """Whether all robots are."""
        rows = self.view.snapshot().robots
        return sum(row.health is not None and row.health.lifecycle in ("READY", "ACTIVE") for row in rows) == len(
            self._robots
        )

    def ask(self) -> None:
        """Send the next request: half of the robots in turn, goals that walk through the arena."""
        x_low, y_low, x_high, y_high = self._bounds
        turn = self.sent * 0.61803398875 % 1.0
        goal: list[float | list[float]] = [x_low + 2 + turn * (x_high - x_low - 4), 0.5 * (y_low + y_high)]
        parameters: dict[str, Value] = {"goal": goal}
        robots = self._robots[self.sent % 2 :: 2]
        self.operator.request("move_to_goal_bc", robots, parameters, self._status)
        self.sent += 1

    def _status(self, status: RequestStatus) -> None:
        self.answered.add(status.request_id)

    def close(self) -> None:
        """Leave the swarm."""
        self.view.close()
        self.operator.close()
        self.bus.close()


def soak(robots: int, minutes: float, warm_up_minutes: float, series: Path | None = None) -> int:
    """Run once; print the table; return the exit code."""
    config = on_free_ports(
        SwarmConfig.model_validate({"robot": [{"id": f"r{k + 1}"} for k in range(robots)]}), prefer_configured=False
    )
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "fleet.toml"
        file.write_text(
            f'[hub]\nendpoint = "{config.hub.endpoint}"\n[world]\naddress = "{config.world_or_default.address}"\n'
            f"bounds_m = [0, 0, 30, 30]\n[fleet]\ncount = {robots}\n"
        )
        stderr = (Path(scratch) / "up.err").open("w+")
        state = Path(scratch) / "state"
        process = subprocess.Popen(
            [sys.executable, "-m", "fullswarm", "up", str(file), "--console"],
            stderr=stderr,
            stdout=stderr,
            env={**os.environ, STATE: str(state)},
        )
        requester = Requester(config)
        samples, page = Samples(), None
        try:
            began_s = time.monotonic()
            while not requester.ready():
                requester.runtime.run(0.2)
                if time.monotonic() - began_s > READY_S or process.poll() is not None:
                    print(Path(stderr.name).read_text(), "\nnot ready")
                    return 1
            text = Path(stderr.name).read_text()
            address = re.search(r"http://\S+#token=\S+", text)
            folder = re.search(r"logs in (\S+?);", text)
            if address is None or folder is None:
                print(text, "\nno console, or no folder")
                return 1
            page = Page(address.group())
            root = psutil.Process(process.pid)
            count = _processes(root)
            for rate_hz, for_minutes in ((WARM_UP_HZ, warm_up_minutes), (HZ, minutes)):
                timer = requester.runtime.every(1.0 / rate_hz, requester.ask)
                samples.warm_s = time.monotonic()
                end_s = samples.warm_s + 60.0 * for_minutes
                while time.monotonic() < end_s and process.poll() is None:
                    requester.runtime.run(SAMPLE_S)
                    samples.take(root, Path(folder.group(1)), state)
                timer.cancel()
            if series is not None:
                samples.save(series)
            requester.runtime.run(ANSWERED_S)
            alive = _processes(root) if process.poll() is None else 0
            return report(samples, requester, page, robots, minutes, ended=count - alive)
        finally:
            if page is not None:
                page.close()
            requester.close()
            process.send_signal(signal.SIGINT)
            process.wait(30.0)
            stderr.close()


def report(samples: Samples, requester: Requester, page: Page, robots: int, minutes: float, *, ended: int) -> int:
    """Print levels and slopes; return the exit code."""
    print(f"{robots} robots, {minutes:g} min: {requester.sent} requests, {len(requester.answered)} answered, "
          f"{page.frames} frames to the page; {ended} processes ended")  # fmt: skip
    print(f"\n{'what':16}{'of':16}{'level':>10}{'per hour':>12}")
    bad = []
    agents: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for what, name, level, slope, number in samples.slopes():
        if number < len(samples.times_s):
            bad.append(f"{name} did not live from the beginning to the end")
        if slope > LIMITS.get(what, math.inf):
            bad.append(f"{what} of {name} grow by {slope:.2f} per hour (limit {LIMITS[what]:g})")
        if name.startswith("agent "):
            agents[what].append((level, slope))
        else:
            print(f"{what:16}{name:16}{level:10.1f}{slope:12.2f}")
    for what, pairs in agents.items():
        level, slope = max(each[0] for each in pairs), max(each[1] for each in pairs)
        print(f"{what:16}{'worst agent':16}{level:10.1f}{slope:12.2f}")
    if len(requester.answered) < requester.sent - 1:
        bad.append(f"{requester.sent - len(requester.answered)} requests without an answer")
    if ended:
        bad.append(f"{ended} processes ended")
    print("\n" + ("\n".join(dict.fromkeys(bad)) if bad else "flat"))
    return 1 if bad else 0


def main() -> int:
    """Read the options and run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--warm-up", type=float, default=42.0, help="minutes")
    parser.add_argument("--series", type=Path, help="write all samples there as JSON")
    options = parser.parse_args()
    return soak(options.robots, options.minutes, options.warm_up, options.series)


if __name__ == "__main__":
    sys.exit(main())
