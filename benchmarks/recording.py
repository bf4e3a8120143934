"""Recordings of a live swarm: what a kill loses, what recording costs, and what other people's readers make of it.

`fullswarm up` with simulated robots that flock, and a recorder beside it that is killed (SIGKILL) at random moments.
Each file is repaired and read by the `mcap` library. Printed per kill: the time from the last recorded state of any
robot to the kill; at the end the processor time of a recorder per robot, as a share of what one agent takes in the same
seconds. The bars: less than 1 s is lost by each kill, and a recorder takes at most 5 % of an agent's time per robot.

    python -m benchmarks.recording [--robots 8] [--kills 20] [--seconds 60] [--seed 1] [--check]
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
from mcap.reader import make_reader

from fullswarm.config import SwarmConfig
from fullswarm.launch.network import on_free_ports

LOSS_S, SHARE = 1.0, 0.05
READY_S = 90.0


def fullswarm(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "fullswarm", *arguments]


def write_fleet(path: Path, robots: int) -> str:
    """Write a fleet file with free ports; return the hub's endpoint."""
    free = on_free_ports(SwarmConfig(), prefer_configured=False)
    lines = [
        f'[hub]\nendpoint = "{free.hub.endpoint}"\n[world]\naddress = "{free.world_or_default.address}"',
        f'engine = "kinematic"\nbounds_m = [0, 0, 20, 20]\n[fleet]\ncount = {robots}\n',
    ]
    path.write_text("\n".join(lines))
    return free.hub.endpoint


def wait_ready(hub: str, robots: int) -> None:
    end_s = time.monotonic() + READY_S
    while time.monotonic() < end_s:
        found = subprocess.run(fullswarm("status", "--hub", hub, "--json"), capture_output=True, check=False)
        if found.returncode == 0:
            states = [each.get("lifecycle") for each in json.loads(found.stdout)["robots"]]
            if states == ["READY"] * robots:
                return
    raise SystemExit("the swarm is not ready")


def record(hub: str, path: Path) -> psutil.Popen:
    """Start a recorder; return once it has written something."""
    process = psutil.Popen(
        fullswarm("record", "start", "--hub", hub, "--out", str(path)), stderr=subprocess.DEVNULL
    )  # fmt: skip
    end_s = time.monotonic() + READY_S
    while not path.exists() or path.stat().st_size < 20_000:
        if time.monotonic() > end_s or process.poll() is not None:
            raise SystemExit("nothing is recorded")
        time.sleep(0.05)
    return process


def last_state_s(path: Path) -> tuple[float, int]:
    """Return when the last state of a robot was recorded, and how many messages the file has."""
    whole = path.with_suffix(".whole.mcap")
    subprocess.run(fullswarm("record", "repair", str(path), "--out", str(whole)), check=True, capture_output=True)
    with whole.open("rb") as stream:
        found = [(channel.topic, message.log_time) for _, channel, message in make_reader(stream).iter_messages()]
    return 1e-9 * max(at for topic, at in found if topic.startswith("/state/")), len(found)


def spent_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=60.0, help="over which processor time is measured")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--check", action="store_true", help="exit code 1 unless the bars hold")
    given = parser.parse_args()
    chance, losses = random.Random(given.seed), []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        hub = write_fleet(folder / "fleet.toml", given.robots)
        up = psutil.Popen(fullswarm("up", str(folder / "fleet.toml")), stderr=subprocess.DEVNULL)
        try:
            wait_ready(hub, given.robots)
            subprocess.run(fullswarm("request", "flocking", "--hub", hub), check=True, capture_output=True)
            for number in range(given.kills):
                path = folder / f"{number}.mcap"
                recorder = record(hub, path)
                time.sleep(chance.uniform(0.0, 2.0))
                recorder.kill()
                killed_s = time.time()
                recorder.wait()
                at_s, messages = last_state_s(path)
                losses.append(killed_s - at_s)
                print(f"kill {number + 1}: {losses[-1]:.3f} s lost, {messages} messages read", flush=True)
            recorder = record(hub, folder / "long.mcap")
            agents = [each for each in up.children() if "agent" in each.cmdline()]
            before = spent_s(recorder), sum(map(spent_s, agents))
            time.sleep(given.seconds)
            took_s, agents_s = spent_s(recorder) - before[0], sum(map(spent_s, agents)) - before[1]
            recorder.send_signal(2)
            recorder.wait()
            size_mb = (folder / "long.mcap").stat().st_size / 1e6
        finally:
            up.send_signal(2)
            up.wait()
    share = took_s / agents_s
    print(
        f"{given.robots} robots: at most {max(losses, default=0.0):.3f} s lost; recorder {took_s / given.seconds:.1%} "
        f"of a core, agents {agents_s / given.seconds / given.robots:.1%} each: "
        f"{share:.1%} of an agent's time per robot; "
        f"{size_mb / given.seconds * 60:.1f} MB a minute"
    )
    good = max(losses, default=0.0) < LOSS_S and share <= SHARE
    return 0 if good or not given.check else 1


if __name__ == "__main__":
    raise SystemExit(main())
