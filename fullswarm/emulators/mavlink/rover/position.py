"""Whether the rover knows where it is: by GPS, or by poses that somebody measures for it (ODOMETRY).

Poses from outside count only with VISO_TYPE=1, EK3_SRC1_POSXY=6 and an origin (SET_GPS_GLOBAL_ORIGIN), and only in
the one pair of frames that the firmware takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.geometry import wrap
from fullswarm.simulation.bodies import BodyState

LOST_S = 7.0  # a filter without a source gives up the position this much later
FAILSAFE_S = 8.2  # and the failsafe acts
LOCAL_FRD, BODY_FRD = 20, 12
BY_GPS, BY_OTHERS = 3.0, 6.0
FIX_PERIOD_S = 0.2
SILENT_S = 4.0
"""A receiver that says nothing keeps its last fix for so long; only the time of that fix stands still."""
NO_RECEIVER, NO_FIX, FIXED = 0, 1, 6


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
    _shift: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0))  # from the truth to what it is told

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
        """Let GPS, if there is any, say where the rover is."""
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
        """Return how long nothing has been heard of where the rover is."""
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

    def believed(self, truth: BodyState) -> BodyState:
        """Return where the rover believes to be."""
        x, y, turned = self._shift
        if self._shift == (0.0, 0.0, 0.0):
            return truth
        heading = wrap(truth.heading_rad + turned)
        return replace(truth, x_m=truth.x_m + x, y_m=truth.y_m + y, heading_rad=heading)
