"""How the emulated rover stops, speeds up and turns, within 15 % of what was measured on the real firmware."""

from __future__ import annotations

import math

import pytest

from fullswarm.drivers.mavlink.firmware import LOOP_S
from fullswarm.drivers.mavlink.protocol import Mode
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
