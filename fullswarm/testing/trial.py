"""A driver under check: the rig that may break it, the one place that waits, the check of each reading and answer."""

from __future__ import annotations

import math
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from tempfile import TemporaryDirectory

import numpy as np

from fullswarm import registry
from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import (
    STAND,
    Description,
    Driver,
    Hazard,
    Lifecycle,
    Limits,
    Pose,
    RangeScan,
    Reading,
    Twist,
)
from fullswarm.drivers.make import Place, emulated_as, emulation_part
from fullswarm.emulators.base import Emulator
from fullswarm.errors import ConfigError
from fullswarm.geometry import wrap
from fullswarm.simulation.bodies import FreeBody
from fullswarm.testing.wire import Wire

STARTS_AT = Pose(2.0, -1.0, 2.5)
"""No axis is the robot's heading, and it does not stand at the origin."""


@dataclass(frozen=True, kw_only=True)
class Rig:
    """One robot or emulator, and the callables that inject its faults. None: not checked, and the report lists that.

    Callables are called on the checking thread and may return anything, except where a type is given.
    """

    make: Callable[[], Driver]
    """Constructs a driver for this robot; each time a new one, the last of which is open."""
    make_on: Callable[[Clock], Driver] | None = None
    """The same with a clock of ours in place of the machine's."""
    pump: Callable[[], object] | None = None
    """Called at 50 Hz while the check waits, for an emulator without a thread of its own."""
    body_speed: Callable[[], Twist] | None = None
    """How the body truly moves now, whatever the driver reports."""
    body_pose: Callable[[], Pose] | None = None
    """Where the body truly is, in the frame of ``Reading.pose``."""
    unplug: Callable[[], object] | None = None
    """Pull the cable, or break the link in both directions; the device keeps its power."""
    replug: Callable[[], object] | None = None
    """Put the cable back."""
    mute: Callable[[bool], object] | None = None
    """Let the device receive, but send nothing; with False send again."""
    garbage: Callable[[bytes], object] | None = None
    """Send these bytes (noise) to the driver, between the device's frames."""
    cut: Callable[[], object] | None = None
    """Lose the second half of the next frame that the device sends; the frames after it are whole."""
    bump: Callable[[bool], object] | None = None
    """Press or release the bumper."""
    obstacle: Callable[[], object] | None = None
    """Put an obstacle within reach of the robot's senses, or do nothing if one is there."""
    motors_on: Callable[[], bool] | None = None
    """Whether the device itself would obey a set-point now: armed, in closed loop, in Safe mode."""
    other_process: bool = False
    """Whether another process may open the driver's URL: then one is started, paused and killed while it drives."""
    fault_s: float = 1.5
    """The driver's stated time: it is in FAULT so long after the device's last word."""
    ready_s: float = 2.0
    """It is READY so long after the link is whole again."""
    rest_m_s: float = 0.0
    """How fast the device creeps although commanded zero."""
    odometry_share: float = 0.06
    """By which share of the way its odometry may be wrong."""


def emulator_rig(
    robot: Emulator,
    driver: Callable[[str, Clock | None], Driver],
    *,
    url: str = "",
    wire: Wire | None = None,
    fault_s: float = 0.8,
) -> Rig:
    """Return the rig of a started emulator alone on its floor, with all faults that the shell of emulators injects.

    Parameters
    ----------
    driver
        Constructs the driver for a URL and a clock; None: the machine's.
    url, wire
        How the driver opens it, if a relay is between the two: frames are then disturbed and cut there.
    """
    body, link = robot.body, wire or robot

    def speed() -> Twist:
        now = body.state()
        return Twist(now.speed_m_s, now.turn_rad_s)

    return Rig(
        make=lambda: driver(url or robot.url, None),
        make_on=lambda clock: driver(url or robot.url, clock),
        body_speed=speed,
        unplug=robot.unplug,
        replug=robot.replug,
        mute=robot.mute,
        garbage=link.garbage,
        cut=link.cut,
        bump=(lambda pressed: body.press(pressed, pressed)) if isinstance(body, FreeBody) else None,
        motors_on=None if robot.motors_on is None else lambda: bool(robot.motors_on),
        other_process=True,
        fault_s=fault_s,
    )


@contextmanager
def emulated_rig(word: str) -> Iterator[Rig]:
    """Yield the rig of the robot that a word of ``emulate =`` names, on a free port; it is switched off at the end.

    Raises
    ------
    ConfigError
        No make has such a robot, or its emulator cannot inject faults.
    """
    make, model = emulated_as(word)
    start = make.emulation.start if make.emulation else ""
    with TemporaryDirectory(prefix="rig-") as folder:
        port = f"{folder}/port" if model.place == "path" else str(_free_port(model.place))
        url = model.url.replace("{port}", port)
        robot = emulation_part(make, start)(url, FreeBody(STARTS_AT))
        try:
            if not isinstance(robot, Emulator):
                raise ConfigError(
                    f"the emulator of '{word}' injects no faults", where=start,
                    hint="derive it from fullswarm.emulators.base.Emulator",
                )  # fmt: skip
            driver = registry.driver_class(url)
            yield emulator_rig(robot, lambda url, clock: driver(url, clock=clock), url=url)
        finally:
            robot.close()


def _free_port(kind: Place) -> int:
    with socket.socket(type=socket.SOCK_DGRAM if kind == "udp" else socket.SOCK_STREAM) as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port


@dataclass
class Report:
    """What was checked, and what was not; ``print`` it."""

    url: str
    checked: dict[str, str] = field(default_factory=dict)
    """Name → what was measured on the way."""
    skipped: dict[str, str] = field(default_factory=dict)
    """Name → why it was not checked: so that it is not taken for checked."""

    def add(self, name: str, measured: str = "") -> None:
        """Note what holds."""
        self.checked[name] = measured

    def skip(self, name: str, reason: str) -> None:
        """Note what was not looked at."""
        self.skipped[name] = reason

    def lacks(self, name: str, **callables: object) -> bool:
        """Tell whether one of the rig's `callables` is missing, and note that `name` is skipped for want of it."""
        missing = [each for each, value in callables.items() if value is None]
        if missing:
            self.skip(name, f"the rig has no {', no '.join(missing)}")
        return bool(missing)

    def __str__(self) -> str:
        """One line per check, those left out last."""
        width = max(map(len, [*self.checked, *self.skipped]), default=0)
        lines = [f"  checked  {name:{width}}  {measured}".rstrip() for name, measured in self.checked.items()]
        lines += [f"  skipped  {name:{width}}  {reason}" for name, reason in self.skipped.items()]
        return "\n".join([self.url, *lines])


AGE_S, EARLY_S = 2.0, 0.02
QUANTUM = 1e-3
"""Share of a limit by which the rounding to what the device can express may go beyond it."""
REST = 0.04
"""Share of a limit that the rounding of a zero may come to."""
LEAP, LEAP_M, LEAP_RAD = 2.0, 0.1, 0.3
"""Odometry goes from one reading to the next at most this many times the limit's way, and this much more."""


def check_reading(
    reading: Reading, before: Reading | None, description: Description, now_s: float, opened_s: float
) -> str:
    """Look at a reading that follows `before`."""
    return next(_wrong_reading(reading, before, description, now_s, opened_s), "")


def check_applied(desired: Twist, applied: object, limits: Limits) -> str:
    """Check the twist that command() returned."""
    return next(_wrong_twist(desired, applied, limits), "")


def _wrong_reading(
    reading: Reading, before: Reading | None, description: Description, now_s: float, opened_s: float
) -> Iterator[str]:
    age_s = now_s - reading.stamp_s
    if not (-EARLY_S <= age_s <= AGE_S and reading.stamp_s >= opened_s):
        yield (
            f"a reading is stamped {age_s:.3f} s before it was read and {reading.stamp_s - opened_s:.3f} s after "
            "open(); stamp it with the monotonic clock's time of arrival, and drop the readings from before open()"
        )
    if before is not None and reading.stamp_s <= before.stamp_s:
        yield "stamps of readings go back; drop what arrives out of order"
    poses = [reading.odometry] + ([reading.pose] if reading.pose is not None else [])
    numbers = [reading.twist.linear_m_s, reading.twist.angular_rad_s]
    for pose in poses:
        numbers += [pose.x_m, pose.y_m, pose.heading_rad]
        if abs(pose.heading_rad) > math.pi:
            yield f"heading {pose.heading_rad} is not in [-pi, pi]; wrap it"
    if not all(map(math.isfinite, numbers)):
        yield f"a reading is not finite: {reading}; unknown values are None"
    yield from _wrong_senses(reading, description)
    if before is not None:
        yield from _leap(before, reading, description.limits)


def _wrong_senses(reading: Reading, description: Description) -> Iterator[str]:
    battery, obstacles = reading.battery, reading.obstacles
    if battery is not None and not 0.0 <= battery <= 1.0:
        yield f"battery {battery} is not None or 0 to 1"
    if obstacles.ndim != 2 or obstacles.shape[1] != 6:
        yield f"obstacles have shape {obstacles.shape}, not (k, 6)"
    if reading.contacts < 0:
        yield f"contacts are {reading.contacts}"
    reported = (reading.pose is not None, len(obstacles) > 0, Hazard.BUMP in reading.hazards)
    senses = (description.senses_pose, description.senses_obstacles, description.senses_bumps)
    for what, reports, claims in zip(("pose", "obstacles", "bumps"), reported, senses, strict=True):
        if reports and not claims:
            yield f"it reports {what}, but its description denies it; set senses_{what}"
    if reading.ranges and not description.ranges_max_m > 0.0:
        yield "it reports ranges, but its description denies it; set ranges_max_m"
    for scan in reading.ranges:
        yield from _wrong_scan(scan, reading)


def _wrong_scan(scan: RangeScan, reading: Reading) -> Iterator[str]:
    angles_rad, distances_m, what = scan.angles_rad, scan.distances_m, f"the scan '{scan.name}'"
    if angles_rad.ndim != 1 or distances_m.shape != angles_rad.shape:
        yield f"{what} has angles of shape {angles_rad.shape} and distances of {distances_m.shape}, not (k,) each"
        return
    if not np.isfinite(angles_rad).all():
        yield f"{what} has an angle that is not finite"
    if (
        not scan.max_m > 0.0
        or (distances_m < 0.0).any()
        or (np.isfinite(distances_m) & (distances_m > scan.max_m)).any()
    ):
        yield f"{what} has a distance that is not infinite, NaN or 0 to max_m = {scan.max_m}"
    if not 0.0 <= scan.cone_rad < math.pi:
        yield f"{what} has a cone_rad of {scan.cone_rad}, not 0 to less than pi"
    if not reading.stamp_s - AGE_S <= scan.stamp_s <= reading.stamp_s + EARLY_S:
        yield f"{what} was measured {reading.stamp_s - scan.stamp_s:.2f} s before the reading"


def _leap(before: Reading, after: Reading, limits: Limits) -> Iterator[str]:
    """Compare the way between two readings with what the wheels can do in that time."""
    passed_s, old, new = after.stamp_s - before.stamp_s, before.odometry, after.odometry
    gone_m, turned = math.hypot(new.x_m - old.x_m, new.y_m - old.y_m), wrap(new.heading_rad - old.heading_rad)
    if gone_m > LEAP * limits.speed_m_s * passed_s + LEAP_M or abs(turned) > (
        LEAP * limits.turn_rad_s * passed_s + LEAP_RAD
    ):
        yield (
            f"odometry leaps by {gone_m:.2f} m, {turned:.2f} rad in {passed_s:.3f} s; check its scale (m, rad) and "
            "each frame's checksum and length; start again at the next one instead of accepting an impossible step"
        )


def _wrong_twist(desired: Twist, applied: object, limits: Limits) -> Iterator[str]:
    returned = f"command({desired}) returns {applied}"
    if not isinstance(applied, Twist):
        yield f"{returned}, not a Twist: return what was applied"
        return
    for name, command, value, limit in (
        ("linear", desired.linear_m_s, applied.linear_m_s, limits.speed_m_s),
        ("angular", desired.angular_rad_s, applied.angular_rad_s, limits.turn_rad_s),
    ):
        if not math.isfinite(value):
            yield f"{returned}, which is not finite; clip before you calculate"
        if abs(value) > limit * (1.0 + QUANTUM):
            yield f"{returned}, {name} beyond {limit}; clip to description.limits"
        if value * command < 0.0:
            yield f"{returned}, {name} the other way round"
        if command == 0.0 and abs(value) > REST * limit:
            yield f"{returned}, {name} although zero was commanded"
    if not limits.can_reverse and applied.linear_m_s < 0.0:
        yield f"{returned}, but its description denies reversing"


STEP_S = 0.02
SILENCE_S = 0.3
"""A set-point holds for so long; after that the driver itself sets zero, whatever watchdog the device has."""
IDLE_S = 0.1
"""How long a robot that should not move is observed."""
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
    """A driver under check, and its newest reading."""

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
        """Wait for a condition, calling `each` and the pump at 50 Hz; return whether it became true in time.

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
        """The driver's state."""
        return self.driver.state

    def reach(self, state: Lifecycle, after: str) -> None:
        """Wait for a state."""
        reached = self.wait(lambda: self.state is state, self.deadline_s)
        self.demand(
            reached,
            f"it is {self.state}, not {state}, {self.deadline_s} s after {after} ({self.driver.fault or 'no fault'})",
        )

    def open(self) -> None:
        """Open the driver and drop the readings from before open()."""
        began_s = self.clock.now_s()
        self.driver.open()
        self.newest, self.opened_s = None, began_s

    def try_command(self, desired: Twist) -> Twist:
        """Command a driver whose link may be broken; return the twist that it returns."""
        try:
            return self.driver.command(desired)
        except Exception as error:  # as above
            raise AssertionError(
                f"{self.driver.url}: command({desired}) raises {type(error).__name__}: {error} while {self.state}; "
                "it never does for finite values: go to FAULT instead"
            ) from error

    def command(self, desired: Twist) -> Twist:
        """Command, and check the returned twist."""
        applied = self.driver.command(desired)
        wrong = check_applied(desired, applied, self.driver.description.limits)
        self.demand(not wrong, wrong)
        return applied

    def drive(self, desired: Twist, share: float = 0.75) -> Twist:
        """Command `desired` until the robot measures `share` of what is applied; return that."""
        applied = self.command(desired)
        self.demand(
            (applied.linear_m_s != 0.0 or desired.linear_m_s == 0.0)
            and (applied.angular_rad_s != 0.0 or desired.angular_rad_s == 0.0),
            f"{desired}, half of its limits, becomes {applied} while {self.state} ({self.driver.fault or 'no fault'})",
        )
        # What rounding makes of a zero is not waited for.
        applied = Twist(
            applied.linear_m_s if desired.linear_m_s else 0.0, applied.angular_rad_s if desired.angular_rad_s else 0.0
        )
        followed = self.wait(lambda: self.follows(applied, share), self.settle_s, lambda: self.command(desired))
        self.demand(
            followed,
            f"it returns {applied}, but measures {self.newest and self.newest.twist} {self.settle_s} s "
            f"later while {self.state}; check sign and scale of command and reading, or give a longer settle_s",
        )
        return applied

    def keep(self, duration_s: float, desired: Twist) -> None:
        """Command `desired` for a while."""
        self.wait(lambda: False, duration_s, lambda: self.command(desired))

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

    def at_rest(self) -> bool:
        """Tell whether the body truly stands, as far as the rig can tell; else what the readings say."""
        return self._is_still(self.rig.body_speed()) if self.rig.body_speed is not None else self.still()

    def _is_still(self, twist: Twist) -> bool:
        limits = self.driver.description.limits
        noise = self.driver.description.standstill
        speed_m_s = max(STILL * limits.speed_m_s, self.rig.rest_m_s, noise.speed_m_s)
        return abs(twist.linear_m_s) <= speed_m_s and abs(twist.angular_rad_s) <= STILL * limits.turn_rad_s

    @property
    def motion(self) -> Twist | None:
        """What moves: the true motion if the rig has it, else the newest reading."""
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
        rests = self.wait(self.at_rest, limit_s, each)
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
