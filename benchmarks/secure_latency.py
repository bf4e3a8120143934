"""From an operator's publish to the twist at the driver, with certificates and access list beside the same without.

Two swarms of one robot run at the same time, one at a ``tls/`` hub, one at a ``tcp/`` hub, each with a core and an
agent in processes of their own; requests go to them in turn, so that both find the machine equally busy. Target: at
most twice the plain time at p50.

    python -m benchmarks.secure_latency [--seconds 20] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.beside_hop import STAMP, TWIST, Figures, spread
from benchmarks.latency import RATE_HZ, SETTLE_S
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.config.fleet_file import write_swarm
from fullswarm.identity import Role
from fullswarm.identity.authority import Authority
from fullswarm.identity.folder import IDENTITY, KeysFolder
from fullswarm.keys import Keys
from fullswarm.launch.network import on_free_ports
from fullswarm.messages import BehaviourRequest
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Runtime

NAMES: tuple[tuple[str, Role], ...] = (
    ("hub", "hub"), ("core", "core"), ("r1", "robot"), ("anna", "operator"), ("eve", "observer")
)  # fmt: skip
OTHERS = 30
"""Robots of the swarm that are away: the hub's access list is that of a whole swarm."""
TARGET = 2.0
END = 9


@dataclass
class Side:
    """One of the two swarms, and the times at which its requests left and its twists came."""

    config: SwarmConfig
    folder: KeysFolder
    offset: float
    sent: dict[float, float] = field(default_factory=dict)
    arrived: dict[float, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Return ``tls`` or ``tcp``."""
        return self.config.hub.endpoint.partition("/")[0]


@contextmanager
def processes(side: Side, port: int) -> Iterator[None]:
    """Run hub, core and the stamping agent, which reports to `port`."""
    fleet, python = side.folder.path.parent.parent / f"{side.name}.toml", [sys.executable, "-m"]
    write_swarm(side.config, fleet)
    commands = [
        [*python, "fullswarm", "hub", "--listen", side.config.hub.endpoint, "--swarm", side.config.swarm],
        [*python, "fullswarm", "core", "--fleet", str(fleet)],
        [*python, "benchmarks.latency", "--agent", str(fleet), "--port", str(port)],
    ]
    environment = {**os.environ, IDENTITY: str(side.folder.path.parent)}
    children = [subprocess.Popen(command, stdin=subprocess.DEVNULL, env=environment) for command in commands]
    try:
        yield
    finally:
        for child in reversed(children):
            child.terminate()
        for child in children:
            child.wait()


def measure(seconds: float) -> Figures:
    """Run both swarms; return p50, p99 and count in µs for each, and their ratio."""
    with tempfile.TemporaryDirectory() as temporary, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        folder = KeysFolder.of("swarm", Path(temporary) / "identity")
        authority = Authority.make(folder)
        for name, role in (*NAMES, *((f"away{number}", "robot") for number in range(OTHERS))):
            authority.issue(name, role)
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
        sides = [Side(_config(scheme), folder, offset) for scheme, offset in (("tcp", 0.1), ("tls", 0.5))]

        def collect() -> None:
            while True:
                which, value, at_s = STAMP.unpack(listener.recv(64))
                if which == END:
                    return
                if which == TWIST:
                    for side in sides:
                        if side.offset <= value < side.offset + 0.3:
                            side.arrived[round(value, 6)] = at_s

        collector = threading.Thread(target=collect, daemon=True)
        collector.start()
        with processes(sides[0], port), processes(sides[1], port):
            _send(sides, seconds)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto(STAMP.pack(END, 0, 0), ("127.0.0.1", port))
        collector.join()
    return _figures(sides)


def _config(scheme: str) -> SwarmConfig:
    hub = {"endpoint": f"{scheme}/127.0.0.1:7447"}
    config = SwarmConfig.model_validate({"robot": [{"id": "r1", "driver": "null://r1"}], "hub": hub})
    return on_free_ports(config, prefer_configured=False)


def _send(sides: list[Side], seconds: float) -> None:
    runtime = Runtime(MonotonicClock())
    keys, buses, views = Keys("swarm"), [], []
    for side in sides:
        credentials = side.folder.credentials("anna", "operator")
        buses.append(ZenohBus(runtime.mailbox, hub=side.config.hub.endpoint, credentials=credentials))
        views.append(FleetView(buses[-1], keys, runtime, ("r1",)))
    for bus in buses:
        bus.wait_connected(30.0)
    count, ready_s, chance = 0, 0.0, random.Random(1)
    first_s = 0.0

    def ready() -> bool:
        nonlocal ready_s
        now_s = runtime.now_s()
        for view in views:
            snapshot = view.snapshot()
            if not snapshot.robots or not any(node.node == "core" for node in snapshot.nodes):
                ready_s = now_s + SETTLE_S
        return now_s >= ready_s

    def request() -> None:
        nonlocal count, first_s
        interval_s = chance.uniform(0.5, 1.5) / RATE_HZ
        runtime.after(interval_s, request)
        if not ready():
            return
        first_s = first_s or runtime.now_s()
        if runtime.now_s() - first_s > seconds:
            runtime.stop()
        count += 1
        side, bus = sides[count % 2], buses[count % 2]
        value = round(1e-6 * count + side.offset, 6)
        message = BehaviourRequest(
            id=f"b{count}", behaviour="drive", robots=("r1",),
            parameters={"linear": value, "angular": 0.0, "speed_m_s": 1.0, "turn_rad_s": 1.0},
            source="benchmark", stamp_s=runtime.now_s(),
        )  # fmt: skip
        side.sent[value] = time.monotonic()
        bus.publish(keys.behaviour_request, message)

    request()
    runtime.run(seconds + 60.0)
    for bus in buses:
        bus.close()


def _figures(sides: list[Side]) -> Figures:
    figures: Figures = {}
    for side in sides:
        times_s = [side.arrived[value] - at_s for value, at_s in side.sent.items() if value in side.arrived]
        figures[side.name] = {**spread(times_s), "arrived": len(times_s), "sent": len(side.sent)}
    plain, secured = (figures[side.name] for side in sides)
    figures["ratio"] = {name: secured[name] / plain[name] for name in ("p50_us", "p99_us")}
    return figures


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    figures = measure(options.seconds)
    if options.json:
        print(json.dumps(figures, indent=2))
        return
    for name in ("tcp", "tls"):
        row = figures[name]
        print(
            f"{name}  p50 {row['p50_us']:6.0f} µs   p99 {row['p99_us']:7.0f} µs   {row['arrived']:.0f} of "
            f"{row['sent']:.0f} arrived"
        )
    print(
        f"ratio  p50 {figures['ratio']['p50_us']:.2f}   p99 {figures['ratio']['p99_us']:.2f}      (target {TARGET:g})"
    )


if __name__ == "__main__":
    main()
