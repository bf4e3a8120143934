"""Cost of the safety filter beside OSQP and cvxopt on the same problems, in one run.

``python -m benchmarks.filter [--scenes 300] [--json]``. One robot among 10 or 31 neighbours: ours is a whole call, from
positions to a twist, rows and braking included, in plain Python as on board, and the solve alone; the others get the
rows ready made, and only solve. Then the same robots a thousand at a time, compiled, as in a trial. Then the joint
form: ours is a whole tick, pairs and assembly included, beside a bare OSQP update and warm solve of the same matrices.
The solvers take turns problem by problem, and medians are printed, so that other work on the machine hits all alike.
Read ratios.

cvxopt is in the extra ``[bench]``; without it its columns are empty.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np
import osqp
from scipy import sparse

from fullswarm import kernels
from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.agent.safety import barrier
from fullswarm.agent.safety.filter import Measured, Requested, SafetyFilter, Tuning, robot_params
from fullswarm.core.centralised import joint_filter
from fullswarm.core.centralised.joint_filter import Arena, JointFilter
from fullswarm.drivers.base import NO_OBSTACLES, Description, Limits
from fullswarm.kernels import Array

RADIUS_M, MARGIN_M, GAIN, SPEED, REACH_M = 0.17, 0.03, 2.0, 0.5, 3.0
LIMITS = Limits(SPEED, 4.25, 2.0, 20.0)
BOUNDS = np.array([0.0, 0.0, 20.0, 20.0])
BATCH = 1000
SAME = 2e-3
"""m/s: answers that differ by more are counted as wrong; OSQP's tolerance is 1e-4."""
SOLVER: dict[str, Any] = {"verbose": False, "eps_abs": 1e-4, "eps_rel": 1e-4, "adaptive_rho_interval": 50}
TARGET = {"plain_us": 60.0, "batch_us": 2.0, "cvxopt": 20.0, "joint": 1.5}


@dataclass(slots=True)
class Single:
    """One robot: medians, µs per call."""

    neighbours: int
    ours_us: float
    solve_us: float  # the projection alone, rows ready made as for the others
    batch_us: float  # per robot
    compiled_us: float  # one robot in one call
    osqp_fresh_us: float
    osqp_warm_us: float
    cvxopt_us: float | None
    different: int  # answers unlike OSQP's
    unsolved: int  # where OSQP has none


@dataclass(slots=True)
class Joint:
    """All robots: medians, ms per tick."""

    robots: int
    pairs: int
    ours_ms: float
    osqp_ms: float  # bare update and warm solve

    @property
    def ratio(self) -> float:
        """How much more than the bare solver ours takes."""
        return self.ours_ms / self.osqp_ms


@dataclass(slots=True)
class Scene:
    """A robot, its neighbours (m, 2), its desired velocity; the rows of its problem, none left out."""

    pose: Array
    others: Array
    desired: Array
    normals: Array = field(init=False)
    limits: Array = field(init=False)

    def __post_init__(self) -> None:
        offset = self.others - self.pose[:2]
        distance = np.linalg.norm(offset, axis=1)
        gap = 0.5 * (distance - 2 * RADIUS_M - MARGIN_M)
        walls = np.concatenate([self.pose[:2] - BOUNDS[:2], BOUNDS[2:] - self.pose[:2]]) - RADIUS_M - MARGIN_M
        sides = np.array([[-1.0, 0.0], [0.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
        self.normals = np.concatenate([offset / distance[:, None], sides])
        self.limits = np.maximum(GAIN * np.concatenate([gap, walls]), 0.0)


def scenes(count: int, neighbours: int) -> list[Scene]:
    """Return crowds: the nearest neighbours touch margins, the farthest are a metre or two away."""
    rng = np.random.default_rng(neighbours)
    made = []
    for _ in range(count):
        pose = np.array([*rng.uniform(3.0, 17.0, 2), rng.uniform(-math.pi, math.pi)])
        angle, far = rng.uniform(-math.pi, math.pi, neighbours), 0.37 + rng.uniform(0.0, 1.0, neighbours) ** 2 * 2.0
        others = pose[:2] + far[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        desired = rng.uniform(-1.0, 1.0, 2)
        made.append(Scene(pose, others, desired * min(1.0, SPEED / float(np.linalg.norm(desired)))))
    return made


class Ours:
    """The filter of some scenes at once."""

    def __init__(self, some: list[Scene]) -> None:
        count, each = len(some), len(some[0].others)
        robots = robot_params(
            (Description("any", "any", RADIUS_M, LIMITS),) * count, np.full(count, SPEED),
            np.full(count, LIMITS.turn_rad_s), np.ones(count, bool),
        )  # fmt: skip
        tuning = Tuning(period_s=0.02, reach_m=REACH_M, speed_gain=1.0, turn_gain_per_s=3.0)
        self.filter = SafetyFilter([str(row) for row in range(count)], robots, tuning, BOUNDS)
        places = np.concatenate([one.others for one in some])
        states = np.zeros((len(places), 6))
        states[:, :2], states[:, 5] = places, RADIUS_M
        spread_m, blur_m, arrival_s = np.full(len(places), 0.001), np.full(len(places), 0.001), np.zeros(len(places))
        start, other = np.arange(count + 1) * each, np.arange(count * each)
        self.near = Nearby(start, other, places, states, spread_m, blur_m, arrival_s)
        self.requested = Requested(
            np.array([one.desired for one in some]),
            np.ones(count, bool),
            np.full(count, GAIN),
            np.full(count, MARGIN_M),
        )
        self.measured = Measured(
            np.array([one.pose for one in some]), np.zeros((count, 2)), np.zeros(count), np.zeros((count, 2))
        )
        self.twists = np.zeros((count, 2))

    def __call__(self) -> None:
        """Filter once."""
        self.filter.apply(0.0, self.requested, self.measured, self.near, NO_OBSTACLES, self.twists)


def timed(call: Callable[[], Any], into: list[float]) -> Any:
    began_s = time.perf_counter()
    answer = call()
    into.append(1e6 * (time.perf_counter() - began_s))
    return answer


def fresh(scene: Scene) -> Any:
    solver = osqp.OSQP()
    below = np.full(len(scene.limits), -np.inf)
    normals = sparse.csc_matrix(scene.normals)
    solver.setup(sparse.eye(2, format="csc"), -scene.desired, normals, below, scene.limits, **SOLVER)
    return solver, solver.solve(raise_error=False)


def by_cvxopt(scene: Scene) -> Callable[[], Any] | None:
    if importlib.util.find_spec("cvxopt") is None:
        return None
    cvxopt: Any = importlib.import_module("cvxopt")
    importlib.import_module("cvxopt.solvers")
    cvxopt.solvers.options["show_progress"] = False
    matrices = [cvxopt.matrix(each) for each in (np.eye(2), -scene.desired, scene.normals, scene.limits)]
    return lambda: cvxopt.solvers.qp(*matrices)


def single(neighbours: int, count: int) -> Single:
    """Measure one robot in plain Python; the batch comes later, once the kernels are compiled."""
    ours: list[float] = []
    solve: list[float] = []
    first: list[float] = []
    warm: list[float] = []
    interior: list[float] = []
    different = unsolved = 0
    solver: Any = None
    for scene in scenes(count, neighbours):
        call = Ours([scene])
        call()
        timed(call, ours)
        new, answer = timed(partial(fresh, scene), first)
        solver = solver or new
        data = sparse.csc_matrix(scene.normals).data

        def update(solver: Any = solver, scene: Scene = scene, data: Array = data) -> None:
            solver.update(q=-scene.desired, u=scene.limits, Ax=data)
            solver.solve(raise_error=False)

        timed(update, warm)
        other = by_cvxopt(scene)
        if other is not None:
            timed(other, interior)
        nx, ny = scene.normals.T.tolist()
        limits = scene.limits.tolist()
        x, y = scene.desired.tolist()
        planes = barrier.HalfPlanes._make((nx, ny, limits, [], []))
        found = timed(partial(barrier.project, x, y, planes, len(limits)), solve)
        solved = answer.info.status == "solved"
        unsolved += not solved
        different += solved and bool(np.abs(np.array(found) - answer.x).max() > SAME)
    median = statistics.median
    return Single(
        neighbours, median(ours), median(solve), math.nan, math.nan, median(first), median(warm),
        median(interior) if interior else None, different, unsolved,
    )  # fmt: skip


def compiled(neighbours: int, robots: int) -> float:
    """Return µs per call of the compiled filter, `robots` in one call."""
    call, took = Ours(scenes(robots, neighbours)), list[float]()
    call()
    for _ in range(30):
        timed(call, took)
    return statistics.median(took)


class Watched:
    """OSQP as the joint filter uses it; keeps its last update, for a bare solver to repeat it."""

    last: dict[str, Array] | None = None
    matrices: tuple[Any, ...] = ()

    def __init__(self) -> None:
        self._solver = osqp.OSQP()

    def setup(self, *matrices: Any, **settings: Any) -> None:
        """Note the matrices."""
        Watched.matrices, Watched.last = tuple(each.copy() for each in matrices), None
        self._solver.setup(*matrices, **settings)

    def warm_start(self, **start: Any) -> None:
        """Pass on."""
        self._solver.warm_start(**start)

    def update(self, **data: Array) -> None:
        """Note the vectors; copies, as the solver overwrites what it is given."""
        Watched.last = {name: each.copy() for name, each in data.items()}
        self._solver.update(**data)

    def solve(self, **options: Any) -> Any:
        """Pass on."""
        return self._solver.solve(**options)


def trace(robots: int, ticks: int) -> list[tuple[Array, Array]]:
    """Return positions and desired velocities of robots that crowd towards the middle, at the paper's density."""
    rng = np.random.default_rng(robots)
    side_m = 20.0 * math.sqrt(robots / 32)
    positions, joint = rng.uniform(0.5, side_m - 0.5, (robots, 2)), JointFilter()
    arena = Arena(np.zeros(2), np.full(2, side_m), SPEED, GAIN, MARGIN_M)
    steps = []
    for _ in range(ticks):
        desired = np.clip(0.2 * (side_m / 2 - positions) + rng.normal(0.0, 0.1, (robots, 2)), -SPEED, SPEED)
        steps.append((positions, desired))
        positions = positions + 0.05 * joint.filter(desired, positions, np.full(robots, RADIUS_M), arena)[0]
    return steps


def joint(robots: int, ticks: int) -> Joint:
    """Run the joint filter over a trace in turns with a bare OSQP that gets the same update in each tick."""
    side_m = 20.0 * math.sqrt(robots / 32)
    arena, radii = Arena(np.zeros(2), np.full(2, side_m), SPEED, GAIN, MARGIN_M), np.full(robots, RADIUS_M)
    steps, ours, bare = trace(robots, ticks), list[float](), list[float]()
    watched, questions, pairs = JointFilter(), list[tuple[Any, ...] | dict[str, Array]](), 0
    watched.solver_type = Watched
    for positions, desired in steps:
        _, near = watched.filter(desired, positions, radii, arena)
        pairs = max(pairs, len(near.first))
        questions.append(Watched.last or Watched.matrices)
    own, alone = JointFilter(), osqp.OSQP()
    for turn, ((positions, desired), question) in enumerate(zip(steps, questions, strict=True)):
        mine = partial(own.filter, desired, positions, radii, arena)
        if isinstance(question, tuple):  # the pattern changed: neither counts, both begin again
            mine()
            alone = osqp.OSQP()
            alone.setup(*question, **joint_filter.SETTINGS)
            alone.solve(raise_error=False)
            continue

        def again(update: dict[str, Array] = question, solver: Any = alone) -> None:
            solver.update(**update)
            solver.solve(raise_error=False)

        both: list[tuple[Callable[[], Any], list[float]]] = [(mine, ours), (again, bare)]
        for call, into in both if turn % 2 else both[::-1]:
            timed(call, into)
    return Joint(robots, pairs, 1e-3 * statistics.median(ours), 1e-3 * statistics.median(bare))


def report(singles: list[Single], joints: list[Joint]) -> None:
    for one in singles:
        target = f"target {TARGET['plain_us']:.0f}, {TARGET['batch_us']:.0f}" if one.neighbours == 10 else "no target"
        print(
            f"1 robot, {one.neighbours:2d} neighbours   ours {one.ours_us:5.1f} µs plain (solve {one.solve_us:.1f}), "
            f"{one.batch_us:5.2f} µs per robot compiled ({target})   OSQP fresh {one.osqp_fresh_us:.0f} µs, "
            f"warm {one.osqp_warm_us:.0f} µs"
        )
        if one.cvxopt_us is not None:
            print(
                f"{'':26}cvxopt {one.cvxopt_us:.0f} µs: {one.cvxopt_us / one.solve_us:.0f}x our solve (target "
                f"{TARGET['cvxopt']:.0f}), {one.cvxopt_us / one.ours_us:.0f}x our whole call in plain Python, "
                f"{one.cvxopt_us / one.compiled_us:.0f}x compiled"
            )
        print(f"{'':26}answers unlike OSQP's {one.different}; OSQP has none {one.unsolved} times")
    for each in joints:
        print(
            f"joint N={each.robots:<4} {each.pairs:4d} pairs   ours {each.ours_ms:7.3f} ms   OSQP update + warm "
            f"{each.osqp_ms:7.3f} ms   ratio {each.ratio:4.2f} (target {TARGET['joint']})"
        )


def missed(singles: list[Single], joints: list[Joint]) -> bool:
    """Tell whether a figure misses its target."""
    ten = singles[0]
    slow = ten.ours_us > TARGET["plain_us"] or ten.batch_us > TARGET["batch_us"]
    slow |= ten.cvxopt_us is not None and ten.cvxopt_us < TARGET["cvxopt"] * ten.solve_us
    return slow or any(each.different for each in singles) or any(each.ratio > TARGET["joint"] for each in joints)


def main() -> int:
    """Print the figures; return 1 when one misses its target."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--robots", default="8,32,100")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    singles = [single(neighbours, options.scenes) for neighbours in (10, 31)]
    joints = [joint(robots, 200) for robots in map(int, options.robots.split(","))]
    kernels.compile_all()
    for each in singles:
        each.batch_us = compiled(each.neighbours, BATCH) / BATCH
        each.compiled_us = compiled(each.neighbours, 1)
    if options.json:
        together = [asdict(each) | {"ratio": each.ratio} for each in joints]
        print(json.dumps({"single": [*map(asdict, singles)], "joint": together}))
    else:
        report(singles, joints)
    return int(missed(singles, joints))


if __name__ == "__main__":
    sys.exit(main())
