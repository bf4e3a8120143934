"""The rosbridge wire without ports: a server's bytes in pieces of any size, and noise in their place."""

from __future__ import annotations

import contextlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.drivers.base import STAND, Twist
from fullswarm.drivers.ros.protocol import Battery, Odometry, Report
from fullswarm.drivers.ros.rosbridge_wire import RosbridgeWire
from fullswarm.drivers.ros.settings import parse_url
from fullswarm.emulators.ros.emulator import _options
from fullswarm.emulators.ros.firmware import Base
from fullswarm.emulators.ros.rosbridge import Rosbridge
from fullswarm.errors import LinkLost, MessageError
from fullswarm.simulation.bodies import FreeBody

URL = "ros://ws/127.0.0.1:9090/t1?model=turtlebot3&watchdog=0.5"


def talk(wire: RosbridgeWire, robot: Rosbridge, size: int, now_s: float) -> list[Report]:
    """Exchange what both have to say, in pieces of a size."""
    found: list[Report] = []
    for _ in range(6):
        for chunk in wire.outgoing():
            for at in range(0, len(chunk), size):
                robot.receive(chunk[at : at + size], now_s, 0)
        robot.step(now_s)
        data = b"".join(robot.take(0))
        for at in range(0, len(data), size):
            found += wire.received(data[at : at + size])
    return found


@given(st.integers(1, 700))
def test_reports_and_commands_pass_in_pieces_of_any_size(size: int) -> None:
    wire, robot = RosbridgeWire(parse_url(URL)), Rosbridge(Base(_options(URL), FreeBody()))
    assert wire.drive(STAND, None) == b""  # before the websocket is there
    talk(wire, robot, size, 0.0)
    reports = talk(wire, robot, size, 0.3)
    assert {type(each) for each in reports} == {Odometry, Battery}
    robot.receive(wire.drive(Twist(0.1, -0.2), None), 0.3, 0)
    assert (robot.base._target, robot.base.commands) == ((0.1, -0.2), 1)


@given(st.lists(st.binary(min_size=1, max_size=200), max_size=5), st.booleans())
def test_noise_is_a_lost_link_or_a_wrong_message_and_nothing_else(noise: list[bytes], greeted: bool) -> None:
    wire, robot = RosbridgeWire(parse_url(URL)), Rosbridge(Base(_options(URL), FreeBody()))
    if greeted:
        talk(wire, robot, 500, 0.0)
    for each in noise:
        with contextlib.suppress(LinkLost, MessageError):
            wire.received(each)
        wire.outgoing()
        wire.drive(Twist(0.1, 0.0), None)
    wire.farewell()
    wire.linked()
    robot.hung_up(0)
    talk(wire, robot, 500, 1.0)
    assert talk(wire, robot, 500, 1.5)


def test_what_rosbridge_complains_about_is_kept_for_people() -> None:
    wire, robot = RosbridgeWire(parse_url(URL)), Rosbridge(Base(_options(URL), FreeBody()))
    talk(wire, robot, 500, 0.0)
    robot._say({"op": "status", "level": "error", "msg": "Unable to import geometry_msgs"})
    robot._flush()
    for chunk in robot.take(0):
        wire.received(chunk)
    assert "Unable to import" in wire.trouble


def test_the_guardians_frame_is_a_whole_message_of_zero() -> None:
    wire, robot = RosbridgeWire(parse_url(URL)), Rosbridge(Base(_options(URL), FreeBody()))
    talk(wire, robot, 500, 0.0)
    robot.receive(wire.drive(Twist(0.1, 0.0), None), 0.1, 0)
    for _, frame in wire.stop_plan.stop:
        robot.receive(frame, 0.2, 0)
    assert robot.base._target == (0.0, 0.0)
    assert robot.base.commands == 1 + len(wire.stop_plan.stop)


@pytest.mark.parametrize(
    "text", [b"[]", b"{}", b'{"op":5}', b"null", json.dumps({"op": "publish", "topic": "/t1/odom"}).encode()]
)
def test_json_that_is_no_message_is_refused(text: bytes) -> None:
    wire = RosbridgeWire(parse_url(URL))
    with pytest.raises(MessageError):
        wire._message(text)
