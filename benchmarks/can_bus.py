"""CPU share of one CAN driver with its usual traffic, beside a bare python-can read loop on the same bus.

``python -m benchmarks.can_bus [--seconds 5] [--json]``. An emulated ODrive base in a process of its own sends what a
real one does (two axes, encoder estimates at 100 Hz, heartbeats at 10 Hz); the driver, in another process, drives at
50 Hz. The bare loop only reads. Read the ratio: the shares belong to the machine. On ``slcan`` python-can reads byte
by byte and wakes a thousand times a second, our reader by the chunk; on ``udp_multicast`` both read the same way.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

BASE = "left=1&right=2&wheel_radius=0.05&base=0.3&watchdog=0.5"
TARGET = 0.05
"""Share of one core."""

WORLD = """
import sys
from fullswarm.emulators.can.emulator import EmulatedBase
with EmulatedBase(sys.argv[1]):
    print("ready", flush=True)
    sys.stdin.read()
"""
OURS = """
import json, sys, time
from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.can.driver import CanBaseDriver
url, seconds = sys.argv[1], float(sys.argv[2])
driver = CanBaseDriver(url)
driver.open()
while driver.state is not Lifecycle.READY:
    time.sleep(0.01)
driver.activate()
while driver.state is not Lifecycle.ACTIVE:
    time.sleep(0.01)
due = time.monotonic()
start, cpu = due, time.process_time()
stamps = set()
while due - start < seconds:
    driver.command(Twist(0.3, 0.1))
    stamps.add(driver.read().stamp_s)
    due += 0.02
    time.sleep(max(0.0, due - time.monotonic()))
cpu, wall = time.process_time() - cpu, time.monotonic() - start
assert driver.state is Lifecycle.ACTIVE, driver.fault
driver.close()
print(json.dumps({"share": cpu / wall, "per_s": len(stamps) / wall}))
"""
BARE = """
import json, sys, time
import can
options, seconds = json.loads(sys.argv[1]), float(sys.argv[2])
with can.Bus(ignore_config=True, **options) as bus:
    while bus.recv(0.1) is None:
        pass
    start, cpu, frames = time.monotonic(), time.process_time(), 0
    while time.monotonic() - start < seconds:
        frames += bus.recv(0.1) is not None
    cpu, wall = time.process_time() - cpu, time.monotonic() - start
print(json.dumps({"share": cpu / wall, "per_s": frames / wall}))
"""


@dataclass(frozen=True)
class Result:
    """One interface: shares of a core, and what was done with them."""

    interface: str
    ours: float
    bare: float
    readings_per_s: float  # seen by the driver's user at 50 Hz
    frames_per_s: float  # seen by the bare loop

    @property
    def ratio(self) -> float:
        """Return how much more than reading it costs to drive."""
        return self.ours / self.bare


@contextmanager
def world(url: str) -> Iterator[None]:
    """Run an emulated base in another process."""
    with subprocess.Popen(
        [sys.executable, "-c", WORLD, url], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        if process.stdout.readline() != "ready\n":
            raise RuntimeError("the emulated base did not start")
        try:
            yield
        finally:
            process.communicate()


def child(code: str, target: str, seconds: float) -> dict[str, float]:
    """Run a reader; return what it measured about itself."""
    done = subprocess.run(
        [sys.executable, "-c", code, target, str(seconds)], check=True, capture_output=True, text=True, timeout=60
    )
    measured: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return measured


def measure(interface: str, channel: str, more: str, options: dict[str, int], seconds: float) -> Result:
    """Measure both on a bus each, one after the other."""
    url = f"can+odrive://{channel}?interface={interface}&{BASE}&{more}"
    with world(url):
        ours = child(OURS, url, seconds)
    bare_options = json.dumps({"interface": interface, "channel": channel, **options})
    with world(url):
        bare = child(BARE, bare_options, seconds)
    return Result(interface, ours["share"], bare["share"], ours["per_s"], bare["per_s"])


def run(seconds: float) -> list[Result]:
    with tempfile.TemporaryDirectory() as folder:
        slcan = measure(
            "slcan", f"{folder}/bench.can", "settle=0", {"bitrate": 250_000, "sleep_after_open": 0}, seconds
        )
    multicast = measure("udp_multicast", "239.74.163.2", "port=43217", {"port": 43217, "hop_limit": 0}, seconds)
    return [slcan, multicast]


def main() -> int:
    """Print the figures; return 1 when a driver takes more than its share."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    results = run(arguments.seconds)
    if arguments.json:
        print(json.dumps([asdict(each) | {"ratio": each.ratio} for each in results]))
    else:
        for each in results:
            print(
                f"{each.interface:14s} driver {each.ours:6.2%} of a core ({each.readings_per_s:.0f} readings/s), "
                f"bare read loop {each.bare:6.2%} ({each.frames_per_s:.0f} frames/s), ratio {each.ratio:.2f}"
            )
    return int(any(each.ours > TARGET for each in results))


if __name__ == "__main__":
    sys.exit(main())
