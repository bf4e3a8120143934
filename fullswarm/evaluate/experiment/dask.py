"""Trials on more than one machine: the function of the pool's workers, run by Dask.

Workers need the package and no disk of ours: a trial's files come back as its answer. A worker that is lost is
survived, and its trial run again, by Dask itself.
"""

from __future__ import annotations

import faulthandler
import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from fullswarm.errors import ConfigError, MissingExtra, Unreachable
from fullswarm.evaluate.experiment import Trial, TrialResult
from fullswarm.evaluate.experiment.pool import uninterruptible_children
from fullswarm.evaluate.lockstep_swarm import measure
from fullswarm.evaluate.trial import Measure, not_kept, perform, record_of
from fullswarm.evaluate.trial_folder import Files, files_of, trial_id, write_files

LOCAL, LOOPBACK = "local", "127.0.0.1"
CONNECT_S = 5.0


@dataclass(frozen=True, slots=True)
class Task:
    """What a Dask worker does with a trial.

    Parameters
    ----------
    timeout_s : wall-clock seconds after which the worker's process ends itself; its nanny starts another one
    """

    experiment: str
    run: Measure = measure
    timeout_s: float = 600.0

    def __call__(self, trial: Trial) -> tuple[TrialResult, Files]:
        """Run a trial; return its result and its files."""
        from fullswarm.logs import log_to_stderr

        log_to_stderr(warnings_only=True)
        with Path(os.devnull).open("w") as nowhere:
            # A trial runs in a thread of the worker, and nothing but the end of the process ends a thread.
            faulthandler.dump_traceback_later(self.timeout_s, exit=True, file=nowhere)
            try:
                result, found, about = perform(trial, self.experiment, 1, self.run, "dask")
                return result, files_of(record_of(trial, self.experiment, found), about, found)
            finally:
                faulthandler.cancel_dump_traceback_later()


class Cluster:
    """Runs trials on a Dask cluster; a context manager.

    Parameters
    ----------
    address : of a scheduler, ``tcp://host:8786``, or ``local``: processes on this machine
    jobs : how many trials at once: the workers' threads
    out : where the trials' directories are written, by this process; None: nowhere
    retries : how often a trial is run again whose worker was lost; a scheduler elsewhere has its own setting

    Raises
    ------
    MissingExtra
        Dask is not installed.
    ConfigError, Unreachable
        The address is wrong, or nothing answers there.
    """

    def __init__(self, address: str, jobs: int, task: Task, out: Path | None, retries: int = 1) -> None:
        try:
            import dask
            import distributed
        except ImportError as error:
            raise MissingExtra("running on a cluster needs Dask", hint="pip install 'fullswarm[cluster]'") from error
        self._task, self._out, self._jobs = task, out, jobs
        library: Any = distributed  # it has no types
        self._cluster: Any = None
        if address == LOCAL:
            dask.config.set({"distributed.scheduler.allowed-failures": retries})
            with uninterruptible_children():  # Dask's thread is one, too, so that workers that it starts later are
                self._cluster = library.LocalCluster(
                    n_workers=jobs,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=f"{LOOPBACK}:0",
                    silence_logs=logging.CRITICAL,
                )
        try:
            self.client: Any = library.Client(self._cluster or address, timeout=CONNECT_S, set_as_default=False)
        except OSError as error:
            raise Unreachable(f"no Dask scheduler answers: {error}", where=address) from error
        except ValueError as error:
            raise ConfigError(f"no address of a Dask scheduler: {error}", where=f"--dask {address}") from error

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()
        if self._cluster is not None:
            self._cluster.close()

    def run(self, trials: Sequence[Trial]) -> Iterator[tuple[Trial, TrialResult]]:
        """Yield each trial with its result as it ends; every trial ends once."""
        import distributed

        library: Any = distributed
        waiting = iter(trials)
        # No more at once than can run: Dask counts the death of a worker against all that wait for it, too.
        asked = {self._ask(trial): trial for trial in islice(waiting, self._jobs)}
        done = library.as_completed(asked, loop=self.client.loop)
        for future in done:
            trial = asked.pop(future)
            error = future.exception()
            if error is not None:
                yield trial, TrialResult(seed=trial.seed, outcome=None, failure=_failure(error), lost=True)
            else:
                yield trial, self._keep(trial, *future.result())
            future.release()  # the scheduler would hold the files of all trials
            for following in islice(waiting, 1):
                new = self._ask(following)
                asked[new] = following
                done.add(new)

    def _ask(self, trial: Trial) -> Any:
        return self.client.submit(self._task, trial, key=trial_id(trial), pure=False)

    def _keep(self, trial: Trial, result: TrialResult, files: Files) -> TrialResult:
        if self._out is None:
            return result
        try:
            write_files(self._out, trial_id(trial), files)
        except OSError as error:
            return not_kept(result, self._out, error)
        return result


def _failure(error: BaseException) -> str:
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        return f"its workers died or ran out of time ({error.args[-1] if error.args else 'all'} was the last)"
    return f"{type(error).__name__}: {error}"
