"""Processes that run trials: one trial each at a time, with a hard time limit, replaced when they die."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.evaluate.experiment import Trial, TrialResult

Work = Callable[[Trial, int], TrialResult]
"""Runs a trial for the nth time."""

DYING_S = 5.0
"""A process whose pipe is closed has ended by then."""
IDLE_S = 1.0
PR_SET_PDEATHSIG = 1
"""Of Linux's ``prctl``."""


def serve(connection: Connection, work: Work, parent: int) -> None:
    """Run the trials that come through `connection` until it ends: what a worker process does."""
    from fullswarm.logs import log_to_stderr

    _leave_group()
    _die_with(parent)
    log_to_stderr(warnings_only=True)  # a thousand trials brake a thousand times: that is counted, not logged
    while True:
        try:
            trial, attempt = connection.recv()
        except EOFError:
            return
        try:
            connection.send(work(trial, attempt))
        except BrokenPipeError:
            return


def _leave_group() -> None:
    """Have a group of its own: ended with all that a trial has started, and out of reach of Ctrl-C."""
    if sys.platform == "win32":  # no groups: Ctrl-C is ignored, and a lockstep trial has started nothing
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    else:
        os.setsid()


def _die_with(parent: int) -> None:
    """Have the kernel end this process when `parent` dies; where it cannot, the end of the pipe does later."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)


@contextmanager
def uninterruptible_children() -> Iterator[None]:
    """Start processes that Ctrl-C does not reach: they would end with stack traces, and we end them anyway."""
    if sys.platform == "win32":  # no masks: the child ignores the signal once it has started
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # of multiprocessing; starting it unblocks the signal
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@dataclass(slots=True)
class Worker:
    """A process, and the trial that it has in hand for the nth time."""

    process: SpawnProcess
    connection: Connection
    trial: Trial | None = None
    attempt: int = 1
    began_s: float = 0.0

    def end(self, dying: bool = False) -> int | None:
        """Kill it and all that it has started; return the exit code it had before, None if it was alive.

        Parameters
        ----------
        dying : it has closed its end of the pipe
        """
        self.connection.close()
        if dying:
            self.process.join(DYING_S)
        code = self.process.exitcode
        if self.process.pid is not None and sys.platform != "win32":
            with suppress(ProcessLookupError, PermissionError):  # before it made a group; after all of it ended
                os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()
        self.process.join()
        self.process.close()
        return code


class Pool:
    """Runs trials in `jobs` processes; a context manager, after which none is left.

    Parameters
    ----------
    timeout_s : wall-clock seconds after which a trial is killed
    work : what a worker does with a trial; importable by its name
    retries : how often a trial is run again whose process died or ran out of time
    idle : called about once a second while trials run
    """

    def __init__(
        self, jobs: int, timeout_s: float, work: Work, clock: Clock | None = None, retries: int = 0,
        idle: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        self._timeout_s, self._work, self._retries, self._idle = timeout_s, work, retries, idle
        self._clock = clock or MonotonicClock()
        # Spawned, not forked: a fork would inherit threads' locks, and Bullet's global state.
        self._context = multiprocessing.get_context("spawn")
        self._waiting: deque[tuple[Trial, int]] = deque()
        self._workers: list[Worker] = []
        try:
            for _ in range(jobs):
                self._workers.append(self._start())
        except BaseException:  # Ctrl-C, too: nothing else knows of those that have been started
            self.__exit__()
            raise

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        while self._workers:
            self._workers.pop().end()

    def run(self, trials: Sequence[Trial]) -> Iterator[tuple[Trial, TrialResult]]:
        """Yield each trial with its result as it ends; every trial ends once."""
        self._waiting = deque((trial, 1) for trial in trials)
        left = len(trials)
        for worker in self._workers:
            self._give(worker)
        while left:
            for index, trial in self._ended():
                result = self._take(index, trial)
                self._give(self._workers[index])
                if result is not None:
                    left -= 1
                    yield trial, result

    def _start(self) -> Worker:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=serve, args=(theirs, self._work, os.getpid()), daemon=True)
        with uninterruptible_children():
            process.start()
        theirs.close()
        return Worker(process, ours)

    def _give(self, worker: Worker) -> None:
        worker.trial = None
        if not self._waiting:
            return
        worker.trial, worker.attempt = self._waiting.popleft()
        worker.began_s = self._clock.now_s()
        with suppress(BrokenPipeError):  # it died while it had nothing to do: noticed when it is to answer
            worker.connection.send((worker.trial, worker.attempt))

    def _ended(self) -> list[tuple[int, Trial]]:
        """Wait until a worker has answered, died or run out of time; return which, and what it had in hand."""
        busy = [(index, each, each.trial) for index, each in enumerate(self._workers) if each.trial is not None]
        next_s = min((each.began_s for _, each, _ in busy), default=0.0) + self._timeout_s - self._clock.now_s()
        ready = wait([each.connection for _, each, _ in busy], timeout=min(max(0.0, next_s), IDLE_S))
        self._idle()
        late_s = self._clock.now_s() - self._timeout_s
        return [(index, trial) for index, each, trial in busy if each.connection in ready or each.began_s <= late_s]

    def _take(self, index: int, trial: Trial) -> TrialResult | None:
        """Return a worker's answer, or why there is none; None: the trial is run again.

        A worker that gave no answer is replaced by a new process.
        """
        worker = self._workers[index]
        wall_s = self._clock.now_s() - worker.began_s
        failure, dying = f"it took longer than {self._timeout_s:.0f} s", False
        try:
            if worker.connection.poll():
                answer: TrialResult = worker.connection.recv()
                return answer
        except (EOFError, ConnectionResetError):
            dying = True
        code = worker.end(dying)
        self._workers[index] = self._start()
        if worker.attempt <= self._retries:
            self._waiting.append((trial, worker.attempt + 1))
            return None
        failure = _death(code) if dying else failure
        attempts = f" ({worker.attempt} times)" if worker.attempt > 1 else ""
        return TrialResult(
            seed=trial.seed, outcome=None, failure=failure + attempts, wall_s=wall_s, attempts=worker.attempt, lost=True
        )


def _death(code: int | None) -> str:
    if code is not None and code < 0:
        return f"its process was killed by {signal.Signals(-code).name}"
    return f"its process died with exit code {code}"
