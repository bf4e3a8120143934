"""The process that holds the bridge's node of ROS 1; run as a file by :mod:`.ros1_link`, with the system's Python.

rospy is part of the system (Debian, or /opt/ros), and runs with no other Python than that; so this file uses nothing
but rospy and Python 3.8. It knows no message types: each line names type, MD5 sum and definition, and messages are
bytes, in base64. Lines of JSON come on standard input::

    {"op": "advertise", "topic": "/r1/odom", "type": …, "md5": …, "text": …, "latch": false}
    {"op": "subscribe", "topic": "/r1/cmd_vel", "type": …, "md5": …, "text": …}
    {"op": "publish", "topic": "/r1/odom", "data": …}
    {"op": "withdraw", "topic": "/r1/odom"}

and go to standard output: ``{"op": "ready"}``, ``{"op": "message", "topic": …, "sender": …, "data": …}`` and, before
this process ends by itself, ``{"op": "gone", "why": …}``. It ends with its input, or when the ROS master is gone.
"""

from __future__ import annotations

import base64
import json
import os
import signal
import socket
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # Python 3.8 could not evaluate these
    from collections.abc import Callable

    Line = dict[str, Any]
    Answer = Callable[[Line], None]

MASTER_S = 1.0
"""Period in which the master is asked whether it is there."""
LOST = 3
"""Unanswered questions after which it is gone."""
QUEUE = 10
"""Messages that wait for one slow subscriber; rospy drops older ones."""
LARGEST_BYTES = 65536


class Node:
    """Publishers and subscriptions of rospy, by topic."""

    def __init__(self, rospy: Any, answer: Answer) -> None:
        self._rospy, self._answer = rospy, answer
        self._publishers: dict[str, Any] = {}
        self._subscribers: dict[str, Any] = {}

    def obey(self, line: Line) -> None:
        """Carry out one line."""
        topic = line["topic"]
        if line["op"] == "publish":
            publisher = self._publishers.get(topic)
            if publisher is not None:
                message = publisher.data_class()
                message.data = base64.b64decode(line["data"])
                publisher.publish(message)
        elif line["op"] == "advertise":
            kind = message_class(line)
            self._publishers[topic] = self._rospy.Publisher(topic, kind, queue_size=QUEUE, latch=line["latch"])
        elif line["op"] == "subscribe":
            kind = message_class(line)
            self._subscribers[topic] = self._rospy.Subscriber(
                topic, kind, self._receive, callback_args=topic, queue_size=QUEUE, buff_size=LARGEST_BYTES
            )
        elif line["op"] == "withdraw":
            for found in (self._publishers.pop(topic, None), self._subscribers.pop(topic, None)):
                if found is not None:
                    found.unregister()

    def _receive(self, message: Any, topic: str) -> None:
        if len(message.data) <= LARGEST_BYTES:
            header = message._connection_header  # noqa: SLF001  (rospy's documented way to the sender)
            sender = str(header.get("callerid", "unknown"))[:100]
            data = base64.b64encode(message.data).decode()
            self._answer({"op": "message", "topic": topic, "sender": sender, "data": data})


def message_class(line: Line) -> Any:
    """Return a class for messages of a type that are already bytes."""
    import genpy

    def start(self: Any, *_args: Any, **_kwargs: Any) -> None:
        self.data = b""

    def serialize(self: Any, buff: Any) -> None:
        buff.write(self.data)

    def deserialize(self: Any, data: bytes) -> Any:
        self.data = data
        return self

    return type(str(line["type"]).replace("/", "_"), (genpy.Message,), {
        "_type": str(line["type"]), "_md5sum": str(line["md5"]), "_full_text": str(line["text"]), "_has_header": False,
        "__slots__": ["data"], "_slot_types": ["uint8[]"], "_get_types": lambda _: ["uint8[]"],
        "__init__": start,
        "serialize": serialize, "deserialize": deserialize,
        "serialize_numpy": lambda self, buff, _: serialize(self, buff),
        "deserialize_numpy": lambda self, data, _: deserialize(self, data),
    })  # fmt: skip


def answerer() -> Answer:
    """Return what writes a line; standard output itself is closed to rospy, which logs there."""
    out, lock = os.fdopen(os.dup(1), "w"), threading.Lock()
    os.dup2(2, 1)

    def answer(line: Line) -> None:
        with lock:
            try:
                out.write(json.dumps(line) + "\n")
                out.flush()
            except OSError:
                os._exit(0)  # the bridge has ended

    return answer


def watch(rosgraph: Any, answer: Answer) -> None:
    """End this process when the master is gone or another one: it knows our topics no longer."""
    failed, first = 0, None
    while True:
        try:
            run = rosgraph.Master("/fullswarm_bridge").getParam("/run_id")
            failed = 0
        except rosgraph.MasterError:
            run, failed = None, 0  # a master without a run id: it answers, which is enough
        except (OSError, rosgraph.MasterException):
            failed += 1
        if failed == 0 and run is not None:
            if first is not None and run != first:
                failed = LOST
            first = run
        if failed >= LOST:
            answer({"op": "gone", "why": "the ROS master does not answer, or was started again"})
            os._exit(1)
        time.sleep(MASTER_S)


def main() -> None:
    """Serve until the input ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the bridge ends this process, after its last zeros
    answer = answerer()
    try:
        import rosgraph
        import rospy
    except ImportError:
        answer({"op": "gone", "why": "this Python has no rospy: " + sys.executable})
        os._exit(1)
    socket.setdefaulttimeout(2.0)
    if not rosgraph.is_master_online():
        answer({"op": "gone", "why": "no ROS master answers at " + rosgraph.get_master_uri()})
        os._exit(1)
    socket.setdefaulttimeout(None)  # connections to other nodes may be silent for long
    rospy.init_node("fullswarm_bridge", anonymous=True, disable_signals=True, disable_rosout=True)
    threading.Thread(target=watch, args=(rosgraph, answer), daemon=True).start()
    node = Node(rospy, answer)
    answer({"op": "ready"})
    for text in sys.stdin:
        try:
            node.obey(json.loads(text))
        except Exception as error:  # rospy raises many kinds when the master is gone; `watch` notices that as well
            sys.stderr.write("fullswarm bridge: " + str(error) + "\n")
    rospy.signal_shutdown("the bridge has ended")
    os._exit(0)


if __name__ == "__main__":
    main()
