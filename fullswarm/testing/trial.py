"""A driver under check: the one place that waits, and a look at each reading and each answer on the way."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import STAND, Driver, Hazard, Lifecycle, Pose, Reading, Twist
from fullswarm.geometry import wrap

STEP_S = 0.02
IDLE_S = 0.1
"""How long a robot is watched that should not move."""
PACE = 0.5
"""Share of its limits that a robot is driven at: above the dead band of most."""
TURN_RAD_S = 4.0
"""It is not turned faster: it would go round between two readings that are compared."""
STILL = 0.04
"""Share of the limits below which a robot counts as standing."""
DRIFT_M, DRIFT_RAD = 0.02, 0.05
AGE_S = 2.0
NEXT_S = 1.0
"""In which a new reading must come; an agent stops its robot after 0.5 s without."""
QUANTUM = 1e-3
"""Share of a limit by which the rounding to what the device can express may go beyond it."""


@dataclass
class Trial:
    """A driver under check, and the newest that it has told."""

    driver: Driver
    settle_s: float
    deadline_s: float
    pump: Callable[[], object] | None
    clock: Clock = field(default_factory=MonotonicClock)
    newest: Reading | None = None
    opened_s: float = 0.0

    @property
    def pace(self) -> Twist:
        """Half of what the robot can do."""
        limits = self.driver.description.limits
        return Twist(PACE * limits.speed_m_s, min(PACE * limits.turn_rad_s, TURN_RAD_S))

    def demand(self, fulfilled: bool, otherwise: str) -> None:
        """Raise ``AssertionError`` with the driver's URL and `otherwise` unless `fulfilled`."""
        if not fulfilled:
            raise AssertionError(f"{self.driver.url}: {otherwise}")

    def wait(self, until: Callable[[], bool], limit_s: float, each: Callable[[], object] | None = None) -> bool:
        """Wait for a condition, calling `each` and the pump at 50 Hz; tell whether it came true in time."""
        pause, due_s = threading.Event(), self.clock.now_s()
        end_s = due_s + limit_s
        self._look()
        while not until():
            if self.clock.now_s() >= end_s:
                return False
            if each is not None:
                each()
            if self.pump is not None:
                self.pump()
            # On a grid, so that a pumped world keeps up with real time; but never two steps at once.
            due_s = max(due_s + STEP_S, self.clock.now_s())
            pause.wait(due_s - self.clock.now_s())
            self._look()
        return True

    def _look(self) -> None:
        reading = self.driver.read()
        if reading is None or (self.newest is not None and reading.stamp_s == self.newest.stamp_s):
            return
        _check_reading(self, reading, self.newest)
        self.newest = reading

    def fresh(self) -> Reading:
        """Return a reading that arrived after this moment."""
        began_s = self.clock.now_s()
        came = self.wait(lambda: self.newest is not None and self.newest.stamp_s > began_s, NEXT_S)
        reading = self.newest
        if reading is None or not came:
            raise AssertionError(
                f"{self.driver.url}: no new reading for {NEXT_S} s while {self.state} "
                f"({self.driver.fault or 'no fault'}); an agent stops its robot after 0.5 s without"
            )
        return reading

    @property
    def state(self) -> Lifecycle:
        """Where the driver stands."""
        return self.driver.state

    def reach(self, state: Lifecycle, after: str) -> None:
        """Wait for a state."""
        reached = self.wait(lambda: self.state is state, self.deadline_s)
        self.demand(
            reached,
            f"it is {self.state}, not {state}, {self.deadline_s} s after {after} ({self.driver.fault or 'no fault'})",
        )

    def open(self) -> None:
        """Open the driver and forget the readings of an earlier life."""
        self.newest, self.opened_s = None, self.clock.now_s()
        self.driver.open()

    def command(self, wished: Twist) -> Twist:
        """Command, and look at what is said to be applied."""
        applied = self.driver.command(wished)
        _check_applied(self, wished, applied)
        return applied

    def drive(self, wished: Twist, share: float = 0.75) -> Twist:
        """Command `wished` until the robot measures `share` of what is applied; return that."""
        applied = self.command(wished)
        self.demand(
            (applied.linear_m_s != 0.0 or wished.linear_m_s == 0.0)
            and (applied.angular_rad_s != 0.0 or wished.angular_rad_s == 0.0),
            f"{wished}, half of its limits, becomes {applied} while {self.state} ({self.driver.fault or 'no fault'})",
        )
        # What rounding makes of a zero is not waited for.
        applied = Twist(
            applied.linear_m_s if wished.linear_m_s else 0.0, applied.angular_rad_s if wished.angular_rad_s else 0.0
        )
        followed = self.wait(lambda: self.follows(applied, share), self.settle_s, lambda: self.command(wished))
        self.demand(
            followed,
            f"it says that it applies {applied}, but measures {self.newest and self.newest.twist} {self.settle_s} s "
            f"later while {self.state}; check sign and scale of command and reading, or give a longer settle_s",
        )
        return applied

    def spend(self, duration_s: float, wished: Twist) -> None:
        """Command `wished` for a while."""
        self.wait(lambda: False, duration_s, lambda: self.command(wished))

    def follows(self, applied: Twist, share: float) -> bool:
        """Tell whether the newest reading shows at least `share` of `applied`, each component."""
        twist = self.newest.twist if self.newest is not None else STAND
        along = twist.linear_m_s * applied.linear_m_s >= share * applied.linear_m_s**2
        return along and twist.angular_rad_s * applied.angular_rad_s >= share * applied.angular_rad_s**2

    def slower(self, applied: Twist) -> bool:
        """Tell whether the newest reading shows clearly less than `applied`."""
        return not self.follows(applied, 0.8)

    def still(self) -> bool:
        """Tell whether the newest reading says that the robot stands."""
        limits, twist = self.driver.description.limits, self.newest.twist if self.newest is not None else STAND
        return (
            abs(twist.linear_m_s) <= STILL * limits.speed_m_s and abs(twist.angular_rad_s) <= STILL * limits.turn_rad_s
        )

    def halt(self, why: str, each: Callable[[], object] | None = None) -> None:
        """Wait until the robot stands."""
        self.fresh()
        self.demand(
            self.wait(self.still, self.settle_s, each),
            f"it still moves {self.settle_s} s after {why}: {self.newest and self.newest.twist}",
        )

    def stays(self, where: Pose, why: str, each: Callable[[], object]) -> None:
        """Watch a robot that should not move, calling `each`."""
        self.wait(lambda: False, IDLE_S, each)
        pose = self.fresh().odometry
        gone_m = math.hypot(pose.x_m - where.x_m, pose.y_m - where.y_m)
        turned = wrap(pose.heading_rad - where.heading_rad)
        self.demand(
            gone_m <= DRIFT_M and abs(turned) <= DRIFT_RAD and self.still(),
            f"it moves {why}: {gone_m:.3f} m, {turned:.3f} rad, {self.newest and self.newest.twist}",
        )


def _check_reading(trial: Trial, reading: Reading, before: Reading | None) -> None:
    description, age_s = trial.driver.description, trial.clock.now_s() - reading.stamp_s
    trial.demand(
        -STEP_S <= age_s <= AGE_S and reading.stamp_s >= trial.opened_s,
        f"a reading is stamped {age_s:.3f} s before it was read and {reading.stamp_s - trial.opened_s:.3f} s after "
        "open(); stamp it with the monotonic clock's time of arrival, and forget the readings of an earlier life",
    )
    trial.demand(
        before is None or reading.stamp_s > before.stamp_s,
        "stamps of readings go back; drop what arrives out of order",
    )
    poses = [reading.odometry] + ([reading.pose] if reading.pose is not None else [])
    twist = reading.twist
    numbers = [twist.linear_m_s, twist.angular_rad_s]
    for pose in poses:
        numbers += [pose.x_m, pose.y_m, pose.heading_rad]
        trial.demand(abs(pose.heading_rad) <= math.pi, f"heading {pose.heading_rad} is not in [-pi, pi]; wrap it")
    trial.demand(all(map(math.isfinite, numbers)), f"a reading is not finite: {reading}; unknown values are None")
    battery, obstacles = reading.battery, reading.obstacles
    trial.demand(battery is None or 0.0 <= battery <= 1.0, f"battery {battery} is not None or 0 to 1")
    trial.demand(obstacles.ndim == 2 and obstacles.shape[1] == 6, f"obstacles have shape {obstacles.shape}, not (k, 6)")
    trial.demand(reading.contacts >= 0, f"contacts are {reading.contacts}")
    told = (reading.pose is not None, len(obstacles) > 0, Hazard.BUMP in reading.hazards)
    senses = (description.senses_pose, description.senses_obstacles, description.senses_bumps)
    for what, tells, claims in zip(("pose", "obstacles", "bumps"), told, senses, strict=True):
        trial.demand(claims or not tells, f"it tells {what}, but its description denies it; set senses_{what}")


def _check_applied(trial: Trial, wished: Twist, applied: Twist) -> None:
    limits = trial.driver.description.limits
    said = f"command({wished}) returns {applied}"
    trial.demand(isinstance(applied, Twist), f"{said}, not a Twist: return what was really applied")
    for name, wish, value, limit in (
        ("linear", wished.linear_m_s, applied.linear_m_s, limits.speed_m_s),
        ("angular", wished.angular_rad_s, applied.angular_rad_s, limits.turn_rad_s),
    ):
        trial.demand(math.isfinite(value), f"{said}, which is not finite; clip before you calculate")
        trial.demand(
            abs(value) <= limit * (1.0 + QUANTUM), f"{said}, {name} beyond {limit}; clip to description.limits"
        )
        trial.demand(value * wish >= 0.0, f"{said}, {name} the other way round")
        trial.demand(wish != 0.0 or abs(value) <= STILL * limit, f"{said}, {name} although zero was wished")
    trial.demand(limits.can_reverse or applied.linear_m_s >= 0.0, f"{said}, but its description says: no reversing")
