"""Breaks a driver's link and lets time jump: the driver must report it in time and move again after activate()."""

from __future__ import annotations

import math
import random
import sys
import time
from collections.abc import Callable
from functools import partial

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import STAND, Lifecycle, Twist
from fullswarm.errors import DriverError
from fullswarm.testing.trial import IDLE_S, SILENCE_S, STEP_S, Trial

FAULTS = (
    "unplug",
    "close while unplugged",
    "unplug in mid-frame",
    "mute and stale data",
    "garbage",
    "frames cut short",
)
UNRECEIVED_S = 0.3
"""What was in flight when the device fell silent may still arrive this much later."""
NOISE_S = 0.5
CHUNK_BYTES = 64
CUTS = 5


def check_faults(trial: Trial) -> None:
    """Unplug, mute, inject garbage; begins and ends with an open driver."""
    rig, report = trial.rig, trial.report
    if not report.lacks("unplug", unplug=rig.unplug, replug=rig.replug):
        report.add("unplug", _check_unplug(trial))
        report.add("close while unplugged", _check_close(trial))
    else:
        report.lacks("close while unplugged", unplug=rig.unplug, replug=rig.replug)
    if not report.lacks("unplug in mid-frame", unplug=rig.unplug, replug=rig.replug, cut=rig.cut):
        report.add("unplug in mid-frame", _check_unplug_in_frame(trial))
    if not report.lacks("mute and stale data", mute=rig.mute):
        report.add("mute and stale data", _check_mute(trial))
    if not report.lacks("garbage", garbage=rig.garbage):
        report.add("garbage", _check_garbage(trial))
    if not report.lacks("frames cut short", cut=rig.cut):
        report.add("frames cut short", _check_cuts(trial))


def lose(trial: Trial, break_it: Callable[[], object], what: str) -> float:
    """Break the link, go on commanding as an agent does, and see FAULT in the stated time; return after how long."""
    desired, driver = trial.pace, trial.driver
    began_s = trial.clock.now_s()
    break_it()
    faulty = trial.wait(lambda: trial.state is Lifecycle.FAULT, trial.rig.fault_s, lambda: trial.try_command(desired))
    took_s = trial.clock.now_s() - began_s
    trial.demand(
        faulty, f"it is {trial.state}, not FAULT, {trial.rig.fault_s} s after {what}; silence is a fault: watch for it"
    )
    trial.demand(driver.fault.strip() != "", f"it is in FAULT after {what} without a text; state why and what to do")
    applied = trial.try_command(desired)
    trial.demand(applied == STAND, f"command() in FAULT after {what} returns {applied}; it applies and returns zero")
    _check_stale(trial, began_s, what)
    return took_s


def recover(trial: Trial, repair: Callable[[], object], what: str) -> float:
    """Repair the link; the driver is READY by itself and stands until activate(). Return how long that took, s."""
    desired, rig = trial.pace, trial.rig
    began_s = trial.clock.now_s()

    def stand() -> None:
        trial.demand(
            trial.state is not Lifecycle.ACTIVE,
            f"it is ACTIVE again after {what}, although activate() was not called; reconnect to READY, never to ACTIVE",
        )
        applied = trial.try_command(desired)
        trial.demand(applied == STAND, f"command() after {what} and before activate() returns {applied}, not zero")

    repair()
    ready = trial.wait(lambda: trial.state is Lifecycle.READY, rig.ready_s, stand)
    took_s = trial.clock.now_s() - began_s
    trial.demand(
        ready,
        f"it is {trial.state}, not READY, {rig.ready_s} s after the end of {what} "
        f"({trial.driver.fault or 'no fault'}); try again by itself, several times a second",
    )
    trial.demand(trial.driver.fault == "", f"it is READY after {what} with a fault: {trial.driver.fault}")
    trial.come_to_rest(trial.settle_s, f"it was READY again after {what}", stand)
    trial.stays(trial.fresh().odometry, f"after {what}, before activate()", stand)
    trial.demand(trial.at_rest(), f"the robot moves after {what}, before activate(): {trial.motion}")
    return took_s


def _check_stale(trial: Trial, silent_s: float, what: str) -> None:
    """Nothing is received: no reading may be newer."""
    trial.wait(lambda: False, IDLE_S, lambda: trial.try_command(trial.pace))
    newest = trial.newest
    late_s = newest.stamp_s - silent_s if newest is not None else 0.0
    trial.demand(
        late_s <= UNRECEIVED_S,
        f"a reading is stamped {late_s:.2f} s after {what}, when nothing came any more; stamp what arrives, not "
        "what is repeated",
    )


def _rest_without_link(trial: Trial, began_s: float, what: str) -> str:
    """Check that the body comes to rest while nothing is received, if watchdog and rig allow that."""
    watchdog_s = trial.driver.description.watchdog_s
    if trial.rig.body_speed is None:
        return "; rest not seen: the rig has no body_speed"
    if watchdog_s is None:
        return "; rest only after READY: the device has no watchdog"
    left_s = began_s + max(watchdog_s, trial.rig.fault_s) + trial.settle_s - trial.clock.now_s()
    trial.come_to_rest(max(left_s, STEP_S), what, lambda: trial.try_command(trial.pace))
    return f", at rest after {trial.clock.now_s() - began_s:.2f} s"


def _check_unplug(trial: Trial) -> str:
    rig = trial.rig
    if rig.unplug is None or rig.replug is None:
        return ""
    trial.go()
    began_s = trial.clock.now_s()
    fault_s = lose(trial, rig.unplug, "unplugging")
    rest = _rest_without_link(trial, began_s, "unplugging")
    ready_s = recover(trial, rig.replug, "unplugging")
    trial.go()
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    return f"FAULT after {fault_s:.2f} s{rest}, READY {ready_s:.2f} s after replug"


def _check_close(trial: Trial) -> str:
    """Close without a device at the other end, and open again when it is there."""
    rig, driver = trial.rig, trial.driver
    if rig.unplug is None or rig.replug is None:
        return ""
    lose(trial, rig.unplug, "unplugging")
    began_s = trial.clock.now_s()
    try:
        driver.close()
    except Exception as error:  # whatever it raises is what this check is for
        raise AssertionError(
            f"{driver.url}: close() without the device raises {type(error).__name__}: {error}"
        ) from error
    took_s = trial.clock.now_s() - began_s
    trial.demand(took_s <= trial.deadline_s, f"close() without the device takes {took_s:.1f} s; do not wait for it")
    trial.demand(trial.state is Lifecycle.CLOSED, f"it is {trial.state} after close(), not CLOSED")
    rig.replug()
    _open_again(trial)
    return f"takes {took_s:.2f} s"


def _open_again(trial: Trial) -> None:
    """Open as soon as the port is there again: a system takes its time to find it."""
    refusals: list[str] = []

    def opens() -> bool:
        try:
            trial.open()
        except DriverError as error:
            refusals.append(str(error))
            return False
        return True

    opened = trial.wait(opens, trial.rig.ready_s)
    trial.demand(opened, f"open() fails {trial.rig.ready_s} s after replugging: {refusals[-1:]}")
    trial.reach(Lifecycle.READY, "open()")


def _check_unplug_in_frame(trial: Trial) -> str:
    rig = trial.rig
    if rig.unplug is None or rig.replug is None or rig.cut is None:
        return ""
    what = "unplugging in mid-frame"
    trial.go()
    rig.cut()
    trial.keep(IDLE_S, trial.pace)  # the half of a frame is on its way
    lose(trial, rig.unplug, what)
    took_s = recover(trial, rig.replug, what)
    return f"READY {took_s:.2f} s after replug"


def _check_mute(trial: Trial) -> str:
    """The device receives but sends nothing: it can and must be commanded to stop."""
    rig = trial.rig
    if rig.mute is None:
        return ""
    trial.go()
    began_s = trial.clock.now_s()
    try:
        fault_s = lose(trial, partial(rig.mute, True), "the device fell silent")
        rest = ""
        if rig.body_speed is not None:
            trial.come_to_rest(trial.settle_s, "FAULT", lambda: trial.try_command(trial.pace))
            rest = f", at rest after {trial.clock.now_s() - began_s:.2f} s"
    finally:
        unmute = partial(rig.mute, False)
        if trial.state is not Lifecycle.FAULT:
            unmute()
    ready_s = recover(trial, unmute, "the silence")
    return f"FAULT after {fault_s:.2f} s{rest}, READY {ready_s:.2f} s after its end"


def _check_garbage(trial: Trial) -> str:
    """Noise while standing moves nothing, noise while driving breaks nothing."""
    noise, garbage = random.Random(0), trial.rig.garbage  # noqa: S311  (must repeat, keeps no secret)
    if garbage is None:
        return ""
    sent = 0

    def send_noise(desired: Twist) -> None:
        nonlocal sent
        count = noise.randrange(1, CHUNK_BYTES)
        garbage(noise.randbytes(count) if noise.random() < 0.8 else bytes([noise.choice((0, 255))]) * count)
        sent += count
        trial.try_command(desired)

    trial.come_to_rest(trial.settle_s, "a zero command", lambda: trial.try_command(STAND))
    standing = trial.fresh().odometry
    trial.wait(lambda: False, NOISE_S, lambda: send_noise(STAND))
    _recovers(trial, "garbage")
    trial.stays(standing, "by garbage", lambda: trial.try_command(STAND))
    trial.go()
    trial.wait(lambda: False, NOISE_S, lambda: send_noise(Twist(trial.pace.linear_m_s, 0.0)))
    took_s = _recovers(trial, "garbage")
    trial.go()
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    return f"{sent} bytes, well again after {took_s:.2f} s"


def _check_cuts(trial: Trial) -> str:
    cut = trial.rig.cut
    if cut is None:
        return ""
    desired = Twist(trial.pace.linear_m_s, 0.0)
    trial.go()
    for _ in range(CUTS):
        cut()
        trial.wait(lambda: False, 2 * STEP_S, lambda: trial.try_command(desired))
    took_s = _recovers(trial, "frames that were cut short")
    trial.go()
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    return f"{CUTS} frames, well again after {took_s:.2f} s"


def _recovers(trial: Trial, what: str) -> float:
    """Wait for READY or ACTIVE and a new reading; return how long that took, s."""
    began_s = trial.clock.now_s()
    well = trial.wait(lambda: trial.state in (Lifecycle.READY, Lifecycle.ACTIVE), trial.rig.ready_s)
    trial.demand(
        well,
        f"it is {trial.state}, neither READY nor ACTIVE, {trial.rig.ready_s} s after {what} "
        f"({trial.driver.fault or 'no fault'}); look for the next frame in what follows",
    )
    trial.fresh()
    return trial.clock.now_s() - began_s


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
        self._set = self._now_s  # one object: each access makes a new bound method

    def __enter__(self) -> WallClock:
        _replace(self._real, self._set)
        return self

    def __exit__(self, *_: object) -> None:
        _replace(self._set, self._real)

    def _now_s(self) -> float:
        return self._real() + self.off_s


def _replace(old: Callable[[], float], new: Callable[[], float]) -> None:
    """Put `new` wherever a module holds `old`: many use ``from time import time``."""
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
    """The last command is an hour old: the robot stops, and recovers as from any silence."""
    trial.go()
    before = trial.fresh().odometry
    clock.jump(HOUR_S)
    trial.ignored_s = clock.now_s() - 0.5 * HOUR_S
    what = f"a jump of the clock by {HOUR_S:.0f} s"
    took_s = trial.come_to_rest(SILENCE_S + trial.settle_s, what)
    again: list[Twist | None] = []

    def look() -> None:
        if not trial.at_rest():
            again.append(trial.motion)

    well = trial.wait(lambda: trial.state in (Lifecycle.READY, Lifecycle.ACTIVE), trial.rig.ready_s, look)
    trial.demand(
        well,
        f"it is {trial.state} {trial.rig.ready_s} s after {what} ({trial.driver.fault or 'no fault'}); recover",
    )
    # On a machine with too much to do, readings come later than the truth of the rig.
    trial.demand(
        trial.wait(trial.still, trial.settle_s, look), f"its readings still show motion {trial.settle_s} s after {what}"
    )
    trial.demand(not again, f"it came to rest after {what}, and moves again without a command: {again[:1]}")
    state, after = trial.state, trial.fresh().odometry
    gone_m = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
    most_m = 2.0 * trial.pace.linear_m_s * (SILENCE_S + trial.settle_s) + trial.pace.linear_m_s * trial.rig.ready_s
    trial.demand(
        gone_m <= most_m, f"odometry grows by {gone_m:.1f} m at {what}; use the device's counts, not the clock"
    )
    trial.stays(trial.fresh().odometry, f"after {what}, without a command", lambda: None)
    trial.go()
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    return f"at rest after {took_s:.2f} s, {state}"


def _check_wall(trial: Trial) -> str:
    """It must have no effect, and silence must be detected as fast as before."""
    rig = trial.rig
    trial.go()
    with WallClock() as wall:
        for wall.off_s in (HOUR_S, -HOUR_S):
            trial.keep(IDLE_S, trial.pace)
            trial.fresh()
            trial.demand(
                trial.state is Lifecycle.ACTIVE,
                f"it is {trial.state} after the wall clock was set by {wall.off_s:.0f} s",
            )
        if rig.mute is None:
            return "not in a silence: the rig has no mute"

        def silence() -> None:
            mute(True)
            # During any wait of the driver: one that is measured by this clock would last an hour.
            trial.wait(lambda: False, IDLE_S, lambda: trial.try_command(trial.pace))
            wall.off_s -= HOUR_S

        mute = rig.mute
        try:
            fault_s = lose(trial, silence, "the device fell silent and the wall clock was set back")
        finally:
            wall.off_s = 0.0
            mute(False)
    recover(trial, lambda: None, "a silence")
    return f"set back in a silence: FAULT after {fault_s:.2f} s"
