"""ROS 2 for tests: a zenoh router and a node on it, which know of the bridge only what rmw_zenoh's sources say.

Messages are built and read by rosbags, attachments by zenoh's own serializer.
"""

from __future__ import annotations

import itertools
import json
import socket
import time
from collections import defaultdict
from typing import Any

import zenoh
from rosbags.typesys import Stores, get_typestore

from fullswarm.bus.zenoh_bus import untyped

STORE: Any = get_typestore(Stores.ROS2_JAZZY)
GID = bytes(range(16))


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class RosSide:
    """A router with the topics of a ROS 2 system.

    Parameters
    ----------
    native
        Keys of rmw_zenoh; else those of zenoh-bridge-ros2dds.
    """

    def __init__(self, *, native: bool = True, port: int = 0) -> None:
        self.native = native
        self.endpoint = f"tcp/127.0.0.1:{port or free_port()}"
        config = zenoh.Config()
        for name, value in {
            "mode": "router", "listen/endpoints": [self.endpoint], "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False, "timestamping/enabled": True, "transport/shared_memory/enabled": False,
        }.items():  # fmt: skip
            config.insert_json5(name, json.dumps(value))
        self.session = zenoh.open(config)
        self.keys: set[str] = set()
        self.tokens: set[str] = set()
        self.received: dict[str, list[tuple[float, bytes, bytes]]] = defaultdict(list)  # when, payload, attachment
        self._numbers = itertools.count(1)
        direct = zenoh.handlers.Callback
        self._kept: list[Any] = [
            self.session.declare_subscriber("**", direct(self._receive, indirect=False)),
            self.session.liveliness().declare_subscriber(
                "@ros2_lv/**", direct(self._token, indirect=False), history=True
            ),
            self.session.liveliness().declare_subscriber(
                "@/*/@ros2_lv/**", direct(self._token, indirect=False), history=True
            ),
        ]

    def _receive(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        self.keys.add(key)
        extra = b"" if sample.attachment is None else sample.attachment.to_bytes()
        self.received[self.topic(key)].append((time.monotonic(), sample.payload.to_bytes(), extra))

    def _token(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self.tokens.add(str(sample.key_expr))
        else:
            self.tokens.discard(str(sample.key_expr))

    def topic(self, key: str) -> str:
        """Return the name of the topic in a key."""
        return "/".join(key.split("/")[1:-2]) if self.native else key

    def key(self, topic: str, kind: str) -> str:
        if not self.native:
            return topic
        package, _, name = kind.split("/")
        return f"0/{topic}/{package}::msg::dds_::{name}_/{STORE.hash_rihs01(kind)}"

    def messages(self, topic: str, kind: str) -> list[Any]:
        return [STORE.deserialize_cdr(data, kind) for _, data, _ in list(self.received[topic])]

    def put(self, topic: str, kind: str, data: bytes) -> None:
        """Publish bytes as a node of ROS does."""
        now = zenoh.ext.Int64(time.time_ns())
        extra = zenoh.ext.z_serialize((zenoh.ext.Int64(next(self._numbers)), now, GID)) if self.native else None
        self.session.put(self.key(topic, kind), data, attachment=extra)

    def twist(self, topic: str, linear: float, angular: float = 0.0) -> None:
        vector = STORE.types["geometry_msgs/msg/Vector3"]
        kind = "geometry_msgs/msg/Twist"
        message = STORE.types[kind](linear=vector(x=linear, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=angular))
        self.put(topic, kind, bytes(STORE.serialize_cdr(message, kind)))

    def ask(self, **request: Any) -> None:
        kind = "std_msgs/msg/String"
        message = STORE.types[kind](data=json.dumps(request))
        self.put("swarm/request", kind, bytes(STORE.serialize_cdr(message, kind)))

    def late(self, topic: str, kind: str) -> list[Any]:
        """Subscribe now, as a transient-local subscription; return what comes, which grows."""
        found: list[Any] = []

        def receive(sample: zenoh.Sample) -> None:
            found.append(STORE.deserialize_cdr(sample.payload.to_bytes(), kind))

        handler = zenoh.handlers.Callback(receive, indirect=False)
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        key = self.key(topic, kind)
        self._kept.append(zenoh.ext.declare_advanced_subscriber(self.session, key, handler, history=history))
        return found

    def close(self) -> None:
        self._kept.clear()
        untyped(self.session.close)
