"""How autopilots make metres of degrees: each has a map of its own, and neither is the ground's exact measure.

ArduPilot takes the earth for a sphere of equatorial radius, which stretches 10 m to the north by 3 cm at 35 degrees
of latitude; PX4 draws an azimuthal equidistant map of a smaller sphere. What a vehicle reports in metres is therefore
turned back into degrees as its own firmware would, and only then laid into the swarm's frame.
"""

from __future__ import annotations

import math
from typing import Final, Protocol

Degrees = tuple[float, float]
"""Latitude and longitude."""

FLAT_M_PER_DEGREE: Final = 111_318.84502145034  # LOCATION_SCALING_FACTOR: a sphere of 6378.1 km
SPHERE_M: Final = 6_371_000.0


class Map(Protocol):
    """An autopilot's map around an origin."""

    def degrees(self, origin: Degrees, north_m: float, east_m: float) -> Degrees:
        """Return latitude and longitude of a place on the map."""
        ...

    def metres(self, origin: Degrees, place: Degrees) -> tuple[float, float]:
        """Return metres north and east of a latitude and longitude; the inverse of :meth:`degrees`."""
        ...


class FlatMap:
    """ArduPilot's: `Location::offset` and `get_distance_NE`, the longitude scaled at the latitude half-way."""

    def degrees(self, origin: Degrees, north_m: float, east_m: float) -> Degrees:
        """Return latitude and longitude of a place on the map."""
        risen = north_m / FLAT_M_PER_DEGREE
        shrink = math.cos(math.radians(origin[0] + risen / 2.0))
        return origin[0] + risen, _wrapped(origin[1] + east_m / FLAT_M_PER_DEGREE / shrink)

    def metres(self, origin: Degrees, place: Degrees) -> tuple[float, float]:
        """Return metres north and east of a latitude and longitude."""
        shrink = math.cos(math.radians((origin[0] + place[0]) / 2.0))
        east_deg = _wrapped(place[1] - origin[1])
        return (place[0] - origin[0]) * FLAT_M_PER_DEGREE, east_deg * FLAT_M_PER_DEGREE * shrink


class SphereMap:
    """PX4's: `MapProjection::reproject` and `project`."""

    def degrees(self, origin: Degrees, north_m: float, east_m: float) -> Degrees:
        """Return latitude and longitude of a place on the map."""
        north, east = north_m / SPHERE_M, east_m / SPHERE_M
        arc = math.hypot(north, east)
        if arc == 0.0:
            return origin
        sin_at, cos_at = math.sin(math.radians(origin[0])), math.cos(math.radians(origin[0]))
        sin, cos = math.sin(arc), math.cos(arc)
        latitude = math.asin(cos * sin_at + north * sin * cos_at / arc)
        around = math.atan2(east * sin, arc * cos_at * cos - north * sin_at * sin)
        return math.degrees(latitude), _wrapped(origin[1] + math.degrees(around))

    def metres(self, origin: Degrees, place: Degrees) -> tuple[float, float]:
        """Return metres north and east of a latitude and longitude."""
        sin_at, cos_at = math.sin(math.radians(origin[0])), math.cos(math.radians(origin[0]))
        sin, cos = math.sin(math.radians(place[0])), math.cos(math.radians(place[0]))
        around = math.radians(place[1] - origin[1])
        north, east = cos_at * sin - sin_at * cos * math.cos(around), cos * math.sin(around)
        reach = math.hypot(north, east)  # the sine of the arc: arccos would lose the millimetres
        stretch = math.asin(min(reach, 1.0)) / reach if reach > 0.0 else 1.0
        return north * stretch * SPHERE_M, east * stretch * SPHERE_M


def _wrapped(longitude_deg: float) -> float:
    return (longitude_deg + 180.0) % 360.0 - 180.0
