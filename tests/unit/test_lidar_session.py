"""The conversations with lidars in simulated time, against the emulated firmware: scans, silence, damage, defects."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import numpy as np
import pytest

from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Lifecycle, RangeScan
from fullswarm.drivers.fleet_file import problems
from fullswarm.drivers.lidar import protocol
from fullswarm.drivers.lidar.session import RplidarSession, session_of
from fullswarm.drivers.lidar.settings import parse_url
from fullswarm.emulators.lidar.firmware import LdFirmware, LidarFirmware, RplidarFirmware
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array
from fullswarm.reasons import Code

SCHEMES = ("ld06", "ld19", "rplidar")
STEP_S = 0.005


def hexagon(angles_rad: Array) -> Array:
    """Distances to the faces of a hexagon, 2 m away, with a door in direction 90°."""
    off = (angles_rad + math.pi / 6.0) % (math.pi / 3.0) - math.pi / 6.0
    distances_m = 2.0 / np.cos(off)
    distances_m[np.abs(np.angle(np.exp(1j * (angles_rad - math.pi / 2.0)))) < 0.2] = math.inf
    return distances_m


class Bench:
    """A session and a firmware, with a wire that `wire` may damage."""

    def __init__(self, url: str) -> None:
        settings = parse_url(url)
        make = RplidarFirmware if settings.scheme == "rplidar" else LdFirmware
        self.firmware: LidarFirmware = make(hexagon, 12.0, 1.0 if settings.upside_down else -1.0)
        self.session = session_of(settings, 0.0)
        self.now_s = 0.0
        self.wire: Callable[[bytes], bytes] = bytes
        self.scans: list[RangeScan] = []
        self.sent: list[tuple[float, bytes]] = []
        self.session.linked(0.0)

    def state(self) -> Lifecycle:
        return self.session.state

    def run(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += STEP_S
            self.firmware.step(self.now_s)
            for chunk in self.firmware.take(0):
                self.session.received(self.wire(chunk), self.now_s)
            for command in self.session.tick(self.now_s):
                self.sent.append((self.now_s, command))
                self.firmware.receive(command, self.now_s, 0)
            reading = self.session.reading
            if reading and (not self.scans or reading.ranges[0] is not self.scans[-1]):
                self.scans.append(reading.ranges[0])


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("options", ["", "?upside_down=1", "?max_m=2.1&heading_rad=1"])
def test_scans_are_what_was_measured(scheme: str, options: str) -> None:
    bench = Bench(f"{scheme}:///dev/x{options}")
    bench.run(2.0)
    assert 15 <= len(bench.scans) <= 20
    assert bench.state() is Lifecycle.READY
    assert bench.session.health.rate_hz == pytest.approx(10.0, abs=0.7)
    assert bench.session.health.damaged == 0
    scan = bench.scans[-1]
    assert scan.duration_s == pytest.approx(0.1, abs=0.012)
    true_m = hexagon(scan.angles_rad)
    true_m[true_m > 12.0] = math.nan
    true_m[true_m > scan.max_m] = math.inf
    clear = np.abs(np.angle(np.exp(1j * (scan.angles_rad - math.pi / 2.0)))) - 0.2  # from the edges of the door
    inner = np.abs(clear) > 0.02
    inner &= np.abs(true_m - scan.max_m) > 0.01 if math.isfinite(scan.max_m) else True
    assert scan.distances_m[inner].tolist() == pytest.approx(true_m[inner].tolist(), abs=0.005, nan_ok=True)
    assert scan.mount.heading_rad == (1.0 if "heading" in options else 0.0)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_silent_lidar_is_a_fault_after_half_a_second_until_the_next_scan(scheme: str) -> None:
    bench = Bench(f"{scheme}:///dev/x")
    bench.run(2.0)
    last_s = bench.scans[-1].stamp_s
    bench.wire = lambda _: b""
    bench.run(last_s + 0.49 - bench.now_s)
    assert bench.state() is Lifecycle.READY
    bench.run(0.02)
    assert bench.state() is Lifecycle.FAULT
    assert "no complete scan for 0.5 s" in bench.session.fault
    assert bench.session.trouble(bench.now_s).code == Code.RANGES
    bench.wire = bytes
    bench.run(0.3)
    assert bench.state() is Lifecycle.READY


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_covered_lidar_is_a_fault_unless_the_url_allows_it(scheme: str) -> None:
    for options, state in (("", Lifecycle.FAULT), ("?valid=0", Lifecycle.READY)):
        bench = Bench(f"{scheme}:///dev/x{options}")
        bench.run(2.0)
        bench.firmware.covered = True
        bench.run(1.0)
        assert bench.state() is state
        assert ("is it covered?" in bench.session.fault) == (state is Lifecycle.FAULT)
        assert bench.session.health.invalid == 1.0


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("seed", range(4))
def test_lost_and_inserted_bytes_are_counted_and_make_no_wrong_point(scheme: str, seed: int) -> None:
    rng = random.Random(seed)

    def damage(chunk: bytes) -> bytes:
        if rng.random() > 0.02:
            return chunk
        place = rng.randrange(len(chunk))
        noise = rng.randbytes(rng.randrange(12))
        return chunk[:place] + noise + chunk[place + rng.randrange(12) :]

    bench = Bench(f"{scheme}:///dev/x")
    bench.run(1.0)
    bench.wire = damage
    bench.run(8.0)
    assert bench.session.health.damaged > 0
    assert len(bench.scans) > 8
    for scan in bench.scans:
        ends = np.column_stack([np.cos(scan.angles_rad), np.sin(scan.angles_rad)]) * scan.distances_m[:, None]
        here = ends[~np.isnan(scan.distances_m)]
        normals = np.array([[math.cos(k * math.pi / 3.0), math.sin(k * math.pi / 3.0)] for k in range(6)])
        assert (here @ normals.T).max(axis=1) == pytest.approx(2.0, abs=0.01)


def test_a_lidar_that_has_waited_in_a_buffer_gives_no_scan() -> None:
    bench = Bench("ld19:///dev/x")
    bench.run(1.0)
    count, waiting = len(bench.scans), b""
    for _ in range(60):
        bench.now_s += STEP_S
        bench.firmware.step(bench.now_s)
        waiting += b"".join(bench.firmware.take(0))
    bench.session.received(waiting, bench.now_s)
    bench.run(0.01)
    assert len(bench.scans) <= count + 1  # the turn that was under way; how long it took shows that it waited


def test_an_rplidar_is_asked_again_ever_later_and_stopped_at_the_end() -> None:
    bench = Bench("rplidar:///dev/x")
    bench.wire = lambda _: b""
    bench.run(40.0)
    asked_s = [at_s for at_s, command in bench.sent if command == protocol.GET_INFO]
    pauses_s = np.diff(asked_s)
    assert pauses_s[0] == pytest.approx(1.1, abs=0.05)
    assert (np.diff(pauses_s) >= -4.0 * STEP_S).all()
    assert pauses_s[-1] == pytest.approx(8.1, abs=0.05)
    bench.wire = bytes
    bench.run(10.0)
    assert bench.state() is Lifecycle.READY
    assert bench.session.firmware == "model 0x28, firmware 1.29, hardware 7"
    assert bench.firmware.turning
    for command in bench.session.final_stop():
        bench.firmware.receive(command, bench.now_s, 0)
    assert not bench.firmware.turning


def test_an_rplidar_with_a_defect_is_reset_and_says_so() -> None:
    bench = Bench("rplidar:///dev/x")
    firmware = bench.firmware
    assert isinstance(firmware, RplidarFirmware)
    assert isinstance(bench.session, RplidarSession)
    firmware.health = protocol.HEALTH_ERROR
    bench.run(1.0)
    assert "error 32769: it is reset" in bench.session.fault
    firmware.health = 0
    bench.run(4.0)
    assert firmware.resets > 0
    assert (bench.state(), bench.session.fault) == (Lifecycle.READY, "")


def test_an_rplidar_that_scans_already_is_stopped_first() -> None:
    bench = Bench("rplidar:///dev/x")
    bench.run(1.0)
    bench.session.linked(bench.now_s)  # another process has used it, and was killed
    count = len(bench.scans)
    bench.run(1.0)
    assert len(bench.scans) > count + 3


# ---------------------------------------------------------------- URLs and fleet files
@pytest.mark.parametrize(
    ("url", "what"),
    [
        ("ld20:///dev/x", "no lidar 'ld20'"), ("ld19:///", "no serial port"), ("ld19://dev/x", "no serial port"),
        ("ld19:///dev/x?max=3", "unknown option 'max'"), ("ld19:///dev/x?max_m=0", "will not do"),
        ("ld19:///dev/x?x_m=nan", "will not do"), ("ld19+udp://h:1", "no lidar"), ("ld19+tcp://h", "not an address"),
    ],
)  # fmt: skip
def test_a_wrong_url_is_refused(url: str, what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        parse_url(url)


def test_a_url_of_a_serial_server() -> None:
    assert parse_url("rplidar+tcp://10.0.0.7:4000").address == ("10.0.0.7", 4000)


def test_a_fleet_file_with_wrong_sensors_is_refused() -> None:
    def wrong(*robots: dict[str, str]) -> list[str]:
        named = [{"id": f"r{place}", **each} for place, each in enumerate(robots, 1)]
        return [f"{key}: {what}" for _, key, what in problems(SwarmConfig.model_validate({"robot": named}), here=True)]

    create = "create:///dev/ttyUSB0"
    assert wrong({"driver": create, "ranges": "ld19:///dev/ttyUSB1"}) == []
    assert (
        "ranges: the port /dev/ttyUSB0 is taken by r1" in wrong({"driver": create, "ranges": "ld19:///dev/ttyUSB0"})[0]
    )
    assert "ld19" in wrong({"driver": create, "ranges": "ld91:///dev/ttyUSB1"})[0]
    assert "unknown option" in wrong({"driver": create, "ranges": "ld19:///dev/ttyUSB1?speed=3"})[0]
    assert "measures no ranges" in wrong({"driver": create, "ranges": "null://r1"})[0]
    assert "simulated" in wrong({"driver": "sim://r1", "ranges": "ld19:///dev/ttyUSB1"})[0]
    assert "driver: this is a range sensor" in wrong({"driver": "ld19:///dev/ttyUSB1"})[0]
