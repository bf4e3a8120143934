"""Counts the robots that pass doors and corridors, wherever a door lies and however it is turned, and contacts.

Eight robots of a Create's size (radius 0.17 m, 0.5 m/s) in the kinematic world, the whole stack in lockstep, judged by
the world's referee. ``doors``: a wall with a door of a given width, at random places of the wall and of the grid, along
both axes and turned; half of the positions are turned by a random angle. ``corridor``: four robots from either side.
``dead``: a door of 1.6 m in which a robot stands that was asked for nothing, or has fallen silent.

    python -m benchmarks.doors [--cases doors,corridor,dead] [--positions 20] [--widths 0.42,0.5,0.7] [--json] [--check]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fullswarm.config import SwarmConfig
from fullswarm.evaluate.witness import WorldWitness
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.logs import quiet
from fullswarm.messages import RequestStatus, Value
from fullswarm.operator.client import Operator

ROBOTS = 8
RADIUS_M, READY_S, LIMIT_S = 0.17, 0.49, 180.0
ARENA_M = (9.0, 7.0)
WALL_M = 0.2
DOORS_M = (0.42, 0.5, 0.7)
CORRIDORS_M = (0.8, 1.0, 1.2, 1.6, 2.0)
CORRIDOR_M = 3.0
DEAD_DOOR_M = 1.6


@dataclass(frozen=True, slots=True)
class Case:
    """A map, and from where each robot drives to where.

    Attributes
    ----------
    starts, goals : (n, 3), (n, 2); a goal of NaN: the robot is asked for nothing
    silent : the last robot's agent falls silent after the start
    """

    kind: str
    width_m: float
    position: int
    boxes: tuple[tuple[float, float, float, float, float], ...]
    starts: Array
    goals: Array
    silent: bool = False


@dataclass(frozen=True, slots=True)
class Run:
    """How it went: contacts of robots and with walls, when the last robot arrived (infinite: not all did)."""

    kind: str
    width_m: float
    position: int
    robots: int
    arrived: int
    contacts: int
    makespan_s: float


def cases(kinds: list[str], positions: int, widths: list[float]) -> Iterator[Case]:
    """Yield the cases."""
    for kind in kinds:
        wide = {"doors": widths or list(DOORS_M), "corridor": widths or list(CORRIDORS_M), "dead": [DEAD_DOOR_M]}[kind]
        for width_m in wide:
            for position in range(positions):
                yield case(kind, width_m, position)


def case(kind: str, width_m: float, position: int) -> Case:
    """Return one case; the same for the same arguments."""
    rng = np.random.default_rng([position, round(1000 * width_m)])
    centre = np.array(ARENA_M) / 2.0 + rng.uniform(-0.5, 0.5, 2)
    # Along the axes in turn, then at any angle.
    yaw = (0.0, 0.5 * math.pi)[position // 2 % 2] if position % 2 == 0 else float(rng.uniform(-math.pi, math.pi))
    thick_m = CORRIDOR_M if kind == "corridor" else WALL_M
    side_m = 6.0
    boxes = [
        (*_turned(centre, yaw, 0.0, sign * 0.5 * (width_m + side_m)), thick_m, side_m, yaw) for sign in (-1.0, 1.0)
    ]
    near = _scatter(rng, 4 if kind == "corridor" else ROBOTS, -0.5 * thick_m)
    starts = [(*_turned(centre, yaw, x, y), float(rng.uniform(-math.pi, math.pi))) for x, y in near]
    # So far apart that a robot can pass between two that have arrived.
    beyond = [(0.5 * thick_m + 1.7 + 0.5 * (row % 2), 0.85 * (row - 3.5)) for row in range(ROBOTS)]
    if kind == "corridor":
        starts += [(*_turned(centre, yaw, -x, -y), float(rng.uniform(-math.pi, math.pi))) for x, y in near]
        beyond = [*beyond[::2], *((-x, y) for x, y in beyond[::2])]
    goals = [_turned(centre, yaw, *place) for place in beyond]
    if kind == "dead":
        aside = float(rng.uniform(-0.3, 0.3))
        starts.append((*_turned(centre, yaw, float(rng.uniform(-0.1, 0.1)), aside), 0.0))
        goals.append((math.nan, math.nan))
    silent = kind == "dead" and position % 2 == 1
    return Case(kind, width_m, position, tuple(boxes), np.array(starts), np.array(goals), silent)


def _turned(centre: Array, yaw: float, x: float, y: float) -> tuple[float, float]:
    c, s = math.cos(yaw), math.sin(yaw)
    return float(centre[0] + c * x - s * y), float(centre[1] + s * x + c * y)


def _scatter(rng: np.random.Generator, count: int, edge_m: float) -> list[tuple[float, float]]:
    """Return places before a wall whose face lies at `edge_m`, 0.6 m apart at least."""
    places: list[tuple[float, float]] = []
    while len(places) < count:
        x, y = float(rng.uniform(edge_m - 2.6, edge_m - 0.4)), float(rng.uniform(-1.8, 1.8))
        if all(math.hypot(x - other_x, y - other_y) >= 0.6 for other_x, other_y in places):
            places.append((x, y))
    return places


def fleet(case: Case, agent: dict[str, Any]) -> SwarmConfig:
    """Return the swarm of a case; the arena is large enough for any angle."""
    robots = [{"id": f"r{row}p{case.position}", "pose": tuple(pose)} for row, pose in enumerate(case.starts.tolist())]
    middle_x, middle_y = ARENA_M[0] / 2.0, ARENA_M[1] / 2.0
    half_m = 0.5 * max(ARENA_M) + 2.0
    world = {
        "engine": "kinematic",
        "bounds_m": (middle_x - half_m, middle_y - half_m, middle_x + half_m, middle_y + half_m),
        "boxes": case.boxes,
        "radius_m": RADIUS_M,
    }
    conditions = f"partition={robots[-1]['id']}|*@2s" if case.silent else None
    return SwarmConfig.model_validate(
        {"world": world, "robot": robots, "agent": agent, "network": {"conditions": conditions}}
    )


def run(case: Case, agent: dict[str, Any] | None = None, limit_s: float = LIMIT_S) -> Run:
    """Run a case with the whole stack."""
    config = fleet(case, agent or {})
    lockstep = Lockstep(config)
    asked = np.isfinite(case.goals[:, 0])
    try:
        operator = Operator(lockstep.bus, Keys(config.swarm), lockstep.runtime, "benchmark")
        answers: list[RequestStatus] = []
        lockstep.run(READY_S)
        goals = np.where(asked[:, None], case.goals, case.starts[:, :2])
        witness = WorldWitness(lockstep.world, goals, 0.1, 0.1, emulated=False)
        witness.begin()
        lockstep.runtime.every(lockstep.world.dt_s, witness.sample)
        targets: dict[str, Value] = {"targets": case.goals[asked].tolist(), "map": "given"}
        names = tuple(robot for robot, wanted in zip(config.robots, asked, strict=True) if wanted)
        operator.request("navigate_each_bc", names, targets, answers.append)
        makespan_s = math.inf
        while lockstep.runtime.now_s() < READY_S + limit_s:
            lockstep.run(0.1)
            if (_away(lockstep, goals) <= 0.1).all():
                makespan_s = lockstep.runtime.now_s() - READY_S
                break
        if not answers or answers[-1].phase == "refused":
            raise SystemExit(f"the core refused: {answers[-1].reason if answers else 'no answer'}")
        arrived = int((_away(lockstep, goals) <= 0.1)[asked].sum())
        counted = witness.tally()
        contacts = (counted.pairs_touched or 0) + int(counted.obstacle_events.sum())
        operator.close()
    finally:
        lockstep.close()
    return Run(case.kind, case.width_m, case.position, int(asked.sum()), arrived, contacts, round(makespan_s, 1))


def _away(lockstep: Lockstep, goals: Array) -> Array:
    away: Array = np.hypot(*(lockstep.world.pose[:, :2] - goals).T)
    return away


def main() -> int:
    """Print a line per width and one in all; with --check return 1 unless all robots passed without a contact."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default="doors,corridor,dead")
    parser.add_argument("--positions", type=int, default=20)
    parser.add_argument("--widths", default="", help="m, with commas")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--check", action="store_true")
    wanted = parser.parse_args()
    quiet()  # stdout is for the table
    widths = [float(each) for each in wanted.widths.split(",") if each]
    runs: list[Run] = []
    for each in cases(wanted.cases.split(","), wanted.positions, widths):
        runs.append(run(each))
        if not wanted.json and (runs[-1].arrived < runs[-1].robots or runs[-1].contacts):
            print(f"  {runs[-1]}", flush=True)
    if wanted.json:
        print(json.dumps([asdict(each) for each in runs]))
    else:
        for kind, width_m in dict.fromkeys((each.kind, each.width_m) for each in runs):
            group = [each for each in runs if (each.kind, each.width_m) == (kind, width_m)]
            times = [each.makespan_s for each in group if math.isfinite(each.makespan_s)]
            print(
                f"{kind:9} {width_m:5.2f} m  trials {len(group):3}  all passed {len(times):3}  robots "
                f"{sum(each.arrived for each in group)}/{sum(each.robots for each in group)}  contacts "
                f"{sum(each.contacts for each in group)}  makespan {np.median(times) if times else math.inf:.1f} s "
                f"(longest {max(times, default=math.inf):.1f})"
            )
    failed = any(each.arrived < each.robots or each.contacts for each in runs)
    return int(wanted.check and failed)


if __name__ == "__main__":
    sys.exit(main())
