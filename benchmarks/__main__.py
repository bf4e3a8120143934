"""Run all benchmarks one after the other: ``python -m benchmarks`` (``make bench``), about twenty minutes."""

from __future__ import annotations

import subprocess
import sys

ALL = (
    ("benchmarks.lockstep",),
    ("benchmarks.bus", "--seconds", "5"),
    ("benchmarks.latency",),
    ("benchmarks.secure_latency",),
    ("benchmarks.joystick",),
    ("benchmarks.console", "--seconds", "3"),
    ("benchmarks.console_page", "--seconds", "8"),
    ("benchmarks.swarm",),
    ("benchmarks.estop",),
    ("benchmarks.filter",),
    ("benchmarks.crowds", "--cases", "open,swap", "--robots", "8,16", "--seeds", "1", "--check"),
    ("benchmarks.doors", "--positions", "2", "--check"),
    ("benchmarks.create",),
    ("benchmarks.mavlink",),
    ("benchmarks.can_bus",),
    ("benchmarks.agent_start",),
    ("benchmarks.release",),
    ("benchmarks.shell_start",),
    ("benchmarks.fault_matrix", "--check"),
    ("benchmarks.fleet",),
    ("benchmarks.hostile_mcp", "--minutes", "1"),
)


def main() -> int:
    """Run each in a process of its own; return how many failed."""
    failed = 0
    for module, *options in ALL:
        print(f"\n== python -m {module} {' '.join(options)}", flush=True)
        failed += subprocess.run([sys.executable, "-m", module, *options], check=False).returncode != 0
    return failed


if __name__ == "__main__":
    sys.exit(main())
