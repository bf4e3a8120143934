"""The URL of a ROS robot: what it means, what is refused, and the keys that follow from it."""

from __future__ import annotations

import pytest

from fullswarm.drivers.ros.models import MODELS
from fullswarm.drivers.ros.settings import claims, parse_url
from fullswarm.drivers.ros.zenoh_wire import relay_task
from fullswarm.errors import ConfigError

TB3 = "ros://tcp/192.168.1.5:7447/turtlebot1?model=turtlebot3&watchdog=0.5"


def test_a_whole_url_is_understood() -> None:
    found = parse_url(
        "ros://tcp/10.0.0.7:7447/lab/t1?rmw=zenoh&cmd=drive&odom=/truth/odom&battery=&estop=e_stop&radius=0.11&speed=0.2"
        "&turn=2.5&accel=0.8&stamped=1&model=turtlebot3&watchdog=0.4&domain=7&guardian=0"
    )
    assert (found.transport, found.host, found.port, found.namespace) == ("zenoh", "10.0.0.7", 7447, "lab/t1")
    topics = found.topics
    assert (topics.cmd, topics.odom) == ("lab/t1/drive", "truth/odom")
    assert (topics.battery, topics.estop) == ("", "lab/t1/e_stop")
    limits = found.description.limits
    assert (limits.speed_m_s, limits.turn_rad_s, limits.accel_m_s2) == (0.2, 2.5, 0.8)
    assert (found.description.radius_m, found.description.watchdog_s) == (0.11, 0.4)
    assert (found.stamped, found.domain, found.guardian) == (True, 7, False)


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("ros://192.168.1.5:7447", "no ROS robot"),
        ("ros://tcp/192.168.1.5", "no address"),
        ("ros://tcp/h:1?model=turtlebot9", "unknown model"),
        ("ros://tcp/h:1?modle=turtlebot3", "did you mean 'model'"),
        ("ros://tcp/h:1", "not known of this robot: radius, speed, turn, watchdog"),
        ("ros://ws/h:9090?model=turtlebot4&rmw=zenoh", "does not fit ws"),
        (TB3 + "&speed=-1", "not a positive number"),
        (TB3 + "&speed=nan", "not a positive number"),
        (TB3 + "&cmd=", "cmd is empty"),
        (TB3 + "&cmd=a b", "no name of a ROS topic"),
        (TB3 + "&odom=a/**", "no name of a ROS topic"),
        (TB3 + "&stamped=yes", "neither 0 nor 1"),
        (TB3 + "&domain=999", "domain"),
        (TB3 + "&model=turtlebot3", "given twice"),
        ("ros://tcp/h:1/9lives?model=turtlebot4", "no ROS namespace"),
    ],
)
def test_what_is_wrong_is_named(url: str, says: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_url(url)
    assert says.replace("no address", "is not an address") in str(refused.value)


def test_a_base_that_nothing_would_stop_is_refused_over_a_network() -> None:
    with pytest.raises(ConfigError, match="keeps its last velocity"):
        parse_url("ros://tcp/192.168.1.5:7447?model=turtlebot3")
    assert parse_url("ros://tcp/127.0.0.1:7447?model=turtlebot3").description.watchdog_s is None
    assert parse_url("ros://tcp/192.168.1.5:7447?model=turtlebot3&watchdog=none").description.watchdog_s is None
    assert parse_url("ros://tcp/192.168.1.5:7447?model=create3").description.watchdog_s == 0.5


def test_the_keys_are_those_of_rmw_zenoh_and_of_the_bridge() -> None:
    native = relay_task(parse_url(TB3 + "&domain=3"))
    assert native.command == "3/turtlebot1/cmd_vel/geometry_msgs::msg::dds_::Twist_"
    assert native.topics[0] == "3/turtlebot1/odom/nav_msgs::msg::dds_::Odometry_/*"
    assert native.attach
    assert native.tokens[1].startswith("@ros2_lv/3/{zid}/0/1/MP/%/%/fullswarm/%turtlebot1%cmd_vel/")
    bridge = relay_task(parse_url(TB3 + "&rmw=bridge"))
    assert (bridge.command, bridge.command_hash, bridge.topics[0]) == ("turtlebot1/cmd_vel", "", "turtlebot1/odom")
    assert not bridge.attach


def test_two_drivers_of_one_base_have_the_same_claim() -> None:
    assert claims(TB3, True) == claims(TB3 + "&speed=0.1", True)
    assert claims(TB3, True) != claims(TB3.replace("turtlebot1", "turtlebot2"), True)


@pytest.mark.parametrize("name", MODELS)
def test_each_model_has_what_a_driver_needs(name: str) -> None:
    found = parse_url(f"ros://tcp/127.0.0.1:7447?model={name}").description
    assert 0.1 < found.radius_m < 0.3
    assert 0.2 <= found.limits.speed_m_s <= 1.0
