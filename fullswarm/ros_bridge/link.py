"""Declares what the bridge needs of a side of ROS: topics that are offered and taken, messages in plain values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

Values = Mapping[str, Any]
"""The fields of a ROS message: numbers, texts, arrays, lists, and mappings for messages inside. Others are zero."""

ROOM = 64
"""Messages of one topic that may wait for the bridge, which takes them 50 times a second; older ones are dropped."""
LARGEST_BYTES = 65_536
"""Of a message from ROS: a velocity has 52 bytes, a request a few hundred."""


class Topic(NamedTuple):
    """A topic of ROS.

    Parameters
    ----------
    name
        Without the leading slash.
    kind
        Its type, ``nav_msgs/msg/Odometry``.
    latched
        Its last message is sent to subscribers that come later (durability "transient local").
    """

    name: str
    kind: str
    latched: bool = False


class Incoming(NamedTuple):
    """A message from ROS as it came; `problem` says why it is none, if that shows without decoding it.

    A call of a service has `reply`, which takes ``success`` and ``message`` of a ``std_srvs/srv/Trigger``.
    """

    topic: str
    sender: str
    data: bytes
    problem: str = ""
    reply: Callable[[bool, str], None] | None = None


class Link(Protocol):
    """One side of ROS. All calls return at once; nothing waits for a slow subscriber.

    Attributes
    ----------
    where : its address, for people
    dropped : messages from ROS that found no room or were too large, and messages to ROS that it did not take in time
    """

    where: str
    dropped: int

    @property
    def up(self) -> bool:
        """Whether it is connected."""
        ...

    def advertise(self, topic: Topic) -> None:
        """Offer a topic. One that is offered already stays as it is."""
        ...

    def subscribe(self, topic: Topic) -> None:
        """Take the messages of a topic from now on; see `take`."""
        ...

    def serve(self, name: str) -> None:
        """Offer a service of the type ``std_srvs/srv/Trigger``, whose calls `take` returns; not every side has them."""
        ...

    def withdraw(self, name: str) -> None:
        """Offer and take a topic no more."""
        ...

    def publish(self, name: str, values: Values) -> None:
        """Send a message on a topic that is offered."""
        ...

    def take(self) -> list[Incoming]:
        """Return what has come since the last call; to be called regularly."""
        ...

    def decode(self, kind: str, data: bytes) -> Any:
        """Return a message of the type `kind`; raises `MessageError`."""
        ...

    def close(self) -> None:
        """Leave. Closing twice is fine."""
        ...
