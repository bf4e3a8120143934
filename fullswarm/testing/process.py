"""Pauses and kills a driver's process while it drives, and checks what its device does then."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys

from fullswarm.drivers.base import Twist
from fullswarm.testing.trial import SILENCE_S, Trial

PROCESS = ("controller's process paused", "watchdog_s")
PAUSE_S = 1.0
START_S = 15.0
"""For a Python interpreter to start on a busy machine, beside the driver's own deadline."""
LATE_S = 0.3
"""From the last set-point to the end of the process, and for the body to be looked at."""
_MODULE = "fullswarm.testing.drives_on"


def check_process(trial: Trial) -> None:
    """Pause and kill a process that drives. Needs the body's true speed: no driver is left to read."""
    rig, report = trial.rig, trial.report
    if rig.body_speed is None:
        for name in PROCESS:
            report.lacks(name, body_speed=None)
        return
    if not rig.other_process:
        for name in PROCESS:
            report.skip(name, "the rig does not set other_process: another process may not be allowed to drive it")
        return
    trial.ignored_s = math.inf  # the trial's own driver is closed
    with _DrivingProcess(trial) as process:
        report.add(PROCESS[0], _check_pause(trial, process))
    watchdog_s = trial.driver.description.watchdog_s
    if watchdog_s is None:
        report.add(PROCESS[1], "none claimed: the robot drives on when its controller dies")
        return
    with _DrivingProcess(trial) as process:
        report.add(PROCESS[1], _check_killed(trial, process, watchdog_s))


def _check_pause(trial: Trial, process: _DrivingProcess) -> str:
    """After the pause the last set-point is old: zero is due, although no message requests it."""
    process.drive()
    watchdog_s = trial.driver.description.watchdog_s
    process.signal(signal.SIGSTOP)
    paused = f"the controller's process was paused; its description claims watchdog_s={watchdog_s}"
    if watchdog_s is not None:
        trial.come_to_rest(watchdog_s + LATE_S + trial.settle_s, paused)
    else:
        trial.wait(lambda: False, PAUSE_S)
    process.signal(signal.SIGCONT)
    what = "the controller's process was paused and continues without a command"
    took_s = trial.come_to_rest(SILENCE_S + trial.settle_s, what)
    trial.wait(lambda: False, SILENCE_S)
    trial.demand(trial.at_rest(), f"the robot moves again after {what}: {trial.motion}; drop old set-points")
    return f"at rest {took_s:.2f} s after it continues"


def _check_killed(trial: Trial, process: _DrivingProcess, watchdog_s: float) -> str:
    process.drive()
    began_s = trial.clock.now_s()
    process.signal(signal.SIGKILL)
    top = trial.motion or Twist()
    fast = 0.8 * abs(top.linear_m_s)
    slower = trial.wait(lambda: abs((trial.motion or Twist()).linear_m_s) < fast, watchdog_s + LATE_S)
    slows_s = trial.clock.now_s() - began_s
    trial.demand(
        slower,
        f"its description claims watchdog_s={watchdog_s}, but {slows_s:.2f} s after its process was killed the robot "
        f"still moves with {trial.motion}; switch the device's watchdog on, or state None",
    )
    trial.come_to_rest(trial.settle_s, "the device's watchdog")
    return f"claimed {watchdog_s:g} s; slows {slows_s:.2f} s after its controller was killed, then rests"


class _DrivingProcess:
    """A process that drives the trial's robot at the trial's pace until its clock shows a gap."""

    def __init__(self, trial: Trial) -> None:
        self._trial = trial
        kind = type(trial.driver)
        self._command = [
            sys.executable, "-m", _MODULE, f"{kind.__module__}:{kind.__qualname__}", trial.driver.url,
            repr(trial.pace.linear_m_s),
        ]  # fmt: skip
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> _DrivingProcess:
        paths = os.pathsep.join(each for each in sys.path if each)
        self._process = subprocess.Popen(  # noqa: S603  (our own interpreter and module)
            self._command, env=os.environ | {"PYTHONPATH": paths}, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        return self

    def __exit__(self, *_: object) -> None:
        process = self._process
        if process is None:
            return
        if process.poll() is None:
            process.send_signal(signal.SIGCONT)  # or the next signal stays pending
            process.terminate()  # it closes its driver
            self._trial.wait(lambda: process.poll() is not None, self._trial.deadline_s)
        if process.poll() is None:
            process.kill()
        process.wait()
        if process.stderr is not None:
            process.stderr.close()

    def drive(self) -> None:
        """Wait until the robot moves."""
        trial, process = self._trial, self._process
        if process is None:
            return
        enough = 0.7 * trial.pace.linear_m_s
        limit_s = START_S + 2.0 * trial.deadline_s + trial.settle_s

        def moves() -> bool:
            return abs((trial.motion or Twist()).linear_m_s) >= enough

        trial.wait(lambda: moves() or process.poll() is not None, limit_s)
        if not moves():
            process.kill()
            output = process.stderr.read().decode(errors="replace").strip() if process.stderr is not None else ""
            trial.demand(False, f"a process of its own does not get the robot to move: {output or 'no output'}")

    def signal(self, number: signal.Signals) -> None:
        """Send a signal."""
        if self._process is not None:
            self._process.send_signal(number)
