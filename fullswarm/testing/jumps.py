"""Time that jumps: a machine that was suspended, and a wall clock that is set."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import STAND, Lifecycle
from fullswarm.testing.contract import SILENCE_S
from fullswarm.testing.faults import lose, recover
from fullswarm.testing.trial import IDLE_S, Trial

JUMPS = ("clock jumps by an hour", "wall clock set")
HOUR_S = 3600.0


class JumpClock:
    """The machine's monotonic clock, with leaps ahead."""

    def __init__(self) -> None:
        self._machine, self._ahead_s = MonotonicClock(), 0.0

    def now_s(self) -> float:
        """Return monotonic seconds."""
        return self._machine.now_s() + self._ahead_s

    def jump(self, by_s: float) -> None:
        """Leap ahead."""
        self._ahead_s += by_s


class WallClock:
    """The wall clock as Python code of this process sees it by ``time.time``, to be set; put right on exit."""

    def __init__(self) -> None:
        self._real, self.off_s = time.time, 0.0
        self._set = self._now_s  # one object: a method is made anew each time it is asked for

    def __enter__(self) -> WallClock:
        _replace(self._real, self._set)
        return self

    def __exit__(self, *_: object) -> None:
        _replace(self._set, self._real)

    def _now_s(self) -> float:
        return self._real() + self.off_s


def _replace(old: Callable[[], float], new: Callable[[], float]) -> None:
    """Put `new` wherever a module holds `old`: many say ``from time import time``."""
    for module in list(sys.modules.values()):
        names: dict[str, object] = getattr(module, "__dict__", {})
        for name in [each for each, value in list(names.items()) if value is old]:
            names[name] = new


def check_jumps(trial: Trial) -> None:
    """Let time jump while a driver of its own drives."""
    rig, report = trial.rig, trial.report
    if rig.make_on is None:
        for name in JUMPS:
            report.lacks(name, make_on=None)
        return
    clock = JumpClock()
    driver = rig.make_on(clock)
    trial = Trial(driver, rig, trial.settle_s, trial.deadline_s, report, clock)
    try:
        trial.open()
        report.add(JUMPS[0], _check_jump(trial, clock))
        report.add(JUMPS[1], _check_wall(trial))
    finally:
        driver.close()


def _check_jump(trial: Trial, clock: JumpClock) -> str:
    """The last command is an hour old: the robot stands, and comes back as from any silence."""
    trial.go()
    before = trial.fresh().odometry
    clock.jump(HOUR_S)
    trial.ignored_s = clock.now_s() - 0.5 * HOUR_S
    what = f"a jump of the clock by {HOUR_S:.0f} s"
    took_s = trial.come_to_rest(SILENCE_S + trial.settle_s, what)
    well = trial.wait(lambda: trial.state in (Lifecycle.READY, Lifecycle.ACTIVE), trial.rig.ready_s)
    trial.demand(
        well, f"it is {trial.state} {trial.rig.ready_s} s after {what} ({trial.driver.fault or 'no fault'}); hear anew"
    )
    state, after = trial.state, trial.fresh().odometry
    gone_m = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
    most_m = 2.0 * trial.pace.linear_m_s * (SILENCE_S + trial.settle_s) + trial.pace.linear_m_s * trial.rig.ready_s
    trial.demand(
        gone_m <= most_m, f"odometry goes on by {gone_m:.1f} m at {what}; believe the device's counts, not the clock"
    )
    trial.stays(trial.fresh().odometry, f"after {what}, without a command", lambda: None)
    trial.go()
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    return f"at rest after {took_s:.2f} s, {state}"


def _check_wall(trial: Trial) -> str:
    """Nothing may come of it, and silence must be seen as soon as ever."""
    rig = trial.rig
    trial.go()
    with WallClock() as wall:
        for wall.off_s in (HOUR_S, -HOUR_S):
            trial.spend(IDLE_S, trial.pace)
            trial.fresh()
            trial.demand(
                trial.state is Lifecycle.ACTIVE,
                f"it is {trial.state} after the wall clock was set by {wall.off_s:.0f} s",
            )
        if rig.mute is None:
            return "not in a silence: the rig has no mute"

        def silence() -> None:
            mute(True)
            # In the middle of whatever the driver waits for: a wait that is measured by this clock lasts an hour.
            trial.wait(lambda: False, IDLE_S, lambda: trial.tell(trial.pace))
            wall.off_s -= HOUR_S

        mute = rig.mute
        try:
            fault_s = lose(trial, silence, "the device fell silent and the wall clock was set back")
        finally:
            wall.off_s = 0.0
            mute(False)
    recover(trial, lambda: None, "a silence")
    return f"set back in a silence: FAULT after {fault_s:.2f} s"
