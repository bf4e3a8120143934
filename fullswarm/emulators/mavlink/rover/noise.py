"""What the rover's position filter makes of the truth: errors of position and velocity, as recorded, and drift.

Recorded against the simulator's truth (83 s): velocity 0.02 m/s per axis, up to 0.05 m/s at rest, half gone after 5 s;
position 0.02 m per axis (0.03 north and 0.05 east over longer runs), moving by less than 0.012 m/s at rest. Both are
sums of slow sines here: smooth, bounded, and the same for the same seed.
"""

from __future__ import annotations

import math
import random
from dataclasses import replace

from fullswarm.simulation.bodies import BodyState

VELOCITY_M_S, VELOCITY_PERIODS_S = 0.0175, (13.0, 23.0, 41.0)
POSITION_M, POSITION_PERIODS_S = 0.028, (37.0, 59.0, 97.0)
JITTER_M, JITTER_M_S = 0.0003, 0.0005
BIAS_M_S2 = 0.06
"""Of the accelerometers: what dead reckoning drifts with."""
COASTS_S = 0.3  # a filter that is aided five times a second has nothing to reckon in between

Wave = tuple[float, float]  # rad/s, phase


class FilterNoise:
    """The errors of one rover's filter now, world frame.

    Parameters
    ----------
    seed
        Two rovers with the same seed err alike.
    scale
        0: a filter that knows the truth.
    """

    def __init__(self, seed: int, scale: float = 1.0) -> None:
        rng = self._random = random.Random(seed)  # noqa: S311  (must repeat, keeps no secret)
        self.scale = scale
        self._velocity = [_waves(rng, VELOCITY_PERIODS_S) for _ in range(2)]
        self._position = [_waves(rng, POSITION_PERIODS_S) for _ in range(2)]
        direction = rng.uniform(-math.pi, math.pi)
        self._bias_m_s2 = BIAS_M_S2 * math.cos(direction), BIAS_M_S2 * math.sin(direction)
        self._drift_m, self._drift_m_s = [0.0, 0.0], [0.0, 0.0]
        self._offset_m, self._error_m_s = [0.0, 0.0], [0.0, 0.0]

    def step(self, up_s: float, unaided_s: float, dt_s: float, *, by_satellites: bool = True) -> None:
        """Go on to `up_s` after power-on; nothing has measured the position for `unaided_s`.

        Only satellites let the position wander: poses from outside are taken as they are.
        """
        gauss = self._random.gauss
        for axis in range(2):
            steady_m_s = VELOCITY_M_S * _sum(self._velocity[axis], up_s)
            if unaided_s > COASTS_S:
                self._drift_m_s[axis] += self._bias_m_s2[axis] * dt_s
                self._drift_m[axis] += (self._drift_m_s[axis] + steady_m_s) * dt_s
            else:
                self._drift_m[axis] = self._drift_m_s[axis] = 0.0
            wander_m = POSITION_M * _sum(self._position[axis], up_s) if by_satellites else 0.0
            self._offset_m[axis] = wander_m + self._drift_m[axis] + gauss(0.0, JITTER_M)
            self._error_m_s[axis] = steady_m_s + self._drift_m_s[axis] + gauss(0.0, JITTER_M_S)

    def seen(self, truth: BodyState) -> BodyState:
        """Return what the filter believes; of the velocity's error only the part along the heading is kept."""
        if self.scale == 0.0:
            return truth
        (east_m, north_m), (east_m_s, north_m_s) = self._offset_m, self._error_m_s
        along_m_s = east_m_s * math.cos(truth.heading_rad) + north_m_s * math.sin(truth.heading_rad)
        return replace(
            truth,
            x_m=truth.x_m + self.scale * east_m,
            y_m=truth.y_m + self.scale * north_m,
            speed_m_s=truth.speed_m_s + self.scale * along_m_s,
        )


def _waves(rng: random.Random, periods_s: tuple[float, ...]) -> list[Wave]:
    return [(2.0 * math.pi / each, rng.uniform(-math.pi, math.pi)) for each in periods_s]


def _sum(waves: list[Wave], at_s: float) -> float:
    return sum(math.sin(rate * at_s + phase) for rate, phase in waves)
