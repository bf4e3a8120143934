"""ROS 1: a process with the system's Python holds the node (:mod:`.ros1_process`); here is the other end of its pipe.

The pipe is read and written without waiting whenever the bridge takes messages, so no thread is needed. A process that
ends, because the ROS master did, is started again, and is told of all topics.
"""

from __future__ import annotations

import base64
import binascii
import json
import os
import subprocess
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import structlog

from fullswarm.clock import Clock
from fullswarm.errors import ConfigError, Unreachable
from fullswarm.ros_bridge import ros1_process
from fullswarm.ros_bridge.codec import Codec
from fullswarm.ros_bridge.link import LARGEST_BYTES, ROOM, Incoming, Topic, Values

log = structlog.get_logger("fullswarm.ros")
START_S, AGAIN_S, LEAVE_S = 10.0, 2.0, 1.0
"""Longest wait for the first process to be ready; time from the end of one to the start of the next; longest wait for
it to leave the ROS master at the end."""
BACKLOG_BYTES = 4_000_000
"""Of lines that the process has not read: further messages are dropped."""
LONGEST_LINE = 2 * LARGEST_BYTES
READ_BYTES = 65_536
MOST_READS = 2
"""Reads at one time: a flood must not keep the bridge from its own work."""
PYTHON = "/usr/bin/python3"


class Ros1Link:
    """A :class:`~fullswarm.ros_bridge.link.Link` to ROS 1.

    Parameters
    ----------
    master
        URI of the ROS master, ``http://<host>:11311``; empty: that of the environment, or of this computer.
    python
        The Python that has rospy.
    wait
        Called while the first process starts, between two looks.

    Raises
    ------
    ConfigError
        There is no such Python, or it has no rospy.
    MissingExtra
        rosbags is not installed.
    Unreachable
        No ROS master answers.
    """

    def __init__(self, master: str, python: str, clock: Clock, wait: Callable[[], None]) -> None:
        self._environment = {**os.environ, **({"ROS_MASTER_URI": master} if master else {})}
        # Ours is not the Python of the process: what makes it use our packages must not reach it.
        for name in ("VIRTUAL_ENV", "PYTHONHOME"):
            self._environment.pop(name, None)
        shown = self._environment.get("ROS_MASTER_URI", "http://localhost:11311")
        self.where, self.up, self.dropped = f"ROS 1 at {shown}", False, 0
        self._python, self._clock, self._master = python, clock, shown
        self._codec = Codec(1)
        self._topics: dict[str, tuple[str, Topic]] = {}  # name → advertise or subscribe, and the topic
        self._arrived: dict[str, deque[Incoming]] = {}
        self._out, self._in = bytearray(), bytearray()
        self._why, self._ended_s = "", 0.0
        self._process: subprocess.Popen[bytes] | None = None
        self._start()
        if not self._becomes_ready(wait):
            self.close()
            raise self._problem()

    def _becomes_ready(self, wait: Callable[[], None]) -> bool:
        began_s = self._clock.now_s()
        while not self.up and self._process is not None and self._clock.now_s() - began_s < START_S:
            self._serve()
            wait()
        return self.up

    def _problem(self) -> ConfigError | Unreachable:
        if "rospy" in self._why:
            hint = "install it (Debian: apt install python3-rospy), or name the Python that has it with --ros1-python"
            return ConfigError(self._why, hint=hint)
        hint = "start `roscore`, or give its address with --ros1"
        return Unreachable(self._why or "the process with rospy does not answer", where=self._master, hint=hint)

    # ------------------------------------------------------------ topics
    def advertise(self, topic: Topic) -> None:
        """Offer a topic."""
        self._tell("advertise", topic)

    def subscribe(self, topic: Topic) -> None:
        """Take the messages of a topic."""
        self._arrived.setdefault(topic.name, deque(maxlen=ROOM))
        self._tell("subscribe", topic)

    def serve(self, name: str) -> None:
        """Offer nothing: on this side there are topics alone."""

    def _tell(self, op: str, topic: Topic) -> None:
        if topic.name in self._topics:
            return
        self._topics[topic.name] = op, topic
        self._write_topic(op, topic)

    def _write_topic(self, op: str, topic: Topic) -> None:
        text, digest = self._codec.definition(topic.kind)
        package, _, name = topic.kind.split("/")
        self._write({
            "op": op, "topic": f"/{topic.name}", "type": f"{package}/{name}", "md5": digest, "text": text,
            "latch": topic.latched,
        })  # fmt: skip

    def withdraw(self, name: str) -> None:
        """Offer and take a topic no more."""
        self._arrived.pop(name, None)
        if self._topics.pop(name, None) is not None:
            self._write({"op": "withdraw", "topic": f"/{name}"})

    def publish(self, name: str, values: Values) -> None:
        """Send a message; it is dropped while the process is busy or gone."""
        _, topic = self._topics[name]
        if not self.up or len(self._out) > BACKLOG_BYTES:
            self.dropped += 1
            return
        data = base64.b64encode(self._codec.encode(topic.kind, values)).decode()
        self._write({"op": "publish", "topic": f"/{name}", "data": data})

    def take(self) -> list[Incoming]:
        """Exchange lines with the process; return the messages that have come."""
        self._serve()
        if self._process is None and self._clock.now_s() - self._ended_s >= AGAIN_S:
            try:
                self._start()
            except ConfigError as error:  # that Python was removed meanwhile: it may come back
                self._why, self._ended_s = str(error), self._clock.now_s()
        found: list[Incoming] = []
        for waiting in self._arrived.values():
            found += waiting
            waiting.clear()
        return found

    def decode(self, kind: str, data: bytes) -> Any:
        """Return a message; raises ``MessageError``."""
        return self._codec.decode(kind, data)

    def close(self) -> None:
        """End the process."""
        self.up = False
        process, self._process = self._process, None
        if process is not None:
            self._end(process, LEAVE_S)

    # ------------------------------------------------------------ the process
    def _start(self) -> None:
        try:
            process = subprocess.Popen(  # noqa: S603  (the operator names the Python)
                [self._python, str(Path(ros1_process.__file__))],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=self._environment,
                bufsize=0, start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            raise ConfigError(
                f"cannot start the Python with rospy: {error.strerror}", where=self._python, hint="see --ros1-python"
            ) from error
        self._process = process
        self._out.clear()
        self._in.clear()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                os.set_blocking(pipe.fileno(), False)

    def _write(self, line: dict[str, Any]) -> None:
        if self.up:
            self._out += json.dumps(line).encode() + b"\n"
            self._flush()

    def _flush(self) -> None:
        if self._process is None or self._process.stdin is None or not self._out:
            return
        try:
            written = os.write(self._process.stdin.fileno(), self._out)
        except BlockingIOError:
            return
        except OSError:
            return  # it has ended, which shows when it is read
        del self._out[:written]

    def _serve(self) -> None:
        """Write what waits, read what has come."""
        process = self._process
        if process is None or process.stdout is None:
            return
        self._flush()
        for _ in range(MOST_READS):
            try:
                data = os.read(process.stdout.fileno(), READ_BYTES)
            except BlockingIOError:
                return
            if not data:
                self._ended(process)
                return
            self._in += data
            *lines, rest = self._in.split(b"\n")
            self._in = bytearray(rest if len(rest) <= LONGEST_LINE else b"")
            for line in lines:
                self._read(bytes(line))

    def _read(self, text: bytes) -> None:
        try:
            line = json.loads(text)
            if line["op"] == "ready":
                self._ready()
            elif line["op"] == "gone":
                self._why = str(line["why"])
            elif line["op"] == "message":
                self._arrive(str(line["topic"])[1:], str(line["sender"]), base64.b64decode(line["data"]))
        except (ValueError, KeyError, TypeError, binascii.Error):
            self.dropped += 1

    def _arrive(self, topic: str, sender: str, data: bytes) -> None:
        waiting = self._arrived.get(topic)
        if waiting is not None:
            self.dropped += len(waiting) == ROOM
            waiting.append(Incoming(topic, sender, data))

    def _ready(self) -> None:
        self.up = True
        for op, topic in self._topics.values():
            self._write_topic(op, topic)

    def _ended(self, process: subprocess.Popen[bytes]) -> None:
        if self.up:
            log.warning("ROS 1 is gone; trying again", where=self.where, reason=self._why or "rospy's process ended")
        self.up, self._process, self._ended_s = False, None, self._clock.now_s()
        self._end(process, 0.0)

    @staticmethod
    def _end(process: subprocess.Popen[bytes], within_s: float) -> None:
        """Close the pipe, at which the process leaves the ROS master; kill it if it does not."""
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            process.wait(within_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
