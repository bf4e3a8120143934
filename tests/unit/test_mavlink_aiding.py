"""A rover that loses its satellites: it notices before its firmware does, says so, stands, and goes on afterwards."""

from __future__ import annotations

import math

import pytest

from fullswarm.agent.motion.robot_controller import StopReason
from fullswarm.drivers.base import Lifecycle
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import decode, dialect
from fullswarm.drivers.mavlink.protocol import Mode
from fullswarm.drivers.mavlink.vehicle import SIGMA_M, Aiding
from fullswarm.reasons import Code
from tests.unit.mavlink_bench import Px4Bench
from tests.unit.mavlink_wire import Wire
from tests.unit.rover_agent import Lab

BARRED_S, STANDS_S, STANDS_M = 0.6, 1.85, 1.15  # from 1 m/s; measured: 0.52, 1.79, 1.08
GOOD, BAD = p.EkfStatus(831), p.EkfStatus(831, strain=0.9)


# ------------------------------------------------------------------ what the messages mean
def test_a_fix_that_is_repeated_is_none() -> None:
    """ArduPilot goes on sending the last fix of a silent receiver as a good one, with the time of that fix."""
    aiding = Aiding()
    for number in range(10):
        aiding.receive(p.SatelliteFix(1_000_000 + min(number, 3) * 200_000, 6), 0.2 * number)
    assert aiding.age_s(1.8) == pytest.approx(1.2)
    assert aiding.sigma_m(1.8) > SIGMA_M + 0.1
    assert "reports nothing new" in aiding.problem(1.8)
    aiding.receive(p.SatelliteFix(1_800_000, 6), 1.8)
    assert (aiding.age_s(1.8), aiding.sigma_m(1.8), aiding.problem(1.8)) == (0.0, SIGMA_M, "")


@pytest.mark.parametrize("fix_type", [0, 1, 2])
def test_a_fix_below_three_dimensions_is_none(fix_type: int) -> None:
    aiding = Aiding()
    aiding.receive(p.SatelliteFix(1, 3), 0.0)
    aiding.receive(p.SatelliteFix(2, fix_type), 1.5)
    assert aiding.age_s(1.5) == 1.5
    assert f"no fix (type {fix_type})" in aiding.problem(1.5)


def test_a_filter_that_rejects_its_measurements_is_unaided() -> None:
    aiding = Aiding()
    aiding.receive(p.SatelliteFix(1, 6), 0.0)
    aiding.receive(BAD, 0.0)
    aiding.receive(p.SatelliteFix(2, 6), 1.5)
    assert aiding.age_s(1.5) == 1.5
    assert "rejects" in aiding.problem(1.5)
    aiding.receive(GOOD, 1.6)
    assert aiding.age_s(1.6) == pytest.approx(0.1)
    assert Aiding(filtered=False).age_s(9.0) == 0.0


def test_a_vehicle_without_a_receiver_is_not_held_to_have_lost_it() -> None:
    aiding, outside = Aiding(), Aiding(receiver=False)
    aiding.receive(p.SatelliteFix(0, 0), 0.0)
    outside.receive(p.SatelliteFix(1, 6), 0.0)
    assert (aiding.age_s(9.0), outside.age_s(9.0)) == (0.0, 0.0)
    assert not aiding.has_receiver


@pytest.mark.parametrize("ratio", [0.3, math.nan])
def test_the_worse_test_ratio_counts_and_one_that_is_no_number_is_the_worst(ratio: float) -> None:
    messages = (
        dialect().MAVLink_ekf_status_report_message(831, 0.1, ratio, 5.0, 5.0, 0.0),
        dialect().MAVLink_estimator_status_message(0, 831, 0.1, ratio, 5.0, 5.0, 0.0, 0.0, 0.0, 0.0),
    )
    for message in messages:
        received = decode(message)
        assert received is not None
        assert isinstance(received.body, p.EkfStatus)
        assert received.body.strain == (ratio if math.isfinite(ratio) else math.inf)


# ------------------------------------------------------------------ the emulated rover, as the firmware shows it
def test_a_silent_receiver_looks_good_for_four_seconds_and_a_covered_one_does_not() -> None:
    wire = Wire()
    wire.run(2.0)
    wire.rover.set_gps(False)
    last_us = wire.of("GPS_RAW_INT")[-1].time_usec
    wire.run(3.0)
    silent = wire.of("GPS_RAW_INT")[-1]
    assert silent.fix_type == 6
    assert silent.time_usec - last_us <= 1_000_000
    assert wire.count(2.0)["LOCAL_POSITION_NED"] == 2  # dead reckoning
    assert wire.of("GPS_RAW_INT")[-1].fix_type == 0
    wire.rover.set_gps(True)
    wire.rover.cover_antenna(True)
    wire.run(1.0)
    assert wire.of("GPS_RAW_INT")[-1].fix_type == 1
    wire.rover.cover_antenna(False)
    wire.rover.parameters["SIM_GPS_DISABLE"] = 1.0
    wire.run(7.5)
    assert wire.of("EKF_STATUS_REPORT")[-1].pos_horiz_variance > 0.8
    assert not wire.count(2.0)["LOCAL_POSITION_NED"]


# ------------------------------------------------------------------ the agent
def driving(seed: int = 0, **settings: float) -> Lab:
    lab = Lab(seed, **settings)
    lab.drive()
    lab.until(lambda: lab.truth.speed_m_s > 0.98)
    lab.runtime.run(1.0 + 0.07 * seed)  # at any moment between two fixes
    assert lab.reason is StopReason.MOVING
    return lab


@pytest.mark.parametrize("covered", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_a_rover_that_loses_its_satellites_stands_long_before_its_firmware_stops_it(seed: int, covered: bool) -> None:
    lab = driving(seed)
    rolled_m, lost_s = lab.truth.rolled_m, lab.runtime.now_s()
    lab.rover.cover_antenna(True) if covered else lab.rover.set_gps(False)
    lab.until(lambda: lab.reason is StopReason.UNSURE, BARRED_S)
    lab.until(lambda: abs(lab.truth.speed_m_s) < 0.05, STANDS_S)
    assert lab.runtime.now_s() - lost_s < STANDS_S
    assert lab.truth.rolled_m - rolled_m < STANDS_M
    lab.runtime.run(0.5)
    assert lab.driver.state is Lifecycle.ACTIVE, "the firmware has not noticed yet"
    health = lab.health[-1]
    assert health.stop_code == Code.UNSURE
    assert health.position_sigma_m > 0.1
    assert "satellite receiver" in health.fault
    lab.close()


def test_it_goes_on_by_itself_when_the_satellites_are_back_soon() -> None:
    lab = driving()
    lab.rover.set_gps(False)
    lab.runtime.run(4.0)
    assert abs(lab.truth.speed_m_s) < 0.05
    lab.rover.set_gps(True)
    lab.until(lambda: lab.truth.speed_m_s > 0.9, 3.0)
    lab.runtime.run(1.0)
    assert lab.health[-1].position_sigma_m < 0.08
    assert lab.driver.fault == ""
    lab.close()


def test_after_the_firmware_s_failsafe_it_does_not_move_by_itself() -> None:
    lab = driving()
    lab.rover.set_gps(False)
    lab.until(lambda: lab.rover.mode == Mode.HOLD, 9.0)
    lab.runtime.run(3.0)
    lab.rover.set_gps(True)
    lab.until(lambda: lab.driver.state is Lifecycle.READY, 5.0)
    rolled_m = lab.truth.rolled_m
    lab.runtime.run(5.0)
    assert lab.truth.rolled_m == pytest.approx(rolled_m, abs=0.01)
    lab.drive()
    lab.until(lambda: lab.truth.speed_m_s > 0.9, 5.0)
    lab.close()


def test_a_wider_margin_of_the_filter_allows_more_dead_reckoning() -> None:
    lab = driving(safety_margin_m=0.5)
    lab.rover.set_gps(False)
    took_s = lab.until(lambda: lab.reason is StopReason.UNSURE, 5.0)
    assert took_s > 2.0
    lab.close()


def test_a_good_signal_never_bars_motion() -> None:
    lab = driving(3)
    reasons = set()
    for _ in range(1000):
        lab.runtime.run(0.02)
        reasons.add(lab.reason)
    assert reasons == {StopReason.MOVING}
    lab.close()


def test_px4_tells_the_same_by_its_own_messages() -> None:
    bench = Px4Bench()
    bench.ready()
    bench.run(2.0)
    reading = bench.session.read()
    assert reading is not None
    assert (reading.position_sigma_m or 0.0) < SIGMA_M + 0.03
    bench.rover.gps = False
    bench.run(2.0)
    reading = bench.session.read()
    assert reading is not None
    assert (reading.position_sigma_m or 0.0) > SIGMA_M + 0.1
    assert bench.session.state is Lifecycle.READY
    assert "satellite receiver" in bench.session.unaided(bench.now_s)
    bench.rover.gps = True
    bench.run(0.5)
    assert bench.session.unaided(bench.now_s) == ""
