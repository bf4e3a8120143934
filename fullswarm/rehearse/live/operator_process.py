"""One operator of a live rehearsal: ``python -m fullswarm.rehearse.live.operator_process FLEET NAME PROCESS SEED LOG``.

It sends request after request to some robots, now and then several at once, until SIGTERM. LOG holds each request with
its time, a JSON document per line: the judge must not depend on what was delivered.
"""

from __future__ import annotations

import json
import random
import sys
from pathlib import Path

from fullswarm.bus.base import OPERATOR
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock, clock_id
from fullswarm.config import SwarmConfig, load_swarm
from fullswarm.keys import Keys
from fullswarm.launch.network import on_network
from fullswarm.messages import RequestStatus, Value
from fullswarm.operator.client import Operator
from fullswarm.runtime import Mailbox, Runtime

MEAN_S = 1.2
BURST = 0.1
"""Share of the moments at which several requests come at once."""
STOPS = 0.05


class RandomOperator:
    """Asks at random, from a seed."""

    def __init__(self, config: SwarmConfig, name: str, process: str, seed: int, log: Path) -> None:
        self._chance = random.Random(seed)  # noqa: S311  (repeats, keeps no secret)
        self._robots = config.robots
        self._bounds = config.bounds_m
        self._log = log.open("a", encoding="utf-8", buffering=1)
        self._name, self._process = name, process
        self.runtime = Runtime(MonotonicClock(), Mailbox())
        self._bus = ZenohBus(self.runtime.mailbox, hub=config.hub.endpoint)
        bus = on_network(self._bus, self.runtime, config, OPERATOR)
        self._operator = Operator(bus, Keys(config.swarm), self.runtime, process, name=name, clock=clock_id())
        self.runtime.stop_on_signals()
        self._next()

    def _next(self) -> None:
        self.runtime.after(self._chance.expovariate(1.0 / MEAN_S), self._act)

    def _act(self) -> None:
        for _ in range(self._chance.randint(3, 6) if self._chance.random() < BURST else 1):
            self._ask()
        self._next()

    def _ask(self) -> None:
        chance = self._chance
        robots = tuple(chance.sample(self._robots, chance.randint(1, min(6, len(self._robots)))))
        if chance.random() < STOPS:
            asked_s = self.runtime.now_s()
            self._operator.stop(robots)
            self._write(t=asked_s, stop=robots)
            return
        behaviour, parameters = self._any(len(robots))
        asked = self._operator.request(behaviour, robots, parameters, on_status=self._status)
        request = asked.request
        self._write(t=request.stamp_s, id=request.id, behaviour=behaviour, robots=robots)

    def _any(self, count: int) -> tuple[str, dict[str, Value]]:
        kind = self._chance.choice(("move", "move", "flocking_bc", "rendezvous_bc", "formation_assigned_bc", "stop"))
        if kind == "move":
            return "move_to_goal_bc", {"goal": [*self._point()]}
        if kind == "formation_assigned_bc":
            return kind, {"targets": [[*self._point()] for _ in range(count)]}
        return kind, {}

    def _point(self) -> tuple[float, float]:
        x_low, y_low, x_high, y_high = self._bounds
        return self._chance.uniform(x_low + 1, x_high - 1), self._chance.uniform(y_low + 1, y_high - 1)

    def _status(self, status: RequestStatus) -> None:
        self._write(t=self.runtime.now_s(), id=status.request_id, phase=status.phase, reason=status.reason)

    def _write(self, **line: object) -> None:
        self._log.write(json.dumps({"operator": self._name, "process": self._process, **line}) + "\n")

    def close(self) -> None:
        """Leave the swarm."""
        self._operator.close()
        self._bus.close()
        self._log.close()


def main() -> int:
    """Ask until SIGTERM."""
    fleet, name, process, seed, log = sys.argv[1:]
    operator = RandomOperator(load_swarm(fleet), name, process, int(seed), Path(log))
    try:
        operator.runtime.run()
    finally:
        operator.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
