"""Eight emulated Creates drive `navigate_bc` on camera poses alone: `fullswarm up` as a user starts it, per seed.

The Creates have odometry only; their poses come from pictures that are rendered of the simulated world. Contacts are
those that the world itself counts at each of its steps; beside them the least gap between two bodies, from the true
poses at 20 Hz.

    python -m benchmarks.camera_drive [--seeds 20] [--robots 8] [--seconds 45]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.errors import FullswarmError
from fullswarm.keys import TRUTH, Keys
from fullswarm.launch.network import free_port
from fullswarm.localization.camera.fleet_template import fleet_text
from fullswarm.messages import HealthReport, RobotHealth, RobotMeasurement, TruePoses
from fullswarm.runtime import Mailbox, Runtime

WIDTH_M, DEPTH_M, RADIUS_M = 6.0, 4.0, 0.17
APART_M = 0.6
START_S = 90.0
GOAL_M = 1.0
"""Eight robots of this size that share a goal have arrived when all are so near it."""


def starts(robots: int, seed: int) -> list[tuple[float, float, float]]:
    """Return free start poses."""
    rng = np.random.default_rng((seed, 11))
    found: list[tuple[float, float, float]] = []
    while len(found) < robots:
        x, y = float(rng.uniform(0.5, WIDTH_M - 0.5)), float(rng.uniform(0.5, DEPTH_M - 0.5))
        if all(math.hypot(x - each[0], y - each[1]) > APART_M for each in found):
            found.append((round(x, 2), round(y, 2), round(float(rng.uniform(-3.1, 3.1)), 2)))
    return found


def lab_text(robots: int, seed: int) -> str:
    """Return the fleet file of `fullswarm track init --emulate create2`, with other start poses."""
    text = fleet_text(robots, WIDTH_M, DEPTH_M, f"world://?seed={seed}", "create2", "lab.toml")
    text = text.replace("127.0.0.1:8808", "")  # several may run
    poses = iter(starts(robots, seed))
    lines = [
        "pose = [{}, {}, {}]".format(*next(poses)) if line.startswith("pose = ") else line for line in text.splitlines()
    ]
    return "\n".join(lines) + "\n"


class Watch:
    """What is seen of a run on its bus."""

    def __init__(self, hub: str) -> None:
        self.runtime = Runtime(MonotonicClock(), Mailbox())
        self.bus = ZenohBus(self.runtime.mailbox, hub=hub)
        keys = Keys("swarm")
        self.events = 0.0
        self.pose: dict[str, tuple[float, float]] = {}
        self.health: dict[str, RobotHealth] = {}
        self.least_gap_m = math.inf
        self.error_m: list[float] = []
        self.bus.subscribe(keys.measurement("robots", TRUTH), RobotMeasurement, self._on_truth)
        self.bus.subscribe(keys.true_poses, TruePoses, self._on_poses)
        self.bus.subscribe(keys.health(), HealthReport, self._on_health)

    def _on_truth(self, message: RobotMeasurement) -> None:
        self.events = sum(message.columns.get("events", ()))

    def _on_poses(self, message: TruePoses) -> None:
        places = np.column_stack((message.x_m, message.y_m))
        apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
        np.fill_diagonal(apart, math.inf)
        self.least_gap_m = min(self.least_gap_m, float(apart.min()) - 2.0 * RADIUS_M)
        self.pose = {robot: (x, y) for robot, x, y in zip(message.robots, message.x_m, message.y_m, strict=True)}

    def _on_health(self, report: HealthReport) -> None:
        self.health.update({each.robot: each for each in report.robots})

    @property
    def on_camera(self) -> int:
        """How many robots have their pose from fixes."""
        return sum(each.pose_source == "fixes" for each in self.health.values())

    def close(self) -> None:
        """Leave the bus."""
        self.bus.close()


def run(seed: int, robots: int, seconds: float) -> dict[str, object]:
    """Start everything, let the robots drive to a goal, count."""
    rng = np.random.default_rng((seed, 12))
    goal = float(rng.uniform(1.2, WIDTH_M - 1.2)), float(rng.uniform(1.2, DEPTH_M - 1.2))
    port = free_port(7600)
    hub = f"tcp/127.0.0.1:{port}"
    environment = {**os.environ, "FULLSWARM_HUB": hub, "PYTHONUNBUFFERED": "1"}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "lab.toml").write_text(lab_text(robots, seed))

        def command(*words: str) -> list[str]:
            return [sys.executable, "-m", "fullswarm", *words]

        def call(*words: str) -> None:
            done = subprocess.run(
                command(*words), cwd=folder, env=environment, capture_output=True, text=True, timeout=400
            )
            if done.returncode not in (0, 1):  # 1: accepted, and robots get it as soon as the core has seen them
                raise RuntimeError(f"{' '.join(words)}: {done.stderr[-500:]}{done.stdout[-500:]}")

        call("track", "calibrate", "lens", "lab.toml")
        call("track", "calibrate", "floor", "lab.toml")
        sets = [f"hub.endpoint={hub}", f"world.address=127.0.0.1:{free_port(7700)}"]
        up = subprocess.Popen(
            command("up", "lab.toml", *(word for each in sets for word in ("--set", each))),
            cwd=folder, env=environment,
            stdout=subprocess.DEVNULL, stderr=(folder / "up.log").open("wb"),
        )  # fmt: skip
        watch = None
        try:
            deadline = time.monotonic() + START_S
            while watch is None and time.monotonic() < deadline:
                try:
                    watch = Watch(hub)
                except FullswarmError:  # the hub is not there yet
                    time.sleep(0.5)
            if watch is None:
                return {"seed": seed, "failed": "no hub", "log": (folder / "up.log").read_text()[-500:]}
            while watch.on_camera < robots and time.monotonic() < deadline:
                watch.runtime.run(0.5)
            ready_s = START_S - (deadline - time.monotonic())
            if watch.on_camera < robots:
                return {
                    "seed": seed,
                    "failed": f"{watch.on_camera} on camera",
                    "log": (folder / "up.log").read_text()[-500:],
                }
            call("request", "navigate_bc", "--set", f"goal={goal[0]:.2f},{goal[1]:.2f}")
            watch.runtime.run(seconds)
            far = [math.hypot(x - goal[0], y - goal[1]) for x, y in watch.pose.values()]
            return {
                "seed": seed, "contacts": watch.events, "least_gap_m": round(watch.least_gap_m, 4),
                "arrived": sum(each <= GOAL_M for each in far), "robots": robots, "ready_s": round(ready_s, 1),
                "on_camera_at_end": watch.on_camera,
            }  # fmt: skip
        finally:
            if watch is not None:
                watch.close()
            up.send_signal(signal.SIGINT)
            try:
                up.wait(30)
            except subprocess.TimeoutExpired:
                up.kill()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=45.0)
    options = parser.parse_args()
    contacts = runs = 0.0
    for seed in range(options.first, options.first + options.seeds):
        found = run(seed, options.robots, options.seconds)
        print(json.dumps(found), flush=True)
        if isinstance(found.get("contacts"), float):
            runs += 1
            contacts += float(found["contacts"])  # type: ignore[arg-type]
    print(json.dumps({"runs": runs, "contacts": contacts}))
    return int(contacts > 0 or runs < options.seeds)


if __name__ == "__main__":
    raise SystemExit(main())
