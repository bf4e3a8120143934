"""Runs the conversation with one robot: the thread, the port and the rules of the contract, for every make.

A make describes its conversation as a :class:`LinkSession`: time and bytes in, time and bytes out, no port, no thread,
no clock. :class:`LinkedDriver` does the rest, the same for all: it claims the port and opens it again after it was
lost, drops what was queued for it meanwhile, passes on commands that are finite and stops the robot when none has come
for :data:`TTL_S`, has a guardian stop the robot should this process die, and sends the session's final stop on every
way out: close(), the interpreter's exit, a defect in the session.
"""

from __future__ import annotations

import atexit
import errno
import math
import os
import select
import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Generic, Literal, Protocol, TypeVar, final

import structlog

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.actuators import ActuatorValue, checked
from fullswarm.drivers.base import STAND, Description, Lifecycle, Pose, Reading, Twist
from fullswarm.drivers.guardian import Guardian, HolderLost, StopPlan
from fullswarm.drivers.ports import Port
from fullswarm.errors import DriverError, FullswarmError, LinkLost
from fullswarm.geometry import wrap
from fullswarm.reasons import Code, Reason, given

TTL_S = 0.3
"""A command holds for so long; after that the session stops the robot."""
TICK_S = 0.015
LONGEST_WAIT_S = 0.05
"""A guardian wants a sign of life that often."""
BLIND_WAIT_S = 0.005
"""Between two looks at a port that has nothing to wait on."""
STUCK_S = 0.25
"""A port that takes nothing for so long is lost."""
DRAIN_S = 0.5
"""At most, for the final stop to leave."""
REOPEN_S = 0.25
STARTING_S = 1.0
"""An open port that cannot be used yet for so long is reported as a fault, with what it waits for."""
JOIN_S = 3.0
"""At most, for a port that blocks to release the link thread."""

C = TypeVar("C")
T = TypeVar("T")

ChunkLog = Callable[[str, C], None]
"""Called with ``"<"`` (from the robot) or ``">"`` and the chunk, on the link thread."""

_log = structlog.get_logger("fullswarm.drivers")


class LinkSession(Protocol[C]):
    """One robot from open() to close() as a state machine. Derive from it for the defaults.

    Every method is called under the driver's lock and must not block; times are seconds of one monotonic clock.
    `C` is what the port carries: bytes, or the frames of a bus.
    """

    state: Lifecycle = Lifecycle.OPEN
    fault: str = ""
    reading: Reading | None = None
    unguarded: str = ""
    """Set by the driver: why nothing would stop the robot if this process died. READY and ACTIVE must end with it."""
    description: Description | None = None
    """What has been learned of the robot, where that differs from what was known before connecting."""
    closing_s: float = 0.0
    """How long :meth:`closing` may take."""

    @property
    def firmware(self) -> str:
        """What the device reports that it runs; empty until known."""
        return ""

    def trouble(self, now_s: float) -> Reason:
        """Return why it is in FAULT, or why it does not become or stay ACTIVE; false otherwise."""
        del now_s
        return given(self.fault)

    def read(self) -> Reading | None:
        """Return the newest reading for the agent."""
        return self.reading

    # ------------------------------------------------------------ the link
    def linked(self, now_s: float) -> None:
        """Begin anew: the port has been opened, for the first time or again, and can be used."""
        del now_s

    def lost(self, reason: str, now_s: float) -> None:
        """Note that the port is gone, or still is: FAULT. The driver tries to open it again."""
        del now_s
        self.state, self.fault = Lifecycle.FAULT, reason

    @abstractmethod
    def received(self, chunk: C, now_s: float) -> None:
        """Take what has arrived."""
        ...

    @abstractmethod
    def tick(self, now_s: float) -> Iterable[C]:
        """Do what is due and return what is to be sent; called after each event, and when :meth:`next_due_s` says."""
        ...

    def next_due_s(self, now_s: float) -> float:
        """Return when :meth:`tick` has something to do at the latest; not later than `now_s` for at once."""
        return now_s + TICK_S

    # ------------------------------------------------------------ the agent
    def activate(self, now_s: float) -> None:
        """READY → ACTIVE, or begin to; ignored in other states."""
        del now_s
        if self.state is Lifecycle.READY:
            self.state = Lifecycle.ACTIVE

    def deactivate(self, now_s: float) -> None:
        """ACTIVE → READY with the wheels at zero."""
        self.halt("it was deactivated", now_s)
        if self.state is Lifecycle.ACTIVE:
            self.state = Lifecycle.READY

    @abstractmethod
    def command(self, twist: Twist, now_s: float) -> Twist:
        """Take a set-point that is finite, while ACTIVE; return what is applied after limits and quantisation."""
        ...

    def halt(self, why: str, now_s: float) -> None:
        """Stand: a command was not finite, or none has come for too long. Repeated while that lasts."""
        del why
        self.command(STAND, now_s)

    # ------------------------------------------------------------ what it has beside wheels
    def actuate(self, name: str, value: ActuatorValue, now_s: float) -> None:
        """Note the state that an actuator shall have; the description has it, and takes the value.

        Raises
        ------
        ValueError
            The device does not take it after all.
        DriverError
            The robot takes it in another state only.
        """
        del value, now_s
        raise DriverError(f"'{name}' is declared but cannot be set", hint="define LinkSession.actuate()")

    def deferred(self, now_s: float) -> C | None:
        """Return one chunk that may wait: it is sent when nothing else is left to be sent.

        Nothing can be taken back from a wire. So that a stop never waits for more than one of these, a session hands
        out one at a time, short ones, and not again before the one before has surely left.
        """
        del now_s
        return None

    # ------------------------------------------------------------ the end
    def closing(self, now_s: float) -> None:
        """Begin to close: stop the wheels and put the device into its safe state."""
        self.deactivate(now_s)

    @property
    def at_rest(self) -> bool:
        """Whether nothing is left to do before the port may be closed."""
        return True

    @abstractmethod
    def final_stop(self) -> Iterable[C]:
        """Return what is sent last, whatever has happened: it stops the robot and takes the drive away."""
        ...

    def closed(self) -> None:
        """Release what the session itself holds; nothing is called after this."""
        return

    # ------------------------------------------------------------ the guardian
    def stop_plan(self, now_s: float) -> StopPlan[C] | None:
        """Return what stops the robot as it is driven now; None: it is not driven. The same object while it holds."""
        del now_s
        return None

    def stopped_by_guardian(self, now_s: float) -> None:
        """Note that the guardian has stopped the robot because this process stood still."""
        self.lost("its guardian stopped it: this process did not run for a while", now_s)


class Odometer:
    """Odometry since open() from poses that a robot counts from a place of its own: starts at (0, 0, 0)."""

    def __init__(self) -> None:
        self.pose = Pose(0.0, 0.0, 0.0)
        self._base = self.pose
        self._anchor: Pose | None = None

    def rebase(self) -> None:
        """Go on from here: the robot's own origin is about to change, for example because it has restarted."""
        self._base, self._anchor = self.pose, None

    def update(self, own: Pose) -> Pose:
        """Take a pose in the robot's present frame; return the odometry."""
        base, anchor = self._base, own if self._anchor is None else self._anchor
        self._anchor = anchor
        dx, dy, turn = own.x_m - anchor.x_m, own.y_m - anchor.y_m, base.heading_rad - anchor.heading_rad
        cos, sin = math.cos(turn), math.sin(turn)
        x_m, y_m = base.x_m + cos * dx - sin * dy, base.y_m + sin * dx + cos * dy
        self.pose = Pose(x_m, y_m, wrap(own.heading_rad + turn))
        return self.pose


class CommandGate(Generic[C]):
    """Passes commands to a session: only finite ones, and a stop when none has come for :data:`TTL_S`."""

    def __init__(self, session: LinkSession[C] | None = None) -> None:
        self._session = session
        self._commanded_s = -math.inf

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Pass a set-point on; return what is applied, zero unless ACTIVE. ``ValueError`` if not finite, and a stop."""
        session = self._session
        if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
            if session is not None and session.state is Lifecycle.ACTIVE:
                session.halt("a command was not finite", now_s)
            raise ValueError(f"a set-point must be finite, not {twist}")
        self._commanded_s = now_s
        if session is None or session.state is not Lifecycle.ACTIVE:
            return STAND
        return session.command(twist, now_s)

    def check(self, now_s: float) -> None:
        """Stop a robot that has not been commanded for too long."""
        session = self._session
        if session is not None and session.state is Lifecycle.ACTIVE and now_s - self._commanded_s > TTL_S:
            session.halt(f"no command came for {TTL_S:g} s", now_s)

    def due_s(self, now_s: float) -> float:
        """Return when :meth:`check` may have something to do next."""
        expires_s = self._commanded_s + TTL_S
        return expires_s if expires_s >= now_s else math.inf


class LinkedDriver(Generic[C]):
    """The whole :class:`~fullswarm.drivers.base.Driver` contract over a session and a port.

    A make derives from it once, to read its URL in the constructor and to add what only its robots can do; the methods
    of the contract are final.

    Parameters
    ----------
    session
        Returns a new session, given the time; called by each :meth:`open`.
    port
        Opens the port; raises ``DriverError`` with what to do.
    guardian
        Whether a process of its own stops the robot when this one is killed or paused; None: the opener of the driver
        decides by :meth:`guard`; "never": the session has no stop plan.
    warning
        What an operator must know before the robot drives; logged by :meth:`open`.
    log
        Sees every chunk, on the link thread.
    """

    def __init__(
        self,
        url: str,
        description: Description,
        *,
        session: Callable[[float], LinkSession[C]],
        port: Callable[[], Port[C]],
        guardian: Literal["never"] | bool | None = "never",
        warning: str = "",
        log: ChunkLog[C] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.url, self.description, self.warning = url, description, warning
        self.guardable, self.guarded = guardian != "never", guardian is True
        self._new_session, self._open_port, self._guardian_wanted, self._log = session, port, guardian, log
        self._clock = clock or MonotonicClock()
        self._lock = threading.Lock()  # guards the session and the gate; held for microseconds
        self._session: LinkSession[C] | None = None
        self._gate: CommandGate[C] = CommandGate()
        self._defect = ""  # what ended the link thread
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._wake_r = self._wake_w = -1
        # These belong to the link thread once it runs.
        self._port: Port[C] | None = None
        self._poll = select.poll()
        self._outbox: deque[C] = deque()
        self._moved_s = 0.0  # when the outbox last shrank, or began
        self._descriptor: int | None = None
        self._polls_room = False
        self._guardian: Guardian | None = None
        self._left: tuple[StopPlan[C] | None, tuple[str, int] | None] = None, None  # with the guardian

    # ------------------------------------------------------------ for the agent: nothing here waits
    @property
    def state(self) -> Lifecycle:
        """Where the driver stands."""
        session = self._session
        if self._thread is None or session is None:
            return Lifecycle.CLOSED
        return Lifecycle.FAULT if self._defect else session.state

    @property
    def fault(self) -> str:
        """Why it is in FAULT, or why it does not become or stay ACTIVE, and what to do; empty otherwise."""
        return self._trouble().text

    @property
    def fault_code(self) -> str:
        """The :class:`~fullswarm.reasons.Code` of `fault`, where there is one."""
        code = self._trouble().code
        return "" if code == Code.GIVEN else code

    def _trouble(self) -> Reason:
        session = self._session
        if self._thread is None or session is None:
            return given("")
        if self._defect:
            return given(self._defect)
        with self._lock:
            return session.trouble(self._clock.now_s())

    @property
    def firmware(self) -> str:
        """What the device reports that it runs; empty until known."""
        return "" if self._session is None else self._session.firmware

    @final
    def guard(self) -> None:
        """Have a guardian from the next `open` on, unless the URL says otherwise."""
        self.guarded = self.guardable and self._guardian_wanted is not False

    @final
    def open(self) -> None:
        """Claim the port and start the link thread; opening twice is fine.

        Raises
        ------
        DriverError
            The port is missing, held, forbidden or unreachable; too many files are open.
        """
        if self._thread is not None:
            return
        session = self._new_session(self._clock.now_s())
        try:
            self._port = self._open_port()
            self._wake_r, self._wake_w = self._pipe()
        except FullswarmError:
            self._let_go()
            session.closed()
            raise
        if self.warning:
            _log.warning("no device watchdog", url=self.url, why=self.warning)
        self._session, self._gate, self._defect = session, CommandGate(session), ""
        self._closing.clear()
        # A daemon, because a forgotten driver must not keep a dying process alive; the robot is stopped at exit.
        self._thread = threading.Thread(target=self._run, args=(session,), name=f"link {self.url}", daemon=True)
        atexit.register(self.close)
        self._thread.start()

    def _pipe(self) -> tuple[int, int]:
        try:
            if hasattr(os, "pipe2"):  # macOS has none
                return os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
            ends = os.pipe()
            for each in ends:
                os.set_blocking(each, False)
            return ends
        except OSError as error:
            hint = "end other programs that hold many files or ports"
            what = f"the port cannot be served: {error.strerror or error}"
            raise DriverError(what, where=self.url, hint=hint) from error

    @final
    def activate(self) -> None:
        """READY → ACTIVE, as soon as the robot confirms it; ignored in any other state."""

        def ask(now_s: float) -> None:
            if self._session is not None and not self._session.unguarded and not self._closing.is_set():
                self._session.activate(now_s)

        self.do(ask)

    @final
    def deactivate(self) -> None:
        """ACTIVE → READY with wheels at zero; ends an activation under way."""
        self.do(lambda now_s: self._session.deactivate(now_s) if self._session is not None else None)

    def read(self) -> Reading | None:
        """Return the newest reading; None before the first."""
        with self._lock:
            return None if self._session is None else self._session.read()

    @final
    def command(self, twist: Twist) -> Twist:
        """Take a set-point for 0.3 s; return what is applied after limits and quantisation, zero unless ACTIVE.

        Raises
        ------
        ValueError
            Not finite; the robot stops.
        """
        with self._lock:
            now_s = self._clock.now_s()
            try:
                return self._gate.command(twist, now_s)
            finally:
                if self._session is not None and self._session.next_due_s(now_s) <= now_s:
                    self._wake()

    @final
    def do(self, action: Callable[[float], T]) -> T:
        """Call `action` with the time, under the lock of the session; it is no command that keeps a robot driving."""
        with self._lock:
            try:
                return action(self._clock.now_s())
            finally:
                self._wake()

    def actuate(self, name: str, value: object) -> None:
        """Bring an actuator into a state, behind everything that moves or stops the robot.

        Raises
        ------
        ValueError
            The robot has no such actuator, or it does not take that value.
        DriverError
            The robot takes it in another state only, or the driver is closed.
        """
        found = checked(self.description.actuators, name, value)

        def note(now_s: float) -> None:
            if self._session is None or self._thread is None:
                raise DriverError(f"it cannot set '{name}' while CLOSED", where=self.url, hint="open it first")
            self._session.actuate(name, found, now_s)

        self.do(note)

    @final
    def close(self) -> None:
        """Stop the robot, put it into its safe state, release the port, end the thread. Closing twice is fine."""
        thread, session = self._thread, self._session
        if thread is None or session is None:
            return
        self._closing.set()
        with self._lock:
            self._wake()
        thread.join(session.closing_s + DRAIN_S + JOIN_S)
        atexit.unregister(self.close)
        with self._lock:
            self._thread, self._gate = None, CommandGate()
            if not thread.is_alive():  # a port that blocks keeps it; the device's watchdog has to stop the wheels
                os.close(self._wake_r)
                os.close(self._wake_w)
            self._wake_r = self._wake_w = -1

    def _wake(self) -> None:
        if self._wake_w >= 0:
            with suppress(BlockingIOError):  # so many wakes are pending that one more changes nothing
                os.write(self._wake_w, b"\0")

    # ------------------------------------------------------------ the link thread
    def _run(self, session: LinkSession[C]) -> None:
        self._guardian = Guardian(self._clock) if self.guarded else None
        try:
            while not self._closing.is_set():
                if self._port is None:
                    self._reopen(session)
                else:
                    self._serve(session, self._port)
            self._end(session)
        except Exception as error:
            # Whatever is wrong in the session, the robot must not drive on, and the agent must learn of it.
            self._gate = CommandGate()
            self._defect = f"{self.url}: internal error: {type(error).__name__}: {error}; restart the agent"
        self._stop_for_good(session)

    def _serve(self, session: LinkSession[C], port: Port[C]) -> None:
        """Serve the port until closing, or until it is lost."""
        self._descriptor, self._polls_room = port.fileno(), False
        self._poll = select.poll()
        self._poll.register(self._wake_r, select.POLLIN)
        if self._descriptor is not None:
            self._poll.register(self._descriptor, select.POLLIN)
        try:
            if not self._await(session, port):
                return
            self._watch(port)
            with self._lock:
                session.linked(self._clock.now_s())
            while not self._closing.is_set():
                self._step(session, port)
        except (OSError, LinkLost) as error:
            self._lose(session, port, error)

    def _await(self, session: LinkSession[C], port: Port[C]) -> bool:
        """Wait until the port can be used; return False when it is time to leave."""
        began_s, reported = self._clock.now_s(), False
        while port.waits_for and not self._closing.is_set():
            if self._wait(TICK_S):
                port.read()
            port.beat()
            if not reported and self._clock.now_s() - began_s > STARTING_S:
                reported = True
                with self._lock:
                    session.lost(port.waits_for, self._clock.now_s())
        return not self._closing.is_set()

    def _wait(self, timeout_s: float) -> bool:
        """Wait for bytes, room for bytes, a wake or `timeout_s`; return whether to read."""
        descriptor = self._descriptor
        if descriptor is None:
            timeout_s = min(timeout_s, BLIND_WAIT_S)
        elif self._polls_room != bool(self._outbox):
            self._polls_room = not self._polls_room
            self._poll.modify(descriptor, select.POLLIN | (select.POLLOUT if self._polls_room else 0))
        events = self._poll.poll(max(0.0, timeout_s) * 1000.0)
        readable = descriptor is None
        for ready, event in events:
            if ready == self._wake_r:
                os.read(self._wake_r, 4096)
            elif event & ~select.POLLOUT:
                readable = True
        return readable

    def _step(self, session: LinkSession[C], port: Port[C]) -> None:
        """Wait for an event, take what has arrived, send what is due."""
        now_s = self._clock.now_s()
        due_s = min(session.next_due_s(now_s), self._gate.due_s(now_s), now_s + LONGEST_WAIT_S)
        chunks = port.read() if self._wait(due_s - now_s) else ()
        port.beat()
        # Between reading and parsing, wherever this process was paused: the guardian reports its stop before it
        # sends it, so what the robot shows of it is not taken for a person's doing.
        self._beat(session)
        now_s = self._clock.now_s()
        for chunk in chunks:
            self._note("<", chunk)
            with self._lock:  # one at a time: the agent's calls must not wait for a whole backlog
                session.received(chunk, now_s)
        with self._lock:
            self._gate.check(now_s)
            sent = list(session.tick(now_s))
            plan = session.stop_plan(now_s) if self._guardian is not None else None
        if session.description is not None:
            self.description = session.description
        self._leave(plan, port)  # before the first set-point leaves
        if sent:
            self._queue(sent, now_s)
            self._flush(port)
        if not self._outbox:
            with self._lock:
                waiting = session.deferred(now_s)
            if waiting is not None:
                self._queue([waiting], now_s)
        if self._outbox:
            self._flush(port)
            if self._outbox and self._clock.now_s() - self._moved_s > STUCK_S:
                raise OSError(errno.ETIMEDOUT, "it takes no bytes")

    def _queue(self, chunks: list[C], now_s: float) -> None:
        for chunk in chunks:
            self._note(">", chunk)
        if not self._outbox:
            self._moved_s = now_s
        self._outbox += chunks

    def _flush(self, port: Port[C]) -> None:
        """Send what goes without waiting."""
        outbox = self._outbox
        while outbox:
            rest = port.write(outbox[0])
            if rest is outbox[0]:
                return
            self._moved_s = self._clock.now_s()
            if rest is None:
                outbox.popleft()
            else:
                outbox[0] = rest

    def _note(self, direction: str, chunk: C) -> None:
        if self._log is not None:
            self._log(direction, chunk)

    # ------------------------------------------------------------ the guardian
    def _watch(self, port: Port[C]) -> None:
        """Have the guardian watch over the port that has been opened."""
        descriptor = port.guardable
        if self._guardian is not None and descriptor is not None:
            self._guardian.watch(descriptor)
            self._left = None, None

    def _beat(self, session: LinkSession[C]) -> None:
        """Tell the guardian that this thread runs, and the session what the guardian has done."""
        guardian = self._guardian
        if guardian is None or not guardian.watching:
            return
        stopped = guardian.beat()
        if stopped or guardian.trouble != session.unguarded:
            with self._lock:
                session.unguarded = guardian.trouble
                if stopped:
                    session.stopped_by_guardian(self._clock.now_s())

    def _leave(self, plan: StopPlan[C] | None, port: Port[C]) -> None:
        """Leave with the guardian what stops the robot as it is driven now."""
        guardian = self._guardian
        if guardian is None or not guardian.watching:
            return
        left = plan, port.destination
        if left[0] is self._left[0] and left[1] == self._left[1]:
            return
        self._left = left
        guardian.stop_with(None if plan is None else plan.packed(port.packed), port.destination)

    # ------------------------------------------------------------ losing and closing the port
    def _lose(self, session: LinkSession[C], port: Port[C], error: OSError | LinkLost) -> None:
        self._let_go()
        if isinstance(error, LinkLost):
            reason = str(error)
        elif isinstance(error, HolderLost):
            reason = f"{error.strerror or error}; the driver starts another one"
        else:
            gone = f"the port is gone ({error.strerror or error})"
            reason = f"{gone}: {port.gone_hint}; the driver keeps trying to open it"
        with self._lock:
            session.lost(reason, self._clock.now_s())

    def _reopen(self, session: LinkSession[C]) -> None:
        if self._closing.wait(REOPEN_S):
            return
        try:
            self._port = self._open_port()
        except FullswarmError as error:
            reason = f"{error.what}; {error.hint}; the driver keeps trying"
            with self._lock:
                session.lost(reason, self._clock.now_s())

    def _end(self, session: LinkSession[C]) -> None:
        """Let the session bring the robot into its safe state."""
        port = self._port
        if port is None or port.waits_for:
            return
        with self._lock:
            session.closing(self._clock.now_s())
        end_s = self._clock.now_s() + session.closing_s
        try:
            while not session.at_rest and self._clock.now_s() < end_s:
                self._step(session, port)
        except (OSError, LinkLost) as error:
            self._lose(session, port, error)

    def _stop_for_good(self, session: LinkSession[C]) -> None:
        """Send the final stop, as far as the port still takes it, and release all."""
        port = self._port
        if port is not None:
            with suppress(Exception):  # session or port may be what has failed
                with self._lock:
                    final = list(session.final_stop())
                self._queue(final, self._clock.now_s())
                self._drain(port)
        self._let_go()
        with self._lock:
            session.closed()

    def _drain(self, port: Port[C]) -> None:
        end_s = self._clock.now_s() + DRAIN_S
        room, descriptor = select.poll(), port.fileno()
        if descriptor is not None:
            room.register(descriptor, select.POLLOUT)
        self._flush(port)
        while self._outbox and self._clock.now_s() < end_s:
            room.poll(20.0)
            self._flush(port)
        port.drain(max(0.0, end_s - self._clock.now_s()))

    def _let_go(self) -> None:
        port, self._port = self._port, None
        self._outbox.clear()  # an old set-point must not reach a robot that comes back
        if self._guardian is not None:
            self._guardian.release()
        if port is not None:
            with suppress(OSError):  # of a port that has vanished
                port.close()
