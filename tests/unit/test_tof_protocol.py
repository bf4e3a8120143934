"""VL53L1X: URLs, results and frames, and the conversation with emulated sensors in simulated time, without a port."""

from __future__ import annotations

import math
import zlib
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.fleet_file import problems
from fullswarm.drivers.lidar.sensor import LidarSensor
from fullswarm.drivers.ranges import KINDS, sensor_of
from fullswarm.drivers.ranges import parse_url as any_url
from fullswarm.drivers.tof import protocol
from fullswarm.drivers.tof.bus import LONGEST, NoAnswer, next_reply, open_bus
from fullswarm.drivers.tof.protocol import LONG, SHORT, decode
from fullswarm.drivers.tof.sensor import ANEW_S, Beam, TofSensors
from fullswarm.drivers.tof.settings import parse_url
from fullswarm.emulators.tof.emulator import FIVE
from fullswarm.emulators.tof.firmware import I2cBridge, Vl53l1x
from fullswarm.errors import ConfigError, DriverError

BUS = "vl53l1x:///dev/i2c-1"


# ---------------------------------------------------------------- URLs
def test_urls() -> None:
    found = parse_url(f"{BUS}?sensor=0@0.1,-0.05,0.785&sensor=7@0.1,0.05,-0.785&mux=0x72&roi=8&max=1&name=tof")
    assert (found.where, found.mux, found.roi, found.max_m, found.mode) == ("/dev/i2c-1", 0x72, 8, 1.0, SHORT)
    first, second = found.sensors
    assert (first.channel, first.address, first.at.y_m, first.at.heading_rad) == (0, 0x29, -0.05, 0.785)
    assert [found.name_of(each) for each in (first, second)] == ["tof/0", "tof/7"]
    assert math.degrees(found.cone_rad) == pytest.approx(20.0)
    found = parse_url("vl53l1x://10.0.0.5:7531?sensor=0x30@0.1,0,0&sensor=3@0,0.1,1.571&mode=long")
    assert (found.where, found.max_m, found.mode) == ("tcp 10.0.0.5:7531", 4.0, LONG)
    assert [(each.channel, each.address, each.key) for each in found.sensors] == [(None, 0x30, "0x30"), (3, 0x29, "3")]
    assert len(parse_url(BUS + FIVE).sensors) == 5


@pytest.mark.parametrize(
    ("url", "what"),
    [
        ("vl53l0x:///dev/i2c-1?sensor=0@0,0,0", "no time-of-flight sensor 'vl53l0x'"),
        ("vl53l1x://?sensor=0@0,0,0", "no bus"),
        ("vl53l1x://host:1/dev/i2c-1?sensor=0@0,0,0", "an address and a device"),
        ("vl53l1x://host?sensor=0@0,0,0", "not an address"),
        (BUS, "names no sensor"),
        (f"{BUS}?sensors=0@0,0,0", "unknown option 'sensors'"),
        (f"{BUS}?sensor=0", "no place on the robot"),
        (f"{BUS}?sensor=0@1,2", "no place on the robot"),
        (f"{BUS}?sensor=0@1,2,nan", "no place on the robot"),
        (f"{BUS}?sensor=@0,0,0", "neither a channel nor an address"),
        (f"{BUS}?sensor=-1@0,0,0", "neither a channel nor an address"),
        (f"{BUS}?sensor=0x78@0,0,0", "neither a channel nor an address"),
        (f"{BUS}?sensor=0@0,0,0&sensor=0@0,0,1", "sensor 0 is there twice"),
        (f"{BUS}?sensor=0x30@0,0,0&sensor=48@0,0,1", "sensor 0x30 is there twice"),
        (f"{BUS}?sensor=0@0,0,0&sensor=0x29@0,0,1", "answers for each channel"),
        (f"{BUS}?sensor=0@0,0,0&sensor=0x70@0,0,1", "the multiplexer and a sensor are at 0x70"),
        (f"{BUS}?sensor=0@0,0,0&mux=0x6f", "mux '0x6f' is not the address"),
        (f"{BUS}?sensor=0@0,0,0&mux=x", "mux 'x' is not the address"),
        (f"{BUS}?sensor=0@0,0,0&mode=medium", "mode 'medium' is none of short, long"),
        (f"{BUS}?sensor=0@0,0,0&roi=5", "roi '5' is none of 16, 8, 4"),
        (f"{BUS}?sensor=0@0,0,0&max=2", "max '2' is not a number from 0.1 to 1.3"),
        (f"{BUS}?sensor=0@0,0,0&max=1&max=2", "'max' is there twice"),
    ],
)
def test_what_is_wrong_with_a_url_is_said(url: str, what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        parse_url(url)


@given(st.text(max_size=40), st.sampled_from(["", "sensor=", "sensor=0@", "mux=", "sensor=0@0,0,0&max="]))
@settings(max_examples=200, deadline=None)
def test_any_text_in_a_url_is_read_or_refused(text: str, before: str) -> None:
    try:
        found = parse_url(f"{BUS}?{before}{text}")
    except ConfigError:
        return
    assert found.sensors


def test_all_range_sensors_are_found_by_their_scheme() -> None:
    assert set(KINDS) == {"ld06", "ld19", "rplidar", "vl53l1x"}
    assert isinstance(sensor_of(BUS + FIVE), TofSensors)
    assert isinstance(sensor_of("ld19:///dev/ttyUSB0"), LidarSensor)
    assert sensor_of(BUS + FIVE).max_m == 1.3
    with pytest.raises(ConfigError, match="no range sensor 'ld20'"):
        any_url("ld20:///dev/x")


def test_a_fleet_file_with_them_is_checked() -> None:
    def said(*ranges: str, **agent: bool) -> list[str]:
        robots = [
            {"id": f"r{row}", "driver": f"null://r{row}", "ranges": each, "host": "127.0.0.1"}
            for row, each in enumerate(ranges)
        ]
        config = SwarmConfig.model_validate({"robot": robots, "agent": agent})
        return [what for _, key, what in problems(config, here=True) if key == "ranges"]

    assert said(BUS + FIVE) == []
    assert said(BUS) == ["this names no sensor; write vl53l1x:///dev/i2c-1?sensor=0@0.1,0,0"]
    assert said(BUS + FIVE, BUS + FIVE) == ["/dev/i2c-1 is taken by r0: each robot needs its own range sensor"]
    assert "agent.locate_on_map needs a lidar" in said(BUS + FIVE, locate_on_map=True)[0]


# ---------------------------------------------------------------- results
def block(state: int, mm: int, number: int = 7) -> bytes:
    return bytes([0xE0 | state, 0, number]) + bytes(10) + mm.to_bytes(2, "big")


@pytest.mark.parametrize(
    ("state", "short_m", "long_m"),
    [
        (9, 0.823, 0.823), (8, 0.0, 0.0),  # measured; nearer than the sensor's own offset
        (4, math.inf, math.nan), (5, math.inf, math.nan),  # no target: too weak, or out of the mode's range
        (6, math.nan, math.nan), (7, math.nan, math.nan), (18, math.nan, math.nan), (19, math.nan, math.nan),
        (1, None, None), (2, None, None), (3, None, None), (0, None, None), (31, None, None),  # the sensor has failed
    ],
)  # fmt: skip
def test_results_mean_what_ranges_mean(state: int, short_m: float | None, long_m: float | None) -> None:
    for mode, expected in ((SHORT, short_m), (LONG, long_m)):
        found = decode(block(state, 823), mode, mode.max_m)
        assert found.number == 7
        if expected is None:
            assert found.distance_m is None
        else:
            assert found.distance_m == pytest.approx(expected, nan_ok=True)
    assert decode(block(9, 1201), SHORT, 1.2).distance_m == math.inf


@given(st.binary(min_size=protocol.RESULT_BYTES, max_size=protocol.RESULT_BYTES), st.sampled_from([SHORT, LONG]))
@settings(max_examples=300, deadline=None)
def test_any_bytes_are_a_distance_in_range_or_none(data: bytes, mode: protocol.Mode) -> None:
    found = decode(data, mode, 1.0).distance_m
    assert found is None or math.isnan(found) or found == math.inf or 0.0 <= found <= 1.0


def test_the_configuration_is_of_the_registers_that_it_is_written_to() -> None:
    first, data = protocol.CONFIGURATION
    assert first + len(data) == 0x88
    assert (data[0x46 - first], data[0x30 - first] & 0x10, data[0x7F - first], data[-1]) == (0x20, 0, 199, 0)


# ---------------------------------------------------------------- frames
def reply(number: int, state: int, data: bytes) -> bytes:
    """What the emulated bridge sends."""
    bridge = I2cBridge({}, 0x70)
    bridge._transfer = lambda *_: None if state else data  # type: ignore[method-assign]
    request = b"\xa7I" + bytes([number, 0x29, 0, len(data)])
    bridge.receive(request + zlib.crc32(request).to_bytes(4, "little"), 0.0, 0)
    return b"".join(bridge.take(0))


@given(st.binary(max_size=60), st.integers(0, 255), st.binary(max_size=40), st.booleans())
@settings(max_examples=200, deadline=None)
def test_a_reply_is_found_in_garbage(before: bytes, number: int, data: bytes, refused: bool) -> None:
    received = bytearray(before.replace(b"\xa7", b"\x00"))
    received += reply(number, int(refused), b"" if refused else data)
    assert next_reply(received) == (number, int(refused), b"" if refused else data)
    assert not received


@given(st.lists(st.binary(max_size=400), max_size=20), st.binary(max_size=20))
@settings(max_examples=100, deadline=None)
def test_garbage_raises_nothing_and_fills_no_memory(chunks: list[bytes], data: bytes) -> None:
    received = bytearray()
    for chunk in chunks:
        received += chunk + reply(1, 0, data)[:-1]
        while next_reply(received) is not None:
            continue
        assert len(received) <= LONGEST


@given(st.integers(0, 255), st.binary(min_size=1, max_size=20), st.data())
@settings(max_examples=100, deadline=None)
def test_a_reply_with_a_flipped_bit_is_none(number: int, payload: bytes, data: st.DataObject) -> None:
    received = bytearray(reply(number, 0, payload))
    received[data.draw(st.integers(0, len(received) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    assert next_reply(received) is None


def test_a_bus_that_cannot_be_opened_says_what_to_do(tmp_path: Path) -> None:
    for path, what in (
        (str(tmp_path / "none"), "there is no such bus"), ("/dev/null", "this is no I2C bus"), (str(tmp_path), "bus"),
    ):  # fmt: skip
        with pytest.raises(DriverError, match=what) as caught:
            open_bus(parse_url(f"vl53l1x://{path}{FIVE}"), MonotonicClock())
        assert caught.value.hint


# ---------------------------------------------------------------- the conversation, in simulated time
class Bench:
    """Sensors on an emulated bus, and the driver's end of their conversations."""

    def __init__(self, query: str = "?sensor=2@0,0,0") -> None:
        self.settings = parse_url(BUS + query)
        self.now_s, self.distance_m = 0.0, 0.9
        self.sensors = [Vl53l1x(lambda _: self.distance_m) for _ in self.settings.sensors]
        places = zip(self.settings.sensors, self.sensors, strict=True)
        self.bridge = I2cBridge({each.channel: [sensor] for each, sensor in places}, self.settings.mux)
        self.beams = [Beam(each, self.settings) for each in self.settings.sensors]

    def transfer(self, address: int, data: bytes, count: int = 0) -> bytes:
        found = self.bridge._transfer(address, data, count, self.now_s)
        if found is None:
            raise NoAnswer(6, "no answer")
        return found

    def close(self) -> None:
        raise AssertionError("a beam does not close its bus")

    def run(self, seconds: float, beam: int = 0) -> list[tuple[float, float]]:
        """Return when what was measured."""
        found, end_s = [], self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += 0.005
            self.bridge.step(self.now_s)
            for number, each in enumerate(self.beams):
                if self.now_s >= each.due_s:
                    distance_m = each.step(self, self.now_s)
                    if distance_m is not None and number == beam:
                        found.append((self.now_s, distance_m))
        return found


def far(away_m: float, _ray: float) -> float:
    return away_m


def narrow(at: float, half: float, ray: float) -> float:
    """A post at 0.6 m before a wall at 1.1 m."""
    return 0.6 if abs(ray - at) < half else 1.1


@pytest.mark.parametrize(("query", "hertz"), [("", 19.0), ("&mode=long", 9.8), ("&roi=4", 19.0)])
def test_a_sensor_is_started_and_measures_at_its_rate(query: str, hertz: float) -> None:
    bench = Bench("?sensor=2@0,0,0" + query)
    first, *found = bench.run(3.0)
    assert math.isnan(first[1]), "the first is not checked for wrap around"
    assert found[0][0] < 0.5
    assert {each for _, each in found} == {0.9}
    assert (len(found) - 1) / (found[-1][0] - found[0][0]) == pytest.approx(hertz, rel=0.15)


@pytest.mark.parametrize("side", [16, 8, 4])
def test_the_region_of_interest_narrows_the_field_of_view_that_is_stated(side: int) -> None:
    bench = Bench(f"?sensor=2@0,0,0&roi={side}")
    half = 0.5 * bench.settings.cone_rad
    for angle, expected in ((0.98 * half, 0.6), (1.02 * half, 1.1)):
        bench.sensors[0].sees = partial(narrow, angle, 0.015 * half)
        assert bench.run(0.5)[-1][1] == expected


def test_each_sensor_is_read_through_its_own_channel_or_address() -> None:
    bench = Bench("?sensor=0@0,0,0&sensor=5@0,0,0&sensor=0x30@0,0,0")
    for number, sensor in enumerate(bench.sensors):
        sensor.sees = partial(far, 0.3 * (number + 1))
    bench.sensors[2].write(bytes([0, 1, 0x30]), 0.0)
    for number in range(3):
        assert bench.run(1.0, number)[-1][1] == pytest.approx(0.3 * (number + 1))


def test_a_sensor_that_lost_its_power_or_sticks_or_fails_is_started_again() -> None:
    bench = Bench()
    sensor = bench.sensors[0]
    assert bench.run(1.0)
    sensor.power(False, bench.now_s)
    assert bench.run(0.5) == []
    assert "does not answer" in bench.beams[0].reason
    sensor.power(True, bench.now_s)
    assert bench.run(1.0)[-1][1] == 0.9
    assert bench.beams[0].reason == ""
    sensor.stuck = True
    bench.run(0.1)
    assert bench.run(2.0 * ANEW_S) == []
    assert "no new measurement" in bench.beams[0].reason
    sensor.stuck, sensor.failed = False, True
    assert bench.run(2.0) == []
    assert "laser or its receivers have failed" in bench.beams[0].reason
    sensor.failed = False
    assert bench.run(2.0)[-1][1] == 0.9


def test_sensors_of_an_agent_that_was_killed_are_started_again() -> None:
    bench = Bench()
    assert bench.run(1.0)
    bench.now_s += 1.0  # it has measured, and nothing has taken that
    bench.bridge.step(bench.now_s)
    bench.beams = [Beam(each, bench.settings) for each in bench.settings.sensors]
    assert bench.run(1.0)[-1][1] == 0.9


def test_another_device_at_its_address_is_not_believed() -> None:
    bench = Bench()
    bench.sensors[0]._put(0x010F, b"\xee\xaa")
    assert bench.run(2.0) == []
    assert bench.beams[0].reason == "its model is eeaa: this is no VL53L1X"
    assert bench.sensors[0]._registers[0x0087] == 0, "and nothing was written to it"
