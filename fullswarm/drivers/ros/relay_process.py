"""The process that holds a driver's zenoh session, and stops the robot when the driver is silent or has died.

Run as a file by :mod:`.relay` with Python's own modules and zenoh, with one end of a packet socket and its task as JSON
(:class:`Task`). A session in the driver's own process could not be used by a guardian: its stream of frames cannot be
continued by another process. Packets are those of :mod:`fullswarm.drivers.guardian_process` (0 a sign of life, 2 the
driver ends on purpose, 3 the link is gone, and why) and:

``1 D payload`` (from the driver)
    A command; D is 1 while the robot is being driven, 0 for zero.
``1 N payload`` (from here)
    What the N-th topic has brought.

After `silence_s` without a packet, or when the driver has died, the zero command is published three times.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import struct
import sys
import threading
import time
from typing import NamedTuple

import zenoh

ALIVE, BYTES, BYE, GONE = b"\0", b"\1", b"\2", b"\3"
BEAT_S = 0.05
REPEATS, REPEAT_S = 3, 0.05
FLUSH_S = 0.1
"""In which the last commands leave: zenoh's own threads send them."""
PACKET = 65536
LARGEST_BYTES = 65536 - 2
BUFFER_BYTES = 32768
"""Of the socket to the driver: a driver that was paused shall not find seconds of old odometry there."""
NO_HASH = "TypeHashNotSupported"
"""The last chunk of a key where the robot's ROS (Humble) has no type hashes."""
GID_BYTES = 16


class Task(NamedTuple):
    """What to connect to, to receive, to send and to declare.

    Parameters
    ----------
    endpoint
        Of the robot's zenoh router or bridge.
    topics
        Key expressions, in the order of their numbers.
    latched
        Numbers of the topics whose last message is wanted although it was sent before.
    command, command_hash
        Key of the commands without its type hash, and that hash; without one the key is whole.
    tokens
        Liveliness tokens by which ROS's tools know of the driver; ``{zid}`` stands for the session's id.
    attach
        Each command bears its number, time and origin, as rmw_zenoh requires.
    stop
        The zero command, hexadecimal.
    silence_s
        After which a driver counts as silent; 0: its death is not acted upon either.
    """

    endpoint: str
    topics: tuple[str, ...]
    latched: tuple[int, ...]
    command: str
    command_hash: str
    tokens: tuple[str, ...]
    attach: bool
    stop: str
    silence_s: float


def attachment(number: int, time_ns: int, gid: bytes) -> bytes:
    """Return what rmw_zenoh expects beside each message: number and time in little endian, length and origin's id."""
    return struct.pack(f"<qqB{GID_BYTES}s", number, time_ns, GID_BYTES, gid)


class Relay:
    """Forwards between a driver and its robot; see the module."""

    def __init__(self, link: socket.socket, task: Task) -> None:
        self._link, self._task = link, task
        self._stop_payload = bytes.fromhex(task.stop)
        self._gid, self._sent = os.urandom(GID_BYTES), 0
        self._hash = task.command_hash
        self._received_s, self._beat_s, self._stop_s = time.monotonic(), -1.0, 0.0
        self._driven, self._stops = False, 0
        self._silent = False
        self._lock = threading.Lock()  # zenoh calls from several threads
        self._session = zenoh.open(_config(task.endpoint))
        self._kept: list[object] = []
        self._declare()

    def _declare(self) -> None:
        session, task = self._session, self._task
        events = zenoh.handlers.Callback(self._on_link, indirect=False)
        self._kept.append(session.info.declare_transport_events_listener(events, history=False))
        for number, key in enumerate(task.topics):
            handler = zenoh.handlers.Callback(_forwarder(self, number), indirect=False)
            if number in task.latched:
                history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
                self._kept.append(zenoh.ext.declare_advanced_subscriber(session, key, handler, history=history))
            else:
                self._kept.append(session.declare_subscriber(key, handler))
        zid = str(session.info.zid())
        for token in task.tokens:
            self._kept.append(session.liveliness().declare_token(token.replace("{zid}", zid)))

    # ------------------------------------------------------------ on zenoh's threads
    def forward(self, number: int, sample: zenoh.Sample) -> None:
        """Hand a message to the driver; one that does not take it now, or is silent, misses it."""
        if number == 0 and self._task.command_hash and str(sample.key_expr).endswith(f"/{NO_HASH}"):
            self._hash = NO_HASH
        if not self._silent and len(sample.payload) <= LARGEST_BYTES:
            self._say(BYTES + bytes([number]) + sample.payload.to_bytes())

    def _on_link(self, event: zenoh.TransportEvent) -> None:
        if event.kind == zenoh.SampleKind.DELETE:
            self._say(GONE + b"the robot's zenoh has closed the connection, or did not answer")

    def _say(self, packet: bytes) -> None:
        with self._lock:
            try:
                self._link.send(packet, socket.MSG_DONTWAIT)
            except OSError:
                return  # it is late or has died, which shows when its packets are read

    # ------------------------------------------------------------ the main thread
    def run(self) -> None:
        """Serve until the driver ends."""
        while self._turn():
            pass
        if self._task.silence_s > 0.0 and self._driven:
            for _ in range(REPEATS):
                self._publish(self._stop_payload)
                time.sleep(REPEAT_S)
        time.sleep(FLUSH_S)

    def _turn(self) -> bool:
        """Wait and act once; return False when the driver has ended."""
        poll = select.poll()
        poll.register(self._link, select.POLLIN)
        if poll.poll(1000.0 * BEAT_S):
            try:
                packet = self._link.recv(PACKET, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return True
            except ConnectionError:
                packet = b""
            if packet[:1] == BYE:
                self._driven = False  # its own final stop came before
                return False
            if not packet:
                return False
            self._take(packet)
        now_s = time.monotonic()
        if now_s - self._beat_s >= BEAT_S:
            self._beat_s = now_s
            self._say(ALIVE)
        self._watch(now_s)
        return True

    def _take(self, packet: bytes) -> None:
        self._received_s, self._silent, self._stops = time.monotonic(), False, 0
        if packet[:1] == BYTES:
            self._driven = packet[1] != 0
            self._publish(packet[2:])

    def _watch(self, now_s: float) -> None:
        """Stop the robot of a driver that is silent."""
        silence_s = self._task.silence_s
        self._silent = silence_s > 0.0 and now_s - self._received_s >= silence_s
        if self._silent and self._driven and self._stops < REPEATS and now_s - self._stop_s >= REPEAT_S:
            self._stops, self._stop_s = self._stops + 1, now_s
            self._publish(self._stop_payload)

    def _publish(self, payload: bytes) -> None:
        task = self._task
        key = f"{task.command}/{self._hash}" if task.command_hash else task.command
        self._sent += 1
        self._session.put(
            key, payload,
            attachment=attachment(self._sent, time.time_ns(), self._gid) if task.attach else None,
            congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME, express=True,
        )  # fmt: skip


def _forwarder(relay: Relay, number: int):  # type: ignore[no-untyped-def]
    return lambda sample: relay.forward(number, sample)


def _config(endpoint: str) -> zenoh.Config:
    """Return a client's settings: nothing is found by accident, and no shared memory is left behind."""
    config = zenoh.Config()
    for name, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/link/tx/lease": 1000,
        "transport/link/rx/max_message_size": 1 << 20,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(name, json.dumps(value))
    return config


def main(arguments: list[str]) -> None:
    """Serve; only the driver ends it, not a signal to its process group."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    link = socket.socket(fileno=int(arguments[0]))
    link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
    task = json.loads(arguments[1])
    try:
        relay = Relay(link, Task(**task))
    except zenoh.ZError as error:
        link.send(GONE + f"no zenoh answers there: {str(error).split(' at /')[0]}".encode()[:1000])
        os._exit(1)
    try:
        relay.run()
    finally:
        os._exit(0)  # closing the session can wait for seconds on a frozen robot, and the kernel closes the link


if __name__ == "__main__":
    main(sys.argv[1:])
