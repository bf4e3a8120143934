"""The check that every driver must pass, built-in or from outside: its lifecycle, its description, its faults.

Run it against the make's emulator, or on a bench with the wheels in the air.
"""

from __future__ import annotations

import math
import statistics
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from fullswarm.drivers.base import STAND, Description, Driver, Hazard, Lifecycle, Limits, Pose, Reading, Twist
from fullswarm.geometry import wrap
from fullswarm.testing.actuators import NAME as ACTUATORS
from fullswarm.testing.actuators import check_actuators
from fullswarm.testing.faults import FAULTS, JUMPS, check_faults, check_jumps
from fullswarm.testing.process import PROCESS, check_process
from fullswarm.testing.trial import DRIFT_M, DRIFT_RAD, IDLE_S, NEXT_S, PACE, SILENCE_S, Report, Rig, Trial


def check_driver(
    make: Callable[[], Driver] | Rig,
    *,
    settle_s: float = 2.0,
    deadline_s: float = 10.0,
    pump: Callable[[], object] | None = None,
    exercise: bool = True,
) -> Report:
    """Lead a driver through its lifecycle, then inject the rig's faults. Real time: 4 s, with a whole rig some 15 s.

    Parameters
    ----------
    make
        A :class:`~fullswarm.testing.Rig`; or only its `make`, which constructs a driver for the same robot each time.
    settle_s
        In which the robot reaches or leaves half its speed, and its readings show that.
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
        The driver breaks the contract; names the place and the remedy.
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
                check_actuators(trial, _check_stops_soon)
                check_faults(trial)
        finally:
            driver.close()
        if exercise:
            check_jumps(trial)
            check_process(trial)
    if not exercise:
        for name in (*CLAIMS, ACTUATORS, *FAULTS, *JUMPS, *PROCESS):
            report.skip(name, UNMOVED)
    return report


@contextmanager
def _threads(trial: Trial) -> Iterator[None]:
    """Report exceptions that end a thread during the check."""
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


WINDOW_S = 0.2
"""How long a robot drives while its odometry is compared with the twist."""
PROMPT_S, SOONER_S = 0.15, 0.12
"""What must stop the robot at once slows it within the first, or by the second sooner than silence does."""
FAIR, TRIES = 2, 6
"""So many measurements on a machine that kept time condemn a driver; so many are taken at most."""
ROUNDS = 3
THREADS_S = 1.0
"""In which the threads of a driver end after close()."""
CALLS, BEST_S, USUAL_S = 50, 0.005, 0.05
"""Of so many calls the fastest and the median must be below; the contract is 1 ms, machines are noisy."""

MOTORS = "motors off unless ACTIVE"
UNMOVED = "the robot may not move (exercise=False)"

_NOT_FINITE = (Twist(math.nan, 0.0), Twist(0.0, math.nan), Twist(math.inf, 0.0), Twist(0.0, -math.inf))
_HUGE = sys.float_info.max


def check_contract(trial: Trial, make: Callable[[], Driver], exercise: bool) -> None:
    """Lead a driver through its lifecycle, opened twice; `exercise` lets the robot move."""
    driver, threads = trial.driver, set(threading.enumerate())
    trial.demand(driver.read() is None, "read() returns a reading before open(); return None until one arrives")
    _check_closed(trial, "before open()")
    _check_description(trial, driver.description)
    _check_opening(trial)
    _check_activation(trial, make)
    _check_not_finite(trial)
    trial.report.add("lifecycle")
    if exercise:
        _check_limits(trial, driver.description.limits)
        _check_signs(trial)
        took_s = _check_silence(trial)
        stop_limit_s = max(PROMPT_S, took_s - SOONER_S)
        stop_s = _check_not_finite_stops(trial, stop_limit_s)
        trial.report.add("limits, signs and scale")
        trial.report.add("silence of the controller", f"slows after {took_s:.2f} s")
        trial.report.add("not finite", f"slows after {stop_s:.2f} s")
    else:
        stop_limit_s = SILENCE_S
        for name in ("limits, signs and scale", "silence of the controller", "not finite"):
            trial.report.skip(name, UNMOVED)
    _check_promptness(trial, trial.pace if exercise else STAND)
    trial.report.add("promptness")
    _check_deactivation(trial, exercise, stop_limit_s)
    note = _check_closing(trial, exercise, stop_limit_s, threads)
    trial.report.add("deactivate and close", note)
    if not trial.report.lacks(MOTORS, motors_on=trial.rig.motors_on):
        trial.report.add(MOTORS, "after open(), deactivate() and close()")


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
    _check_motors_off(trial, "READY after open()")
    trial.driver.deactivate()
    trial.demand(
        trial.state is Lifecycle.READY,
        f"it is {trial.state}, not READY, although activate() was not called: that is the agent's decision",
    )


def _check_activation(trial: Trial, make: Callable[[], Driver]) -> None:
    trial.driver.activate()
    trial.reach(Lifecycle.ACTIVE, "activate()")
    trial.stays(trial.fresh().odometry, "although it was activated only", lambda: trial.command(STAND))
    _check_second_driver(trial, make)
    reading = trial.fresh()
    trial.demand(
        reading.pose is not None or not trial.driver.description.senses_pose,
        "its description claims senses_pose, but it is ACTIVE and reports none",
    )


def _check_second_driver(trial: Trial, make: Callable[[], Driver]) -> None:
    """Construct another driver for the same robot: this one stays ACTIVE, if it does so without the other."""
    if any(_stays_active(trial, make) for _ in range(ROUNDS)):
        return
    alone = any(_stays_active(trial, None) for _ in range(ROUNDS))
    trial.demand(not alone, "constructing a second driver disturbs the first; touch nothing there")
    why = trial.driver.fault or "no fault is reported"
    trial.demand(
        False,
        f"it is {trial.state} although it was activated and commanded ({why}); only deactivate() or a fault ends it",
    )


def _stays_active(trial: Trial, make: Callable[[], Driver] | None) -> bool:
    """Tell whether an ACTIVE driver is still so after a second one was constructed, or nothing was done."""
    if trial.state is not Lifecycle.ACTIVE:
        trial.reach(Lifecycle.READY, "a fault while ACTIVE")
        trial.driver.activate()
        trial.reach(Lifecycle.ACTIVE, "activate()")
    if make is not None:
        other = make()
        try:
            trial.demand(
                other.state is Lifecycle.CLOSED, f"a second driver is {other.state} without open(), not CLOSED"
            )
        finally:
            other.close()
    trial.keep(2 * IDLE_S, STAND)
    trial.fresh()
    return trial.state is Lifecycle.ACTIVE


def _check_motors_off(trial: Trial, when: str) -> None:
    """READY and CLOSED mean that the device obeys no set-point of any sender."""
    motors_on = trial.rig.motors_on
    if motors_on is not None:
        off = trial.wait(lambda: not motors_on(), trial.deadline_s)
        trial.demand(off, f"the motors are on although it is {when}; disarm, leave closed loop or Safe mode")


def _check_not_finite(trial: Trial) -> None:
    for bad in _NOT_FINITE:
        _check_refused(trial, bad, "while ACTIVE")
        trial.command(STAND)
    trial.demand(trial.state is Lifecycle.ACTIVE, f"a value that is not finite makes it {trial.state}; it stays ACTIVE")
    trial.halt("a value that was not finite")


def _check_limits(trial: Trial, limits: Limits) -> None:
    speed, turn = 10.0 * limits.speed_m_s, 10.0 * limits.turn_rad_s
    for desired in (Twist(speed, 0.0), Twist(0.0, turn), Twist(-speed, -turn), Twist(_HUGE, _HUGE), Twist(0.0, -_HUGE)):
        try:
            applied = trial.command(desired)
        except ValueError as error:
            raise AssertionError(
                f"{trial.driver.url}: command({desired}) raises ValueError ({error}); it is finite: clip it"
            ) from error
        forwards = desired.linear_m_s >= 0.0 or limits.can_reverse
        trial.demand(applied != STAND or not forwards, f"command({desired}) returns zero; clip, do not refuse")
        zero = trial.command(STAND)
        trial.demand(zero == STAND, f"command({STAND}) returns {zero}; zero can always be applied")
    trial.halt("a zero command", each=lambda: trial.command(STAND))


def _check_signs(trial: Trial) -> None:
    """Drive forwards, turn left, then both the other way round, and see what the readings make of it."""
    speed, turn = trial.pace.linear_m_s, trial.pace.angular_rad_s
    back = -speed if trial.driver.description.limits.can_reverse else speed
    for desired in (Twist(speed, 0.0), Twist(0.0, turn), Twist(back, -turn)):
        applied = trial.drive(desired)
        begin = trial.fresh()
        trial.keep(WINDOW_S, desired)
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
        f"under {applied} the odometry moves {aside_m:.3f} m sideways and {forward_m:.3f} m along its heading; it is "
        "in the frame of open(), with x along the heading then",
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


def _check_not_finite_stops(trial: Trial, limit_s: float) -> float:
    bad = Twist(math.nan, 0.0)
    refused = partial(_check_refused, trial, bad, "while driving")
    return _check_stops(trial, refused, "a value that is not finite", "then raise", limit_s)


def _check_silence(trial: Trial) -> float:
    remedy = f"from a thread of the driver's own, when no command has come for {SILENCE_S} s"
    return _check_stops(trial, lambda: None, "silence", remedy, 2.0 * SILENCE_S)


def _check_stops(trial: Trial, act: Callable[[], None], what: str, remedy: str, limit_s: float) -> float:
    """Something must stop the robot by itself, within `limit_s`; return how soon it did.

    `limit_s` may lie close below the time that silence takes, which a driver that does nothing else would need.
    """

    def measure() -> float:
        applied = _drive_off(trial)
        began_s = trial.clock.now_s()
        act()
        trial.wait(partial(trial.slower, applied), trial.settle_s)
        took_s = (trial.newest.stamp_s if trial.newest is not None else math.inf) - began_s
        trial.halt(f"{what} (set zero, {remedy})")
        return took_s

    return _judge(trial, measure, limit_s, f"{what} slows it after {{}} only, not {limit_s:.2f} s; set zero, {remedy}")


def _check_stops_soon(trial: Trial, act: Callable[[], None], what: str, remedy: str) -> float:
    return _check_stops(trial, act, what, remedy, max(PROMPT_S, SILENCE_S - SOONER_S))


def _drive_off(trial: Trial) -> Twist:
    """Drive at half speed, from READY or ACTIVE; return what is applied."""
    if trial.state is not Lifecycle.ACTIVE:
        trial.reach(Lifecycle.READY, "a stop")
        trial.driver.activate()
        trial.reach(Lifecycle.ACTIVE, "activate()")
    return trial.drive(Twist(trial.pace.linear_m_s, 0.0), share=0.9)


def _judge(trial: Trial, measure: Callable[[], float], limit_s: float, otherwise: str) -> float:
    """Measure until a time is below `limit_s`; what was measured while this machine was late does not count."""
    took_s, fair = math.inf, 0
    for _ in range(TRIES):
        late_s = trial.late_s
        took_s = measure()
        if took_s < limit_s:
            return took_s
        fair += trial.late_s == late_s
        if fair == FAIR:
            break
    trial.demand(fair == 0, otherwise.format(f"{took_s:.2f} s"))
    trial.demand(
        False, f"{otherwise.format(f'{took_s:.2f} s')} (in {TRIES} of {TRIES} tries this machine was busy itself: "
        "end other programs and try again)"
    )  # fmt: skip
    return took_s


def _check_promptness(trial: Trial, pace: Twist) -> None:
    """Time the calls that the agent makes each tick; `pace` and zero in turn, so that something has to be sent."""
    driver, twists = trial.driver, (pace, STAND)
    calls: dict[str, Callable[[int], object]] = {
        "read()": lambda _: driver.read(),
        "state": lambda _: driver.state,
        "command()": lambda number: driver.command(twists[number % 2]),
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


def _check_deactivation(trial: Trial, exercise: bool, limit_s: float) -> None:
    if exercise:
        _check_stops(trial, trial.driver.deactivate, "deactivate()", "then leave ACTIVE", limit_s)
    else:
        trial.driver.deactivate()
    _check_zero(trial, "after deactivate()")
    trial.reach(Lifecycle.READY, "deactivate()")
    trial.halt("deactivate()", each=lambda: _check_zero(trial, "after deactivate()"))
    trial.demand(trial.state is Lifecycle.READY, f"{trial.state} after deactivate(), not READY")
    _check_motors_off(trial, "READY after deactivate()")


def _check_closing(trial: Trial, exercise: bool, limit_s: float, threads: set[threading.Thread]) -> str:
    """Close while ACTIVE, moving if allowed, and open again; return what was measured.

    `threads` are those from before open(): no other is left after close().
    """
    if exercise and trial.rig.body_speed is not None:
        note = _check_close_stops(trial, trial.rig.body_speed, limit_s)
    else:
        _activate_again(trial)
        if exercise:
            trial.drive(Twist(trial.pace.linear_m_s, 0.0))
        trial.driver.close()
        note = "close() while driving not seen: the rig has no body_speed" if exercise else ""
    _check_closed(trial, "after close()")
    _check_motors_off(trial, "CLOSED")
    _check_threads(trial, threads)
    if trial.rig.body_speed is not None:  # it may coast; without a true speed the next readings must show it at rest
        trial.come_to_rest(trial.settle_s, "close()")
    _check_opening(trial)
    return note


def _activate_again(trial: Trial) -> None:
    trial.driver.activate()
    trial.reach(Lifecycle.ACTIVE, "the second activate()")


def _check_close_stops(trial: Trial, body_speed: Callable[[], Twist], limit_s: float) -> str:
    """The driver itself stops the wheels in close(): the device's watchdog, if it has one, would be later."""
    watchdog_s = trial.driver.description.watchdog_s

    def measure() -> float:
        if trial.state is Lifecycle.CLOSED:
            _check_opening(trial)
        _activate_again(trial)
        trial.drive(Twist(trial.pace.linear_m_s, 0.0), share=0.9)
        fast_m_s = 0.8 * abs(body_speed().linear_m_s)
        closing = _Closing(trial.driver)
        began_s = trial.clock.now_s()
        closing.start()
        trial.wait(lambda: abs(body_speed().linear_m_s) < fast_m_s, max(trial.settle_s, watchdog_s or 0.0))
        took_s = trial.clock.now_s() - began_s
        trial.demand(trial.wait(lambda: not closing.is_alive(), trial.deadline_s), "close() does not return")
        if closing.error is not None:
            raise closing.error
        trial.come_to_rest(trial.settle_s + (watchdog_s or 0.0), "close()")
        return took_s

    if watchdog_s is not None and watchdog_s <= limit_s + PROMPT_S:
        measure()
        return f"close() or its watchdog ({watchdog_s:g} s) stops it: too close together to be distinguished"
    remedy = "send zero before the port is closed, the device's watchdog is the last resort"
    otherwise = f"close() slows it after {{}} only, not {limit_s:.2f} s; {remedy}"
    return f"close() slows it after {_judge(trial, measure, limit_s, otherwise):.2f} s"


class _Closing(threading.Thread):
    """Closes a driver while the robot is watched."""

    def __init__(self, driver: Driver) -> None:
        super().__init__(name="check: close()", daemon=True)
        self._driver = driver
        self.error: Exception | None = None

    def run(self) -> None:
        try:
            self._driver.close()
        except Exception as error:  # raised again on the checking thread
            self.error = error


def _check_threads(trial: Trial, before: set[threading.Thread]) -> None:
    def left() -> list[str]:
        return [each.name for each in threading.enumerate() if each not in before]

    trial.wait(lambda: not left(), THREADS_S)
    names = ", ".join(f"'{name}'" for name in left())
    trial.demand(not names, f"close() leaves the thread {names}; end it and join it")


def _check_zero(trial: Trial, when: str) -> None:
    applied = trial.driver.command(trial.pace)
    trial.demand(applied == STAND, f"command() {when} returns {applied}; anything but ACTIVE applies and returns zero")


def _check_refused(trial: Trial, bad: Twist, when: str) -> None:
    try:
        applied = trial.driver.command(bad)
    except ValueError:
        return
    raise AssertionError(
        f"{trial.driver.url}: command({bad}) {when} returns {applied}; stop the robot and raise ValueError"
    )


CLAIMS = (
    "measured and true speed",
    "odometry and true motion",
    "slow driving",
    "can_reverse",
    "senses_bumps",
    "senses_pose",
    "senses_obstacles",
    "ranges",
)
TRUE = 0.25
"""Share by which the true speed may differ from the measured one."""
WAY_S, WAYS = 1.5, 3
"""How long the odometry is compared with the true motion, and how often before it counts as wrong."""
SLOW = (Twist(0.05, 0.0), Twist(0.0, 0.1))
SLOW_S, SLOW_SHARE = 1.0, 0.4
"""How long a slow robot is watched, and by which share it may be slower or faster than applied."""
POSE_M = 0.1
BACK_S = 0.4


def check_claims(trial: Trial) -> None:
    """Compare the description with the robot; begins and ends with an open driver at standstill."""
    rig, report, description = trial.rig, trial.report, trial.driver.description
    if not report.lacks("measured and true speed", body_speed=rig.body_speed):
        report.add("measured and true speed", _check_truth(trial))
    if not report.lacks("odometry and true motion", body_speed=rig.body_speed):
        report.add("odometry and true motion", _check_odometry(trial))
    report.add("slow driving", _check_slow(trial))
    report.add("can_reverse", _check_reverse(trial))
    if not description.senses_bumps:
        report.add("senses_bumps", "not claimed, and never reported")
    elif rig.bump is None:
        report.lacks("senses_bumps", bump=None)
    else:
        report.add("senses_bumps", _check_bumps(trial, rig.bump))
    if not description.senses_pose:
        report.add("senses_pose", "not claimed, and never reported")
    elif not report.lacks("senses_pose", body_pose=rig.body_pose):
        report.add("senses_pose", _check_pose(trial))
    if not description.senses_obstacles:
        report.add("senses_obstacles", "not claimed, and never reported")
    elif not report.lacks("senses_obstacles", obstacle=rig.obstacle):
        report.add("senses_obstacles", _check_obstacles(trial))
    if not description.ranges_max_m > 0.0:
        report.add("ranges", "not claimed, and never reported")
    else:
        report.add("ranges", _check_ranges(trial))


def _check_truth(trial: Trial) -> str:
    """The readings show how the body moves: a scale that is wrong in both directions would pass otherwise."""
    worst = 0.0
    trial.go()
    for desired in (Twist(trial.pace.linear_m_s, 0.0), Twist(0.0, trial.pace.angular_rad_s)):
        applied = trial.drive(desired, share=0.9)
        agrees = trial.wait(partial(_agrees, trial, applied), trial.settle_s, partial(trial.command, desired))
        trial.demand(
            agrees,
            f"under {applied} the body moves with {trial.motion}, but the reading is "
            f"{trial.newest and trial.newest.twist}; check wheel radius, base and units",
        )
        worst = max(worst, _error(trial, applied))
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    return f"within {worst:.1%}"


def _agrees(trial: Trial, applied: Twist) -> bool:
    return _error(trial, applied) <= TRUE


def _error(trial: Trial, applied: Twist) -> float:
    """Return the relative error of the newest reading, in the component that is driven."""
    measured, true = trial.newest.twist if trial.newest is not None else STAND, trial.motion or STAND
    if applied.linear_m_s:
        return abs(measured.linear_m_s - true.linear_m_s) / max(abs(true.linear_m_s), 1e-6)
    return abs(measured.angular_rad_s - true.angular_rad_s) / max(abs(true.angular_rad_s), 1e-6)


@dataclass
class _Way:
    """Adds up how far the odometry goes and how far the body truly goes, along its heading or round."""

    trial: Trial
    turning: bool
    before: Reading
    measured: float = 0.0  # m or rad
    true_rate: float = 0.0  # m/s or rad/s, added up …
    samples: int = 0  # … over so many samples

    def sample(self) -> None:
        """Take the newest reading, and the body's motion now."""
        reading = self.trial.newest
        if reading is not None and reading.stamp_s > self.before.stamp_s:
            a, b = self.before.odometry, reading.odometry
            turned = wrap(b.heading_rad - a.heading_rad)
            halfway = a.heading_rad + turned / 2.0
            along = math.cos(halfway) * (b.x_m - a.x_m) + math.sin(halfway) * (b.y_m - a.y_m)
            self.measured += turned if self.turning else along
            self.before = reading
        motion = self.trial.motion or STAND
        self.true_rate += motion.angular_rad_s if self.turning else motion.linear_m_s
        self.samples += 1


def _measure_way(trial: Trial, desired: Twist, duration_s: float) -> tuple[float, float]:
    """Drive for a while; return the mean speed by the odometry, and as it truly was (m/s or rad/s)."""
    way = _Way(trial, desired.angular_rad_s != 0.0, trial.fresh())
    began_s = way.before.stamp_s

    def each() -> None:
        trial.command(desired)
        way.sample()

    trial.wait(lambda: False, duration_s, each)
    return way.measured / max(way.before.stamp_s - began_s, 1e-6), way.true_rate / max(way.samples, 1)


def _check_odometry(trial: Trial) -> str:
    """The way that the odometry counts is the body's: a wheel radius or base that is 10 % wrong shows here."""
    worst, most = 0.0, trial.rig.odometry_share
    for desired in (Twist(trial.pace.linear_m_s, 0.0), Twist(0.0, trial.pace.angular_rad_s)):
        off, measured, true = math.inf, 0.0, 0.0
        for _ in range(WAYS):  # the body may have been bumped, or this machine busy
            trial.go()
            trial.drive(desired, share=0.9)
            measured, true = _measure_way(trial, desired, WAY_S)
            off = abs(measured - true) / max(abs(true), 1e-6)
            if off <= most:
                break
        what = "wheel radius" if desired.linear_m_s else "wheel base"
        trial.demand(
            off <= most,
            f"under {desired} the odometry counts {measured:.3f} a second, the body goes {true:.3f}: {off:.0%} apart, "
            f"more than {most:.0%}; check {what} and counts per turn",
        )
        worst = max(worst, off)
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    return f"within {worst:.1%}"


def _check_slow(trial: Trial) -> str:
    """The twist that command() returns moves the robot, however slow: in a dead band it returns zero."""
    found = []
    for desired in SLOW:
        trial.go()
        trial.halt("a zero command", each=lambda: trial.command(STAND))
        applied = trial.command(desired)
        rate = applied.linear_m_s or applied.angular_rad_s
        unit = "m/s" if desired.linear_m_s else "rad/s"
        if rate == 0.0:
            found.append(f"{desired.linear_m_s or desired.angular_rad_s:g} {unit}: returns zero")
            continue
        trial.keep(min(trial.settle_s, SLOW_S), desired)
        measured, true = _measure_way(trial, desired, SLOW_S)
        moves = true if trial.rig.body_speed is not None else measured
        rest = trial.rig.rest_m_s if desired.linear_m_s else 0.0
        trial.demand(
            abs(moves - rate) <= SLOW_SHARE * abs(rate) + rest,
            f"command({desired}) returns {rate:.3f} {unit}, but the robot moves with {moves:.3f} {unit}; "
            "where the device has a dead band, return what it does: zero",
        )
        found.append(f"{moves:.3f} of {rate:.3f} {unit}")
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    return ", ".join(found)


def _check_reverse(trial: Trial) -> str:
    """Half speed backwards: applied if it can, clipped to zero if it cannot, by the wheels and in the twist."""
    limits = trial.driver.description.limits
    back = Twist(-PACE * limits.speed_m_s, 0.0)
    if limits.can_reverse:
        return "claimed, and driven backwards"  # by the check of the signs
    trial.go()
    trial.halt("a zero command", each=lambda: trial.command(STAND))
    begin = trial.fresh().odometry
    trial.keep(BACK_S, back)
    end = trial.fresh().odometry
    c, s = math.cos(begin.heading_rad), math.sin(begin.heading_rad)
    gone_m = c * (end.x_m - begin.x_m) + s * (end.y_m - begin.y_m)
    true = trial.motion or STAND
    trial.demand(
        gone_m >= -0.1 * limits.speed_m_s * BACK_S and true.linear_m_s >= -0.1 * limits.speed_m_s,
        f"its description denies reversing, but under {back} it moves by {gone_m:.3f} m ({true}); clip it",
    )
    return "denied, and clipped"


def _check_bumps(trial: Trial, bump: Callable[[bool], object]) -> str:
    began_s = trial.clock.now_s()
    bump(True)
    try:
        seen = trial.wait(lambda: _bumped(trial), NEXT_S)
        took_s = trial.clock.now_s() - began_s
        trial.demand(seen, f"its description claims senses_bumps, but a bump is not reported within {NEXT_S} s")
    finally:
        bump(False)
    gone = trial.wait(lambda: not _bumped(trial), NEXT_S)
    trial.demand(gone, f"it still reports a bump {NEXT_S} s after the bumper was released")
    return f"reported after {took_s:.2f} s"


def _bumped(trial: Trial) -> bool:
    return trial.newest is not None and Hazard.BUMP in trial.newest.hazards


def _check_pose(trial: Trial) -> str:
    where = trial.rig.body_pose
    if where is None:
        return ""
    trial.wait(trial.at_rest, trial.settle_s)
    measured, true = trial.fresh().pose, where()
    if measured is None:
        raise AssertionError(f"{trial.driver.url}: its description claims senses_pose, but it reports none")
    off_m = math.hypot(measured.x_m - true.x_m, measured.y_m - true.y_m)
    off_rad = abs(wrap(measured.heading_rad - true.heading_rad))
    trial.demand(
        off_m <= POSE_M and off_rad <= 2.0 * DRIFT_RAD,
        f"it reports the pose {measured}, the body is at {true}; x is east, y north, heading 0 along x and "
        "counter-clockwise",
    )
    return f"{off_m * 1e3:.0f} mm, {math.degrees(off_rad):.1f} deg from the true pose"


def _check_ranges(trial: Trial) -> str:
    """Scans come, each newer than the one before."""
    seen = trial.wait(lambda: trial.newest is not None and bool(trial.newest.ranges), NEXT_S)
    trial.demand(seen, f"its description claims ranges, but no scan is reported within {NEXT_S} s")
    first = trial.newest.ranges[0].stamp_s if trial.newest is not None else 0.0
    newer = trial.wait(lambda: trial.newest is not None and trial.newest.ranges[0].stamp_s > first, NEXT_S)
    trial.demand(newer, f"its scan is not followed by a newer one within {NEXT_S} s")
    return "reported"


def _check_obstacles(trial: Trial) -> str:
    put = trial.rig.obstacle
    if put is None:
        return ""
    put()
    seen = trial.wait(lambda: trial.newest is not None and len(trial.newest.obstacles) > 0, NEXT_S)
    trial.demand(seen, f"its description claims senses_obstacles, but an obstacle is not reported within {NEXT_S} s")
    return "reported"
