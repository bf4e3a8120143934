"""What every driver must hold while nothing is broken: lifecycle, limits, signs, silence, promptness."""

from __future__ import annotations

import math
import statistics
import sys
from collections.abc import Callable
from functools import partial

from fullswarm.drivers.base import STAND, Description, Driver, Lifecycle, Limits, Pose, Reading, Twist
from fullswarm.geometry import wrap
from fullswarm.testing.trial import DRIFT_M, DRIFT_RAD, Trial

SILENCE_S = 0.3
"""A set-point holds for so long; after that the driver itself sets zero, whatever watchdog the device has."""
WINDOW_S = 0.2
"""How long a robot drives while its odometry is compared with the twist."""
CALLS, BEST_S, USUAL_S = 50, 0.005, 0.05
"""Of so many calls the fastest and the median must be below; the contract says 1 ms, machines are noisy."""

UNMOVED = "the robot may not move (exercise=False)"

_NOT_FINITE = (Twist(math.nan, 0.0), Twist(0.0, math.nan), Twist(math.inf, 0.0), Twist(0.0, -math.inf))
_HUGE = sys.float_info.max


def check_contract(trial: Trial, make: Callable[[], Driver], exercise: bool) -> None:
    """Lead a driver through its life, opened twice; `exercise` lets the robot move."""
    driver = trial.driver
    trial.demand(driver.read() is None, "read() gives something before open(); None until the robot has told")
    _check_closed(trial, "before open()")
    _check_description(trial, driver.description)
    _check_opening(trial)
    _check_activation(trial, make)
    _check_not_finite(trial)
    trial.report.add("lifecycle")
    if exercise:
        _check_limits(trial, driver.description.limits)
        _check_signs(trial)
        _check_not_finite_stops(trial)
        took_s = _check_silence(trial)
        trial.report.add("limits, signs and scale")
        trial.report.add("silence of the controller", f"slows after {took_s:.2f} s")
    else:
        for name in ("limits, signs and scale", "silence of the controller"):
            trial.report.skip(name, UNMOVED)
    _check_promptness(trial, trial.pace if exercise else STAND)
    trial.report.add("promptness")
    _check_deactivation(trial, exercise)
    _check_closing(trial, exercise)
    trial.report.add("deactivate and close")


def _check_closed(trial: Trial, when: str) -> None:
    driver = trial.driver
    trial.demand(
        trial.state is Lifecycle.CLOSED, f"it is {trial.state} {when}, not CLOSED; only open() touches the robot"
    )
    trial.demand(driver.fault == "", f"it has a fault {when}: {driver.fault}; empty unless in FAULT")
    driver.activate()
    driver.deactivate()
    _check_zero(trial, when)
    for bad in _NOT_FINITE:
        _check_refused(trial, bad, when)
    driver.close()
    trial.demand(
        trial.state is Lifecycle.CLOSED,
        f"activate(), deactivate() or close() {when} made it {trial.state}; they do nothing then",
    )


def _check_description(trial: Trial, description: Description) -> None:
    limits = description.limits
    for name in ("speed_m_s", "turn_rad_s", "accel_m_s2", "turn_accel_rad_s2"):
        value = getattr(limits, name)
        trial.demand(0.0 < value < math.inf, f"description.limits.{name} is {value}; a finite number above 0")
    radius_m, watchdog_s = description.radius_m, description.watchdog_s
    trial.demand(0.0 < radius_m < math.inf, f"description.radius_m is {radius_m}; a finite number above 0")
    trial.demand(
        watchdog_s is None or 0.0 < watchdog_s < math.inf,
        f"description.watchdog_s is {watchdog_s}; None if it has none",
    )
    trial.demand(bool(description.make and description.model), "description.make or .model is empty; name the robot")


def _check_opening(trial: Trial) -> None:
    trial.open()
    state = trial.state
    trial.demand(state is not Lifecycle.CLOSED, "it is CLOSED after open(); OPEN until the robot answers")
    trial.reach(Lifecycle.READY, "open()")
    trial.demand(trial.driver.fault == "", f"it is READY with a fault: {trial.driver.fault}; empty unless in FAULT")
    origin = trial.fresh().odometry
    trial.demand(
        math.hypot(origin.x_m, origin.y_m) <= DRIFT_M and abs(origin.heading_rad) <= DRIFT_RAD,
        f"odometry is {origin} after open(); it starts at (0, 0, 0) each time",
    )
    trial.stays(origin, "while READY and commanded", lambda: _check_zero(trial, "while READY"))
    trial.driver.deactivate()
    trial.demand(
        trial.state is Lifecycle.READY,
        f"it is {trial.state}, not READY, although nobody called activate(): that is the agent's decision",
    )


def _check_activation(trial: Trial, make: Callable[[], Driver]) -> None:
    trial.driver.activate()
    trial.reach(Lifecycle.ACTIVE, "activate()")
    trial.stays(trial.fresh().odometry, "although it was activated only", lambda: trial.command(STAND))
    other = make()
    try:
        trial.demand(other.state is Lifecycle.CLOSED, f"a second driver is {other.state} without open(), not CLOSED")
    finally:
        other.close()
    reading = trial.fresh()
    trial.demand(
        trial.state is Lifecycle.ACTIVE, "constructing a second driver disturbs the first; touch nothing there"
    )
    trial.demand(
        reading.pose is not None or not trial.driver.description.senses_pose,
        "its description says senses_pose, but it is ACTIVE and tells none",
    )


def _check_not_finite(trial: Trial) -> None:
    for bad in _NOT_FINITE:
        _check_refused(trial, bad, "while ACTIVE")
        trial.command(STAND)
    trial.demand(trial.state is Lifecycle.ACTIVE, f"a value that is not finite makes it {trial.state}; it stays ACTIVE")
    trial.halt("a value that was not finite")


def _check_limits(trial: Trial, limits: Limits) -> None:
    speed, turn = 10.0 * limits.speed_m_s, 10.0 * limits.turn_rad_s
    for wished in (Twist(speed, 0.0), Twist(0.0, turn), Twist(-speed, -turn), Twist(_HUGE, _HUGE), Twist(0.0, -_HUGE)):
        try:
            applied = trial.command(wished)
        except ValueError as error:
            raise AssertionError(
                f"{trial.driver.url}: command({wished}) raises ValueError ({error}); it is finite: clip it"
            ) from error
        forwards = wished.linear_m_s >= 0.0 or limits.can_reverse
        trial.demand(applied != STAND or not forwards, f"command({wished}) returns zero; clip, do not refuse")
        zero = trial.command(STAND)
        trial.demand(zero == STAND, f"command({STAND}) returns {zero}; zero can always be applied")
    trial.halt("a zero command", each=lambda: trial.command(STAND))


def _check_signs(trial: Trial) -> None:
    """Drive forwards, turn left, then both the other way round, and see what the readings make of it."""
    speed, turn = trial.pace.linear_m_s, trial.pace.angular_rad_s
    back = -speed if trial.driver.description.limits.can_reverse else speed
    for wished in (Twist(speed, 0.0), Twist(0.0, turn), Twist(back, -turn)):
        applied = trial.drive(wished)
        begin = trial.fresh()
        trial.spend(WINDOW_S, wished)
        _check_way(trial, applied, begin, trial.fresh())
    trial.halt("a zero command", each=lambda: trial.command(STAND))


def _check_way(trial: Trial, applied: Twist, begin: Reading, end: Reading) -> None:
    """Compare how far the odometry went between two readings with the twist that was applied."""
    passed_s = end.stamp_s - begin.stamp_s
    forward_m, aside_m, turned_rad = _moved(begin.odometry, end.odometry)
    for what, gone, rate, measured in (
        ("m", forward_m, applied.linear_m_s, end.twist.linear_m_s),
        ("rad", turned_rad, applied.angular_rad_s, end.twist.angular_rad_s),
    ):
        trial.demand(
            rate == 0.0 or (0.5 <= gone / (rate * passed_s) <= 1.5 and 0.5 <= measured / rate <= 1.5),
            f"under {applied} the odometry moves by {gone:.3f} {what} in {passed_s:.2f} s and the measured twist is "
            f"{measured:.3f} {what}/s; x is forward, heading grows counter-clockwise, m and rad: check signs and scale",
        )
    trial.demand(
        applied.linear_m_s == 0.0 or abs(aside_m) <= 0.5 * abs(forward_m),
        f"under {applied} the odometry moves {aside_m:.3f} m aside and {forward_m:.3f} m along its heading; it is in "
        "the frame of open(), with x along the heading then",
    )
    if begin.pose is not None and end.pose is not None:
        forward_m, _, turned_rad = _moved(begin.pose, end.pose)
        trial.demand(
            forward_m * applied.linear_m_s >= 0.0 and turned_rad * applied.angular_rad_s >= 0.0,
            f"under {applied} the pose goes from {begin.pose} to {end.pose}; x is east, y north, heading 0 along x and "
            "counter-clockwise",
        )


def _moved(begin: Pose, end: Pose) -> tuple[float, float, float]:
    """Return how far along the heading halfway, how far to its left, and the turn."""
    dx, dy, turned = end.x_m - begin.x_m, end.y_m - begin.y_m, wrap(end.heading_rad - begin.heading_rad)
    halfway = begin.heading_rad + turned / 2.0
    c, s = math.cos(halfway), math.sin(halfway)
    return c * dx + s * dy, c * dy - s * dx, turned


def _check_not_finite_stops(trial: Trial) -> None:
    bad = Twist(math.nan, 0.0)
    _check_stops(trial, lambda: _check_refused(trial, bad, "while driving"), "a value that is not finite", "then raise")


def _check_silence(trial: Trial) -> float:
    mend = f"from a thread of the driver's own, when no command has come for {SILENCE_S} s"
    return _check_stops(trial, lambda: None, "silence", mend, 2.0 * SILENCE_S)


def _check_stops(trial: Trial, act: Callable[[], None], what: str, mend: str, limit_s: float = SILENCE_S) -> float:
    """Something must stop the robot by itself, by default sooner than silence would; return how soon it did."""
    took_s = math.inf
    for _ in range(2):  # a busy machine may be late once
        if trial.state is Lifecycle.READY:
            trial.driver.activate()
            trial.reach(Lifecycle.ACTIVE, "activate()")
        applied = trial.drive(Twist(trial.pace.linear_m_s, 0.0), share=0.9)
        began_s = trial.clock.now_s()
        act()
        trial.wait(partial(trial.slower, applied), trial.settle_s)
        took_s = (trial.newest.stamp_s if trial.newest is not None else math.inf) - began_s
        trial.halt(f"{what} (set zero, {mend})")
        if took_s < limit_s:
            return took_s
    trial.demand(False, f"{what} slows it after {took_s:.2f} s only, not {limit_s} s; set zero, {mend}")
    return took_s


def _check_promptness(trial: Trial, pace: Twist) -> None:
    """Time the calls that the agent makes each tick; `pace` and zero in turn, so that something has to be sent."""
    driver, wishes = trial.driver, (pace, STAND)
    calls: dict[str, Callable[[int], object]] = {
        "read()": lambda _: driver.read(),
        "state": lambda _: driver.state,
        "command()": lambda number: driver.command(wishes[number % 2]),
    }
    for name, call in calls.items():
        took_s = []
        for number in range(CALLS):
            began_s = trial.clock.now_s()
            call(number)
            took_s.append(trial.clock.now_s() - began_s)
        best_s, usual_s = min(took_s), statistics.median(took_s)
        trial.demand(
            best_s < BEST_S and usual_s < USUAL_S,
            f"{name} takes {best_s * 1e3:.1f} ms at best, {usual_s * 1e3:.1f} ms usually; never wait there: "
            "leave it to the link's thread",
        )
    trial.halt("a zero command", each=lambda: trial.command(STAND))


def _check_deactivation(trial: Trial, exercise: bool) -> None:
    if exercise:
        _check_stops(trial, trial.driver.deactivate, "deactivate()", "then leave ACTIVE")
    else:
        trial.driver.deactivate()
    _check_zero(trial, "after deactivate()")
    trial.reach(Lifecycle.READY, "deactivate()")
    trial.halt("deactivate()", each=lambda: _check_zero(trial, "after deactivate()"))
    trial.demand(trial.state is Lifecycle.READY, f"{trial.state} after deactivate(), not READY")


def _check_closing(trial: Trial, exercise: bool) -> None:
    """Close while ACTIVE, moving if allowed, and begin anew."""
    trial.driver.activate()
    trial.reach(Lifecycle.ACTIVE, "the second activate()")
    if exercise:
        trial.drive(Twist(trial.pace.linear_m_s, 0.0))
    trial.driver.close()
    _check_closed(trial, "after close()")
    if trial.rig.body_speed is not None:  # it may roll out; without the truth the next readings must show it at rest
        trial.come_to_rest(trial.settle_s, "close()")
    _check_opening(trial)


def _check_zero(trial: Trial, when: str) -> None:
    applied = trial.driver.command(trial.pace)
    trial.demand(applied == STAND, f"command() {when} returns {applied}; anything but ACTIVE applies zero, and says so")


def _check_refused(trial: Trial, bad: Twist, when: str) -> None:
    try:
        applied = trial.driver.command(bad)
    except ValueError:
        return
    raise AssertionError(
        f"{trial.driver.url}: command({bad}) {when} returns {applied}; stop the robot and raise ValueError"
    )
