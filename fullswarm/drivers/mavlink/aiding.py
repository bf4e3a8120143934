"""Whether the vehicle's position is still measured, or dead reckoning, and how uncertain it has become since.

An autopilot goes on sending positions for seconds after its satellite receiver has lost the signal, and its EKF calls
them good. The receiver's own message tells: the fix falls, or the time of the last fix stands still although the
message keeps coming (ArduPilot repeats the last fix of a receiver that is silent for 4 s).
"""

from __future__ import annotations

import math

from fullswarm.drivers.mavlink import protocol as p

SIGMA_M = 0.05
"""Standard deviation of an aided position, per axis: 0.03 m north and 0.05 m east of the simulator's truth."""
DRIFT_M_S, DRIFT_M_S2 = 0.04, 0.12
"""An unaided position drifts with the error of the velocity at its loss, and with that of the accelerations."""
FIX_3D = 3
STRAINED = 0.8
"""Innovation test ratio from which on an EKF rejects what it is aided with; also ArduPilot's FS_EKF_THRESH."""
TOLD_S = 1.0


class Aiding:
    """What was heard of a vehicle's receiver and filter, with arrival times (s, monotonic).

    Parameters
    ----------
    receiver
        Whether satellites are what aids it; False: poses from outside do.
    filtered
        Whether what the EKF says of itself counts.
    """

    def __init__(self, *, receiver: bool = True, filtered: bool = True) -> None:
        self._by_receiver, self._filtered = receiver, filtered
        self._fix: p.SatelliteFix | None = None  # the newest message
        self._heard_s = -math.inf  # and when it came
        self._fix_us = -1
        self._aided_s: float | None = None  # when a new fix came; None: there was none, it is aided by something else
        self._strained_s: float | None = None  # since when the filter rejects what aids it

    @property
    def has_receiver(self) -> bool:
        """Whether a satellite receiver has had a fix."""
        return self._aided_s is not None

    def receive(self, body: p.SatelliteFix | p.EkfStatus, now_s: float) -> None:
        """Take what the receiver or the filter says."""
        if isinstance(body, p.EkfStatus):
            bad = self._filtered and (body.strain > STRAINED or not body.good)
            self._strained_s = (now_s if self._strained_s is None else self._strained_s) if bad else None
            return
        self._fix, self._heard_s = body, now_s
        if self._by_receiver and body.fix_type >= FIX_3D and body.stamp_us != self._fix_us:
            self._fix_us, self._aided_s = body.stamp_us, now_s

    def unheard(self, now_s: float) -> bool:
        """Tell whether a receiver that had a fix has not been heard for so long that its state is not known."""
        return self.has_receiver and now_s - self._heard_s >= TOLD_S

    def age_s(self, now_s: float) -> float:
        """Return for how long nothing has measured the position."""
        lost_s = [each for each in (self._aided_s, self._strained_s) if each is not None]
        return max(0.0, now_s - min(lost_s)) if lost_s else 0.0

    def sigma_m(self, now_s: float) -> float:
        """Return the standard deviation of the position, per axis."""
        age_s = self.age_s(now_s)
        return SIGMA_M + DRIFT_M_S * age_s + 0.5 * DRIFT_M_S2 * age_s**2

    def problem(self, now_s: float) -> str:
        """Return what is lost, once that is no hiccup; empty while the position is measured."""
        age_s = self.age_s(now_s)
        if age_s < TOLD_S or not math.isfinite(age_s):
            return ""
        silent = self._aided_s is not None and now_s - self._aided_s >= TOLD_S
        if silent and self._fix is not None and self._fix.fix_type < FIX_3D:
            what = f"the satellite receiver has no fix (type {self._fix.fix_type})"
        elif silent:
            what = "the satellite receiver tells nothing new"
        else:
            what = "the autopilot's filter rejects what measures its position"
        return f"{what}: the position has been dead reckoning for {age_s:.1f} s"
