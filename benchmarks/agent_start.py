"""What an agent on board costs: from its start to READY, and its resident memory, beside what it cannot do without.

``python -m benchmarks.agent_start [--rounds 5] [--json]``. The reference is a bare Python that imports numpy and opens
a zenoh session, in the same run; rounds of the two alternate. Read the ratio of the times and the difference of the
memories: milliseconds belong to the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

TARGET_MB = 70.0
FLEET = '[[robot]]\nid = "r1"\ndriver = "null://r1"\n[hub]\nendpoint = "tcp/127.0.0.1:9"\n'
BARE = """
import os, socket, time
import numpy, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", '["tcp/127.0.0.1:9"]')
config.insert_json5("connect/timeout_ms", "0")
config.insert_json5("connect/exit_on_failure", "false")
config.insert_json5("mode", '"peer"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("listen/endpoints", "[]")
session = zenoh.open(config)
socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).sendto(b"READY=1", os.environ["NOTIFY_SOCKET"])
time.sleep(60)
"""
SETTLE_S = 2.0
START_S = 60.0


@dataclass(frozen=True)
class Cost:
    """Medians: seconds from start to READY, MB resident, MB of them that no other process can share."""

    ready_s: float
    resident_mb: float
    own_mb: float


def one(command: list[str], folder: Path) -> Cost:
    """Start a process that prints READY, measure it, end it."""
    address = str(folder / f"notify-{time.monotonic_ns()}")
    environment = {
        **os.environ, "NOTIFY_SOCKET": address, "FULLSWARM_HEALTH": str(folder / "health.json"),
        "FULLSWARM_STATE": str(folder),
    }  # fmt: skip
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        manager.settimeout(START_S)
        began_s = time.monotonic()
        with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as process:
            try:
                while b"READY=1" not in manager.recv(4096):
                    pass
                ready_s = time.monotonic() - began_s
                time.sleep(SETTLE_S)
                status = Path(f"/proc/{process.pid}/status").read_text()
            finally:
                process.kill()
    return Cost(ready_s, _mb(status, "VmRSS"), _mb(status, "RssAnon"))


def _mb(status: str, name: str) -> float:
    (line,) = (line for line in status.splitlines() if line.startswith(f"{name}:"))
    return int(line.split()[1]) / 1024


def median(costs: list[Cost]) -> Cost:
    """Return the medians, each by itself."""
    rows = zip(*(asdict(each).values() for each in costs), strict=True)
    return Cost(*(round(statistics.median(row), 3) for row in rows))


def main() -> int:
    """Measure and report; 1 when the agent takes more than the target."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fleet = folder / "fleet.toml"
        fleet.write_text(FLEET)
        agent = [sys.executable, "-m", "fullswarm", "agent", "r1", "--fleet", str(fleet)]
        bare = [sys.executable, "-c", BARE]
        rounds = [(one(bare, folder), one(agent, folder)) for _ in range(options.rounds)]
    base, ours = (median(list(column)) for column in zip(*rounds, strict=True))
    ratio, more_mb = ours.ready_s / base.ready_s, ours.resident_mb - base.resident_mb
    if options.json:
        print(json.dumps({"bare": asdict(base), "agent": asdict(ours), "ratio": ratio, "more_mb": more_mb}))
    else:
        print(f"bare python + numpy + zenoh  ready {base.ready_s:.2f} s  resident {base.resident_mb:.1f} MB")
        print(f"agent on board               ready {ours.ready_s:.2f} s  resident {ours.resident_mb:.1f} MB")
        print(f"start ×{ratio:.1f}, {more_mb:.1f} MB more; {ours.own_mb:.1f} MB own; target {TARGET_MB:.0f} MB")
    return int(ours.resident_mb > TARGET_MB)


if __name__ == "__main__":
    sys.exit(main())
