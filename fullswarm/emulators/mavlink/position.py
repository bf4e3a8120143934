"""What an emulated autopilot has of its position: its map, its filter's errors, and what measures it.

A rover measures its position by GPS, or takes poses that are measured from outside (ODOMETRY). These count only with
VISO_TYPE=1, EK3_SRC1_POSXY=6 and an origin (SET_GPS_GLOBAL_ORIGIN), and only in the one pair of frames that the
firmware takes.

The errors were recorded against the simulator's truth (83 s): velocity 0.02 m/s per axis, up to 0.05 m/s at rest, half
gone after 5 s; position 0.02 m per axis (0.03 north and 0.05 east over longer runs), moving by less than 0.012 m/s at
rest. Both are sums of slow sines here: smooth, bounded, and the same for the same seed.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field, replace
from typing import Any

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.maps import Degrees, FlatMap, Map
from fullswarm.earth import SITL_ORIGIN_DEG, TangentPlane
from fullswarm.geometry import wrap
from fullswarm.simulation.bodies import BodyState

ALTITUDE_M = 584.0
VELOCITY_M_S, VELOCITY_PERIODS_S = 0.0175, (13.0, 23.0, 41.0)
POSITION_M, POSITION_PERIODS_S = 0.028, (37.0, 59.0, 97.0)
JITTER_M, JITTER_M_S = 0.0003, 0.0005
BIAS_M_S2 = 0.06
"""Of the accelerometers: what dead reckoning drifts with."""
COASTS_S = 0.3  # a filter that is aided five times a second has nothing to reckon in between

Wave = tuple[float, float]  # rad/s, phase
LOST_S = 7.0  # a filter without a source gives up the position this much later
FAILSAFE_S = 8.2  # and the failsafe acts
LOCAL_FRD, BODY_FRD = 20, 12
BY_GPS, BY_OTHERS = 3.0, 6.0
FIX_PERIOD_S = 0.2
SILENT_S = 4.0
"""A silent receiver keeps its last fix for so long; only the time of that fix stands still."""
NO_RECEIVER, NO_FIX, FIXED = 0, 1, 6


@dataclass(slots=True)
class Chart:
    """The world's place on earth, and the autopilot's own map.

    Parameters
    ----------
    world
        Where on earth the world's (0, 0) is.
    map
        How the autopilot makes metres of degrees.
    origin
        Where its map begins; None: not yet known, or given by poses from outside.
    """

    world: Degrees = SITL_ORIGIN_DEG
    map: Map = field(default_factory=FlatMap)
    origin: Degrees | None = None

    @property
    def _plane(self) -> TangentPlane:
        return TangentPlane(*self.world, ALTITUDE_M)

    def begin(self, x_m: float, y_m: float) -> None:
        """Begin the map at a place of the world, as exactly as messages carry it (1e-7 degrees)."""
        latitude, longitude = self.degrees(x_m, y_m)
        self.origin = round(latitude, 7), round(longitude, 7)

    def degrees(self, x_m: float, y_m: float) -> Degrees:
        """Return latitude and longitude of a place in the world."""
        latitude, longitude, _ = self._plane.geodetic(x_m, y_m)
        return latitude, longitude

    def place(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Return the place in the world, metres east and north; the inverse of :meth:`degrees`."""
        x_m, y_m, _ = self._plane.enu(latitude_deg, longitude_deg)
        return x_m, y_m

    def local(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return metres north and east on the map of a place in the world; the same without a map of its own."""
        return (y_m, x_m) if self.origin is None else self.map.metres(self.origin, self.degrees(x_m, y_m))

    def world_place(self, north_m: float, east_m: float) -> tuple[float, float]:
        """Return the place in the world of one on the map; the inverse of :meth:`local`."""
        if self.origin is None:
            return east_m, north_m
        return self.place(*self.map.degrees(self.origin, north_m, east_m))


# ---------------------------------------------------------------- the errors of the filter
class FilterNoise:
    """The errors of one rover's filter now, world frame.

    Parameters
    ----------
    seed
        Two rovers with the same seed err alike.
    scale
        0: a filter without errors.
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
        """Return what the filter estimates; of the velocity's error only the part along the heading is kept."""
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


# ---------------------------------------------------------------- what measures the position
@dataclass(slots=True)
class Position:
    """What the position filter is fed with."""

    parameters: dict[str, float]
    gps: bool = True  # the receiver is on
    covered: bool = False  # its antenna: it is on, and has no fix
    fix_s: float = -math.inf  # when it had the last one
    origin: bool = False
    given: tuple[float, float] | None = None  # latitude and longitude that a station has set
    _fed_s: float = -math.inf
    _shift: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0))  # from the truth to the poses from outside

    def restart(self, now_s: float) -> None:
        """Forget the origin and the poses from outside; GPS is taken to be fine until now."""
        self.origin, self.given, self._shift = False, None, (0.0, 0.0, 0.0)
        self._fed_s = now_s if self.receiving and self.by_gps else -math.inf
        self.fix_s = -math.inf

    @property
    def by_gps(self) -> bool:
        """Whether GPS is what counts."""
        return self.parameters.get("EK3_SRC1_POSXY") != BY_OTHERS

    def step(self, now_s: float) -> None:
        """Let GPS, if there is any, measure the position."""
        if not self.receiving:
            return
        if now_s - self.fix_s >= FIX_PERIOD_S - 1e-6:
            self.fix_s = now_s
        if self.by_gps:
            self._fed_s = now_s

    @property
    def receiving(self) -> bool:
        """Whether there is a receiver, switched on, with a signal."""
        return self.gps and not self.covered and not self.parameters.get("SIM_GPS_DISABLE")

    def fix_type(self, now_s: float) -> int:
        """Return what GPS_RAW_INT calls the fix."""
        if self.receiving:
            return FIXED
        if self.covered and self.gps:
            return NO_FIX
        return FIXED if now_s - self.fix_s < SILENT_S else NO_RECEIVER

    def silent_s(self, now_s: float) -> float:
        """Return for how long nothing has measured the position."""
        return now_s - self._fed_s

    def known(self, now_s: float) -> bool:
        """Whether there is a position (once the filter has settled after boot)."""
        return self.silent_s(now_s) < LOST_S and (self.by_gps or self.origin)

    def odometry(self, message: Any, truth: BodyState, now_s: float) -> None:
        """Take ODOMETRY; other frames than LOCAL_FRD and BODY_FRD are dropped."""
        if (message.frame_id, message.child_frame_id) == (LOCAL_FRD, BODY_FRD):
            w, x, y, z = message.q
            yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
            self._take(message.x, message.y, yaw, truth, now_s)

    def vision(self, message: Any, truth: BodyState, now_s: float) -> None:
        """Take VISION_POSITION_ESTIMATE."""
        self._take(message.x, message.y, message.yaw, truth, now_s)

    def _take(self, north: float, east: float, yaw: float, truth: BodyState, now_s: float) -> None:
        if self.by_gps or not self.parameters.get("VISO_TYPE") or not math.isfinite(north + east + yaw):
            return
        turned = wrap(p.heading_from_yaw(yaw) - truth.heading_rad)
        if self.parameters.get("EK3_SRC1_YAW") != BY_OTHERS:
            turned = 0.0
        self._shift = (east - truth.x_m, north - truth.y_m, turned)
        self._fed_s = now_s

    def measured(self, truth: BodyState) -> BodyState:
        """Return the position that the filter takes from its sources."""
        x, y, turned = self._shift
        if self._shift == (0.0, 0.0, 0.0):
            return truth
        heading = wrap(truth.heading_rad + turned)
        return replace(truth, x_m=truth.x_m + x, y_m=truth.y_m + y, heading_rad=heading)
