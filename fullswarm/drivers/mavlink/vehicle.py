"""What the vehicle has told so far, and the reading made of it. No I/O, no clock of its own."""

from __future__ import annotations

import math
from collections import deque

from fullswarm.drivers.base import Hazard, Pose, Reading, Twist
from fullswarm.drivers.linked import Odometer
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.aiding import Aiding
from fullswarm.drivers.mavlink.frame import SwarmFrame

LINK_SILENCE_S = 3.0
TELEMETRY_SILENCE_S = 1.0
BATTERY_LOW = 0.15
REBOOT_MS = 1000  # a boot time this much older is a restart, less is a datagram out of order
TEXTS = 20
WARNING = 4  # severities up to here are worth an operator's attention


class Vehicle:
    """The newest of everything that one vehicle has sent, with arrival times (s, monotonic).

    Parameters
    ----------
    receiver
        Whether satellites are what aids its position; False: poses from outside do.
    filtered
        Whether what its EKF says of itself counts.
    """

    def __init__(self, *, receiver: bool = True, filtered: bool = True) -> None:
        self._aids = receiver, filtered
        self.odometer = Odometer()
        self.frame: SwarmFrame | None = None  # None: its own map is all there is
        self.reading: Reading | None = None
        self.version: p.Version | None = None
        self.forget()

    def forget(self) -> None:
        """Believe nothing of what was heard before: the link was lost or the vehicle restarted."""
        self.heartbeat: p.Heartbeat | None = None
        self.heartbeat_s = -math.inf
        self.ekf: p.EkfStatus | None = None
        self.aiding = Aiding(receiver=self._aids[0], filtered=self._aids[1])
        self.signs = False
        self.rebooted = False
        self._position_s = self._attitude_s = -math.inf
        self._attitude: p.Attitude | None = None
        self._boot_ms: int | None = None
        self._battery: p.Battery | None = None
        self.motors_off = False
        self._texts: deque[tuple[float, int, str]] = deque(maxlen=TEXTS)
        self._assembler = p.TextAssembler()
        self.odometer.rebase()

    @property
    def armed(self) -> bool:
        """Whether the newest heartbeat says that motors may turn."""
        return self.heartbeat is not None and self.heartbeat.armed

    @property
    def mode(self) -> int | None:
        """The newest heartbeat's mode."""
        return None if self.heartbeat is None else self.heartbeat.custom_mode

    @property
    def heading_rad(self) -> float | None:
        """The newest heading, ENU; None before the first."""
        return None if self._attitude is None else self._attitude.heading_rad

    def silent(self, now_s: float) -> bool:
        """Whether heartbeats have stopped."""
        return now_s - self.heartbeat_s > LINK_SILENCE_S

    def telemetry_silent(self, now_s: float) -> bool:
        """Whether position or attitude have stopped, whatever heartbeats say."""
        return now_s - min(self._position_s, self._attitude_s) > TELEMETRY_SILENCE_S

    def texts_since(self, since_s: float) -> list[str]:
        """Return the warnings and worse that arrived since then."""
        return [text for at_s, severity, text in self._texts if at_s >= since_s and severity <= WARNING]

    def receive(self, body: p.Body, now_s: float) -> None:
        """Take a message of this vehicle."""
        match body:
            case p.Heartbeat():
                self.heartbeat, self.heartbeat_s = body, now_s
            case p.Attitude():
                self._watch_boot(body.boot_ms)
                self._attitude, self._attitude_s = body, now_s
            case p.LocalPosition():
                self._watch_boot(body.boot_ms)
                self._position_s = now_s
                self._make_reading(body, now_s)
            case p.EkfStatus():
                self.ekf = body
                self.aiding.receive(body, now_s)
            case p.SatelliteFix():
                self.aiding.receive(body, now_s)
            case p.Battery():
                self._merge(body)
            case p.Version():
                self.version = body
            case p.StatusText():
                text = self._assembler.add(body)
                if text is not None:
                    self._texts.append((now_s, body.severity, text))
            case _:
                return

    def _watch_boot(self, boot_ms: int) -> None:
        if self._boot_ms is not None and boot_ms + REBOOT_MS < self._boot_ms:
            self.rebooted = True
        self._boot_ms = boot_ms

    def _merge(self, new: p.Battery) -> None:
        # SYS_STATUS and BATTERY_STATUS tell of one pack; either may leave out what the other knows.
        if new.motors_off is not None:
            self.motors_off = new.motors_off
        old = self._battery
        if new.remaining is not None or old is None:
            self._battery = new

    def _make_reading(self, position: p.LocalPosition, now_s: float) -> None:
        attitude = self._attitude
        if attitude is None or self.rebooted or now_s - self._attitude_s > TELEMETRY_SILENCE_S:
            return
        heading = attitude.heading_rad
        world: Pose | None = Pose(position.x_m, position.y_m, heading)
        frame = self.frame
        if frame is not None:
            if frame.leaps(position, now_s):
                self.odometer.rebase()
            world = frame.pose(position, heading)
        if world is not None:
            self.odometer.update(world)  # metres of the ground where they are known, not of the vehicle's map
        battery = None if self._battery is None else self._battery.remaining
        self.reading = Reading(
            stamp_s=now_s,
            odometry=self.odometer.pose,
            twist=Twist(p.forward_speed(position.vx_m_s, position.vy_m_s, heading), attitude.turn_rad_s),
            pose=world,
            position_sigma_m=self.aiding.sigma_m(now_s),
            hazards=Hazard.BATTERY_LOW if battery is not None and battery < BATTERY_LOW else Hazard.NONE,
            battery=battery,
        )

    def speed_m_s(self, now_s: float) -> float | None:
        """Return the measured speed without its sign; None when it is not known now."""
        if self.reading is None or now_s - self.reading.stamp_s > TELEMETRY_SILENCE_S:
            return None
        return abs(self.reading.twist.linear_m_s)
