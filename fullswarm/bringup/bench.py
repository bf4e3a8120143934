"""A robot under test by a person: the one place that waits for it, and that Ctrl-C ends at once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from fullswarm import output
from fullswarm.drivers.base import STAND, Driver, Lifecycle, Reading, Twist
from fullswarm.geometry import wrap
from fullswarm.launch.typed import Typed
from fullswarm.runtime import Runtime

STEP_S = 0.02
STILL = 0.04
"""Share of its limits below which a robot counts as standing, unless its make's noise is greater."""


@dataclass
class Bench:
    """A driver, its newest reading, and the operator beside the robot (None: no terminal)."""

    driver: Driver
    runtime: Runtime
    operator: Typed | None = None
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
        """Look at 50 Hz, calling `each`, until a condition holds; return whether it did in time.

        Raises
        ------
        KeyboardInterrupt
            Ctrl-C or SIGTERM, at most one step ago.
        """
        fulfilled = False

        def look() -> None:
            nonlocal fulfilled
            self._read()
            fulfilled = fulfilled or until()
            if fulfilled:
                self.runtime.pause()
            elif each is not None:
                each()

        timer = self.runtime.every(STEP_S, look, first_s=0.0)
        try:
            self.runtime.run(limit_s)
        finally:
            timer.cancel()
        if self.runtime.exit_signal is not None:
            raise KeyboardInterrupt
        return fulfilled

    def drive(self, wished: Twist, duration_s: float) -> None:
        """Command `wished` for a while."""
        self.wait(lambda: False, duration_s, lambda: self.driver.command(wished))

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
