"""Typed nonsense of every kind against live processes: none ends, none grows, and the robots still obey."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from fullswarm.keys import Keys
from fullswarm.messages import EStop
from tests.system.live import LiveSwarm

pytestmark = pytest.mark.alone

KEYS = Keys()
CONFIG = {
    "world": {"engine": "kinematic", "bounds_m": [0, 0, 10, 10], "boxes": [[5.0, 2.0, 1.0, 1.0, 0.3]]},
    "robot": [{"id": f"r{number}"} for number in range(1, 4)],
    "groups": {"team": ["r1", "r2"]},
}
GROWTH_MB = 20.0


def rss_mb(pid: int) -> float:
    """Return the memory of a process that is in use, MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmRSS"))


def fuzz(swarm: LiveSwarm, seed: int, count: int, per_second: float) -> None:
    command = [sys.executable, "-m", "tests.system.fuzz_process", swarm.config.hub.endpoint]
    process = subprocess.Popen([*command, str(seed), str(count), str(per_second)])
    swarm.until(lambda: process.poll() is not None, 10.0 * count / per_second + 60.0, "all is sent")
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("count", "per_second"), [(20_000, 2000.0), pytest.param(1_000_000, 3000.0, marks=pytest.mark.slow)]
)
def test_no_message_ends_or_fills_a_process(count: int, per_second: float) -> None:
    swarm = LiveSwarm(CONFIG, watch=False)
    console = swarm.spawn("console", "--listen", "127.0.0.1:0")
    try:
        children = {name: child.process for name, child in swarm.supervisor.children.items()}
        pids = {name: process.pid for name, process in children.items() if process is not None}
        pids["console"] = console.pid
        swarm.rest(2.0)
        fuzz(swarm, 1, count // 10, per_second)  # what is allocated once
        before = {name: rss_mb(pid) for name, pid in pids.items()}
        fuzz(swarm, 2, count, per_second)
        swarm.rest(2.0)
        ended = [name for name, process in children.items() if process is None or process.poll() is not None]
        assert not ended, "\n".join(swarm.supervisor.log_tail(name, 30) for name in ended)
        assert console.poll() is None, console.communicate()[1]
        grown = {name: rss_mb(pid) - before[name] for name, pid in pids.items()}
        sys.stdout.write(f"{count} messages; MB at first {before}; grown by {grown}\n")
        assert max(grown.values()) < GROWTH_MB, grown
        swarm.bus.publish(KEYS.estop, EStop(id="release", engaged=False, source="test"))
        swarm.rest(6.0)
        swarm.operator.request("move_to_goal_bc", swarm.config.robots, {"goal": [8.0, 8.0]}, take=True)
        swarm.until(lambda: swarm.all_run("move_to_goal_bc"), 15.0, "all robots obey")
    finally:
        console.terminate()
        console.communicate(timeout=20.0)
        swarm.close()
