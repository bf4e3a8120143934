"""One serial port and the one thread that touches it: claims it, reads, writes, ticks, re-opens it when it is gone.

A driver never waits for a port: :meth:`SerialLink.send` queues, the link thread writes. What is queued when the
port vanishes is dropped, so that an old set-point cannot reach a robot that comes back.
"""

from __future__ import annotations

import atexit
import errno
import os
import select
import termios
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import serial

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.errors import DriverError
from fullswarm.reasons import Code

STUCK_S = 0.25
"""A port that takes no byte for this long is lost."""

FAREWELL_S = 0.5
"""At most, for the last words to leave."""

MOUTHFUL = 512
"""Bytes handed over at once: a user works under a lock that must not be held long."""

PATIENCE_S = 1.0
"""An open port that cannot be used yet for so long is told as a fault, with what it waits for."""

ByteLog = Callable[[str, bytes], None]
"""Called with ``"<"`` (from the robot) or ``">"`` and the bytes, on the link thread."""


class HolderLost(OSError):
    """The process that holds the port is gone, not the port."""


class LinkUser(Protocol):
    """What a driver does with a link; called on the link thread, except for the first `linked`, within open()."""

    def linked(self) -> None:
        """Take note that the port has been opened (again), or can be used now."""
        ...

    def received(self, data: bytes) -> None:
        """Take bytes that arrived."""
        ...

    def tick(self) -> None:
        """Do what is due: called after each event and at least each `tick_s` while the port is open."""
        ...

    def lost(self, reason: str) -> None:
        """Take note that the port is gone; the link tries to open it again."""
        ...


class Port(Protocol):
    """An open port as the link uses it; nothing here blocks, ``OSError`` means that the port is gone."""

    @property
    def waits_for(self) -> str:
        """What must come before it can be used, for people; empty: nothing."""
        ...

    @property
    def out_waiting(self) -> int:
        """Bytes taken, but not yet on the wire."""
        ...

    def fileno(self) -> int:
        """Return what to wait on."""
        ...

    def read(self, size: int, /) -> bytes:
        """Return what has come, empty if nothing for the user."""
        ...

    def write(self, data: bytes | bytearray, /) -> int:
        """Return how many bytes were taken; raises ``BlockingIOError`` for none."""
        ...

    def beat(self) -> None:
        """Note that the link is alive; called each `tick_s` at least."""
        ...

    def close(self) -> None:
        """Let go of it; closing twice is fine."""
        ...


Opener = Callable[[str, int], Port]
"""Opens a path at a rate; raises ``DriverError`` with what to do."""


class PlainPort:
    """A :class:`Port` that this process holds itself. Raises as :func:`claim`."""

    def __init__(self, path: str, baud: int) -> None:
        self._port = claim(path, baud)

    @property
    def waits_for(self) -> str:
        """Nothing."""
        return ""

    @property
    def out_waiting(self) -> int:
        """Bytes in the system's buffer."""
        return int(self._port.out_waiting)

    def fileno(self) -> int:
        """Return the descriptor."""
        descriptor: int = self._port.fileno()
        return descriptor

    def read(self, size: int) -> bytes:
        """Read what is there."""
        data = os.read(self.fileno(), size)
        if not data:
            raise OSError(errno.EIO, "hung up")
        return data

    def write(self, data: bytes | bytearray) -> int:
        """Write what goes."""
        return os.write(self.fileno(), data)

    def beat(self) -> None:
        """Nobody watches this port."""

    def close(self) -> None:
        """Let go of it."""
        self._port.close()


class SerialLink:
    """A serial port, claimed exclusively.

    Parameters
    ----------
    path, baud
        The port; 8N1, no flow control.
    user
        Whom to call.
    opener
        What opens the port, :class:`PlainPort` unless somebody else shall hold it.
    last_words
        Sent before the port is closed, whatever the reason: close(), the interpreter's exit, a defect in `user`.
    """

    def __init__(
        self,
        path: str,
        baud: int,
        user: LinkUser,
        *,
        opener: Opener = PlainPort,
        last_words: bytes = b"",
        tick_s: float = 0.015,
        retry_s: float = 0.25,
        log: ByteLog | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._path, self._baud, self._user, self._last_words = path, baud, user, last_words
        self._tick_s, self._retry_s, self._log, self._opener = tick_s, retry_s, log, opener
        self._clock = clock or MonotonicClock()
        self._port: Port | None = None
        self._outbox = bytearray()
        self._lock = threading.Lock()  # guards the outbox
        self._stopping = False
        self._thread: threading.Thread | None = None
        self._wake_r, self._wake_w = -1, -1
        self._moved_s = 0.0  # when the outbox last shrank or was empty

    def open(self) -> None:
        """Claim the port and start the thread.

        Raises
        ------
        DriverError
            The port is missing, held by somebody else, forbidden, or no serial port; too many files are open.
        """
        self._port = self._opener(self._path, self._baud)
        try:
            self._wake_r, self._wake_w = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            self._let_go()
            hint = "end other programs that hold many files or ports"
            raise DriverError(f"the port cannot be served: {_reason(error)}", where=self._path, hint=hint) from error
        self._thread = threading.Thread(target=self._run, name=f"link {self._path}", daemon=True)
        # A daemon thread dies unheard when the interpreter exits, and some robots would drive on for ever.
        atexit.register(self.close)
        self._user.linked()
        self._thread.start()

    def send(self, data: bytes) -> None:
        """Queue bytes. Any thread; never blocks; dropped while the port is gone."""
        with self._lock:
            if self._port is None:
                return
            self._outbox += data
            self._wake()

    def close(self) -> None:
        """Send the last words, let go of the port, end the thread. Closing twice is fine."""
        if self._thread is None:
            return
        atexit.unregister(self.close)
        self._stopping = True
        self._wake()
        self._thread.join()
        self._thread = None
        os.close(self._wake_r)
        os.close(self._wake_w)

    # ------------------------------------------------------------ the link thread
    def _run(self) -> None:
        reason = ""
        try:
            while not self._stopping:
                if self._port is None:
                    self._reopen()
                else:
                    self._serve(self._port)
        except Exception as error:
            # Whatever is wrong in the user, the robot must not drive on, and nobody should see a stack trace.
            reason = f"internal error: {type(error).__name__}: {error}"
        self._leave()
        if reason:
            self._user.lost(reason)

    def _await(self, port: Port) -> bool:
        """Wait until the port can be used; return False when it is gone, or it is time to leave."""
        if not port.waits_for:
            return True
        began_s, told = self._clock.now_s(), False
        poll = select.poll()
        poll.register(self._wake_r, select.POLLIN)
        poll.register(port.fileno(), select.POLLIN)
        while port.waits_for and not self._stopping:
            self._drain_wakes(self._wake_r in dict(poll.poll(self._tick_s * 1000.0)))
            try:
                port.read(MOUTHFUL)
                port.beat()
            except OSError as error:
                self._lose(error)
                return False
            if not told and self._clock.now_s() - began_s > PATIENCE_S:
                told = True
                self._user.lost(port.waits_for)
        with self._lock:
            self._outbox.clear()  # what was said into the void meanwhile
        self._user.linked()
        return not self._stopping

    def _serve(self, port: Port) -> None:
        if not self._await(port):
            return
        self._moved_s = self._clock.now_s()
        poll = select.poll()
        poll.register(self._wake_r, select.POLLIN)
        descriptor = port.fileno()
        while not self._stopping:
            poll.register(descriptor, select.POLLIN | (select.POLLOUT if self._outbox else 0))
            events = dict(poll.poll(self._tick_s * 1000.0))
            self._drain_wakes(self._wake_r in events)
            try:
                data = self._exchange(port, events.get(descriptor, 0))
                port.beat()
            except OSError as error:
                self._lose(error)
                return
            if data:
                self._user.received(data)
            self._user.tick()

    def _exchange(self, port: Port, events: int) -> bytes:
        """Read and write what goes without waiting. Raises ``OSError`` when the port is gone."""
        data = b""
        if events & (select.POLLIN | select.POLLHUP | select.POLLERR | select.POLLNVAL):
            data = port.read(MOUTHFUL)
            if data:
                self._note("<", data)
        self._write(port)
        if self._outbox and self._clock.now_s() - self._moved_s > STUCK_S:
            raise OSError(errno.ETIMEDOUT, "it takes no bytes")
        return data

    def _write(self, port: Port) -> None:
        with self._lock:
            if self._outbox:
                try:
                    count = port.write(self._outbox)
                except BlockingIOError:
                    return
                sent = bytes(self._outbox[:count])
                del self._outbox[:count]
            else:
                sent = b""
        self._moved_s = self._clock.now_s()
        if sent:
            self._note(">", sent)

    def _reopen(self) -> None:
        poll = select.poll()
        poll.register(self._wake_r, select.POLLIN)
        self._drain_wakes(bool(poll.poll(self._retry_s * 1000.0)))
        if self._stopping:
            return
        try:
            port = self._opener(self._path, self._baud)
        except DriverError as error:
            self._user.lost(f"{error.what}; {error.hint}; the driver keeps trying")
            return
        with self._lock:
            self._port = port
        self._user.linked()

    def _lose(self, error: OSError) -> None:
        self._let_go()
        if isinstance(error, HolderLost):
            self._user.lost(f"{_reason(error)}; the driver starts another one")
        else:
            gone = f"the port is gone ({_reason(error)})"
            self._user.lost(f"{gone}: plug it in again; the driver keeps trying to open it")

    def _let_go(self) -> None:
        with self._lock:
            port, self._port = self._port, None
            self._outbox.clear()
        if port is not None:
            port.close()

    def _leave(self) -> None:
        """Say the last words, as far as the port still takes them, and close it."""
        port = self._port
        if port is not None:
            with self._lock:
                self._outbox += self._last_words
            try:
                self._see_off(port)
            except OSError:
                self._outbox.clear()  # the port went first; nothing can be told to the robot any more
        self._let_go()

    def _see_off(self, port: Port) -> None:
        end_s = self._clock.now_s() + FAREWELL_S
        poll = select.poll()
        poll.register(port.fileno(), select.POLLOUT)
        while self._outbox and self._clock.now_s() < end_s:
            poll.poll(20)
            self._write(port)
        while port.out_waiting and self._clock.now_s() < end_s:
            select.select([], [], [], 0.002)

    def _drain_wakes(self, woken: bool) -> None:
        if woken:
            os.read(self._wake_r, 4096)

    def _wake(self) -> None:
        try:
            os.write(self._wake_w, b"\0")
        except BlockingIOError:
            return  # so many wakes are pending that one more changes nothing

    def _note(self, direction: str, data: bytes) -> None:
        if self._log is not None:
            self._log(direction, data)


def claim(path: str, baud: int) -> serial.Serial:
    """Open a port for this process alone; reading and writing never block.

    Raises
    ------
    DriverError
        With what to do about it.
    """
    try:
        return serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
    except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError
        number = getattr(error, "errno", None)
        what, hint = _advice(path, number, error)
        code = Code.PORT_HELD if number in (errno.EAGAIN, errno.EBUSY) else Code.NONE
        raise DriverError(what, where=path, hint=hint, code=code) from error


def _advice(path: str, number: int | None, error: Exception) -> tuple[str, str]:
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO):
        return "there is no such port", f"plug the robot in; ports now: {', '.join(_ports()) or 'none'}"
    if number in (errno.EACCES, errno.EPERM):
        return "you may not use this port", "run 'sudo usermod -aG dialout $USER' and log in again"
    if number in (errno.EAGAIN, errno.EBUSY):
        holders = _holders(path)
        by = f" by {', '.join(holders)}" if holders else ""
        return f"the port is held{by}", "end that program; one port serves one driver"
    if number == errno.ENOTTY or "not configure port" in str(error):
        return "this is not a serial port", f"ports now: {', '.join(_ports()) or 'none'}"
    return f"the port does not open: {error}", "check the path and the baud rate"


def _reason(error: OSError) -> str:
    return error.strerror or str(error)


def _ports() -> list[str]:
    devices = Path("/dev")
    named = sorted(str(each) for each in (devices / "serial" / "by-id").glob("*"))
    return named or sorted(str(each) for kind in ("ttyUSB*", "ttyACM*", "ttyAMA*") for each in devices.glob(kind))


def _holders(path: str) -> list[str]:
    """Name the processes that have the port open, as far as this user may look."""
    device, holders = Path(path).resolve(), []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(_leads_to(each, device) for each in (process / "fd").iterdir()):
                holders.append(f"{(process / 'comm').read_text().strip()} (pid {process.name})")
        except OSError:
            continue  # ended meanwhile, or somebody else's
    return holders


def _leads_to(link: Path, device: Path) -> bool:
    try:
        return link.readlink() == device
    except OSError:
        return False
