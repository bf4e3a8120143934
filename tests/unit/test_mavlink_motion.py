"""How the emulated rover stops, speeds up and turns, within 15 % of what was measured on the real firmware."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest

from fullswarm.drivers.mavlink.protocol import Mode
from fullswarm.drivers.mavlink.settings import LIMITS
from fullswarm.emulators.mavlink.firmware import LOOP_S
from tests.unit.mavlink_wire import Wire

WITHIN = 0.15


# ---------------------------------------------------------------- the measured table of stops
def near(measured: tuple[float, float], table: tuple[float, float]) -> None:
    assert measured == pytest.approx(table, rel=WITHIN)


@pytest.mark.parametrize(("speed", "table"), [(0.5, (3.75, 1.59)), (1.0, (4.12, 3.55)), (2.0, (4.94, 8.05))])
def test_silence_stops_after_three_seconds(speed: float, table: tuple[float, float]) -> None:
    wire = Wire().moving(speed)
    wire.drive(speed)
    silent_s = wire.now_s
    near(wire.stopping(), table)
    assert wire.text_s("target not received last 3secs, stopping") - silent_s == pytest.approx(3.0, abs=0.1)
    assert (wire.rover.mode, wire.rover.armed) == (Mode.GUIDED, True)
    wire.run(1.0, lambda: wire.drive(speed))
    assert wire.state.speed_m_s > 0.4  # resumes at once


def test_speed_falls_shortly_after_the_text() -> None:
    wire = Wire().moving(1.0)
    wire.drive(1.0)
    assert wire.until(lambda: wire.state.speed_m_s < 0.99) == pytest.approx(3.14, abs=0.1)


@pytest.mark.parametrize(("speed", "table"), [(0.5, (0.89, 0.17)), (1.0, (1.26, 0.62)), (2.0, (2.04, 2.16))])
def test_a_zero_set_point_brakes(speed: float, table: tuple[float, float]) -> None:
    wire = Wire().moving(speed)
    wire.drive()
    near(wire.stopping(), table)


@pytest.mark.parametrize("speed", [0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0])
def test_a_stop_is_no_longer_than_the_driver_tells_the_filter(speed: float) -> None:
    wire = Wire().moving(speed)
    x_m = wire.state.x_m
    for _ in range(80):
        wire.drive()
        wire.run(0.05)
    told_m = speed**2 / (2.0 * LIMITS.accel_m_s2) + min(LIMITS.overrun_s * speed, LIMITS.overrun_m)
    assert wire.state.speed_m_s == pytest.approx(0.0, abs=1e-6)
    assert wire.state.x_m - x_m <= told_m


@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.MANUAL])
@pytest.mark.parametrize(("speed", "table"), [(0.5, (0.82, 0.145)), (1.0, (1.04, 0.36)), (2.0, (1.195, 0.95))])
def test_hold_and_manual_roll_out(mode: Mode, speed: float, table: tuple[float, float]) -> None:
    wire = Wire().moving(speed)
    wire.send("SET_MODE", 1, 1, mode)
    near(wire.stopping(), table)


@pytest.mark.parametrize(("speed", "table"), [(0.5, (0.75, 0.11)), (1.0, (0.91, 0.26)), (2.0, (0.91, 0.54))])
def test_disarming_rolls_out(speed: float, table: tuple[float, float]) -> None:
    wire = Wire().moving(speed)
    wire.send("COMMAND_LONG", 1, 1, 400, 0, 0, 0, 0, 0, 0, 0, 0)
    near(wire.stopping(), table)
    assert wire.rover.mode == Mode.GUIDED


def test_asking_for_guided_again_changes_nothing() -> None:
    wire = Wire().moving(1.0)
    wire.drive(1.0)
    took_s, _ = wire.stopping(lambda: wire.command(176, 1, Mode.GUIDED))
    assert took_s == pytest.approx(4.12, rel=WITHIN)


# ---------------------------------------------------------------- how it drives
@pytest.mark.parametrize(("speed", "t90_s"), [(1.0, 1.0), (2.0, 1.9), (3.0, 2.75), (-1.0, 1.0)])
def test_acceleration_and_steady_speed(speed: float, t90_s: float) -> None:
    wire, peak, before = Wire().guided(), 0.0, 0.0
    start_s, reached_s = wire.now_s, math.inf
    for _ in range(300):
        wire.drive(speed)
        wire.step()
        now = abs(wire.state.speed_m_s)
        peak, before = max(peak, (now - before) / LOOP_S), now
        if now >= 0.9 * abs(speed):
            reached_s = min(reached_s, wire.now_s - start_s)
    assert reached_s == pytest.approx(t90_s, rel=WITHIN)
    assert 1.0 <= peak <= 1.15
    assert wire.state.speed_m_s == pytest.approx(speed, rel=0.02)


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0, -1.0])
def test_it_overshoots_by_four_to_ten_percent(speed: float) -> None:
    wire, peak = Wire().guided(), 0.0
    for _ in range(200):
        wire.drive(speed)
        wire.step()
        peak = max(peak, abs(wire.state.speed_m_s))
    assert 1.04 <= peak / abs(speed) <= 1.10


@pytest.mark.parametrize(
    ("asked", "got", "t90_s"), [(0.5, 0.5, 0.26), (-1.0, -1.0, 0.48), (2.0, 2.0, 0.9), (3.0, 2.095, 0.9)]
)
def test_yaw_rate(asked: float, got: float, t90_s: float) -> None:
    wire = Wire().guided()
    wire.drive(-0.5, asked)
    took_s = wire.until(lambda: abs(wire.state.turn_rad_s) >= 0.9 * abs(got))
    assert took_s == pytest.approx(t90_s, rel=0.2)
    wire.run(1.0)
    assert wire.state.turn_rad_s == pytest.approx(-got, abs=0.002)  # clockwise positive, in reverse as well


@pytest.mark.parametrize("rate_hz", [5.0, 2.0, 1.0, 0.5, 0.36])
def test_rare_set_points_are_enough(rate_hz: float) -> None:
    wire = Wire().moving(0.8)
    slowest = []

    def drive() -> None:
        wire.drive(0.8)
        slowest.append(wire.state.speed_m_s)

    wire.run(12.0, drive, every_s=1 / rate_hz)
    assert min(slowest) > 0.79
    assert not any(text.startswith("target") for text in wire.texts)


def test_a_speed_that_the_rover_may_not_reach_is_capped_without_a_word() -> None:
    wire = Wire().moving(6.0)
    assert wire.state.speed_m_s == pytest.approx(3.0, rel=0.02)
    assert not any("speed" in text.lower() for text in wire.texts)


# ---------------------------------------------------------------- what its filter makes of the truth
def errors(wire: Wire, duration_s: float) -> list[tuple[float, float, float]]:
    """Go on; return the errors of position, east and north, and of the speed, at 50 Hz."""
    found = []

    def look() -> None:
        told, truth = wire.rover.state(), wire.rover.truth()
        found.append((told.x_m - truth.x_m, told.y_m - truth.y_m, told.speed_m_s - truth.speed_m_s))

    wire.run(duration_s, look, every_s=LOOP_S)
    return found


def test_its_filter_errs_as_the_recorded_one_does() -> None:
    """Recorded: 0.02 to 0.05 m, 0.02 m/s, up to 0.05 m/s at rest; slow, and the position moves less than 12 mm/s."""
    for seed in range(6):
        found = errors(Wire(seed=seed), 100.0)
        assert 0.01 < spread(error[0] for error in found) < 0.05
        assert 0.01 < spread(error[2] for error in found) < 0.035
        assert 0.02 < max(abs(error[2]) for error in found) < 0.06
        for now, later in zip(found, found[25:], strict=False):  # 0.5 s
            assert math.hypot(later[0] - now[0], later[1] - now[1]) < 0.008
            assert abs(later[2] - now[2]) < 0.015


def test_two_rovers_err_differently_and_each_alike_every_time() -> None:
    one, again, other = (errors(Wire(seed=seed), 2.0) for seed in (1, 1, 2))
    assert one == again
    assert one != other


def spread(values: Iterable[float]) -> float:
    each = list(values)
    mean = sum(each) / len(each)
    return math.sqrt(sum((value - mean) ** 2 for value in each) / len(each))
