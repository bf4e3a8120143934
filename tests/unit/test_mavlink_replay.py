"""A drive of the real firmware, recorded, played back to the driver's own conversation on the recording's clock.

The recording (83 s, 8274 packets, both directions) holds the simulator's truth (SIM_STATE) beside the telemetry.
"""

from __future__ import annotations

import itertools
import lzma
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fullswarm.agent.motion.reflexes import Standstill
from fullswarm.drivers.base import NO_OBSTACLES, Description, FleetReading, Limits, Reading
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.autopilot import FILTERED
from fullswarm.drivers.mavlink.codec import StreamParser, decoded_ids, dialect
from fullswarm.drivers.mavlink.session import Session
from fullswarm.drivers.mavlink.settings import Options
from fullswarm.geometry import wrap

RECORDING = Path(__file__).parents[1] / "data" / "ardurover_guided.tlog.xz"
VEHICLE, SIM_STATE, ORIGIN = 1, 108, (51.9999993, 5.0)  # as its GPS_GLOBAL_ORIGIN says
EARTH_M = 6_371_000.0 * math.pi / 180.0 * 1.00112  # metres of a degree of latitude, as the simulator has it
# What the recording's script asked for: speed, turn rate (counter-clockwise), seconds.
SCRIPT = (
    (1.0, 0.0, 10), (1.0, -0.3, 10), (1.0, 0.3, 8), (0.0, -0.5, 8), (0.0, 0.5, 6), (-0.5, 0.0, 8), (-0.5, -0.3, 8),
    (1.0, 0.0, 6), (0.0, 0.0, 6), (0.8, 0.0, 5),
)  # fmt: skip
NEAR_M_S, NEAR_RAD_S, LEAST_S = 0.15, 0.08, 1.5
MEAN_ERROR_M, MAX_ERROR_M, MAX_HEADING_RAD = 0.04, 0.07, 0.02  # measured: 0.031, 0.059, 0.015


@dataclass(frozen=True)
class Truth:
    """Where the simulated rover really was; ENU."""

    x_m: float
    y_m: float
    heading_rad: float


@dataclass(frozen=True)
class Moment:
    """What the driver held when the simulator told the truth."""

    at_s: float
    reading: Reading
    truth: Truth
    mode: int | None
    armed: bool


class Replay:
    """The recording, played once."""

    def __init__(self) -> None:
        self.session = Session(Options(VEHICLE, Limits(1.0, 2.0, 1.0, 2.0), "replay"), 0.0)
        self.moments: list[Moment] = []
        self.readings: list[Reading] = []
        self.lifecycles: set[str] = set()
        self.faults: set[str] = set()
        self.packets = 0
        for at_s, packet in packets(lzma.decompress(RECORDING.read_bytes())):
            self.packets += 1
            self._play(at_s, packet)

    def _play(self, at_s: float, packet: bytes) -> None:
        session = self.session
        for message in StreamParser(decoded_ids() | {SIM_STATE}).feed(packet):
            session.receive(message, at_s)
            reading = session.read()
            if reading is not None and (not self.readings or reading is not self.readings[-1]):
                self.readings.append(reading)
            if message.get_type() == "SIM_STATE" and reading is not None:
                vehicle = session._vehicle
                self.moments.append(Moment(at_s, reading, truth_of(message), vehicle.mode, vehicle.armed))
        session.tick(at_s)
        self.lifecycles.add(session.state)
        self.faults.add(session.fault)


def packets(data: bytes) -> Iterator[tuple[float, bytes]]:
    """Yield seconds since the first packet, and each packet."""
    at, first_us = 0, int.from_bytes(data[:8], "big")
    while at < len(data):
        now_us, frame = int.from_bytes(data[at : at + 8], "big"), at + 8
        at = frame + 12 + data[frame + 1]  # version 2, unsigned
        yield (now_us - first_us) / 1e6, data[frame:at]


def truth_of(message: Any) -> Truth:
    north = (message.lat_int / 1e7 - ORIGIN[0]) * EARTH_M
    east = (message.lon_int / 1e7 - ORIGIN[1]) * EARTH_M * math.cos(math.radians(ORIGIN[0]))
    return Truth(east, north, wrap(math.pi / 2 - message.yaw))


@pytest.fixture(scope="module")
def replay() -> Replay:
    return Replay()


def test_the_whole_recording_is_understood(replay: Replay) -> None:
    assert replay.packets == 8274
    assert len(replay.readings) > 1600
    # Somebody else's drive: the driver would stop it, is not heard (this is a recording), says so, and never drives.
    assert not replay.lifecycles & {"READY", "ACTIVE"}
    assert all(not fault or "does not confirm" in fault for fault in replay.faults)


def test_poses_follow_the_simulator_s_truth(replay: Replay) -> None:
    errors, turns = [], []
    for moment in replay.moments:
        pose = moment.reading.pose
        assert pose is not None
        errors.append(math.hypot(pose.x_m - moment.truth.x_m, pose.y_m - moment.truth.y_m))
        turns.append(abs(wrap(pose.heading_rad - moment.truth.heading_rad)))
    way = sum(
        math.hypot(b.truth.x_m - a.truth.x_m, b.truth.y_m - a.truth.y_m) for a, b in itertools.pairwise(replay.moments)
    )
    assert len(errors) > 800
    assert way == pytest.approx(49.1, abs=0.1)  # metres driven
    assert sum(errors) / len(errors) < MEAN_ERROR_M
    assert max(errors) < MAX_ERROR_M
    assert max(turns) < MAX_HEADING_RAD


def test_all_phases_are_recognised_with_their_speeds_and_turn_rates(replay: Replay) -> None:
    runs: list[tuple[tuple[float, float], float]] = []
    for reading in replay.readings:
        twist = reading.twist
        fits = [
            (speed, turn)
            for speed, turn, _ in SCRIPT
            if abs(twist.linear_m_s - speed) < NEAR_M_S and abs(twist.angular_rad_s - turn) < NEAR_RAD_S
        ]
        if fits and (not runs or runs[-1][0] != fits[0]):
            runs.append((fits[0], reading.stamp_s))
        elif not fits:
            runs.append(((math.nan, math.nan), reading.stamp_s))
    phases = []
    for (what, began_s), (_, ended_s) in itertools.pairwise([*runs, ((0.0, 0.0), replay.readings[-1].stamp_s)]):
        if ended_s - began_s > LEAST_S and what[0] == what[0]:
            phases.append((*what, ended_s - began_s))
    driving = [phase for phase in phases if phase[:2] != (0.0, 0.0)]
    asked = [phase for phase in SCRIPT if phase[:2] != (0.0, 0.0)]
    assert len(asked) == 9
    assert [phase[:2] for phase in driving] == [phase[:2] for phase in asked]
    # Each lasts as long as it was asked for, less the time to get there; silence adds up to 3 s to one of them.
    assert all(0.6 * want[2] < got[2] < want[2] + 3.0 for got, want in zip(driving, asked, strict=True))


def test_modes_texts_and_the_end(replay: Replay) -> None:
    seen = [key for key, _ in itertools.groupby((moment.mode, moment.armed) for moment in replay.moments)]
    order = [each for each in seen if each[0] is not None]
    assert order[-3:] == [(p.Mode.GUIDED, True), (p.Mode.HOLD, True), (p.Mode.HOLD, False)]
    assert any("target not received last 3secs" in text for text in replay.session.texts(83.0, 83.0))
    assert dialect().MAVLink_sim_state_message.id == SIM_STATE


def test_standstill_of_the_recorded_vehicle_is_recognised_and_nothing_else() -> None:
    """Its filter showed up to 0.05 m/s at rest. What the simulator says of the speed decides what is true."""
    session = Session(Options(VEHICLE, Limits(1.0, 2.0, 1.0, 2.0), "replay"), 0.0)
    make = Description("ArduPilot", "Rover", 0.35, Limits(1.0, 2.0, 1.0, 2.0), standstill=FILTERED)
    judge, seen = Standstill((make,), 50.0), -math.inf
    rest_s = motion_s = math.inf  # since when it has truly stood, or moved
    standing_s = fastest_m_s = 0.0
    for at_s, packet in packets(lzma.decompress(RECORDING.read_bytes())):
        for message in StreamParser(decoded_ids() | {SIM_STATE}).feed(packet):
            session.receive(message, at_s)
            if message.get_type() == "SIM_STATE":
                moves = math.hypot(message.vn, message.ve) > 0.03 or abs(message.zgyro) > 0.1
                motion_s = min(motion_s, at_s) if moves else math.inf
                rest_s = math.inf if moves else min(rest_s, at_s)
            reading = session.read()
            if reading is None or reading.stamp_s == seen:
                continue
            elapsed_s, seen = reading.stamp_s - max(seen, 0.0), reading.stamp_s
            judge.update(columns(reading))
            if judge.at_standstill[0]:
                assert at_s - motion_s < 0.3, "it moves"
                standing_s += elapsed_s
                fastest_m_s = max(fastest_m_s, abs(reading.twist.linear_m_s))
            else:
                assert at_s - rest_s < 1.0, "it has stood for a second"
    assert standing_s > 3.0
    assert fastest_m_s > 0.02


def columns(reading: Reading) -> FleetReading:
    place, twist = reading.odometry, reading.twist
    return FleetReading(
        np.array([reading.stamp_s]), np.full((1, 3), math.nan),
        np.array([[place.x_m, place.y_m, place.heading_rad]]),
        np.array([[twist.linear_m_s, twist.angular_rad_s]]), np.zeros(1, np.uint8), np.zeros(1, np.int64),
        np.full(1, -1.0), NO_OBSTACLES, np.full(1, math.nan),
    )  # fmt: skip
