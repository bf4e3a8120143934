"""Runs `fullswarm robots test URL`: drives one robot a short way, slowly, and reports whether it follows the driver.

Each step gives a verdict. Whatever ends the test, Ctrl-C and a closed terminal included, the wheels are commanded zero
first; should this process be killed, the robot's watchdog stops them, or the guardian of one that has none.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Literal

from rich.markup import escape

from fullswarm import output, registry
from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import STAND, STOPPING_HAZARDS, Description, Driver, Hazard, Lifecycle, Reading, Twist
from fullswarm.drivers.guardian import guarded
from fullswarm.errors import ConfigError
from fullswarm.geometry import wrap
from fullswarm.output import TypedLines
from fullswarm.runtime import Runtime

if TYPE_CHECKING:
    from rich.table import Table

STEP_S = 0.02
STILL = 0.04
"""Share of its limits below which a robot counts as at standstill, unless the noise of its make is greater."""
Verdict = Literal["passed", "failed", "skipped"]
ACTIVATE_S, DEACTIVATE_S, STAND_S = 15.0, 10.0, 2.0
SETTLE_S, LONGEST_SETTLE_S, WINDOW_S = 0.4, 2.0, 0.6
SETTLED = 0.9
"""Share of the commanded speed that a robot has to measure first: an autopilot's regulator is slow at low speeds."""
LEAST, MOST, NOTHING = 0.7, 1.3, 0.1
"""Shares of the commanded way that the odometry may show; below the last it does not move at all."""
HALF = 0.45, 0.55
SLOWEST_HZ = 4.0
"""An agent stops its robot when readings are older than 0.5 s."""
SILENCE_S = 1.0
"""Time within which a robot without commands is at standstill: 0.5 s, and as much to decelerate."""
PRESS_S = 30.0
ON_THE_FLOOR = """Put the robot on the floor with 0.5 m of free room on all sides, away from edges, off its charger.
(In the air its wheel-drop and cliff sensors would not let it drive.)"""
NO_WATCHDOG = "Should this computer die or the cable come off, the robot drives on: keep a hand on its switch."
IN_THE_AIR = """Jack the robot up so that no wheel touches the ground, and keep hands and cables away."""


@dataclass
class Bench:
    """A driver, its newest reading, and the operator beside the robot (None: no terminal)."""

    driver: Driver
    runtime: Runtime
    operator: TypedLines | None = None
    newest: Reading | None = None
    readings: int = 0
    still: Twist = field(default=STAND, init=False)

    def __post_init__(self) -> None:
        limits = self.driver.description.limits
        noise = self.driver.description.standstill
        self.still = Twist(
            max(STILL * limits.speed_m_s, noise.speed_m_s), max(STILL * limits.turn_rad_s, noise.turn_rad_s)
        )

    def wait(self, until: Callable[[], bool], limit_s: float, each: Callable[[], object] | None = None) -> bool:
        """Check at 50 Hz, calling `each`, until a condition holds; return whether it did in time.

        Raises
        ------
        KeyboardInterrupt
            Ctrl-C or SIGTERM, at most one step ago.
        """
        fulfilled = False

        def check() -> None:
            nonlocal fulfilled
            self._read()
            fulfilled = fulfilled or until()
            if fulfilled:
                self.runtime.pause()
            elif each is not None:
                each()

        timer = self.runtime.every(STEP_S, check, first_s=0.0)
        try:
            self.runtime.run(limit_s)
        finally:
            timer.cancel()
        if self.runtime.exit_signal is not None:
            raise KeyboardInterrupt
        return fulfilled

    def drive(self, desired: Twist, duration_s: float) -> None:
        """Command `desired` for a while."""
        self.wait(lambda: False, duration_s, lambda: self.driver.command(desired))

    def halt(self, limit_s: float) -> bool:
        """Command zero until the robot is at standstill; return whether it is."""
        return self.wait(self.standing, limit_s, lambda: self.driver.command(STAND))

    def reach(self, state: Lifecycle, limit_s: float, each: Callable[[], object] | None = None) -> bool:
        """Wait for a state; return whether it was reached."""
        return self.wait(lambda: self.driver.state is state, limit_s, each)

    def standing(self) -> bool:
        """Return whether the newest reading shows a robot at standstill."""
        twist = STAND if self.newest is None else self.newest.twist
        slow = abs(twist.linear_m_s) <= self.still.linear_m_s
        return slow and abs(twist.angular_rad_s) <= self.still.angular_rad_s

    def fresh(self, limit_s: float = 1.0) -> Reading | None:
        """Return a reading that has come after this moment; None when none does."""
        seen = self.readings
        return self.newest if self.wait(lambda: self.readings > seen, limit_s) else None

    def answers(self, question: str, limit_s: float = 120.0) -> bool | None:
        """Ask the operator; None without a terminal or an answer."""
        typed = self._ask(f"{question} [y/n] ", limit_s)
        return None if not typed else typed.lower() in ("y", "yes")

    def sees(self, instruction: str, until: Callable[[Reading], bool], limit_s: float) -> bool | None:
        """Ask the operator to do something and wait until a reading shows it; None when it is skipped."""
        if self.operator is None or self.operator.ended:
            return None
        output.progress(f"{instruction} (Enter skips it)")
        skipped = False

        def done() -> bool:
            nonlocal skipped
            skipped = self.operator is not None and self.operator.line() is not None
            return skipped or (self.newest is not None and until(self.newest))

        return self.wait(done, limit_s) and (None if skipped else True)

    def _ask(self, prompt: str, limit_s: float) -> str | None:
        operator, typed = self.operator, None
        if operator is None or operator.ended:
            return None
        output.progress(prompt)

        def come() -> bool:
            nonlocal typed
            typed = operator.line()
            return typed is not None or operator.ended

        self.wait(come, limit_s)
        return typed

    def _read(self) -> None:
        reading = self.driver.read()
        if reading is not None and (self.newest is None or reading.stamp_s != self.newest.stamp_s):
            self.newest, self.readings = reading, self.readings + 1


def moved(begin: Reading, end: Reading) -> tuple[float, float]:
    """Return how far the odometry went along the heading (m) and how far it turned (rad) between two readings."""
    a, b = begin.odometry, end.odometry
    turned = wrap(b.heading_rad - a.heading_rad)
    middle = a.heading_rad + turned / 2.0
    return math.cos(middle) * (b.x_m - a.x_m) + math.sin(middle) * (b.y_m - a.y_m), turned


# ---------------------------------------------------------------- the steps
@dataclass(frozen=True, slots=True)
class Step:
    """One line of the result."""

    name: str
    verdict: Verdict
    what: str


def steps(bench: Bench, clock: Clock, speed_m_s: float, ready_s: float, hertz: list[float]) -> Iterator[Step]:
    """Yield verdicts in order; ends early after a failure that makes the rest meaningless."""
    yield (ready := _ready(bench, clock, ready_s))
    if ready.verdict == "failed":
        return
    yield (state := _identity(bench))
    if state.verdict == "failed":
        return
    yield (rate := _rate(bench, hertz))
    if rate.verdict == "failed":
        return
    yield from _sensors(bench)
    yield (active := _activated(bench))
    if active.verdict == "failed":
        return
    limits = bench.driver.description.limits
    turn_rad_s = speed_m_s * limits.turn_rad_s / limits.speed_m_s  # a differential drive's wheels at that speed
    moves = [
        ("forwards", Twist(speed_m_s, 0.0)),
        ("backwards", Twist(-speed_m_s, 0.0)),
        ("left", Twist(0.0, turn_rad_s)),
        ("right", Twist(0.0, -turn_rad_s)),
    ]
    blind = False
    for name, desired in moves:
        step = _move(bench, name, desired)
        blind = blind or (step.verdict == "skipped" and desired.linear_m_s >= 0.0)
        yield step
        if bench.driver.state is not Lifecycle.ACTIVE:
            yield Step("stays active", "failed", _why(bench.driver))
            return
    yield _watchdog(bench, clock, Twist(speed_m_s, 0.0), blind=blind)
    yield _deactivated(bench)


def _ready(bench: Bench, clock: Clock, limit_s: float) -> Step:
    reported, began_s = "", clock.now_s()

    def report() -> None:
        nonlocal reported
        why = bench.driver.fault or getattr(bench.driver, "why", "")
        if why and why != reported:
            reported = why
            output.progress(f"waiting: {why}")

    if bench.reach(Lifecycle.READY, limit_s, report):
        return Step("ready", "passed", f"{clock.now_s() - began_s:.1f} s after opening")
    return Step("ready", "failed", f"not READY within {limit_s:g} s: {reported or _why(bench.driver)}")


def _identity(bench: Bench) -> Step:
    reading, firmware = bench.fresh(), bench.driver.firmware
    battery = None if reading is None else reading.battery
    charge = "battery unknown" if battery is None else f"battery {battery:.0%}"
    hazards = Hazard.NONE if reading is None else reading.hazards
    what = f"firmware {firmware or 'not reported'}, {charge}"
    if hazards & STOPPING_HAZARDS:
        return Step("state", "failed", f"{what}, {_names(hazards)}: fix this first")
    return Step("state", "passed", f"{what}, {_names(hazards)}" if hazards else what)


def _rate(bench: Bench, hertz: list[float]) -> Step:
    before = bench.readings
    bench.wait(lambda: False, 1.0)
    rate = float(bench.readings - before)
    hertz.append(rate)
    # Looked at 50 times a second: a faster robot counts as 50.
    what = f"{rate:.0f} a second" if rate < 45.0 else "45 a second or more"
    return Step("readings", "passed" if rate >= SLOWEST_HZ else "failed", what)


def _activated(bench: Bench) -> Step:
    bench.driver.activate()
    if not bench.reach(Lifecycle.ACTIVE, ACTIVATE_S):
        return Step("activate", "failed", _why(bench.driver))
    if not bench.halt(STAND_S):
        return Step("activate", "failed", "it moves although nothing but zero was commanded")
    return Step("activate", "passed", "ACTIVE, at standstill")


def _move(bench: Bench, name: str, desired: Twist) -> Step:
    """Drive for a second and compare the way by odometry with what was applied; then it must stand."""
    driver, limits = bench.driver, bench.driver.description.limits
    if desired.linear_m_s < 0.0 and not limits.can_reverse:
        return Step(name, "skipped", "this robot cannot reverse")
    applied = driver.command(desired)
    if applied == STAND:
        reason = _why(driver) if driver.state is not Lifecycle.ACTIVE else "too slow for its controllers: raise --speed"
        return Step(name, "failed", f"the driver applies zero ({reason})")
    bench.drive(desired, SETTLE_S)
    bench.wait(partial(_settled, bench, applied), LONGEST_SETTLE_S - SETTLE_S, partial(driver.command, desired))
    begin = bench.newest
    bench.drive(desired, WINDOW_S)
    end = bench.newest
    standing = bench.halt(STAND_S)
    if begin is None or end is None or end.stamp_s <= begin.stamp_s:
        return Step(name, "failed", f"no readings while it drives ({_why(driver)})")
    forward_m, turned_rad = moved(begin, end)
    passed_s = end.stamp_s - begin.stamp_s
    if desired.linear_m_s:
        gone, expected, other, unit = forward_m, applied.linear_m_s * passed_s, turned_rad, "m"
    else:
        gone, expected, other, unit = turned_rad, applied.angular_rad_s * passed_s, forward_m, "rad"
    what = f"{gone:+.3f} {unit} by odometry where {expected:+.3f} were commanded"
    share = gone / expected
    if abs(share) < NOTHING and abs(other) < NOTHING * abs(expected):
        return _unmoved(bench, name, what)
    if not LEAST <= share <= MOST:
        return Step(name, "failed", f"{what}: {_cause(share, desired)}")
    if not standing:
        return Step(name, "failed", f"{what}, but it does not stand {STAND_S:g} s after zero")
    return Step(name, "passed", f"{what}, at standstill after zero")


def _settled(bench: Bench, applied: Twist) -> bool:
    measured = STAND if bench.newest is None else bench.newest.twist
    along = measured.linear_m_s * applied.linear_m_s >= SETTLED * applied.linear_m_s**2
    return along and measured.angular_rad_s * applied.angular_rad_s >= SETTLED * applied.angular_rad_s**2


def _unmoved(bench: Bench, name: str, what: str) -> Step:
    if not bench.driver.description.senses_pose:
        return Step(name, "failed", f"{what}: motors or encoders are not connected, or the brakes are on")
    seen = bench.answers(f"Its position does not move. Did the wheels turn {name}?")
    if seen is None:
        return Step(
            name, "skipped", "its position does not move: with the wheels in the air it may not know; see to it"
        )
    return Step(name, "passed" if seen else "failed", f"the operator {'saw' if seen else 'did not see'} it")


def _cause(share: float, desired: Twist) -> str:
    if share < -NOTHING:
        wrong = "wheels run backwards" if desired.linear_m_s else "left and right are swapped"
        return f"{wrong}, or the odometry's sign is wrong"
    if share < NOTHING:
        return "it turns instead: one wheel turns the wrong way" if desired.linear_m_s else "it does not turn"
    if HALF[0] < share < HALF[1]:
        return "half the way: one wheel does not turn"
    return "the scale is wrong: check wheel radius, gear and the distance between the wheels"


def _watchdog(bench: Bench, clock: Clock, desired: Twist, *, blind: bool) -> Step:
    """Send no commands while it drives: the driver must stop it."""
    bench.drive(desired, SETTLE_S + WINDOW_S)
    began_s = clock.now_s()
    if blind:
        bench.wait(lambda: False, SILENCE_S)
        seen = bench.answers("Commands have ended a second ago. Do the wheels stand?")
        if seen is None:
            return Step("silence stops it", "skipped", "its position does not move: see to it")
        return Step("silence stops it", "passed" if seen else "failed", "by the operator's eyes")
    if bench.standing():
        return Step("silence stops it", "failed", "it did not drive")
    standing = bench.wait(bench.standing, SILENCE_S)
    took_s = clock.now_s() - began_s
    bench.halt(STAND_S)
    if not standing:
        return Step("silence stops it", "failed", f"it still drives {SILENCE_S:g} s after the last command: DANGEROUS")
    return Step("silence stops it", "passed", f"at standstill {took_s:.2f} s after the last command")


def _sensors(bench: Bench) -> Iterator[Step]:
    """Let the operator press the bumper and lift the robot, wheels off."""
    if not bench.driver.description.senses_bumps:
        return
    tests = (
        ("bumper", "Press the front bumper.", Hazard.BUMP),
        ("cliff, wheel drop", "Lift the robot until its wheels hang.", Hazard.CLIFF | Hazard.WHEEL_DROP),
    )
    for name, instruction, wanted in tests:
        seen = bench.sees(instruction, partial(_reported, wanted), PRESS_S)
        if seen is None:
            yield Step(name, "skipped", "not tried")
        elif not seen:
            yield Step(name, "failed", f"nothing was reported within {PRESS_S:g} s")
        elif bench.sees("Let go, and put it down.", partial(_over, wanted), PRESS_S) is False:
            yield Step(name, "failed", "it is still reported")
        else:
            yield Step(name, "passed", "reported")


def _reported(wanted: Hazard, reading: Reading) -> bool:
    return bool(reading.hazards & wanted)


def _over(wanted: Hazard, reading: Reading) -> bool:
    return not reading.hazards & wanted


def _deactivated(bench: Bench) -> Step:
    bench.driver.deactivate()
    if not bench.reach(Lifecycle.READY, DEACTIVATE_S):
        return Step("deactivate", "failed", f"not READY: {_why(bench.driver)}")
    fastest = Twist(bench.driver.description.limits.speed_m_s, 0.0)
    if bench.driver.command(fastest) != STAND:
        return Step("deactivate", "failed", "it applies commands although it is not ACTIVE")
    return Step("deactivate", "passed", "READY, commands apply zero")


def _why(driver: Driver) -> str:
    """Return the driver's own description of its state."""
    words = driver.fault or getattr(driver, "blocked", "") or getattr(driver, "why", "")
    return f"{driver.state}: {words}" if words else str(driver.state)


def _names(hazards: Hazard) -> str:
    return ", ".join(each.name.lower().replace("_", " ") for each in hazards if each.name)


# ---------------------------------------------------------------- the test
def run(url: str, *, speed_m_s: float, confirmed: bool, ready_s: float, as_json: bool) -> int:
    """Test the robot at `url`; return 0 when nothing failed, else 1.

    Parameters
    ----------
    confirmed
        Skip the confirmation prompt: it is safe to drive.
    ready_s
        How long it may take to be READY.

    Raises
    ------
    ConfigError
        The URL is wrong, the speed is beyond the robot's, or no confirmation.
    DriverError
        The port cannot be had.
    """
    driver: Driver = guarded(registry.driver_class(url)(url))
    description = driver.description
    if speed_m_s > description.limits.speed_m_s:
        hint = f"its limit is {description.limits.speed_m_s:.2f} m/s"
        raise ConfigError(f"{speed_m_s} m/s is too fast for this robot", where="--speed", hint=hint)
    clock = MonotonicClock()
    runtime = Runtime(clock)
    runtime.stop_on_signals()
    bench = Bench(driver, runtime, None if confirmed else TypedLines())
    output.progress(_explain(description, speed_m_s))
    if not confirmed and not _agreed(bench):
        output.progress("nothing was opened, nothing moved")
        return 1
    done: list[Step] = []
    hertz: list[float] = []
    with _stopped_at_the_end(driver):
        driver.open()
        for step in steps(bench, clock, speed_m_s, ready_s, hertz):
            done.append(step)
            output.progress(f"{step.verdict:8} {step.name}: {step.what}")
        firmware, battery = driver.firmware, bench.newest.battery if bench.newest else None
        description = driver.description  # a rover reports its autopilot only now
    done.append(_closed(driver))
    passed = all(each.verdict != "failed" for each in done)
    if as_json:
        output.data_json(
            {
                "url": url,
                "make": description.make,
                "model": description.model,
                "firmware": firmware,
                "battery": battery,
                "readings_hz": hertz[0] if hertz else None,
                "passed": passed,
                "steps": [asdict(each) for each in done],
            }
        )
    else:
        output.data_table(_table(done))
        output.data(f"{description.make} {description.model}: {'passed' if passed else 'FAILED'}")
    return 0 if passed else 1


@contextlib.contextmanager
def _stopped_at_the_end(driver: Driver) -> Iterator[None]:
    """Stop the wheels first, then leave the robot in its safe state, whatever ends the test."""
    with contextlib.ExitStack() as end:  # from the last to the first, and each even if another fails
        end.callback(driver.close)
        end.callback(driver.deactivate)
        end.callback(driver.command, STAND)
        try:
            yield
        except KeyboardInterrupt:
            driver.command(STAND)
            output.progress("stopping the wheels, then closing")
            raise


def _beside_wheels(description: Description) -> str:
    parts = [f"{each.name} ({each.expected()})" for each in description.actuators]
    return f"Actuators, which this does not test: {'; '.join(parts)}\n" if parts else ""


def _explain(description: Description, speed_m_s: float) -> str:
    limits = description.limits
    watchdog = "none" if description.watchdog_s is None else f"{description.watchdog_s:g} s"
    alone = "" if description.watchdog_s else f"{NO_WATCHDOG}\n"
    place = ON_THE_FLOOR if description.senses_bumps else IN_THE_AIR
    return (
        f"{description.make} {description.model}: up to {limits.speed_m_s:.2f} m/s, {limits.turn_rad_s:.2f} rad/s; "
        f"its own watchdog: {watchdog}\n"
        f"{_beside_wheels(description)}"
        f"It will drive forwards, backwards, left and right, a second or two each, its wheels at {speed_m_s:g} m/s.\n"
        f"{alone}{place}\nCtrl-C stops the wheels at any time."
    )


def _agreed(bench: Bench) -> bool:
    agreed = bench.answers("Is it safe to drive?")
    if agreed is None:
        raise ConfigError("not confirmed that it is safe to drive", hint="answer y, or skip the prompt with --yes")
    return agreed


def _closed(driver: Driver) -> Step:
    closed = driver.state is Lifecycle.CLOSED
    return Step("close", "passed" if closed else "failed", str(driver.state))


def _table(steps: list[Step]) -> Table:
    table = output.plain_table("step", "verdict", "what")
    for each in steps:
        verdict = f"[bold red]{each.verdict}[/]" if each.verdict == "failed" else each.verdict
        table.add_row(escape(each.name), verdict, escape(each.what))
    return table
