"""Processes that run trials: one trial each at a time, with a hard time limit, replaced when they die."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.perf.experiment import Trial, TrialResult

Work = Callable[[Trial], TrialResult]


def serve(connection: Connection, work: Work) -> None:
    """Run the trials that come through `connection` until it ends: what a worker process does."""
    from fullswarm.operator.output import log_to_stderr

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all; the parent ends its workers in order
    log_to_stderr(warnings_only=True)  # a thousand trials brake a thousand times: that is counted, not told
    while True:
        try:
            trial = connection.recv()
        except EOFError:
            return
        try:
            connection.send(work(trial))
        except BrokenPipeError:
            return


@dataclass(slots=True)
class Worker:
    """A process, and the trial that it has in hand."""

    process: SpawnProcess
    connection: Connection
    trial: Trial | None = None
    began_s: float = 0.0

    def end(self) -> None:
        """Kill it, and wait for that."""
        self.connection.close()
        self.process.kill()
        self.process.join()
        self.process.close()


class Pool:
    """Runs trials in `jobs` processes; a context manager, after which none is left.

    Parameters
    ----------
    timeout_s : wall-clock seconds after which a trial is killed and counted as failed
    work : what a worker does with a trial; importable by its name
    """

    def __init__(self, jobs: int, timeout_s: float, work: Work, clock: Clock | None = None) -> None:
        self._timeout_s, self._work = timeout_s, work
        self._clock = clock or MonotonicClock()
        # Spawned, not forked: a fork would inherit threads' locks, and Bullet's global state.
        self._context = multiprocessing.get_context("spawn")
        self._workers = [self._start() for _ in range(jobs)]

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.end()

    def run(self, trials: Sequence[Trial]) -> Iterator[tuple[Trial, TrialResult]]:
        """Yield each trial with its result as it ends; every trial ends once."""
        waiting = iter(trials)
        left = len(trials)
        for worker in self._workers:
            self._give(worker, waiting)
        while left:
            for index in self._ended():
                worker = self._workers[index]
                trial = worker.trial
                result = self._take(index)
                self._give(self._workers[index], waiting)
                if trial is not None:
                    left -= 1
                    yield trial, result

    def _start(self) -> Worker:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=serve, args=(theirs, self._work), daemon=True)
        process.start()
        theirs.close()
        return Worker(process, ours)

    def _give(self, worker: Worker, waiting: Iterator[Trial]) -> None:
        worker.trial = next(waiting, None)
        worker.began_s = self._clock.now_s()
        if worker.trial is not None:
            worker.connection.send(worker.trial)

    def _ended(self) -> list[int]:
        """Wait until a worker has answered, died or run out of time; return which."""
        busy = [(index, each) for index, each in enumerate(self._workers) if each.trial is not None]
        next_s = min(each.began_s for _, each in busy) + self._timeout_s - self._clock.now_s()
        ready = wait([each.connection for _, each in busy], timeout=max(0.0, next_s))
        late_s = self._clock.now_s() - self._timeout_s
        return [index for index, each in busy if each.connection in ready or each.began_s <= late_s]

    def _take(self, index: int) -> TrialResult:
        """Return a worker's answer, or why there is none; then a new process has its place."""
        worker = self._workers[index]
        trial, wall_s = worker.trial, self._clock.now_s() - worker.began_s
        assert trial is not None  # noqa: S101  (narrows the type; only busy workers end)
        try:
            if worker.connection.poll():
                answer: TrialResult = worker.connection.recv()
                return answer
            failure = f"it took longer than {self._timeout_s:.0f} s"
        except (EOFError, ConnectionResetError):
            worker.process.join()
            failure = f"its process died with exit code {worker.process.exitcode}"
        worker.end()
        self._workers[index] = self._start()
        return TrialResult(seed=trial.seed, outcome=None, failure=failure, wall_s=wall_s)
