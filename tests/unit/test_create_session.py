"""The Create's session against its firmware, in simulated time over a perfect or a bad wire; no port, no thread."""

from __future__ import annotations

import math
import random

import pytest

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Pose, Twist
from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.protocol import CREATE1, CREATE2, ROOMBA500, Generation, Mode, Op
from fullswarm.drivers.create_oi.senses import stream_ids, wheel_speeds
from fullswarm.drivers.create_oi.session import CALM_S, REPEAT_S, Session
from fullswarm.drivers.create_oi.settings import Settings
from fullswarm.emulators.create_oi.firmware import BOOT_S, Quirks
from fullswarm.simulation.bodies import BodyState
from tests.unit.create_bench import GO, Bench, Held


def close_to(told: Pose, true: BodyState, way_m: float) -> bool:
    off_m = math.hypot(told.x_m - true.x_m, told.y_m - true.y_m)
    return off_m < 0.01 * way_m and abs(math.remainder(told.heading_rad - true.heading_rad, math.tau)) < 0.02


@pytest.mark.parametrize("generation", [CREATE1, ROOMBA500, CREATE2])
def test_every_generation_connects_and_becomes_active(generation: Generation) -> None:
    bench = Bench(generation)
    assert bench.at(Lifecycle.OPEN)
    bench.run(0.2)
    assert bench.at(Lifecycle.READY)
    assert bench.robot_in(Mode.PASSIVE)
    bench.run(0.1, GO)
    assert bench.wheels == (0.0, 0.0)  # READY cannot move
    bench.activate()
    assert bench.robot_in(Mode.SAFE)
    assert bench.wheels == (0.0, 0.0)
    bench.run(0.1, GO)
    assert bench.wheels[0] > 0.0
    ear = protocol.CommandParser(generation)
    told = {command.op for byte in bench.sent if (command := ear.push(byte)) is not None}
    assert told == {Op.START, Op.STREAM, Op.SAFE, Op.DRIVE_DIRECT}


@pytest.mark.parametrize("generation", [CREATE1, ROOMBA500, CREATE2])
@pytest.mark.parametrize("twist", [Twist(0.3, 0.0), Twist(-0.3, 0.0), Twist(0.25, 0.9), Twist(-0.2, -1.1)])
def test_odometry_follows_the_body_across_the_wrap(generation: Generation, twist: Twist) -> None:
    bench = Bench(generation, encoders=(65500, 30)).active()
    bench.run(5.0, twist)
    assert bench.reading.twist.linear_m_s == pytest.approx(twist.linear_m_s, abs=0.012)
    assert bench.reading.twist.angular_rad_s == pytest.approx(twist.angular_rad_s, abs=0.7)
    bench.session.deactivate(bench.clock.now_s())
    bench.run(0.1)
    assert close_to(bench.reading.odometry, bench.body.state(), 5.0 * abs(twist.linear_m_s))


def test_a_command_expires_and_the_session_stays_active() -> None:
    bench = Bench().active()
    bench.run(0.2, GO)
    bench.run(0.25)
    assert bench.wheels != (0.0, 0.0)
    bench.run(0.1)
    assert bench.wheels == (0.0, 0.0)
    assert bench.at(Lifecycle.ACTIVE)


def test_a_lost_command_is_repeated_until_confirmed() -> None:
    bench = Bench().active()
    bench.gate.command(GO, bench.clock.now_s())
    bench.wire.clear()
    bench.run(0.2, GO)
    assert bench.wheels != (0.0, 0.0)
    bench.gate.command(STAND, bench.clock.now_s())
    bench.wire.clear()
    bench.run(0.2)
    assert bench.wheels == (0.0, 0.0)


@pytest.mark.parametrize("generation", [CREATE1, ROOMBA500, CREATE2])
def test_a_lost_stop_is_repeated_where_a_slow_stream_cannot_confirm_it(generation: Generation) -> None:
    bench = Bench(generation, baud=19200).active()
    bench.run(0.5, GO)
    assert bench.wheels != (0.0, 0.0)
    bench.gate.command(STAND, bench.clock.now_s())
    bench.wire.clear()
    bench.run(REPEAT_S + 0.03, STAND)  # the next frame after it
    assert bench.wheels == (0.0, 0.0)
    bench.run(3.0, GO)  # and nothing is taken for a stuck sensor
    assert bench.at(Lifecycle.ACTIVE)
    bench.robot._body = Held()
    bench.run(3.0, GO)
    assert bench.at(Lifecycle.ACTIVE)


@pytest.mark.parametrize(("baud", "least", "most"), [(115200, 1, 4), (57600, 1, 4), (19200, 10, 17)])
def test_a_set_point_takes_little_of_the_wire(baud: int, least: int, most: int) -> None:
    bench = Bench(baud=baud).active()
    bench.sent.clear()
    bench.run(1.0, GO)
    told = bench.sent.count(protocol.drive_direct(*wheel_speeds(GO, CREATE2.wheel_base_m)))
    assert least <= told <= most


def test_a_robot_left_driving_is_stopped_by_the_greeting() -> None:
    bench = Bench()
    bench.robot.receive(protocol.simple(Op.START) + protocol.simple(Op.FULL) + protocol.drive_direct(200, 200), 0.0)
    assert bench.wheels == (0.2, 0.2)
    bench.run(0.02)
    assert bench.wheels == (0.0, 0.0)
    bench.run(0.2)
    assert bench.at(Lifecycle.READY)


def test_a_robot_that_waits_for_data_is_reached_in_the_end() -> None:
    bench = Bench()
    bench.robot.receive(bytes([Op.START, Op.SONG, 0, 16]), 0.0)
    bench.run(2.5)
    assert bench.at(Lifecycle.READY)


def test_a_cliff_stops_the_robot_and_bars_it_while_it_lasts() -> None:
    bench = Bench().active()
    bench.run(0.2, GO)
    bench.robot.cliffs[1] = True
    bench.run(0.02, GO)
    assert bench.wheels == (0.0, 0.0)
    assert bench.at(Lifecycle.READY)
    assert Hazard.CLIFF in bench.reading.hazards
    assert "cliff" in bench.session.blocked
    bench.run(0.5)
    bench.activate()
    assert bench.at(Lifecycle.READY)
    assert bench.robot_in(Mode.PASSIVE)
    bench.robot.cliffs[1] = False
    bench.run(0.3)
    assert bench.reading.hazards is Hazard.NONE
    bench.activate()
    assert bench.at(Lifecycle.ACTIVE)
    assert bench.wheels == (0.0, 0.0)


def test_a_blip_of_one_frame_is_still_told() -> None:
    bench = Bench().active()
    bench.robot.drops[0] = True
    bench.run(0.02)
    bench.robot.drops[0] = False
    bench.run(0.1)
    assert Hazard.WHEEL_DROP in bench.reading.hazards


def fallen() -> Bench:
    """Return a bench whose robot has just fallen for the third time, and hangs no more."""
    bench = Bench().active()
    for fall in range(3):
        bench.robot.drops[1] = True
        bench.run(0.1)
        bench.robot.drops[1] = False
        bench.run(0.4)
        assert bench.at(Lifecycle.FAULT if fall == 2 else Lifecycle.READY)
        bench.activate()
    return bench


def test_three_falls_are_forgiven_after_ten_calm_seconds() -> None:
    bench = fallen()
    assert "safe ground" in bench.session.fault
    bench.run(CALM_S - 3.0, GO)
    bench.activate()
    assert bench.at(Lifecycle.FAULT)
    bench.robot.cliffs[0] = True  # somebody takes it into his hands: the time begins anew
    bench.run(1.0)
    bench.robot.cliffs[0] = False
    bench.run(CALM_S - 1.0, GO)
    assert bench.at(Lifecycle.FAULT)
    bench.run(1.5, GO)
    assert bench.at(Lifecycle.READY)  # and no further: nobody has asked for motion
    assert bench.session.fault == ""
    assert bench.wheels == (0.0, 0.0)
    bench.activate()
    bench.run(0.1, GO)
    assert bench.wheels[0] > 0.0
    bench.robot.drops[1] = True
    bench.run(0.1)
    assert bench.at(Lifecycle.READY)  # it counts from one again


def test_silence_is_no_calm() -> None:
    bench = fallen()
    bench.run(5.0)
    bench.cut = True
    bench.run(8.0)
    bench.cut = False
    bench.run(8.0)
    assert bench.at(Lifecycle.FAULT)
    assert "3 times" in bench.session.fault
    bench.run(3.5)
    assert bench.at(Lifecycle.READY)


def test_three_falls_in_ten_seconds_are_a_fault_that_a_reconnect_does_not_clear() -> None:
    bench = fallen()
    assert "3 times" in bench.session.fault
    assert bench.robot_in(Mode.PASSIVE)
    bench.session.lost("unplugged", bench.clock.now_s())
    bench.session.linked(bench.clock.now_s())
    bench.run(0.3)
    assert bench.at(Lifecycle.FAULT)
    assert "3 times" in bench.session.fault


def test_falls_far_apart_are_no_fault() -> None:
    bench = Bench().active()
    for _ in range(4):
        bench.robot.drops[1] = True
        bench.run(0.1)
        bench.robot.drops[1] = False
        bench.run(5.0)
        bench.activate()
    assert bench.at(Lifecycle.ACTIVE)


def test_silence_is_a_fault_that_mends_itself_but_never_to_active() -> None:
    bench = Bench().active()
    bench.run(0.2, GO)
    bench.cut = True
    bench.run(0.6, GO)
    assert bench.at(Lifecycle.FAULT)
    assert "silent" in bench.session.fault
    assert bench.wheels == (0.0, 0.0)  # the way to the robot still works: it was told to stop
    assert bench.gate.command(GO, bench.clock.now_s()) == STAND
    bench.cut = False
    bench.run(1.0, GO)
    assert bench.at(Lifecycle.READY)
    assert bench.session.fault == ""
    assert bench.robot_in(Mode.PASSIVE)


def test_hazards_contacts_and_battery_are_told() -> None:
    bench = Bench().active()
    bench.body.press(True, False)
    bench.robot.overcurrents = 0b01000
    bench.robot.battery.charge_mah = 200.0
    bench.run(0.05)
    assert bench.reading.hazards == Hazard.BUMP | Hazard.OVERCURRENT | Hazard.BATTERY_LOW
    assert bench.reading.contacts == 1
    assert bench.reading.battery == pytest.approx(200 / 2696)
    assert bench.at(Lifecycle.ACTIVE)  # a bump leaves the mode alone


def test_no_answer_and_noise_are_told_apart() -> None:
    deaf = Session(Settings("bench"))
    deaf.linked(0.0)
    noisy = Session(Settings("bench"))
    noisy.linked(0.0)
    for step in range(1200):
        deaf.tick(step * 0.005)
        noisy.received(b"\x55\xaa", step * 0.005)
        noisy.tick(step * 0.005)
    assert deaf.state is Lifecycle.FAULT
    assert "no answer" in deaf.fault
    assert "baud" in noisy.fault


def test_firmware_defects() -> None:
    shifted = Bench(quirks=Quirks(mode_offset=1), mode_offset=1).active()
    shifted.run(0.1, GO)
    assert shifted.wheels != (0.0, 0.0)
    unknown = Bench(quirks=Quirks(mode_offset=1))
    unknown.run(6.0)
    assert unknown.at(Lifecycle.FAULT)
    assert "mode_offset" in unknown.session.fault
    deaf = Bench(quirks=Quirks(deaf_to_safe=True))
    deaf.run(0.2)
    deaf.activate()
    deaf.run(0.6)
    assert deaf.at(Lifecycle.READY)
    assert "Safe" in deaf.session.blocked
    Bench(CREATE1, quirks=Quirks(header_in_sum=False)).active()
    Bench(baud=19200).active()


def test_an_activation_is_withdrawn() -> None:
    bench = Bench()
    bench.run(0.2)
    bench.session.activate(bench.clock.now_s())
    bench.run(0.015)
    bench.session.deactivate(bench.clock.now_s())
    bench.run(0.5)
    assert bench.at(Lifecycle.READY)
    assert bench.robot_in(Mode.PASSIVE)


def test_a_late_frame_does_not_confirm_a_new_activation() -> None:
    bench = Bench().active()
    now_s = bench.clock.now_s()
    late = protocol.frame(stream_ids(CREATE2, CREATE2.baud), {"mode": Mode.SAFE})
    bench.session.deactivate(now_s)
    bench.session.activate(now_s)
    bench.session.received(late + late, now_s)
    assert bench.at(Lifecycle.READY)
    bench.run(0.1)
    assert bench.at(Lifecycle.ACTIVE)


def test_a_charger_bars_the_robot() -> None:
    bench = Bench().active()
    bench.robot.charger = True
    bench.run(0.1, GO)
    assert bench.at(Lifecycle.READY)
    bench.activate()
    assert "charger" in bench.session.blocked


def test_the_firmware_answers_queries_and_counts_up_when_pushed() -> None:
    bench = Bench()
    robot, body = bench.robot, bench.body
    assert robot.receive(protocol.query(100), 0.0) == b""  # off
    robot.receive(protocol.simple(Op.START), 0.0)
    body.push(-0.06690703, -0.0444565 / 0.235)  # 100.5 counts left, 200.5 right, both backwards
    answer = protocol.decode([100], robot.receive(protocol.query(100), 0.0))
    assert answer is not None
    assert (answer.encoder_left, answer.encoder_right) == (100, 200)
    assert answer.mode == Mode.PASSIVE
    answer = protocol.decode([20, 35], robot.receive(protocol.query_list([20, 35]), 0.0))
    assert answer is not None
    assert answer.angle_deg == 0
    robot.receive(protocol.drive_direct(100, 100), 0.0)
    assert bench.wheels == (0.0, 0.0)  # Passive
    robot.receive(protocol.simple(Op.SAFE) + protocol.drive(200, -1), 0.0)
    assert bench.wheels == (0.2, -0.2)
    robot.receive(protocol.drive(200, 235), 0.0)
    assert bench.wheels == (0.1, 0.3)
    robot.receive(protocol.drive_pwm(0, 255), 0.0)
    assert bench.wheels == (0.0, 0.5)
    robot.receive(protocol.simple(Op.RESET), 0.0)
    assert robot.mode is Mode.OFF
    assert bench.wheels == (0.0, 0.0)
    assert robot.receive(protocol.simple(Op.START) + protocol.query(35), 0.5) == b""  # starting
    assert b"release-3" in robot.step(BOOT_S)
    assert robot.receive(protocol.simple(Op.START) + protocol.query(35), BOOT_S) == b"\x01"


def test_a_cliff_behind_matters_only_in_place_and_full_mode_ignores_all() -> None:
    bench = Bench()
    robot = bench.robot
    robot.receive(protocol.simple(Op.START) + protocol.simple(Op.SAFE) + protocol.drive_direct(-200, -200), 0.0)
    robot.cliffs[0] = True
    robot.step(0.01)
    assert bench.robot_in(Mode.SAFE)
    robot.receive(protocol.drive_direct(-200, -20), 0.0)
    robot.step(0.02)
    assert bench.robot_in(Mode.PASSIVE)
    robot.receive(protocol.simple(Op.FULL) + protocol.drive_direct(200, 200), 0.0)
    robot.drops[0] = True
    robot.step(0.03)
    assert bench.robot_in(Mode.FULL)


@pytest.mark.parametrize("baud", [115200, 19200])
def test_a_bad_wire_cannot_keep_the_robot_driving(baud: int) -> None:
    bench = Bench(baud=baud).active()
    luck = random.Random(11)
    bench.carry = lambda data: bench.wire.extend(data if luck.random() < 0.5 else b"")
    for round_ in range(20):
        bench.run(0.3, Twist(luck.uniform(-0.5, 0.5), luck.uniform(-2.0, 2.0)))
        bench.session.received(luck.randbytes(5), bench.clock.now_s())
        bench.run(1.5)
        assert bench.wheels == (0.0, 0.0), round_
        assert bench.at(Lifecycle.ACTIVE)


def driven_into_a_gap(gap_s: float, generation: Generation = CREATE2, *, pulled: bool, start: int = 300) -> Bench:
    """Drive a robot, lose it for a while, and have it back."""
    bench = Bench(generation, encoders=(start, start)).active()
    bench.run(1.0, GO)
    bench.cut, bench.pulled = not pulled, pulled
    bench.run(gap_s, GO)
    bench.cut = bench.pulled = False
    bench.run(1.0)
    assert bench.at(Lifecycle.READY)
    return bench


@pytest.mark.parametrize("generation", [ROOMBA500, CREATE2])
@pytest.mark.parametrize(("gap_s", "pulled"), [(0.7, False), (0.7, True), (3.0, True)])
def test_odometry_holds_what_the_robot_drove_while_nobody_heard_it(
    generation: Generation, gap_s: float, pulled: bool
) -> None:
    bench = driven_into_a_gap(gap_s, generation, pulled=pulled, start=65000)  # and its counts wrap meanwhile
    state = bench.body.state()
    assert state.rolled_m > 0.3 + 0.3 * min(gap_s, 0.5)
    assert close_to(bench.reading.odometry, state, state.rolled_m)
    assert bench.reading.odometry_breaks == 0
    assert bench.reading.twist.linear_m_s == 0.0


def test_a_restart_in_a_gap_is_a_break_in_the_odometry_and_no_motion() -> None:
    bench = Bench().active()
    bench.run(1.0, GO)
    before, state = bench.reading.odometry, bench.body.state()
    bench.robot.reboot(bench.clock.now_s())
    bench.run(3.0)
    assert bench.at(Lifecycle.READY)
    assert bench.session.firmware.endswith("3.5.4")  # its text has been heard
    assert bench.reading.odometry_breaks == 1
    assert bench.reading.odometry == before
    bench.pulled = True
    bench.robot.reboot(bench.clock.now_s())
    bench.run(3.0)  # its text goes into the void
    bench.pulled = False
    bench.run(1.0)
    assert bench.at(Lifecycle.READY)
    assert bench.reading.odometry == before
    assert close_to(before, state, state.rolled_m)


def test_counts_that_began_anew_in_the_dark_are_a_break_and_no_way_back() -> None:
    bench = Bench().active()
    bench.run(1.0, GO)  # 700 counts: as far back as it may have driven in the gap
    before = bench.reading.odometry
    bench.pulled = True
    bench.robot.reboot(bench.clock.now_s())
    bench.run(3.0)
    bench.pulled = False
    bench.run(1.0)
    assert bench.at(Lifecycle.READY)
    assert bench.reading.odometry_breaks == 1
    assert bench.reading.odometry == before


def test_a_gap_in_which_the_counts_may_have_wrapped_is_a_break() -> None:
    bench = driven_into_a_gap(40.0, pulled=True)
    assert bench.reading.odometry_breaks == 1
    standing = Bench().active()
    standing.run(1.0, GO)
    standing.session.deactivate(standing.clock.now_s())
    standing.run(0.1)
    standing.pulled = True
    standing.run(40.0)
    standing.pulled = False
    standing.run(1.0)
    assert standing.reading.odometry_breaks == 0  # it stood, and its counts say so


def test_a_create_1_forgets_what_it_has_told_nobody() -> None:
    bench = driven_into_a_gap(0.7, CREATE1, pulled=True)
    assert bench.reading.odometry_breaks == 1
