"""The emulated rover behind real ports: other people's client drives it, and its links break on request."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import Pose
from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.drivers.mavlink.protocol import Mode
from fullswarm.emulators.base import LinkFaults
from fullswarm.emulators.mavlink.emulator import RoverEmulator
from fullswarm.emulators.ports import plug, port_at
from fullswarm.errors import ConfigError, DriverError
from fullswarm.simulation.bodies import FreeBody
from tests.emulated.rover_link import free_port

CLOCK = MonotonicClock()
LIMIT_S = 20.0


@contextmanager
def client(address: str) -> Iterator[Any]:
    """pymavlink's own client: its parser, its waiters, its mode tables."""
    dialect()  # sets MAVLINK20 first
    from pymavlink import mavutil

    connection = mavutil.mavlink_connection(address, source_system=255, source_component=190, robust_parsing=True)
    try:
        yield connection
    finally:
        connection.close()


def in_time(work: Callable[[], object]) -> None:
    """Run a client whose waiters have no deadline of their own."""
    failed: list[BaseException] = []

    def run() -> None:
        try:
            work()
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(LIMIT_S)
    assert not thread.is_alive(), "the client waits in vain"
    if failed:
        raise failed[0]


def drive(connection: Any, speed: float, turn: float) -> None:
    connection.mav.set_position_target_local_ned_send(
        0, connection.target_system, connection.target_component, 8, 0x5E7, 0, 0, 0, speed, 0, 0, 0, 0, 0, 0, turn
    )


ADDRESSES: dict[str, Callable[[], tuple[str, str]]] = {
    "udp": lambda: (f"udp://127.0.0.1:{(port := free_port())}", f"udpin:127.0.0.1:{port}"),
    "udpin": lambda: (f"udpin://127.0.0.1:{(port := free_port())}", f"udpout:127.0.0.1:{port}"),
    "tcp": lambda: (f"tcp://127.0.0.1:{(port := free_port())}", f"tcp:127.0.0.1:{port}"),
    "pty": lambda: ("pty:", ""),
}


@pytest.mark.parametrize("kind", ADDRESSES)
def test_pymavlink_s_own_client_arms_and_drives(kind: str) -> None:
    address, theirs = ADDRESSES[kind]()
    with RoverEmulator(address) as rover, client(theirs or rover.url.removeprefix("mavlink+serial://")) as connection:

        def work() -> None:
            if kind == "udpin":
                connection.mav.heartbeat_send(6, 8, 0, 0, 4)  # it must be called first
            connection.wait_heartbeat()
            assert (connection.target_system, connection.mav_type, connection.mode_mapping()["GUIDED"]) == (1, 10, 15)
            for message, interval in ((0, 100_000), (32, 50_000)):
                connection.mav.command_long_send(1, 1, 511, 0, message, interval, 0, 0, 0, 0, 0)
                assert connection.recv_match(type="COMMAND_ACK", blocking=True, timeout=3).result == 0
            assert connection.recv_match(type="LOCAL_POSITION_NED", blocking=True, timeout=3) is not None
            connection.set_mode("GUIDED")
            while connection.flightmode != "GUIDED":
                connection.wait_heartbeat()
            connection.arducopter_arm()
            connection.motors_armed_wait()
            assert connection.motors_armed()
            for _ in range(20):
                drive(connection, 0.8, -0.4)
                position = connection.recv_match(type="LOCAL_POSITION_NED", blocking=True, timeout=3)
            assert math.hypot(position.vx, position.vy) > 0.5
            connection.param_fetch_all()
            values: dict[str, float] = {}
            while len(values) < len(rover.firmware.parameters):
                value = connection.recv_match(type="PARAM_VALUE", blocking=True, timeout=3)
                values[value.param_id] = value.param_value
            assert values["WP_SPEED"] == 3.0
            connection.arducopter_disarm()
            connection.motors_disarmed_wait()

        in_time(work)
        state = rover.body.state()
        assert state.x_m > 0.2
        assert state.heading_rad > 0.1  # yaw rate -0.4 (NED) is counter-clockwise


def test_a_second_tcp_client_is_not_heard_until_the_first_has_left() -> None:
    with RoverEmulator("tcp://127.0.0.1:0") as rover:
        where = ("127.0.0.1", int(rover.url.rpartition(":")[2]))
        with socket.create_connection(where, timeout=2.0) as first, socket.create_connection(where) as second:
            assert first.recv(10)
            second.settimeout(0.4)
            with pytest.raises(TimeoutError):
                second.recv(10)
            first.close()
            second.settimeout(3.0)
            assert second.recv(10)


class Ear:
    """Somebody who listens on a rover's UDP port."""

    def __init__(self, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.senders: set[int] = set()

    def frames(self, duration_s: float) -> list[bytes]:
        end_s, frames = CLOCK.now_s() + duration_s, []
        while (left_s := end_s - CLOCK.now_s()) > 0:
            self.socket.settimeout(left_s)
            with contextlib.suppress(TimeoutError):
                data, sender = self.socket.recvfrom(4096)
                frames.append(data)
                self.senders.add(sender[1])
        return frames

    def until_heard(self) -> None:
        self.socket.settimeout(5.0)
        self.socket.recv(4096)


def lost(frames: list[bytes]) -> float:
    """Return the share that is missing, by the gaps in their numbers."""
    gaps = [(after[4] - before[4]) % 256 for before, after in itertools.pairwise(frames)]
    return 1.0 - len(gaps) / sum(gaps)


@contextmanager
def heard(**options: Any) -> Iterator[tuple[RoverEmulator, Ear]]:
    port = free_port()
    ear = Ear(port)
    try:
        with RoverEmulator(f"udp://127.0.0.1:{port}", **options) as rover:
            ear.until_heard()
            rover.firmware.set_interval(30, 50_000, CLOCK.now_s())
            yield rover, ear
    finally:
        ear.socket.close()


def test_unplugged_it_is_silent_and_back_at_the_same_address() -> None:
    with heard() as (rover, ear):
        assert ear.frames(0.3)
        rover.unplug()
        ear.frames(0.05)
        assert not ear.frames(0.3)
        rover.replug()
        rover.replug()  # twice is fine
        assert ear.frames(0.3)
        assert len(ear.senders) == 1
        rover.mute()
        ear.frames(0.05)
        assert not ear.frames(0.3)
        rover.mute(False)
        assert ear.frames(0.3)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:0", "udpin://127.0.0.1:0", "pty:"])
def test_a_port_comes_back_with_its_name(address: str) -> None:
    with RoverEmulator(address) as rover:
        url = rover.url
        rover.unplug()
        path = url.removeprefix("mavlink+serial://")
        if address == "pty:":
            assert not Path(path).exists()
        elif address.startswith("tcp"):
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2])))
        rover.replug()
        assert rover.url == url
        if address == "pty:":
            descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
            assert os.read(descriptor, 1)
            os.close(descriptor)
        else:
            with pytest.raises(DriverError, match="in use"):
                plug(port_at(f"{address.rpartition(':')[0]}:{url.rpartition(':')[2]}"))


def test_a_bad_link_loses_mangles_and_delays() -> None:
    with heard(faults=LinkFaults()) as (rover, ear):
        assert lost(ear.frames(0.5)) == 0.0
        rover.faults.drop = 0.5
        ear.frames(0.1)
        assert 0.2 < lost(ear.frames(1.0)) < 0.8
        rover.faults.drop, rover.faults.corrupt = 0.0, 1.0
        ear.frames(0.1)
        checker = dialect().MAVLink(None)
        broken = 0
        frames = ear.frames(0.7)
        for frame in frames:
            try:
                checker.decode(bytearray(frame))
            except dialect().MAVError:
                broken += 1
        assert frames
        assert broken > 0.7 * len(frames)  # a flip in the id makes a message that nobody can check
        rover.faults.corrupt, rover.faults.delay_s = 0.0, 0.5
        ear.frames(0.1)
        assert not ear.frames(0.3)
        assert ear.frames(0.7)


def test_a_reboot_drops_the_connection_and_begins_anew() -> None:
    with RoverEmulator("tcp://127.0.0.1:0", body=FreeBody(Pose(1.0, 2.0, 0.5))) as rover:
        where = ("127.0.0.1", int(rover.url.rpartition(":")[2]))
        with socket.create_connection(where, timeout=5.0) as first:
            first.recv(10)
            rover.pilot_mode(Mode.HOLD)
            rover.reboot()
            while first.recv(65536):
                pass  # what was under way, then the end
        with client(f"tcp:127.0.0.1:{where[1]}") as connection:
            in_time(lambda: connection.wait_heartbeat())
            assert connection.flightmode != "HOLD"
        assert (rover.body.state().x_m, rover.body.state().y_m) == (1.0, 2.0)


def test_one_that_died_of_a_nan_hangs_up_and_can_be_started_again() -> None:
    with RoverEmulator("tcp://127.0.0.1:0", traps_floats=True) as rover:
        where = int(rover.url.rpartition(":")[2])
        with client(f"tcp:127.0.0.1:{where}") as connection:
            in_time(lambda: connection.wait_heartbeat())
            connection.mav.command_long_send(1, 1, 511, 0, 30, 50_000, math.nan, 0, 0, 0, 0)
            end_s = CLOCK.now_s() + 5.0
            while not rover.firmware.aborted:
                assert CLOCK.now_s() < end_s
        rover.reboot()
        with client(f"tcp:127.0.0.1:{where}") as connection:
            in_time(lambda: connection.wait_heartbeat())


def test_wrong_addresses_are_told() -> None:
    with pytest.raises(ConfigError, match="not an address"):
        RoverEmulator("http://127.0.0.1:1")
    with pytest.raises(ConfigError, match="not an address"):
        RoverEmulator("udp://127.0.0.1:99999")
    with pytest.raises(DriverError, match="no port can be made"):
        RoverEmulator("pty:/no/such/folder/rover")


def test_two_ports_of_one_rover() -> None:
    with (
        RoverEmulator("udpin://127.0.0.1:0", more=["udpin://127.0.0.1:0"]) as rover,
        client(f"udpout:127.0.0.1:{rover.urls[0].rpartition(':')[2]}") as first,
        client(f"udpout:127.0.0.1:{rover.urls[1].rpartition(':')[2]}") as second,
    ):

        def work() -> None:
            for each in (first, second):
                each.mav.heartbeat_send(6, 8, 0, 0, 4)
                each.wait_heartbeat()
            second.mav.command_long_send(1, 1, 176, 0, 1, 4, 0, 0, 0, 0, 0)
            assert second.recv_match(type="COMMAND_ACK", blocking=True, timeout=3).result == 0
            assert first.recv_match(type="COMMAND_ACK", blocking=True, timeout=0.3) is None

        in_time(work)
