"""From a moved stick to the twist at the driver, across four processes, beside a bare zenoh hop.

The pad is SDL's virtual one, in a process that runs the real `fullswarm joystick`: SDL → pilot → request → main
controller → request handler → agent → driver. The stick moves at no fixed phase to the pilot's looks at it (each 5 ms,
so half of that is waiting). The reference is one zenoh put through the same hub, in the same run and interleaved.

    python -m benchmarks.joystick [--seconds 20] [--json]
"""

from __future__ import annotations

import argparse
import json
import random
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import closing

import zenoh

from benchmarks.beside_hop import (
    HOP,
    HOP_KEY,
    PADDING,
    STAMP,
    TWIST,
    Figures,
    Logged,
    compared,
    patient_config,
    ratio,
    rows,
    swarm_processes,
)
from fullswarm.config import SwarmConfig
from fullswarm.launch.network import on_free_ports
from fullswarm.operator.joystick.pads import FULL
from fullswarm.operator.joystick.pilot import DIGITS

OURS = "stick to twist"
MOVED, DONE = 7, 8
RATE_HZ = 12.0
BINDINGS = """
[motion]
dead_zone = 0.0
share_without_turbo = 1.0
[[sticks]]
behaviour = "drive"
axes = { linear = "leftx" }
parameters = { speed_m_s = 1.0 }
"""


def serve_pad(port: int, seconds: float, hub: str) -> None:
    """Run the joystick command with a virtual pad that moves, and report when it did."""
    from fullswarm.cli.main import app
    from fullswarm.testing.pad import VirtualPad

    pad = VirtualPad()
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    chance = random.Random(1)

    def stick(raw: int) -> int:
        """Move it further, by more than the pilot's resolution, and report."""
        time.sleep(chance.uniform(0.5, 1.5) / RATE_HZ)
        raw = 3000 + (raw - 3000 + 7) % 25000
        moved_s = time.monotonic()
        pad.axis("leftx", raw / FULL)
        out.sendto(STAMP.pack(MOVED, round(raw / FULL, DIGITS), moved_s), ("127.0.0.1", port))
        return raw

    def driven() -> bool:
        return bool(select.select([out], [], [], 0.0)[0])

    def move() -> None:
        raw = 3000
        while not driven():  # hub, core and agent may still be starting: whoever was refused presses again
            pad.button("leftshoulder", False)
            time.sleep(0.5)
            pad.button("leftshoulder", True)
            for _ in range(20):
                raw = stick(raw)
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            raw = stick(raw)
        pad.button("leftshoulder", False)
        time.sleep(0.5)
        out.sendto(STAMP.pack(DONE, 0.0, 0.0), ("127.0.0.1", port))

    threading.Thread(target=move, daemon=True).start()
    with tempfile.NamedTemporaryFile("w", suffix=".toml") as bindings:
        bindings.write(BINDINGS)
        bindings.flush()
        app(["joystick", "--hub", hub, "--bindings", bindings.name], prog_name="fullswarm")


def measure(seconds: float) -> Figures:
    """Run everything; return p50, p99 in µs and counts for the hop, the stick and their ratio."""
    config = on_free_ports(SwarmConfig.model_validate({"robot": [{"id": "r1", "driver": "null://r1"}]}))
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.bind(("127.0.0.1", 0))
    port, hub = listener.getsockname()[1], config.hub.endpoint
    with closing(listener), swarm_processes(config, port) as children, zenoh.open(patient_config(hub)) as session:
        pad = [sys.executable, "-m", "benchmarks.joystick", "--pad", hub, "--port", str(port)]
        pad += ["--seconds", str(seconds)]
        children.append(subprocess.Popen(pad, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL))
        return compared(*_collect(listener, session, seconds), OURS)


def _collect(listener: socket.socket, session: zenoh.Session, seconds: float) -> tuple[Logged, Logged]:
    """Return when each value was sent and when it arrived; a bare hop goes out half-way between two moves."""
    sent: Logged = {HOP: {}, TWIST: {}}
    arrived: Logged = {HOP: {}, TWIST: {}}
    listener.settimeout(seconds + 60.0)
    publisher = session.declare_publisher(HOP_KEY, congestion_control=zenoh.CongestionControl.DROP)

    def hop(value: float) -> None:
        sent[HOP][value] = time.monotonic()
        publisher.put(STAMP.pack(HOP, value, 0.0) + PADDING)

    begun, pad = False, None
    while True:
        data, address = listener.recvfrom(64)
        which, value, at_s = STAMP.unpack(data)
        value = round(value, DIGITS)
        if which == DONE:
            return sent, arrived
        if which == MOVED:
            pad = address
            if begun:
                sent[TWIST][value] = at_s
                threading.Timer(0.25 / RATE_HZ, hop, (value,)).start()
        elif which == TWIST and not begun and pad is not None:
            begun = True
            listener.sendto(b"driven", pad)
        else:
            arrived[which].setdefault(value, at_s)


def main() -> None:
    """Run as the benchmark or, with a hidden option, as the process of its pad."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--pad", help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.pad:
        serve_pad(options.port, options.seconds, options.pad)
        return
    figures = measure(options.seconds)
    if options.json:
        print(json.dumps(figures, indent=2))
        return
    for line in (*rows(figures, OURS), ratio(figures)):
        print(line)


if __name__ == "__main__":
    main()
