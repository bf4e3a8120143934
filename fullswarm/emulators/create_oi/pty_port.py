"""The robot's side of a serial port made of a pseudo-terminal: a path to open, a rate, bytes, a cable to pull.

The path is a link that outlives an unplugging, as ``/dev/serial/by-id`` does.
"""

from __future__ import annotations

import errno
import fcntl
import os
import struct
import tempfile
import termios
import tty
from collections import deque
from pathlib import Path

from fullswarm.emulators.faults import BadLink, LinkFaults
from fullswarm.errors import DriverError

LATE_BYTES = 4000
"""A reader who lets this pile up loses what follows, as with a real port's buffer. A terminal counts up to 4095."""

MOUTHFUL = 4096
PTS = "/dev/pts/"
"""Where a link left behind by an emulator leads; any other is somebody else's."""

RATES = {getattr(termios, f"B{rate}"): rate for rate in (300, 600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)}


class PtyPort:
    """One port. Not thread-safe.

    Parameters
    ----------
    path
        The link to create; None puts it into a new folder. A file beside it (``.lock``) says that it is in use.

    Raises
    ------
    DriverError
        Something else is at `path`, or another emulator uses it.
    """

    def __init__(self, path: str | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="create-") if path is None else None
        self.path = str(Path(self._folder.name) / "port") if self._folder is not None else str(path)
        self.master: int | None = None
        self._slave: int | None = None
        self._lock_file = _lock(self.path)

    def plug(self) -> None:
        """Make the port; does nothing when it is there."""
        if self.master is not None:
            return
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)  # or the terminal echoes the robot's words back to it
        os.set_blocking(self.master, False)
        link = Path(self.path)
        link.unlink(missing_ok=True)  # of an emulator that was killed
        link.symlink_to(os.ttyname(self._slave))

    def pull(self) -> None:
        """Pull the cable: whoever has the port open loses it, and the path is gone."""
        if self.master is None or self._slave is None:
            return
        Path(self.path).unlink(missing_ok=True)
        os.close(self.master)
        os.close(self._slave)
        self.master = self._slave = None

    def close(self) -> None:
        """Remove the port and all traces of it. Closing twice is fine."""
        self.pull()
        if self._lock_file >= 0:
            Path(f"{self.path}.lock").unlink(missing_ok=True)
            os.close(self._lock_file)
            self._lock_file = -1
        if self._folder is not None:
            self._folder.cleanup()

    @property
    def baud(self) -> int | None:
        """The rate that the other side has set; 0 for one that no robot has, None when unplugged."""
        return None if self.master is None else RATES.get(termios.tcgetattr(self.master)[5], 0)

    def hear(self) -> bytes:
        """Return what has arrived."""
        if self.master is None:
            return b""
        try:
            return os.read(self.master, MOUTHFUL)
        except BlockingIOError:
            return b""

    def say(self, data: bytes) -> None:
        """Send bytes; lost when nobody reads."""
        if self.master is None or self._slave is None:
            return
        (waiting,) = struct.unpack("i", fcntl.ioctl(self._slave, termios.FIONREAD, b"\0" * 4))
        if waiting >= LATE_BYTES:
            return
        try:
            os.write(self.master, data)
        except BlockingIOError:
            return


class Wire:
    """One direction of the cable: what is put in comes out when its last bit is through, if it is not lost.

    Parameters
    ----------
    faults
        Read at each chunk.
    """

    def __init__(self, faults: LinkFaults, seed: int) -> None:
        self._faults, self._link = faults, BadLink(faults, seed)
        self._free_s = 0.0
        self._arrivals: deque[float] = deque()

    @property
    def due_s(self) -> float | None:
        """When the next chunk may come out; None when nothing is on the way."""
        return self._arrivals[0] if self._arrivals else None

    def put(self, data: bytes, now_s: float, baud: int) -> None:
        """Send a chunk: ten bits a byte, one after the other."""
        if not data:
            return
        self._free_s = max(self._free_s, now_s) + 10.0 * len(data) / baud
        self._link.put(data, self._free_s)
        self._arrivals.append(self._free_s + self._faults.delay_s)

    def take(self, now_s: float) -> bytes:
        """Return what has come out by now."""
        while self._arrivals and self._arrivals[0] <= now_s:
            self._arrivals.popleft()
        return b"".join(self._link.due(now_s))

    def clear(self) -> None:
        """Forget what is on the way."""
        self._link.clear()
        self._arrivals.clear()
        self._free_s = 0.0


def _lock(path: str) -> int:
    """Claim a path among emulators; the kernel lets go of it when the process dies. Return the lock's descriptor."""
    link = Path(path)
    ours = link.is_symlink() and str(link.readlink()).startswith(PTS)
    if not ours and (link.exists() or link.is_symlink()):
        raise DriverError("there is something else already", where=path, hint="choose another path for the port")
    try:
        lock = os.open(f"{path}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        hint = "its folder must exist and be writable"
        raise DriverError(f"no port can be made here: {error.strerror}", where=path, hint=hint) from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        if error.errno not in (errno.EAGAIN, errno.EACCES):
            raise DriverError(f"the port cannot be locked: {error.strerror}", where=path) from error
        raise DriverError(
            "another emulator uses this path", where=path, hint="end it, or choose another path"
        ) from None
    return lock
