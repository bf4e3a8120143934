"""The conversation with one rover, as a state machine: messages and ticks in, frames and state out.

No I/O, no thread, no clock: the driver's link thread feeds it, so it can be replayed and tested in lockstep.
Time is monotonic seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Limits, Reading, Twist
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.arming import SETPOINT_S, Activation, StandDown
from fullswarm.drivers.mavlink.codec import StationEncoder, decode
from fullswarm.drivers.mavlink.startup import STATION, Startup, unsupported
from fullswarm.drivers.mavlink.vehicle import LINK_SILENCE_S, Vehicle
from fullswarm.geometry import clamp

STATION_COMPONENT = 190
HEARTBEAT_S = 1.0
COMMAND_TTL_S = 0.3
FAULT_DWELL_S = 0.5  # long enough for an agent's loop to see it
RETRY_S = 1.0  # between two attempts to arm
STAND_DOWN_S = 5.0
STORED_SETPOINT_S = 3.2  # the firmware forgets a set-point after 3.0 s


@dataclass(frozen=True, slots=True)
class Options:
    """Which vehicle, and what to ask of it."""

    system: int
    limits: Limits
    where: str
    ekf_ignored: bool = False


class Session:
    """One rover, from silence to driving and back."""

    def __init__(self, options: Options, now_s: float) -> None:
        self._options = options
        self._encoder = StationEncoder(STATION, STATION_COMPONENT, options.system)
        self._vehicle = Vehicle()
        self._startup = Startup(self._encoder, ekf_ignored=options.ekf_ignored)
        self._activation: Activation | None = None
        self._stand_down: StandDown | None = None
        self.lifecycle = Lifecycle.OPEN
        self.fault = ""
        self.why = f"no heartbeat from system {options.system} yet"
        self._opened_s = now_s
        self._fault_s = -math.inf
        self._heartbeat_due_s = now_s
        self._setpoint_due_s = now_s
        self._wish = False
        self._wished_s = self._retry_s = -math.inf
        self._taken_over = False
        self._armed_by_us = False
        self._command, self._command_s = STAND, -math.inf
        self._moving_sent_s = -math.inf

    # ------------------------------------------------------------ for the agent
    @property
    def firmware(self) -> str:
        """The firmware's name and version; empty until known."""
        return f"ArduRover {self._vehicle.version}" if self._vehicle.version else ""

    @property
    def standing_down(self) -> bool:
        """Whether the vehicle may still be moving or armed because of us."""
        return self._stand_down is not None or self._activation is not None or self.lifecycle is Lifecycle.ACTIVE

    def reading(self) -> Reading | None:
        """Return the newest reading; a pilot's take-over shows as the emergency-stop hazard."""
        reading = self._vehicle.reading
        if reading is not None and self._taken_over:
            return replace(reading, hazards=reading.hazards | Hazard.ESTOP_BUTTON)
        return reading

    def activate(self, now_s: float) -> None:
        """Wish to drive. Calls less than a second apart are one wish, which a pilot's take-over ends."""
        same_wish = now_s - self._wished_s < RETRY_S
        self._wished_s = now_s
        if self.lifecycle is not Lifecycle.READY or (self._taken_over and same_wish):
            return
        if self._activation is not None:
            return
        self._taken_over = False
        self._wish = True

    def deactivate(self, now_s: float) -> None:
        """Stand down: zero set-point, HOLD, disarm."""
        self._wish, self._taken_over = False, False
        self._command = STAND
        if self.lifecycle is Lifecycle.ACTIVE or self._activation is not None:
            self._begin_stand_down(now_s)

    def command(self, twist: Twist, now_s: float) -> Twist:
        """Take a set-point; return what the vehicle will be told.

        Raises
        ------
        ValueError
            Not finite; the rover is told to stand.
        """
        if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
            self._command, self._setpoint_due_s = STAND, now_s
            raise ValueError(f"a set-point must be finite, not {twist}")
        if self.lifecycle is not Lifecycle.ACTIVE or self._stand_down is not None:
            return STAND
        limits = self._options.limits
        speed = min(limits.speed_m_s, self._startup.top_speed_m_s or math.inf)
        applied = Twist(
            clamp(twist.linear_m_s, -speed, speed),
            clamp(twist.angular_rad_s, -limits.turn_rad_s, limits.turn_rad_s),
        )
        if applied == STAND and self._command != STAND:
            self._setpoint_due_s = now_s  # a stop does not wait for its turn
        self._command, self._command_s = applied, now_s
        return applied

    # ------------------------------------------------------------ for the link thread
    def is_our_vehicle(self, message: Any) -> bool:
        """Whether a dialect's message is the heartbeat of the vehicle we look for."""
        received = decode(message)
        return received is not None and self._is_ours(received) and isinstance(received.body, p.Heartbeat)

    def _is_ours(self, received: p.Received) -> bool:
        if received.system != self._options.system:
            return False
        if isinstance(received.body, p.Heartbeat):
            return received.body.is_vehicle
        return received.component == 1  # the autopilot itself, not a camera beside it

    def receive(self, message: Any, now_s: float) -> None:
        """Take one of the dialect's messages; those of other systems are ignored."""
        received = decode(message)
        if received is None or not self._is_ours(received):
            return
        body = received.body
        if isinstance(body, p.Ack) and body.target_system not in (0, STATION):
            return  # the answer to another station
        if isinstance(body, p.Heartbeat):
            self._watch_hand_back(body)
        self._vehicle.receive(body, now_s)
        self._startup.receive(body)
        if self._activation is not None:
            self._activation.receive(body, now_s)
        if isinstance(body, p.Heartbeat) and self.lifecycle is Lifecycle.ACTIVE and self._stand_down is None:
            self._watch_mode(body, now_s)

    @property
    def alone(self) -> bool:
        """Whether nothing is heard of the vehicle: any port may be its new one."""
        return self._vehicle.heartbeat is None

    def next_due_s(self) -> float:
        """Return when :meth:`tick` has something to send at the latest."""
        if self.lifecycle is Lifecycle.ACTIVE:
            return min(self._heartbeat_due_s, self._setpoint_due_s)
        return self._heartbeat_due_s

    def link_lost(self, reason: str, now_s: float) -> None:
        """Take note that the port is gone; the driver opens it again."""
        self._fail(reason, now_s)
        self._forget()

    def emergency(self) -> list[bytes]:
        """Return what stops a vehicle that we drive, for the moment when nothing else works any more."""
        if not self.standing_down:
            return []
        encoder = self._encoder
        stop = encoder.stand() if self.lifecycle is Lifecycle.ACTIVE else b""
        return [stop, encoder.set_mode(p.Mode.HOLD), encoder.arm(False)]

    def tick(self, now_s: float) -> list[bytes]:
        """Return the frames that are due now."""
        frames: list[bytes] = []
        if now_s >= self._heartbeat_due_s:
            self._heartbeat_due_s = now_s + HEARTBEAT_S
            frames.append(self._encoder.heartbeat())
        vehicle = self._vehicle
        if vehicle.rebooted:
            self._fail("the autopilot restarted", now_s)
            self._forget()
        if vehicle.heartbeat is None or vehicle.silent(now_s):
            if self.lifecycle is Lifecycle.ACTIVE:
                frames.append(self._encoder.stand())  # it may still hear us
            self._watch_silence(now_s)
            return frames
        problem = unsupported(vehicle.heartbeat)
        if problem:
            if self.lifecycle is not Lifecycle.FAULT:
                self._fail(problem, now_s)
            return frames
        frames += self._startup.tick(now_s, vehicle)
        self._watch_problem(now_s)
        if self._stand_down is not None:
            frames += self._continue_stand_down(self._stand_down, now_s)
        elif self.lifecycle is Lifecycle.ACTIVE:
            frames += self._setpoint(now_s)
        elif self.lifecycle is Lifecycle.READY:
            frames += self._pursue_wish(now_s)
        return frames

    # ------------------------------------------------------------ transitions
    def _fail(self, reason: str, now_s: float) -> None:
        self.lifecycle, self.fault, self._fault_s = Lifecycle.FAULT, f"{self._options.where}: {reason}", now_s
        self._wish, self._command = False, STAND

    def _forget(self) -> None:
        self._vehicle.forget()
        self._startup.restart()
        self._activation = self._stand_down = None
        self._taken_over = False

    def _watch_silence(self, now_s: float) -> None:
        system = self._options.system
        if self._vehicle.heartbeat is not None:
            self._fail(f"link lost: no heartbeat from system {system} for {LINK_SILENCE_S:g} s", now_s)
            self._forget()
        elif self.lifecycle is Lifecycle.OPEN and now_s - self._opened_s > LINK_SILENCE_S:
            hint = "check power, cable, baud rate and ?sysid="
            self._fail(f"no heartbeat from system {system} ({hint})", now_s)

    def _watch_problem(self, now_s: float) -> None:
        """Move between OPEN, READY and FAULT as the vehicle's condition changes."""
        self.why = self._startup.problem(now_s, self._vehicle)
        settled = self._stand_down is None
        if self.lifecycle is Lifecycle.ACTIVE and settled and self.why:
            self._fail(self.why, now_s)
            self._begin_stand_down(now_s)
        elif self.lifecycle is Lifecycle.READY and self.why:
            self.lifecycle, self._wish = Lifecycle.OPEN, False
            if self._activation is not None:
                self._begin_stand_down(now_s)
        elif self.lifecycle is Lifecycle.FAULT and settled and now_s - self._fault_s > FAULT_DWELL_S:
            self.lifecycle, self.fault, self._opened_s = Lifecycle.OPEN, "", now_s
        elif self.lifecycle is Lifecycle.OPEN and settled:
            if self._left_armed():
                self._begin_stand_down(now_s)
            elif not self.why:
                self.lifecycle = Lifecycle.READY

    def _left_armed(self) -> bool:
        """Whether the vehicle is still armed from before the link was lost, or from another run of ours."""
        mode = self._vehicle.mode
        return self._vehicle.armed and (mode == p.Mode.GUIDED or (self._armed_by_us and mode == p.Mode.HOLD))

    def _watch_mode(self, heartbeat: p.Heartbeat, now_s: float) -> None:
        """While ACTIVE: somebody else took the vehicle; say so and let him have it."""
        guided = heartbeat.custom_mode == p.Mode.GUIDED
        if heartbeat.status == p.STATUS_CRITICAL or heartbeat.custom_mode == p.Mode.INITIALISING:
            return  # a failsafe or a restart, not a person: _watch_problem deals with it
        if guided and heartbeat.armed:
            return
        what = "it was disarmed" if guided else f"the mode was changed to {p.mode_name(heartbeat.custom_mode)}"
        texts = "; ".join(dict.fromkeys(self._vehicle.texts_since(now_s - 2.0)))
        self.fault = (
            f"{self._options.where}: {what} by the pilot, another station or the autopilot"
            f"{f' ({texts})' if texts else ''}: hand back GUIDED, or stop the behaviour and ask again"
        )
        self.lifecycle, self._command, self._wished_s = Lifecycle.READY, STAND, now_s
        self._taken_over, self._armed_by_us, self._wish = True, False, False

    def _watch_hand_back(self, heartbeat: p.Heartbeat) -> None:
        if self._vehicle.mode != p.Mode.GUIDED and heartbeat.custom_mode == p.Mode.GUIDED:
            self._taken_over = False

    def _begin_stand_down(self, now_s: float) -> None:
        pending = self._activation is not None and self._activation.arm_may_take_effect
        self._stand_down = StandDown(self._encoder, self._vehicle, now_s, arm_pending=pending)
        self._activation, self._wish, self._command = None, False, STAND

    def _continue_stand_down(self, stand_down: StandDown, now_s: float) -> list[bytes]:
        frames = stand_down.tick(now_s)
        if stand_down.done:
            self._stand_down, self._armed_by_us = None, False
            if self.lifecycle is Lifecycle.ACTIVE:
                self.lifecycle = Lifecycle.READY
        elif now_s - stand_down.start_s > STAND_DOWN_S and self.lifecycle is not Lifecycle.FAULT:
            self._fail("the vehicle does not confirm HOLD and disarm; still trying", now_s)
        return frames

    def _setpoint(self, now_s: float) -> list[bytes]:
        if now_s < self._setpoint_due_s:
            return []
        self._setpoint_due_s = now_s + SETPOINT_S
        if now_s - self._command_s > COMMAND_TTL_S:
            self._command = STAND
        if self._command != STAND:
            self._moving_sent_s = now_s
        return [self._encoder.drive(self._command.linear_m_s, self._command.angular_rad_s)]

    def _pursue_wish(self, now_s: float) -> list[bytes]:
        if self._activation is None:
            stored = self._vehicle.mode == p.Mode.GUIDED and now_s - self._moving_sent_s < STORED_SETPOINT_S
            if not self._wish or now_s < self._retry_s or stored:
                return []
            self._wish = False
            self._activation = Activation(self._encoder, self._vehicle, now_s)
        attempt = self._activation
        frames = attempt.tick(now_s)
        self._armed_by_us = self._armed_by_us or attempt.arm_may_take_effect
        if attempt.refusal:
            self.fault, self._retry_s = f"{self._options.where}: {attempt.refusal}", now_s + RETRY_S
            self._taken_over, self._wished_s = attempt.taken_over, now_s
            self._begin_stand_down(now_s)
        elif attempt.armed:
            self._activation, self.lifecycle, self.fault = None, Lifecycle.ACTIVE, ""
            self._command, self._command_s = STAND, -math.inf
            self._setpoint_due_s = now_s
            frames += self._setpoint(now_s)
        return frames
