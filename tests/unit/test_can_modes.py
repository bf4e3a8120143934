"""What the emulated controllers do in control modes that our own codecs do not use, in simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from fullswarm.clock import SimClock
from fullswarm.drivers.can import odrive, vesc
from fullswarm.drivers.can.odrive import AxisState
from fullswarm.drivers.can.protocol import Frame
from fullswarm.drivers.can.settings import parse
from fullswarm.emulators.can.firmware import Base
from fullswarm.emulators.can.wheel import FRICTION_M_S2, STEP_S
from fullswarm.simulation.bodies import FreeBody
from tests.unit.can_rig import OPTIONS, URL, Wire

METRES_PER_MOTOR_TURN = 2.0 * math.pi * 0.05 / 10.0  # the rig's wheel radius and gear
POLE_PAIRS = 7


class Bench:
    """Two emulated controllers and no driver; the wheel with node 2 is mounted the other way round."""

    def __init__(self, make: str, *more: str) -> None:
        self.clock = SimClock(100.0)
        self.wire = Wire()
        body = FreeBody(clock=self.clock)
        self.base = Base(parse("&".join((URL.format(make), OPTIONS[make], *more))), body, self.wire)

    def say(self, *frames: Frame) -> None:
        for frame in frames:
            self.base.receive(frame, self.clock.now_s())

    def run(self, duration_s: float, repeat: Callable[[], tuple[Frame, ...]] = tuple) -> None:
        for _ in range(round(duration_s / STEP_S)):
            self.clock.advance_to(self.clock.now_s() + STEP_S)
            self.say(*repeat())
            self.base.step(self.clock.now_s())

    def motor_turns(self) -> tuple[float, float]:
        """Turns of the two motors as the body has moved, in the sense of the robot's x axis."""
        left, right = self.base.left.spin.travelled_m, self.base.right.spin.travelled_m
        return left / METRES_PER_MOTOR_TURN, right / METRES_PER_MOTOR_TURN

    def speeds_m_s(self) -> tuple[float, float]:
        return self.base.left.spin.speed_m_s, self.base.right.spin.speed_m_s


def to_both(*messages: object) -> tuple[Frame, ...]:
    encode = vesc.encode if type(messages[0]).__module__ == vesc.__name__ else odrive.encode
    return tuple(encode(node, message) for node in (1, 2) for message in messages)


# ---------------------------------------------------------------- VESC
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_vesc_turns_by_duty_cycle_until_its_timeout(sign: float) -> None:
    bench = Bench("vesc")
    bench.run(0.9, lambda: to_both(vesc.SetDuty(sign * 0.1)))
    left, right = bench.speeds_m_s()
    assert left * sign > 0.05
    assert right == pytest.approx(-left)  # mounted the other way round
    bench.run(0.2, lambda: to_both(vesc.SetDuty(sign * 0.2)))
    assert bench.speeds_m_s()[0] == pytest.approx(2.0 * left, rel=0.02)
    bench.run(3.0)
    assert bench.speeds_m_s() == (0.0, 0.0)


def test_a_vesc_tells_duty_cycle_current_and_position() -> None:
    bench = Bench("vesc")
    for wheel in bench.base.wheels:
        wheel.statuses = frozenset({1, 4})  # type: ignore[union-attr]  # a VESC, by its URL
    bench.run(1.0, lambda: to_both(vesc.SetDuty(0.1)))
    told = [message for frame in bench.wire if isinstance(message := vesc.decode(frame), vesc.Status1)]
    assert told[-1].duty == pytest.approx(0.1, abs=0.002)
    bench.wire.clear()
    bench.run(0.5, lambda: to_both(vesc.SetCurrent(5.0)))
    told = [message for frame in bench.wire if isinstance(message := vesc.decode(frame), vesc.Status1)]
    assert told[-1].current_a == pytest.approx(5.0)
    angles = [message for frame in bench.wire if isinstance(message := vesc.decode(frame), vesc.Status4)]
    assert 0.0 <= angles[-1].position_deg < 360.0


@pytest.mark.parametrize("order", [vesc.SetCurrent(10.0), vesc.SetRelativeCurrent(10.0 / 60.0)])
def test_a_vesc_current_accelerates_the_wheel_against_friction(order: object) -> None:
    bench = Bench("vesc")
    bench.run(0.1)
    bench.run(0.1, lambda: to_both(order))
    slow, _ = bench.speeds_m_s()
    bench.run(0.1, lambda: to_both(order))
    fast, other = bench.speeds_m_s()
    assert slow > 0.0
    assert fast == pytest.approx(2.0 * slow, rel=0.02)
    assert other == pytest.approx(-fast)
    bench.run(5.0, lambda: to_both(order))
    limit, _ = bench.speeds_m_s()
    bench.run(1.0, lambda: to_both(order))
    assert bench.speeds_m_s()[0] == pytest.approx(limit)  # back EMF: it does not accelerate for ever


def test_a_vesc_current_below_friction_moves_nothing_and_zero_lets_it_roll_out() -> None:
    bench = Bench("vesc")
    bench.run(1.0, lambda: to_both(vesc.SetCurrent(1.0)))
    assert bench.speeds_m_s() == (0.0, 0.0)
    bench.run(0.2, lambda: to_both(vesc.SetCurrent(10.0)))
    before, _ = bench.speeds_m_s()
    bench.run(0.1, lambda: to_both(vesc.SetCurrent(0.0)))
    assert before - bench.speeds_m_s()[0] == pytest.approx(FRICTION_M_S2 * 0.1, rel=0.05)


def test_a_vesc_brakes_with_a_current_and_coasts_with_none() -> None:
    coasting, braking = Bench("vesc"), Bench("vesc")
    for bench, order in ((coasting, vesc.SetBrake(0.0)), (braking, vesc.SetBrake(5.0))):
        bench.run(0.5, lambda: to_both(vesc.SetErpm(20_000)))
        bench.run(0.2, lambda order=order: to_both(order))  # type: ignore[misc]
    assert abs(braking.speeds_m_s()[0]) < 0.5 * abs(coasting.speeds_m_s()[0])


@pytest.mark.parametrize("degrees", [90.0, 270.0])
def test_a_vesc_goes_to_an_angle_by_the_shorter_way(degrees: float) -> None:
    bench = Bench("vesc")
    bench.run(1.5, lambda: to_both(vesc.SetPosition(degrees)))
    left, right = bench.motor_turns()
    shorter = (degrees / 360.0 + 0.5) % 1.0 - 0.5
    assert left == pytest.approx(shorter, abs=0.03)
    assert right == pytest.approx(-shorter, abs=0.03)


def test_a_pressed_stop_lets_every_mode_go() -> None:
    bench = Bench("vesc")
    bench.base.left.press_estop(True)
    for order in (vesc.SetDuty(0.2), vesc.SetCurrent(20.0), vesc.SetPosition(180.0), vesc.SetErpm(5000)):
        bench.run(0.3, lambda order=order: to_both(order))  # type: ignore[misc]
        assert bench.speeds_m_s()[0] == 0.0


# ---------------------------------------------------------------- ODrive
def closed_loop(control: int, mode: int = odrive.PASSTHROUGH) -> tuple[Frame, ...]:
    return to_both(odrive.SetMode(control, mode), odrive.SetState(AxisState.CLOSED_LOOP))


@pytest.mark.parametrize("turns", [3.0, -3.0])
def test_an_odrive_goes_to_a_position_and_stays(turns: float) -> None:
    bench = Bench("odrive")
    bench.say(*closed_loop(3), *to_both(odrive.SetPosition(turns)))
    bench.run(2.0)
    assert bench.motor_turns() == pytest.approx((turns, -turns), abs=0.05)
    before = bench.motor_turns()
    bench.run(1.0)
    assert bench.motor_turns() == pytest.approx(before, abs=0.02)


def test_an_odrive_in_position_control_starts_where_it_stands() -> None:
    bench = Bench("odrive")
    bench.say(*to_both(odrive.SetPosition(40.0)))  # still idle
    bench.say(*closed_loop(3))
    bench.run(1.0)
    assert bench.motor_turns() == pytest.approx((0.0, 0.0), abs=0.02)


def test_an_odrive_position_move_keeps_to_the_limit_and_a_planned_one_to_its_cruise_speed() -> None:
    for mode, turn_s in ((odrive.PASSTHROUGH, 6.0), (5, 2.0)):
        bench = Bench("odrive")
        limits = to_both(odrive.SetLimits(6.0, 20.0), odrive.SetTrajectoryVelocity(2.0))
        bench.say(*limits, *closed_loop(3, mode), *to_both(odrive.SetPosition(100.0)))
        bench.run(1.0)
        assert bench.speeds_m_s()[0] / METRES_PER_MOTOR_TURN == pytest.approx(turn_s, rel=0.01)


def test_an_odrive_torque_accelerates_up_to_the_velocity_limit() -> None:
    bench = Bench("odrive")
    bench.run(0.1)
    bench.say(*to_both(odrive.SetLimits(10.0, 20.0)), *closed_loop(1), *to_both(odrive.SetTorque(0.5)))
    bench.run(0.05)
    slow, _ = bench.speeds_m_s()
    bench.run(0.05)
    fast, other = bench.speeds_m_s()
    assert slow > 0.0
    assert fast == pytest.approx(2.0 * slow, rel=0.02)
    assert other == pytest.approx(-fast)
    bench.run(3.0)
    assert bench.speeds_m_s()[0] / METRES_PER_MOTOR_TURN == pytest.approx(10.0, rel=0.01)
    bench.say(*to_both(odrive.SetTorque(0.0)))
    bench.run(2.0)
    assert bench.speeds_m_s() == (0.0, 0.0)


def test_an_idle_odrive_obeys_no_set_point_of_any_mode() -> None:
    bench = Bench("odrive")
    for control in (1, 2, 3):
        bench.say(*to_both(odrive.SetMode(control)))
        bench.say(*to_both(odrive.SetTorque(1.0), odrive.SetVelocity(1.0), odrive.SetPosition(5.0)))
        bench.run(0.5)
        assert bench.speeds_m_s() == (0.0, 0.0)
