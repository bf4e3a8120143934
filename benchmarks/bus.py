"""Our bus against bare zenoh in the same run: round trips, leaving in time, coming back.

``python -m benchmarks.bus [--seconds 5] [--json]``. Both go through one hub, between two processes each, with the
same zenoh settings; short slices of the two alternate. Read the ratio: the microseconds belong to the machine.
"""

from __future__ import annotations

import argparse
import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.messages import Heartbeat
from fullswarm.runtime import Mailbox

TARGET = 1.2
SLICE_S = 0.5
MODES = ("paced", "chained")
KINDS = ("bare", "ours")

HUB = """
import signal, sys
from fullswarm.bus.hub import Hub
with Hub(sys.argv[1]):
    print("ready", flush=True)
    signal.pause()
"""
FORGETFUL = """
import sys
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.messages import Heartbeat
from fullswarm.runtime import Runtime
runtime = Runtime(MonotonicClock())
bus = ZenohBus(runtime.mailbox, hub=sys.argv[1])
bus.subscribe("bench/**", Heartbeat, print)
bus.wait_connected(5.0)
runtime.after(0.0, lambda: print("ready", flush=True))
runtime.run()
"""


@dataclass(frozen=True)
class Trips:
    """Round trips of one kind: how many, and their percentiles in microseconds."""

    count: int
    p50_us: float
    p99_us: float

    @classmethod
    def of(cls, samples_us: list[float]) -> Trips:
        """Summarise samples in microseconds."""
        ordered = sorted(samples_us)
        return cls(len(ordered), ordered[len(ordered) // 2], ordered[len(ordered) * 99 // 100])


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def process(*command: str) -> Iterator[subprocess.Popen[str]]:
    """Run a Python process that prints "ready"; kill it at the end."""
    with subprocess.Popen(
        [sys.executable, *command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as child:
        try:
            read_line(child)
            yield child
        finally:
            child.kill()


def read_line(child: subprocess.Popen[str]) -> str:
    assert child.stdout is not None
    line = child.stdout.readline()
    if not line:
        raise SystemExit("a process of the benchmark died; run it by hand: python -m benchmarks.bus_peers")
    return line


def ask(child: subprocess.Popen[str], line: str) -> list[float]:
    assert child.stdin is not None
    child.stdin.write(line + "\n")
    child.stdin.flush()
    return [float(each) for each in json.loads(read_line(child))]


def round_trips(seconds: float) -> dict[str, dict[str, Trips]]:
    """Measure each kind and mode for `seconds`, a slice at a time in turn."""
    endpoint = free_endpoint()
    samples: dict[tuple[str, str], list[float]] = {(mode, kind): [] for mode in MODES for kind in KINDS}
    with ExitStack() as stack:
        stack.enter_context(process("-c", HUB, endpoint))
        pings = {}
        for kind in KINDS:
            stack.enter_context(process("-m", "benchmarks.bus_peers", kind, "pong", endpoint))
            pings[kind] = stack.enter_context(process("-m", "benchmarks.bus_peers", kind, "ping", endpoint))
        for kind in KINDS:
            ask(pings[kind], f"chained {SLICE_S / 2}")  # warm up
        for turn in range(max(1, round(seconds / SLICE_S))):
            for mode in MODES:
                for kind in KINDS if turn % 2 == 0 else reversed(KINDS):
                    samples[mode, kind] += ask(pings[kind], f"{mode} {SLICE_S}")
    return {mode: {kind: Trips.of(samples[mode, kind]) for kind in KINDS} for mode in MODES}


def exit_time_s() -> float:
    """Return how long a process with an open subscription and no close() takes to leave after Ctrl-C."""
    endpoint = free_endpoint()
    with process("-c", HUB, endpoint), process("-c", FORGETFUL, endpoint) as child:
        start_s = time.perf_counter()
        child.send_signal(signal.SIGINT)
        child.wait(30.0)
        return time.perf_counter() - start_s


def back_time_s() -> float:
    """Return the time from a new hub that is ready to the first message through it."""
    endpoint, mailbox = free_endpoint(), Mailbox()
    received: list[Heartbeat] = []
    talker, listener = ZenohBus(Mailbox(), hub=endpoint), ZenohBus(mailbox, hub=endpoint)
    listener.subscribe("bench/x", Heartbeat, received.append)

    def talk() -> float:
        start_s = time.perf_counter()
        received.clear()
        while not received:
            talker.publish("bench/x", Heartbeat(node="bench", process="p", sequence=1))
            mailbox.deliver_one(0.002)
            if time.perf_counter() - start_s > 30.0:
                raise SystemExit("no message came through a new hub within 30 s")
        return time.perf_counter() - start_s

    try:
        with process("-c", HUB, endpoint):
            talk()
        time.sleep(1.0)  # long enough for the retries to reach their longest pause
        mailbox.drain()
        with process("-c", HUB, endpoint):
            return talk()
    finally:
        talker.close()
        listener.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0, help="per kind and mode")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    options = parser.parse_args()
    trips = round_trips(options.seconds)
    ratios = {
        mode: {
            "p50": trips[mode]["ours"].p50_us / trips[mode]["bare"].p50_us,
            "p99": trips[mode]["ours"].p99_us / trips[mode]["bare"].p99_us,
        }
        for mode in MODES
    }
    leaving_s, back_s = exit_time_s(), back_time_s()
    if options.json:
        table = {mode: {kind: asdict(trips[mode][kind]) for kind in KINDS} for mode in MODES}
        print(json.dumps({"trips": table, "ratio": ratios, "exit_s": leaving_s, "back_s": back_s}))
        return
    print("round trip of a Command through the hub, µs      p50      p99   trips")
    for mode, title in (("paced", "100 Hz"), ("chained", "back to back")):
        for kind, name in (("bare", "bare zenoh"), ("ours", "our bus")):
            each = trips[mode][kind]
            print(f"  {title:14}{name:26}{each.p50_us:10.0f}{each.p99_us:9.0f}{each.count:8}")
        print(f"  {title:14}{'ratio':26}{ratios[mode]['p50']:10.2f}{ratios[mode]['p99']:9.2f}")
    print(f"target at p50: {TARGET} or less")
    print(f"leaving after Ctrl-C, never closed: {leaving_s:.2f} s (target 1)")
    print(f"traffic after a hub restart: {back_s:.2f} s (target 1)")


if __name__ == "__main__":
    main()
