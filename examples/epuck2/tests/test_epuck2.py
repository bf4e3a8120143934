"""The published check of the e-puck2's driver with every fault of its emulator, its protocol, and its guardian."""

import struct
import subprocess
import sys
import time

import pytest
from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.probe.line import Line, SerialPort
from fullswarm.errors import ConfigError
from fullswarm.simulation.bodies import FreeBody
from fullswarm.testing import check_driver, emulated_rig
from hypothesis import given
from hypothesis import strategies as st

from fullswarm_epuck2 import probe
from fullswarm_epuck2 import protocol as p
from fullswarm_epuck2.driver import Epuck2Driver
from fullswarm_epuck2.emulator import Epuck2Emulator, Firmware
from fullswarm_epuck2.session import Session

CLOCK = MonotonicClock()
SPEED = st.integers(-p.MOST_STEPS, p.MOST_STEPS)


def until(condition: object, limit_s: float = 10.0) -> float:
    began_s = CLOCK.now_s()
    while not condition():  # type: ignore[operator]
        assert CLOCK.now_s() - began_s < limit_s
        time.sleep(0.005)
    return CLOCK.now_s() - began_s


def test_keeps_the_contract() -> None:
    with emulated_rig("epuck2") as rig:
        report = check_driver(rig)
    print(report)
    assert set(report.skipped) == {"motors off unless ACTIVE"}  # nothing switches its steppers off


DRIVES = """
import sys, time
from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.guardian import guarded
from fullswarm_epuck2.driver import Epuck2Driver
driver = guarded(Epuck2Driver(sys.argv[1]))
driver.open()
while True:
    if driver.state is Lifecycle.READY:
        driver.activate()
    driver.command(Twist(0.1, 0.0))
    time.sleep(0.05)
"""


def test_its_guardian_stops_it_when_its_driver_is_killed() -> None:
    with Epuck2Emulator() as robot, subprocess.Popen([sys.executable, "-c", DRIVES, robot.url]) as driver:
        try:
            until(lambda: robot.body.state().speed_m_s > 0.09, 20.0)
        finally:
            driver.kill()
        assert until(lambda: robot.body.state().speed_m_s == 0.0) < 0.5


def test_the_probe_finds_it_and_it_does_not_move() -> None:
    with Epuck2Emulator() as robot:
        path = robot.url.removeprefix("epuck2://")
        with Line(path, CLOCK) as line:
            line.send(bytes([150, 0, 142, 35]))  # a Create's questions came first
            [found] = probe.ask_line(line, SerialPort(path, path), 115200, b"", CLOCK)
        assert (found.url, found.make) == (robot.url, "GCtronic")
        assert robot.body.state().rolled_m == 0.0


def test_a_restart_moves_no_odometry() -> None:
    body = FreeBody()
    session, firmware = Session(), Firmware(body)
    session.linked(0.0)
    now_s = 0.0

    def talk(duration_s: float) -> None:
        nonlocal now_s
        end_s = now_s + duration_s
        while now_s < end_s:
            now_s += 0.01
            firmware.receive(b"".join(session.tick(now_s)), now_s, 0)
            for chunk in firmware.take(0):
                session.received(chunk, now_s)

    talk(0.5)
    assert session.state is Lifecycle.READY
    for _ in range(40):  # pushed by hand, faster than its motors could
        body.push(0.01, 0.0)
        talk(0.05)
    assert session.reading is not None
    before = session.reading.odometry
    assert before.x_m == pytest.approx(0.4, abs=0.001)
    firmware.reboot()
    talk(1.0)
    assert session.reading.odometry == before
    assert session.reading.odometry_breaks == 1


def test_a_wrong_url_is_an_error() -> None:
    for url in ("epuck2://", "epuck2://host/dev", "epuck2:///dev/x?speed=1", "null://r1"):
        with pytest.raises(ConfigError):
            Epuck2Driver(url)


# ---------------------------------------------------------------- protocol
@given(SPEED, SPEED)
def test_a_twist_of_whole_steps_is_kept(left: int, right: int) -> None:
    assert p.to_steps(p.to_twist(p.Steps(left, right))) == p.Steps(left, right)


@given(st.floats(-10.0, 10.0), st.floats(-100.0, 100.0))
def test_wheels_that_would_be_too_fast_are_slowed_alike(linear: float, angular: float) -> None:
    steps = p.to_steps(Twist(linear, angular))
    assert max(abs(steps.left), abs(steps.right)) <= p.MOST_STEPS


@given(SPEED, SPEED, st.floats(0.0, 1.0), st.binary(max_size=20))
def test_the_firmware_answers_a_request_and_noise_before_it_hides_nothing(
    left: int, right: int, charge: float, noise: bytes
) -> None:
    firmware = Firmware(FreeBody())
    firmware.battery = charge
    speeds = p.Steps(left, right)
    firmware.receive(p.request(speeds), 0.0, 0)
    [sent] = firmware.take(0)
    found = p.answer(noise + sent, speeds)
    assert found is not None
    assert found.charge == pytest.approx(charge, abs=0.01)


@given(st.binary(max_size=40), st.integers(0, 13))
def test_what_is_cut_short_or_of_other_speeds_is_no_answer(noise: bytes, size: int) -> None:
    good = struct.pack("<hhHHHhh", 5, 6, 1, 2, 3200, 5, 6)
    assert p.answer(good[:size], p.Steps(5, 6)) is None
    assert p.answer(good, p.Steps(5, 7)) is None
    p.answer(noise, p.Steps(5, 6))


@given(st.binary(max_size=30))
def test_whatever_came_before_two_parks_stop_it(noise: bytes) -> None:
    body = FreeBody()
    firmware = Firmware(body)
    firmware.receive(noise, 0.0, 0)
    firmware.receive(p.RESYNC + p.PARK, 0.0, 0)
    state = body.state()
    assert (state.speed_m_s, state.turn_rad_s) == (0.0, 0.0)
