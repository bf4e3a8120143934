"""The batteries of simulated bodies, and the docks that charge them.

Each body draws a share of its capacity per hour, per metre and per radian; one that stands in a slot of a dock is
charged. Bodies differ from one another by factors that the world's seed decides. A body whose battery is empty moves no
more until it is charged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fullswarm.config import WorldConfig
from fullswarm.config.docks import Slot
from fullswarm.kernels import Array, kernel

ALIGNED_RAD = 0.35
"""A body that looks in a dock's direction within this has its contacts."""
HOUR_S = 3600.0


class Batteries:
    """The batteries of n bodies.

    Parameters
    ----------
    slots : of the docks, one body each

    Attributes
    ----------
    charge : (n,) share of each capacity, 0 to 1
    charging : (n,) current flows into it
    slot : (n,) the slot in which a body stands, -1: in none
    powered : (k,) slots that charge; a rehearsed fault clears it
    flat_s : (n,) for how long each was empty, in all
    rates : (n, 4) share per hour at rest, per metre, per radian; share per hour that a dock puts in
    """

    def __init__(self, config: WorldConfig, count: int, slots: Sequence[Slot] = ()) -> None:
        battery = config.battery
        assert battery is not None  # noqa: S101  (a world without batteries makes none)
        rng = np.random.default_rng((config.seed, 2))
        self.charge = battery.start - battery.start_spread * rng.random(count)
        np.maximum(self.charge, 0.0, out=self.charge)
        draw = 1.0 + battery.spread * rng.uniform(-1.0, 1.0, count)
        fill = 1.0 + battery.spread * rng.uniform(-1.0, 1.0, count)
        self.rates = np.column_stack(
            [
                battery.rest_per_h * draw,
                battery.drive_per_m * draw,
                battery.turn_per_rad * draw,
                battery.charge_per_h * fill,
            ]
        )
        self.charging = np.zeros(count, np.bool_)
        self.slot = np.full(count, -1, np.int64)
        self.flat_s = np.zeros(count)
        places = [(each.x_m, each.y_m, each.heading_rad) for each in slots]
        self._places = np.array(places, float).reshape(-1, 3)
        self.powered = np.ones(len(places), np.bool_)
        self._contact_m = battery.contact_m

    def step(self, pose: Array, twist: Array, dt_s: float) -> None:
        """Let `dt_s` pass with bodies at `pose` (n, 3) that move by `twist` (n, 2)."""
        drain.run(
            pose, twist, self.rates, self._places, self.powered, self.charge, self.charging, self.slot, self.flat_s,
            self._contact_m, dt_s,
        )  # fmt: skip

    def hold_flat(self, target: Array) -> None:
        """Set the set-points (n, 2) of bodies whose battery is empty to zero."""
        stop_flat.run(self.charge, target)


@kernel
def stop_flat(charge: Array, target: Array) -> None:
    """Set `target` (n, 2) to zero where `charge` (n,) is none."""
    for i in range(charge.shape[0]):
        if charge[i] <= 0.0:
            target[i, 0] = 0.0
            target[i, 1] = 0.0


@kernel
def drain(
    pose: Array, twist: Array, rates: Array, places: Array, powered: NDArray[np.bool_], charge: Array,
    charging: NDArray[np.bool_], slot: NDArray[np.int64], flat_s: Array, contact_m: float, dt_s: float,
) -> None:  # fmt: skip
    """Advance all batteries by `dt_s`; see :class:`Batteries`. `places` (k, 3): poses of docked bodies."""
    for i in range(charge.shape[0]):
        slot[i] = -1
        for k in range(places.shape[0]):
            dx = pose[i, 0] - places[k, 0]
            dy = pose[i, 1] - places[k, 1]
            if dx * dx + dy * dy <= contact_m * contact_m:
                off = pose[i, 2] - places[k, 2]
                if math.cos(off) >= math.cos(ALIGNED_RAD):
                    slot[i] = k
        charging[i] = False
        if slot[i] >= 0 and powered[slot[i]]:
            charging[i] = charge[i] < 1.0
            charge[i] = min(1.0, charge[i] + rates[i, 3] * dt_s / HOUR_S)
        else:
            spent = rates[i, 0] / HOUR_S + rates[i, 1] * math.fabs(twist[i, 0]) + rates[i, 2] * math.fabs(twist[i, 1])
            charge[i] = max(0.0, charge[i] - spent * dt_s)
        if charge[i] <= 0.0:
            flat_s[i] += dt_s
