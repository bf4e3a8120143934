"""From the map of one vehicle, which begins wherever its autopilot set its origin, to the swarm's own frame.

LOCAL_POSITION_NED counts from there and keeps millimetres; the origin itself (GPS_GLOBAL_ORIGIN) is asked for again
and again, because each boot sets another one. Headings: ArduPilot's and PX4's yaw counts from true north once the
declination is applied, which both do by themselves (COMPASS_AUTODEC, MAG_DECL by the world magnetic model). Not
corrected: a declination switched off there, and the convergence of meridians (0.1 mrad per km from the origin).
"""

from __future__ import annotations

import math

from fullswarm.drivers.base import Pose
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import StationEncoder
from fullswarm.drivers.mavlink.maps import Map
from fullswarm.earth import TangentPlane

ASK_S, ASK_AGAIN_S = 0.5, 2.0
LEAP_M = 1.0
"""So far no vehicle drives between two positions: it has a new origin, or has corrected itself."""
PATIENCE_S = 0.5
FAR_M = 50_000.0


class SwarmFrame:
    """Where a vehicle is in the swarm's frame.

    Parameters
    ----------
    chart
        How the vehicle's autopilot makes metres of degrees.
    origin
        The swarm's.
    """

    def __init__(self, encoder: StationEncoder, chart: Map, origin: p.Origin) -> None:
        self._encoder, self._chart, self._swarm = encoder, chart, origin
        self.restart()

    def restart(self) -> None:
        """Believe nothing: another boot has another origin."""
        self._origin: p.Origin | None = None
        self._plane: TangentPlane | None = None
        self._ask_s = -math.inf
        self._lost_s = -math.inf
        self._last: p.LocalPosition | None = None

    def receive(self, body: p.Body) -> None:
        """Take a message of the vehicle."""
        if isinstance(body, p.Origin) and (body.latitude_deg or body.longitude_deg):
            self._origin = body
            # Metres on the ground are those at its height; the plane's own height would shorten them.
            self._plane = TangentPlane(self._swarm.latitude_deg, self._swarm.longitude_deg, body.altitude_m)

    def leaps(self, position: p.LocalPosition, now_s: float) -> bool:
        """Compare with the position before; after a leap the origin is unknown until it is sent anew."""
        last, self._last = self._last, position
        if last is None:
            return False
        passed_s = max(0.0, position.boot_ms - last.boot_ms) / 1000.0
        driven_m = passed_s * max(math.hypot(each.vx_m_s, each.vy_m_s) for each in (last, position))
        if math.hypot(position.x_m - last.x_m, position.y_m - last.y_m) <= LEAP_M + 2.0 * driven_m:
            return False
        if self._origin is not None:
            self._origin, self._lost_s, self._ask_s = None, now_s, -math.inf
        return True

    def pose(self, position: p.LocalPosition, heading_rad: float) -> Pose | None:
        """Return the pose in the swarm's frame; None while the vehicle's origin is not known, or is far away."""
        origin, plane = self._origin, self._plane
        if origin is None or plane is None:
            return None
        place = self._chart.degrees((origin.latitude_deg, origin.longitude_deg), position.y_m, position.x_m)
        x_m, y_m, _ = plane.enu(*place)
        return Pose(x_m, y_m, heading_rad) if math.hypot(x_m, y_m) <= FAR_M else None

    def tick(self, now_s: float) -> list[bytes]:
        """Return the frames that are due: questions for the origin."""
        if now_s < self._ask_s:
            return []
        self._ask_s = now_s + (ASK_S if self._origin is None else ASK_AGAIN_S)
        return [self._encoder.request_message(p.MESSAGE_ORIGIN)]

    def problem(self, now_s: float) -> str:
        """Return why there is no pose in the swarm's frame; empty when there is one."""
        if self._origin is None:
            late = now_s - self._lost_s > PATIENCE_S
            return "the autopilot has not sent its origin yet (GPS_GLOBAL_ORIGIN)" if late else ""
        if self._plane is not None:
            x_m, y_m, _ = self._plane.enu(self._origin.latitude_deg, self._origin.longitude_deg)
            if math.hypot(x_m, y_m) > FAR_M:
                swarm = f"{self._swarm.latitude_deg:g}, {self._swarm.longitude_deg:g}"
                place = f"{self._origin.latitude_deg:.5f}, {self._origin.longitude_deg:.5f}"
                return f"it is at {place}, far from the swarm's origin at {swarm}: correct [world] origin"
        return ""
