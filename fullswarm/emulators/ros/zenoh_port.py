"""The robot's end of zenoh: a router, as rmw_zenohd or zenoh-bridge-ros2dds is one, with the topics of one base.

Chunks are ``topic NUL payload``. What is no such chunk (injected noise, half a name) is published as odometry, as a
broken node would. The attachments of rmw_zenoh are written and read by zenoh's own serializer, and a command without a
valid one is dropped, as rmw_zenoh drops it.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections import deque
from typing import Any, Literal

import zenoh

from fullswarm.emulators.ros.definitions import typestore
from fullswarm.emulators.ros.firmware import BaseOptions

GID = bytes(range(1, 17))
WAITING = 64
"""Commands that may wait for the base."""


class ZenohPort:
    """A zenoh router on one address; see :class:`fullswarm.emulators.ports.Port`.

    Parameters
    ----------
    kind
        Keys and attachments of rmw_zenoh, or plain names of the bridge.
    hashes
        Whether the robot's ROS has type hashes: Humble has none.
    """

    rates = (0, 0)

    def __init__(
        self, host: str, port: int, base: BaseOptions, *, kind: Literal["zenoh", "bridge"], domain: int = 0,
        hashes: bool = True,
    ) -> None:  # fmt: skip
        self.address = f"{host}:{port}"
        self._base, self._native, self._domain, self._hashes = base, kind == "zenoh", domain, hashes
        self._arrived: deque[bytes] = deque(maxlen=WAITING)
        self._session: Any = None
        self._kept: list[Any] = []
        self._wake, self._sent = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC), 0

    # ------------------------------------------------------------ keys
    def _key(self, topic: str, kind: str) -> str:
        if not self._native:
            return topic
        package, middle, name = kind.split("/")
        found = typestore().hash_rihs01(kind) if self._hashes else "TypeHashNotSupported"
        return "/".join((str(self._domain), topic, f"{package}::{middle}::dds_::{name}_", found))

    # ------------------------------------------------------------ the port
    def plug(self) -> None:
        """Open the router."""
        if self._session is not None:
            return
        config = zenoh.Config()
        for name, value in {
            "mode": "router",
            "listen/endpoints": [f"tcp/{self.address}"],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "scouting/delay": 0,
            "transport/shared_memory/enabled": False,
        }.items():
            config.insert_json5(name, json.dumps(value))
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise OSError(98, str(error).split(" at /")[0]) from error
        handler = zenoh.handlers.Callback(self._on_command, indirect=False)
        base, session = self._base, self._session
        self._kept = [session.declare_subscriber(self._key(base.cmd, base.command_type), handler)]
        if self._native:
            zid = str(session.info.zid())
            for number, (topic, kind) in enumerate({base.cmd: base.command_type, **base.published}.items()):
                role = "MS" if topic == base.cmd else "MP"
                mangled = f"/{topic}".replace("/", "%")
                typed = "/".join(self._key(topic, kind).rsplit("/", 2)[1:])
                named = f"{role}/%/%/base/{mangled}/{typed}/1:2:1,10:,:,:,,"
                token = f"@ros2_lv/{self._domain}/{zid}/0/{number + 1}/{named}"
                self._kept.append(session.liveliness().declare_token(token))

    def _on_command(self, sample: zenoh.Sample) -> None:
        """Take a command, on a thread of zenoh."""
        if self._native and not _valid(sample.attachment):
            return
        self._arrived.append(self._base.cmd.encode() + b"\0" + sample.payload.to_bytes())
        with contextlib.suppress(OSError, ValueError):  # it is being closed
            os.eventfd_write(self._wake, 1)

    def fileno(self) -> int:
        """Return what to wait on."""
        return self._wake

    def receive(self) -> list[bytes]:
        """Return the commands that have arrived."""
        with contextlib.suppress(OSError):
            os.eventfd_read(self._wake)
        chunks: list[bytes] = []
        while self._arrived:
            chunks.append(self._arrived.popleft())
        return chunks

    def send(self, data: bytes) -> None:
        """Publish a message."""
        if self._session is None:
            return
        name, _, payload = data.partition(b"\0")
        topic = name.decode(errors="replace")
        kind = self._base.published.get(topic)
        if kind is None:
            topic, payload = self._base.odom, data
            kind = self._base.published[topic]
        self._sent += 1
        attachment = _attachment(self._sent) if self._native else None
        self._session.put(self._key(topic, kind), payload, attachment=attachment)

    def drop(self) -> None:
        """End all connections, as a restart does."""
        if self._session is not None:
            self.pull()
            self.plug()

    def pull(self) -> None:
        """Close the router."""
        session, self._session, self._kept = self._session, None, []
        self._arrived.clear()
        if session is not None:
            session.close()

    def close(self) -> None:
        """Close the router for good."""
        self.pull()
        if self._wake >= 0:
            os.close(self._wake)
            self._wake = -1


def _attachment(number: int) -> Any:
    return zenoh.ext.z_serialize((zenoh.ext.Int64(number), zenoh.ext.Int64(time.time_ns()), GID))


def _valid(attachment: Any) -> bool:
    """Tell whether an attachment is what rmw_zenoh takes: number, time, and an origin of 16 bytes."""
    if attachment is None:
        return False
    try:
        number, time_ns, gid = zenoh.ext.z_deserialize(tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes], attachment)
    except zenoh.ext.ZDeserializeError:
        return False
    return int(number) > 0 and int(time_ns) > 0 and len(gid) == 16
