"""Places on earth in a swarm's own frame: the plane that touches the WGS84 ellipsoid at the swarm's origin.

x points east, y north. Exact: geodetic → earth-centred → turned into the plane, and back. Plain numbers, since a driver
does it twenty times a second and the base install shall stay small.
"""

from __future__ import annotations

import math

SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
_ECC2 = FLATTENING * (2.0 - FLATTENING)
_ROUNDS = 5  # each one of the way back to a latitude gains two digits and more near the ground
SITL_ORIGIN_DEG = (-35.3632621, 149.1652374)
"""Where the simulated world lies by default: where ArduPilot's own simulator starts."""


def ecef(latitude_deg: float, longitude_deg: float, height_m: float = 0.0) -> tuple[float, float, float]:
    """Return the earth-centred, earth-fixed place (m) of a latitude, a longitude and a height above the ellipsoid."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    sin, cos = math.sin(latitude), math.cos(latitude)
    normal_m = SEMI_MAJOR_M / math.sqrt(1.0 - _ECC2 * sin * sin)
    out_m = (normal_m + height_m) * cos
    return out_m * math.cos(longitude), out_m * math.sin(longitude), (normal_m * (1.0 - _ECC2) + height_m) * sin


def geodetic(x_m: float, y_m: float, z_m: float) -> tuple[float, float, float]:
    """Return latitude, longitude (degrees) and height (m) of an earth-centred place near the ground."""
    out_m = math.hypot(x_m, y_m)
    latitude = math.atan2(z_m, out_m * (1.0 - _ECC2))
    for _ in range(_ROUNDS):
        sin = math.sin(latitude)
        latitude = math.atan2(z_m + _ECC2 * SEMI_MAJOR_M / math.sqrt(1.0 - _ECC2 * sin * sin) * sin, out_m)
    sin, cos = math.sin(latitude), math.cos(latitude)
    height_m = out_m * cos + z_m * sin - SEMI_MAJOR_M * math.sqrt(1.0 - _ECC2 * sin * sin)
    return math.degrees(latitude), math.degrees(math.atan2(y_m, x_m)), height_m


class TangentPlane:
    """East, north and up (m) from an origin on earth.

    Parameters
    ----------
    latitude_deg, longitude_deg
        The origin, WGS84.
    height_m
        Height of the plane above the ellipsoid; 100 m change a distance on the ground by 16 parts in a million.
    """

    def __init__(self, latitude_deg: float, longitude_deg: float, height_m: float = 0.0) -> None:
        self.latitude_deg, self.longitude_deg, self.height_m = latitude_deg, longitude_deg, height_m
        self._origin = ecef(latitude_deg, longitude_deg, height_m)
        latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
        sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
        sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
        self._east = (-sin_lon, cos_lon, 0.0)
        self._north = (-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat)
        self._up = (cos_lat * cos_lon, cos_lat * sin_lon, sin_lat)

    def enu(
        self, latitude_deg: float, longitude_deg: float, height_m: float | None = None
    ) -> tuple[float, float, float]:
        """Return east, north and up (m) of a place on earth; without a height it is as high as the plane's origin."""
        place = ecef(latitude_deg, longitude_deg, self.height_m if height_m is None else height_m)
        way = (place[0] - self._origin[0], place[1] - self._origin[1], place[2] - self._origin[2])
        return _dot(self._east, way), _dot(self._north, way), _dot(self._up, way)

    def geodetic(self, east_m: float, north_m: float, up_m: float = 0.0) -> tuple[float, float, float]:
        """Return latitude, longitude (degrees) and height (m) of a place in the plane; the inverse of :meth:`enu`."""
        x_m, y_m, z_m = (
            self._origin[axis] + east_m * self._east[axis] + north_m * self._north[axis] + up_m * self._up[axis]
            for axis in range(3)
        )
        return geodetic(x_m, y_m, z_m)


def _dot(one: tuple[float, float, float], other: tuple[float, float, float]) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
