"""The published check of the Scout's driver with every fault of its emulator, and its protocol alone."""

import pytest
from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.errors import ConfigError, DriverError
from fullswarm.simulation.bodies import FreeBody
from fullswarm.testing import check_driver, emulated_rig
from hypothesis import given
from hypothesis import strategies as st

from fullswarm_acme.driver import AcmeDriver
from fullswarm_acme.emulator import Firmware
from fullswarm_acme.protocol import Drive, Hello, LineParser, Robot, State, line
from fullswarm_acme.session import Session


def test_keeps_the_contract() -> None:
    with emulated_rig("scout") as rig:
        report = check_driver(rig)
    print(report)
    assert report.skipped == {}


# ---------------------------------------------------------------- what the check cannot know of
def test_a_pressed_button_is_a_fault_that_says_so_and_a_reboot_moves_no_odometry() -> None:
    body = FreeBody()
    session, firmware = Session(), Firmware(body)
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
    assert (session.state, "button" in session.fault) == (Lifecycle.FAULT, True)
    firmware.estop = False
    talk(0.4)
    assert session.state is Lifecycle.READY
    body.push(1.0, 0.5)
    talk(0.5)
    before = session.reading
    session.received(line(Robot("Scout", "2.3", 7)), 0.6)
    session.received(line(State(0, 0, 9000, 9000, 3000)), 0.6)
    assert before and session.reading
    assert session.reading.odometry.x_m == pytest.approx(before.odometry.x_m)
    assert session.reading.odometry.heading_rad == pytest.approx(before.odometry.heading_rad)


def test_an_unreachable_robot_and_a_wrong_url_are_errors() -> None:
    driver = AcmeDriver("acme://127.0.0.1:1")
    with pytest.raises(DriverError, match="is the robot on"):
        driver.open()
    for url in ("acme://", "acme://host:port", "acme://host/path", "null://r1"):
        with pytest.raises(ConfigError):
            AcmeDriver(url)


# ---------------------------------------------------------------- protocol
@given(st.binary(max_size=300), st.integers(1, 50), st.floats(-30.0, 30.0), st.floats(-30.0, 30.0))
def test_noise_hides_no_message_behind_it_and_makes_none(noise: bytes, size: int, v: float, w: float) -> None:
    data = noise + b"\n" + line(Hello()) + line(Drive.of(Twist(v, w)))
    parser, messages = LineParser(), list[object]()
    for start in range(0, len(data), size):
        messages += parser.feed(data[start : start + size])
    greeting, sent = messages
    assert greeting == Hello()
    assert isinstance(sent, Drive)
    assert sent.twist == Twist(pytest.approx(v, abs=6e-4), pytest.approx(w, abs=6e-4))
