"""The plane that touches the earth at a swarm's origin, against published values and formulas of its own."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.drivers.mavlink.maps import FlatMap, Map, SphereMap
from fullswarm.earth import FLATTENING, SEMI_MAJOR_M, TangentPlane, ecef, geodetic

LATITUDES = st.floats(-85.0, 85.0)
LONGITUDES = st.floats(-180.0, 180.0)
NEAR_M = st.floats(-2000.0, 2000.0)


def vincenty_m(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Return a geodesic's length on WGS84 by Vincenty's inverse formula: it knows nothing of earth-centred axes."""
    minor_m = SEMI_MAJOR_M * (1.0 - FLATTENING)
    u1, u2 = (math.atan((1.0 - FLATTENING) * math.tan(math.radians(each[0]))) for each in (one, other))
    east = turned = math.radians(other[1] - one[1])
    for _ in range(50):
        sin_s = math.hypot(
            math.cos(u2) * math.sin(turned),
            math.cos(u1) * math.sin(u2) - math.sin(u1) * math.cos(u2) * math.cos(turned),
        )
        if sin_s == 0.0:
            return 0.0
        cos_s = math.sin(u1) * math.sin(u2) + math.cos(u1) * math.cos(u2) * math.cos(turned)
        sigma = math.atan2(sin_s, cos_s)
        sin_a = math.cos(u1) * math.cos(u2) * math.sin(turned) / sin_s
        cos2_a = 1.0 - sin_a**2
        middle = cos_s - 2.0 * math.sin(u1) * math.sin(u2) / cos2_a if cos2_a else 0.0
        c = FLATTENING / 16.0 * cos2_a * (4.0 + FLATTENING * (4.0 - 3.0 * cos2_a))
        turned = east + (1.0 - c) * FLATTENING * sin_a * (
            sigma + c * sin_s * (middle + c * cos_s * (2.0 * middle**2 - 1.0))
        )
    u = cos2_a * (SEMI_MAJOR_M**2 - minor_m**2) / minor_m**2
    a = 1.0 + u / 16384.0 * (4096.0 + u * (-768.0 + u * (320.0 - 175.0 * u)))
    b = u / 1024.0 * (256.0 + u * (-128.0 + u * (74.0 - 47.0 * u)))
    inner = cos_s * (2.0 * middle**2 - 1.0) - b / 6.0 * middle * (4.0 * sin_s**2 - 3.0) * (4.0 * middle**2 - 3.0)
    return minor_m * a * (sigma - b * sin_s * (middle + b / 4.0 * inner))


@pytest.mark.parametrize(
    ("place", "centred"),
    [
        ((0.0, 0.0, 0.0), (6_378_137.0, 0.0, 0.0)),
        ((0.0, 90.0, 100.0), (0.0, 6_378_237.0, 0.0)),
        ((90.0, 0.0, 0.0), (0.0, 0.0, 6_356_752.314245)),  # WGS84's semi-minor axis
    ],
)
def test_the_axes_of_wgs84(place: tuple[float, float, float], centred: tuple[float, float, float]) -> None:
    assert ecef(*place) == pytest.approx(centred, abs=1e-6)
    assert geodetic(*centred)[::2] == pytest.approx(place[::2], abs=1e-6)


@given(LATITUDES, LONGITUDES, NEAR_M, NEAR_M)
@settings(deadline=None, max_examples=200)
def test_the_plane_and_back(latitude: float, longitude: float, east: float, north: float) -> None:
    plane = TangentPlane(latitude, longitude, 584.0)
    assert plane.enu(*plane.geodetic(east, north, 3.0)) == pytest.approx((east, north, 3.0), abs=1e-6)


@given(LATITUDES, LONGITUDES, st.floats(-300.0, 300.0), st.floats(-300.0, 300.0))
@settings(deadline=None, max_examples=200)
def test_distances_in_the_plane_are_those_on_the_ground(
    latitude: float, longitude: float, east: float, north: float
) -> None:
    there = TangentPlane(latitude, longitude).geodetic(east, north)
    # The chord falls short of the arc by d³ / 24 R²: 0.03 µm at 400 m; the height of the plane adds a little.
    assert vincenty_m((latitude, longitude), there[:2]) == pytest.approx(math.hypot(east, north), abs=1e-3)


def test_east_is_east_and_north_is_north() -> None:
    plane = TangentPlane(52.5, 13.4)
    assert plane.enu(52.5, 13.401)[0] == pytest.approx(vincenty_m((52.5, 13.4), (52.5, 13.401)), abs=1e-3)
    assert plane.enu(52.501, 13.4)[1] == pytest.approx(vincenty_m((52.5, 13.4), (52.501, 13.4)), abs=1e-3)


@pytest.mark.parametrize("chart", [FlatMap(), SphereMap()])
@given(latitude=st.floats(-80.0, 80.0), longitude=LONGITUDES, north=NEAR_M, east=NEAR_M)
@settings(deadline=None, max_examples=100)
def test_an_autopilots_map_and_back(chart: Map, latitude: float, longitude: float, north: float, east: float) -> None:
    place = chart.degrees((latitude, longitude), north, east)
    assert chart.metres((latitude, longitude), place) == pytest.approx((north, east), abs=1e-4)


def test_an_autopilots_metres_are_not_the_grounds() -> None:
    """At 35 degrees ArduPilot calls 100 m to the north 100.34 m, and PX4 100.24 m: too much to be left as it is."""
    origin = (-35.3632621, 149.1652374)
    there = TangentPlane(*origin).geodetic(0.0, 100.0)[:2]
    assert FlatMap().metres(origin, there)[0] == pytest.approx(100.34, abs=0.01)
    assert SphereMap().metres(origin, there)[0] == pytest.approx(100.23, abs=0.02)
