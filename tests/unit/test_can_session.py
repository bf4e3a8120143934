"""The lifecycle without faults, against the emulated controllers in simulated time."""

from __future__ import annotations

import itertools
import math

import pytest

from fullswarm.drivers.base import STAND, Lifecycle, Twist
from fullswarm.drivers.can import odrive
from fullswarm.drivers.can.odrive import AxisState
from fullswarm.emulators.can.vesc import VescEmulator
from fullswarm.geometry import wrap
from tests.unit.can_rig import BASE_M, LIMIT_M_S, Rig
from tests.unit.can_square import Square, error_m


@pytest.mark.parametrize("make", ["odrive", "vesc"])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_drives_and_counts(make: str, direction: float) -> None:
    rig = Rig(make)
    rig.active(Twist(0.3 * direction, 0.0))
    rig.run(3.0)
    rig.twist = STAND
    rig.run(1.0)
    reading = rig.session.reading
    assert reading is not None
    true_m = rig.rolled()[0]
    assert true_m * direction > 0.9
    assert reading.odometry.x_m == pytest.approx(true_m, rel=0.01)
    one_count_m = 0.05 * math.tau / (10 * 7 * 6) if make == "vesc" else 0.0  # of heading, over the whole way
    assert abs(reading.odometry.y_m) <= 0.001 + 1.1 * one_count_m / BASE_M * abs(true_m)
    assert rig.session.state is Lifecycle.ACTIVE


@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_turning_in_place_counts_the_angle(make: str) -> None:
    rig = Rig(make)
    rig.active(Twist(0.0, 1.5))
    rig.run(1.0)
    left, right = rig.rolled()
    reading = rig.session.reading
    assert reading is not None
    assert reading.odometry.heading_rad == pytest.approx((right - left) / BASE_M, rel=0.03)
    assert reading.twist.angular_rad_s == pytest.approx(1.5, rel=0.02)


def test_nothing_moves_before_activation() -> None:
    rig = Rig()
    rig.twist = Twist(0.3, 0.0)
    rig.until_state(Lifecycle.READY, 1.0)
    rig.run(1.0)
    assert rig.applied == STAND
    assert rig.idle()
    assert rig.speeds() == [0.0, 0.0]


def test_activation_starts_from_zero() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.session.deactivate(rig.now)
    rig.twist = None
    rig.until(rig.idle, 1.0)
    rig.session.activate(rig.now)
    rig.until_state(Lifecycle.ACTIVE, 0.6)
    rig.run(0.5)
    assert rig.speeds() == pytest.approx([0.0, 0.0], abs=1e-6)


def test_saturation_reports_what_is_applied() -> None:
    rig = Rig()
    rig.active(Twist(1.0, 2.0))
    assert max(abs(speed) for speed in rig.speeds()) == pytest.approx(LIMIT_M_S, rel=1e-3)
    assert rig.applied.linear_m_s / rig.applied.angular_rad_s == pytest.approx(0.5, rel=1e-5)


def test_vesc_dead_band_is_reported_and_braked() -> None:
    rig = Rig("vesc")
    rig.active(Twist(0.3, 0.0))
    rig.twist = Twist(0.05, 0.0)  # 668 ERPM
    rig.run(0.2)
    assert rig.applied == STAND
    assert rig.sent[-1][1].id >> 8 == 2


@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_silence_is_a_stop(make: str) -> None:
    rig = Rig(make)
    rig.active(Twist(0.3, 0.0))
    rig.twist = None
    rig.run(0.25)
    assert min(rig.speeds()) == pytest.approx(0.3, rel=0.01)
    rig.until(lambda: max(rig.speeds()) < 0.01, 0.6)
    assert rig.session.state is Lifecycle.ACTIVE


def test_set_points_at_50_hz() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.sent.clear()
    rig.run(1.0)
    times = [at for at, frame in rig.sent if frame.id == 1 << 5 | 0x0D]
    assert 49 <= len(times) <= 51
    assert max(b - a for a, b in itertools.pairwise(times)) < 0.026


def test_deactivate_rolls_out_and_lets_go() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.session.deactivate(rig.now)
    assert rig.session.state is Lifecycle.READY
    rig.step()
    assert not rig.idle()  # still regulated to zero, which brakes
    rig.until(rig.idle, 0.6)
    assert max(rig.speeds()) < 0.05


def test_leaving_goes_over_zero_to_idle() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.session.closing(rig.now)
    rig.until(lambda: rig.session.at_rest, 1.0)
    assert rig.idle()
    rig.session.activate(rig.now)
    rig.run(0.5)
    assert rig.idle()
    assert odrive.encode(2, odrive.SetState(AxisState.IDLE)) in rig.session.final_stop()
    assert rig.session.state is not Lifecycle.ACTIVE


@pytest.mark.parametrize("laps", [2, pytest.param(10, marks=pytest.mark.slow)])
@pytest.mark.parametrize("make", ["odrive", "vesc"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_squares_of_2_m(make: str, sign: float, laps: int) -> None:
    """Odometry within 1 % of the path; ten times round is 80 m through the counts of both wheels."""
    rig = Rig(make)
    rig.active(STAND)
    square = Square(rig.reading.odometry, 2.0, laps, sign, 0.5, 3.0)
    for _ in range(400 * 50):
        rig.twist = square.twist(rig.reading.odometry)
        if rig.twist is None:
            break
        for _ in range(4):
            rig.step()
    assert rig.twist is None, "it never came round"
    rig.twist = STAND
    rig.run(1.0)
    true, told = rig.body.state(), rig.reading.odometry
    assert abs(true.rolled_m) > 0.97 * square.path_m
    assert error_m(told, true.x_m, true.y_m) < 0.01 * square.path_m
    assert error_m(told, true.x_m, true.y_m) < 0.05
    assert wrap(told.heading_rad - true.heading_rad) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_tachometer_wraps(direction: float) -> None:
    """A VESC counts in 32 bits: the wheels roll on past the end of the count, both ways."""
    rig = Rig("vesc")
    for wheel in rig.wheels:
        assert isinstance(wheel, VescEmulator)
        counts = direction * wheel._wheel.sign * (2**31 - 1000)
        wheel._zero_m = -wheel._wheel.metres(counts / (6 * 7))
    rig.active(Twist(0.3 * direction, 0.0))
    rig.run(2.0)
    true_m = rig.body.state().rolled_m
    assert abs(true_m) > 0.7  # some 930 counts to the metre
    assert rig.reading.odometry.x_m == pytest.approx(true_m, rel=0.03)
