"""The Create's session beyond driving: stuck sensors, the dock, the battery, lamps and songs, sleep, odd wheels."""

from __future__ import annotations

import math

import pytest

from fullswarm.drivers.base import STAND, Lifecycle, Twist
from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.protocol import Mode, Op
from fullswarm.drivers.create_oi.senses import Charging
from fullswarm.emulators.create_oi.firmware import Quirks
from fullswarm.errors import DriverError
from tests.unit.create_bench import GO, Bench, Held


# ---------------------------------------------------------------- sensors that do not follow
@pytest.mark.parametrize("wheels_turn", [False, True])
def test_stuck_sensors_are_a_fault_once_a_set_point_changes_nothing(wheels_turn: bool) -> None:
    bench = Bench().active()
    if wheels_turn:
        bench.run(0.5, GO)
    bench.robot.stick(True, bench.clock.now_s())
    bench.run(0.9, Twist(-0.2, 0.0))
    assert bench.at(Lifecycle.ACTIVE)
    bench.run(0.3, Twist(-0.2, 0.0))
    assert bench.at(Lifecycle.FAULT)
    assert "has not changed" in bench.session.fault
    assert bench.wheels == (0.0, 0.0)
    bench.run(6.0)
    assert bench.at(Lifecycle.FAULT)
    bench.robot.stick(False, bench.clock.now_s())
    bench.run(1.0)
    assert bench.at(Lifecycle.READY)


def test_a_blocked_wheel_is_no_stuck_sensor() -> None:
    bench = Bench().active()
    bench.robot._body = Held()
    bench.run(3.0, GO)
    assert bench.at(Lifecycle.ACTIVE)  # its packets 41 and 42 confirm what it was told


# ---------------------------------------------------------------- dock, battery, extras
def test_docking_ends_on_the_dock() -> None:
    bench = Bench().active()
    bench.dock()
    bench.run(2.0, GO)
    assert bench.at(Lifecycle.ACTIVE)
    assert bench.wheels == (0.2, 0.2)  # its own, not what is commanded
    assert bench.gate.command(GO, bench.clock.now_s()) == STAND
    bench.robot.dock = True
    bench.run(0.1, GO)
    assert bench.at(Lifecycle.READY)
    assert not bench.session.docking
    assert "dock" in bench.session.blocked
    assert bench.wheels == (0.0, 0.0)
    bench.run(1.0)
    power = bench.session.power
    assert power is not None
    assert (power.charging, power.on_dock, power.on_charger) == (Charging.FULL, True, False)
    assert power.current_a == 1.5
    assert power.voltage_v == pytest.approx(15.45, abs=0.01)


def test_a_search_for_the_dock_stops_without_a_commander_or_on_demand() -> None:
    bench = Bench().active()
    bench.dock()
    bench.run(0.25)
    assert bench.wheels != (0.0, 0.0)
    bench.run(0.15)
    assert bench.wheels == (0.0, 0.0)
    assert bench.at(Lifecycle.READY)
    assert "no command came" in bench.session.blocked
    bench.activate()
    bench.dock()
    bench.run(0.1, STAND)
    bench.session.deactivate(bench.clock.now_s())
    bench.run(0.02)
    assert bench.wheels == (0.0, 0.0)
    bench.activate()
    bench.dock()
    with pytest.raises(ValueError, match="must be finite"):
        bench.gate.command(Twist(math.nan, 0.0), bench.clock.now_s())
    bench.run(0.1)
    assert bench.wheels == (0.0, 0.0)
    assert bench.at(Lifecycle.READY)


def test_a_lost_command_to_dock_is_repeated() -> None:
    bench = Bench().active()
    bench.dock()
    bench.wire.clear()
    bench.run(0.2, STAND)
    assert bench.wheels == (0.2, 0.2)


def test_extras_need_an_active_robot() -> None:
    bench = Bench()
    bench.run(0.2)
    with pytest.raises(DriverError, match="cannot sing while READY"):
        bench.session.send(protocol.play(0), "sing")
    with pytest.raises(DriverError, match="cannot look for its dock"):
        bench.dock()
    bench.activate()
    bench.session.send(protocol.leds(1, 2, 3), "light its lamps")
    bench.run(0.05)
    assert bench.robot.panel.led_bits == 1
    bench.dock()
    with pytest.raises(DriverError, match="while looking for its dock"):
        bench.session.send(protocol.play(0), "sing")


def test_a_robot_on_its_charger_tells_of_it() -> None:
    bench = Bench()
    bench.run(0.1)
    assert bench.session.power is not None
    bench.robot.charger = True
    bench.run(0.1)
    power = bench.session.power
    assert power is not None
    assert power.on_charger
    assert power.capacity_ah == 2.696


def test_firmware_names_the_generation_and_the_version_of_a_robot_that_was_heard_starting() -> None:
    bench = Bench()
    assert bench.session.firmware == ""
    bench.run(0.2)
    assert bench.session.firmware == "Open Interface, Create 2"
    bench.robot.reboot(bench.clock.now_s())
    bench.run(0.6)
    assert bench.at(Lifecycle.FAULT)
    bench.run(1.4)
    assert bench.at(Lifecycle.READY)
    assert bench.session.firmware == "Open Interface, Create 2, firmware 3.5.4"


# ---------------------------------------------------------------- asleep and awake
def test_brc_wakes_a_robot() -> None:
    bench = Bench(brc=True)
    bench.robot.receive(protocol.simple(Op.START) + protocol.simple(Op.POWER), 0.0)
    bench.run(0.9)
    assert bench.pulses == [True]
    assert bench.robot_in(Mode.OFF)
    bench.run(2.0)
    assert bench.at(Lifecycle.READY)
    assert bench.pulses == [True, False]


def test_brc_keeps_an_idle_robot_awake() -> None:
    bench = Bench(brc=True)
    bench.run(400.0, step_s=0.05)
    assert bench.at(Lifecycle.READY)
    assert bench.pulses == [True, False] * 6


def test_without_brc_an_idle_robot_is_nudged_and_does_not_move() -> None:
    bench = Bench()
    bench.run(500.0, step_s=0.05)
    assert bench.at(Lifecycle.READY)
    assert bench.robot_in(Mode.PASSIVE)
    assert bench.body.state().rolled_m == 0.0
    told = [command.op for byte in bench.sent if (command := bench.ear.push(byte)) is not None]
    assert told.count(Op.SAFE) == 2


def test_a_robot_on_its_dock_is_not_nudged() -> None:
    bench = Bench()
    bench.robot.dock = True
    bench.run(250.0, step_s=0.05)
    assert bytes([Op.SAFE]) not in bench.sent


def test_a_robot_that_sleeps_without_brc_is_a_fault_that_says_what_to_do() -> None:
    bench = Bench()
    bench.robot.receive(protocol.simple(Op.START) + protocol.simple(Op.POWER), 0.0)
    bench.run(6.0)
    assert bench.at(Lifecycle.FAULT)
    assert "power button" in bench.session.fault


def test_a_line_left_low_is_let_go() -> None:
    bench = Bench(brc=True)
    bench.robot.asleep = True
    bench.run(0.7)
    assert bench.pulses == [True]
    bench.session.lost("unplugged", bench.clock.now_s())
    assert bench.pulses == [True, False]


# ---------------------------------------------------------------- quantised wheels
def test_speeds_in_steps_are_told_as_they_are() -> None:
    bench = Bench(speed_step_mm_s=28.5, quirks=Quirks(speed_quantum_mm_s=28.5)).active()
    applied = bench.gate.command(Twist(0.2, 0.0), bench.clock.now_s())
    bench.run(0.05, Twist(0.2, 0.0))
    assert applied.linear_m_s == pytest.approx(bench.body.state().speed_m_s, abs=0.0006)
    assert applied.linear_m_s == pytest.approx(0.1995, abs=0.0006)
