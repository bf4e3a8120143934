"""What the emulators can do on request, and what the lifecycle makes of it, in simulated time."""

from __future__ import annotations

import pytest

from fullswarm.drivers.base import Hazard, Lifecycle, Twist
from fullswarm.drivers.can import odrive
from tests.unit.can_rig import Rig


@pytest.mark.parametrize(
    ("make", "options", "firmware"),
    [
        ("odrive", "firmware=0.6", "ODrive 0.6.10"),
        ("odrive", "firmware=0.5", "ODrive CANSimple 0.5"),
        ("vesc", "speed=0.5", "VESC"),
    ],
)
def test_firmware_is_known_once_ready_and_not_before(make: str, options: str, firmware: str) -> None:
    rig = Rig(make, options)
    assert rig.session.firmware == ""
    rig.until_state(Lifecycle.READY, 2.0)
    assert rig.session.firmware == firmware


def test_a_version_that_got_lost_is_asked_for_again() -> None:
    rig = Rig()
    version = odrive.request(1, odrive.Version), odrive.request(2, odrive.Version)
    for each in rig.odrives:
        each.faults.muted = True
    rig.run(0.3)
    for each in rig.odrives:
        each.faults.muted = False
    rig.until_state(Lifecycle.READY, 2.0)
    rig.run(1.2)
    assert rig.session.firmware == "ODrive 0.6.10"
    rig.sent.clear()
    rig.run(3.0)
    assert not any(frame in version for _, frame in rig.sent)  # known: no longer asked


@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_battery_by_the_lower_voltage(make: str) -> None:
    rig = Rig(make, "volts_empty=20&volts_full=30")
    rig.wheels[0].volts, rig.wheels[1].volts = 26.0, 25.0
    rig.until_state(Lifecycle.READY, 2.0)
    rig.run(1.2)
    assert rig.reading.battery == pytest.approx(0.5, abs=0.01)
    assert rig.hazards() is Hazard.NONE
    rig.wheels[0].volts = 21.0
    rig.run(1.2)
    assert rig.reading.battery == pytest.approx(0.1, abs=0.01)
    assert rig.hazards() is Hazard.BATTERY_LOW
    rig.wheels[0].volts = 12.0
    rig.run(1.2)
    assert rig.reading.battery == 0.0


def test_without_a_voltage_range_nothing_is_claimed() -> None:
    rig = Rig()
    rig.until_state(Lifecycle.READY, 2.0)
    rig.run(1.2)
    assert rig.reading.battery is None


@pytest.mark.parametrize("firmware", ["0.5", "0.6"])
def test_a_pressed_button_is_reported_and_cannot_be_cleared(firmware: str) -> None:
    rig = Rig("odrive", f"firmware={firmware}")
    rig.active(Twist(0.3, 0.0))
    for each in rig.odrives:
        each.press_estop(True)
    rig.until_state(Lifecycle.FAULT, 0.2)
    rig.until(lambda: max(rig.speeds()) == 0.0, 0.3)
    assert rig.hazards() is Hazard.ESTOP_BUTTON
    for each in rig.odrives:
        each.receive(odrive.encode(each.node, odrive.ClearErrors()), rig.now)
    rig.run(5.0)
    assert rig.state() is Lifecycle.FAULT
    for each in rig.odrives:
        each.press_estop(False)
    rig.until_state(Lifecycle.READY, 2.0)
    rig.run(1.0)
    assert rig.state() is Lifecycle.READY
    assert rig.hazards() is Hazard.NONE


@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_a_reboot_in_mid_drive_ends_ready(make: str) -> None:
    rig = Rig(make)
    rig.active(Twist(0.3, 0.0))
    before_m = rig.reading.odometry.x_m
    for each in rig.wheels:
        each.reboot(rig.now)
    rig.until_state(Lifecycle.FAULT, 1.0)
    rig.until_state(Lifecycle.READY, 2.0)
    rig.run(2.0)
    assert rig.state() is Lifecycle.READY
    assert rig.speeds() == [0.0, 0.0]
    assert rig.reading.odometry.x_m - before_m < 0.1  # the counts began anew, the pose did not
    assert rig.reading.odometry_breaks > 0


@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_a_mute_robot_is_a_fault_and_comes_back_ready(make: str) -> None:
    rig = Rig(make)
    rig.active(Twist(0.3, 0.0))
    for each in rig.wheels:
        each.faults.muted = True
    rig.until_state(Lifecycle.FAULT, 0.7)
    rig.until(lambda: max(rig.speeds()) == 0.0, 0.5)  # it still hears
    rig.run(3.0)
    for each in rig.wheels:
        each.faults.muted = False
    rig.until_state(Lifecycle.READY, 2.0)


@pytest.mark.parametrize("make", ["odrive", "vesc"])
def test_a_stuck_sensor_is_a_fault(make: str) -> None:
    rig = Rig(make)
    rig.active(Twist(0.3, 0.0))
    rig.wheels[1].faults.stuck_sensor = True
    rig.until_state(Lifecycle.FAULT, 0.7)
    assert "encoder of the right wheel (node 2) is stuck" in rig.session.fault
    rig.until(lambda: max(rig.speeds()) == 0.0, 0.5)
    rig.wheels[1].faults.stuck_sensor = False
    rig.until_state(Lifecycle.READY, 2.0)


def test_a_lost_link_never_latches() -> None:
    rig = Rig()
    for _ in range(4):
        rig.active(Twist(0.3, 0.0))
        rig.link = False
        rig.session.lost("cable out", rig.now)
        rig.run(0.3)
        rig.link = True
        rig.session.linked(rig.now)
        assert rig.until_state(Lifecycle.READY, 2.0) < 1.2
    for _ in range(4):
        rig.active(Twist(0.3, 0.0))
        for each in rig.wheels:
            each.faults.unplugged = True
        rig.until_state(Lifecycle.FAULT, 0.7)
        for each in rig.wheels:
            each.faults.unplugged = False
        rig.until_state(Lifecycle.READY, 2.0)


def test_a_bus_that_stays_lost_says_the_newest_reason() -> None:
    rig = Rig()
    rig.active(Twist(0.3, 0.0))
    rig.session.lost("cable out", rig.now)
    rig.session.lost("no such port", rig.now)
    assert (rig.state(), rig.session.fault) == (Lifecycle.FAULT, "no such port")


def test_an_05_axis_watchdog_is_fed_by_any_frame_an_06_one_by_set_points() -> None:
    for firmware, holds in (("0.5", True), ("0.6", False)):
        rig = Rig("odrive", f"firmware={firmware}", "watchdog=0.5")
        rig.active()
        rig.link = False
        for _ in range(100):
            for each in rig.odrives:
                each.receive(odrive.request(each.node, odrive.Encoder), rig.now)
            rig.step()
            rig.step()
        assert rig.idle() is not holds


@pytest.mark.parametrize("make", ["odrive", "vesc"])
@pytest.mark.parametrize("away_s", [0.3, 0.46, 0.48, 0.5, 0.52, 1.0])
@pytest.mark.parametrize("cut", [0, 1])
def test_a_bus_that_comes_back_turns_no_robot_that_drove_straight_on(make: str, away_s: float, cut: int) -> None:
    """The frame of one wheel was cut: the other has reported once more, and is heard first or last afterwards."""
    rig = Rig(make)
    rig.active(Twist(0.45, 0.0))
    rig.unheard = {cut}
    rig.run(0.025)
    rig.unheard.clear()
    rig.session.lost("the adapter is gone", rig.now)
    rig.link = False
    rig.run(away_s)
    rig.link = True
    rig.session.linked(rig.now)
    headings = []
    for _ in range(100):
        rig.step()
        headings.append(rig.reading.odometry.heading_rad)
    assert max(map(abs, headings)) < 0.1
    assert rig.reading.odometry_breaks == 1
    rig.run(1.0)
    assert rig.reading.odometry_breaks == 1


@pytest.mark.parametrize("make", ["odrive", "vesc"])
@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("away_s", [0.3, 0.6, 1.5])
def test_a_wheel_that_falls_silent_alone_turns_no_robot_that_drove_straight_on(
    make: str, side: int, away_s: float
) -> None:
    rig = Rig(make)
    rig.active(Twist(0.45, 0.0))
    before_m = rig.rolled()[0]
    assert rig.reading.odometry_breaks == 0
    rig.unheard = {side}
    rig.run(away_s)
    rig.unheard.clear()
    rig.run(0.5)
    reading, went_m = rig.reading, rig.rolled()[0] - before_m
    assert abs(reading.odometry.heading_rad) < 0.1
    # Either all of the way was counted, or it is said that a part of it may be missing.
    assert (reading.odometry_breaks == 0) is (reading.odometry.x_m - before_m > went_m - 0.05)
    assert (reading.odometry_breaks == 0) is (away_s < 0.5)
