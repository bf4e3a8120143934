"""A robot whose cable is pulled by the kernel. Run by test_network.py inside ``unshare -rn``; prints times as JSON.

Two network namespaces and a cable between them: here the hub and the core, over there the robot's agent and its body.
With ``secured`` the hub asks for certificates, and the robot's lives so short that it must be renewed over the cable.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

from fullswarm.bringup.certificates import issue_all
from fullswarm.bus.endpoint import credentials_at
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.config import SwarmConfig
from fullswarm.config.fleet_file import write_swarm
from fullswarm.identity.authority import Authority, copy_to
from fullswarm.identity.certificates import DAY_S, Certificate, read_certificate
from fullswarm.identity.folder import IDENTITY, KeysFolder
from fullswarm.keys import Keys
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.simulation.server import WorldServer
from tests.system.live import WatchedWorld

SECURED = "secured" in sys.argv
HUB = f"{'tls' if SECURED else 'tcp'}/10.77.0.1:7447"
OPERATOR = "anna"
LIFE_S = 45.0
"""Of the robot's certificate: longer than interpreters take to start on a machine with other work."""
CONFIG = SwarmConfig.model_validate(
    {
        "hub": {"endpoint": HUB},
        "world": {"engine": "kinematic", "bounds_m": [0, 0, 90, 90], "watchdog_s": 5.0},
        "robot": [{"id": "r1", "pose": [2.0, 2.0, 0.0]}],
    }
)
CUT_S = 3.0
clock = MonotonicClock()


def sh(command: str) -> None:
    subprocess.run(["sh", "-ec", command], check=True, stdout=subprocess.DEVNULL)


def tell(what: object) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def body() -> None:
    """Be the robot's body in the other namespace: tell each change between driving and standing."""
    runtime = Runtime(clock, Mailbox())
    runtime.stop_on_signals()
    world = WatchedWorld(CONFIG, clock)
    server = WorldServer(world)
    was = False

    def look() -> None:
        nonlocal was
        server.tick()
        if (now := bool(world.setpoint.any())) is not was:
            was = now
            tell([now, clock.now_s()])

    runtime.every(1.0 / CONFIG.world_or_default.rate_hz, look)
    runtime.run()
    server.close()
    world.close()


def make_keys(folder: Path) -> list[str]:
    """Make the base's keys here and the robot's in a folder of its own; return what the robot's side starts with."""
    os.environ[IDENTITY] = str(folder / "base")
    authority = Authority.make(KeysFolder.of(CONFIG.swarm))
    assert all(each.state == "issued" for each in issue_all(authority, CONFIG))
    authority.issue(OPERATOR, "operator")
    authority.renew("r1", days=LIFE_S / DAY_S)
    copy_to(authority.folder, "r1", folder / "robot")
    return ["env", f"{IDENTITY}={folder / 'robot'}"]


class Cable:
    """The processes on both ends, and what the body tells."""

    def __init__(self, folder: Path) -> None:
        self.there = make_keys(folder) if SECURED else []
        self.files = KeysFolder.of(CONFIG.swarm, folder / "robot")
        self.first = self.certificate() if SECURED else None
        self.fleet = folder / "fleet.toml"
        write_swarm(CONFIG, self.fleet)
        self.processes: list[subprocess.Popen[str]] = []
        self.told: list[tuple[bool, float]] = []
        sh("ip link set lo up; ip addr add 10.77.0.1/32 dev lo; ip link add v0 type veth peer name v1")
        self.far = self.start(["unshare", "-n", "sh", "-c", "echo here; exec sleep 600"])
        assert self.far.stdout is not None
        self.far.stdout.readline()
        pid = self.far.pid
        sh(f"ip link set v1 netns {pid}; ip addr add 10.78.0.1/24 dev v0; ip link set v0 up")
        sh(
            f"nsenter -t {pid} -n sh -ec 'ip link set lo up; ip addr add 10.78.0.2/24 dev v1; ip link set v1 up;"
            " ip route add 10.77.0.1 via 10.78.0.1'"
        )

    def certificate(self) -> Certificate:
        """Return the robot's certificate, as it is on its side of the cable."""
        return read_certificate(self.files.certificate_path("r1"))

    def start(self, command: list[str]) -> subprocess.Popen[str]:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.processes.append(process)
        return process

    def start_all(self) -> None:
        python = [sys.executable, "-m"]
        self.start([*python, "fullswarm", "hub", "--listen", HUB, *([] if SECURED else ["--insecure-network"])])
        for name in ("core", "centralised"):
            self.start([*python, "fullswarm", name, "--fleet", str(self.fleet)])
        there = ["nsenter", "-t", str(self.far.pid), "-n", *self.there, *python]
        told = self.start([*there, "tests.system.cut_cable", "body"])
        threading.Thread(target=self._read, args=(told,), daemon=True).start()
        self.start([*there, "fullswarm", "agent", "r1", "--fleet", str(self.fleet)])

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        self.told += (tuple(json.loads(line)) for line in process.stdout)

    def driven(self) -> bool:
        return bool(self.told) and self.told[-1][0]

    def pull(self) -> None:
        sh("ip link set v0 down")

    def plug(self) -> None:
        sh("ip link set v0 up")

    def close(self) -> None:
        for process in reversed(self.processes):
            process.send_signal(signal.SIGTERM)
        for process in self.processes:
            process.wait(5.0)


def until(runtime: Runtime, condition: Callable[[], bool], limit_s: float, what: str) -> None:
    end_s = clock.now_s() + limit_s
    while not condition():
        if clock.now_s() > end_s:
            raise SystemExit(f"waited {limit_s} s for: {what}")
        runtime.run(0.01)


def outlive(cable: Cable, runtime: Runtime) -> dict[str, object]:
    """Wait until the robot's first certificate has expired; tell whether it was renewed, and the robot still drives."""
    first = cable.first
    assert first is not None
    until(runtime, lambda: cable.certificate().expires_s > first.expires_s, LIFE_S, "the certificate is renewed")
    runtime.run(max(0.0, first.expires_s - wall_time_s()) + 2.0)
    return {"renewed": cable.certificate().common_name == first.common_name, "drives": cable.driven()}


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        cable = Cable(Path(folder))
        runtime = Runtime(clock, Mailbox())
        bus = None
        try:
            cable.start_all()
            credentials = credentials_at(HUB, CONFIG.swarm, OPERATOR, "operator")
            bus = ZenohBus(runtime.mailbox, hub=HUB, credentials=credentials)
            operator = Operator(bus, Keys(CONFIG.swarm), runtime, "test", name=OPERATOR)
            operator.request("move_to_goal", (), {"goal": [80.0, 80.0]})
            until(runtime, cable.driven, 60.0, "the robot drives")
            runtime.run(1.0)
            pulled_s = clock.now_s()
            cable.pull()
            until(runtime, lambda: not cable.driven(), 10.0, "the robot stands")
            stood_s = cable.told[-1][1]
            runtime.run(max(0.0, pulled_s + CUT_S - clock.now_s()))
            stayed = not cable.driven()
            states: list[RequestStatus] = []
            operator.request("move_to_goal", ("r1",), {"goal": [80.0, 10.0]}, states.append)
            plugged_s = clock.now_s()
            cable.plug()
            until(runtime, cable.driven, 20.0, "the robot drives again")
            drove_after_s = cable.told[-1][1] - plugged_s
            until(
                runtime, lambda: bool(states) and states[-1].phase == "running", 10.0, "what was asked meanwhile runs"
            )
            found = {"stood_after_s": stood_s - pulled_s, "stayed": stayed, "drove_after_s": drove_after_s}
            tell(found | {"phases": [each.phase for each in states]} | (outlive(cable, runtime) if SECURED else {}))
            operator.close()
        finally:
            if bus is not None:
                bus.close()
            cable.close()


if __name__ == "__main__":
    body() if sys.argv[1:] == ["body"] else main()
