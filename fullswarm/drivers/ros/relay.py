"""The driver's port to a robot's zenoh: a relay process holds the session (:mod:`.relay_process`).

Chunks are packets: to the robot one byte, 1 while it is driven and 0 for zero, and the payload; from the robot the
number of the topic and the payload.
"""

from __future__ import annotations

import errno
import json
import os
import socket
import sys
from collections.abc import Sequence
from pathlib import Path

from fullswarm.clock import Clock
from fullswarm.drivers.guardian import NO_ROOM, Attempts, GuardianProcess
from fullswarm.drivers.ports import CONNECT_S, Port, cannot_open
from fullswarm.drivers.ros import relay_process as process
from fullswarm.drivers.ros.relay_process import Task
from fullswarm.errors import DriverError

STARTING = "the process that talks to the robot's zenoh is still starting: this computer is busy or slow"


class RelayPort(Port[bytes]):
    """A zenoh session in a process of its own, which also stops the robot in place of a guardian.

    Raises
    ------
    DriverError
        Nothing answers at the address, this computer has no room for a process, or the last ones have failed.
    """

    gone_hint = "is the robot on, with rmw_zenohd or its zenoh bridge running?"

    def __init__(self, host: str, port: int, task: Task, clock: Clock, attempts: Attempts) -> None:
        where = f"tcp {host}:{port}"
        if attempts.left_s > 0.0:
            hint = f"{self.gone_hint}; the next try is in {attempts.left_s:.1f} s"
            raise DriverError(attempts.why, where=where, hint=hint)
        try:
            socket.create_connection((host, port), timeout=CONNECT_S).close()  # a process is started for no dead robot
        except OSError as error:
            raise cannot_open(where, error) from error
        try:
            self._process = GuardianProcess(
                lambda link: [sys.executable, "-P", str(Path(process.__file__)), str(link), json.dumps(task._asdict())],
                (), clock, attempts, {"PYTHONPATH": os.pathsep.join(each for each in sys.path if each)},
            )  # fmt: skip
        except OSError as error:
            what = f"the process that talks to the robot's zenoh does not start: {error.strerror or error}"
            raise DriverError(what, where=where, hint=NO_ROOM) from error

    @property
    def waits_for(self) -> str:
        """The start of the process, while that lasts."""
        return "" if self._process.has_started else STARTING

    @property
    def guardable(self) -> None:
        """None: the relay is its guardian."""
        return

    def fileno(self) -> int:
        """Return what to wait on."""
        return self._process.socket.fileno()

    def read(self) -> Sequence[bytes]:
        """Return what the topics have brought; raise ``OSError`` when the robot or the relay is gone."""
        received: list[bytes] = []
        for packet in self._process.receive():
            if packet[:1] == process.GONE:
                raise OSError(errno.EIO, packet[1:].decode(errors="replace"))
            if packet[:1] == process.BYTES:
                received.append(packet[1:])
        return received

    def write(self, chunk: bytes) -> bytes | None:
        """Hand over a command."""
        try:
            self._process.send(process.BYTES + chunk)
        except BlockingIOError:
            return chunk
        return None

    def beat(self) -> None:
        """Send the relay a sign of life, and check that it lives; raise ``OSError`` when not."""
        if self._process.overdue():
            self.read()  # a pause of this process looks the same; then the relay's packets are waiting here
            if self._process.overdue():
                raise self._process.hangs()
        if self._process.has_started:
            self._process.beat()

    def close(self) -> None:
        """Let the relay send what it has and end. Closing twice is fine."""
        self._process.leave()
