"""What the MAVLink driver costs while it drives an emulated rover with 20 Hz telemetry, beside a bare pymavlink loop.

Each in a process of its own, at the same time, on an emulator of its own in a third and a fourth process, on UDP, with
the same message rates. The driver's process also sends set-points at 20 Hz and reads, as an agent does; the bare one
is `mavutil.recv_match` in a loop and throws away what it gets. CPU time of the process, not wall time. Target: at most
3 % of one core.

    python -m benchmarks.mavlink [--seconds 20] [--json] [--profile]
"""

from __future__ import annotations

import argparse
import cProfile
import json
import pstats
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.mavlink.startup import RATES_HZ
from fullswarm.emulators.mavlink.emulator import RoverEmulator

TARGET = 0.03
COMMAND_S = 0.05
WARM_UP_S = 2.0


def serve_emulator(port: int) -> None:
    with RoverEmulator(f"udp://127.0.0.1:{port}"):
        print("ready", flush=True)
        sys.stdin.read()  # until the benchmark closes it


def measure_driver(port: int, seconds: float) -> None:
    driver = MavlinkDriver(f"mavlink+udp://127.0.0.1:{port}")
    driver.open()
    pause = threading.Event()
    try:
        while driver.state is not Lifecycle.ACTIVE:
            driver.activate()
            pause.wait(COMMAND_S)
        _drive(driver, WARM_UP_S)
        start_s, cpu_s, calls_s = time.monotonic(), time.process_time(), time.thread_time()
        readings = _drive(driver, seconds)
        wall_s = time.monotonic() - start_s
        figures = {
            "share": (time.process_time() - cpu_s) / wall_s,
            "calls": (time.thread_time() - calls_s) / wall_s,
            "readings_hz": readings / wall_s,
        }
    finally:
        driver.close()
    print(json.dumps(figures), flush=True)


def _drive(driver: MavlinkDriver, seconds: float) -> int:
    """Read and command at 20 Hz; return how many new readings there were."""
    end_s, pause, stamps = time.monotonic() + seconds, threading.Event(), set()
    while time.monotonic() < end_s:
        reading = driver.read()
        if reading is not None:
            stamps.add(reading.stamp_s)
        driver.command(Twist(0.3, 0.2))
        pause.wait(COMMAND_S)
    return len(stamps)


def measure_bare(port: int, seconds: float) -> None:
    dialect()
    from pymavlink import mavutil

    connection: Any = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=255)
    connection.wait_heartbeat(timeout=10)
    for message, rate_hz in RATES_HZ.items():
        connection.mav.command_long_send(1, 1, 511, 0, message, 1e6 / rate_hz, 0, 0, 0, 0, 0)
        connection.recv_match(type="COMMAND_ACK", blocking=True, timeout=2)
    _receive(connection, WARM_UP_S)
    start_s, cpu_s = time.monotonic(), time.process_time()
    count = _receive(connection, seconds)
    wall_s = time.monotonic() - start_s
    print(json.dumps({"share": (time.process_time() - cpu_s) / wall_s, "messages_hz": count / wall_s}), flush=True)
    connection.close()


def _receive(connection: Any, seconds: float) -> int:
    end_s, count = time.monotonic() + seconds, 0
    while time.monotonic() < end_s:
        count += connection.recv_match(blocking=True, timeout=0.5) is not None
    return count


def profile_link(seconds: float) -> None:
    """Print where the link thread's time goes, most of its own first; with the emulator in another process."""
    port = _free_port()
    emulator = _start("--emulator", str(port))
    profiler, run = cProfile.Profile(), MavlinkDriver._run  # noqa: SLF001  (wrapped, to profile its thread)

    def profiled(*values: Any) -> None:
        profiler.runcall(run, *values)

    MavlinkDriver._run = profiled  # type: ignore[assignment,method-assign]  # noqa: SLF001
    try:
        measure_driver(port, seconds)
    finally:
        _end(emulator)
    pstats.Stats(profiler).sort_stats("tottime").print_stats(18)


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _start(*options: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.mavlink", *options], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def _end(emulator: subprocess.Popen[str]) -> None:
    emulator.communicate(timeout=10)


def measure(seconds: float) -> dict[str, Any]:
    ports = [_free_port() for _ in range(2)]
    emulators = [_start("--emulator", str(port)) for port in ports]
    jobs = {
        name: _start(f"--{name}", str(port), "--seconds", str(seconds))
        for name, port in zip(("driver", "bare"), ports, strict=True)
    }
    try:
        figures: dict[str, Any] = {
            name: json.loads(job.communicate(timeout=seconds + 60)[0].splitlines()[-1]) for name, job in jobs.items()
        }
    finally:
        for emulator in emulators:
            _end(emulator)
    figures["ratio"] = figures["driver"]["share"] / figures["bare"]["share"]
    figures["target"] = TARGET
    return figures


def main() -> None:
    """Run as the benchmark or, with a hidden option, as one of its processes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--profile", action="store_true", help="print where the driver's link thread spends its time")
    for role in ("--emulator", "--driver", "--bare"):
        parser.add_argument(role, type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    roles: dict[str, Callable[[], None]] = {
        "emulator": lambda: serve_emulator(options.emulator),
        "driver": lambda: measure_driver(options.driver, options.seconds),
        "bare": lambda: measure_bare(options.bare, options.seconds),
        "profile": lambda: profile_link(options.seconds),
    }
    for name, run in roles.items():
        if getattr(options, name):
            run()
            return
    figures = measure(options.seconds)
    if options.json:
        print(json.dumps(figures, indent=2))
        return
    driver, bare = figures["driver"], figures["bare"]
    print(f"driver  {driver['share']:6.2%} of one core ({driver['calls']:.2%} of it in the agent's calls), "
          f"{driver['readings_hz']:.1f} new readings/s seen   (target {TARGET:.0%})")  # fmt: skip
    print(f"bare    {bare['share']:6.2%} of one core, {bare['messages_hz']:.1f} messages/s")
    print(f"ratio   {figures['ratio']:6.2f}")


if __name__ == "__main__":
    main()
