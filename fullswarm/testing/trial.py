"""A driver under check: the one place that waits, and a look at each reading and each answer on the way."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import STAND, Driver, Lifecycle, Pose, Reading, Twist
from fullswarm.geometry import wrap
from fullswarm.testing.rig import Report, Rig
from fullswarm.testing.sight import check_applied, check_reading

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
LATE_S = 0.03
"""A step that begins so much too late shows that this machine is busy: it does not count against the driver."""
PATIENCE = 4.0
"""A busy machine stretches a time limit to at most this many times itself."""
NEXT_S = 1.0
"""In which a new reading must come; an agent stops its robot after 0.5 s without."""


@dataclass
class Trial:
    """A driver under check, and the newest that it has told."""

    driver: Driver
    rig: Rig
    settle_s: float
    deadline_s: float
    report: Report
    clock: Clock = field(default_factory=MonotonicClock)
    newest: Reading | None = None
    opened_s: float = 0.0
    ignored_s: float = -math.inf  # readings up to here are not looked at: the clock has jumped since
    late_s: float = 0.0  # by how much the steps of all waits were too late, added up

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
        """Wait for a condition, calling `each` and the pump at 50 Hz; tell whether it came true in time.

        Time in which this process did not get the processor is not counted: the driver's threads did not either.
        """
        pause, due_s = threading.Event(), self.clock.now_s()
        end_s, latest_s = due_s + limit_s, due_s + PATIENCE * limit_s
        self._look()
        while not until():
            if self.clock.now_s() >= end_s:
                return False
            if each is not None:
                each()
            if self.rig.pump is not None:
                self.rig.pump()
            # On a grid, so that a pumped world keeps up with real time; but never two steps at once.
            due_s = max(due_s + STEP_S, self.clock.now_s())
            pause.wait(due_s - self.clock.now_s())
            late_s = self.clock.now_s() - due_s
            if late_s > LATE_S:
                self.late_s += late_s
                end_s = min(end_s + late_s, latest_s)
            self._look()
        return True

    def _look(self) -> None:
        try:
            reading = self.driver.read()
        except Exception as error:  # whatever it raises is what this check is for
            raise AssertionError(
                f"{self.driver.url}: read() raises {type(error).__name__}: {error}; it never does: go to FAULT instead"
            ) from error
        if reading is None or reading.stamp_s <= self.ignored_s:
            return
        if self.newest is not None and reading.stamp_s == self.newest.stamp_s:
            return
        description, now_s = self.driver.description, self.clock.now_s()
        wrong = check_reading(reading, self.newest, description, now_s, self.opened_s)
        self.demand(not wrong, wrong)
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
        began_s = self.clock.now_s()
        self.driver.open()
        self.newest, self.opened_s = None, began_s

    def tell(self, wished: Twist) -> Twist:
        """Command a driver whose link may be broken; return what it says that it applies."""
        try:
            return self.driver.command(wished)
        except Exception as error:  # as above
            raise AssertionError(
                f"{self.driver.url}: command({wished}) raises {type(error).__name__}: {error} while {self.state}; "
                "it never does for finite values: go to FAULT instead"
            ) from error

    def command(self, wished: Twist) -> Twist:
        """Command, and look at what is said to be applied."""
        applied = self.driver.command(wished)
        wrong = check_applied(wished, applied, self.driver.description.limits)
        self.demand(not wrong, wrong)
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
        return self._is_still(self.newest.twist if self.newest is not None else STAND)

    def rests(self) -> bool:
        """Tell whether the body truly stands, as far as the rig can tell; else what the readings say."""
        return self._is_still(self.rig.body_speed()) if self.rig.body_speed is not None else self.still()

    def _is_still(self, twist: Twist) -> bool:
        limits = self.driver.description.limits
        noise = self.driver.description.standstill
        speed_m_s = max(STILL * limits.speed_m_s, self.rig.rest_m_s, noise.speed_m_s)
        return abs(twist.linear_m_s) <= speed_m_s and abs(twist.angular_rad_s) <= STILL * limits.turn_rad_s

    @property
    def motion(self) -> Twist | None:
        """What moves: the truth if the rig knows it, else the newest reading."""
        if self.rig.body_speed is not None:
            return self.rig.body_speed()
        return None if self.newest is None else self.newest.twist

    def go(self) -> Twist:
        """Drive forwards at half speed, from READY or ACTIVE; return what is applied."""
        if self.state is not Lifecycle.ACTIVE:
            self.reach(Lifecycle.READY, "all was well again")
            self.driver.activate()
            self.reach(Lifecycle.ACTIVE, "activate()")
        return self.drive(Twist(self.pace.linear_m_s, 0.0))

    def come_to_rest(self, limit_s: float, why: str, each: Callable[[], object] | None = None) -> float:
        """Wait until the body rests; return how long that took, s."""
        began_s = self.clock.now_s()
        rests = self.wait(self.rests, limit_s, each)
        self.demand(rests, f"the robot still moves {limit_s:.1f} s after {why}: {self.motion}")
        return self.clock.now_s() - began_s

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
