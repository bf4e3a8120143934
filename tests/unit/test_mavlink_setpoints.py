"""Every row of set-points, sticks and numbers that are none, as measured on the real firmware."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from fullswarm.drivers.mavlink.protocol import Mode
from tests.unit.mavlink_wire import COMPANION, STATION, STRANGER, Wire


def driven(each: Callable[[Wire], object], duration_s: float = 3.0) -> tuple[float, float]:
    """Return the speed and the turn rate (clockwise) after a set-point was repeated at 10 Hz."""
    wire = Wire().guided()
    wire.run(duration_s, lambda: each(wire))
    return wire.state.speed_m_s, -wire.state.turn_rad_s


def close(speed: float, turn: float) -> Any:
    return pytest.approx((speed, turn), abs=0.02)


@pytest.mark.parametrize("frame", [8, 9, 1, 7])
@pytest.mark.parametrize("mask", [0x5C7, 0x5E7, 0x5C3, 0x4C7, 0x7C7])
def test_speed_and_turn_whatever_the_frame(frame: int, mask: int) -> None:
    assert driven(lambda wire: wire.drive(0.8, 0.4, mask=mask, frame=frame, vz=5.0)) == close(0.8, 0.4)


@pytest.mark.parametrize("frame", [12, 20, 0])
def test_other_frames_are_ignored(frame: int) -> None:
    assert driven(lambda wire: wire.drive(0.8, 0.4, frame=frame)) == (0.0, 0.0)


@pytest.mark.parametrize("mask", [0x407, 0x1C7, 0xDFF])
def test_masks_that_are_ignored(mask: int) -> None:
    assert driven(lambda wire: wire.drive(0.8, 0.4, mask=mask)) == (0.0, 0.0)


@pytest.mark.parametrize("mask", [0x5D7, 0x5FF])
def test_turn_only(mask: int) -> None:
    assert driven(lambda wire: wire.drive(0.8, 0.4, mask=mask)) == close(0.0, 0.4)


def test_speed_is_the_hypotenuse_with_the_sign_of_vx() -> None:
    assert driven(lambda wire: wire.drive(0.0, vy=0.8)) == close(0.8, 0.0)
    assert driven(lambda wire: wire.drive(0.0, vy=-0.8)) == close(0.8, 0.0)
    assert driven(lambda wire: wire.drive(-0.3, vy=0.4)) == close(-0.5, 0.0)


def test_a_velocity_vector_is_driven_forwards_and_one_that_points_behind_spins_for_ever() -> None:
    assert driven(lambda wire: wire.drive(0.8, mask=0xDC7)) == close(0.8, 0.0)
    speed, turn = driven(lambda wire: wire.drive(-0.8, mask=0xDC7), 8.0)
    assert speed == pytest.approx(0.8, abs=0.02)
    assert abs(turn) == pytest.approx(2.1, abs=0.1)
    wire = Wire().guided()
    wire.run(4.0, lambda: wire.drive(0.8, mask=0xDC7, frame=1))  # north, in the world
    assert (wire.state.heading_rad, wire.state.speed_m_s) == close(math.pi / 2, 0.8)


def test_velocity_and_heading() -> None:
    assert driven(lambda wire: wire.drive(-0.8, mask=0x9C7)) == close(-0.8, 0.0)
    _, turn = driven(lambda wire: wire.drive(-0.8, mask=0x9C7, yaw=0.5), 8.0)
    assert turn == pytest.approx(0.87, rel=0.15)  # anchored again with each message
    wire = Wire().guided()
    wire.run(4.0, lambda: wire.drive(mask=0x9FF, frame=1, yaw=math.pi))  # heading only: south
    assert (wire.state.heading_rad, wire.state.speed_m_s) == close(-math.pi / 2, 0.0)


def test_a_place_is_driven_to_by_one_message() -> None:
    wire = Wire().guided()
    wire.drive(mask=0xDF8, frame=1, y=6.0)  # east, where it looks
    assert wire.until(lambda: bool(wire.of("MISSION_ITEM_REACHED")), 15.0) == pytest.approx(8.3, rel=0.15)
    wire.run(2.0)
    assert abs(wire.state.x_m - 6.0) == pytest.approx(0.2, abs=0.15)
    assert not any(text.startswith("target") for text in wire.texts)
    wire.drive(mask=0xDF8, frame=8, x=-2.0)  # behind it
    wire.until(lambda: len(wire.of("MISSION_ITEM_REACHED")) > 1, 15.0)
    assert wire.state.x_m == pytest.approx(3.9, abs=0.4)


def test_whose_set_points_count() -> None:
    assert driven(lambda wire: wire.drive(0.8, target=(2, 1))) == (0.0, 0.0)
    assert driven(lambda wire: wire.drive(0.8, target=(0, 0))) == close(0.8, 0.0)
    assert driven(lambda wire: wire.drive(0.8, target=(1, 191))) == close(0.8, 0.0)
    for source in (COMPANION, STRANGER, (254, 190), STATION):
        assert driven(lambda wire, source=source: wire.drive(0.8, source=source)) == close(0.8, 0.0)  # type: ignore[misc]
    assert driven(lambda wire: wire.drive(0.8, source=(1, 1))) == (0.0, 0.0)

    def both(wire: Wire) -> None:
        wire.drive(0.8)
        wire.drive(-0.2, port=1)

    assert driven(both) == close(-0.2, 0.0)  # last writer wins


@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.MANUAL, Mode.LOITER, Mode.ACRO, Mode.STEERING])
def test_other_modes_ignore_and_do_not_remember(mode: Mode) -> None:
    wire = Wire()
    wire.command(400, 1)
    wire.command(176, 1, mode)
    wire.run(1.0, lambda: wire.drive(0.8))
    assert wire.state.speed_m_s == 0.0
    wire.command(176, 1, Mode.GUIDED)
    wire.run(1.0)
    assert wire.state.speed_m_s < 0.05


@pytest.mark.parametrize(("pause_s", "moves"), [(0.0, True), (2.5, True), (3.5, False)])
def test_danger_1_a_set_point_stored_while_disarmed_drives_off_on_arming(pause_s: float, moves: bool) -> None:
    wire = Wire()
    wire.command(176, 1, Mode.GUIDED)
    wire.drive(0.8)
    wire.run(pause_s)
    wire.command(400, 1)
    wire.run(0.4)
    assert (wire.state.speed_m_s > 0.2) == moves


def override(wire: Wire, steering: int = 1500, throttle: int = 1500, source: tuple[int, int] = STATION) -> None:
    wire.send("RC_CHANNELS_OVERRIDE", 1, 1, steering, 1500, throttle, *[0] * 5, source=source)


def test_danger_2_a_pilot_s_throttle_wins_in_guided() -> None:
    def both(wire: Wire) -> None:
        wire.drive(0.3)
        override(wire, throttle=1800)

    speed, _ = driven(both, 5.0)
    assert speed == pytest.approx(2.36, rel=0.05)


@pytest.mark.parametrize("legacy", [True, False])
def test_sticks_in_manual_and_their_end(legacy: bool) -> None:
    wire = Wire()
    wire.command(400, 1)

    def sticks(source: tuple[int, int] = STATION) -> None:
        if legacy:
            override(wire, 1600, 1750, source)
        else:
            wire.send("MANUAL_CONTROL", 1, 0, 200, 500, 0, 0, source=source)

    wire.run(2.0, lambda: sticks(STRANGER))
    assert wire.state.speed_m_s == 0.0
    wire.run(4.0, sticks)
    assert wire.state.speed_m_s == pytest.approx(1.83, rel=0.03)
    assert wire.state.turn_rad_s < -0.1  # to the right
    sticks()
    assert wire.until(lambda: wire.state.speed_m_s < 1.75) == pytest.approx(3.1, abs=0.1)
    assert 3.0 + wire.stopping()[0] == pytest.approx(4.1, abs=0.35)
    assert (wire.rover.mode, wire.rover.armed) == (Mode.MANUAL, True)


def test_attitude_targets_are_shares_of_the_top_speed() -> None:
    def aim(wire: Wire, mask: int = 0b11) -> None:
        wire.send("SET_ATTITUDE_TARGET", 0, 1, 1, mask, [1, 0, 0, 0], 0, 0, 0.3, 0.3)

    assert driven(aim) == close(0.9, 0.3)
    assert driven(lambda wire: aim(wire, 64)) == (0.0, 0.0)
    wire = Wire().guided()
    wire.run(4.0, lambda: aim(wire, 0b111))  # heading from the quaternion: north
    assert (wire.state.heading_rad, wire.state.speed_m_s) == close(math.pi / 2, 0.9)


# ---------------------------------------------------------------- numbers that are none
def test_not_finite_on_a_board() -> None:
    nan = math.nan
    assert driven(lambda wire: wire.drive(nan)) == (0.0, 0.0)
    assert driven(lambda wire: wire.drive(0.8, vy=nan)) == (0.0, 0.0)
    assert driven(lambda wire: wire.drive(0.8, nan)) == close(0.31, 0.0)
    assert driven(lambda wire: wire.drive(0.8, vz=nan, yaw=nan, x=nan)) == close(0.8, 0.0)
    assert driven(lambda wire: wire.drive(1e10), 6.0) == close(3.0, 0.0)
    assert driven(lambda wire: wire.drive(math.inf, 1e6), 6.0) == close(3.0, 2.094)
    assert driven(lambda wire: wire.drive(1e30), 6.0) == close(3.0, 0.0)


@pytest.mark.parametrize(
    ("speed", "side", "turn", "dies"),
    [(math.nan, 0.0, 0.0, True), (0.5, math.nan, 0.0, True), (0.5, 0.0, math.nan, True), (1e30, 0.0, 0.0, True),
     (1e10, 0.0, 0.0, False), (math.inf, 0.0, 0.0, False), (0.5, 0.0, math.inf, False), (0.5, 0.0, 1e6, False)],
)  # fmt: skip
def test_not_finite_in_the_simulator_is_its_end(speed: float, side: float, turn: float, dies: bool) -> None:
    wire = Wire(traps_floats=True).guided()
    wire.run(0.5, lambda: wire.drive(speed, turn, vy=side))
    assert wire.rover.aborted == dies
    assert bool(wire.count(2.0)) != dies
    assert wire.state.speed_m_s == 0.0 or not dies
