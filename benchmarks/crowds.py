"""Makespans of crowds beside ORCA's: the same starts, goals, limits and bodies, judged by the same referee.

Ours is the whole stack in lockstep, filter included. ORCA is RVO2 (pyrvo, extra ``[bench]``) at 50 Hz with the true
states of all bodies and no delay, mapped to unicycles as in NH-ORCA (Alonso-Mora et al. 2010): the heading follows the
velocity that ORCA gives, the speed is its component along the heading, and the radius that ORCA uses is enlarged by the
error of that tracking. Enlargement and time horizon are tried from a list, and the fastest run in which all arrive
without a contact counts, else the one with the fewest contacts; so the reference is tuned to each start, ours is not.

    python -m benchmarks.crowds [--cases dense,open,random,swap,thousand] [--limits slow,fast] [--robots 2,8] [--check]
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm import kernels
from fullswarm.config import SwarmConfig, WorldConfig
from fullswarm.evaluate.scenarios import Scenario, load_scenario, spawn
from fullswarm.geometry import clamp, unicycle
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.logs import quiet
from fullswarm.messages import RequestStatus, Value
from fullswarm.operator.client import Operator
from fullswarm.simulation.world import World

RADIUS_M, SENSING_M, PERIOD_S, READY_S = 0.17, 3.0, 0.02, 0.49
GAIN_PER_S, TURN_GAIN_PER_S = 1.0, 3.0
LIMITS: dict[str, dict[str, float]] = {
    "slow": {"speed_limit_m_s": 0.5, "turn_limit_rad_s": 4.25},
    "fast": {
        "speed_limit_m_s": 4.0, "turn_limit_rad_s": math.pi / 4,
        "accel_limit_m_s2": 8.0, "turn_accel_limit_rad_s2": 20.0,
    },
}  # fmt: skip
"""As in ``evaluate/experiment/safety.toml``: iRobot Create, and the paper's simulated robots."""

SETTINGS = ((0.02, 2.0), (0.05, 1.0), (0.05, 4.0), (0.1, 1.0), (0.1, 2.0), (0.2, 4.0), (0.3, 1.0))
"""By how much ORCA's radius is enlarged, m, and its time horizon, s."""

SIZES = {"dense": (64, 100, 200), "open": (2, 4, 8, 16, 32), "random": (16, 32), "swap": (2, 8, 16, 32),
         "thousand": (1000,)}  # fmt: skip
RATIO = {"dense": 1.2, "open": 1.1}
"""The greatest makespan, in ORCA's, that ``--check`` accepts; a swap of 8 or more must be ahead of ORCA."""
AHEAD = 8
MANY = 200
"""In larger swarms the least gap is not measured: that is all pairs in each step."""


@dataclass(frozen=True, slots=True)
class Case:
    """A start and what is asked of the robots."""

    kind: str
    limits: str
    seed: int
    world: WorldConfig
    starts: Array  # (n, 3)
    goals: Array  # (n, 2)
    goal_radius_m: float
    limit_s: float


@dataclass(frozen=True, slots=True)
class Run:
    """How it went.

    `makespan_s`: until all were within their goals' radius at the same time; inf if they never were. `contacts`: pairs
    of robots, or of a robot and a wall, that touched. `closest_m`: the least gap between two footprints.
    """

    makespan_s: float
    arrived: int
    contacts: int
    closest_m: float


def cases(kinds: list[str], limits: list[str], robots: list[int], seeds: int) -> Iterator[Case]:
    """Yield the cases; `robots`: only these sizes, if any."""
    for kind in kinds:
        for limit in limits:
            for count in SIZES[kind]:
                if (robots and count not in robots) or (kind in ("dense", "thousand") and limit == "fast"):
                    continue
                for seed in range(1 if kind in ("swap", "thousand") else seeds):
                    yield case(kind, limit, count, seed)


def case(kind: str, limits: str, count: int, seed: int) -> Case:
    """Return one case.

    Dense: a square full of robots, 0.4 m apart at least, and the goal disc of the scenario ``empty_dense`` for all;
    for a thousand both grow with the number. Open: the scenario ``empty``. Random: starts and goals anywhere, a goal
    each. Swap: the scenario ``antipodal``.
    """
    name = {"open": "empty", "swap": "antipodal"}.get(kind, "empty_dense")
    scenario = load_scenario(name)
    if kind in ("dense", "thousand"):
        scenario = _dense(scenario, count, large=kind == "thousand")
    if kind == "random":
        goals = spawn(_changed(scenario, region_m=[1.0, 1.0, 19.0, 19.0], spacing_m=1.0), count, 1000 + seed, RADIUS_M)
        scenario = _changed(scenario, region_m=[1.0, 1.0, 19.0, 19.0], spacing_m=0.6)
    starts = spawn(scenario, count, seed, RADIUS_M)
    centre = np.array(scenario.goal.centre_m)
    if kind == "swap":
        goals = 2.0 * centre - starts[:, :2]
    elif kind != "random":
        goals = np.tile(centre, (count, 1))
    world = WorldConfig.model_validate(
        {"engine": "kinematic", "bounds_m": scenario.bounds_m, "walls": scenario.walls, **LIMITS[limits]}
    )
    return Case(
        kind, limits, seed, world, starts,
        goals=np.ascontiguousarray(goals[:, :2]),
        goal_radius_m=0.3 if kind == "random" else scenario.goal.radius_m,
        limit_s={"dense": 200.0, "thousand": 300.0}.get(kind, 120.0),
    )  # fmt: skip


def _dense(scenario: Scenario, count: int, large: bool) -> Scenario:
    side_m = max(5.0, 0.55 * math.sqrt(count))
    scenario = _changed(scenario, region_m=[1.0, 1.0, 1.0 + side_m, 1.0 + side_m], spacing_m=0.4)
    if not large:
        return scenario
    # The share of the disc that 200 robots take in the scenario's.
    radius_m = 4.0 * math.sqrt(count / 200)
    middle_m = side_m + 6.0 + radius_m
    arena_m = middle_m + radius_m + 1.0
    goal = {"centre_m": [middle_m, middle_m], "radius_m": radius_m}
    return Scenario.model_validate({**scenario.model_dump(), "bounds_m": [0.0, 0.0, arena_m, arena_m], "goal": goal})


def _changed(scenario: Scenario, **spawning: Any) -> Scenario:
    whole = scenario.model_dump()
    whole["bounds_m"] = [0.0, 0.0, *(max(edge, spawning["region_m"][3] + 1.0) for edge in scenario.bounds_m[2:])]
    return Scenario.model_validate({**whole, "spawn": {**whole["spawn"], **spawning}})


class Judge:
    """Takes in each step of a world: contacts as its referee finds them, arrivals, the least gap at its end."""

    def __init__(self, world: World, case: Case) -> None:
        self._world, self._case = world, case
        self._touched: set[tuple[int, int]] = set()
        self._closest_m, self._done_s = math.inf, math.inf
        self._steps = 0
        world.watchers.append(self._take)

    def _take(self) -> None:
        self._steps += 1
        place = self._world.pose[:, :2]
        self._touched |= {(min(pair), max(pair)) for pair in self._world.referee.pairs.tolist()}
        if len(place) <= MANY:
            apart = np.hypot(*(place[:, None] - place[None]).transpose(2, 0, 1))
            np.fill_diagonal(apart, math.inf)
            self._closest_m = min(self._closest_m, float(apart.min()) - 2.0 * RADIUS_M)
        if not self.done and self._near().all():
            self._done_s = self._steps * self._world.dt_s

    @property
    def done(self) -> bool:
        """All have been at their goals at the same time."""
        return math.isfinite(self._done_s)

    def _near(self) -> NDArray[np.bool_]:
        away_m: Array = np.hypot(*(self._world.pose[:, :2] - self._case.goals).T)
        return away_m <= self._case.goal_radius_m

    def run(self) -> Run:
        """Return what was counted."""
        return Run(self._done_s, int(self._near().sum()), len(self._touched), self._closest_m)


def fleet(case: Case, agent: dict[str, Any]) -> SwarmConfig:
    """Return the swarm of a case."""
    robots = [{"id": f"r{row}s{case.seed}", "pose": tuple(pose)} for row, pose in enumerate(case.starts.tolist())]
    return SwarmConfig.model_validate({"world": case.world.model_dump(), "robot": robots, "agent": agent})


def ours(case: Case, agent: dict[str, Any] | None = None, watch: Callable[[Lockstep], None] | None = None) -> Run:
    """Run a case with the whole stack.

    Parameters
    ----------
    agent : settings of the agents
    watch : called every 0.1 s
    """
    config = fleet(case, agent or {})
    lockstep = Lockstep(config)
    try:
        operator = Operator(lockstep.bus, Keys(config.swarm), lockstep.runtime, "benchmark")
        answers: list[RequestStatus] = []
        lockstep.run(READY_S)
        judge = Judge(lockstep.world, case)
        parameters: dict[str, Value] = {"gain": GAIN_PER_S}
        if case.kind in ("random", "swap"):
            behaviour, parameters["targets"] = "formation_bc", case.goals.tolist()
        else:
            behaviour, parameters["goal"] = "move_to_goal_bc", case.goals[0].tolist()
        operator.request(behaviour, (), parameters, answers.append)
        for _ in range(round(case.limit_s / 0.1)):
            lockstep.run(0.1)
            if watch is not None:
                watch(lockstep)
            if judge.done:
                break
        if not answers or answers[-1].phase != "running":
            raise SystemExit(f"{behaviour} was not accepted: {answers[-1:] or 'no answer'}")
        return judge.run()
    finally:
        lockstep.close()


def orca(case: Case, enlarged_m: float, horizon_s: float) -> Run:
    """Run a case with RVO2's ORCA and its unicycle mapping."""
    import pyrvo

    limits = LIMITS[case.limits]
    top, turn_limit = limits["speed_limit_m_s"], limits["turn_limit_rad_s"]
    count = len(case.starts)
    world = World(case.world, [f"r{row}" for row in range(count)], case.starts)
    judge = Judge(world, case)
    rvo = pyrvo.RVOSimulator(PERIOD_S, SENSING_M, 20, horizon_s, horizon_s, RADIUS_M + enlarged_m, top)
    x_min, y_min, x_max, y_max = case.world.bounds_m
    # Vertices in clockwise order: the agents are inside.
    rvo.add_obstacle([(x_min, y_min), (x_min, y_max), (x_max, y_max), (x_max, y_min)])
    rvo.process_obstacles()
    for pose in case.starts:
        rvo.add_agent((pose[0], pose[1]))
    rng = np.random.default_rng(case.seed)
    twists = np.zeros((count, 2))
    for _ in range(round(case.limit_s / PERIOD_S)):
        pose, twist = world.pose, world.twist
        ahead = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=1)
        velocity = twist[:, :1] * ahead
        error = case.goals - pose[:, :2]
        away_m = np.hypot(*error.T)
        desired = error * np.minimum(GAIN_PER_S, top / np.maximum(away_m, 1e-9))[:, None]
        desired += rng.normal(0.0, 1e-3, (count, 2)) * top  # breaks symmetry, as RVO2's examples do
        for row in range(count):
            rvo.set_agent_position(row, (pose[row, 0], pose[row, 1]))
            rvo.set_agent_velocity(row, (velocity[row, 0], velocity[row, 1]))
            rvo.set_agent_pref_velocity(row, (desired[row, 0], desired[row, 1]))
        rvo.do_step()
        for row in range(count):
            wanted = rvo.get_agent_velocity(row)
            drive, turn = unicycle.plain(wanted.x, wanted.y, pose[row, 2], 1.0, TURN_GAIN_PER_S)
            twists[row] = clamp.plain(drive, 0.0, top), clamp.plain(turn, -turn_limit, turn_limit)
        world.set_twists(twists)
        world.step()
        if judge.done:
            break
    found = judge.run()
    world.close()
    return found


def best_orca(case: Case) -> Run:
    """Return the fastest run in which all arrive without a contact, else the fastest with the fewest contacts."""
    runs = [orca(case, *each) for each in (SETTINGS if len(case.starts) <= 200 else SETTINGS[1:2])]
    return min(runs, key=lambda run: (run.contacts, -run.arrived, run.makespan_s))


@dataclass(frozen=True, slots=True)
class Row:
    """All seeds of one case: medians of the makespans, sums of the rest."""

    case: str
    limits: str
    robots: int
    seeds: int
    orca_s: float
    ours_s: float
    ratio: float  # the mean makespan of ours by ORCA's, over the seeds in which both arrive; nan: none
    orca_arrived: int
    ours_arrived: int
    orca_contacts: int
    ours_contacts: int
    closest_m: float
    holds: bool


def row(some: list[Case], pairs: list[tuple[Run, Run]]) -> Row:
    """Return the line of the table; `pairs`: ORCA's run and ours of each seed."""
    first, count = some[0], len(some[0].starts)
    both = [(a.makespan_s, b.makespan_s) for a, b in pairs if math.isfinite(a.makespan_s + b.makespan_s)]
    ratio = statistics.fmean(b for _, b in both) / statistics.fmean(a for a, _ in both) if both else math.nan
    contacts = sum(b.contacts for _, b in pairs)
    holds = contacts == 0 and all(math.isfinite(b.makespan_s) for _, b in pairs)
    if first.kind == "swap" and count >= AHEAD:
        holds = holds and not ratio > 1.0
    elif first.kind in RATIO:
        holds = holds and not ratio > RATIO[first.kind]
    return Row(
        first.kind, first.limits, count, len(some),
        orca_s=statistics.median(a.makespan_s for a, _ in pairs),
        ours_s=statistics.median(b.makespan_s for _, b in pairs),
        ratio=ratio,
        orca_arrived=sum(a.arrived for a, _ in pairs), ours_arrived=sum(b.arrived for _, b in pairs),
        orca_contacts=sum(a.contacts for a, _ in pairs), ours_contacts=contacts,
        closest_m=min(b.closest_m for _, b in pairs), holds=holds,
    )  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default="dense,open,random,swap", help="of dense, open, random, swap, thousand")
    parser.add_argument("--limits", default="slow,fast")
    parser.add_argument("--robots", default="", help="only these numbers of robots")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--check", action="store_true", help="fail when a bar does not hold")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    quiet()  # stdout is for the table
    if importlib.util.find_spec("pyrvo") is None:
        parser.error("ORCA is not installed: pip install -e '.[bench]'")
    kernels.compile_all()
    robots = [int(each) for each in options.robots.split(",") if each]
    groups: dict[tuple[str, str, int], list[Case]] = {}
    for each in cases(options.cases.split(","), options.limits.split(","), robots, options.seeds):
        groups.setdefault((each.kind, each.limits, len(each.starts)), []).append(each)
    rows = []
    if not options.json:
        print(
            "case      limits    N  seeds  ORCA s  ours s  ratio   arrived ORCA / ours   contacts ORCA / ours  closest"
        )
    for some in groups.values():
        found = row(some, [(best_orca(each), ours(each)) for each in some])
        rows.append(found)
        if not options.json:
            whole = found.robots * found.seeds
            print(
                f"{found.case:9} {found.limits:6} {found.robots:5} {found.seeds:6} {found.orca_s:7.1f} "
                f"{found.ours_s:7.1f} {found.ratio:6.2f}   {found.orca_arrived:6} / {found.ours_arrived} of {whole:<6} "
                f"{found.orca_contacts:8} / {found.ours_contacts:<8} {1000 * found.closest_m:6.1f} mm"
                f"{'' if found.holds else '  BELOW THE BAR'}",
                flush=True,
            )
    if options.json:
        print(json.dumps([asdict(each) for each in rows], indent=2))
    if options.check and not all(each.holds for each in rows):
        raise SystemExit("a bar does not hold: see the table")


if __name__ == "__main__":
    main()
