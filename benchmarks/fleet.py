"""A fleet of containers with real systemd and sshd: first deploy, second deploy, update, broken release, and the agent.

``python -m benchmarks.fleet [--robots 16] [--json]``, as root (see tests/fleet). Targets: 16 robots deployed in under
60 s, an app-only update of one robot in under 10 s and 1 MB, a second deploy under 100 kB that restarts nothing.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from pathlib import Path

from tests.fleet.fleet import Figures, Fleet, results
from tests.fleet.lab import Lab
from tests.fleet.tools import Missing, missing


def _second_deploy(fleet: Fleet) -> None:
    starts, before = fleet.lab.starts(), fleet.moved_bytes()
    took_s = fleet.lab.cli("deploy", "--json").took_s
    sent = (fleet.moved_bytes() - before) / len(fleet.lab.robots)
    restarted = sum(fleet.lab.starts()[robot] != start for robot, start in starts.items())
    fleet.figures.note("second deploy of the same", f"{took_s:.1f} s")
    fleet.figures.note("  moved per robot", f"{sent / 1e3:.1f} kB", "100 kB")
    fleet.figures.note("  agents restarted", f"{restarted}", "0")


def _update(fleet: Fleet) -> None:
    lab, before = fleet.lab, fleet.moved_bytes()
    alone_s = [lab.cli("update", robot, "--release", fleet.second).took_s for robot in lab.robots[:3]]
    sent = (fleet.moved_bytes() - before) / len(alone_s)
    all_s = lab.cli("update", "--release", fleet.second).took_s
    fleet.figures.note("app-only update of one robot", f"{statistics.median(alone_s):.1f} s", "10 s")
    fleet.figures.note("  sent", f"{sent / 1e3:.1f} kB", "1 MB")
    fleet.figures.note(f"  of {len(lab.robots)}: canary, wave, rest", f"{all_s:.1f} s", "120 s for 32")


def _broken(fleet: Fleet) -> None:
    everywhere = ("--canary", "0", "--wave", "100%", "--stop-at", "64", "--at-a-time", "16")
    done = fleet.lab.cli("update", "--release", fleet.broken, *everywhere, "--json", code=1)
    back = sum(result == "rolled back" for result in results(done).values())
    fleet.figures.note("broken release on all at once", f"{done.took_s:.1f} s")
    fleet.figures.note("  rolled back by themselves", f"{back}", f"{len(fleet.lab.robots)}")


def _agent(fleet: Fleet) -> None:
    """How long an agent takes from its start to READY, and what it holds in memory, alone on its computer."""
    starts_s, sizes_mb = [], []
    for robot in fleet.lab.robots[:5]:
        computer = fleet.lab.computers[robot]
        computer.do("systemctl", "restart", "fullswarm-agent")  # waits for READY
        shown = computer.do(
            "systemctl", "show", "fullswarm-agent", "--value", "-p", "MainPID",
            "-p", "ExecMainStartTimestampMonotonic", "-p", "ActiveEnterTimestampMonotonic",
        ).split()  # fmt: skip
        numbers = sorted(map(int, shown))
        starts_s.append((numbers[2] - numbers[1]) / 1e6)
        status = computer.do("cat", f"/proc/{numbers[0]}/status")
        resident = next(line for line in status.splitlines() if line.startswith("VmRSS"))
        sizes_mb.append(int(resident.split()[1]) / 1000)
    fleet.figures.note("agent: start to READY", f"{statistics.median(starts_s):.2f} s")
    fleet.figures.note("  resident, without its guardian", f"{statistics.median(sizes_mb):.0f} MB")


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if lacking := missing():
        print(f"skipped: {lacking}", file=sys.stderr)
        return 0
    figures = Figures()
    with tempfile.TemporaryDirectory() as folder:
        try:
            with Lab(options.robots, Path(folder)) as lab:
                fleet = Fleet(lab, figures)
                figures.note(f"first deploy of {options.robots}", f"{fleet.deployed.took_s:.1f} s", "60 s for 16")
                figures.note("  moved per robot", f"{fleet.deployed_bytes / options.robots / 1e6:.1f} MB")
                for part in (_second_deploy, _update, _agent, _broken):
                    part(fleet)
        except Missing as error:
            print(f"skipped: {error}", file=sys.stderr)
            return 0
    if options.json:
        print(
            json.dumps(
                [{"what": what.strip(), "value": value, "target": target} for what, value, target in figures.rows]
            )
        )
    else:
        print("\n".join(figures.lines()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
