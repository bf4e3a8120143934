"""E-stop of a live swarm: how long until each receipt, until each robot stands, and how far it still rolled.

``python -m benchmarks.estop [--robots 20] [--rounds 10] [--json]``. Hub, core, world and one agent per robot are
processes of their own on this machine; all robots drive when a second client of the hub presses. Target: every
round every robot's receipt in under 0.2 s.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, field

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.network import on_free_ports
from fullswarm.launch.supervisor import Supervisor
from fullswarm.messages import EStopReceipt, Value
from fullswarm.operator.client import Operator
from fullswarm.operator.estop import EStopOrder
from fullswarm.operator.view import FleetView, RobotRow
from fullswarm.runtime import Mailbox, Runtime

TARGET_S = 0.2
START_S = 120.0
WAIT_S = 20.0
SPEED_M_S = 0.3
FAR: dict[str, Value] = {"goal": [190.0, 26.0]}


@dataclass
class Samples:
    """Over all rounds and robots: seconds to the receipt and to the stand, metres rolled."""

    answered_s: list[float] = field(default_factory=list)
    confirmed_s: list[float] = field(default_factory=list)
    rolled_m: list[float] = field(default_factory=list)
    worst_s: list[float] = field(default_factory=list)  # of each round
    incomplete: int = 0  # rounds in which a robot did not confirm


class Bench:
    """A live swarm and an operator that observes it."""

    def __init__(self, robots: int) -> None:
        self.config = on_free_ports(
            SwarmConfig.model_validate(
                {
                    "swarm": "estop-bench",
                    "world": {"engine": "kinematic", "walls": False, "bounds_m": [0, 0, 200, 60]},
                    "agent": {"speed_limit_m_s": SPEED_M_S},
                    "performance": {"coverage_cell_m": 1.0},
                    "robot": [
                        {"id": f"r{row + 1}", "pose": [2.0 + 3 * (row // 20), 2.0 + 2.5 * (row % 20), 0.0]}
                        for row in range(robots)
                    ],
                }
            )
        )
        self.clock = MonotonicClock()
        self.runtime = Runtime(self.clock, Mailbox())
        self.supervisor = Supervisor(self.config, self.runtime, restart=False)
        self.bus = ZenohBus(self.runtime.mailbox, hub=self.config.hub.endpoint)
        keys = Keys(self.config.swarm)
        self.operator = Operator(self.bus, keys, self.runtime, "bench")
        self.view = FleetView(self.bus, keys, self.runtime, self.config.robots)
        self.supervisor.start()

    def until(self, what: str, timeout_s: float = WAIT_S) -> None:
        """Serve until all robots are in the state `what`."""
        end_s = self.clock.now_s() + timeout_s
        while not self._all(what):
            if self.clock.now_s() > end_s:
                raise SystemExit(f"not all robots are {what} after {timeout_s:g} s")
            self.runtime.run(0.05)

    def _all(self, what: str) -> bool:
        rows = [row for row in self.view.snapshot().robots if row.age_s < 1.5]
        core = what != "ready" or any(node.node == "core" for node in self.view.snapshot().nodes)
        return core and sum(is_(what, row) for row in rows) == len(self.config.robot)

    def order(self, engaged: bool) -> EStopOrder:
        """Press or release and wait for all robots."""
        receipts: list[EStopReceipt] = []
        order = self.operator.estop(
            engaged,
            known=self.view.present,
            deadline_s=WAIT_S,
            on_receipt=receipts.append,
            on_done=lambda _: self.runtime.pause(),
        )
        self.runtime.run(WAIT_S + 1.0)
        return order

    def round(self, samples: Samples) -> None:
        """Set all off, press, release; book what came of it."""
        self.operator.request("move_to_goal", (), FAR)
        self.until("driving")
        order = self.order(engaged=True)
        samples.answered_s += order.answered_s.values()
        samples.confirmed_s += order.confirmed_s.values()
        samples.rolled_m += [each.rolled_m for each in order.receipts.values()]
        samples.worst_s.append(max(order.answered_s.values(), default=float("inf")))
        samples.incomplete += bool(order.unconfirmed())
        self.order(engaged=False)
        self.until("free")

    def close(self) -> None:
        """End all processes."""
        self.operator.close()
        self.view.close()
        self.supervisor.close()
        self.bus.close()


def is_(what: str, row: RobotRow) -> bool:
    """Tell whether a robot is ``ready``, ``driving`` or ``free`` (released, standing, no behaviour)."""
    health = row.health
    if health is None:
        return False
    if what == "driving":
        return bool(health.behaviour) and row.speed_m_s > 0.5 * SPEED_M_S
    busy = health.estop or health.behaviour or health.moving
    return health.lifecycle in ("READY", "ACTIVE") and not (what == "free" and busy)


def distribution(values: list[float]) -> dict[str, float]:
    """Return percentiles of `values`."""
    ordered = sorted(values) or [float("nan")]
    at = {"p50": 0.5, "p90": 0.9, "p99": 0.99}
    return {
        **{name: ordered[min(len(ordered) - 1, int(share * len(ordered)))] for name, share in at.items()},
        "worst": ordered[-1],
    }


def main() -> int:
    """Print the distributions; return 1 when a receipt was late or missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--json", action="store_true", help="machine-readable")
    options = parser.parse_args()
    bench, samples = Bench(options.robots), Samples()
    try:
        bench.until("ready", START_S)
        for _ in range(options.rounds):
            bench.round(samples)
    finally:
        bench.close()
    tables = {
        "receipt_s": distribution(samples.answered_s),
        "standing_s": distribution(samples.confirmed_s),
        "rolled_m": distribution(samples.rolled_m),
    }
    count = len(samples.answered_s)
    good = samples.incomplete == 0 and count == options.robots * options.rounds
    good = good and tables["receipt_s"]["worst"] < TARGET_S
    if options.json:
        print(json.dumps({"receipts": count, "met": good, "worst_of_rounds_s": samples.worst_s, **tables}))
        return 0 if good else 1
    print(f"e-stop of {options.robots} live robots at {SPEED_M_S} m/s, {options.rounds} rounds: {count} receipts, "
          f"{samples.incomplete} rounds incomplete")  # fmt: skip
    print(f"{'':28}{'p50':>9}{'p90':>9}{'p99':>9}{'worst':>9}")
    for name, table in tables.items():
        title = {"receipt_s": "pressed to receipt, s", "standing_s": "pressed to standing, s"}.get(name, "rolled, m")
        print(f"  {title:26}" + "".join(f"{value:9.3f}" for value in table.values()))
    print("  worst receipt per round, s:", " ".join(f"{each:.3f}" for each in samples.worst_s))
    print(f"target: worst receipt under {TARGET_S} s: {'met' if good else 'MISSED'}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
