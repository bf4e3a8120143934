"""N live robots on this machine, beside N processes of bare zenoh that do nothing but exchange 48 bytes.

Each robot is a real agent process on one hub, with a filtered behaviour on, states by grid cell at the paper's density
(32 in 20 x 20 m); a real core is there too. The bare swarm sends at the same rate on the same cells through the same
kind of hub, in the same run. Read the ratios: the milliseconds belong to the machine. At equal density the swarm's
edge counts: `senders` is how many neighbours' states a robot gets.

    python -m benchmarks.swarm [--robots 8 32 64] [--all 32] [--rate 20] [--control 50] [--seconds 5] [--profile]
                               [--no-bare] [--json]

`age` is from the sender's stamp to the node's handler; `late` ticks of the control loop (bare: of the sending loop)
began more than 1 ms after their time, `missed` ones were skipped. CPU is in % of one core, `others` of everything
else that ran here meanwhile.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import pstats
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from benchmarks.swarm_run import SENSING_M, Figures, layout, run

HEAD = (
    f"{'N':>3} {'swarm':11} {'senders':>7} {'delivered':>9} {'age p50':>8} {'p99 ms':>7} {'late':>6} {'missed':>6} "
    f"{'p99 ms':>6} {'CPU/robot':>9} {'hub':>5} {'core':>5} {'cores':>5} {'others':>6} {'RSS MB':>6} {'threads':>7}"
)
PROFILE_ROWS = 15


def row(each: Figures, name: str = "") -> str:
    return (
        f"{each.robots:>3} {name or each.kind:11} {each.senders_per_robot:>5.1f} {each.delivered:>9.2%} "
        f"{each.age_p50_ms:>8.2f} {each.age_p99_ms:>7.2f} {each.late:>6.2%} {each.missed:>6.2%} "
        f"{each.late_p99_ms:>6.2f} {each.cpu_per_robot:>8.2f}% {each.cpu_hub:>4.1f}% {each.cpu_core:>4.1f}% "
        f"{each.cores:>5.2f} {each.cpu_others:>5.0f}% {each.rss_mb:>6.1f} {each.threads:>7.1f}"
    )


def ratio(ours: Figures, bare: Figures) -> dict[str, float]:
    """Return ours over bare."""
    return {
        "age_p50": ours.age_p50_ms / bare.age_p50_ms,
        "age_p99": ours.age_p99_ms / bare.age_p99_ms,
        "cpu_per_robot": ours.cpu_per_robot / bare.cpu_per_robot,
    }


def by_thread(each: Figures) -> str:
    """Return the mean CPU per robot of each kind of thread: rx, tx and app are zenoh's, python is the node's."""
    return ", ".join(f"{name} {share:.2f}%" for name, share in each.threads_cpu.items() if share >= 0.005)


def rospy() -> str:
    """Return whether Debian's rospy could be compared with."""
    python = "/usr/bin/python3"
    if not Path(python).exists() or subprocess.run([python, "-c", "import rospy"], capture_output=True).returncode:
        return "not installed"
    return "installed, but this benchmark does not run it"


def top_of(profile: Path, ticks: int) -> str:
    """Return where an agent's CPU went, per control tick, the profiler's own cost included."""
    stats = pstats.Stats(str(profile), stream=io.StringIO())
    rows = sorted(stats.stats.items(), key=lambda item: -item[1][3])[:PROFILE_ROWS]  # type: ignore[attr-defined]
    lines = [f"{'µs/tick':>8} {'own':>7} {'calls/tick':>10}  function (thread of the node, under cProfile)"]
    for (file, line, name), (_, calls, own_s, total_s, _) in rows:
        total_us, own_us = 1e6 * total_s / ticks, 1e6 * own_s / ticks
        place = f"{Path(file).parent.name}/{Path(file).name}:{line}" if line else ""
        lines.append(f"{total_us:>8.1f} {own_us:>7.1f} {calls / ticks:>10.2f}  {name} {place}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="*", default=[8, 32, 64], help="swarm sizes, states by grid cell")
    parser.add_argument("--all", type=int, nargs="*", default=[32], help="sizes with one key for the whole swarm")
    parser.add_argument("--rate", type=float, default=20.0, help="states per second of each robot")
    parser.add_argument("--control", type=float, default=50.0, help="control loop of each robot, Hz")
    parser.add_argument("--seconds", type=float, default=5.0, help="of measuring, per swarm")
    parser.add_argument("--no-bare", action="store_true", help="leave the reference out")
    parser.add_argument("--profile", action="store_true", help="profile one agent of each swarm")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    options = parser.parse_args()
    report: list[dict[str, object]] = []
    if not options.json:
        print(f"{options.rate:g} Hz states, {options.control:g} Hz control, {os.cpu_count()} cores\n{HEAD}")
    first: Figures | None = None
    for cell_m, sizes in ((SENSING_M, options.robots), (0.0, options.all)):
        for count in sizes:
            config = layout(count, options.rate, options.control, cell_m)
            with tempfile.TemporaryDirectory() as folder:
                profile = Path(folder) / "agent.prof" if options.profile else None
                ours = run("agent", config, options.seconds, profile)
                top = top_of(profile, ours.ticks // count) if profile else ""
            bare = None if options.no_bare else run("bare", config, options.seconds)
            entry: dict[str, object] = {"cell_m": cell_m, "fullswarm": asdict(ours) | {"cores": ours.cores}}
            if bare:
                entry |= {"bare": asdict(bare) | {"cores": bare.cores}, "ratio": ratio(ours, bare)}
            report.append(entry)
            if options.json:
                continue
            print(row(ours, "" if cell_m else "one key"), flush=True)
            if bare:
                print(row(bare), flush=True)
                print("    ratio: " + "   ".join(f"{name} {value:.2f}" for name, value in ratio(ours, bare).items()))
            print(f"    tick {ours.tick_cpu_us:.0f} µs of CPU; by thread: {by_thread(ours)}")
            if bare:
                print(f"    bare by thread: {by_thread(bare)}")
            if cell_m:
                first = first or ours
                print(f"    CPU per robot against N = {first.robots}: {ours.cpu_per_robot / first.cpu_per_robot:.2f}")
            if top:
                print(top)
    if options.json:
        print(json.dumps({"swarms": report, "rospy": rospy()}, indent=2))
    else:
        print(f"rospy: {rospy()}")


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
