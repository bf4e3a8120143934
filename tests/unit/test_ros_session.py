"""A ROS base's session on a simulated clock: silence, stale and late odometry, restarts, e-stop, stamps of commands."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Pose, Twist
from fullswarm.drivers.ros.protocol import Battery, EStop, Hazards, LaserScan, Odometry, Report
from fullswarm.drivers.ros.session import LATE_S, SILENCE_S, Session
from fullswarm.drivers.ros.settings import SCAN_SILENCE_S, parse_url
from fullswarm.errors import LinkLost, MessageError

URL = "ros://tcp/127.0.0.1:7447?model=turtlebot3&watchdog=0.5"
ROBOT_CLOCK_S = 1000.0  # ahead of ours


class ListWire:
    """Hands over reports by number, and keeps commands."""

    trouble = ""
    streams = False

    def __init__(self) -> None:
        self.reports: list[Sequence[Report]] = []
        self.commands: list[tuple[Twist, float | None]] = []

    def linked(self) -> None:
        return

    def received(self, chunk: bytes) -> Sequence[Report]:
        if chunk == b"bad":
            raise MessageError("a test's noise")
        return self.reports[chunk[0]]

    def outgoing(self) -> Sequence[bytes]:
        return ()

    def drive(self, twist: Twist, stamp_s: float | None) -> bytes:
        self.commands.append((twist, stamp_s))
        return b"c"

    def farewell(self) -> Sequence[bytes]:
        return ()


class Bench:
    """A session, its wire, and time."""

    def __init__(self, *, stamped: bool = False, estop: bool = False, streams: bool = False) -> None:
        self.wire = ListWire()
        self.wire.streams = streams
        self.session = Session(parse_url(URL).description, self.wire, stamped=stamped, estop=estop)
        self.now_s, self.x_m = 50.0, 0.0
        self.session.linked(self.now_s)

    def state(self) -> Lifecycle:
        return self.session.state

    def take(self, *reports: Report) -> None:
        self.wire.reports = [reports]
        self.session.received(b"\0", self.now_s)

    def odometry(self, x_m: float | None = None, *, late_s: float = 0.0, stamp_s: float | None = None) -> None:
        self.x_m = self.x_m if x_m is None else x_m
        stamp_s = self.now_s + ROBOT_CLOCK_S - late_s if stamp_s is None else stamp_s
        self.take(Odometry(stamp_s, Pose(self.x_m, 0.0, 0.0), STAND))

    def run(self, duration_s: float, *, silent: bool = False, late_s: float = 0.0) -> None:
        for _ in range(round(duration_s / 0.02)):
            self.now_s += 0.02
            if not silent:
                self.odometry(late_s=late_s)
            self.session.tick(self.now_s)

    def active(self) -> None:
        self.run(0.1)
        self.session.activate(self.now_s)
        assert self.state() is Lifecycle.ACTIVE


def test_it_is_ready_with_the_first_odometry_and_sends_zero_then_nothing() -> None:
    bench = Bench()
    bench.session.tick(bench.now_s)
    assert bench.state() is Lifecycle.OPEN
    bench.run(1.0)
    assert bench.state() is Lifecycle.READY
    assert {twist for twist, _ in bench.wire.commands} == {STAND}
    bench.wire.commands.clear()
    bench.run(1.0)
    assert bench.wire.commands == []  # another program may drive it


def test_a_base_whose_odometry_falls_silent_is_lost_in_time_and_gets_zero_until_it_is_back() -> None:
    bench = Bench()
    bench.active()
    bench.session.command(Twist(0.1, 0.0), bench.now_s)
    bench.run(0.2)
    assert bench.wire.commands[-1][0] == Twist(0.1, 0.0)
    bench.run(SILENCE_S - 0.05, silent=True)
    assert bench.state() is Lifecycle.ACTIVE
    bench.run(0.1, silent=True)
    assert bench.state() is Lifecycle.FAULT
    assert "no new odometry" in bench.session.fault
    bench.wire.commands.clear()
    bench.run(2.0, silent=True)
    assert len(bench.wire.commands) >= 9
    assert {twist for twist, _ in bench.wire.commands} == {STAND}
    bench.run(0.1)
    assert bench.state() is Lifecycle.READY


def test_odometry_that_is_repeated_with_its_old_stamp_counts_as_silence() -> None:
    bench = Bench()
    bench.active()
    stamp_s = bench.now_s + ROBOT_CLOCK_S
    for _ in range(40):
        bench.now_s += 0.02
        bench.odometry(stamp_s=stamp_s)
        bench.session.tick(bench.now_s)
    assert bench.state() is Lifecycle.FAULT


def test_odometry_that_arrives_ever_later_is_not_believed() -> None:
    bench = Bench()
    bench.active()
    late_s = 0.0
    while late_s < LATE_S - 0.02:  # a queue in the network grows: stamps go on, but slower than time
        bench.run(0.02, late_s=late_s)
        late_s += 0.01
    assert bench.state() is Lifecycle.ACTIVE
    for _ in range(40):
        bench.run(0.02, late_s=late_s)
        late_s += 0.01
    assert bench.state() is Lifecycle.FAULT
    assert "late" in bench.session.fault
    bench.run(0.5)
    assert bench.state() is Lifecycle.READY


def test_odometry_without_stamps_is_taken_as_it_arrives() -> None:
    bench = Bench()
    for _ in range(20):
        bench.now_s += 0.02
        bench.odometry(stamp_s=0.0)
        bench.session.tick(bench.now_s)
    assert bench.state() is Lifecycle.READY


@pytest.mark.parametrize("how", ["jump", "zero", "clock set back"])
def test_odometry_that_begins_anew_moves_nothing_and_is_counted(how: str) -> None:
    bench = Bench()
    bench.odometry(3.0)
    bench.run(0.1)
    assert bench.session.reading is not None
    before = bench.session.reading.odometry
    bench.now_s += 0.02
    if how == "jump":
        bench.odometry(3.2)
    elif how == "zero":
        bench.odometry(0.0)
    else:
        bench.odometry(3.0, stamp_s=5.0)
    assert bench.session.reading.odometry == before
    assert bench.session.reading.odometry_breaks == 1
    bench.now_s += 0.02
    bench.odometry(bench.x_m + 0.004, stamp_s=5.1 if how == "clock set back" else None)
    assert bench.session.reading.odometry.x_m == pytest.approx(before.x_m + 0.004)
    assert bench.session.reading.odometry_breaks == 1


def test_a_restart_during_a_silence_is_noticed_although_the_jump_is_small() -> None:
    bench = Bench()
    bench.odometry(0.2)
    bench.run(0.1)
    bench.run(3.0, silent=True)
    bench.now_s += 0.02
    bench.odometry(0.0)
    assert bench.session.reading is not None
    assert bench.session.reading.odometry_breaks == 1
    assert bench.session.reading.odometry.x_m == pytest.approx(0.0)


def test_an_engaged_estop_is_a_fault_and_an_unknown_one_keeps_it_from_ready() -> None:
    bench = Bench(estop=True)
    bench.run(1.0)
    assert bench.state() is Lifecycle.OPEN
    assert "emergency stop" in bench.session.trouble(bench.now_s).text
    bench.take(EStop(engaged=False))
    bench.run(0.1)
    bench.session.activate(bench.now_s)
    assert bench.state() is Lifecycle.ACTIVE
    bench.take(EStop(engaged=True))
    assert bench.state() is Lifecycle.FAULT
    bench.run(1.0)
    assert bench.state() is Lifecycle.FAULT
    reading = bench.session.read()
    assert reading is not None
    assert Hazard.ESTOP_BUTTON in reading.hazards
    bench.take(EStop(engaged=False))
    bench.run(0.1)
    assert bench.state() is Lifecycle.READY


def test_a_short_bump_is_in_the_next_reading_and_charge_and_hazards_in_all() -> None:
    bench = Bench()
    bench.take(Battery(0.05), Hazards(Hazard.BUMP))
    bench.take(Hazards(Hazard.NONE))
    bench.odometry()
    first, second = bench.session.read(), bench.session.read()
    assert first is not None
    assert second is not None
    assert (first.hazards, second.hazards) == (Hazard.BUMP | Hazard.BATTERY_LOW, Hazard.BATTERY_LOW)
    assert second.battery == 0.05


def test_stamps_of_commands_are_times_of_the_robots_clock() -> None:
    bench = Bench(stamped=True)
    bench.active()
    bench.session.command(Twist(0.1, 0.0), bench.now_s)
    bench.run(1.0)
    twist, stamp_s = bench.wire.commands[-1]
    assert twist == Twist(0.1, 0.0)
    assert stamp_s == pytest.approx(bench.now_s + ROBOT_CLOCK_S, abs=0.1)


def test_a_pause_of_this_process_ends_the_motion() -> None:
    bench = Bench()
    bench.active()
    bench.session.command(Twist(0.1, 0.0), bench.now_s)
    bench.now_s += 0.6
    bench.odometry()
    assert bench.state() is not Lifecycle.ACTIVE
    bench.wire.commands.clear()
    bench.session.tick(bench.now_s)
    assert bench.wire.commands[0][0] == STAND


def test_a_stream_without_sense_is_begun_anew_less_and_less_often() -> None:
    bench = Bench(streams=True)
    waits = []
    for _ in range(5):
        began_s = bench.now_s
        with pytest.raises(LinkLost):
            bench.run(20.0, silent=True)
        waits.append(bench.now_s - began_s)
        bench.session.lost("gone", bench.now_s)
        bench.session.linked(bench.now_s)
    assert waits == pytest.approx([0.6, 1.2, 2.4, 4.8, 8.0], abs=0.05)


def test_noise_is_named_when_nothing_better_comes() -> None:
    bench = Bench()
    bench.session.received(b"bad", bench.now_s)
    bench.run(2.5, silent=True)
    assert bench.state() is Lifecycle.FAULT
    assert "a test's noise" in bench.session.fault
    assert math.isfinite(bench.session.next_due_s(bench.now_s))


def test_a_scan_is_in_the_next_reading_with_a_stamp_of_this_clock_and_a_late_one_is_not() -> None:
    bench = Bench()
    bench.session = Session(
        parse_url(f"{URL}&scan=scan&scan_at=0.1,0,1.5&scan_max=3").description, bench.wire, stamped=False, estop=False,
        scan_at=Pose(0.1, 0.0, 1.5),
    )  # fmt: skip
    bench.session.linked(bench.now_s)
    bench.run(0.2)
    angles, distances = np.array([0.0, 1.0, 2.0]), np.array([1.0, 3.2, math.nan])
    ended_s = bench.now_s - 0.05
    bench.take(LaserScan(ended_s - 0.1 + ROBOT_CLOCK_S, 0.1, angles, distances, 3.5))
    bench.run(0.02)
    reading = bench.session.read()
    assert reading is not None
    (scan,) = reading.ranges
    assert scan.stamp_s == pytest.approx(ended_s, abs=1e-6)
    assert (scan.max_m, scan.mount, scan.duration_s) == (3.0, Pose(0.1, 0.0, 1.5), 0.1)
    assert scan.distances_m[:2].tolist() == [1.0, math.inf], "beyond what it is said to see there is nothing"
    assert math.isnan(scan.distances_m[2])
    bench.run(0.2)
    bench.take(LaserScan(bench.now_s + ROBOT_CLOCK_S - 1.5, 0.1, angles, distances, 3.5))
    bench.run(0.02)
    reading = bench.session.read()
    assert reading is not None
    assert reading.ranges == (scan,)


def test_a_silent_lidar_is_a_fault_until_it_scans_again() -> None:
    bench = Bench()
    bench.session = Session(
        parse_url(f"{URL}&scan=scan").description, bench.wire, stamped=False, estop=False, scan_at=Pose(0.0, 0.0, 0.0)
    )

    def scan() -> None:
        bench.take(LaserScan(0.0, 0.1, np.zeros(2), np.ones(2), 3.5))

    bench.session.linked(bench.now_s)
    bench.run(3.0)
    assert bench.state() is Lifecycle.FAULT, "it may not drive before its lidar is there"
    assert "no scan for 1 s" in bench.session.fault
    scan()
    bench.active()
    bench.session.command(Twist(0.1, 0.0), bench.now_s)
    bench.run(SCAN_SILENCE_S - 0.2)
    assert bench.state() is Lifecycle.ACTIVE
    bench.run(0.3)
    assert bench.state() is Lifecycle.FAULT
    assert bench.wire.commands[-1][0] == STAND
    scan()
    bench.run(0.1)
    assert bench.state() is Lifecycle.READY
