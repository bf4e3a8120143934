"""The driver's port to a robot's zenoh: a relay process holds the session (:mod:`.relay_process`).

Chunks are packets: to the robot one byte, 1 while it is driven and 0 for zero, and the payload; from the robot the
number of the topic and the payload.
"""

from __future__ import annotations

import json
import os
import socket
import sys
from pathlib import Path

from fullswarm.clock import Clock
from fullswarm.drivers.guardian import NO_ROOM, Attempts, GuardianProcess, ProcessPort
from fullswarm.drivers.ports import CONNECT_S, cannot_open
from fullswarm.drivers.ros import relay_process as process
from fullswarm.drivers.ros.relay_process import Task
from fullswarm.errors import DriverError


class RelayPort(ProcessPort):
    """A zenoh session in a process of its own, which also stops the robot in place of a guardian.

    Raises
    ------
    DriverError
        Nothing answers at the address, this computer has no room for a process, or the last ones have failed.
    """

    starting = "the process that talks to the robot's zenoh is still starting: this computer is busy or slow"
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
            relay = GuardianProcess(
                lambda link: [sys.executable, "-P", str(Path(process.__file__)), str(link), json.dumps(task._asdict())],
                (), clock, attempts, {"PYTHONPATH": os.pathsep.join(each for each in sys.path if each)},
            )  # fmt: skip
        except OSError as error:
            what = f"the process that talks to the robot's zenoh does not start: {error.strerror or error}"
            raise DriverError(what, where=where, hint=NO_ROOM) from error
        super().__init__(relay)

    def write(self, chunk: bytes) -> bytes | None:
        """Hand over a command."""
        try:
            self._guardian.send(process.BYTES + chunk)
        except BlockingIOError:
            return chunk
        return None
