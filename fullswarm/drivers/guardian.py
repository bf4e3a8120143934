"""Guardian processes: they stop a robot whose driver is silent or gone (decision 14).

The driver talks to its guardian over a packet socket and says something each 50 ms. When it is silent for
:data:`SILENCE_S` (paused, hung) or gone (killed), the guardian stops the robot. There are two ways to watch:

- :class:`GuardedPort` has a serial port held by the guardian alone. For a robot that keeps its last command for ever
  and whose stop is always the same bytes (Create). A guardian that dies or hangs is a lost link: the driver goes to
  FAULT and starts another one.
- :class:`Guardian` leaves the port to the driver and a duplicate of it to the guardian, with the frames that stop the
  robot as it is driven now. For any descriptor: serial, UDP, TCP, CAN. Without a guardian that watches, the driver
  says why (:attr:`Guardian.trouble`) and does not drive.

A guardian may take :data:`START_S` to start: a slow board, busy with its boot, needs seconds for a Python.
"""

from __future__ import annotations

import errno
import socket
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers import guardian_process as process
from fullswarm.drivers.base import Description
from fullswarm.drivers.link import HolderLost, claim
from fullswarm.errors import DriverError

SILENCE_S = 0.3
START_S = 30.0
"""A guardian may be silent for so long before its first word."""
HANGS_S = 0.5
"""One that falls silent for so long later is ended: it could not stop the robot."""
LEAVE_S = process.FAREWELL_S + 0.5
LONG_WATCHDOG_S = 0.5
"""A device that stops by itself within this time after the driver's last word needs no guardian."""
BACKLOG = 64
AGAIN_S, LONGEST_S = 0.25, 5.0
"""From one guardian that does not start to the next try: at first, and at most."""
NO_ROOM = "end other programs: this computer may be short of memory, processes or open files"
STARTING = "the process that guards this port is still starting: this computer is busy or slow"


@runtime_checkable
class TakesGuardian(Protocol):
    """A driver that can have its robot stopped by a guardian, from any package."""

    def guard(self) -> None:
        """Have a guardian from the next `open` on, unless the URL says ``guardian=0``."""
        ...


D = TypeVar("D")


def needs_guardian(description: Description) -> bool:
    """Tell whether a robot drives on for long when its driver is killed: none, or a slow, watchdog of its own."""
    return description.watchdog_s is None or description.watchdog_s > LONG_WATCHDOG_S


def guarded(driver: D) -> D:
    """Return the driver, told to have a guardian where its device needs one and it can have one."""
    description = getattr(driver, "description", None)
    if isinstance(description, Description) and needs_guardian(description) and isinstance(driver, TakesGuardian):
        driver.guard()
    return driver


@dataclass(frozen=True, slots=True)
class StopPlan:
    """What a guardian sends in a driver's place; times in seconds from when it falls silent or is gone.

    Parameters
    ----------
    stop
        Each time with a whole frame: brings the robot to rest, and is repeated in here as often as it takes.
    leave
        What follows if the driver is gone: takes the drive away for good.
    to
        Host and port to send to, for a socket that is not connected.
    """

    stop: process.Frames
    leave: process.Frames = ()
    to: tuple[str, int] | None = None


class Attempts:
    """Spaces out the starts of guardians that end before they have said a word."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._failed = 0
        self._next_s = 0.0
        self.why = ""

    def failed(self, why: str) -> None:
        """Take note of one that did not start."""
        self._failed += 1
        self._next_s = self._clock.now_s() + min(LONGEST_S, AGAIN_S * 2.0 ** min(self._failed - 1, 8))
        self.why = why

    def worked(self) -> None:
        """Take note of one that said something."""
        self._failed, self._next_s, self.why = 0, 0.0, ""

    @property
    def left_s(self) -> float:
        """How long to wait before the next."""
        return self._next_s - self._clock.now_s()


class _Process:
    """A guardian's process and our end of its link; ``OSError`` when there is no room for one.

    It lives in a session of its own, where no Ctrl-C and no killed process group reaches it.
    """

    def __init__(self, way: str, port: int, *arguments: str, clock: Clock, attempts: Attempts) -> None:
        self._clock, self._attempts = clock, attempts
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [sys.executable, "-I", "-S", str(Path(process.__file__)), way, str(port), str(theirs.fileno())]
        with theirs:
            try:
                self._process = subprocess.Popen(  # noqa: S603  (our own interpreter and file)
                    [*command, str(SILENCE_S), *arguments],
                    pass_fds=(port, theirs.fileno()), start_new_session=True,
                    stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                )  # fmt: skip
            except OSError:
                ours.close()
                raise
        ours.setblocking(False)
        self.socket = ours
        self.pid = self._process.pid
        self.has_spoken = False
        self._heard_s = self._clock.now_s()
        self._beat_s = 0.0

    def hear(self) -> list[bytes]:
        """Return its packets; raise ``HolderLost`` when it has ended."""
        packets: list[bytes] = []
        for _ in range(BACKLOG):
            try:
                packet = self.socket.recv(process.PACKET)
            except BlockingIOError:
                break
            except ConnectionError:
                packet = b""
            if not packet and packets:
                break  # what it said last comes first
            if not packet:
                raise self._lost("ended")
            if not self.has_spoken:
                self.has_spoken = True
                self._attempts.worked()
            self._heard_s = self._clock.now_s()
            packets.append(packet)
        return packets

    def overdue(self) -> bool:
        """Tell whether it has been silent for too long."""
        return self._clock.now_s() - self._heard_s > (HANGS_S if self.has_spoken else START_S)

    def hangs(self) -> HolderLost:
        """End it; return what to raise."""
        self._process.kill()
        return self._lost("does not respond")

    def _lost(self, how: str) -> HolderLost:
        if self.has_spoken:
            return HolderLost(errno.EPIPE, f"its guardian process {how}")
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(LEAVE_S)  # its end of the link is closed: it is ending
        code = self._process.poll()
        died = f" with exit code {code}" if how == "ended" and code is not None else ""
        why = f"its guardian process {how}{died} before it was ready (interpreter: {sys.executable})"
        self._attempts.failed(why)
        return HolderLost(errno.EPIPE, why)

    def send(self, packet: bytes) -> None:
        """Say something; ``BlockingIOError`` when it does not take it now, ``HolderLost`` when it has ended."""
        try:
            self.socket.send(packet)
        except BlockingIOError:
            raise
        except OSError as error:
            raise self._lost("ended") from error
        self._beat_s = self._clock.now_s()

    def beat(self) -> None:
        """Say "I am alive" if nothing else was said lately."""
        if self._clock.now_s() - self._beat_s >= process.BEAT_S:
            with suppress(BlockingIOError):  # so much waits for it that it knows, or hangs
                self.send(process.ALIVE)

    def leave(self) -> None:
        """Let it do its last work and go."""
        try:
            self.socket.send(process.BYE)
        except OSError:
            self.socket.close()  # closed before, or it went first: its end says the same
        self.socket.close()
        if not self.has_spoken:
            self._process.kill()  # it may take long to start, only to hear that it is over
        try:
            self._process.wait(LEAVE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class GuardedPort:
    """A :class:`~fullswarm.drivers.link.Port` behind a guardian.

    Parameters
    ----------
    park
        The bytes that stop the robot: sent at once, and by the guardian when this side is silent or gone.
    attempts
        Of this robot's guardians so far.

    Raises
    ------
    DriverError
        See :func:`~fullswarm.drivers.link.claim`: the port is opened here and handed over. Or this computer has no
        room for a guardian, or the last ones ended before they said a word.
    """

    def __init__(
        self, path: str, baud: int, park: bytes, clock: Clock | None = None, attempts: Attempts | None = None
    ) -> None:
        clock = clock or MonotonicClock()
        attempts = attempts or Attempts(clock)
        if attempts.left_s > 0.0:
            hint = f"the next try is in {attempts.left_s:.1f} s"
            what = f"the process that guards this port does not start: {attempts.why}"
            raise DriverError(what, where=path, hint=hint)
        # Before the guardian: whoever holds the port, and why it does not open, is said as without one.
        with claim(path, baud) as port:
            with suppress(OSError):
                port.write(park)  # its last guardian may have died while it drove, and the next one takes its time
            try:
                self._guardian = _Process("relay", port.fileno(), park.hex(), clock=clock, attempts=attempts)
            except OSError as error:
                what = f"the process that guards this port does not start: {error.strerror or error}"
                raise DriverError(what, where=path, hint=NO_ROOM) from error

    @property
    def pid(self) -> int:
        """The guardian's process."""
        return self._guardian.pid

    @property
    def waits_for(self) -> str:
        """What it still waits for: its guardian's start."""
        return "" if self._guardian.has_spoken else STARTING

    @property
    def out_waiting(self) -> int:
        """Bytes that have not left yet: the guardian sees to them."""
        return 0

    def fileno(self) -> int:
        """Return what to wait on."""
        return self._guardian.socket.fileno()

    def read(self, size: int) -> bytes:
        """Return what the robot said, empty if nothing; raise ``OSError`` when the port or the guardian is gone."""
        del size
        said = b""
        for packet in self._guardian.hear():
            if packet[:1] == process.GONE:
                raise OSError(errno.EIO, packet[1:].decode(errors="replace"))
            if packet[:1] == process.BYTES:
                said += packet[1:]
        return said

    def write(self, data: bytes | bytearray) -> int:
        """Hand over bytes; raise ``BlockingIOError`` when they are not taken now."""
        piece = bytes(data[: process.MOUTHFUL])
        self._guardian.send(process.BYTES + piece)
        return len(piece)

    def beat(self) -> None:
        """Tell the guardian that this side is alive, and see that it is; raise ``OSError`` when not."""
        if self._guardian.overdue():
            # A pause of this process looks the same; then the guardian's words are waiting here.
            self.read(process.MOUTHFUL)
            if self._guardian.overdue():
                raise self._guardian.hangs()
        if self._guardian.has_spoken:
            self._guardian.beat()

    def close(self) -> None:
        """Let the guardian stop the robot and go. Closing twice is fine."""
        self._guardian.leave()


class Guardian:
    """Watches over a port that the driver itself uses, from a process of its own. One thread at a time.

    The driver calls :meth:`beat` each 50 ms or so, and :meth:`stop_with` whenever what stops the robot changes.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or MonotonicClock()
        self._attempts = Attempts(self._clock)
        self._process: _Process | None = None
        self._descriptor: int | None = None
        self._packet = process.plan(())
        self._told = False  # the process knows the newest plan
        self.trouble = ""
        """Why nothing watches now, for people; empty while it does."""

    @property
    def watching(self) -> bool:
        """Whether it has a port to watch over."""
        return self._descriptor is not None

    def watch(self, descriptor: int) -> None:
        """Begin to watch over a port that has been opened; nothing is to be stopped yet."""
        self.release()
        self._descriptor, self._packet, self._told = descriptor, process.plan(()), False
        self.trouble = STARTING
        self._start()

    def stop_with(self, plan: StopPlan | None) -> None:
        """Leave with the guardian what stops the robot now; None: it is not being driven."""
        packet = process.plan(()) if plan is None else process.plan(plan.stop, plan.leave, plan.to)
        if packet != self._packet:
            self._packet, self._told = packet, False
            self._tell()

    def beat(self) -> bool:
        """Tell the guardian that the driver is alive; return whether it has stopped the robot meanwhile.

        A guardian that has ended or hangs is replaced; meanwhile :attr:`trouble` says so.
        """
        guardian, stopped = self._process, False
        try:
            if guardian is None:
                self._start()
                return False
            stopped = process.STOPPED in guardian.hear()
            if guardian.overdue():
                raise guardian.hangs()
            if guardian.has_spoken:
                guardian.beat()
                self._tell()
        except OSError as error:
            self.trouble = f"{error.strerror or error}; another one is being started"
            self._end()
        return stopped

    def release(self) -> None:
        """Let go of the port: it is about to be closed, or is gone."""
        self._descriptor, self.trouble = None, ""
        self._end()

    def _start(self) -> None:
        if self._descriptor is None or self._attempts.left_s > 0.0:
            return
        try:
            self._process = _Process("watch", self._descriptor, clock=self._clock, attempts=self._attempts)
        except OSError as error:
            self._attempts.failed(error.strerror or str(error))
            self.trouble = f"the process that guards this port does not start: {self._attempts.why} ({NO_ROOM})"

    def _tell(self) -> None:
        guardian = self._process
        if guardian is None or not guardian.has_spoken or self._told:
            return
        with suppress(BlockingIOError):  # then with the next beat
            guardian.send(self._packet)
            self._told, self.trouble = True, ""

    def _end(self) -> None:
        guardian, self._process, self._told = self._process, None, False
        if guardian is not None:
            guardian.leave()
