"""Starts guardian processes, which stop a robot whose driver has stalled or died (decision 14).

The driver sends its guardian a packet each 50 ms over a packet socket. When none has come for :data:`SILENCE_S` (the
driver is paused or hangs), or the socket closes (it was killed), the guardian stops the robot. There are two ways:

- :class:`GuardedPort`: the guardian alone holds a serial port. For a robot that keeps its last command for ever and
  whose stop is always the same bytes (Create). A guardian that dies or hangs is a lost link: the driver goes to FAULT
  and starts another one.
- :class:`Guardian`: the port stays with the driver, and the guardian has a duplicate of its descriptor, with the frames
  that stop the robot as it is driven now. For any descriptor: serial, UDP, TCP, CAN. While no guardian watches,
  :attr:`Guardian.trouble` says why, and the driver does not drive.

A guardian may take :data:`START_S` to start: a slow board, busy with its boot, needs seconds for a Python.
"""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers import guardian_process as process
from fullswarm.drivers.base import Description
from fullswarm.drivers.ports import Port, claim
from fullswarm.errors import DriverError

SILENCE_S = 0.3
START_S = 30.0
"""A guardian may take so long before its first packet."""
HANGS_S = 0.5
"""One that sends nothing for so long later is ended: it could not stop the robot."""
LEAVE_S = process.DRAIN_S + 0.5
LONG_WATCHDOG_S = 0.5
"""A device that stops by itself within this time after the driver's last command needs no guardian."""
BACKLOG = 64
AGAIN_S, LONGEST_S = 0.25, 5.0
"""From one guardian that does not start to the next try: at first, and at most."""
NO_ROOM = "end other programs: this computer may be short of memory, processes or open files"
STARTING = "the process that guards this port is still starting: this computer is busy or slow"

C = TypeVar("C")
D = TypeVar("D")


class HolderLost(OSError):
    """The guardian process that holds or watches a port is gone, not the port."""


@runtime_checkable
class TakesGuardian(Protocol):
    """A driver whose robot a guardian can stop, from any package."""

    def guard(self) -> None:
        """Have a guardian from the next `open` on, unless the URL says ``guardian=0``."""
        ...


def needs_guardian(description: Description) -> bool:
    """Tell whether a robot drives on for long when its driver is killed: none, or a slow, watchdog of its own."""
    return description.watchdog_s is None or description.watchdog_s > LONG_WATCHDOG_S


def takes_guardian(driver: object) -> bool:
    """Return whether a guardian can stop the driver's robot; a driver that never has one says so by ``guardable``."""
    return isinstance(driver, TakesGuardian) and bool(getattr(driver, "guardable", True))


def guarded(driver: D) -> D:
    """Return the driver; ask it for a guardian where its device needs one and it can have one."""
    description = getattr(driver, "description", None)
    if isinstance(description, Description) and needs_guardian(description) and isinstance(driver, TakesGuardian):
        driver.guard()
    return driver


@dataclass(frozen=True, slots=True)
class StopPlan(Generic[C]):
    """What a guardian sends in a driver's place; times in seconds from when the driver falls silent or dies.

    Parameters
    ----------
    stop
        Each time with a whole chunk of the port: brings the robot to rest, and is repeated in here as often as needed.
    leave
        What follows if the driver has died: takes the drive away for good.
    """

    stop: tuple[tuple[float, C], ...]
    leave: tuple[tuple[float, C], ...] = ()

    def packed(self, pack: Callable[[C], bytes]) -> StopPlan[bytes]:
        """Return the plan with its chunks as bytes."""
        stop, leave = (tuple((at_s, pack(chunk)) for at_s, chunk in each) for each in (self.stop, self.leave))
        return StopPlan(stop, leave)


class Attempts:
    """Spaces out the starts of guardians that end before their first packet."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._failed = 0
        self._next_s = 0.0
        self.why = ""

    def failed(self, why: str) -> None:
        """Note one that did not start."""
        self._failed += 1
        self._next_s = self._clock.now_s() + min(LONGEST_S, AGAIN_S * 2.0 ** min(self._failed - 1, 8))
        self.why = why

    def worked(self) -> None:
        """Note one that has started."""
        self._failed, self._next_s, self.why = 0, 0.0, ""

    @property
    def left_s(self) -> float:
        """How long to wait before the next."""
        return self._next_s - self._clock.now_s()


class GuardianProcess:
    """A guardian's process and this end of its socket; ``OSError`` when there is no room for one.

    It lives in a session of its own, where no Ctrl-C and no killed process group reaches it.

    Parameters
    ----------
    command
        Returns the command line, given the number of its descriptor of the socket.
    descriptors
        Further descriptors that it inherits.
    environment
        Added to that of this process.
    """

    def __init__(
        self,
        command: Callable[[int], Sequence[str]],
        descriptors: Sequence[int],
        clock: Clock,
        attempts: Attempts,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._clock, self._attempts = clock, attempts
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            try:
                self._process = subprocess.Popen(  # noqa: S603  (our own interpreter and file)
                    command(theirs.fileno()),
                    pass_fds=(*descriptors, theirs.fileno()), start_new_session=True,
                    env=None if environment is None else {**os.environ, **environment},
                    stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                )  # fmt: skip
            except OSError:
                ours.close()
                raise
        ours.setblocking(False)
        self.socket = ours
        self.pid = self._process.pid
        self.has_started = False
        self._received_s = self._clock.now_s()
        self._beat_s = 0.0

    def receive(self) -> list[bytes]:
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
                break  # its last packets come before its end
            if not packet:
                raise self._lost("ended")
            if not self.has_started:
                self.has_started = True
                self._attempts.worked()
            self._received_s = self._clock.now_s()
            packets.append(packet)
        return packets

    def overdue(self) -> bool:
        """Return whether it has been silent for too long."""
        return self._clock.now_s() - self._received_s > (HANGS_S if self.has_started else START_S)

    def hangs(self) -> HolderLost:
        """End it; return what to raise."""
        self._process.kill()
        return self._lost("does not respond")

    def _lost(self, how: str) -> HolderLost:
        if self.has_started:
            return HolderLost(errno.EPIPE, f"its guardian process {how}")
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(LEAVE_S)  # its end of the link is closed: it is ending
        code = self._process.poll()
        died = f" with exit code {code}" if how == "ended" and code is not None else ""
        why = f"its guardian process {how}{died} before it was ready (interpreter: {sys.executable})"
        self._attempts.failed(why)
        return HolderLost(errno.EPIPE, why)

    def send(self, packet: bytes) -> None:
        """Send a packet; ``BlockingIOError`` when it is not taken now, ``HolderLost`` when the guardian has ended."""
        try:
            self.socket.send(packet)
        except BlockingIOError:
            raise
        except OSError as error:
            raise self._lost("ended") from error
        self._beat_s = self._clock.now_s()

    def beat(self) -> None:
        """Send ALIVE unless something was sent within the last :data:`~.guardian_process.BEAT_S`."""
        if self._clock.now_s() - self._beat_s >= process.BEAT_S:
            with suppress(BlockingIOError):  # so many packets wait for it that one more changes nothing
                self.send(process.ALIVE)

    def leave(self) -> None:
        """Let it stop the robot as planned and end."""
        try:
            self.socket.send(process.BYE)
        except OSError:
            self.socket.close()  # closed before, or it ended first
        self.socket.close()
        if not self.has_started:
            self._process.kill()  # it may take long to start, for nothing
        try:
            self._process.wait(LEAVE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _guardian(way: str, port: int, *arguments: str, clock: Clock, attempts: Attempts) -> GuardianProcess:
    """Start a process of :mod:`.guardian_process` over a port."""

    def command(link: int) -> list[str]:
        file = str(Path(process.__file__))
        return [sys.executable, "-I", "-S", file, way, str(port), str(link), str(SILENCE_S), *arguments]

    return GuardianProcess(command, (port,), clock, attempts)


class ProcessPort(Port[bytes]):
    """A port that a guardian holds: what is read and written passes through its process."""

    starting = STARTING
    """What a driver waits for until the process has started."""

    def __init__(self, guardian: GuardianProcess) -> None:
        self._guardian = guardian

    @property
    def pid(self) -> int:
        """The guardian's process."""
        return self._guardian.pid

    @property
    def waits_for(self) -> str:
        """The guardian's start, while that lasts."""
        return "" if self._guardian.has_started else self.starting

    @property
    def guardable(self) -> None:
        """None: it has a guardian."""
        return

    def fileno(self) -> int:
        """Return what to wait on."""
        return self._guardian.socket.fileno()

    def read(self) -> Sequence[bytes]:
        """Return what the robot sent; raise ``OSError`` when the robot or the guardian is gone."""
        received: list[bytes] = []
        for packet in self._guardian.receive():
            if packet[:1] == process.GONE:
                raise OSError(errno.EIO, packet[1:].decode(errors="replace"))
            if packet[:1] == process.BYTES:
                received.append(packet[1:])
        return received

    def beat(self) -> None:
        """Send the guardian a sign of life, and check that it lives; raise ``OSError`` when not."""
        if self._guardian.overdue():
            # A pause of this process looks the same; then the guardian's packets are waiting here.
            self.read()
            if self._guardian.overdue():
                raise self._guardian.hangs()
        if self._guardian.has_started:
            self._guardian.beat()

    def close(self) -> None:
        """Let the guardian stop the robot and end. Closing twice is fine."""
        self._guardian.leave()


class GuardedPort(ProcessPort):
    """A serial port held by a guardian.

    Parameters
    ----------
    park
        The bytes that stop the robot: sent at once, and by the guardian when the driver is silent or has died.
    attempts
        Of this robot's guardians so far.

    Raises
    ------
    DriverError
        See :func:`~fullswarm.drivers.ports.claim`: the port is opened here and handed over. Or this computer has no
        room for a guardian, or the last ones ended before their first packet.
    """

    gone_hint = "plug it in again"

    def __init__(
        self, path: str, baud: int, park: bytes, clock: Clock | None = None, attempts: Attempts | None = None
    ) -> None:
        clock = clock or MonotonicClock()
        attempts = attempts or Attempts(clock)
        if attempts.left_s > 0.0:
            hint = f"the next try is in {attempts.left_s:.1f} s"
            what = f"the process that guards this port does not start: {attempts.why}"
            raise DriverError(what, where=path, hint=hint)
        # Before the guardian starts: a port that does not open is reported as it would be without one.
        with claim(path, baud) as port:
            with suppress(OSError):
                port.write(park)  # the last guardian may have died while the robot drove, and the next one takes time
            try:
                super().__init__(_guardian("relay", port.fileno(), park.hex(), clock=clock, attempts=attempts))
            except OSError as error:
                what = f"the process that guards this port does not start: {error.strerror or error}"
                raise DriverError(what, where=path, hint=NO_ROOM) from error

    def write(self, chunk: bytes) -> bytes | None:
        """Hand over bytes."""
        piece = chunk[: process.CHUNK]
        try:
            self._guardian.send(process.BYTES + piece)
        except BlockingIOError:
            return chunk
        return chunk[len(piece) :] or None


class Guardian:
    """Watches over a port that the driver itself uses, from a process of its own. One thread at a time.

    The driver calls :meth:`beat` each 50 ms or so, and :meth:`stop_with` whenever what stops the robot changes.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or MonotonicClock()
        self._attempts = Attempts(self._clock)
        self._process: GuardianProcess | None = None
        self._descriptor: int | None = None
        self._packet = process.plan(())
        self._sent = False  # the process has the newest plan
        self.trouble = ""
        """Why nothing watches now, for people; empty while it does."""

    @property
    def watching(self) -> bool:
        """Whether it has a port to watch over."""
        return self._descriptor is not None

    def watch(self, descriptor: int) -> None:
        """Begin to watch over a port that has been opened; nothing is to be stopped yet."""
        self.release()
        self._descriptor, self._packet, self._sent = descriptor, process.plan(()), False
        self.trouble = STARTING
        self._start()

    def stop_with(self, plan: StopPlan[bytes] | None, to: tuple[str, int] | None = None) -> None:
        """Leave with the guardian what stops the robot now; None: it is not being driven.

        `to` is the host and port to send to, for a socket that is not connected.
        """
        packet = process.plan(()) if plan is None else process.plan(plan.stop, plan.leave, to)
        if packet != self._packet:
            self._packet, self._sent = packet, False
            self._send()

    def beat(self) -> bool:
        """Send the guardian a sign of life; return whether it has stopped the robot meanwhile.

        A guardian that has ended or hangs is replaced; meanwhile :attr:`trouble` says so.
        """
        guardian, stopped = self._process, False
        try:
            if guardian is None:
                self._start()
                return False
            stopped = process.STOPPED in guardian.receive()
            if guardian.overdue():
                raise guardian.hangs()
            if guardian.has_started:
                guardian.beat()
                self._send()
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
            self._process = _guardian("watch", self._descriptor, clock=self._clock, attempts=self._attempts)
        except OSError as error:
            self._attempts.failed(error.strerror or str(error))
            self.trouble = f"the process that guards this port does not start: {self._attempts.why} ({NO_ROOM})"

    def _send(self) -> None:
        guardian = self._process
        if guardian is None or not guardian.has_started or self._sent:
            return
        with suppress(BlockingIOError):  # then with the next beat
            guardian.send(self._packet)
            self._sent, self.trouble = True, ""

    def _end(self) -> None:
        guardian, self._process, self._sent = self._process, None, False
        if guardian is not None:
            guardian.leave()
