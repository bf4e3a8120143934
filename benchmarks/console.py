"""What a page costs the console: processor, frames and bytes, beside a bare server that sends the same bytes.

``python -m benchmarks.console [--robots 32 100] [--clients 1 2 4] [--seconds 5] [--json]``. A hub and the console are
processes of their own; this one plays the robots (states at 20 Hz, health at 2 Hz) and the core's heartbeat, another
one the pages, which read and forget. The cost of a client is that of n clients less that of none. The reference is a
`websockets` server in a process of its own that sends the frames recorded from the console to as many clients at the
same rate. Target: under 10 % of a core per client with 32 robots.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import multiprocessing
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from typing import Any

import psutil

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.keys import Keys
from fullswarm.launch.network import free_port
from fullswarm.launch.processes import PARENT
from fullswarm.messages import HealthReport, Heartbeat, RobotHealth, RobotStates
from fullswarm.runtime import Mailbox, Runtime

TARGET = 0.10
SEEN = 0.001
STATE_HZ, HEALTH_HZ, BEAT_HZ = 20.0, 2.0, 10.0
MOST_HOSTS, PER_HOST = 100, 50
SETTLE_S = 1.5
START_S = 60.0  # generous: the machine may have other work


@dataclass
class Row:
    """One measurement; shares of one core."""

    robots: int
    clients: int
    console: float  # processor of the whole console
    per_client: float  # less that without clients
    bare_per_client: float  # of the bare server
    frames_hz: float  # received by each client
    bytes_hz: float


class Swarm:
    """Robots that only talk: each a host of its own, as on a real swarm; of more than 100, 50 are one host's."""

    def __init__(self, robots: int, hub: str) -> None:
        self.runtime = Runtime(MonotonicClock(), Mailbox())
        self._bus, self._keys = ZenohBus(self.runtime.mailbox, hub=hub), Keys("console-bench")
        self._bus.wait_connected(START_S)
        each = 1 if robots <= MOST_HOSTS else PER_HOST
        self._hosts = [range(first, min(first + each, robots)) for first in range(0, robots, each)]
        self._side = max(10, math.ceil(math.sqrt(robots)))
        self._sequence = 0
        self.runtime.every(1.0 / STATE_HZ, self._states)
        self.runtime.every(1.0 / HEALTH_HZ, self._health)
        self.runtime.every(1.0 / BEAT_HZ, self._beat)

    def _states(self) -> None:
        self._sequence += 1
        now_s = self.runtime.now_s()
        side = self._side
        for numbers in self._hosts:
            host, count = f"r{numbers[0]}", len(numbers)
            message = RobotStates(
                host=host, sequence=self._sequence, stamp_s=now_s, robots=tuple(f"r{each}" for each in numbers),
                x_m=tuple((now_s * 0.3 + each // side) % side for each in numbers),
                y_m=tuple(float(each % side) for each in numbers),
                heading_rad=tuple(math.remainder(0.1 * each, 2.0 * math.pi) for each in numbers),
                speed_m_s=(0.3,) * count, turn_rad_s=(0.0,) * count, radius_m=(0.17,) * count,
            )  # fmt: skip
            self._bus.publish(self._keys.state("all", host), message)

    def _health(self) -> None:
        for numbers in self._hosts:
            healths = tuple(
                RobotHealth(
                    robot=f"r{each}", driver=f"sim://r{each}", make="sim", model="disc", firmware="1",
                    lifecycle="ACTIVE", behaviour="flocking_bc", request_id="0123456789ab", moving=True, battery=0.8,
                    pose_source="driver",
                )
                for each in numbers
            )  # fmt: skip
            message = HealthReport(host=f"r{numbers[0]}", process="p", version="0.1.0", robots=healths)
            self._bus.publish(self._keys.health(f"r{numbers[0]}"), message)

    def _beat(self) -> None:
        self._bus.publish(self._keys.heartbeat("core"), Heartbeat(node="core", process="core-1", sequence=1))

    def close(self) -> None:
        """Say nothing more."""
        self._bus.close()


# ---------------------------------------------------------------- pages, in a process of their own
def pages(url: str, count: int, seconds: float, record: bool, answer: Connection) -> None:
    """Open `count` pages, tell when all are greeted, read for `seconds`, tell how much came."""
    asyncio.run(_pages(url, count, seconds, record, answer))


async def _pages(url: str, count: int, seconds: float, record: bool, answer: Connection) -> None:
    import websockets
    from websockets.typing import Origin

    origin, _, token = url.partition("/#token=")
    tallies = [[0, 0] for _ in range(count)]
    recorded: list[tuple[float, str]] = []
    counting = asyncio.Event()

    async def read(line: Any, number: int) -> None:
        async for text in line:
            if counting.is_set():
                tallies[number][0] += 1
                tallies[number][1] += len(text)
                if record and number == 0:
                    recorded.append((time.monotonic(), text))

    address = origin.replace("http", "ws") + "/ws"
    tasks = []
    async with AsyncExitStack() as stack:
        for number in range(count):
            line = await stack.enter_async_context(
                websockets.connect(address, origin=Origin(origin), max_size=None, compression=None, proxy=None)
            )
            hello = {"t": "hello", "token": token, "session": f"session-{number}"}
            await line.send(json.dumps(hello))
            tasks.append(asyncio.create_task(read(line, number)))
        await asyncio.sleep(SETTLE_S)
        counting.set()
        answer.send("ready")
        await asyncio.sleep(seconds)
        counting.clear()
        for task in tasks:
            task.cancel()
    answer.send((tallies, recorded))


# ---------------------------------------------------------------- the reference
def bare(recorded: list[tuple[float, str]], port: int) -> None:
    """Serve the recorded frames, each at its time, over and over, to whoever comes."""
    asyncio.run(_bare(recorded, port))


async def _bare(recorded: list[tuple[float, str]], port: int) -> None:
    from websockets.asyncio.server import ServerConnection, broadcast, serve

    lines: set[ServerConnection] = set()

    async def welcome(line: ServerConnection) -> None:
        lines.add(line)
        try:
            await line.wait_closed()
        finally:
            lines.discard(line)

    async with serve(welcome, "127.0.0.1", port, compression=None):
        while True:
            began_s, first_s = time.monotonic(), recorded[0][0]
            for at_s, text in recorded:
                wait_s = began_s + (at_s - first_s) - time.monotonic()
                if wait_s > 0.0:
                    await asyncio.sleep(wait_s)
                broadcast(lines, text)


# ---------------------------------------------------------------- measuring
class Bench:
    """Hub, console and robots."""

    def __init__(self, robots: int) -> None:
        hub = f"tcp/127.0.0.1:{free_port(0)}"
        environment = {**os.environ, PARENT: str(os.getpid())}
        start = [sys.executable, "-m", "fullswarm"]
        self._hub = subprocess.Popen([*start, "hub", "--listen", hub, "--with-parent"], env=environment)
        self.robots, self.swarm = robots, Swarm(robots, hub)
        self._console = subprocess.Popen(
            [*start, "console", "--listen", "127.0.0.1:0", "--json", "--hub", hub, "--swarm", "console-bench",
             "--with-parent"],
            env=environment, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._console.stdout is not None
        self.url = str(json.loads(self._console.stdout.readline())["url"])
        self.swarm.runtime.run(SETTLE_S)

    def console(self, clients: int, seconds: float, record: bool = False) -> tuple[float, Any, Any]:
        """Return the console's share of a core with so many clients, and what they got."""
        if clients == 0:
            return self._share(self._console.pid, seconds), [], []
        with self._pages(self.url, clients, seconds, record) as answer:
            share = self._share(self._console.pid, seconds)
            tallies, recorded = answer.recv()
        return share, tallies, recorded

    def bare(self, recorded: list[tuple[float, str]], clients: int, seconds: float) -> float:
        """Return the share of a core that a bare server needs for the same frames."""
        port = free_port(0)
        server = multiprocessing.get_context("spawn").Process(target=bare, args=(recorded, port), daemon=True)
        server.start()
        try:
            assert server.pid is not None
            self._wait_for(port)
            if clients == 0:
                return self._share(server.pid, seconds)
            with self._pages(f"http://127.0.0.1:{port}/#token=x", clients, seconds, False) as answer:
                share = self._share(server.pid, seconds)
                answer.recv()
            return share
        finally:
            server.kill()
            server.join()

    @contextmanager
    def _pages(self, url: str, count: int, seconds: float, record: bool) -> Iterator[Connection]:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        process = context.Process(target=pages, args=(url, count, seconds, record, there), daemon=True)
        process.start()
        try:
            while not here.poll():
                self.swarm.runtime.run(0.05)
            here.recv()
            yield here
        finally:
            process.join()

    def _share(self, pid: int, seconds: float) -> float:
        process = psutil.Process(pid)
        began_s, before = time.monotonic(), process.cpu_times()
        self.swarm.runtime.run(seconds)
        after, took_s = process.cpu_times(), time.monotonic() - began_s
        return (after.user + after.system - before.user - before.system) / took_s

    def _wait_for(self, port: int) -> None:
        for _ in range(200):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    return
            self.swarm.runtime.run(0.05)
        raise SystemExit("the bare server did not start")

    def close(self) -> None:
        """End all processes."""
        self.swarm.close()
        for process in (self._console, self._hub):
            process.terminate()
            process.wait()


def measure(robots: int, clients: list[int], seconds: float) -> list[Row]:
    """Return a row per number of clients."""
    bench = Bench(robots)
    try:
        idle, _, _ = bench.console(0, seconds)
        rows = []
        for count in clients:
            share, tallies, recorded = bench.console(count, seconds, record=True)
            bare_idle = bench.bare(recorded, 0, seconds)
            bare_share = bench.bare(recorded, count, seconds)
            rows.append(
                Row(
                    robots,
                    count,
                    share,
                    (share - idle) / count,
                    (bare_share - bare_idle) / count,
                    sum(tally[0] for tally in tallies) / count / seconds,
                    sum(tally[1] for tally in tallies) / count / seconds,
                )
            )
        return rows
    finally:
        bench.close()


def main() -> int:
    """Print the rows; return 1 when a client costs too much."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, nargs="+", default=[32, 100])
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = [row for robots in options.robots for row in measure(robots, options.clients, options.seconds)]
    if options.json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
    else:
        print("robots clients  console  per client  bare, per client  ratio  frames/s    kB/s")
        for row in rows:
            # A server that costs less than the clock ticks of so short a run can show is no reference.
            seen = row.bare_per_client > SEEN
            ratio = f"{row.per_client / row.bare_per_client:.1f}" if seen else "-"
            print(
                f"{row.robots:6d} {row.clients:7d} {row.console:8.1%} {row.per_client:11.1%} "
                f"{row.bare_per_client:17.1%} {ratio:>6} {row.frames_hz:9.1f} {row.bytes_hz / 1000:7.1f}"
            )
    dear = [row for row in rows if row.robots <= 32 and row.per_client > TARGET]
    return 1 if dear else 0


if __name__ == "__main__":
    sys.exit(main())
