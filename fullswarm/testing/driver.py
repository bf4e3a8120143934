"""The check that every driver must pass, built-in or from outside: as it lives, as it breaks, as it says of itself.

Run it against the make's emulator, or on a bench with the wheels in the air.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from fullswarm.drivers.base import Driver
from fullswarm.testing.claims import CLAIMS, check_claims
from fullswarm.testing.contract import UNMOVED, check_contract
from fullswarm.testing.faults import FAULTS, check_faults
from fullswarm.testing.jumps import JUMPS, check_jumps
from fullswarm.testing.process import PROCESS, check_process
from fullswarm.testing.rig import Report, Rig
from fullswarm.testing.trial import Trial


def check_driver(
    make: Callable[[], Driver] | Rig,
    *,
    settle_s: float = 2.0,
    deadline_s: float = 10.0,
    pump: Callable[[], object] | None = None,
    exercise: bool = True,
) -> Report:
    """Lead a driver through its life, then break what the rig can break. Real time, 4 s, with a whole rig some 15 s.

    Parameters
    ----------
    make
        A :class:`~fullswarm.testing.Rig`; or only its `make`, which constructs a driver for the same robot each time.
    settle_s
        In which the robot reaches or leaves half its speed, and its readings tell so.
    deadline_s
        For each step of the lifecycle that the robot has to confirm.
    pump
        Called at 50 Hz while the check waits, if `make` is no rig.
    exercise
        Whether the robot may move, up to its full speed for a moment and half of it for seconds. Without, only
        lifecycle and promptness are checked.

    Returns
    -------
    Report
        What was checked, and what was not for want of a callable of the rig. Print it.

    Raises
    ------
    AssertionError
        The driver breaks the contract; says where, and how to mend it.
    DriverError
        Its port cannot be had.
    """
    rig = make if isinstance(make, Rig) else Rig(make=make, pump=pump)
    driver = rig.make()
    report = Report(driver.url)
    trial = Trial(driver, rig, settle_s, deadline_s, report)
    with _threads(trial):
        try:
            check_contract(trial, rig.make, exercise)
            if exercise:
                check_claims(trial)
                check_faults(trial)
        finally:
            driver.close()
        if exercise:
            check_jumps(trial)
            check_process(trial)
    if not exercise:
        for name in (*CLAIMS, *FAULTS, *JUMPS, *PROCESS):
            report.skip(name, UNMOVED)
    return report


@contextmanager
def _threads(trial: Trial) -> Iterator[None]:
    """Tell of exceptions that end a thread meanwhile: nothing else would."""
    died: list[str] = []
    before = threading.excepthook

    def note(end: threading.ExceptHookArgs) -> None:
        name = end.thread.name if end.thread is not None else "?"
        died.append(f"thread '{name}' ended with {end.exc_type.__name__}: {end.exc_value}")

    threading.excepthook = note
    try:
        yield
    finally:
        threading.excepthook = before
    trial.demand(not died, f"{'; '.join(died)}; catch what a link can throw, and go to FAULT with a reason")
