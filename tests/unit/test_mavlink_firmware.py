"""The emulated firmware against what was measured on the real one: boot, rates, failsafes, whom it believes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.clock import SimClock
from fullswarm.drivers.base import Pose
from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.drivers.mavlink.protocol import Mode
from fullswarm.emulators.mavlink.firmware import REAL_BOOT_S, Firmware
from fullswarm.simulation.bodies import FreeBody
from tests.unit.mavlink_wire import COMPANION, STATION, STRANGER, Wire

WITHIN = 0.15


# ---------------------------------------------------------------- boot and restart
def test_boot_as_measured() -> None:
    wire = Wire(boot_s=REAL_BOOT_S, settle_s=0.0)
    assert wire.until(lambda: bool(wire.of("HEARTBEAT"))) == pytest.approx(1.03, abs=0.05)
    assert wire.frames[0][1].startswith(b"Init Gyro**")
    beat = wire.of("HEARTBEAT")[0]
    assert (beat.type, beat.autopilot, beat.base_mode, beat.custom_mode, beat.system_status) == (10, 3, 65, 16, 2)
    assert wire.frames[1][1][0] == 0xFD
    wire.run(0.1)
    assert wire.command(176, 1, Mode.GUIDED) == 0  # proves nothing
    assert wire.command(400, 1) == 4
    wire.run(2.0)
    assert wire.rover.mode == Mode.MANUAL
    assert wire.text_s("Flight mode change failed") - wire.began_s == pytest.approx(1.7, abs=0.1)
    assert wire.text_s("ArduPilot Ready") - wire.began_s == pytest.approx(2.4, abs=0.05)
    assert not wire.of("LOCAL_POSITION_NED")
    wire.run(36.0)
    assert wire.command(400, 1) == 4
    wire.until(lambda: wire.command(400, 1) == 0)
    assert wire.now_s - wire.began_s == pytest.approx(42.4, abs=0.1)
    reasons = {text.removeprefix("Arm: ") for text in wire.texts if text.startswith("Arm:")}
    assert reasons == {"System not initialised", "AHRS: not using configured AHRS type"}
    assert wire.of("LOCAL_POSITION_NED")
    for text, at_s in (("EKF3 IMU0 origin set", 19.9), ("EKF3 IMU0 is using GPS", 41.9), ("AHRS: EKF3 active", 41.9)):
        assert wire.text_s(text) - wire.began_s == pytest.approx(at_s, abs=0.05)


def test_reboot_forgets_rates_mode_and_arming_but_not_parameters() -> None:
    wire = Wire(boot_s=REAL_BOOT_S, settle_s=43.0)
    wire.send("PARAM_SET", 1, 1, b"FS_GCS_ENABLE", 1.0, 2)
    assert wire.command(511, 30, 50_000) == 0
    assert wire.count(1.0)["ATTITUDE"] in (20, 21)
    before_s, stamp = wire.now_s, wire.of("ATTITUDE")[-1].time_boot_ms
    assert wire.command(246, 1) == 0
    heard = len(wire.heard)
    wire.run(0.5)
    assert len(wire.heard) > heard  # still talking
    wire.until(lambda: wire.rover.mode == Mode.INITIALISING)
    assert wire.now_s - before_s == pytest.approx(0.66, abs=0.06)
    heard = len(wire.heard)
    wire.until(lambda: len(wire.heard) > heard)
    assert wire.now_s - before_s == pytest.approx(1.23, abs=0.06)
    wire.run(2.0)
    assert wire.of("ATTITUDE")[-1].time_boot_ms < stamp
    assert wire.count(4.0)["ATTITUDE"] == 4
    assert wire.rover.parameters["FS_GCS_ENABLE"] == 1.0


# ---------------------------------------------------------------- streams
DEFAULTS = [
    "HEARTBEAT",
    "AHRS",
    "AHRS2",
    "ATTITUDE",
    "GLOBAL_POSITION_INT",
    "LOCAL_POSITION_NED",
    "VFR_HUD",
    "SYS_STATUS",
    "POWER_STATUS",
    "MEMINFO",
    "MISSION_CURRENT",
    "SERVO_OUTPUT_RAW",
    "RC_CHANNELS",
    "RC_CHANNELS_SCALED",
    "RAW_IMU",
    "SCALED_IMU2",
    "SCALED_IMU3",
    "SCALED_PRESSURE",
    "SCALED_PRESSURE2",
    "GPS_RAW_INT",
    "SYSTEM_TIME",
    "SIMSTATE",
    "EKF_STATUS_REPORT",
    "VIBRATION",
    "BATTERY_STATUS",
]


def test_everything_once_a_second_until_asked() -> None:
    wire = Wire()
    counts = wire.count(20.0)
    assert {name: counts.pop(name) for name in DEFAULTS} == dict.fromkeys(DEFAULTS, 20)
    assert counts == {"TIMESYNC": 2}
    size = sum(len(frame) for port, frame in wire.frames if port == 0) / 20.5
    assert size == pytest.approx(867, rel=WITHIN)
    wire.command(176, 1, Mode.GUIDED)
    assert wire.count(4.0)["NAV_CONTROLLER_OUTPUT"] == 4


@pytest.mark.parametrize(("rate_hz", "delivered_hz"), [(10, 10.0), (20, 20.0), (30, 30.0), (39, 40.0), (40, 40.0)])
def test_rates_are_kept_up_to_the_cap(rate_hz: float, delivered_hz: float) -> None:
    wire = Wire()
    assert wire.command(511, 30, 1e6 / rate_hz) == 0
    assert wire.count(10.0)["ATTITUDE"] == pytest.approx(10 * delivered_hz, rel=0.03)
    assert wire.count(5.0, port=1)["ATTITUDE"] == 5  # a rate belongs to the port


@pytest.mark.parametrize(
    ("values", "result"),
    [
        ((30, 1e6 / 41), 2), ((30, 1e6 / 45), 2), ((30, 1e6 / 50), 2), ((30, 1e3), 2), ((30, -5), 2), ((30, 1e5, 1), 2),
        ((331, 1e5), 2), ((9000, 1e5), 2), ((64, 1e5), 2), ((230, 1e5), 2), ((339, 1e5), 2), ((60_000, 1e5), 2),
        ((30, math.nan), 2), ((85, 1e5), 0), ((132, 1e5), 0), ((194, 1e5), 0), ((162, 1e5), 0), ((168, 1e5), 0),
        ((0, 5e5), 0), ((245, 1e5), 0), ((108, 1e5), 0), ((105, 1e5), 0), ((242, 1e5), 0), ((31, 1e5), 0),
        ((30, 1e5, 0, math.nan, math.nan, math.nan, math.nan), 0),
    ],
)  # fmt: skip
def test_message_intervals(values: tuple[float, ...], result: int) -> None:
    wire = Wire()
    assert wire.command(511, *values) == result
    rates = wire.count(2.0)
    if result == 2:
        assert rates["ATTITUDE"] == 2  # the old rate stays
        assert any("Increase SCHED_LOOP_RATE" in "".join(wire.texts) or "No ap_message" in t for t in wire.texts) == (
            values[1] > 0 and len(values) == 2
        )
    elif values[0] in (85, 132, 194, 162, 168):
        assert rates.keys() == wire.count(2.0).keys()  # granted and never sent
    else:
        kind = dialect().mavlink_map[values[0]].msgname
        assert rates[kind] == pytest.approx(2e6 / values[1], abs=1)


def test_an_interval_can_be_switched_off_read_and_set_back() -> None:
    wire = Wire()
    for interval, said, count in ((50_000, 50_000, 40), (-1, -1, 0), (0, 1_000_000, 2)):
        assert wire.command(511, 30, interval) == 0
        assert wire.command(510, 30) == 0
        assert wire.of("MESSAGE_INTERVAL")[-1].interval_us == said
        assert wire.count(2.0)["ATTITUDE"] == count
    assert wire.command(510, 331) == 4


def test_the_legacy_request_has_no_answer_and_writes_parameters() -> None:
    wire = Wire()
    wire.send("REQUEST_DATA_STREAM", 1, 1, 6, 5, 1)
    counts = wire.count(4.0)
    assert 19 <= counts["LOCAL_POSITION_NED"] <= 20
    assert (counts["ATTITUDE"], counts["COMMAND_ACK"]) == (4, 0)
    assert wire.rover.parameters["SR0_POSITION"] == 5.0


def test_parameters_and_time() -> None:
    wire = Wire()
    wire.send("PARAM_REQUEST_READ", 1, 1, b"NO_SUCH_NAME", -1)
    wire.send("PARAM_SET", 1, 1, b"NO_SUCH_NAME", 1.0, 9)
    wire.send("PARAM_SET", 1, 1, b"WP_SPEED", math.nan, 9)
    wire.run(0.1)
    assert not wire.of("PARAM_VALUE")
    wire.send("PARAM_SET", 1, 1, b"WP_SPEED", 1e9, 9)  # no range check
    wire.send("PARAM_REQUEST_READ", 1, 1, b"FS_GCS_ENABLE", -1)
    wire.run(0.1)
    echo, failsafe = wire.of("PARAM_VALUE")
    assert (echo.param_id, echo.param_value, echo.param_index) == ("WP_SPEED", 1e9, 65535)
    assert (failsafe.param_id, failsafe.param_value, failsafe.param_type) == ("FS_GCS_ENABLE", 0.0, 2)
    wire.send("PARAM_REQUEST_LIST", 1, 1)
    wire.run(0.1)
    listed = wire.of("PARAM_VALUE")[2:]
    assert [each.param_index for each in listed] == list(range(len(wire.rover.parameters)))
    assert {each.param_count for each in listed} == {len(listed)}
    assert not wire.of("PARAM_VALUE", port=1)
    wire.send("TIMESYNC", 0, 123_456)
    wire.run(0.1)
    answer = wire.of("TIMESYNC")[-1]
    assert (answer.ts1, answer.tc1) == (123_456, pytest.approx(1e9 * (wire.now_s - wire.began_s), abs=2e8))


# ---------------------------------------------------------------- failsafes
def beat(wire: Wire, source: tuple[int, int] = STATION) -> None:
    wire.send("HEARTBEAT", 6, 8, 0, 0, 4, 3, source=source)


def test_the_ground_station_failsafe_and_its_quirks() -> None:
    wire = Wire()
    wire.rover.parameters["FS_GCS_ENABLE"] = 1.0
    wire.guided().run(8.0, lambda: wire.drive(0.5))
    assert wire.rover.mode == Mode.GUIDED  # a station never seen never triggers
    beat(wire)
    last_s = wire.now_s

    def drive_on() -> None:
        wire.drive(0.5)
        beat(wire, COMPANION)
        wire.send("TIMESYNC", 0, 1)

    wire.run(6.4, drive_on)
    assert wire.rover.mode == Mode.GUIDED
    assert wire.state.speed_m_s == pytest.approx(0.5)
    wire.run(0.3, drive_on)
    assert wire.text_s("Radio Failsafe") - last_s == pytest.approx(6.55, abs=0.1)
    assert (wire.rover.mode, wire.rover.armed, wire.of("HEARTBEAT")[-1].system_status) == (Mode.HOLD, True, 5)
    assert wire.command(176, 1, Mode.GUIDED) == 0  # latched: it drives on, and does not fire again
    wire.run(8.0, drive_on)
    assert wire.state.speed_m_s == pytest.approx(0.5)
    wire.command(176, 1, Mode.HOLD)
    beat(wire)
    wire.run(0.2)
    assert "GCS Failsafe Cleared" in wire.texts
    assert (wire.rover.mode, wire.rover.armed) == (Mode.HOLD, True)
    wire.run(1.0)
    assert wire.of("HEARTBEAT")[-1].system_status == 4


@pytest.mark.parametrize(
    ("action", "mode", "armed"),
    [(0, Mode.GUIDED, True), (1, Mode.RTL, True), (3, Mode.SMART_RTL, True), (5, Mode.GUIDED, False)],
)
def test_the_failsafe_s_other_actions_do_what_they_say(action: int, mode: Mode, armed: bool) -> None:
    wire = Wire()
    wire.rover.parameters |= {"FS_GCS_ENABLE": 1.0, "FS_ACTION": float(action)}
    beat(wire)
    wire.guided().run(6.4, lambda: wire.drive(0.5))
    away_m = wire.state.rolled_m
    assert away_m > 2.5
    wire.run(7.0, lambda: wire.drive(0.5))
    assert (wire.rover.failsafe, wire.rover.mode, wire.rover.armed) == (True, mode, armed)
    home_m = math.hypot(wire.state.x_m, wire.state.y_m)
    if action == 0:
        assert home_m > away_m + 3.0
    elif armed:
        assert home_m < 0.5 * away_m  # it drove home, with nobody there
    else:
        assert wire.state.speed_m_s == 0.0


def test_the_failsafe_is_off_by_default() -> None:
    wire = Wire()
    beat(wire)
    wire.guided().run(8.0, lambda: wire.drive(0.5))
    assert wire.rover.mode == Mode.GUIDED


def test_gps_lost_while_driving() -> None:
    wire = Wire().moving(0.5)
    wire.rover.set_gps(False)
    lost_s = wire.now_s
    wire.run(6.5, lambda: wire.drive(0.5))
    assert wire.rover.mode == Mode.GUIDED
    wire.run(2.5, lambda: wire.drive(0.5))
    assert wire.text_s("AHRS: DCM active") - lost_s == pytest.approx(7.0, abs=0.2)
    assert wire.text_s("EKF failsafe") - lost_s == pytest.approx(8.2, abs=0.2)
    assert wire.rover.mode == Mode.HOLD
    counts = wire.count(3.0)
    assert (counts["LOCAL_POSITION_NED"], counts["ATTITUDE"]) == (0, 3)
    assert wire.of("EKF_STATUS_REPORT")[-1].flags & 128
    assert wire.command(176, 1, Mode.GUIDED) == 4
    wire.rover.set_gps(True)
    wire.run(1.5)
    assert wire.command(176, 1, Mode.GUIDED) == 0


def test_safety_switch_stuck_sensors_and_battery() -> None:
    wire = Wire().moving(0.5)
    wire.rover.safety = True
    wire.run(1.5, lambda: wire.drive(0.5))
    assert wire.state.speed_m_s < 0.05
    assert not wire.of("SYS_STATUS")[-1].onboard_control_sensors_enabled & 0x8000
    wire.command(400, 0)
    assert wire.command(400, 1) == 4
    assert "Arm: Hardware safety switch" in wire.texts
    wire.rover.safety, wire.rover.charge = False, 0.1
    assert wire.command(400, 1) == 0
    wire.rover.stick_sensors(True)
    wire.run(3.0, lambda: wire.drive(0.5))
    first, last = wire.of("LOCAL_POSITION_NED")[-2:]
    assert (first.x, first.y) == (last.x, last.y)
    assert last.time_boot_ms > first.time_boot_ms
    assert wire.of("BATTERY_STATUS")[-1].battery_remaining == 10
    wire.rover.stick_sensors(False)
    wire.run(1.0)
    assert wire.of("LOCAL_POSITION_NED")[-1].y > last.y + 0.5


# ---------------------------------------------------------------- whom it believes
def test_only_the_station_may_command_if_that_is_enforced() -> None:
    wire = Wire().guided()
    for source in (COMPANION, STRANGER, (254, 190), STATION):
        wire.run(1.5, lambda source=source: wire.drive(0.4, source=source))  # type: ignore[misc]  # loop variable
        assert wire.state.speed_m_s == pytest.approx(0.4, abs=0.02)
    wire.rover.parameters["SYSID_ENFORCE"] = 1.0
    wire.run(5.0, lambda: wire.drive(0.8, source=STRANGER))
    assert wire.state.speed_m_s == 0.0
    assert wire.command(176, 1, Mode.HOLD, source=STRANGER) is None
    assert wire.command(176, 1, Mode.HOLD, source=COMPANION) == 0
    assert wire.command(176, 1, Mode.GUIDED) == 0


def test_the_map_is_the_world_s() -> None:
    clock = SimClock(0.0)
    rover = Firmware(FreeBody(Pose(2.0, -1.0, math.pi / 2), clock), boot_s=0.05)
    rover.power_on(0.0)
    assert (rover.state().x_m, rover.state().y_m) == (2.0, -1.0)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_no_message_can_break_it(data: st.DataObject) -> None:
    wire = Wire(settle_s=0.1)
    wire.rover.armed, wire.rover.mode = data.draw(st.booleans()), data.draw(st.sampled_from(list(Mode)))
    number = st.floats(width=32)
    command = data.draw(st.sampled_from([20, 176, 178, 179, 192, 241, 400, 410, 510, 511, 512, 520, 60001]))
    values = [data.draw(number) for _ in range(7)]
    wire.send("COMMAND_LONG", 1, 1, command, 0, *values)
    wire.send("COMMAND_INT", 1, 1, 6, command, 0, 0, *values[:4], 5, 6, values[4])
    mask, frame = data.draw(st.integers(0, 0xFFF)), data.draw(st.integers(0, 21))
    wire.send("SET_POSITION_TARGET_LOCAL_NED", 0, 1, 1, frame, mask, *[data.draw(number) for _ in range(11)])
    wire.send("SET_ATTITUDE_TARGET", 0, 1, 1, mask & 0xFF, values[:4], 0, 0, values[4], values[5])
    wire.send("SET_POSITION_TARGET_GLOBAL_INT", 0, 1, 1, 6, mask, 2**31 - 1, -(2**31), *values, 0, 0)
    wire.send("MANUAL_CONTROL", 1, 0, 32767, -32768, 32767, 0)
    wire.send("VISION_POSITION_ESTIMATE", 0, *values[:6])
    wire.run(0.1)
    assert math.isfinite(wire.state.speed_m_s + wire.state.turn_rad_s + wire.state.x_m)
