"""The HAL contract: what the agent may ask of any robot. SI units, ENU, body x forward, CCW positive.

Lifecycle::

    CLOSED --open()--> OPEN --the robot answers--> READY --activate()--> ACTIVE
       ^                 ^                           ^------deactivate()-----'
       '---close()-------+------- FAULT <---- link lost, robot fault (any state)
                         '-- the driver itself reconnects: FAULT -> OPEN -> READY, never to ACTIVE

A driver never blocks in `read`, `command` or `state` for longer than a millisecond: whatever waits lives on the
driver's own link thread. Outside packages add drivers through the entry point group ``fullswarm.drivers``.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fullswarm.drivers.actuators import Actuator
from fullswarm.kernels import Array

NO_OBSTACLES: Array = np.zeros((0, 6))


class Lifecycle(enum.StrEnum):
    """Where a driver stands; the same five states for every make."""

    CLOSED = "CLOSED"
    OPEN = "OPEN"
    READY = "READY"
    ACTIVE = "ACTIVE"
    FAULT = "FAULT"


class Hazard(enum.IntFlag):
    """What a robot's own sensors report as wrong right now."""

    NONE = 0
    BUMP = 1
    CLIFF = 2
    WHEEL_DROP = 4
    OVERCURRENT = 8
    BATTERY_LOW = 16
    ESTOP_BUTTON = 32  # a button, or a person who took over
    MOTORS_OFF = 64  # a switch on the robot keeps its motors from power


STOPPING_HAZARDS = Hazard.CLIFF | Hazard.WHEEL_DROP | Hazard.OVERCURRENT | Hazard.ESTOP_BUTTON | Hazard.MOTORS_OFF
"""With one of these a robot may not move at all; a bump bars the way forward only."""


@dataclass(frozen=True, slots=True)
class Twist:
    """Body velocity: m/s along x, rad/s counter-clockwise."""

    linear_m_s: float = 0.0
    angular_rad_s: float = 0.0


STAND = Twist()


@dataclass(frozen=True, slots=True)
class Pose:
    """Position in metres and heading in [-π, π]; ENU world frame, or odometry frame where stated."""

    x_m: float
    y_m: float
    heading_rad: float


DECAYED = 4.0
"""So many time constants, and what decays with them is over."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What the wheels can do; a driver clips to them, which shows in what it returns.

    A stop from v m/s takes v² / 2 `accel_m_s2`, and beyond that `overrun_s` times v, at most `overrun_m`: the wheels
    answer late, or brake softly at the end. A command has its first effect `dead_time_s` after it was given, and until
    then the commands before it go on.
    """

    speed_m_s: float
    turn_rad_s: float
    accel_m_s2: float
    turn_accel_rad_s2: float
    can_reverse: bool = True
    overrun_s: float = 0.0
    overrun_m: float = 0.0
    dead_time_s: float = 0.0

    def stop_extra(self, speed_m_s: float) -> tuple[float, float]:
        """Return by how much a stop from a speed takes longer than the acceleration says: m and s.

        What an overrun leaves of the speed decays with `overrun_s`; after four times that it counts as none.
        """
        late_m = speed_m_s * self.dead_time_s if self.dead_time_s > 0.0 else 0.0  # a speed may have no limit
        over_m = min(self.overrun_s * speed_m_s, self.overrun_m) if self.overrun_s > 0.0 else 0.0
        return late_m + over_m, self.dead_time_s + DECAYED * self.overrun_s

    def clip(self, twist: Twist) -> Twist:
        """Return a twist held within speed and turn rate, each by itself."""
        slowest_m_s = -self.speed_m_s if self.can_reverse else 0.0
        speed_m_s = max(slowest_m_s, min(self.speed_m_s, twist.linear_m_s))
        return Twist(speed_m_s, max(-self.turn_rad_s, min(self.turn_rad_s, twist.angular_rad_s)))


@dataclass(frozen=True, slots=True)
class Standstill:
    """What a make's measurements show of a robot that stands: the bounds of its noise.

    The defaults are those of wheel encoders, which show zero at once: the newest velocity alone decides. A make whose
    velocity is estimated states how long it has to be watched, and how far its position wanders meanwhile.
    """

    speed_m_s: float = 0.005  # of the mean velocity over the window
    turn_rad_s: float = 0.02
    window_s: float = 0.0
    way_m: float = 0.0  # between any reading of the window and the newest
    angle_rad: float = 0.0
    wander_m: float = 0.0  # a way up to this cannot be separated from noise within the seconds of a stop


EXACT = Standstill()
RANGES_TIMEOUT_S = 0.5
"""A robot whose range sensor is silent for longer does not see where it drives; the slowest lidar turns at 5 Hz."""
POSE_SIGMA_M = 0.05


@dataclass(frozen=True, slots=True)
class RangeScan:
    """One scan of a range sensor: a lidar, or a group of time-of-flight sensors.

    Angles count from the sensor's own x axis, counter-clockwise; a distance is along its ray from the sensor's origin.
    Infinite: nothing is within `max_m`. NaN: no measurement, of which nothing follows.
    """

    stamp_s: float  # when its last ray was measured, or arrived, on this machine's monotonic clock
    angles_rad: Array  # (k,) in the order in which they were measured
    distances_m: Array  # (k,)
    max_m: float
    mount: Pose = Pose(0.0, 0.0, 0.0)  # of the sensor on the body: x forward, y left, heading of its x axis
    name: str = "ranges"  # tells the sensors of a robot apart
    sigma_m: float = 0.01  # standard deviation of a distance
    duration_s: float = 0.0  # from the first ray to the last: a robot that turns meanwhile is taken into account
    cone_rad: float = 0.0  # full angle of each ray's field of view: the distance is that of the nearest thing in it


@dataclass(frozen=True, slots=True)
class Description:
    """What is known of a robot before connecting."""

    make: str
    model: str
    radius_m: float  # of the disc that holds the footprint
    limits: Limits
    senses_pose: bool = False  # world pose, not just odometry
    own_frame: bool = False  # that pose counts from a place of its own; ``origin=lat,lon`` in the URL mends it
    senses_obstacles: bool = False
    senses_bumps: bool = False
    bodies_range_m: float = 0.0  # of the sense of `Reading.bodies`; 0: it has none
    ranges_max_m: float = 0.0  # of the sense of `Reading.ranges`, of its farthest sensor; 0: it has none
    ranges_timeout_s: float = RANGES_TIMEOUT_S  # without a newer scan for so long it carries out no behaviour
    watchdog_s: float | None = None  # the device's own: it stops by itself after this silence; None: it has none
    standstill: Standstill = EXACT
    pose_sigma_m: float = POSE_SIGMA_M  # standard deviation of a sensed position, per axis, while all is well
    actuators: tuple[Actuator, ...] = ()  # what it has beside its wheels; its driver then is an `Actuates`
    abilities: tuple[str, ...] = ()  # what else it can do, one word each: "carry", "camera"

    @property
    def capabilities(self) -> tuple[str, ...]:
        """What it can do, as requests and control laws name it, sorted.

        Its `abilities`, the names of its actuators, and of "bodies", "bumps", "obstacles", "pose", "ranges" what it
        senses; "reverse": it can drive backwards.
        """
        senses = {
            "bodies": self.bodies_range_m > 0.0, "bumps": self.senses_bumps, "obstacles": self.senses_obstacles,
            "pose": self.senses_pose, "ranges": self.ranges_max_m > 0.0, "reverse": self.limits.can_reverse,
        }  # fmt: skip
        found = {*self.abilities, *(each.name for each in self.actuators)}
        return tuple(sorted(found | {name for name, has in senses.items() if has}))


@dataclass(frozen=True, slots=True)
class Reading:
    """The newest that a robot has reported. Unknown values are None, not zero."""

    stamp_s: float  # arrival, on this machine's monotonic clock
    odometry: Pose  # since open(), from wheels or gyro; starts at (0, 0, 0)
    twist: Twist  # measured
    odometry_breaks: int = 0  # how often since open() motion may have been lost: it goes on from where it was
    pose: Pose | None = None  # world frame, only if `senses_pose`
    position_sigma_m: float | None = None  # of `pose`, per axis, as known now; None: the make's `pose_sigma_m`
    hazards: Hazard = Hazard.NONE
    contacts: int = 0  # bodies touched now
    battery: float | None = None  # 0 to 1
    charging: bool | None = None  # current flows into the battery; None: it does not report that
    obstacles: Array = field(default_factory=lambda: NO_OBSTACLES)
    """Sensed static obstacles, shape (k, 6): centre x, y (m), half sizes x, y (m), yaw (rad), corner radius (m).

    A disc is half sizes 0 with its radius as corner radius; a wall is a long box."""
    bodies: Array | None = None
    """Bodies seen around the robot that may move, shape (k, 3): centre x, y, radius (m), world frame, without identity.

    All whose rim is within `bodies_range_m` of the robot's centre and that nothing hides; other robots are among
    them. None: the robot did not look; no rows: it saw that nothing is there."""
    ranges: tuple[RangeScan, ...] = ()
    """The newest scan of each range sensor; the same objects until there is a newer one."""


class Driver(Protocol):
    """One robot. Constructed from a URL without touching the device; nothing moves before `activate`."""

    url: str
    description: Description

    @property
    def state(self) -> Lifecycle:
        """Where the driver stands."""
        ...

    @property
    def fault(self) -> str:
        """Why it is in FAULT, or why it does not become or stay ACTIVE, and what to do; empty otherwise.

        A driver may have a `fault_code` beside it, a :class:`~fullswarm.reasons.Code`: operators get advice by that.
        """
        ...

    @property
    def firmware(self) -> str:
        """What the device reports that it runs; empty until known."""
        ...

    def open(self) -> None:
        """Claim the port and start talking; returns before the robot is READY.

        Raises
        ------
        DriverError
            The port cannot be had; names its holder or what to do.
        """
        ...

    def activate(self) -> None:
        """READY → ACTIVE (arm, Safe mode, closed loop); ignored in any other state."""
        ...

    def deactivate(self) -> None:
        """ACTIVE → READY with wheels at zero."""
        ...

    def read(self) -> Reading | None:
        """Return the newest reading; None before the first."""
        ...

    def command(self, twist: Twist) -> Twist:
        """Send a set-point; return what was really applied after limits and quantisation.

        It holds for 0.3 s: a driver that gets no further command by then sends zero by itself.

        Anything but ACTIVE applies zero. A non-finite value raises ``ValueError`` and stops the robot.
        """
        ...

    def close(self) -> None:
        """Stop the wheels, put the device into its safe state and let go of the port. Closing twice is fine."""
        ...


@runtime_checkable
class TakesFixes(Protocol):
    """A driver whose robot takes its position from outside: an autopilot with external pose input."""

    def locate(self, pose: Pose, position_sigma_m: float, heading_sigma_rad: float) -> None:
        """Pass on where the robot was just seen from outside, world frame; standard deviations, per axis.

        Called by the agent for each fix that it accepts, in any state; never blocks. What cannot be sent now is
        dropped: the next one comes soon. A heading with a standard deviation above 1 rad was not seen.
        """
        ...


@runtime_checkable
class Docks(Protocol):
    """A driver whose robot finds its dock by itself: a Create by the infrared beams of its Home Base."""

    def dock(self) -> None:
        """Let the robot look for its dock; it drives by itself then, and stays ACTIVE until it is there (READY).

        `command()` applies zero meanwhile, but has to be called: without it for 0.3 s, or by `deactivate()`, the
        robot stops. Raises ``DriverError`` unless ACTIVE.
        """
        ...

    @property
    def docking(self) -> bool:
        """The robot looks for its dock by itself."""
        ...

    @property
    def docked(self) -> bool:
        """The robot stands on its dock, as the robot reports it."""
        ...


@dataclass(slots=True)
class FleetReading:
    """Readings of the n robots of one host as columns: n is 1 on board, the whole swarm in lockstep."""

    stamp_s: Array  # (n,), -inf before the first reading
    pose: Array  # (n, 3) world x, y, heading; NaN where not sensed
    odometry: Array  # (n, 3)
    twist: Array  # (n, 2) m/s, rad/s
    hazards: NDArray[np.uint8]  # (n,) Hazard bits
    contacts: NDArray[np.int64]  # (n,)
    battery: Array  # (n,) 0 to 1, -1 unknown
    obstacles: Array  # (k, 6) as in Reading; of all robots together
    position_sigma_m: Array  # (n,) as in Reading, NaN where the driver states none
    odometry_breaks: NDArray[np.int64] | None = None  # (n,) as in Reading; None: never any
    bodies: Array | None = None  # (k, 3) as in Reading; of all robots together, without themselves
    ranges: tuple[tuple[int, RangeScan], ...] = ()  # robot's row and scan; the same tuple until one is newer
    charging: NDArray[np.int8] | None = None  # (n,) 1 or 0 as in Reading, -1 unknown; None: all unknown


class Fleet(Protocol):
    """The drivers of one host, seen as arrays. `OneRobot` wraps a Driver; the simulator's fleet is native."""

    ids: tuple[str, ...]
    urls: tuple[str, ...]
    descriptions: tuple[Description, ...]

    def open(self) -> None:
        """Open all drivers."""
        ...

    def read(self) -> FleetReading:
        """Return the newest readings; the arrays may be reused by the next call."""
        ...

    def command(self, twists: Array, active: NDArray[np.bool_]) -> Array:
        """Send set-points (n, 2) to the robots in `active` (n,), zero to the others; return what was applied.

        Activates and deactivates drivers as `active` changes.
        """
        ...

    def lifecycle(self, row: int) -> Lifecycle:
        """Return the state of robot `row`."""
        ...

    def fault(self, row: int) -> str:
        """Return why robot `row` is in FAULT, or does not become or stay ACTIVE; empty otherwise."""
        ...

    def fault_code(self, row: int) -> str:
        """Return the :class:`~fullswarm.reasons.Code` of robot `row`'s fault; empty where its driver has none."""
        ...

    def firmware(self, row: int) -> str:
        """Return the firmware of robot `row`."""
        ...

    def locate(self, row: int, pose: Pose, position_sigma_m: float, heading_sigma_rad: float) -> None:
        """Tell robot `row` where it was seen, world frame; nothing happens if its driver does not take fixes."""
        ...

    def seek_dock(self, row: int) -> bool:
        """Let robot `row` find its dock by itself, see :class:`Docks`; call it each tick until it is `docked`.

        Returns False where its driver cannot.
        """
        ...

    def docked(self, row: int) -> bool:
        """Tell whether robot `row` reports that it stands on a dock; False where its driver cannot tell."""
        ...

    def actuate(self, row: int, name: str, value: object) -> None:
        """Bring an actuator of robot `row` into a state, see :mod:`fullswarm.drivers.actuators`; returns at once.

        Raises
        ------
        ValueError
            The robot has no such actuator, or it does not take that value.
        DriverError
            The robot takes it in another state only.
        """
        ...

    def close(self) -> None:
        """Close all drivers, wheels at zero."""
        ...
