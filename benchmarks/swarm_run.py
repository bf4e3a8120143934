"""Runs one swarm of the swarm benchmark: starts its processes, waits until it is in full swing, measures, ends it."""

from __future__ import annotations

import contextlib
import json
import math
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.bus import free_endpoint
from benchmarks.swarm_agent import SWAY_M, senders_of
from benchmarks.swarm_meet import GRACE_S, Result, leave
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.config.fleet_file import write_swarm
from fullswarm.keys import Keys, cell_of, cells_within
from fullswarm.messages import BehaviourRequest, RequestStatus
from fullswarm.runtime import Mailbox, Runtime

AREA_PER_ROBOT_M2 = 20.0 * 20.0 / 32
"""The paper's density: 32 robots in 20 x 20 m."""
JITTER_M = 1.2
BORDER_M = SWAY_M + 0.05
SENSING_M = 3.0
SETTLE_S = 3.0
START_S = 120.0
BEHAVIOUR = "flocking_bc"


@dataclass(frozen=True)
class Figures:
    """What one swarm did within the window. CPU in % of one core; ages and lateness in ms."""

    kind: str
    robots: int
    senders_per_robot: float  # neighbours whose states a robot should get
    delivered: float  # share of the expected deliveries
    age_p50_ms: float
    age_p99_ms: float
    ticks: int
    late: float  # share of ticks more than 1 ms late
    missed: float  # share of periods skipped
    late_p99_ms: float
    cpu_per_robot: float
    cpu_hub: float
    cpu_core: float
    cpu_others: float  # of everything else on this machine
    tick_cpu_us: float
    rss_mb: float
    threads: float
    threads_cpu: dict[str, float] = field(default_factory=dict)  # mean over the robots, by the thread's name

    @property
    def cores(self) -> float:
        """All processes of the swarm together, in cores."""
        return (self.robots * self.cpu_per_robot + self.cpu_hub + self.cpu_core) / 100.0


def layout(count: int, rate_hz: float, control_hz: float, cell_m: float) -> SwarmConfig:
    """Return a fleet at the paper's density: a grid, shaken with a fixed seed; no robot is on a cell's border."""
    side_m = math.sqrt(count * AREA_PER_ROBOT_M2)
    columns = math.ceil(math.sqrt(count))
    spacing_m, chance = side_m / columns, random.Random(count)

    def place(index: int) -> float:
        at_m = (index + 0.5) * spacing_m + chance.uniform(-JITTER_M, JITTER_M)
        cell = math.floor(at_m / SENSING_M)
        return cell * SENSING_M + min(max(at_m - cell * SENSING_M, BORDER_M), SENSING_M - BORDER_M)

    return SwarmConfig.model_validate(
        {
            "hub": {"endpoint": free_endpoint()},
            "agent": {
                "control_rate_hz": control_hz,
                "state_rate_hz": rate_hz,
                "state_cell_m": cell_m,
                "sensing_radius_m": SENSING_M,
                "bounds_m": (0.0, 0.0, side_m, side_m),
            },
            "robot": [
                {
                    "id": f"r{number + 1}",
                    "driver": f"null://r{number + 1}",
                    "pose": (place(number % columns), place(number // columns), chance.uniform(-math.pi, math.pi)),
                }
                for number in range(count)
            ],
        }
    )


@contextlib.contextmanager
def children(folder: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Give a function that starts a Python process; all of them are gone when the context ends."""
    started: list[subprocess.Popen[bytes]] = []

    def start(*arguments: str) -> subprocess.Popen[bytes]:
        with (folder / "log.txt").open("ab") as log:
            # Ctrl-C must reach this process alone, which then ends them.
            child = subprocess.Popen([sys.executable, *arguments], stdout=log, stderr=log, start_new_session=True)
        started.append(child)
        return child

    try:
        yield start
    finally:
        for number, patience_s in ((signal.SIGTERM, 5.0), (signal.SIGKILL, 5.0)):
            for child in started:
                if child.poll() is None:
                    child.send_signal(number)
            until_s = time.monotonic() + patience_s
            for child in started:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.wait(max(0.0, until_s - time.monotonic()))


def run(kind: str, config: SwarmConfig, seconds: float, profile: Path | None = None) -> Figures:
    """Run the robots of a fleet as a kind (agent or bare) through one hub and measure them for `seconds`."""
    count = len(config.robot)
    with tempfile.TemporaryDirectory(prefix="swarm-benchmark-") as name, children(Path(name)) as start:
        folder = Path(name)
        fleet = folder / "fleet.toml"
        write_swarm(config, fleet)
        if profile:
            (folder / "profile").touch()
        hub = start("-m", "fullswarm", "hub", "--listen", config.hub.endpoint, "--with-parent")
        _wait_for_port(config.hub.endpoint, hub)
        core = start("-m", "fullswarm", "core", "--fleet", str(fleet), "--with-parent") if kind == "agent" else None
        if kind == "bare":
            _write_bare(config, folder)
        robots = [start("-m", f"benchmarks.swarm_{kind}", robot, name) for robot in config.robots]
        everyone = [hub, *([core] if core else []), *robots]
        _wait_for_files(folder, "*.ready", count, everyone, START_S)
        if kind == "agent":
            _set_going(config)
        begin_s = time.monotonic() + SETTLE_S
        leave(folder / "window.json", [begin_s, begin_s + seconds])
        usage = _usage(everyone, begin_s, begin_s + seconds)
        _wait_for_files(folder, "r*.json", count, everyone, seconds + 30.0)
        results = {robot: Result(**json.loads((folder / f"{robot}.json").read_text())) for robot in config.robots}
        if profile and (folder / "agent.prof").exists():
            profile.write_bytes((folder / "agent.prof").read_bytes())
        return _figures(kind, config, results, usage, core is not None)


def _wait_for_port(endpoint: str, hub: subprocess.Popen[bytes]) -> None:
    """Return once the hub is there."""
    bus = ZenohBus(Mailbox(), hub=endpoint)
    try:
        bus.wait_connected(20.0)
    finally:
        bus.close()
    if hub.poll() is not None:
        raise SystemExit("the hub ended at once")


def _wait_for_files(
    folder: Path, pattern: str, count: int, everyone: list[subprocess.Popen[bytes]], timeout_s: float
) -> None:
    until_s = time.monotonic() + timeout_s
    while (there := len(list(folder.glob(pattern)))) < count:
        dead = [child for child in everyone if child.poll() is not None]
        if dead or time.monotonic() > until_s:
            log = (folder / "log.txt").read_text()[-2000:]
            what = f"a process ended with code {dead[0].returncode}" if dead else f"only {there} of {count} {pattern}"
            raise SystemExit(f"{what}\n{log}")
        time.sleep(0.1)


def _write_bare(config: SwarmConfig, folder: Path) -> None:
    """Tell each robot of the reference its keys, so that it needs no code of ours to find them."""
    agent, expected = config.agent, senders_of(config)
    for each in config.robot:
        x_m, y_m, _ = each.pose or (0.0, 0.0, 0.0)
        settings = {
            "endpoint": config.hub.endpoint,
            "publish": f"bare/{cell_of(x_m, y_m, config.state_cell_m)}/{each.id}",
            "listen": [
                f"bare/{cell}/*" for cell in cells_within(x_m, y_m, agent.sensing_radius_m, config.state_cell_m)
            ],
            "expected": sorted(expected[each.id]),
            "period_s": 1.0 / agent.state_rate_hz,
        }
        leave(folder / f"{each.id}.bare", settings)


def _set_going(config: SwarmConfig) -> None:
    """Ask the core for a filtered behaviour and wait until every robot runs it."""
    mailbox = Mailbox()
    runtime, bus, keys = Runtime(MonotonicClock(), mailbox), ZenohBus(mailbox, hub=config.hub.endpoint), Keys("swarm")
    newest: list[RequestStatus] = []
    request = BehaviourRequest(id="benchmark", behaviour=BEHAVIOUR, robots=config.robots, source="benchmark")

    def ask() -> None:
        bus.publish(keys.behaviour_request, request)
        if newest and len(newest[-1].running) == len(config.robots):
            runtime.pause()

    try:
        bus.subscribe(keys.behaviour_status, RequestStatus, newest.append)
        runtime.every(0.5, ask)
        runtime.run(30.0)
        if not newest or len(newest[-1].running) < len(config.robots):
            raise SystemExit(f"not all robots run {BEHAVIOUR}: {newest[-1:]}")
    finally:
        bus.close()


def _usage(everyone: list[subprocess.Popen[bytes]], begin_s: float, end_s: float) -> dict[str, Any]:
    """Return CPU seconds per process and of the machine within the window, memory and threads."""
    watched = [psutil.Process(child.pid) for child in everyone]

    def used() -> tuple[list[float], float, float]:
        machine = psutil.cpu_times()
        busy_s = sum(machine) - machine.idle - machine.iowait - machine.guest - machine.guest_nice
        return [sum(each.cpu_times()[:2]) for each in watched], busy_s, time.monotonic()

    time.sleep(max(0.0, begin_s - time.monotonic()))
    before, busy_before_s, from_s = used()
    time.sleep(max(0.0, end_s - time.monotonic()))
    after, busy_after_s, to_s = used()
    time.sleep(GRACE_S)
    cpu = [100.0 * (later - sooner) / (to_s - from_s) for later, sooner in zip(after, before, strict=True)]
    return {
        "cpu": cpu,
        "others": max(0.0, 100.0 * (busy_after_s - busy_before_s) / (to_s - from_s) - sum(cpu)),
        "rss_mb": [each.memory_info().rss / 1e6 for each in watched],
        "threads": [each.num_threads() for each in watched],
    }


def _figures(
    kind: str, config: SwarmConfig, results: dict[str, Result], usage: dict[str, Any], with_core: bool
) -> Figures:
    expected = senders_of(config)
    wanted = sum(results[sender].sent for senders in expected.values() for sender in senders)
    arrived = sum(results[robot].received.get(sender, 0) for robot, senders in expected.items() for sender in senders)
    ages_s = np.concatenate([result.ages_s for result in results.values()])
    late_s = np.concatenate([result.late_s for result in results.values()])
    missed = sum(result.missed for result in results.values())
    first = 2 if with_core else 1
    names = {name for result in results.values() for name in result.threads_cpu_s}
    robot_seconds = sum(result.window_s for result in results.values())
    return Figures(
        kind={"agent": "fullswarm", "bare": "bare zenoh"}[kind],
        robots=len(results),
        senders_per_robot=sum(map(len, expected.values())) / len(expected),
        delivered=arrived / wanted if wanted else math.nan,
        age_p50_ms=1e3 * float(np.percentile(ages_s, 50)),
        age_p99_ms=1e3 * float(np.percentile(ages_s, 99)),
        ticks=len(late_s),
        late=float(np.mean(late_s > 0.001)),
        missed=missed / (len(late_s) + missed),
        late_p99_ms=1e3 * float(np.percentile(late_s, 99)),
        cpu_per_robot=float(np.mean(usage["cpu"][first:])),
        cpu_hub=usage["cpu"][0],
        cpu_core=usage["cpu"][1] if with_core else 0.0,
        cpu_others=usage["others"],
        tick_cpu_us=float(np.mean([result.tick_cpu_us for result in results.values()])),
        rss_mb=float(np.mean(usage["rss_mb"][first:])),
        threads=float(np.mean(usage["threads"][first:])),
        threads_cpu={
            name: 100.0 * sum(each.threads_cpu_s.get(name, 0.0) for each in results.values()) / robot_seconds
            for name in sorted(names)
        },
    )
