"""From an operator's publish to the twist at the driver, across four processes, beside a bare zenoh hop.

Operator, core and agent are real processes on one hub, as on robots: request → main controller → request handler →
agent → driver. The reference is one zenoh put from this process to another through the same hub, in the same run and
interleaved. All stamps come from one machine's monotonic clock. Target: at most 3 bare hops, at p50 and at p99.

    python -m benchmarks.latency [--seconds 20] [--json]
"""

from __future__ import annotations

import argparse
import json
import random
import socket
import sys
import threading
import time
from pathlib import Path

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
    spread,
    swarm_processes,
)
from fullswarm.bus import Bus
from fullswarm.bus.zenoh_bus import ZenohBus, client_config
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Description, Lifecycle, Limits, Pose, Reading, Twist
from fullswarm.keys import Keys
from fullswarm.launch import nodes, processes
from fullswarm.launch.network import on_free_ports
from fullswarm.messages import BehaviourRequest, ControlRequest
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Mailbox, Runtime

DECIDED = 2
OURS = "request to twist"
RATE_HZ = 20.0
SETTLE_S = 1.0
"""A core that connects after the robot learns of it by the next report; requests before that wait."""


class StampingDriver:
    """A driver that reports each new set-point and when it came; no limits, so that values stay recognisable."""

    url = "null://latency"
    description = Description("benchmark", "stamping", 0.17, Limits(1e3, 1e3, 1e9, 1e9), senses_pose=True)
    fault = firmware = ""

    def __init__(self, port: int) -> None:
        self.state = Lifecycle.CLOSED
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._to = ("127.0.0.1", port)
        self._last = 0.0

    def open(self) -> None:
        """Be ready at once."""
        self.state = Lifecycle.READY

    def activate(self) -> None:
        """Accept set-points."""
        self.state = Lifecycle.ACTIVE

    def deactivate(self) -> None:
        """Accept none."""
        self.state = Lifecycle.READY

    def read(self) -> Reading:
        """Return a pose at the origin, read now."""
        return Reading(stamp_s=time.monotonic(), odometry=Pose(0, 0, 0), twist=Twist(), pose=Pose(0, 0, 0))

    def command(self, twist: Twist) -> Twist:
        """Report a new set-point."""
        if twist.linear_m_s not in (0.0, self._last):
            self._last = twist.linear_m_s
            self._socket.sendto(STAMP.pack(TWIST, twist.linear_m_s, time.monotonic()), self._to)
        return twist

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def serve_agent(fleet: Path, port: int) -> None:
    """Run an agent with the stamping driver."""
    from fullswarm.agent.state import Identity
    from fullswarm.config import load_swarm
    from fullswarm.drivers.fleet import OneRobot

    config = load_swarm(fleet)

    def build(bus: Bus, runtime: Runtime) -> list[nodes.Node]:
        robot = OneRobot("r1", StampingDriver(port))
        return [nodes.agent(bus, runtime, config, robot, Identity("r1", "r1-0"), runtime.stats)]

    processes.serve_on_bus(config, True, build, "r1")


def serve_hop(endpoint: str, port: int) -> None:
    """Report when each bare put arrives."""
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def received(sample: zenoh.Sample) -> None:
        now_s = time.monotonic()
        _, value, _ = STAMP.unpack_from(sample.payload.to_bytes())
        out.sendto(STAMP.pack(HOP, value, now_s), ("127.0.0.1", port))

    with zenoh.open(patient_config(endpoint)) as session:
        session.declare_subscriber(HOP_KEY, zenoh.handlers.Callback(received, indirect=False))
        sys.stdin.read()


def measure(seconds: float) -> Figures:
    """Run everything; return p50, p99 and count in µs for the hop, the request and their ratio."""
    config = on_free_ports(SwarmConfig.model_validate({"robot": [{"id": "r1", "driver": "null://r1"}]}))
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.bind(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    arrived: Logged = {HOP: {}, TWIST: {}}

    def collect() -> None:
        while True:
            which, value, at_s = STAMP.unpack(listener.recv(64))
            if which > TWIST:
                return
            arrived[which][round(value, 6)] = at_s

    collector = threading.Thread(target=collect, daemon=True)
    collector.start()
    with swarm_processes(config, port):
        sent = _send(config, seconds)
    socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(STAMP.pack(9, 0, 0), ("127.0.0.1", port))
    collector.join()
    listener.close()
    return _evaluate(sent, arrived)


def _send(config: SwarmConfig, seconds: float) -> Logged:
    mailbox = Mailbox()
    runtime = Runtime(MonotonicClock(), mailbox)
    bus, keys = ZenohBus(mailbox, hub=config.hub.endpoint), Keys(config.swarm)
    view = FleetView(bus, keys, runtime, ("r1",))
    sent: Logged = {HOP: {}, TWIST: {}, DECIDED: {}}

    def decided(request: ControlRequest) -> None:
        if request.enable:
            sent[DECIDED][round(float(str(request.parameters["linear"])), 6)] = request.stamp_s

    bus.subscribe(keys.control_requests(), ControlRequest, decided)
    bus.wait_connected(20.0)
    with zenoh.open(client_config(config.hub.endpoint, multicast=False)) as session:
        publisher = session.declare_publisher(HOP_KEY, congestion_control=zenoh.CongestionControl.DROP)
        ready_s = 0.0
        count, chance = 0, random.Random(1)

        def ready() -> bool:
            nonlocal ready_s
            snapshot, now_s = view.snapshot(), runtime.now_s()
            if not snapshot.robots or not any(node.node == "core" for node in snapshot.nodes):
                ready_s = now_s + SETTLE_S
            return now_s >= ready_s

        def both() -> None:
            nonlocal count
            # At no fixed phase to the periods of core and agent: that would decide the figure of one run.
            interval_s = chance.uniform(0.5, 1.5) / RATE_HZ
            runtime.after(interval_s, both)
            if not ready():
                return
            count += 1
            value = round(1e-6 * count + 0.1, 6)
            request = BehaviourRequest(
                id=f"b{count}", behaviour="drive", robots=("r1",),
                parameters={"linear": value, "angular": 0.0, "speed_m_s": 1.0, "turn_rad_s": 1.0},
                source="benchmark", stamp_s=runtime.now_s(),
            )  # fmt: skip
            # The hop goes out half-way to the next request: the two never wait for each other, and find equal quiet.
            runtime.after(0.5 * interval_s, lambda: hop(value))
            sent[TWIST][value] = time.monotonic()
            bus.publish(keys.behaviour_request, request)

        def hop(value: float) -> None:
            sent[HOP][value] = time.monotonic()
            publisher.put(STAMP.pack(HOP, value, 0.0) + PADDING)

        both()
        runtime.run(seconds + 3.0)
    bus.close()
    return sent


def _evaluate(sent: Logged, arrived: Logged) -> Figures:
    legs_s = [(sent[DECIDED][v] - at, arrived[TWIST][v] - sent[DECIDED][v]) for v, at in sent[TWIST].items()
              if v in sent[DECIDED] and v in arrived[TWIST]]  # fmt: skip
    names = ("publish to decided", "decided to twist")
    legs = {name: spread([each[leg] for each in legs_s]) for leg, name in enumerate(names)}
    return compared(sent, arrived, OURS) | legs


def main() -> None:
    """Run as the benchmark or, with a hidden option, as one of its processes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--agent", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--hop", help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.agent:
        serve_agent(options.agent, options.port)
    elif options.hop:
        serve_hop(options.hop, options.port)
    else:
        figures = measure(options.seconds)
        if options.json:
            print(json.dumps(figures, indent=2))
            return
        for line in rows(figures, OURS):
            print(line)
        for name in ("publish to decided", "decided to twist"):
            print(f"  {name:18} p50 {figures[name]['p50_us']:5.0f} µs   p99 {figures[name]['p99_us']:7.0f} µs")
        print(f"{ratio(figures)}      (target 3)")


if __name__ == "__main__":
    main()
