"""Columns of what robots are and can do, as control laws read them: one row per robot or pair, from their profiles.

What is not known is "" for a make, -1 for a charge, NaN for a limit, and false for a capability.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fullswarm.kernels import Array, Flags
from fullswarm.messages import RobotProfile

Known = Sequence[RobotProfile | None]
"""Profiles of k robots; None: that of the robot has not been received."""


def makes(profiles: Known) -> NDArray[np.str_]:
    """Return the makes, (k,)."""
    return np.array(["" if each is None else each.make for each in profiles], np.str_)


def charges(profiles: Known) -> Array:
    """Return the charges, (k,) 0 to 1."""
    return np.array([-1.0 if each is None else each.battery for each in profiles])


def having(profiles: Known, capability: str) -> Flags:
    """Tell which robots state a capability, (k,)."""
    return np.array([each is not None and capability in each.capabilities for each in profiles], bool)


def limits(profiles: Known) -> Array:
    """Return the greatest speeds, turn rates and accelerations, (k, 3) m/s, rad/s, m/s²."""
    unknown = math.nan, math.nan, math.nan
    rows = [
        unknown if each is None else (each.speed_limit_m_s, each.turn_limit_rad_s, each.accel_m_s2) for each in profiles
    ]
    return np.array(rows).reshape(-1, 3)
