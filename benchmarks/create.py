"""CPU of one Create driver at the robot's 66 Hz, beside a bare pyserial loop that reads the same stream.

``python -m benchmarks.create [--seconds 12] [--json]``. The robot is the emulator, in a process of its own, on a real
pseudo-terminal. Slices of three kinds alternate: ``bare`` reads frames with pyserial and checks their sums; ``ready``
is the driver, read at 50 Hz as an agent does; ``driving`` also sends it another set-point each time. What counts is
the processor time of this process with all its threads, as a share of one core. Exits 1 above the target.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import serial

from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.create_oi.driver import CreateDriver
from fullswarm.drivers.create_oi.protocol import CREATE2, Op, frame_size, simple, stream
from fullswarm.drivers.create_oi.senses import stream_ids

TARGET = 0.05
KINDS = ("bare", "ready", "driving")
SLICE_S = 2.0
PERIOD_S = 0.02

ROBOT = """
import sys
from fullswarm.emulators.create_oi.emulator import CreateEmulator
with CreateEmulator() as robot:
    print(robot.port, flush=True)
    sys.stdin.read()
"""


@contextmanager
def robot() -> Iterator[str]:
    """Run an emulator in a process of its own; yield the path of its port."""
    command = [sys.executable, "-c", ROBOT]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        path = child.stdout.readline().strip()
        if not path:
            raise SystemExit("the emulator died; run `fullswarm emulate create` by hand")
        yield path
        child.stdin.close()


def share(began: tuple[float, float]) -> float:
    """Return the processor time since `began` (wall, processor) as a share of one core."""
    return (time.process_time() - began[1]) / (time.perf_counter() - began[0])


def now() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def bare(path: str) -> tuple[float, float]:
    """Read frames with pyserial alone for a slice; return the share of a core and the frames per second."""
    ids = stream_ids(CREATE2, CREATE2.baud)
    size, frames = frame_size(ids), 0
    with serial.Serial(path, CREATE2.baud, timeout=1.0, exclusive=True) as port:
        port.write(simple(Op.START))
        time.sleep(0.05)
        port.reset_input_buffer()
        port.write(stream(ids))
        port.read(size)
        began = now()
        while time.perf_counter() - began[0] < SLICE_S:
            frame = port.read(size)
            if frame[0] != 19 or sum(frame) & 0xFF:
                raise SystemExit("the bare loop is out of step with the stream")
            frames += 1
        return share(began), frames / (time.perf_counter() - began[0])


def driven(path: str, active: bool) -> tuple[float, float]:
    """Use the driver for a slice; return the share of a core and the readings per second that it took in."""
    frames = [0]
    size = frame_size(stream_ids(CREATE2, CREATE2.baud))

    def count(way: str, data: bytes) -> None:
        frames[0] += len(data) if way == "<" else 0

    driver = CreateDriver(f"create://{path}", log=count)
    driver.open()
    try:
        wait_for(driver, Lifecycle.READY)
        if active:
            driver.activate()
            wait_for(driver, Lifecycle.ACTIVE)
        began, frames[0] = now(), 0
        due_s = began[0]
        while (passed_s := time.perf_counter() - began[0]) < SLICE_S:
            driver.read()
            driver.command(Twist(0.2, math.sin(passed_s)))
            due_s += PERIOD_S
            time.sleep(max(0.0, due_s - time.perf_counter()))
        return share(began), frames[0] / size / (time.perf_counter() - began[0])
    finally:
        driver.close()


def wait_for(driver: CreateDriver, state: Lifecycle) -> None:
    deadline_s = time.perf_counter() + 10.0
    while driver.state is not state:
        if time.perf_counter() > deadline_s:
            raise SystemExit(f"the driver is {driver.state}, not {state}: {driver.fault or driver.blocked}")
        time.sleep(0.01)


def measure(seconds: float) -> dict[str, tuple[float, float]]:
    """Return median share of a core and median rate in Hz of each kind."""
    results: dict[str, list[tuple[float, float]]] = {kind: [] for kind in KINDS}
    with robot() as path:
        for _ in range(max(1, round(seconds / SLICE_S / len(KINDS)))):
            results["bare"].append(bare(path))
            results["ready"].append(driven(path, active=False))
            results["driving"].append(driven(path, active=True))
    return {
        kind: (statistics.median(each[0] for each in slices), statistics.median(each[1] for each in slices))
        for kind, slices in results.items()
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=24.0, help="in all")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    options = parser.parse_args()
    results = measure(options.seconds)
    base = results["bare"][0]
    worst = max(results["ready"][0], results["driving"][0])
    if options.json:
        table = {kind: {"core": core, "hz": hz, "ratio": core / base} for kind, (core, hz) in results.items()}
        print(json.dumps({"kinds": table, "target": TARGET, "kept": worst <= TARGET}))
        return int(worst > TARGET)
    print("one Create at 115200 baud               share of a core   frames/s   ratio to bare")
    names = {"bare": "bare pyserial loop", "ready": "driver, READY", "driving": "driver, 50 set-points/s"}
    for kind, (core, hz) in results.items():
        print(f"  {names[kind]:38}{core:14.2%}{hz:11.1f}{core / base:16.2f}")
    print(f"target: {TARGET:.0%} of a core or less: {'kept' if worst <= TARGET else 'missed'}")
    return int(worst > TARGET)


if __name__ == "__main__":
    sys.exit(main())
