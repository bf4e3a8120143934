"""Other people's clients against the emulated Create: pycreate2, and the bytes of libcreate."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any

import pytest
import serial

from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.protocol import Frame, Mode, StreamParser
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from tests.waiting import until


@pytest.fixture
def robot() -> Iterator[CreateEmulator]:
    with CreateEmulator() as emulator:
        yield emulator


def test_pycreate2_reads_drives_and_sings(robot: CreateEmulator) -> None:
    client: Any = importlib.import_module("pycreate2").Create2(robot.port)
    client.sleep_timer = 0.02  # it waits half a second after each command otherwise
    try:
        client.start()
        until(lambda: robot.mode is Mode.PASSIVE)
        client.safe()
        until(lambda: robot.mode is Mode.SAFE)
        client.drive_direct(200, 100)  # right, left
        until(lambda: robot.body.state().turned_rad > 0.05)
        sensors = client.get_sensors()
        assert (sensors.velocity_right, sensors.velocity_left) == (200, 100)
        assert sensors.encoder_counts_right > sensors.encoder_counts_left > 0
        assert sensors.distance > 0
        assert sensors.angle > 0
        assert not sensors.cliff_front_left
        assert sensors.battery_charge == 2200
        assert sensors.battery_capacity == 2696
        assert sensors.temperature == 25
        assert sensors.oi_stream_num_packets == 0
        robot.set_cliff(front_left=True)
        until(lambda: robot.mode is Mode.PASSIVE)
        assert robot.body.state().speed_m_s == 0.0
        sensors = client.get_sensors()
        assert (sensors.open_interface_mode, sensors.cliff_front_left) == (Mode.PASSIVE, True)
        robot.set_cliff()
        client.full()
        assert client.createSong(3, [60, 4, 64, 4, 67, 8]) == 0.25
        client.playSong(3)
        client.led(led_bits=4, power_color=255, power_intensity=128)
        client.digit_led_ascii("hi")
        sensors = client.get_sensors()
        assert (sensors.song_number, sensors.song_playing) == (3, True)
        panel = robot.firmware.panel
        assert (panel.led_bits, panel.power_colour, panel.power_intensity) == (4, 255, 128)
        assert panel.digits == "HI  "
        client.drive_pwm(255, 255)
        until(lambda: robot.body.state().speed_m_s == 0.5)
    finally:
        del client  # it stops the robot and closes its port
    assert robot.mode is Mode.OFF
    assert robot.body.state().speed_m_s == 0.0


def test_the_bytes_of_libcreate_connect_drive_and_end(robot: CreateEmulator) -> None:
    ids = [*range(7, 16), 17, 18, *range(21, 27), 35, *range(43, 54), 58]
    assert len(ids) == 30
    parser = StreamParser(ids)
    with serial.Serial(robot.port, 115200, timeout=1.0) as port:
        port.write(bytes([128]))
        port.write(bytes([148, 30, *ids]))
        port.write(bytes([132]))
        frames: list[Frame] = []
        while len(frames) < 20:
            frames += parser.feed(port.read(1))
        assert parser.skipped == 0
        assert frames[-1].sensors.mode == Mode.FULL
        assert frames[-1].sensors.charge_mah == 2200
        port.write(bytes([145, 0, 100, 0, 100]))
        until(lambda: robot.body.state().rolled_m > 0.01)
        port.write(bytes([145, 255, 156, 255, 156]))
        until(lambda: robot.body.state().speed_m_s == -0.1)
        port.write(bytes([128, 173]))
        until(lambda: robot.mode is Mode.OFF)
        assert robot.body.state().speed_m_s == 0.0


def test_a_poll_of_all_packets_while_driving_by_radius(robot: CreateEmulator) -> None:
    """As pyroombaadapter does: 137 and 142."""
    with serial.Serial(robot.port, 115200, timeout=1.0) as port:
        port.write(bytes([128, 131]) + protocol.drive(200, 235))
        until(lambda: robot.body.state().turned_rad > 0.1)
        port.write(protocol.query(100))
        sensors = protocol.decode([100], port.read(80))
        assert sensors is not None
        assert (sensors.velocity_mm_s, sensors.radius_mm) == (200, 235)
        assert (sensors.left_mm_s, sensors.right_mm_s) == (100, 300)
