"""Charging: 24 simulated hours of 8 robots with batteries that patrol, and share docks.

    python -m benchmarks.charging [--hours 24] [--seeds 1 2 3] [--docks 3] [--robots 8] [--battery create|titanate]
                                  [--rate-hz 10] [--save FILE.npz]

All robots are asked to drive around a line (`perimeter_bc`, 26 m, 0.3 m/s, at equal distances) for the whole time;
those that are left close the gaps of those that charge. The judge reads what the simulated world itself records once
per second: true poses, true charges, and which bodies a dock charges. It imports nothing of the planner, the agents or
their reports. Its terms:

served    a second in which a robot is in the patrolled area (2.5 m off the wall with the docks) and has moved by 0.3 m
          or more within the last 30 s; on the way to and from a dock, in it, and waiting, it does not serve
asked     all robots, from the request until the end
feasible  of what was asked, the share that physics allows: a robot that draws w per hour while it serves and is charged
          with r per hour must be in a dock for w / (w + r) of the time. Counted per robot with its own true rates and
          with what its battery had at first and has at the end; ways, docking, waiting and planning are not in it, so
          they count as losses. Where docks are short, their time is a bound as well.

The bar: served >= 95 % of feasible, and no battery ever empty. The raw share (served of asked) is printed beside it.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import structlog
from numpy.typing import NDArray

from fullswarm.config import SwarmConfig
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import BehaviourRequest

Array = NDArray[np.float64]

LINE: list[float | list[float]] = [[4.0, 1.0], [11.0, 1.0], [11.0, 7.0], [4.0, 7.0]]
SPEED_M_S = 0.3
AREA_X_M = 2.5
MOVED_M, WITHIN_S = 0.3, 30
BAR = 0.95


BATTERIES = {
    "create": {"rest_per_h": 0.111, "drive_per_m": 0.000172, "turn_per_rad": 0.00002, "charge_per_h": 0.556},
    "titanate": {"rest_per_h": 0.05, "drive_per_m": 0.00009, "turn_per_rad": 0.00001, "charge_per_h": 6.0},
}
"""Of a Create 2: 11 %/h at rest, 30 %/h at 0.3 m/s, charged with 55 %/h. Of lithium titanate, as in vehicles that are
charged in between: 15 %/h at 0.3 m/s, charged in ten minutes."""


def fleet(robots: int, docks: int, seed: int, rate_hz: float, battery: str = "create") -> SwarmConfig:
    """Return robots with one of the `BATTERIES`."""
    spacing_m = 7.0 / docks
    return SwarmConfig.model_validate(
        {
            "world": {
                "engine": "kinematic", "bounds_m": (0.0, 0.0, 12.0, 8.0), "seed": seed, "rate_hz": rate_hz,
                "battery": {
                    "start": 1.0, "start_spread": 0.3, "spread": 0.1, **BATTERIES[battery],
                },
            },
            "agent": {"control_rate_hz": rate_hz},
            "robot": [
                {"id": f"r{row + 1}", "pose": (4.0 + 2.0 * (row % 4), 2.5 + 3.0 * (row // 4), 0.0)}
                for row in range(robots)
            ],
            "dock": [
                {"id": f"d{number + 1}", "pose": (0.3, 0.5 + spacing_m * (number + 0.5), np.pi)}
                for number in range(docks)
            ],
        }
    )  # fmt: skip


class Record:
    """What the simulated world itself knows, once per second."""

    def __init__(self, lockstep: Lockstep) -> None:
        self._world, self._steps = lockstep.world, round(1.0 / lockstep.world.dt_s)
        self._count = 0
        self.pose: list[Array] = []
        self.charge: list[Array] = []
        self.charging: list[NDArray[np.bool_]] = []
        self.contacts = 0
        self._world.watchers.append(self._step)

    def _step(self) -> None:
        world, batteries = self._world, self._world.batteries
        self.contacts += int((world.contacts > 0).any())
        self._count += 1
        if self._count % self._steps == 0 and batteries is not None:
            self.pose.append(world.pose[:, :2].copy())
            self.charge.append(batteries.charge.copy())
            self.charging.append(batteries.charging.copy())


@dataclass(frozen=True)
class Verdict:
    """What the judge makes of a record."""

    raw: float  # served of asked
    feasible: float  # what physics allows of asked
    feasible_emptied: float  # the same if all batteries could be empty at the end
    least_charge: float
    flat_s: float
    docked: float  # mean share of the docks in use
    visits: int

    @property
    def share(self) -> float:
        """Served of feasible."""
        return self.raw / self.feasible


def judge(pose: Array, charge: Array, charging: NDArray[np.bool_], docks: int, from_s: int) -> Verdict:
    """Judge a record of t seconds and n robots: `pose` (t, n, 2), `charge` and `charging` (t, n).

    Parameters
    ----------
    from_s : when the task was asked for
    """
    pose, charge, charging = pose[from_s:], charge[from_s:], charging[from_s:]
    seconds, robots = charge.shape
    moved = np.zeros((seconds, robots), bool)
    step_m = np.linalg.norm(pose[WITHIN_S:] - pose[:-WITHIN_S], axis=2)
    for ahead in range(1, WITHIN_S):  # a patrol may come back to where it was: the greatest distance counts
        step_m = np.maximum(step_m, np.linalg.norm(pose[WITHIN_S:] - pose[ahead : ahead + seconds - WITHIN_S], axis=2))
    moved[WITHIN_S:] = step_m >= MOVED_M
    moved[:WITHIN_S] = True
    served = moved & (pose[:, :, 0] >= AREA_X_M)
    hours = seconds / 3600.0
    rise = np.diff(charge, axis=0)
    bounds, emptied, in_dock = [], [], []
    for robot in range(robots):
        working = served[1:, robot] & ~charging[1:, robot]
        filling = charging[1:, robot] & charging[:-1, robot]
        draw = -3600.0 * float(rise[working, robot].mean())
        fill = 3600.0 * float(rise[filling, robot].mean()) if filling.any() else 0.0
        used = float(charge[0, robot] - charge[-1, robot]), float(charge[0, robot])
        found = [min(1.0, (fill + each / hours) / (draw + fill)) if draw + fill > 0.0 else 1.0 for each in used]
        bounds.append(found[0])
        emptied.append(found[1])
        in_dock.append(1.0 - found[0])
    # Charging takes (1 - bound) of each robot's time; docks have room for `docks` robots at a time.
    feasible = float(np.mean(bounds))
    if sum(in_dock) > docks:
        feasible *= docks / sum(in_dock)
    starts = charging[1:] & ~charging[:-1]
    return Verdict(
        raw=float(served.mean()), feasible=feasible, feasible_emptied=float(np.mean(emptied)),
        least_charge=float(charge.min()), flat_s=float((charge <= 0.0).sum()),
        docked=float(charging.sum(axis=1).mean()) / docks, visits=int(starts.sum()),
    )  # fmt: skip


def run(hours: float, config: SwarmConfig, save: Path | None) -> tuple[Verdict, int]:
    """Run one patrol; return the verdict and in how many control periods bodies touched."""
    lockstep = Lockstep(config)
    record = Record(lockstep)
    try:
        lockstep.run(5.0)
        request = BehaviourRequest(
            id="patrol", behaviour="perimeter_bc", parameters={"corners": LINE, "speed_m_s": SPEED_M_S}, source="judge"
        )
        lockstep.bus_of("benchmark").publish(lockstep.keys.behaviour_request, request)
        lockstep.run(hours * 3600.0)
    finally:
        lockstep.close()
    pose, charge = np.array(record.pose, np.float64), np.array(record.charge, np.float64)
    charging = np.array(record.charging, np.bool_)
    if save is not None:
        np.savez_compressed(save, pose=pose.astype(np.float32), charge=charge, charging=charging)
    return judge(pose, charge, charging, len(config.dock), 5), record.contacts


def main() -> int:
    """Print a line per seed; return 1 if a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--docks", type=int, default=3)
    parser.add_argument("--rate-hz", type=float, default=50.0, help="of the world and of the agents' control")
    parser.add_argument("--battery", choices=tuple(BATTERIES), default="create")
    parser.add_argument("--log", action="store_true", help="print what the core decides")
    parser.add_argument("--save", type=Path, default=None)
    given = parser.parse_args()
    level = logging.INFO if given.log else logging.ERROR
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(level))
    missed = False
    print(
        f"{'seed':>4} {'raw':>7} {'feasible':>9} {'served/feas.':>13} {'least charge':>13} {'flat s':>7} "
        f"{'docks in use':>13} {'visits':>7} {'contacts':>9} {'took s':>7}"
    )
    for seed in given.seeds:
        began_s = time.perf_counter()
        config = fleet(given.robots, given.docks, seed, given.rate_hz, given.battery)
        found, contacts = run(given.hours, config, given.save)
        took_s = time.perf_counter() - began_s
        print(
            f"{seed:>4} {found.raw:>7.1%} {found.feasible:>9.1%} {found.share:>13.1%} {found.least_charge:>13.1%} "
            f"{found.flat_s:>7.0f} {found.docked:>13.1%} {found.visits:>7} {contacts:>9} {took_s:>7.0f}"
            f"   (emptied: {found.feasible_emptied:.1%})",
            flush=True,
        )
        missed |= found.share < BAR or found.flat_s > 0.0
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
