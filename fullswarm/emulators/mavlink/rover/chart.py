"""Where an emulated rover stands on earth, and on the map that its autopilot began where it was switched on."""

from __future__ import annotations

from dataclasses import dataclass, field

from fullswarm.drivers.mavlink.maps import Degrees, FlatMap, Map
from fullswarm.earth import SITL_ORIGIN_DEG, TangentPlane

ALTITUDE_M = 584.0


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
        Where its map begins; None: not yet known, or poses from outside say it.
    """

    world: Degrees = SITL_ORIGIN_DEG
    map: Map = field(default_factory=FlatMap)
    origin: Degrees | None = None

    @property
    def _plane(self) -> TangentPlane:
        return TangentPlane(*self.world, ALTITUDE_M)

    def begin(self, x_m: float, y_m: float) -> None:
        """Begin the map at a place of the world, as exactly as it can be told (1e-7 degrees)."""
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
