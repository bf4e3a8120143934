"""What benchmarks share that measure a way through several processes beside a bare zenoh hop through the same hub."""

from __future__ import annotations

import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import zenoh

from fullswarm.bus.zenoh_bus import client_config
from fullswarm.config import SwarmConfig
from fullswarm.config.fleet_file import write_swarm

STAMP = struct.Struct("<Bdd")  # which, value, seconds
HOP, TWIST = 0, 1
HOP_KEY = "benchmark/hop"
PADDING = bytes(160)
"""Makes the bare message as long as an encoded request."""

Logged = dict[int, dict[float, float]]
"""Which → value → seconds."""
Figures = dict[str, dict[str, float]]


@contextmanager
def swarm_processes(config: SwarmConfig, port: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Run hub, core, the stamping agent and the far end of the hop, which report to `port`; more may be added."""
    hub, python = config.hub.endpoint, [sys.executable, "-m"]
    with tempfile.TemporaryDirectory() as folder:
        fleet = Path(folder) / "fleet.toml"
        write_swarm(config, fleet)
        commands = [
            [*python, "fullswarm", "hub", "--listen", hub],
            [*python, "fullswarm", "core", "--fleet", str(fleet)],
            [*python, "benchmarks.latency", "--agent", str(fleet), "--port", str(port)],
            [*python, "benchmarks.latency", "--hop", hub, "--port", str(port)],
        ]
        children = [subprocess.Popen(command, stdin=subprocess.PIPE) for command in commands]
        try:
            yield children
        finally:
            for child in reversed(children):
                child.terminate()
            for child in children:
                child.wait()
                if child.stdin:
                    child.stdin.close()


def patient_config(hub: str) -> zenoh.Config:
    """Return the settings of a session whose hub may still be starting."""
    settings = client_config(hub, multicast=False)
    settings.insert_json5("connect/timeout_ms", "-1")
    return settings


def spread(times_s: Sequence[float]) -> dict[str, float]:
    """Return p50 and p99 in µs; the first tenth warms up."""
    late = np.array(times_s[len(times_s) // 10 :]) * 1e6
    return {"p50_us": float(np.percentile(late, 50)), "p99_us": float(np.percentile(late, 99))}


def compared(sent: Logged, arrived: Logged, ours: str) -> Figures:
    """Return the figures of the bare hop, of `ours`, and their ratio."""
    figures: Figures = {}
    for which, name in ((HOP, "bare hop"), (TWIST, ours)):
        times_s = [arrived[which][value] - at_s for value, at_s in sent[which].items() if value in arrived[which]]
        figures[name] = {**spread(times_s), "arrived": len(times_s), "sent": len(sent[which])}
    hop = figures["bare hop"]
    figures["ratio"] = {name: figures[ours][name] / hop[name] for name in ("p50_us", "p99_us")}
    return figures


def rows(figures: Figures, ours: str) -> Iterator[str]:
    """Yield the lines of the two ways."""
    for name in ("bare hop", ours):
        row = figures[name]
        yield (
            f"{name:18} p50 {row['p50_us']:7.0f} µs   p99 {row['p99_us']:7.0f} µs   {row['arrived']:.0f} of "
            f"{row['sent']:.0f} arrived"
        )


def ratio(figures: Figures) -> str:
    """Return the line of their ratio."""
    return f"{'ratio':18} p50 {figures['ratio']['p50_us']:7.2f}      p99 {figures['ratio']['p99_us']:7.2f}"
