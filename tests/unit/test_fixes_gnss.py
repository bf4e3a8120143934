"""GNSS receivers: what they say is a place in the swarm's frame, with its error, or nothing."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.clock import MonotonicClock
from fullswarm.earth import TangentPlane
from fullswarm.errors import ConfigError
from fullswarm.localization.gnss import Decoder, GnssSource, Mount, Splitter, mount_of
from fullswarm.localization.sighting import UNSEEN_RAD, Ranging, Refused, Sighting
from fullswarm.localization.source import Seen, Settings, Trouble

ORIGIN = (48.0, 11.0)
NORTH_M_PER_DEG = 111_194.0  # near 48 degrees north on WGS84: 111.19 km; here to 0.01 %
EAST_M_PER_DEG = 74_628.0


def decoder(**mount: float) -> Decoder:
    return Decoder("r1", TangentPlane(*ORIGIN), Mount(**mount))


def nmea(text: str) -> bytes:
    checksum = 0
    for byte in text.encode():
        checksum ^= byte
    return f"${text}*{checksum:02X}\r\n".encode()


def gga(
    time: str = "120000.00", north_m: float = 0.0, east_m: float = 0.0, quality: int = 4, hdop: str = "0.8"
) -> bytes:
    latitude, longitude = 60.0 * north_m / NORTH_M_PER_DEG, 60.0 * east_m / EAST_M_PER_DEG
    return nmea(
        f"GNGGA,{time},48{latitude:010.7f},N,011{longitude:010.7f},E,{quality},20,{hdop},500.0,M,47.0,M,1.0,0000"
    )


def ubx(kind: int, payload: bytes) -> bytes:
    body = struct.pack("<BBH", 1, kind, len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes((a, b))


def pvt(
    time_ms: int, latitude_deg: float, longitude_deg: float, accuracy_mm: int, carrier: int = 2, ok: int = 1
) -> bytes:
    """UBX-NAV-PVT after u-blox' interface description, F9 HPG 1.32: 92 bytes."""
    out = struct.pack("<IHBBBBBBIi", time_ms, 2026, 11, 26, 12, 0, 0, 7, 10, 0)
    out += struct.pack("<BBBB", 3 if ok else 0, ok | carrier << 6, 0, 20)
    out += struct.pack("<iiiiII", round(longitude_deg * 1e7), round(latitude_deg * 1e7), 0, 0, accuracy_mm, 20)
    return ubx(0x07, out.ljust(92, b"\0"))


def relposned(time_ms: int, heading_deg: float, accuracy_deg: float, flags: int) -> bytes:
    """UBX-NAV-RELPOSNED version 1, 64 bytes; flags: bit 0 fix, 3 to 4 carrier, 8 heading valid."""
    out = struct.pack("<BBHI", 1, 0, 0, time_ms) + struct.pack("<iiii", 0, 0, 0, 100)
    out += struct.pack("<i4x", round(heading_deg * 1e5)) + struct.pack("<bbbb", 0, 0, 0, 0)
    out += struct.pack("<IIIII4xI", 0, 0, 0, 0, round(accuracy_deg * 1e5), flags)
    return ubx(0x3C, out)


def sightings(found: Iterable[Seen]) -> list[Sighting]:
    every = list(found)
    assert all(isinstance(each, Sighting) for each in every), every
    return [each for each in every if isinstance(each, Sighting)]


def test_a_sentence_is_a_place_in_the_swarms_frame() -> None:
    (seen,) = sightings(decoder().read(gga(north_m=30.0, east_m=-0.0)))
    assert seen.name == "r1"
    assert (seen.x_m, seen.y_m) == pytest.approx((0.0, 30.0), abs=0.01)
    assert seen.position_sigma_m == pytest.approx(0.016)
    assert (seen.heading_sigma_rad, seen.time_s, seen.marker) == (UNSEEN_RAD, 43_200.0, "RTK fixed")
    (seen,) = sightings(decoder().read(gga(east_m=100.0)))
    assert (seen.x_m, seen.y_m) == pytest.approx((100.0, 0.0), abs=0.02)


def test_the_receivers_own_error_estimate_counts() -> None:
    each = decoder()
    errors = nmea("GNGST,120000.00,0.1,0.05,0.02,45.0,0.03,0.06,0.2")  # latitude 0.03, longitude 0.06
    (seen,) = sightings(each.read(errors + gga()))
    assert seen.covariance_m2 == pytest.approx((0.0036, 0.0, 0.0009))
    (seen,) = sightings(each.read(gga("120010.00")))  # too old
    assert seen.position_sigma_m == pytest.approx(0.016)


@pytest.mark.parametrize(
    ("quality", "why"), [(0, "no position"), (6, "dead reckoning"), (7, "by hand"), (8, "simulated")]
)
def test_a_place_that_is_not_measured_is_none(quality: int, why: str) -> None:
    (seen,) = decoder().read(gga(quality=quality))
    assert isinstance(seen, Trouble)
    assert why in seen.text


def test_a_place_that_is_too_uncertain_is_none() -> None:
    (seen,) = decoder().read(gga(quality=1))
    assert isinstance(seen, Trouble)
    assert "autonomous" in seen.text
    assert sightings(decoder(worst_m=5.0).read(gga(quality=1)))[0].position_sigma_m == pytest.approx(2.0)


def test_a_wrong_origin_is_said() -> None:
    (seen,) = decoder().read(gga(north_m=0.0).replace(b"GNGGA", b"GNGGA"))[:1]
    assert isinstance(seen, Sighting)
    far = Decoder("r1", TangentPlane(-35.0, 149.0), Mount())
    (seen,) = far.read(gga())
    assert isinstance(seen, Trouble)
    assert "is it right?" in seen.text


def test_ubx_is_preferred_to_nmea_of_the_same_receiver() -> None:
    each = decoder()
    (seen,) = sightings(each.read(pvt(1000, 48.0001, 11.0, 14)))
    assert seen.y_m == pytest.approx(11.119, abs=0.01)
    assert (seen.position_sigma_m, seen.marker) == (0.014, "RTK fixed")
    assert each.read(gga()) == []
    (seen,) = sightings(each.read(pvt(1200, 48.0, 11.0, 300, carrier=1)))
    assert (seen.marker, seen.time_s) == ("RTK float", 1.2)
    (trouble,) = each.read(pvt(1400, 48.0, 11.0, 14, ok=0))
    assert isinstance(trouble, Trouble)


def test_the_weeks_end_is_no_jump_back() -> None:
    each = decoder()
    times = [sightings(each.read(pvt(time_ms, 48.0, 11.0, 14)))[0].time_s for time_ms in (604_799_800, 0, 200)]
    assert times == pytest.approx([604_799.8, 604_800.0, 604_800.2])


def test_two_antennas_give_a_heading_and_the_place_of_the_centre() -> None:
    each = decoder(forward_m=0.5, baseline_rad=0.0)
    each.read(relposned(1000, 90.0, 0.4, 1 | 2 << 3 | 1 << 8))  # the robot looks east
    (seen,) = sightings(each.read(pvt(1000, 48.0, 11.0, 14)))
    assert seen.heading_rad == pytest.approx(0.0, abs=1e-9)
    assert seen.heading_sigma_rad == pytest.approx(math.radians(0.4))
    assert (seen.x_m, seen.y_m) == pytest.approx((-0.5, 0.0), abs=1e-6)
    (seen,) = sightings(each.read(pvt(5000, 48.0, 11.0, 14)))  # the heading is too old: where the centre is, is open
    assert seen.heading_sigma_rad == UNSEEN_RAD
    assert seen.position_sigma_m == pytest.approx(0.5, abs=0.001)
    each.read(relposned(5000, 90.0, 0.4, 1 | 1 << 3 | 1 << 8))  # float: ambiguities are not resolved
    assert sightings(each.read(pvt(5000, 48.0, 11.0, 14)))[0].heading_sigma_rad == UNSEEN_RAD
    each = decoder(baseline_rad=math.pi / 2.0)  # the second antenna is on the left
    each.read(relposned(1000, 0.0, 0.4, 1 | 2 << 3 | 1 << 8))  # to the north: so the robot looks east
    assert sightings(each.read(pvt(1000, 48.0, 11.0, 14)))[0].heading_rad == pytest.approx(0.0, abs=1e-9)


def test_a_compass_sentence_is_a_heading() -> None:
    each = decoder()
    each.read(gga("120000.00"))
    each.read(nmea("GNHDT,180.0,T"))
    assert sightings(each.read(gga("120000.20")))[0].heading_rad == pytest.approx(-math.pi / 2.0)


def test_damage_is_refused_and_the_next_message_read() -> None:
    each = decoder()
    damaged = gga().replace(b"48", b"49", 1)
    rtcm = b"\xd3\x00\x13" + bytes(22)
    found = each.read(b"\x00garbage" + damaged + rtcm + pvt(1000, 48.0, 11.0, 14)[:-1] + b"\x00" + gga())
    assert [type(one) for one in found] == [Refused, Refused, Sighting]


@given(st.binary(max_size=300), st.integers(1, 50))
def test_any_bytes_are_read_to_their_end(data: bytes, size: int) -> None:
    each, splitter = decoder(), Splitter()
    for at in range(0, len(data), size):
        for seen in each.read(data[at : at + size]):
            assert isinstance(seen, Sighting | Refused | Trouble | Ranging)
        splitter.feed(data[at : at + size])
    assert len(splitter._buffer) < 9000


@given(st.data())
def test_damaged_messages_are_places_that_are_finite_or_refused(data: st.DataObject) -> None:
    good = pvt(1000, 48.0, 11.0, 14) + gga() + relposned(1000, 10.0, 0.4, 1 | 2 << 3 | 1 << 8)
    damaged = bytearray(good)
    for _ in range(data.draw(st.integers(1, 5))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    for seen in decoder().read(bytes(damaged)):
        if isinstance(seen, Sighting):
            assert math.isfinite(seen.x_m + seen.y_m + seen.heading_rad + seen.position_sigma_m)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (Settings("gnss:///dev/ttyACM0", origin_deg=ORIGIN), "which"),
        (Settings("gnss:///dev/ttyACM0", robot="r1"), "is not stated"),
        (Settings("gnss://ttyACM0", robot="r1", origin_deg=ORIGIN), "no device"),
        (Settings("gnss:///dev/ttyACM0?baud=fast", robot="r1", origin_deg=ORIGIN), "no device"),
        (Settings("gnss:///dev/ttyACM0?forwards=1", robot="r1", origin_deg=ORIGIN), "unknown option 'forwards'"),
        (Settings("gnss:///dev/ttyACM0?forward=far", robot="r1", origin_deg=ORIGIN), "no number"),
        (Settings("gnss+udp://0.0.0.0:0", robot="r1", origin_deg=ORIGIN), "open to the network"),
    ],
)
def test_settings_that_will_not_do(settings: Settings, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        GnssSource(settings, MonotonicClock())


def test_the_mount_of_a_url() -> None:
    assert mount_of({"forward": "0.1", "left": "-0.2", "baseline_deg": "90", "worst_m": "3"}, "") == Mount(
        0.1, -0.2, math.pi / 2.0, 3.0
    )
