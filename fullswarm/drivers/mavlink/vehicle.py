"""What the vehicle has reported so far, the reading made of it, and whether its position is still measured.

An autopilot goes on sending positions for seconds after its satellite receiver has lost the signal, and its EKF calls
them good. The receiver's own message shows it: the fix falls, or the time of the last fix stands still although the
message keeps coming (ArduPilot repeats the last fix of a receiver that is silent for 4 s).
"""

from __future__ import annotations

import math
from collections import deque

from fullswarm.drivers.base import Hazard, Pose, Reading, Twist
from fullswarm.drivers.linked import Odometer
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.frame import SwarmFrame

LINK_SILENCE_S = 3.0
TELEMETRY_SILENCE_S = 1.0
BATTERY_LOW = 0.15
REBOOT_MS = 1000  # a boot time this much older is a restart, less is a datagram out of order
TEXTS = 20
WARNING = 4  # severities up to here are worth an operator's attention


SIGMA_M = 0.05
"""Standard deviation of an aided position, per axis: 0.03 m north and 0.05 m east of the simulator's truth."""
DRIFT_M_S, DRIFT_M_S2 = 0.04, 0.12
"""An unaided position drifts with the error of the velocity at its loss, and with that of the accelerations."""
FIX_3D = 3
STRAINED = 0.8
"""Innovation test ratio from which on an EKF rejects what it is aided with; also ArduPilot's FS_EKF_THRESH."""
TOLD_S = 1.0


class Aiding:
    """What was received of a vehicle's receiver and filter, with arrival times (s, monotonic).

    Parameters
    ----------
    receiver
        Whether satellites are what aids it; False: poses from outside do.
    filtered
        Whether the EKF's own report counts.
    """

    def __init__(self, *, receiver: bool = True, filtered: bool = True) -> None:
        self._by_receiver, self._filtered = receiver, filtered
        self._fix: p.SatelliteFix | None = None  # the newest message
        self._heard_s = -math.inf  # and when it came
        self._fix_us = -1
        self._aided_s: float | None = None  # when a new fix came; None: there was none, it is aided by something else
        self._strained_s: float | None = None  # since when the filter rejects what aids it

    @property
    def has_receiver(self) -> bool:
        """Whether a satellite receiver has had a fix."""
        return self._aided_s is not None

    def receive(self, body: p.SatelliteFix | p.EkfStatus, now_s: float) -> None:
        """Take a report of the receiver or the filter."""
        if isinstance(body, p.EkfStatus):
            bad = self._filtered and (body.strain > STRAINED or not body.good)
            self._strained_s = (now_s if self._strained_s is None else self._strained_s) if bad else None
            return
        self._fix, self._heard_s = body, now_s
        if self._by_receiver and body.fix_type >= FIX_3D and body.stamp_us != self._fix_us:
            self._fix_us, self._aided_s = body.stamp_us, now_s

    def unheard(self, now_s: float) -> bool:
        """Return whether a receiver that had a fix has been silent for so long that its state is not known."""
        return self.has_receiver and now_s - self._heard_s >= TOLD_S

    def age_s(self, now_s: float) -> float:
        """Return for how long nothing has measured the position."""
        lost_s = [each for each in (self._aided_s, self._strained_s) if each is not None]
        return max(0.0, now_s - min(lost_s)) if lost_s else 0.0

    def sigma_m(self, now_s: float) -> float:
        """Return the standard deviation of the position, per axis."""
        age_s = self.age_s(now_s)
        return SIGMA_M + DRIFT_M_S * age_s + 0.5 * DRIFT_M_S2 * age_s**2

    def problem(self, now_s: float) -> str:
        """Return what is lost, once that is no hiccup; empty while the position is measured."""
        age_s = self.age_s(now_s)
        if age_s < TOLD_S or not math.isfinite(age_s):
            return ""
        silent = self._aided_s is not None and now_s - self._aided_s >= TOLD_S
        if silent and self._fix is not None and self._fix.fix_type < FIX_3D:
            what = f"the satellite receiver has no fix (type {self._fix.fix_type})"
        elif silent:
            what = "the satellite receiver reports nothing new"
        else:
            what = "the autopilot's filter rejects what measures its position"
        return f"{what}: the position has been dead reckoning for {age_s:.1f} s"


class Vehicle:
    """The newest of everything that one vehicle has sent, with arrival times (s, monotonic).

    Parameters
    ----------
    receiver
        Whether satellites are what aids its position; False: poses from outside do.
    filtered
        Whether its EKF's own report counts.
    """

    def __init__(self, *, receiver: bool = True, filtered: bool = True) -> None:
        self._aids = receiver, filtered
        self.odometer = Odometer()
        self.frame: SwarmFrame | None = None  # None: its own map is all there is
        self.reading: Reading | None = None
        self.version: p.Version | None = None
        self.forget()

    def forget(self) -> None:
        """Forget what was received before: the link was lost or the vehicle restarted."""
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
        """Whether motors may turn, by the newest heartbeat."""
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
        """Whether position or attitude have stopped, whatever heartbeats show."""
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
        # SYS_STATUS and BATTERY_STATUS report one pack; either may leave out what the other knows.
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
