"""The bridge's side of ROS 2 on a real zenoh router, in both forms of keys; tokens, attachments, latched topics."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from typing import Any

import pytest
import zenoh

from fullswarm.errors import ConfigError, Unreachable
from fullswarm.ros_bridge import codec as types
from fullswarm.ros_bridge.link import LARGEST_BYTES, ROOM, Incoming, Topic
from fullswarm.ros_bridge.zenoh_link import ZenohLink
from tests.system.ros_side import GID, STORE, RosSide, free_port
from tests.waiting import until

ODOM, CMD, MAP = Topic("r1/odom", types.ODOMETRY), Topic("r1/cmd_vel", types.TWIST), Topic("map", types.GRID, True)


class Ends:
    def __init__(self, native: bool) -> None:
        self.native = native
        self.ros = RosSide(native=native)
        self.link = ZenohLink(self.ros.endpoint, "zenoh" if native else "bridge", 0, time.time_ns)

    def close(self) -> None:
        self.link.close()
        self.ros.close()


@pytest.fixture(params=[True, False], ids=["rmw_zenoh", "ros2dds"])
def ends(request: pytest.FixtureRequest) -> Iterator[Ends]:
    made = Ends(request.param)
    yield made
    made.close()


def test_a_message_arrives_on_the_key_of_its_topic(ends: Ends) -> None:
    ends.link.advertise(ODOM)
    for _ in range(3):
        ends.link.publish("r1/odom", {"child_frame_id": "r1/base_link"})
    until(lambda: len(ends.ros.received["r1/odom"]) == 3, what="three messages arrive")
    assert ends.ros.messages("r1/odom", types.ODOMETRY)[0].child_frame_id == "r1/base_link"
    native = f"0/r1/odom/nav_msgs::msg::dds_::Odometry_/{STORE.hash_rihs01(types.ODOMETRY)}"
    assert ends.ros.keys == {native if ends.native else "r1/odom"}
    extras = [extra for _, _, extra in ends.ros.received["r1/odom"]]
    if not ends.native:
        assert extras == [b"", b"", b""]
        return
    kind: Any = tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes]
    read: list[Any] = [zenoh.ext.z_deserialize(kind, zenoh.ZBytes(extra)) for extra in extras]
    assert [int(number) for number, _, _ in read] == [1, 2, 3]
    assert all(abs(int(time_ns) - time.time_ns()) < 20e9 for _, time_ns, _ in read)
    assert len({gid for _, _, gid in read}) == 1
    assert len(read[0][2]) == 16


def test_the_graph_of_ros_has_the_node_its_publishers_and_subscriptions(ends: Ends) -> None:
    for topic in (ODOM, MAP):
        ends.link.advertise(topic)
    ends.link.subscribe(CMD)
    until(lambda: len(ends.ros.tokens) == 4, what="four tokens")
    zid = "[0-9a-f]{1,32}"
    if ends.native:
        head, hashed = rf"@ros2_lv/0/{zid}/0", r"RIHS01_[0-9a-f]{64}"
        wanted = [
            rf"{head}/0/NN/%/%/fullswarm",
            rf"{head}/\d+/MP/%/%/fullswarm/%r1%odom/nav_msgs::msg::dds_::Odometry_/{hashed}/1:2:1,10:,:,:,,",
            rf"{head}/\d+/MP/%/%/fullswarm/%map/nav_msgs::msg::dds_::OccupancyGrid_/{hashed}/1:1:1,1:,:,:,,",
            rf"{head}/\d+/MS/%/%/fullswarm/%r1%cmd_vel/geometry_msgs::msg::dds_::Twist_/{hashed}/1:2:1,10:,:,:,,",
        ]
    else:
        head = rf"@/{zid}/@ros2_lv"
        wanted = [
            head,
            rf"{head}/MP/r1§odom/nav_msgs§msg§Odometry/:1:0:0,10",
            rf"{head}/MP/map/nav_msgs§msg§OccupancyGrid/:1:1:0,1",
            rf"{head}/MS/r1§cmd_vel/geometry_msgs§msg§Twist/:1:0:0,10",
        ]
    for pattern in wanted:
        assert sum(re.fullmatch(pattern, token) is not None for token in ends.ros.tokens) == 1, pattern
    ends.link.withdraw("map")
    ends.link.withdraw("r1/cmd_vel")
    until(lambda: len(ends.ros.tokens) == 2, what="two tokens are gone")


def test_who_subscribes_late_gets_the_last_message_of_a_latched_topic(ends: Ends) -> None:
    ends.link.advertise(MAP)
    for width in (3, 4):
        ends.link.publish("map", {"info": {"width": width}})
    until(lambda: len(ends.ros.received["map"]) == 2, what="both arrive")
    found = ends.ros.late("map", types.GRID)
    until(lambda: bool(found), what="the last one arrives")
    assert [each.info.width for each in found] == [4]


def test_messages_of_ros_wait_for_the_bridge_but_not_without_bound(ends: Ends) -> None:
    ends.link.subscribe(CMD)
    until(lambda: any("cmd_vel" in each for each in ends.ros.tokens), what="the subscription is known")
    sent = 0

    def send() -> None:
        nonlocal sent
        for _ in range(50):
            sent += 1
            ends.ros.twist("r1/cmd_vel", 0.001 * sent)

    until(lambda: ends.link.dropped > 200, each=send, what="messages are dropped")
    found = ends.link.take()
    assert len(found) == ROOM
    assert {each.problem for each in found} == {""}
    assert found[0].sender == (f"gid {GID.hex()}" if ends.native else "r1/cmd_vel")
    speeds = [ends.link.decode(types.TWIST, each.data).linear.x for each in found]
    assert speeds == sorted(speeds)


def test_a_huge_message_is_dropped_before_it_is_copied(ends: Ends) -> None:
    ends.link.subscribe(CMD)
    until(lambda: any("cmd_vel" in each for each in ends.ros.tokens), what="the subscription is known")
    ends.ros.put("r1/cmd_vel", types.TWIST, bytes(LARGEST_BYTES + 1))
    until(lambda: ends.link.dropped == 1, what="it is dropped")
    assert ends.link.take() == []


@pytest.mark.parametrize("extra", [None, b"", b"x" * 33, b"x" * 32, b"\0" * 33])
def test_a_message_without_a_valid_attachment_is_named(extra: bytes | None) -> None:
    ends = Ends(native=True)
    ends.link.subscribe(CMD)
    until(lambda: any("cmd_vel" in each for each in ends.ros.tokens), what="the subscription is known")
    ends.ros.session.put(ends.ros.key("r1/cmd_vel", types.TWIST), b"x", attachment=extra)
    found: list[Incoming] = []
    until(lambda: bool(found), each=lambda: found.extend(ends.link.take()), what="it arrives")
    assert "attachment" in found[0].problem
    ends.close()


def test_a_router_that_comes_back_gets_everything_declared_again(ends: Ends) -> None:
    ends.link.advertise(ODOM)
    ends.link.subscribe(CMD)
    until(lambda: len(ends.ros.tokens) == 3, what="three tokens")
    port = int(ends.ros.endpoint.rpartition(":")[2])
    ends.ros.close()
    until(lambda: not ends.link.up, what="the loss is noticed")
    ends.link.publish("r1/odom", {})  # goes nowhere, and does not wait
    ends.ros = RosSide(native=ends.native, port=port)
    until(lambda: ends.link.up and len(ends.ros.tokens) == 3, what="it is connected again")
    until(
        lambda: bool(ends.ros.received["r1/odom"]), each=lambda: ends.link.publish("r1/odom", {}), what="odometry again"
    )


def test_a_side_that_is_not_there_is_named_with_what_to_start() -> None:
    with pytest.raises(Unreachable, match=r"no zenoh router of ROS 2 answers.*rmw_zenohd"):
        ZenohLink(f"tcp/127.0.0.1:{free_port()}", "zenoh", 0, time.time_ns)
    for wrong in ("127.0.0.1:7447", "tls/127.0.0.1:7447", "udp/127.0.0.1:1"):
        with pytest.raises(ConfigError):
            ZenohLink(wrong, "zenoh", 0, time.time_ns)


def test_a_service_is_called_as_rmw_zenoh_calls_it() -> None:
    ends = Ends(native=True)
    ends.link.serve("swarm/stop")
    hashed = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"  # in keys of public repositories
    kind = f"std_srvs::srv::dds_::Trigger_/{hashed}"
    token = rf"@ros2_lv/0/[0-9a-f]+/0/\d+/SS/%/%/fullswarm/%swarm%stop/{kind}/1:2:1,10:,:,:,,"
    until(lambda: any(re.fullmatch(token, each) for each in ends.ros.tokens), what="the service is in the graph")
    extra = zenoh.ext.z_serialize((zenoh.ext.Int64(41), zenoh.ext.Int64(time.time_ns()), GID))
    handler: Any = zenoh.handlers.FifoChannel(8)
    replies = ends.ros.session.get(
        f"0/swarm/stop/{kind}", handler, payload=b"\0\1\0\0\0", attachment=extra, timeout=10.0,
        target=zenoh.QueryTarget.ALL_COMPLETE, consolidation=zenoh.ConsolidationMode.NONE,
    )  # fmt: skip
    found: list[Incoming] = []
    until(lambda: bool(found), each=lambda: found.extend(ends.link.take()), what="the call arrives")
    assert found[0].reply is not None
    found[0].reply(True, "done")
    answer = replies.recv().ok
    assert answer.payload.to_bytes() == b"\0\1\0\0" + b"\1\0\0\0" + b"\5\0\0\0done\0"
    read: Any = tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes]
    number, _, gid = zenoh.ext.z_deserialize(read, answer.attachment)
    assert (int(number), gid) == (41, GID)
    ends.close()
