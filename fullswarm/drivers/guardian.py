"""A serial port held by a process of its own, for robots without a watchdog (decision 14).

The driver talks to its guardian over a packet socket and is expected to say something each 50 ms. When it is silent
for :data:`SILENCE_S` (paused, hung) or gone (killed), the guardian stops the robot. A guardian that dies or hangs is a
lost link: the driver goes to FAULT and starts another one, whose first words stop the robot.
"""

from __future__ import annotations

import errno
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers import guardian_process as process
from fullswarm.drivers.link import claim
from fullswarm.errors import DriverError

SILENCE_S = 0.3
HANGS_S = 0.5
"""A guardian that is silent for so long is ended: it could not stop the robot."""
LEAVE_S = process.FAREWELL_S + 0.5
BACKLOG = 64
GUARDED_SCHEMES = ("create",)
OPTION = "guardian"
NO_ROOM = "end other programs: this computer may be short of memory, processes or open files"


def guarded_url(url: str) -> str:
    """Return the URL with which an agent opens a driver: with a guardian where the make needs one.

    A URL that says ``guardian=0`` or ``guardian=1`` is left as it is.
    """
    parts = urlsplit(url)
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    if parts.scheme not in GUARDED_SCHEMES or OPTION in options:
        return url
    return f"{url}{'&' if parts.query else '?'}{OPTION}=1"


class GuardedPort:
    """A :class:`~fullswarm.drivers.link.Port` behind a guardian.

    Parameters
    ----------
    park
        The bytes that stop the robot; sent by the guardian when this side is silent or gone.

    Raises
    ------
    DriverError
        See :func:`~fullswarm.drivers.link.claim`: the port is opened here and handed over. Or this computer has no
        room for a guardian.
    """

    def __init__(self, path: str, baud: int, park: bytes, clock: Clock | None = None) -> None:
        self._clock = clock or MonotonicClock()
        # Before the guardian: whoever holds the port, and why it does not open, is said as without one.
        with claim(path, baud) as port:
            try:
                self._socket, self._process = _start(port.fileno(), park)
            except OSError as error:
                with suppress(OSError):
                    port.write(park)  # its last guardian may have died while it drove, and there is no next one yet
                what = f"the process that guards this port does not start: {error.strerror or error}"
                raise DriverError(what, where=path, hint=NO_ROOM) from error
        self._socket.setblocking(False)
        self._heard_s = self._clock.now_s()
        self._beat_s = 0.0

    @property
    def pid(self) -> int:
        """The guardian's process."""
        return self._process.pid

    @property
    def out_waiting(self) -> int:
        """Bytes that have not left yet: the guardian sees to them."""
        return 0

    def fileno(self) -> int:
        """Return what to wait on."""
        return self._socket.fileno()

    def read(self, size: int) -> bytes:
        """Return what the robot said, empty if nothing; raise ``OSError`` when the port or the guardian is gone."""
        del size
        said = b""
        for _ in range(BACKLOG):
            try:
                packet = self._socket.recv(process.PACKET)
            except BlockingIOError:
                break
            if not packet:
                raise OSError(errno.EPIPE, "its guardian has ended")
            if packet[:1] == process.GONE:
                raise OSError(errno.EIO, packet[1:].decode(errors="replace"))
            self._heard_s = self._clock.now_s()
            if packet[:1] == process.BYTES:
                said += packet[1:]
        return said

    def write(self, data: bytes | bytearray) -> int:
        """Hand over bytes; raise ``BlockingIOError`` when they are not taken now."""
        piece = bytes(data[: process.MOUTHFUL])
        self._socket.send(process.BYTES + piece)
        self._beat_s = self._clock.now_s()
        return len(piece)

    def beat(self) -> None:
        """Tell the guardian that this side is alive, and see that it is; raise ``OSError`` when not."""
        now_s = self._clock.now_s()
        if now_s - self._heard_s > HANGS_S:
            # A pause of this process looks the same; then the guardian's words are waiting here.
            self.read(process.MOUTHFUL)
            if now_s - self._heard_s > HANGS_S:
                self._process.kill()
                raise OSError(errno.ETIMEDOUT, "its guardian hangs")
        if now_s - self._beat_s >= process.BEAT_S:
            self._beat_s = now_s
            try:
                self._socket.send(process.ALIVE)
            except BlockingIOError:
                return  # so much waits for the guardian that it knows, or hangs

    def close(self) -> None:
        """Let the guardian stop the robot and go. Closing twice is fine."""
        try:
            self._socket.send(process.BYE)
        except OSError:
            self._socket.close()  # closed before, or it went first: its end says the same
        self._socket.close()
        try:
            self._process.wait(LEAVE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _start(port: int, park: bytes) -> tuple[socket.socket, subprocess.Popen[bytes]]:
    """Start a guardian and return our end of its link; ``OSError`` when there is no room for one.

    It lives in a session of its own, where no Ctrl-C and no killed process group reaches it.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    command = [sys.executable, "-I", "-S", str(Path(process.__file__))]
    with theirs:
        try:
            return ours, subprocess.Popen(  # noqa: S603  (our own interpreter and file)
                [*command, str(port), str(theirs.fileno()), park.hex(), str(SILENCE_S)],
                pass_fds=(port, theirs.fileno()), start_new_session=True,
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except OSError:
            ours.close()
            raise
