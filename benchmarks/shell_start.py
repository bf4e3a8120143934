"""How long the shell takes to answer: ``--help``, the help of each command, and ``status`` without a hub.

``python -m benchmarks.shell_start [--rounds 5] [--all] [--json]``. The reference is ``python -c pass`` in the same run;
rounds alternate. Read the ratios: milliseconds belong to the machine, and to what else runs on it. CPU time is the
process's own and says what an idle machine would take.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import asdict, dataclass

PASS = ("-c", "pass")
SHELL = ("-m", "fullswarm")
USUAL = ((*SHELL, "--help"), (*SHELL, "up", "--help"), (*SHELL, "status", "--help"), (*SHELL, "results", "--help"))
NO_HUB = (*SHELL, "status", "--hub", "tcp/127.0.0.1:9")


@dataclass(frozen=True)
class Start:
    """Medians of a command: seconds by the wall clock and of the processor, and how often those of ``pass``."""

    command: str
    wall_s: float
    cpu_s: float
    ratio: float


def once(arguments: tuple[str, ...]) -> tuple[float, float]:
    """Run a command; return seconds by the wall clock and of the processor."""
    began_s = time.perf_counter()
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, _, used = os.wait4(process.pid, 0)
    process.returncode = 0
    return time.perf_counter() - began_s, used.ru_utime + used.ru_stime


def commands() -> list[tuple[str, ...]]:
    """Return the help of every command, as arguments of Python."""
    from typer.main import get_command

    from fullswarm.cli.main import app

    return [(*SHELL, name, "--help") for name in getattr(get_command(app), "commands", {})]


def measure(asked: list[tuple[str, ...]], rounds: int) -> list[Start]:
    """Run all commands in turn, `rounds` times; return the medians, the slowest first."""
    times: dict[tuple[str, ...], list[tuple[float, float]]] = {each: [] for each in (PASS, *asked)}
    for each in times:
        once(each)  # what it loads is then cached by the system
    for _ in range(rounds):
        for each, found in times.items():
            found.append(once(each))
    medians = {
        each: [statistics.median(column) for column in zip(*found, strict=True)] for each, found in times.items()
    }
    base_s = medians[PASS][1]
    starts = [Start(" ".join(each[1:]), wall, cpu, cpu / base_s) for each, (wall, cpu) in medians.items()]
    return sorted(starts, key=lambda start: -start.cpu_s)


def main() -> int:
    """Print a line per command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--all", action="store_true", help="the help of every command")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    asked = [USUAL[0], *commands(), NO_HUB] if options.all else [*USUAL, NO_HUB]
    starts = measure(asked, options.rounds)
    if options.json:
        print(json.dumps([asdict(each) for each in starts], indent=2))
        return 0
    print(f"{'command':40} {'wall':>8} {'CPU':>8} {'CPU / pass':>11}")
    for each in starts:
        print(f"{each.command:40} {each.wall_s:6.2f} s {each.cpu_s:6.2f} s {each.ratio:11.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
