"""A ROS base as its topics show it: takes velocities, moves a body, reports odometry, battery, hazards and e-stop.

Messages are built and read by the `rosbags` library from the published definitions, so nothing here shares code with
the driver's own codec. :class:`Topics` turns the base into chunks ``topic NUL payload``, for a transport that carries
each message by itself (zenoh); :mod:`.rosbridge` carries the same base over a websocket.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from fullswarm.emulators.ros.definitions import (
    BATTERY,
    BOOL,
    HAZARDS,
    ODOMETRY,
    SCAN,
    TWIST,
    TWIST_STAMPED,
    typestore,
)
from fullswarm.geometry import clamp
from fullswarm.simulation.bodies import Body

ODOMETRY_S, SLOW_S = 0.02, 0.2
"""Periods of the odometry, and of battery, hazards and e-stop."""
BOOTED_S = 1_764_000_000.25
"""The robot's clock at the origin of ours: it was never set from this computer."""
DRIVEN = 0.31, -0.17, 0.4
"""Its odometry when it is switched on here: it has been driven since it booted. m, m, rad."""
RAYS, SCAN_MAX_M = 360, 3.5
"""Of an LDS-01."""
CHARGING_UNKNOWN, LIPO = 0, 3
BUMP, CLIFF, STALL, WHEEL_DROP = 1, 2, 3, 4


@dataclass(frozen=True, slots=True)
class BaseOptions:
    """What base it is.

    Parameters
    ----------
    cmd, odom, battery, hazards, estop, scan
        Topics without the leading slash; empty: it has none.
    timeout_s
        After this silence on `cmd` it stops by itself; None: it keeps its last velocity, as a TurtleBot 3.
    stamped
        It takes TwistStamped.
    checks_age
        And drops one that is older than `timeout_s`, as ros2_control's controllers do.
    percent
        It reports its charge as 0 to 100, as a TurtleBot 3.
    """

    cmd: str
    odom: str
    battery: str
    hazards: str
    estop: str
    scan: str
    speed_m_s: float
    turn_rad_s: float
    accel_m_s2: float
    turn_accel_rad_s2: float
    timeout_s: float | None
    stamped: bool = False
    checks_age: bool = False
    percent: bool = False

    @property
    def command_type(self) -> str:
        """The type of `cmd`."""
        return TWIST_STAMPED if self.stamped else TWIST

    @property
    def published(self) -> Mapping[str, str]:
        """Its topics with their types."""
        found = {self.odom: ODOMETRY, self.battery: BATTERY, self.hazards: HAZARDS, self.estop: BOOL, self.scan: SCAN}
        return {name: kind for name, kind in found.items() if name}


class Base:
    """The base, without a transport."""

    def __init__(self, options: BaseOptions, body: Body) -> None:
        self.options, self._body = options, body
        self.store = typestore()
        self.battery, self.estop, self.stuck = 0.87, False, False
        self.distances_m = [math.inf] * RAYS
        """What its lidar measures, counter-clockwise from its own x axis."""
        self.hazards: set[int] = set()
        self.due_s = self._slow_s = 0.0
        self.commands = 0  # taken so far
        self._target = (0.0, 0.0)
        self._commanded_s = -math.inf
        self._speed_m_s = self._turn_rad_s = 0.0
        self._old: Any = None
        self._begin(DRIVEN)

    def _begin(self, odometry: tuple[float, float, float]) -> None:
        self._origin, self._counted = self._body.state(), odometry

    def reboot(self) -> None:
        """Start anew: motors off, odometry at zero."""
        self._target, self._speed_m_s, self._turn_rad_s = (0.0, 0.0), 0.0, 0.0
        self._body.drive(0.0, 0.0)
        self._begin((0.0, 0.0, 0.0))

    # ------------------------------------------------------------ commands
    def command(self, message: Any, now_s: float) -> None:
        """Take a Twist or TwistStamped; one with values that are not finite is dropped."""
        twist = message.twist if self.options.stamped else message
        velocity = (twist.linear.x, twist.angular.z)
        if not all(map(math.isfinite, velocity)):
            return
        if self.options.stamped and self.options.checks_age and self.options.timeout_s is not None:
            stamp = message.header.stamp
            stamp_s = stamp.sec + 1e-9 * stamp.nanosec
            if stamp_s and BOOTED_S + now_s - stamp_s > self.options.timeout_s:
                return
        self._target, self._commanded_s = velocity, now_s
        self.commands += 1

    # ------------------------------------------------------------ time
    def step(self, now_s: float) -> Iterator[tuple[str, Any]]:
        """Turn the motors; yield what is to be published: topic and message."""
        if now_s < self.due_s:
            return
        self.due_s = max(self.due_s + ODOMETRY_S, now_s)
        self._move(now_s)
        names = self.options
        yield names.odom, self._odometry(now_s)
        if now_s >= self._slow_s:
            self._slow_s = now_s + SLOW_S
            if names.battery:
                yield names.battery, self._battery_state(now_s)
            if names.estop:
                yield names.estop, self._type(BOOL)(data=self.estop)
            if names.scan:
                yield names.scan, self._scan(now_s)
        if names.hazards:
            yield names.hazards, self._hazard_vector(now_s)

    def _move(self, now_s: float) -> None:
        options = self.options
        silent_s = now_s - self._commanded_s
        if self.estop or (options.timeout_s is not None and silent_s > options.timeout_s):
            self._target = (0.0, 0.0)
        speed = clamp(self._target[0], -options.speed_m_s, options.speed_m_s)
        turn = clamp(self._target[1], -options.turn_rad_s, options.turn_rad_s)
        faster, turning = options.accel_m_s2 * ODOMETRY_S, options.turn_accel_rad_s2 * ODOMETRY_S
        self._speed_m_s += clamp(speed - self._speed_m_s, -faster, faster)
        self._turn_rad_s += clamp(turn - self._turn_rad_s, -turning, turning)
        self._body.drive(self._speed_m_s, self._turn_rad_s)

    # ------------------------------------------------------------ messages
    def _type(self, name: str) -> Any:
        return self.store.types[name]

    def _header(self, now_s: float, frame: str) -> Any:
        whole = math.floor(BOOTED_S + now_s)
        stamp = self._type("builtin_interfaces/msg/Time")(sec=whole, nanosec=int((BOOTED_S + now_s - whole) * 1e9))
        return self._type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._type("geometry_msgs/msg/Vector3")(x=x, y=y, z=z)

    def _odometry(self, now_s: float) -> Any:
        if self.stuck and self._old is not None:
            return self._old
        import numpy as np

        now, start, (x, y, heading) = self._body.state(), self._origin, self._counted
        turn = heading - start.heading_rad
        dx, dy = now.x_m - start.x_m, now.y_m - start.y_m
        x, y = x + math.cos(turn) * dx - math.sin(turn) * dy, y + math.sin(turn) * dx + math.cos(turn) * dy
        half = (now.heading_rad + turn) / 2.0
        covariance = np.zeros(36)
        self._old = self._type(ODOMETRY)(
            header=self._header(now_s, "odom"),
            child_frame_id="base_footprint",
            pose=self._type("geometry_msgs/msg/PoseWithCovariance")(
                pose=self._type("geometry_msgs/msg/Pose")(
                    position=self._type("geometry_msgs/msg/Point")(x=x, y=y, z=0.0),
                    orientation=self._type("geometry_msgs/msg/Quaternion")(
                        x=0.0, y=0.0, z=math.sin(half), w=math.cos(half)
                    ),
                ),
                covariance=covariance,
            ),
            twist=self._type("geometry_msgs/msg/TwistWithCovariance")(
                twist=self._type(TWIST)(
                    linear=self._vector(now.speed_m_s, 0.0, 0.0), angular=self._vector(0.0, 0.0, now.turn_rad_s)
                ),
                covariance=covariance,
            ),
        )
        return self._old

    def _scan(self, now_s: float) -> Any:
        """Return the scan that ends now."""
        import numpy as np

        return self._type(SCAN)(
            header=self._header(now_s - SLOW_S, "base_scan"), angle_min=0.0, angle_max=math.tau * (1.0 - 1.0 / RAYS),
            angle_increment=math.tau / RAYS, time_increment=SLOW_S / RAYS, scan_time=SLOW_S, range_min=0.12,
            range_max=SCAN_MAX_M, ranges=np.array(self.distances_m, np.float32), intensities=np.zeros(RAYS, np.float32),
        )  # fmt: skip

    def _battery_state(self, now_s: float) -> Any:
        import numpy as np

        nothing, full = np.zeros(0, dtype=np.float32), 100.0 if self.options.percent else 1.0
        return self._type(BATTERY)(
            header=self._header(now_s, ""), voltage=11.1, temperature=math.nan, current=math.nan, charge=math.nan,
            capacity=math.nan, design_capacity=1.8, percentage=full * self.battery,
            power_supply_status=CHARGING_UNKNOWN, power_supply_health=0, power_supply_technology=LIPO, present=True,
            cell_voltage=nothing, cell_temperature=nothing, location="", serial_number="",
        )  # fmt: skip

    def _hazard_vector(self, now_s: float) -> Any:
        detection = self._type("irobot_create_msgs/msg/HazardDetection")
        bumped = any(self._body.state().bumps)
        found = sorted(self.hazards | ({BUMP} if bumped else set()))
        names = {BUMP: "bump_front_center", CLIFF: "cliff_front_left", STALL: "wheel_stall", WHEEL_DROP: "wheel_drop"}
        return self._type(HAZARDS)(
            header=self._header(now_s, "base_link"),
            detections=[detection(header=self._header(now_s, names[each]), type=each) for each in found],
        )


class Topics:
    """The base as firmware of a transport that carries each message by itself: chunks ``topic NUL payload``."""

    def __init__(self, base: Base) -> None:
        self.base = base
        self._out: list[bytes] = []

    @property
    def next_due_s(self) -> float:
        """When the motors are due."""
        return self.base.due_s

    def receive(self, data: bytes, now_s: float, _port: int) -> None:
        """Take a command in CDR; what is none is dropped."""
        topic, _, payload = data.partition(b"\0")
        options = self.base.options
        if topic.decode(errors="replace") != options.cmd:
            return
        try:
            message = self.base.store.deserialize_cdr(payload, options.command_type)
        except Exception:  # whatever the generated code of rosbags stumbles over
            return
        self.base.command(message, now_s)

    def step(self, now_s: float) -> bool:
        """Go on to `now_s`."""
        for topic, message in self.base.step(now_s):
            payload = bytes(self.base.store.serialize_cdr(message, message.__msgtype__))
            self._out.append(topic.encode() + b"\0" + payload)
        return False

    def take(self, _port: int) -> list[bytes]:
        """Return the messages to publish."""
        out, self._out = self._out, []
        return out

    def hung_up(self, _port: int) -> None:
        """Nothing: a base does not know who commands it."""
