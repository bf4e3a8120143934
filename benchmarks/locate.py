"""Measures how well whole robots know their place on a known map by their ranges, and whether they are found again.

Robots sense neither poses nor obstacles: a simulated lidar with noise and dropouts, odometry whose wheels are not as
stated, and the map of the scenario are all. They drive with `navigate_bc` from their starts to goals and back. After
`--carry` seconds one robot is put somewhere else, as by hand: its odometry knows nothing of it. The world's own poses
judge: the error of each robot's pose at 10 Hz while its agent counts it as known, and how long after it was carried the
robot is known again and less than 10 cm off for good. The bars: RMSE of at most 5 cm, found within 20 s, 0 contacts.

    python -m benchmarks.locate [--worlds uniform,concave] [--robots 4] [--seeds 5] [--check]
"""

from __future__ import annotations

import argparse
import json
import math
import time
from typing import Any

import numpy as np

from benchmarks.ranges import AGENT, BODY
from fullswarm.config import SwarmConfig
from fullswarm.evaluate.experiment.plan import Cell, Trial
from fullswarm.evaluate.scenarios import load_scenario
from fullswarm.evaluate.trial import configure
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.logs import quiet
from fullswarm.messages import Value
from fullswarm.operator.client import Operator

RANGES = {"count": 360, "max_m": 12.0, "sigma_m": 0.01, "dropout": 0.01, "rate_hz": 10.0}
WHEELS = 0.02
"""Standard deviation of the scale of each robot's odometry."""
GOOD_M, LEAST_CLEAR_M = 0.10, 0.6
BAR_M, FOUND_S = 0.05, 20.0


def fleet(world: str, robots: int, seed: int) -> tuple[SwarmConfig, list[list[float]], list[list[float]]]:
    """Return a fleet that knows its scenario's map and no poses, its goals, and the places where it begins."""
    cell = Cell("locate", "navigate_bc", (("map", "given"),), world, robots, "kinematic", "create")
    trial = Trial(cell, seed, 120.0, tuple(BODY.items()), (*AGENT.items(), ("locate_on_map", True)))
    config, goals = configure(trial, load_scenario(world))
    data = config.model_dump(exclude_unset=True)
    data["world"] |= {"ranges": RANGES, "sight": {"pose": False}}
    data["world"].setdefault("noise", {})
    data["world"]["noise"] = {**data["world"]["noise"], "odometry": WHEELS}
    starts = [list(each.pose)[:2] for each in config.robot if each.pose is not None]
    return SwarmConfig.model_validate(data), np.asarray(goals)[:, :2].tolist(), starts


def elsewhere(swarm: Lockstep, row: int, random: np.random.Generator) -> tuple[float, float, float]:
    """Return a free place of the arena, at least 3 m from where the robot is."""
    world = swarm.world
    x_min, y_min, x_max, y_max = world.config.bounds_m
    while True:
        x, y = random.uniform(x_min + 1.0, x_max - 1.0), random.uniform(y_min + 1.0, y_max - 1.0)
        away_m = np.hypot(world.pose[:, 0] - x, world.pose[:, 1] - y)
        boxes = world.obstacles
        off_x, off_y = np.abs(boxes[:, 0] - x) - boxes[:, 2], np.abs(boxes[:, 1] - y) - boxes[:, 3]
        clear = np.hypot(np.maximum(off_x, 0.0), np.maximum(off_y, 0.0)).min(initial=math.inf) > LEAST_CLEAR_M
        if clear and away_m[row] > 3.0 and np.delete(away_m, row).min(initial=math.inf) > 1.0:
            return x, y, random.uniform(-math.pi, math.pi)


def run(world: str, robots: int, seed: int, carry_s: float, after_s: float) -> dict[str, Any]:
    """Run one trial and return its figures."""
    config, goals, starts = fleet(world, robots, seed)
    swarm, random = Lockstep(config), np.random.default_rng(seed)
    began_s = time.perf_counter()
    try:
        operator = Operator(swarm.bus, Keys(config.swarm), swarm.runtime, "benchmark")
        swarm.run(2.0)
        agent, judge, row = swarm.agent, swarm.world, seed % robots
        errors: list[float] = []
        touched, known, carried, found_s, wrong_m = 0, 0, False, None, 0.0
        steps = round((carry_s + after_s) / 0.1)
        for step in range(steps):
            if step % 400 == 0:
                for robot in range(robots):
                    goal = goals[robot % len(goals)] if step % 800 == 0 else starts[robot]
                    parameters: dict[str, Value] = {"goal": list(goal), "map": "given"}
                    operator.request("navigate_bc", (swarm.world.ids[robot],), parameters, _ignore)
            if step == round(carry_s / 0.1):
                judge.pose[row] = elsewhere(swarm, row, random)
                carried = True
            swarm.run(0.1)
            touched += int(judge.contacts.sum())
            pose = agent._state.pose  # noqa: SLF001  (as the agent acts on it, not as it is reported)
            sure = np.isfinite(pose[:, 0]) & ~agent.reflexes.pose_uncertain
            off_m = np.hypot(*(pose[:, :2] - judge.pose[:, :2]).T)
            for each in range(robots):
                if not carried or each != row:
                    known += int(sure[each])
                    if sure[each]:
                        errors.append(float(off_m[each]))
            if carried:
                since_s = round(0.1 * (step + 1) - carry_s, 1)
                if not sure[row] or off_m[row] > GOOD_M:
                    found_s = None
                    if sure[row] and since_s > 2.0:
                        wrong_m = max(wrong_m, float(off_m[row]))
                elif found_s is None:
                    found_s = since_s
        counted = steps * robots - round(after_s / 0.1)
        return {
            "world": world, "robots": robots, "seed": seed,
            "rmse_m": round(float(np.sqrt(np.mean(np.square(errors)))), 4),
            "p99_m": round(float(np.percentile(errors, 99)), 4), "known": round(known / counted, 4),
            "found_s": found_s, "wrong_m": round(wrong_m, 3), "contacts": touched,
            "wall_s": round(time.perf_counter() - began_s, 1),
        }  # fmt: skip
    finally:
        swarm.close()


def _ignore(_: object) -> None:
    """Take a request's status."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default="uniform,concave")
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--carry", type=float, default=60.0, metavar="SECONDS")
    parser.add_argument("--after", type=float, default=40.0, metavar="SECONDS")
    parser.add_argument("--check", action="store_true", help="exit 1 unless the bars hold")
    given = parser.parse_args()
    quiet()  # stdout is for the table
    good = True
    for world in given.worlds.split(","):
        for seed in range(given.seeds):
            row = run(world, given.robots, seed, given.carry, given.after)
            print(json.dumps(row), flush=True)
            found_s = row["found_s"]
            good &= row["rmse_m"] <= BAR_M and found_s is not None and found_s <= FOUND_S and not row["contacts"]
    return 0 if good or not given.check else 1


if __name__ == "__main__":
    raise SystemExit(main())
