"""The published check of the Scout's driver with every fault of its emulator, and its protocol alone."""

from __future__ import annotations

import importlib.metadata

import pytest
from fullswarm import registry
from fullswarm.drivers.base import STAND, Lifecycle, Pose, Twist
from fullswarm.errors import ConfigError, DriverError
from fullswarm.simulation.bodies import FreeBody
from fullswarm.testing import check_driver
from hypothesis import given
from hypothesis import strategies as st

from fullswarm_acme.driver import AcmeDriver
from fullswarm_acme.emulator import Firmware
from fullswarm_acme.protocol import LineParser, State, drive, line, parse_drive, parse_state, quantised, state
from fullswarm_acme.rig import rig
from fullswarm_acme.session import Session


def test_keeps_the_contract() -> None:
    with rig() as emulated:
        report = check_driver(emulated)
    print(report)
    assert report.skipped == {}


def test_the_entry_point_leads_to_the_driver() -> None:
    if not importlib.metadata.entry_points(group=registry.DRIVER_GROUP, name="acme"):
        pytest.skip("this package is not installed: pip install examples/outside_driver")
    assert registry.driver_class("acme://127.0.0.1") is AcmeDriver


# ---------------------------------------------------------------- what the check cannot know of
def test_a_pressed_button_is_a_fault_that_says_so_and_a_reboot_moves_no_odometry() -> None:
    body = FreeBody()
    session, firmware = Session("here"), Firmware(body)
    session.linked(0.0)

    def talk(now_s: float) -> None:
        firmware.receive(b"".join(session.tick(now_s)), now_s, 0)
        firmware.step(now_s)
        for chunk in firmware.take(0):
            session.received(chunk, now_s)

    talk(0.0)
    talk(0.02)
    assert session.state is Lifecycle.READY
    firmware.estop = True
    talk(0.3)
    assert session.state is Lifecycle.FAULT
    assert "button" in session.fault
    firmware.estop = False
    talk(0.4)
    assert session.state is Lifecycle.READY
    body.push(1.0, 0.5)
    talk(0.5)
    before = session.reading
    session.received(line("ROBOT Scout 2.3 7"), 0.6)
    session.received(line(state(State("IDLE", Pose(9.0, 9.0, 3.0), STAND, False, 1.0))), 0.6)
    assert before is not None
    assert session.reading is not None
    assert session.reading.odometry.x_m == pytest.approx(before.odometry.x_m)
    assert session.reading.odometry.heading_rad == pytest.approx(before.odometry.heading_rad)


def test_an_unreachable_robot_and_a_wrong_url_are_errors() -> None:
    driver = AcmeDriver("acme://127.0.0.1:1")
    with pytest.raises(DriverError, match="is the robot on"):
        driver.open()
    assert driver.state is Lifecycle.CLOSED
    for url in ("acme://", "acme://host:port", "acme://host/path", "null://r1"):
        with pytest.raises(ConfigError):
            AcmeDriver(url)


# ---------------------------------------------------------------- protocol
small = st.floats(-30.0, 30.0)


@given(st.sampled_from(["IDLE", "ON", "ESTOP"]), small, small, st.floats(-3.14, 3.14), small, st.booleans())
def test_a_state_goes_round(mode: str, x_m: float, y_m: float, heading: float, v: float, bumper: bool) -> None:
    sent = State(mode, Pose(x_m, y_m, heading), Twist(v, -v), bumper, 0.5)
    found = parse_state(state(sent))
    assert found is not None
    assert (found.mode, found.bumper, found.battery) == (mode, bumper, 0.5)
    assert found.pose.x_m == pytest.approx(x_m, abs=1e-3)
    assert found.pose.heading_rad == pytest.approx(heading, abs=1e-3)
    assert found.twist == quantised(sent.twist) == parse_drive(drive(sent.twist))


@given(st.binary(max_size=300), st.integers(1, 50))
def test_noise_hides_no_line_behind_it_and_makes_none(noise: bytes, size: int) -> None:
    data = noise + b"\n" + line("HELLO") + line("ENABLE")
    parser, texts = LineParser(), list[str]()
    for start in range(0, len(data), size):
        texts += parser.feed(data[start : start + size])
    assert texts == ["HELLO", "ENABLE"]
