"""Real-time factor of the full stack in lockstep beside the bare engine's, in one run.

Full stack: core, agent with laws, barrier filter, controller, estimator and calculators, summarizers, bus; each robot
drives to a place of its own (`formation_bc`) at the paper's density (32 robots in 20 x 20 m), sensing 3 m, 50 Hz
control, states at 20 Hz. Bare engine: the same world stepped with the same set-points and nothing else.
CPU seconds of this one process, so that other work on the machine counts little.

    python -m benchmarks.lockstep [--robots 4,8,16,32,100,1000] [--engines pybullet,kinematic] [--behaviour NAME]
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import asdict, dataclass

import numpy as np

from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.logs import quiet
from fullswarm.messages import RequestStatus, Value
from fullswarm.operator.client import Operator
from fullswarm.simulation.engine import make_engine

TARGETS = {("pybullet", 32): 60, ("pybullet", 100): 15, ("pybullet", 1000): 1,
           ("kinematic", 32): 300, ("kinematic", 100): 150, ("kinematic", 1000): 20}  # fmt: skip
ARGOS = {32: 58, 100: 11.5, 1000: 0.6}
"""ARGoS3 (C++) with 50 Hz control and 250 Hz physics, measured elsewhere on a machine of this kind."""

WARM_UP_S = 2.0


@dataclass(frozen=True, slots=True)
class Figure:
    """One line of the table; factors are simulated seconds per CPU second."""

    engine: str
    robots: int
    behaviour: str
    stack: float
    bare: float
    overhead_us: float  # per control tick
    collisions: int


def swarm(engine: str, robots: int, seed: int) -> SwarmConfig:
    """Return a swarm spread evenly at the paper's density, with random headings."""
    rng = np.random.default_rng(seed)
    spacing_m = 20.0 / math.sqrt(32)
    columns = math.ceil(math.sqrt(robots))
    side_m = max(columns * spacing_m, 8.0)
    places = [(i % columns, i // columns) for i in range(robots)]
    return SwarmConfig.model_validate(
        {
            "world": {"engine": engine, "bounds_m": (0.0, 0.0, side_m, side_m)},
            "robot": [
                {
                    "id": f"r{number}",
                    "pose": (
                        (x + 0.5) * spacing_m + rng.uniform(-0.8, 0.8),
                        (y + 0.5) * spacing_m + rng.uniform(-0.8, 0.8),
                        rng.uniform(-math.pi, math.pi),
                    ),
                }
                for number, (x, y) in enumerate(places)
            ],
        }
    )


def parameters(config: SwarmConfig, behaviour: str, seed: int) -> dict[str, Value]:
    """Return what the behaviour needs; targets are the start places permuted among near robots."""
    if behaviour.startswith("move_to_goal"):
        x, y = config.bounds_m[2:]
        return {"goal": [x / 2, y / 2]}
    if not behaviour.startswith("formation"):
        return {}
    rng = np.random.default_rng(seed + 1)
    low, high = 0.5, config.bounds_m[2] - 0.5
    targets = [
        np.clip(np.array(each.pose[:2]) + rng.uniform(-6.0, 6.0, 2), low, high).tolist()
        for each in config.robot
        if each.pose
    ]
    return {"targets": targets, "gain": 1.0}


def measure(engine: str, robots: int, behaviour: str, seconds: float, seed: int) -> Figure:
    """Run the stack and then the bare engine with the set-points that the stack gave."""
    config = swarm(engine, robots, seed)
    lockstep = Lockstep(config)
    operator = Operator(lockstep.bus, Keys(config.swarm), lockstep.runtime, "benchmark")
    answers: list[RequestStatus] = []
    lockstep.run(1.0)
    operator.request(behaviour, (), parameters(config, behaviour, seed), answers.append)
    lockstep.run(WARM_UP_S)
    if not answers or answers[-1].phase != "running":
        raise SystemExit(f"{behaviour} was not accepted: {answers[-1:] or 'no answer'}")
    began_s = time.process_time()
    lockstep.run(seconds)
    stack_s = time.process_time() - began_s
    setpoints = lockstep.agent.setpoints.copy()
    pose, collisions = lockstep.world.pose.copy(), int(lockstep.agent.calculators.collisions.sum())
    lockstep.close()
    bare = make_engine(config.world_or_default, pose)
    steps = round(seconds * config.world_or_default.rate_hz)
    bare.step(setpoints)
    began_s = time.process_time()
    for _ in range(steps):
        bare.step(setpoints)
    bare_s = time.process_time() - began_s
    bare.close()
    return Figure(
        engine, robots, behaviour, seconds / stack_s, seconds / bare_s, 1e6 * (stack_s - bare_s) / steps, collisions
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", default="4,8,16,32,100,1000")
    parser.add_argument("--engines", default="pybullet,kinematic")
    parser.add_argument("--behaviour", default="formation_bc")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    quiet()  # stdout is for the table
    figures = []
    for engine in options.engines.split(","):
        for robots in map(int, options.robots.split(",")):
            seconds = options.seconds if robots < 1000 else max(options.seconds / 3, 2.0)
            figure = measure(engine, robots, options.behaviour, seconds, options.seed)
            figures.append(figure)
            if options.json:
                continue
            target = TARGETS.get((engine, robots))
            notes = f"target {target}" if target else ""
            if engine == "pybullet" and robots in ARGOS:
                notes += f", ARGoS {ARGOS[robots]}"
            print(
                f"{engine:10} N={robots:<5} stack {figure.stack:8.1f}   bare engine {figure.bare:8.1f}   "
                f"ratio {figure.stack / figure.bare:5.2f}   stack adds {figure.overhead_us:6.0f} µs a tick   "
                f"collisions {figure.collisions}   {notes}"
            )
    if options.json:
        print(json.dumps([asdict(each) for each in figures], indent=2))


if __name__ == "__main__":
    main()
