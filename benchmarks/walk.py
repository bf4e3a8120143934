"""How far a request and a control tick walk through the code: calls, functions and files of one robot in lockstep.

A reader that follows a request from the operator to the wheels opens this many files. Counted by the interpreter's own
profiler, without what kernels call among themselves.

    python -m benchmarks.walk [--json] [--files]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from fullswarm.config import SwarmConfig
from fullswarm.launch.lockstep import Lockstep
from fullswarm.logs import quiet
from fullswarm.operator.client import Operator

PACKAGE = Path(__file__).parents[1] / "fullswarm"
SETTLE_S = 1.013


@dataclass
class Walk:
    """What was called meanwhile.

    Attributes
    ----------
    changes : how often a call went from one file into another
    """

    calls: int = 0
    changes: int = 0
    functions: set[tuple[str, int]] = field(default_factory=set)
    files: set[str] = field(default_factory=set)

    def of(self, do: Callable[[], object]) -> Walk:
        """Add all that `do` calls within the package."""
        sys.setprofile(self._note)
        try:
            do()
        finally:
            sys.setprofile(None)
        return self

    def _note(self, frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(str(PACKAGE)):
            return
        self.calls += 1
        self.functions.add((code.co_filename, code.co_firstlineno))
        self.files.add(code.co_filename)
        caller = frame.f_back
        self.changes += caller is not None and caller.f_code.co_filename != code.co_filename

    def row(self) -> dict[str, int]:
        """Return the figures."""
        return {
            "calls": self.calls, "functions": len(self.functions), "files": len(self.files), "changes": self.changes,
        }  # fmt: skip


def walks() -> dict[str, Walk]:
    """Return what is walked by a filtered request up to the applied twist, and by one control tick."""
    config = SwarmConfig.model_validate(
        {"world": {"engine": "kinematic"}, "robot": [{"id": "r1", "pose": (1.0, 1.0, 0.0)}]}
    )
    swarm = Lockstep(config)
    operator = Operator(swarm.bus, swarm.keys, swarm.runtime, "walk")
    try:
        swarm.runtime.run(SETTLE_S)
        world = swarm.world

        def until_it_drives() -> None:
            operator.request("move_to_goal_bc", (), {"goal": [4.0, 4.0]})
            for _ in range(1000):
                swarm.runtime.run(0.001)
                if world.target[0].any():
                    return
            raise SystemExit("the robot does not drive")

        request = Walk().of(until_it_drives)
        swarm.runtime.run(SETTLE_S)
        tick = Walk().of(swarm.agents[0].tick)
    finally:
        operator.close()
        swarm.close()
    return {"filtered request": request, "control tick": tick}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--files", action="store_true", help="list the files as well")
    wanted = parser.parse_args()
    quiet()  # stdout is for the table
    found = walks()
    if wanted.json:
        print(json.dumps({name: walk.row() for name, walk in found.items()}, indent=2))
        return
    for name, walk in found.items():
        print(f"{name:18}" + "".join(f"{value:8} {key}" for key, value in walk.row().items()))
        if wanted.files:
            print(*(f"    {Path(each).relative_to(PACKAGE)}" for each in sorted(walk.files)), sep="\n")


if __name__ == "__main__":
    main()
