"""Measures robots that know their surroundings by range sensors alone: arrivals and contacts.

No map, no sensed obstacles and no seen bodies: a simulated lidar with noise and dropouts is all (`RangesConfig`). The
world's referee (``evaluate/witness.py``) counts contacts and arrivals.

    python -m benchmarks.ranges [--worlds uniform,concave,people] [--robots 4,8,16] [--seeds 10] [--check]
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from typing import Any

from fullswarm.config import RangesConfig, SwarmConfig
from fullswarm.evaluate.experiment.outcomes import Outcome
from fullswarm.evaluate.experiment.plan import Cell, Trial
from fullswarm.evaluate.lockstep_swarm import LockstepSwarm
from fullswarm.evaluate.scenarios import load_scenario
from fullswarm.evaluate.trial import TIME_LIMIT, configure, drive_in_world

WORLDS, SIZES, SEEDS = ("uniform", "concave", "people"), (4, 8, 16), 10
LIMIT_S = 180.0
SENSOR = RangesConfig()
BODY = {
    "speed_limit_m_s": 0.5, "turn_limit_rad_s": 4.25, "accel_limit_m_s2": 2.0, "turn_accel_limit_rad_s2": 20.0,
    "radius_m": 0.17,
}  # fmt: skip
AGENT = {"safety_margin_m": 0.03, "sensing_radius_m": 3.0}


def with_ranges(config: SwarmConfig, sensor: RangesConfig) -> SwarmConfig:
    """Return the fleet whose robots have a range sensor, and no other sense of their surroundings."""
    world = config.world_or_default.model_copy(update={"ranges": sensor})
    return config.model_copy(update={"world": world})


def arrive(world: str, robots: int, seed: int, sensor: RangesConfig = SENSOR, limit_s: float = LIMIT_S) -> Outcome:
    """Run one trial and return what the referee saw."""
    cell = Cell("ranges", "navigate_bc", (("map", "shared"),), world, robots, "kinematic", "create")
    trial = Trial(cell, seed, limit_s, tuple(BODY.items()), tuple(AGENT.items()))
    trial = replace(trial, stop=(("all_arrived", True),))
    scenario = load_scenario(world)
    config, goals = configure(trial, scenario)
    swarm = LockstepSwarm(with_ranges(config, sensor))
    try:
        return drive_in_world(swarm, swarm.world, trial, scenario, goals, (limit_s, TIME_LIMIT)).outcome
    finally:
        swarm.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", default=",".join(WORLDS))
    parser.add_argument("--robots", default=",".join(map(str, SIZES)))
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--check", action="store_true", help="exit 1 unless all arrive without a contact")
    given = parser.parse_args()
    good = True
    for world in given.worlds.split(","):
        for robots in map(int, given.robots.split(",")):
            for seed in range(given.seeds):
                began_s = time.perf_counter()
                found = arrive(world, robots, seed)
                row: dict[str, Any] = {
                    "world": world, "robots": robots, "seed": seed, "arrived": found.arrived,
                    "contacts": found.events, "robot": found.robot_events, "obstacle": found.obstacle_events,
                    "mover": found.mover_events, "hits_by_movers": found.mover_hits, "pushed": found.pushed_events,
                    "clearance_m": found.clearance_m, "separation_m": found.separation_m,
                    "simulated_s": round(found.simulated_s, 2), "wall_s": round(time.perf_counter() - began_s, 1),
                }  # fmt: skip
                print(json.dumps(row), flush=True)
                good &= found.arrived == robots and not found.events
    return 0 if good or not given.check else 1


if __name__ == "__main__":
    raise SystemExit(main())
