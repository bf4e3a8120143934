"""The simulator's datagrams and URLs, and the null driver."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.clock import SimClock
from fullswarm.config import WorldConfig
from fullswarm.drivers.base import STAND, Driver, Twist
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.drivers.sim import protocol
from fullswarm.drivers.sim.settings import parse_url, url_for
from fullswarm.errors import ConfigError, MessageError

real = st.floats(allow_nan=False, width=64)
triple = st.tuples(real, real, real)
anything = st.one_of(
    st.builds(protocol.Hello, robot=st.text(), session=st.text(), sensing_m=real),
    st.builds(
        protocol.Drive,
        robot=st.text(),
        session=st.text(),
        sequence=st.integers(0, 2**60),
        linear_m_s=real,
        angular_rad_s=real,
        active=st.booleans(),
    ),
    st.builds(
        protocol.BodyReading,
        robot=st.text(),
        session=st.text(),
        time_s=real,
        pose=triple,
        odometry=triple,
        twist=st.tuples(real, real),
        contacts=st.integers(0, 100),
        hazards=st.integers(0, 63),
        obstacles=st.binary(max_size=100),
    ),
    st.builds(protocol.Refusal, robot=st.text(), session=st.text(), reason=st.text(), hint=st.text()),
    st.builds(protocol.Bye, robot=st.text(), session=st.text()),
)


@given(anything)
def test_datagrams_come_back(datagram: protocol.Datagram) -> None:
    assert protocol.decode(protocol.encode(datagram)) == datagram


@given(st.binary(max_size=200))
def test_noise_on_the_wire_is_refused(data: bytes) -> None:
    with pytest.raises(MessageError):
        protocol.decode(data)


def test_another_version_or_field_is_refused() -> None:
    bye = {"kind": "sim.Bye/1", "robot": "a", "session": "s"}
    assert protocol.decode(msgspec.msgpack.encode(bye)) == protocol.Bye(robot="a", session="s")
    for change in ({"kind": "sim.Bye/2"}, {"extra": 1}, {"robot": 3}):
        with pytest.raises(MessageError):
            protocol.decode(msgspec.msgpack.encode(bye | change))


def test_obstacles_come_back() -> None:
    rows = np.arange(18.0).reshape(3, 6)
    assert protocol.unpack_rows(protocol.pack_rows(rows), 6).tolist() == rows.tolist()
    assert protocol.unpack_rows(b"", 6).shape == (0, 6)
    with pytest.raises(MessageError):
        protocol.unpack_rows(b"12345", 6)


def test_urls() -> None:
    short, long = parse_url("sim://R1"), parse_url("sim://10.0.0.2:99/r-2?speed_limit_m_s=4&sensing_m=1.5")
    assert (short.robot, short.host, short.port, short.sensing_m) == ("R1", "127.0.0.1", 7450, 3.0)
    assert short.description.limits.speed_m_s == 0.5
    assert (long.robot, long.host, long.port, long.sensing_m) == ("r-2", "10.0.0.2", 99, 1.5)
    assert long.description.limits.speed_m_s == 4.0


def test_url_for_says_what_differs() -> None:
    assert url_for(WorldConfig(), "r1") == "sim://r1"
    config = WorldConfig(address="127.0.0.1:8000", speed_limit_m_s=4.0, turn_limit_rad_s=0.785, radius_m=0.2)
    parsed = parse_url(url_for(config, "r1", sensing_m=2.0))
    assert (parsed.robot, parsed.port, parsed.sensing_m) == ("r1", 8000, 2.0)
    assert parsed.description.limits.turn_rad_s == 0.785
    assert parsed.description.radius_m == 0.2


@pytest.mark.parametrize(
    "url", ["sim://", "sim://a b", "create://r1", "sim://host/r1", "sim://h:99999/r1", "sim://r1?speed_limit=1",
            "sim://r1?radius_m=x", "sim://r1?radius_m=-1", "sim://r1?radius_m=inf", "sim://h:1/a/b"]
)  # fmt: skip
def test_wrong_urls_are_refused(url: str) -> None:
    with pytest.raises(ConfigError):
        parse_url(url)


def test_null_driver_follows_the_lifecycle() -> None:
    clock = SimClock(5.0)
    null = NullDriver("null://n1", clock)
    driver: Driver = null
    assert driver.read() is None
    assert driver.command(Twist(0.3, 0.0)) == STAND
    driver.open()
    assert driver.command(Twist(0.3, 0.0)) == STAND
    driver.activate()
    assert driver.state.value == "ACTIVE"
    assert driver.command(Twist(9.0, -9.0)) == Twist(0.5, -4.25)
    driver.command(Twist(0.2, 1.0))
    clock.advance_to(5.25)
    reading = driver.read()
    assert reading is not None
    assert reading.odometry.x_m == pytest.approx(0.2 * math.sin(0.25))
    assert reading.odometry.heading_rad == pytest.approx(0.25)
    clock.advance_to(9.0)
    reading = driver.read()
    assert reading is not None
    assert reading.odometry.heading_rad == pytest.approx(0.3)  # the watchdog stopped it after 0.3 s
    assert reading.twist == STAND
    with pytest.raises(ValueError, match="finite"):
        driver.command(Twist(math.nan, 0.0))
    driver.deactivate()
    assert null.state.name == "READY"
    driver.close()
    driver.close()
    assert null.state.name == "CLOSED"
    with pytest.raises(ConfigError):
        NullDriver("null://a/b")
