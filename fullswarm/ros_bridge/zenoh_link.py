"""ROS 2 over zenoh: a session of its own to ROS's router, in the keys of rmw_zenoh or of zenoh-bridge-ros2dds.

rmw_zenoh (its docs/design.md): a topic's key is ``<domain>/<name>/<type>/<type hash>``, each message bears an
attachment with its number, time and origin, and liveliness tokens tell ROS's graph of nodes, publishers and
subscriptions. zenoh-bridge-ros2dds: the key is the topic's name; its tokens name key, type and quality of service.
"""

from __future__ import annotations

import contextlib
import functools
import os
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import zenoh

from fullswarm.bus.endpoint import host_of, is_secured
from fullswarm.bus.zenoh_bus import HubLink, untyped
from fullswarm.drivers.ros.relay_process import GID_BYTES, attachment
from fullswarm.drivers.ros.zenoh_wire import dds_type
from fullswarm.errors import ConfigError, Unreachable
from fullswarm.ros_bridge.codec import TRIGGER, Codec
from fullswarm.ros_bridge.link import LARGEST_BYTES, ROOM, Incoming, Topic, Values

Keys = Literal["zenoh", "bridge"]
CONNECT_S = 3.0
NODE = "fullswarm"
ATTACHMENT = f"<qqB{GID_BYTES}s"
"""Number, time in ns, length of the origin's id, that id."""
ATTACHMENT_BYTES = struct.calcsize(ATTACHMENT)
HEARTBEAT_S = 1.0
"""Of a latched topic: within this time a subscriber learns that it has missed the last message."""
HINT = "start `ros2 run rmw_zenoh_cpp rmw_zenohd`, or zenoh-bridge-ros2dds with --keys bridge; --ros2 is its address"


@dataclass(slots=True)
class Channel:
    """What is declared for one topic."""

    topic: Topic
    key: str
    publisher: Any = None
    subscriber: Any = None
    token: Any = None
    gid: bytes = b""
    sent: int = 0
    waiting: deque[Incoming] = field(default_factory=lambda: deque(maxlen=ROOM))


class ZenohLink:
    """A :class:`~fullswarm.ros_bridge.link.Link` to ROS 2.

    Parameters
    ----------
    endpoint
        Of rmw_zenoh's router or of zenoh-bridge-ros2dds, ``tcp/<host>:<port>``.
    keys
        Whose keys: ``zenoh`` is rmw_zenoh.
    domain
        ROS domain, of rmw_zenoh.
    wall_ns
        Returns nanoseconds since 1970, for the attachments.

    Raises
    ------
    ConfigError
        The endpoint is malformed, or a secured one.
    MissingExtra
        rosbags is not installed.
    Unreachable
        No router answers there within 3 s.
    """

    def __init__(self, endpoint: str, keys: Keys, domain: int, wall_ns: Callable[[], int]) -> None:
        host_of(endpoint)
        if is_secured(endpoint):
            raise ConfigError("a ROS side with certificates is not supported", where=endpoint, hint="use tcp/")
        self.where, self.dropped = f"ROS 2 at {endpoint}", 0
        self._keys, self._domain, self._wall_ns = keys, domain, wall_ns
        self._codec = Codec(2)
        self._channels: dict[str, Channel] = {}
        self._entities = 0
        self._session: Any = None
        self._node: Any = None
        # Latched topics need times of zenoh's own on their messages.
        self._hub = HubLink(endpoint, multicast=False, on_open=self._on_open, timestamping__enabled=True)
        try:
            self._hub.wait(CONNECT_S)
        except Unreachable as error:
            self._hub.close()
            raise Unreachable("no zenoh router of ROS 2 answers", where=endpoint, hint=HINT) from error
        self._node = self._declare_node()

    @property
    def _zid(self) -> str:
        return str(self._session.info.zid())

    def _on_open(self, session: Any) -> None:
        self._session = session

    @property
    def up(self) -> bool:
        """Whether the router is connected; after a loss zenoh connects again and declares everything anew."""
        return self._hub.up

    # ------------------------------------------------------------ topics
    def advertise(self, topic: Topic) -> None:
        """Offer a topic."""
        if topic.name in self._channels:
            return
        key = self._key(topic)
        channel = Channel(topic, key, gid=os.urandom(GID_BYTES))
        # A slow subscriber loses messages; it cannot make a put wait.
        drop = zenoh.CongestionControl.DROP
        if topic.latched:
            channel.publisher = zenoh.ext.declare_advanced_publisher(
                self._session, key, congestion_control=drop, cache=zenoh.ext.CacheConfig(1), publisher_detection=True,
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
            )  # fmt: skip
        else:
            channel.publisher = self._session.declare_publisher(key, congestion_control=drop)
        channel.token = self._declare_token("MP", topic)
        self._channels[topic.name] = channel

    def subscribe(self, topic: Topic) -> None:
        """Take the messages of a topic."""
        if topic.name in self._channels:
            return
        # Any type hash: ROS 2 Humble has none.
        key = self._key(topic) if self._keys == "bridge" else f"{self._key(topic).rpartition('/')[0]}/*"
        channel = Channel(topic, key)
        # Direct: zenoh's own handler thread is not a daemon, a process with one would never end.
        handler = zenoh.handlers.Callback(functools.partial(self._receive, channel), indirect=False)
        channel.subscriber = self._session.declare_subscriber(key, handler)
        channel.token = self._declare_token("MS", topic)
        self._channels[topic.name] = channel

    def serve(self, name: str) -> None:
        """Offer a service; only in the keys of rmw_zenoh."""
        topic = Topic(name, TRIGGER)
        if self._keys == "bridge" or name in self._channels:
            return
        channel = Channel(topic, self._key(topic))
        handler = zenoh.handlers.Callback(functools.partial(self._called, channel), indirect=False)
        channel.subscriber = self._session.declare_queryable(channel.key, handler, complete=True)
        channel.token = self._declare_token("SS", topic)
        self._channels[name] = channel

    def withdraw(self, name: str) -> None:
        """Offer and take a topic no more."""
        channel = self._channels.pop(name, None)
        if channel is None:
            return
        for declared in (channel.token, channel.publisher, channel.subscriber):
            if declared is not None:
                untyped(declared.undeclare)

    def publish(self, name: str, values: Values) -> None:
        """Send a message."""
        channel = self._channels[name]
        data = self._codec.encode(channel.topic.kind, values)
        channel.sent += 1
        extra = attachment(channel.sent, self._wall_ns(), channel.gid) if self._keys == "zenoh" else None
        channel.publisher.put(data, attachment=extra)

    # ------------------------------------------------------------ messages of ROS
    def _receive(self, channel: Channel, sample: zenoh.Sample) -> None:
        """Take in a message, on a thread of zenoh: nothing here may wait, or grow with what is sent."""
        size = len(sample.payload)
        if size > LARGEST_BYTES:
            self.dropped += 1
            return
        if len(channel.waiting) == ROOM:
            self.dropped += 1
        sender, problem = (channel.topic.name, "") if self._keys == "bridge" else _origin(sample.attachment)
        channel.waiting.append(Incoming(channel.topic.name, sender, sample.payload.to_bytes(), problem))

    def _called(self, channel: Channel, query: zenoh.Query) -> None:
        """Take in a call of a service, on a thread of zenoh; a call that finds no room gets no reply."""
        sender, problem = _origin(query.attachment)
        if len(channel.waiting) == ROOM or problem:
            self.dropped += 1
            return
        number, _, _, gid = struct.unpack(ATTACHMENT, query.attachment.to_bytes())  # type: ignore[union-attr]

        def reply(success: bool, message: str) -> None:
            # The client knows its call by its own number and origin.
            extra = attachment(number, self._wall_ns(), gid)
            with contextlib.suppress(zenoh.ZError), query:  # it has waited for too long, or is gone
                query.reply(channel.key, self._codec.trigger_response(success, message), attachment=extra)

        channel.waiting.append(Incoming(channel.topic.name, sender, b"", reply=reply))

    def take(self) -> list[Incoming]:
        """Return what has come since the last call, at most what had come when it began."""
        found: list[Incoming] = []
        for channel in self._channels.values():
            found += [channel.waiting.popleft() for _ in range(len(channel.waiting))]
        return found

    def decode(self, kind: str, data: bytes) -> Any:
        """Return a message; raises ``MessageError``."""
        return self._codec.decode(kind, data)

    def close(self) -> None:
        """End the session, within half a second also when the router is frozen."""
        self._channels.clear()
        self._hub.close()

    # ------------------------------------------------------------ keys
    def _key(self, topic: Topic) -> str:
        if self._keys == "bridge":
            return topic.name
        return f"{self._domain}/{topic.name}/{dds_type(topic.kind)}/{self._codec.type_hash(topic.kind)}"

    def _declare_token(self, role: str, topic: Topic) -> Any:
        return self._session.liveliness().declare_token(self._token(role, topic))

    def _token(self, role: str, topic: Topic) -> str:
        self._entities += 1
        if self._keys == "bridge":
            # keyless, reliable; durability and history as DDS numbers them, the last 1 or 10 messages
            quality = ":1:1:0,1" if topic.latched else ":1:0:0,10"
            key, kind = topic.name.replace("/", "§"), topic.kind.replace("/", "§")
            return f"@/{self._zid}/@ros2_lv/{role}/{key}/{kind}/{quality}"
        quality = f"1:{1 if topic.latched else 2}:1,{1 if topic.latched else 10}:,:,:,,"
        name, kind = f"/{topic.name}".replace("/", "%"), dds_type(topic.kind)
        head = f"@ros2_lv/{self._domain}/{self._zid}/0/{self._entities}/{role}/%/%/{NODE}"
        return f"{head}/{name}/{kind}/{self._codec.type_hash(topic.kind)}/{quality}"

    def _declare_node(self) -> Any:
        native = f"@ros2_lv/{self._domain}/{self._zid}/0/0/NN/%/%/{NODE}"
        token = f"@/{self._zid}/@ros2_lv" if self._keys == "bridge" else native
        return self._session.liveliness().declare_token(token)


def _origin(extra: Any) -> tuple[str, str]:
    """Return who sent a message, by its attachment, and what is wrong with that; rmw_zenoh refuses the same."""
    data = b"" if extra is None else extra.to_bytes()
    if len(data) != ATTACHMENT_BYTES or data[16] != GID_BYTES:
        return "unknown", "a message without the attachment of rmw_zenoh (or of an early version of it)"
    _, _, _, gid = struct.unpack(ATTACHMENT, data)
    return f"gid {gid.hex()}", ""
