"""Runs nodes: one thread, a mailbox and timers, on the wall clock or on a simulated one.

A node never sees a thread. Whatever arrives (a bus message, a signal) is put into the :class:`Mailbox`; the
runtime takes it out and calls the node, never two handlers or timers at once. Timers have absolute deadlines, so
they do not drift; a tick that is a whole period late is skipped, counted and published, never caught up.
"""

from __future__ import annotations

import heapq
import itertools
import math
import queue
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from types import FrameType
from typing import Any, Protocol, TypeVar

from fullswarm.clock import Clock, SimClock

HANG_UP: signal.Signals | None = getattr(signal, "SIGHUP", None)
"""Sent when a terminal is closed; None on Windows."""
LATE_S = 0.001
"""A tick counts as late from here on."""

LONGEST_WAIT_S = 0.25
"""The kernel may hand a signal to a thread of the bus; Python then acts on it only when this thread wakes up."""

AT_ONCE = 256
"""Messages that one call of :meth:`Runtime.serve_due` delivers at most."""

WHILE_LATE = 16
"""Messages that a loop delivers before overdue timers fire again: with one of them, more would come than go."""

FETCH_S = 0.05
"""Longest time between two calls of a :data:`Source`: as often as robots tell their states."""

Handler = Callable[[Any], None]
Item = tuple[Handler, Any, Handler]
Source = Callable[[], bool]
"""Delivers some of the messages that wait elsewhere, on the runtime's thread; returns whether more wait there."""
T = TypeVar("T")


class Lane(IntEnum):
    """Kinds of messages of other processes in the order in which a mailbox delivers them."""

    ORDERS = 0
    """What stops, starts and steers robots, and the answers: in one order, because a stop must not be carried out
    before a request that was sent earlier, which would start the robot again."""
    STATES = 1
    READS = 2
    """Questions, statistics, what is only shown to people."""


ROOM = (2000, 4000, 4000)
"""Messages that wait in each lane at most. Stops are delivered however many wait."""


class Mailbox:
    """A thread-safe queue of (handler, message), and the gate that keeps nodes single-threaded.

    Handlers run one at a time, in the order of arrival; of messages that were put into lanes the first lane comes
    first. Normally the runtime's thread runs them. While it waits and nothing is queued, the thread that brings an
    urgent message may run its handler itself (:meth:`run_now`): waking another thread would cost as much as the rest of
    the way through this process.

    Attributes
    ----------
    dropped : dict
        Lane or cause → messages that were dropped since the start.
    """

    def __init__(self) -> None:
        self.on_put: Callable[[bool], None] | None = None
        """Called after each put, on the thread that puts: wakes a loop that waits for something else, too. The argument
        tells whether the message is urgent; states and what is only read are not."""
        self.dropped: dict[str, int] = {}
        # None stands for one message of a lane, the first one there is when its turn comes.
        self._queue: queue.SimpleQueue[tuple[Handler, Any] | None] = queue.SimpleQueue()
        # Rung by each put. `SimpleQueue.get` with a timeout never returns when the thread loses the processor for that
        # long within it (CPython 3.11 to 3.12): loops froze on a loaded machine until the next message.
        self._bell = threading.Lock()
        self._bell.acquire()
        self._lanes: tuple[deque[Item], ...] = tuple(deque() for _ in Lane)
        self._waiting = 0
        self._count = threading.RLock()  # reentrant: a signal handler may put while its own thread puts
        # Closed except while the runtime waits, so no foreign thread ever meets a node that is being built or busy.
        self._gate = threading.Lock()
        self._gate.acquire()
        self._wanted = False  # by the runtime's thread: a lock is not fair, and a stream of messages would keep it out
        self._sources: tuple[Source, ...] = ()

    def add_source(self, source: Source) -> None:
        """Have `source` called before messages are delivered, at least each `FETCH_S`. Any thread may add."""
        with self._count:
            self._sources = (*self._sources, source)

    def remove_source(self, source: Source) -> None:
        """Call `source` no more, which may be running now. Any thread may remove."""
        with self._count:
            self._sources = tuple(each for each in self._sources if each != source)

    @property
    def fetch_s(self) -> float:
        """In what time :meth:`fetch` is to be called again; infinite without sources."""
        return FETCH_S if self._sources else math.inf

    def fetch(self) -> bool:
        """Have the sources deliver what waits there; return whether more does."""
        more = False
        for source in self._sources:
            more |= source()
        return more

    def put(self, handler: Handler, message: Any) -> None:
        """Have `handler` called with `message` on the runtime's thread. Any thread may put. Nothing is dropped."""
        with self._count:
            self._waiting += 1
        self._queue.put((handler, message))
        self._ring()

    def _ring(self, urgent: bool = True) -> None:
        if self._bell.locked():
            with suppress(RuntimeError):  # another thread has rung it just now
                self._bell.release()
        if self.on_put is not None:
            self.on_put(urgent)

    def put_into(self, lane: Lane, handler: Handler, message: Any, on_drop: Handler, *, always: bool = False) -> None:
        """Do the same with a message that may be dropped when too many wait; then call `on_drop(message)`.

        The oldest of the lane is dropped, of orders the new one: those before it may be stops. `always`: it is a stop
        and is never dropped.
        """
        items, lost = self._lanes[lane], (handler, message, on_drop)
        with self._count:
            full = len(items) >= ROOM[lane] and not always
            if not full:
                self._waiting += 1
                items.append(lost)
            else:
                name = lane.name.lower()
                self.dropped[name] = self.dropped.get(name, 0) + 1
                if lane is not Lane.ORDERS:
                    items.append(lost)
                    lost = items.popleft()
        if full:
            lost[2](lost[1])
        else:
            self._queue.put(None)
        self._ring(lane is Lane.ORDERS)

    def note_drop(self, cause: str) -> None:
        """Count a message that was dropped before it came here."""
        with self._count:
            self.dropped[cause] = self.dropped.get(cause, 0) + 1

    def run_now(self, handler: Handler, message: Any) -> bool:
        """Run `handler` on this thread if the runtime is waiting and nothing is queued; else return False.

        What the handler raises is raised again on the runtime's thread.
        """
        if self._wanted or not self._empty() or not self._gate.acquire(blocking=False):
            return False
        try:
            if not self._empty():
                return False
            handler(message)
        except BaseException as error:  # any kind: it must end the process as it would on the runtime's thread
            self.put(_raise, error)
        finally:
            self._gate.release()
        return True

    def _empty(self) -> bool:
        return self._waiting == 0

    def drain(self, most: int | None = None) -> int:
        """Deliver all that is there, and what that causes, but not more than `most`; return how many."""
        count, waiting = 0, self._queue
        while count != most and not waiting.empty():
            self._handle(waiting.get_nowait())
            count += 1
        return count

    def deliver_one(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` for one message and deliver it; False when none came, perhaps sooner."""
        if timeout_s > 0 and self._queue.empty() and not self.fetch():
            self._gate.release()
            try:
                self._bell.acquire(timeout=min(timeout_s, self.fetch_s))
            finally:
                self._wanted = True
                self._gate.acquire()
                self._wanted = False
        try:
            item = self._queue.get_nowait()
        except queue.Empty:
            return False
        self._handle(item)
        return True

    def _handle(self, item: tuple[Handler, Any] | None) -> None:
        if item is None:
            for lane in self._lanes:
                if lane:  # one of them is: each None of the queue stands for a message
                    item = lane.popleft()[:2]
                    break
            else:
                return
        try:
            item[0](item[1])
        finally:
            with self._count:
                self._waiting -= 1


def _raise(error: BaseException) -> None:
    raise error


class Timer:
    """A callback at a fixed rate or, with no period, once."""

    __slots__ = ("active", "callback", "due_s", "late", "missed", "period_s", "ticks", "worst_late_s")

    def __init__(self, due_s: float, period_s: float | None, callback: Callable[[], None]) -> None:
        self.due_s, self.period_s, self.callback = due_s, period_s, callback
        self.active = True
        self.ticks = self.late = self.missed = 0
        self.worst_late_s = 0.0

    def cancel(self) -> None:
        """Never call again."""
        self.active = False


class Scheduler(Protocol):
    """What a node may use of the runtime."""

    def now_s(self) -> float:
        """Return the node's monotonic time in seconds."""
        ...

    def every(self, period_s: float, callback: Callable[[], None], *, first_s: float | None = None) -> Timer:
        """Call `callback` each `period_s`, first after `first_s` (default: one period)."""
        ...

    def after(self, delay_s: float, callback: Callable[[], None]) -> Timer:
        """Call `callback` once after `delay_s`."""
        ...


@dataclass(frozen=True, slots=True)
class LoopStats:
    """Sum over a runtime's timers: how well the deadlines were kept; and what its mailbox has dropped, by lane."""

    ticks: int
    late: int
    missed: int
    worst_late_s: float
    dropped: Mapping[str, int] = field(default_factory=dict)


class Runtime:
    """One thread that serves a set of nodes."""

    def __init__(self, clock: Clock, mailbox: Mailbox | None = None) -> None:
        self.clock = clock
        self.mailbox = mailbox or Mailbox()
        self._timers: list[tuple[float, int, Timer]] = []
        self._order = itertools.count()
        self._stopping = self._paused = False
        self._simulated = isinstance(clock, SimClock)
        self._thread = threading.get_ident()
        self.exit_signal: int | None = None

    def now_s(self) -> float:
        """Return the clock's seconds."""
        return self.clock.now_s()

    def every(self, period_s: float, callback: Callable[[], None], *, first_s: float | None = None) -> Timer:
        """Call `callback` each `period_s` on an absolute grid, first after `first_s` (default one period)."""
        if not period_s > 0:
            raise ValueError(f"a period must be positive, not {period_s} s")
        return self._add(Timer(self.now_s() + (period_s if first_s is None else first_s), period_s, callback))

    def after(self, delay_s: float, callback: Callable[[], None]) -> Timer:
        """Call `callback` once after `delay_s`."""
        return self._add(Timer(self.now_s() + delay_s, None, callback))

    def _add(self, timer: Timer) -> Timer:
        heapq.heappush(self._timers, (timer.due_s, next(self._order), timer))
        if threading.get_ident() != self._thread:
            self.mailbox.put(_nothing, None)  # set by a handler on another thread: the loop may wait too long
        return timer

    def stats(self) -> LoopStats:
        """Return how the periodic timers have kept their deadlines so far."""
        ticks = late = missed = 0
        worst_late_s = 0.0
        for _, _, timer in self._timers:
            if timer.period_s is not None:
                ticks += timer.ticks
                late += timer.late
                missed += timer.missed
                worst_late_s = max(worst_late_s, timer.worst_late_s)
        return LoopStats(ticks, late, missed, worst_late_s, self.mailbox.dropped)

    def stop(self) -> None:
        """End :meth:`run` for good after the current callback. Any thread or signal handler may call it."""
        self._stopping = True
        self.mailbox.put(_nothing, None)

    def pause(self) -> None:
        """End the present :meth:`run` after the current callback; it may be called again."""
        self._paused = True
        self.mailbox.put(_nothing, None)

    def stop_on_signals(self) -> None:
        """Let Ctrl-C, SIGTERM and a closed terminal end :meth:`run` in order; a second Ctrl-C or SIGTERM exits at once.

        Under ``nohup`` a closed terminal changes nothing.
        """

        def on_signal(number: int, _frame: FrameType | None) -> None:
            if self._stopping:
                if number == HANG_UP:
                    return  # the shell sends one and the kernel another: that is one request
                signal.signal(number, signal.SIG_DFL)
                signal.raise_signal(number)
            self.exit_signal = number
            self.stop()

        for number in (signal.SIGINT, signal.SIGTERM, HANG_UP):
            if number is not None and (number != HANG_UP or signal.getsignal(number) != signal.SIG_IGN):
                signal.signal(number, on_signal)

    def run(self, duration_s: float | None = None) -> None:
        """Serve until :meth:`stop` or, with `duration_s`, for that long.

        On a :class:`SimClock` time jumps from deadline to deadline: messages are delivered in the order they
        were put, before the next timer, so a run repeats to the byte.
        """
        self._paused = False
        end_s = float("inf") if duration_s is None else self.now_s() + duration_s
        if self._simulated:
            self._run_simulated(end_s)
        else:
            self._run_live(end_s)

    def serve_due(self) -> float:
        """Deliver what has come, fire what is due, and return: for a thread that another loop runs on.

        Returns
        -------
        float
            Seconds until it must be called again; sooner when :attr:`Mailbox.on_put` says so. 0: there is more.
        """
        # Messages first, but a flood of them must neither starve a deadline nor the other loop.
        more = self.mailbox.fetch()
        more |= self.mailbox.drain(most=AT_ONCE) == AT_ONCE
        self._fire_due()
        if more:
            return 0.0
        next_s = self._timers[0][0] - self.now_s() if self._timers else LONGEST_WAIT_S
        return max(0.0, min(next_s, self.mailbox.fetch_s))

    def _run_simulated(self, end_s: float) -> None:
        clock, mailbox, timers = self.clock, self.mailbox, self._timers
        assert isinstance(clock, SimClock)  # noqa: S101  (narrows the type; run() has checked)
        mailbox.drain()
        while not (self._stopping or self._paused):
            if not timers or timers[0][0] > end_s:
                if end_s != float("inf"):
                    clock.advance_to(end_s)
                return
            due_s, _, timer = heapq.heappop(timers)
            if not timer.active:
                continue
            clock.advance_to(due_s)
            if timer.period_s is not None:
                timer.ticks += 1
                timer.due_s = due_s + timer.period_s
                heapq.heappush(timers, (timer.due_s, next(self._order), timer))
            timer.callback()
            mailbox.drain()

    def _run_live(self, end_s: float) -> None:
        with _short_switch_interval():
            while not (self._stopping or self._paused):
                due_s = min(self._timers[0][0] if self._timers else end_s, end_s)
                wait_s = due_s - self.now_s()
                if self.mailbox.deliver_one(min(wait_s, LONGEST_WAIT_S)):
                    # Messages first, but a flood of them must not starve a deadline.
                    if self.now_s() < due_s:
                        continue
                    self.mailbox.drain(most=WHILE_LATE)
                elif self.now_s() < due_s:
                    continue
                if self.now_s() >= end_s:
                    return
                self.mailbox.fetch()  # what is due shall know it
                self._fire_due()

    def _fire_due(self) -> None:
        now_s = self.now_s()
        while self._timers and self._timers[0][0] <= now_s and not (self._stopping or self._paused):
            _, _, timer = heapq.heappop(self._timers)
            if not timer.active:
                continue
            if timer.period_s is not None:
                _count(timer, now_s - timer.due_s)
                heapq.heappush(self._timers, (timer.due_s, next(self._order), timer))
            timer.callback()


class RuntimeThread:
    """A runtime on a thread of its own, for a program that does something else meanwhile.

    Whatever belongs to its nodes is called by :meth:`call`. The thread is a daemon: a program that forgets to close it
    ends all the same.

    Parameters
    ----------
    name
        Of the thread.
    on_end
        Called last on the thread, also after an error, which is logged as that of any thread.
    """

    def __init__(self, clock: Clock, name: str, on_end: Callable[[], None]) -> None:
        self._clock, self._on_end, self._lock, self._open = clock, on_end, threading.Lock(), True
        started: Future[Runtime] = Future()
        self._thread = threading.Thread(target=self._serve, args=(started,), name=name, daemon=True)
        self._thread.start()
        self.runtime = started.result()

    @property
    def alive(self) -> bool:
        """Whether it serves."""
        return self._open

    def call(self, function: Callable[[], T]) -> Future[T]:
        """Have `function` called on the thread; return its result to come.

        Raises
        ------
        RuntimeError
            The thread has ended.
        """
        future: Future[T] = Future()

        def run(_: object) -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(function())
            except Exception as error:
                future.set_exception(error)

        with self._lock:
            if not self.alive:
                raise RuntimeError("the thread of this runtime has ended")
            self.runtime.mailbox.put(run, None)
        return future

    def close(self, last: Callable[[], None]) -> None:
        """Call `last` on the thread and end it. Closing twice is fine."""
        with self._lock:
            was_open, self._open = self._open, False
        if was_open:

            def end(_: object) -> None:
                try:
                    last()
                finally:
                    self.runtime.stop()

            self.runtime.mailbox.put(end, None)
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _serve(self, started: Future[Runtime]) -> None:
        runtime = Runtime(self._clock)
        started.set_result(runtime)
        try:
            runtime.run()
        finally:
            with self._lock:
                self._open = False
            self._on_end()


def _count(timer: Timer, late_s: float) -> None:
    """Book one tick and set the next deadline on the same grid, past any that were missed."""
    period_s = timer.period_s or 0.0
    skipped = int(late_s // period_s)
    timer.ticks += 1
    timer.missed += skipped
    timer.late += late_s > LATE_S
    timer.worst_late_s = max(timer.worst_late_s, late_s)
    timer.due_s += (skipped + 1) * period_s


def _nothing(_: object) -> None:
    """Wake the loop."""


class _short_switch_interval:  # noqa: N801
    """Let bus threads hand over within 0.5 ms instead of 5 ms while a loop runs (GIL switch interval)."""

    def __enter__(self) -> None:
        self._before = sys.getswitchinterval()
        sys.setswitchinterval(0.0005)

    def __exit__(self, *_: object) -> None:
        sys.setswitchinterval(self._before)
