"""The emulated Create by itself: what it shows, sounds, waits for, counts; sleep, charge, rates. No session."""

from __future__ import annotations

import math

import pytest

from fullswarm.clock import SimClock
from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.protocol import CREATE1, CREATE2, Generation, Mode, Op, Sensors, encoder_delta
from fullswarm.emulators.create_oi.firmware import BOOT_S, SLEEP_S, Firmware, Quirks, happens
from fullswarm.simulation.bodies import BodyState, FreeBody, wheels_rolled

BASE_M = CREATE2.wheel_base_m
PER_COUNT_M = 0.444565e-3


class Bench:
    """A robot on an endless floor in simulated time."""

    def __init__(self, generation: Generation = CREATE2, quirks: Quirks | None = None) -> None:
        self.clock = SimClock()
        self.body = FreeBody(clock=self.clock)
        self.robot = Firmware(generation, self.body, quirks=quirks)
        self.tell(protocol.simple(Op.START))

    def tell(self, *commands: bytes) -> bytes:
        return self.robot.receive(b"".join(commands), self.clock.now_s())

    def go(self, duration_s: float) -> bytes:
        said = b""
        for _ in range(max(1, round(duration_s / 0.015))):
            self.clock.advance_to(self.clock.now_s() + 0.015)
            said += self.robot.step(self.clock.now_s())
        return said

    def ask(self, *ids: int) -> Sensors:
        answer = protocol.decode(ids, self.tell(protocol.query_list(ids)))
        assert answer is not None
        return answer

    def in_mode(self, mode: Mode) -> bool:
        return self.robot.mode is mode

    def asleep(self) -> bool:
        return self.robot.asleep

    def still(self) -> bool:
        state = self.body.state()
        return state.speed_m_s == 0.0 and state.turn_rad_s == 0.0


def test_lamps_and_digits_need_safe_mode() -> None:
    bench = Bench()
    panel = bench.robot.panel
    shows = (
        protocol.leds(5, 128, 255), protocol.digit_leds("OK 1"), protocol.scheduling_leds(3, 4),
        protocol.digit_leds_raw([1, 2, 3, 4]), protocol.motors(3), protocol.motors_pwm(-5, 6, 7),
    )  # fmt: skip
    bench.tell(*shows)
    assert panel.digits == "    "
    assert (panel.led_bits, panel.motor_bits) == (0, 0)
    bench.tell(protocol.simple(Op.SAFE), *shows)
    assert (panel.led_bits, panel.power_colour, panel.power_intensity) == (5, 128, 255)
    assert (panel.digits, panel.segments) == ("OK 1", (1, 2, 3, 4))
    assert (panel.weekday_leds, panel.schedule_leds) == (3, 4)
    assert (panel.motor_bits, panel.motor_pwm) == (3, (-5, 6, 7))
    bench.tell(protocol.simple(Op.START))
    assert panel.motor_bits == 0  # Passive: brushes stop


def test_a_song_is_stored_in_any_mode_and_played_in_safe() -> None:
    bench = Bench()
    bench.tell(protocol.song(2, [(60, 32), (0, 16), (64, 16)]), protocol.play(2))
    assert bench.ask(37).playing == 0
    bench.tell(protocol.simple(Op.SAFE), protocol.play(3), protocol.play(2))
    assert bench.ask(36, 37) == Sensors(song=2, playing=1)
    bench.tell(protocol.play(2))  # while one plays another does nothing
    bench.go(0.9)
    assert bench.ask(37).playing == 1
    bench.go(0.2)
    assert bench.ask(37).playing == 0
    assert bench.robot.panel.played == [2]


def test_buttons_are_let_go_after_a_sixth_of_a_second() -> None:
    bench = Bench()
    bench.tell(protocol.buttons(0b101))
    assert bench.ask(18).buttons == 0b101
    bench.robot.panel.held = 0b1000
    bench.go(0.2)
    assert bench.ask(18).buttons == 0b1000


def test_schedule_and_clock_are_heard_and_change_nothing() -> None:
    bench = Bench()
    assert bench.tell(protocol.schedule(1, [(1, 2)] * 7), protocol.day_time(1, 2, 3), protocol.query(35)) == b"\x01"


def test_distance_and_angle_start_anew_only_when_they_were_asked_for() -> None:
    bench = Bench()
    bench.tell(protocol.simple(Op.SAFE), protocol.drive_direct(250, 350))
    bench.go(0.6)
    angle = math.degrees(0.1 / BASE_M * 0.6)
    assert bench.ask(35).mode == Mode.SAFE
    assert bench.ask(19).distance_mm == 180
    assert bench.ask(19, 20) == Sensors(distance_mm=0, angle_deg=math.trunc(angle))
    assert bench.ask(20).angle_deg == 0


def test_distance_saturates() -> None:
    bench = Bench()
    bench.body.push(-40.0, 0.0)  # counted up: the encoders cannot tell
    assert bench.ask(19).distance_mm == 32767


@pytest.mark.parametrize(("scale", "angle"), [(1.0, 56), (0.324056, 18)])
def test_old_firmware_reports_a_third_of_the_angle(scale: float, angle: int) -> None:
    bench = Bench(quirks=Quirks(angle_scale=scale, distance_scale=0.5))
    bench.tell(protocol.simple(Op.SAFE), protocol.drive_direct(100, 335))
    bench.go(0.99)  # 1 rad/s
    assert bench.ask(19, 20) == Sensors(distance_mm=107, angle_deg=angle)


def test_wheel_speeds_are_rounded_where_the_firmware_does() -> None:
    bench = Bench(quirks=Quirks(speed_quantum_mm_s=28.5))
    bench.tell(protocol.simple(Op.SAFE), protocol.drive_direct(100, 100))
    assert bench.body.state().speed_m_s == pytest.approx(0.114)
    assert bench.ask(42).left_mm_s == 100


def test_cleaning_and_docking_move_it_in_passive_mode_and_start_ends_them() -> None:
    for op in (Op.SPOT, Op.CLEAN, Op.MAX, Op.DOCK):
        bench = Bench()
        bench.tell(protocol.simple(Op.SAFE), protocol.simple(op))
        assert bench.in_mode(Mode.PASSIVE)
        assert not bench.still()
        bench.tell(protocol.simple(Op.START))
        assert bench.still()
    bench.tell(protocol.simple(Op.DOCK))
    bench.robot.dock = True
    bench.go(0.1)
    assert bench.still()
    assert bench.ask(34).chargers == 0b10


def test_it_charges_in_passive_mode_only_and_stops_when_full() -> None:
    bench = Bench()
    bench.robot.dock = True
    battery = bench.robot.battery
    battery.charge_mah = 1000.0
    bench.go(36.0)
    assert battery.charge_mah == pytest.approx(1015.0, abs=0.1)
    assert bench.ask(21, 23).charging_state == 2
    bench.tell(protocol.simple(Op.SAFE))
    bench.go(36.0)
    assert battery.charge_mah == pytest.approx(1012.0, abs=0.1)
    assert bench.ask(21, 23) == Sensors(charging_state=0, current_ma=-300)
    bench.tell(protocol.simple(Op.START))
    battery.charge_mah = 2696.0
    bench.go(1.0)
    assert bench.ask(21, 25, 26) == Sensors(charging_state=3, charge_mah=2696, capacity_mah=2696)


def test_it_falls_asleep_in_passive_mode_and_brc_keeps_or_makes_it_awake() -> None:
    bench = Bench()
    bench.tell(protocol.stream([35]))
    bench.go(SLEEP_S - 1.0)
    bench.robot.brc(bench.clock.now_s())
    bench.go(SLEEP_S - 1.0)
    assert not bench.asleep()
    assert bench.go(0.1)
    bench.go(2.0)
    assert bench.asleep()
    assert bench.tell(protocol.simple(Op.START), protocol.query(35)) == b""
    assert not bench.go(1.0)
    bench.robot.brc(bench.clock.now_s())
    assert b"release-3.5.4" in bench.go(BOOT_S + 0.1)
    assert bench.tell(protocol.simple(Op.START), protocol.query(35)) == b"\x01"
    bench.tell(protocol.simple(Op.SAFE))
    bench.go(2.0 * SLEEP_S)
    assert not bench.asleep()


def test_power_off_is_sleep() -> None:
    bench = Bench()
    bench.tell(protocol.simple(Op.POWER), protocol.simple(Op.START))
    assert bench.asleep()


def test_the_rate_changes_until_a_restart() -> None:
    bench = Bench()
    bench.tell(protocol.baud(19200), bytes([Op.BAUD, 99]))
    assert bench.robot.baud == 19200
    bench.robot.reboot(0.0)
    assert bench.robot.baud == 115200


def test_a_restart_forgets_counts_and_stops() -> None:
    bench = Bench()
    bench.tell(protocol.simple(Op.SAFE), protocol.drive_direct(300, 300))
    bench.go(1.0)
    bench.robot.reboot(bench.clock.now_s())
    assert bench.still()
    bench.go(BOOT_S + 0.1)
    bench.tell(protocol.simple(Op.START))
    assert bench.ask(43).encoder_left == 0


def test_stuck_sensors_tell_old_values() -> None:
    bench = Bench()
    bench.tell(protocol.simple(Op.SAFE), protocol.drive_direct(300, 300))
    bench.robot.stick(True, bench.clock.now_s())
    bench.go(1.0)
    assert bench.ask(43).encoder_left == 0
    bench.robot.stick(False, bench.clock.now_s())
    assert bench.ask(43).encoder_left == pytest.approx(300 / 0.444565, abs=12)


# ---------------------------------------------------------------- the Create 1
def test_waits_block_everything_until_they_are_over() -> None:
    bench = Bench(CREATE1)
    bench.tell(protocol.simple(Op.FULL), protocol.drive(200, None), protocol.stream([35]))
    bench.tell(protocol.wait_distance(300), protocol.drive(0, None), protocol.query(39))
    assert not bench.go(1.0)
    assert not bench.still()
    assert bench.go(0.6)
    assert bench.still()
    assert bench.body.state().rolled_m == pytest.approx(0.3, abs=0.005)
    bench.tell(protocol.drive(100, -1), protocol.wait_angle(-45), protocol.drive(0, None))
    bench.go(3.0)
    assert bench.body.state().turned_rad == pytest.approx(-math.pi / 4, abs=0.02)
    bench.tell(protocol.create1_byte(Op.WAIT_TIME, 10))
    assert not bench.go(0.9)
    assert bench.go(0.2)


def test_an_event_ends_a_wait() -> None:
    bench = Bench(CREATE1)
    bench.tell(protocol.create1_byte(Op.WAIT_EVENT, 5), protocol.query(35))
    bench.go(1.0)
    bench.body.press(True, False)
    assert bench.go(0.03) == b"\x01"


def test_events() -> None:
    assert happens(6, {"bumps_drops": 0b10})
    assert not happens(7, {"bumps_drops": 0b10})
    assert happens(256 - 7, {"bumps_drops": 0b10})
    assert happens(1, {"bumps_drops": 0b10000})
    assert happens(10, {"cliff_right": 1})
    assert not happens(10, {})
    assert happens(17, {"buttons": 1})
    assert happens(22, {"mode": 1})
    assert not happens(22, {"mode": 2})
    assert happens(100, {})  # no such event: a robot that waited for it would be lost


def test_a_script_plays_and_shows_and_may_play_itself() -> None:
    bench = Bench(CREATE1)
    bench.tell(protocol.simple(Op.FULL))
    lines = protocol.drive(100, None) + protocol.create1_byte(Op.WAIT_TIME, 5) + protocol.drive(-100, None)
    lines += protocol.create1_byte(Op.WAIT_TIME, 5) + protocol.simple(Op.PLAY_SCRIPT)
    bench.tell(protocol.script(lines))
    assert bench.still()
    assert bench.tell(protocol.simple(Op.SHOW_SCRIPT)) == bytes([len(lines)]) + lines
    bench.tell(protocol.simple(Op.PLAY_SCRIPT))
    speeds = []
    for _ in range(4):
        bench.go(0.3)
        speeds.append(bench.body.state().speed_m_s)
        bench.go(0.225)
    assert speeds == [0.1, -0.1, 0.1, -0.1]


def test_outputs_and_infrared_of_a_create1() -> None:
    bench = Bench(CREATE1)
    bench.tell(protocol.simple(Op.SAFE), protocol.create1_byte(Op.DIGITAL_OUTPUTS, 5))
    bench.tell(protocol.create1_byte(Op.SEND_IR, 200))
    assert (bench.robot.panel.digital_outputs, bench.robot.panel.infrared) == (5, 200)


# ---------------------------------------------------------------- encoders on a body that moves in steps
class SteppedBody:
    """A body of the simulated world: moves 5 ms at a time, and what it is told counts from the next step on."""

    def __init__(self) -> None:
        self._told = self._moving = (0.0, 0.0)
        self._rolled_m = self._turned_rad = 0.0

    def drive(self, speed_m_s: float, turn_rad_s: float) -> None:
        self._told = speed_m_s, turn_rad_s

    def step(self) -> None:
        self._rolled_m += 0.005 * self._moving[0]
        self._turned_rad += 0.005 * self._moving[1]
        self._moving = self._told

    def state(self) -> BodyState:
        return BodyState(rolled_m=self._rolled_m, turned_rad=self._turned_rad)


def test_counts_keep_their_sign_while_a_wheel_runs_out() -> None:
    body = SteppedBody()
    robot = Firmware(CREATE2, body)
    robot.receive(bytes([Op.START, Op.SAFE]), 0.0)
    now_s = 0.0
    for round_ in range(200):
        wheels = ((-400, -400), (0, 0), (-300, 300), (300, -300))[round_ % 4]
        robot.receive(protocol.drive_direct(*wheels), now_s)
        for _ in range(60):
            now_s += 0.005
            body.step()
            robot.step(now_s)
    answer = protocol.decode([43, 44], robot.receive(protocol.query_list([43, 44]), now_s))
    assert answer is not None
    assert answer.encoder_left is not None
    assert answer.encoder_right is not None
    left_m, right_m = wheels_rolled(body.state(), BASE_M)
    assert encoder_delta(answer.encoder_left, math.floor(left_m / PER_COUNT_M) & 0xFFFF) in (-1, 0, 1)
    assert encoder_delta(answer.encoder_right, math.floor(right_m / PER_COUNT_M) & 0xFFFF) in (-1, 0, 1)


def test_cliff_signals_are_high_over_floor_and_fall_where_it_is_gone() -> None:
    bench = Bench()
    assert all(signal > 1000 for signal in cliff_signals(bench))
    bench.robot.cliffs[1] = True
    left, front_left, front_right, right = cliff_signals(bench)
    assert front_left < 100
    assert min(left, front_right, right) > 1000


def cliff_signals(bench: Bench) -> list[int]:
    told = bench.ask(28, 29, 30, 31)
    signals = (
        told.cliff_left_signal, told.cliff_front_left_signal, told.cliff_front_right_signal, told.cliff_right_signal,
    )  # fmt: skip
    return [signal for signal in signals if signal is not None]


@pytest.mark.parametrize("op", [Op.SAFE, Op.CONTROL])
def test_entering_safe_mode_switches_the_lamps_off(op: Op) -> None:
    bench = Bench()
    panel = bench.robot.panel
    shows = protocol.leds(5, 128, 255), protocol.digit_leds("OK 1"), protocol.scheduling_leds(3, 4)
    bench.tell(protocol.simple(Op.SAFE), *shows, protocol.simple(Op.FULL))
    assert (panel.led_bits, panel.power_intensity, panel.digits) == (5, 255, "OK 1")
    bench.tell(protocol.simple(op))
    assert (panel.led_bits, panel.power_colour, panel.power_intensity) == (0, 0, 0)
    assert (panel.digits, panel.weekday_leds, panel.schedule_leds) == ("    ", 0, 0)


@pytest.mark.parametrize(
    ("velocity", "radius", "told"),
    [
        (900, 5000, (500, 2000)),
        (-900, -5000, (-500, -2000)),
        (200, -32768, (200, -32768)),
        (200, 32767, (200, 32767)),
        (200, 1, (200, 1)),
    ],
)
def test_requested_velocity_and_radius_are_told_within_their_ranges(
    velocity: int, radius: int, told: tuple[int, int]
) -> None:
    bench = Bench()
    drive = bytes([Op.DRIVE]) + velocity.to_bytes(2, "big", signed=True) + radius.to_bytes(2, "big", signed=True)
    bench.tell(protocol.simple(Op.SAFE), drive)
    sensors = bench.ask(39, 40)
    assert (sensors.velocity_mm_s, sensors.radius_mm) == told


def test_walls_and_light_bumper_set_bits_by_their_signals() -> None:
    bench = Bench()
    around = bench.robot.surroundings
    assert bench.ask(8, 27, 45) == Sensors(wall=0, wall_signal=0, light_bumper=0)
    around.wall_signal, around.light_signals = 700, (0, 20, 900, 0, 0, 3000)
    assert bench.ask(8, 27) == Sensors(wall=1, wall_signal=700)
    sensors = bench.ask(106, 45)
    assert sensors.light_bumper == 0b100100
    assert (sensors.light_front_left, sensors.light_centre_left, sensors.light_right) == (20, 900, 3000)


@pytest.mark.parametrize(("generation", "nothing", "wall"), [(CREATE2, 0, 162), (CREATE1, 255, 255)])
def test_infrared_bytes_and_virtual_walls(generation: Generation, nothing: int, wall: int) -> None:
    bench = Bench(generation)
    around = bench.robot.surroundings
    assert bench.ask(13, 17) == Sensors(virtual_wall=0, ir_omni=nothing)
    around.virtual_wall = True
    assert bench.ask(13, 17) == Sensors(virtual_wall=1, ir_omni=wall)
    around.infrared = 172, 168, 164
    assert bench.ask(17).ir_omni == 172
    if generation is CREATE2:
        assert bench.ask(52, 53) == Sensors(ir_left=168, ir_right=164)


def test_the_clean_button_sets_it_going_in_passive_mode_only() -> None:
    bench = Bench()
    bench.robot.panel.held = 0b1
    bench.go(0.1)
    assert not bench.still()
    bench.robot.panel.held = 0
    bench.go(0.1)
    assert not bench.still()
    bench.robot.panel.held = 0b1  # pressed again: it stops
    bench.go(0.1)
    assert bench.still()
    bench.robot.panel.held = 0
    bench.tell(protocol.simple(Op.SAFE))
    bench.go(0.1)
    bench.robot.panel.held = 0b1
    bench.go(0.1)
    assert bench.still()
    assert bench.ask(18).buttons == 0b1
