"""What a spare process has done in advance, seen from the process that it becomes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fullswarm.config import SwarmConfig
from fullswarm.config.fleet_file import write_swarm
from fullswarm.launch.processes import RUN

BECOME = """
import sys
from fullswarm.launch import spare
spare._prepare()
before = set(sys.modules)
from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.launch import processes
from fullswarm.runtime import Runtime

def build_only(config, with_parent, build, name, identity=None):
    runtime = Runtime(SimClock())
    nodes = list(build(LocalBus(runtime.mailbox), runtime))
    runtime.run(0.2)
    for node in reversed(nodes):
        node.close()
    return 0

processes.serve_on_bus = build_only
from fullswarm.cli.main import main, parser
assert parser.cache_info().currsize == 1
try:
    main()
except SystemExit as end:
    assert end.code == 0
print(*sorted(name for name in set(sys.modules) - before if name.split(".")[0] in ("fullswarm", "pydantic")))
"""
HERE = {"fullswarm.bus.local"}
"""What this test itself imports."""


@pytest.mark.parametrize("command", [("core",), ("centralised",), ("agent", "r1")], ids=" ".join)
def test_a_spare_has_imported_all_that_the_process_needs_which_it_becomes(
    command: tuple[str, ...], tmp_path: Path
) -> None:
    write_swarm(SwarmConfig.model_validate({"robot": [{"id": "r1", "driver": "null://r1"}]}), tmp_path / "fleet.toml")
    environment = {**os.environ, RUN: str(tmp_path), "FULLSWARM_STATE": str(tmp_path / "state")}
    arguments = (*command, "--fleet", str(tmp_path / "fleet.toml"))
    done = subprocess.run(
        [sys.executable, "-c", BECOME, *arguments], env=environment, capture_output=True, text=True, timeout=60.0
    )
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) - HERE == set()
