"""Poses measured from outside (motion capture, ultra-wideband) for a vehicle without GPS: ODOMETRY and the origin.

Needs in the vehicle, checked before READY:

- ArduPilot: ``VISO_TYPE=1`` (then a reboot), ``EK3_SRC1_POSXY=6``, ``EK3_SRC1_VELXY=0`` (or 7 with wheel encoders,
  never 6: no velocity is measured), ``EK3_SRC1_YAW=6`` (with 1 the compass has to agree with the outer frame).
- PX4: ``EKF2_EV_CTRL`` with bits 0 and 3 (9); ``EKF2_GPS_CTRL=0`` indoors.

The outer frame is taken for ENU: its y axis is the vehicle's north.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fullswarm.drivers.base import Limits, Pose
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import StationEncoder
from fullswarm.errors import ConfigError
from fullswarm.geometry import wrap

SHORTEST_S = 0.02
REPEAT_S = 0.2
"""The vehicle wants at least 4 Hz."""
STALE_S = 1.0
ORIGIN_S = 1.0
JUMP_SIGMAS = 5.0
JUMP_M, JUMP_RAD = 0.2, 0.3
UNSEEN_RAD = 1.0
FAR_DEG = 1e-5  # about a metre


@dataclass(frozen=True, slots=True)
class _Located:
    at_s: float
    pose: Pose
    position_sigma_m: float
    heading_sigma_rad: float


class ExternalPose:
    """Takes fixes, decides when to send which ODOMETRY, and sets the origin.

    Parameters
    ----------
    limits
        What the vehicle can do; a fix that it cannot have driven to is a jump of what measures it.
    origin
        Where the local frame begins; None: the vehicle knows it already.
    """

    def __init__(self, encoder: StationEncoder, limits: Limits, origin: p.Origin | None, velocity: float) -> None:
        self._encoder, self._limits, self._wanted, self._velocity = encoder, limits, origin, velocity
        self._fix: _Located | None = None
        self._resets = 0
        self._new = False
        self._sent_s = -math.inf
        self.restart()

    def restart(self) -> None:
        """Begin anew: another boot has no origin."""
        self._origin: p.Origin | None = None
        self._origin_due_s = -math.inf
        self._asked = False

    def locate(self, pose: Pose, position_sigma_m: float, heading_sigma_rad: float, now_s: float) -> None:
        """Take a fix, ENU; standard deviations in m and rad. One that is not finite is dropped.

        Above 1 rad the heading was not seen: the vehicle's own is sent in its place, with that deviation.
        """
        seen = heading_sigma_rad <= UNSEEN_RAD
        numbers = (pose.x_m, pose.y_m, pose.heading_rad if seen else 0.0, position_sigma_m)
        if not all(map(math.isfinite, numbers)) or not min(position_sigma_m, heading_sigma_rad) > 0.0:
            return
        new = _Located(now_s, pose, position_sigma_m, min(heading_sigma_rad, math.pi))
        if self._fix is not None and self._jumps(self._fix, new):
            self._resets += 1
        self._fix, self._new = new, True

    def _jumps(self, old: _Located, new: _Located) -> bool:
        passed_s = new.at_s - old.at_s
        gone_m = math.hypot(new.pose.x_m - old.pose.x_m, new.pose.y_m - old.pose.y_m)
        sigma_m = max(old.position_sigma_m, new.position_sigma_m)
        sigma_rad = max(old.heading_sigma_rad, new.heading_sigma_rad)
        turned = abs(wrap(new.pose.heading_rad - old.pose.heading_rad)) if sigma_rad <= UNSEEN_RAD else 0.0
        return (
            gone_m > 2.0 * self._limits.speed_m_s * passed_s + JUMP_SIGMAS * sigma_m + JUMP_M
            or turned > 2.0 * self._limits.turn_rad_s * passed_s + JUMP_SIGMAS * sigma_rad + JUMP_RAD
        )

    def receive(self, body: p.Body) -> None:
        """Take a message of the vehicle."""
        if isinstance(body, p.Origin):
            self._origin = body

    def tick(self, now_s: float, heading_rad: float | None) -> list[bytes]:
        """Return the frames that are due; `heading_rad` is the vehicle's own estimate, if it has sent one."""
        return self._see_to_origin(now_s) + self._odometry(now_s, heading_rad)

    def next_due_s(self, now_s: float) -> float:
        """Return when a fix has to go out."""
        if self._fix is None or now_s - self._fix.at_s > STALE_S:
            return math.inf
        return self._sent_s + (SHORTEST_S if self._new else REPEAT_S)

    def _see_to_origin(self, now_s: float) -> list[bytes]:
        """Ask for the origin; set it if there is none. The vehicle confirms it by sending it."""
        if self._origin is not None or now_s < self._origin_due_s:
            return []
        self._origin_due_s = now_s + ORIGIN_S
        frames = [self._encoder.request_message(p.MESSAGE_ORIGIN)]
        if self._wanted is not None and self._asked:
            frames.insert(0, self._encoder.set_origin(self._wanted))
        self._asked = True
        return frames

    def _odometry(self, now_s: float, own_rad: float | None) -> list[bytes]:
        fix = self._fix
        if fix is None or now_s < self.next_due_s(now_s):
            return []
        heading = fix.pose.heading_rad if fix.heading_sigma_rad <= UNSEEN_RAD else own_rad
        if heading is None:
            return []
        age_s, self._sent_s, self._new = now_s - fix.at_s, now_s, False
        sigma_m = fix.position_sigma_m + self._limits.speed_m_s * age_s  # it may have driven on since
        sigma_rad = fix.heading_sigma_rad + self._limits.turn_rad_s * age_s
        pose = fix.pose
        frame = p.Fix(int(fix.at_s * 1e6), pose.x_m, pose.y_m, heading, sigma_m**2, sigma_rad**2, self._resets)
        return [self._encoder.odometry(frame, velocity=self._velocity)]

    def problem(self, now_s: float) -> str:
        """Return why the vehicle cannot know its position; empty when that is not for want of us."""
        if self._fix is None:
            return "no pose fix has come in yet (pose=external)"
        if now_s - self._fix.at_s > STALE_S:
            return f"no pose fix has come in for {now_s - self._fix.at_s:.0f} s (pose=external)"
        if self._origin is None:
            hint = "" if self._wanted else ": give ?origin=lat,lon,alt"
            return f"the vehicle has no origin yet{hint}"
        return ""

    @property
    def warnings(self) -> list[str]:
        """What is odd but does not keep it from driving."""
        actual, wanted = self._origin, self._wanted
        if actual is None or wanted is None:
            return []
        apart = max(abs(actual.latitude_deg - wanted.latitude_deg), abs(actual.longitude_deg - wanted.longitude_deg))
        where = f"{actual.latitude_deg:.7f},{actual.longitude_deg:.7f}"
        return [f"its origin was set to {where} before; it stays until a reboot"] if apart > FAR_DEG else []


def parse_origin(text: str, url: str, *, altitude: bool = True) -> p.Origin:
    """Return the origin that an URL's ``origin=lat,lon,alt`` names (degrees, degrees, metres).

    Without `altitude` two numbers will do: a vehicle that knows its own position knows its height.

    Raises
    ------
    ConfigError
        Not three numbers, or not a place on earth.
    """
    try:
        numbers = [*map(float, text.split(","))]
        latitude, longitude, height = numbers if altitude or len(numbers) != 2 else (*numbers, 0.0)
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and abs(height) < 1e4):
            raise ValueError("not a place on earth")
    except ValueError as error:
        hint = "latitude, longitude, altitude: origin=52.5163,13.3777,34" if altitude else "origin=52.5163,13.3777"
        raise ConfigError(f"origin is '{text}': {error}", where=url, hint=hint) from error
    return p.Origin(latitude, longitude, height)
