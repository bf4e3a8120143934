"""Into motion and out of it: the driving mode and armed, confirmed by state; zero, hold and disarmed, by state too."""

from __future__ import annotations

import math
from functools import partial

from fullswarm.drivers.base import STAND
from fullswarm.drivers.guardian import StopPlan
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.autopilot import Autopilot, Known
from fullswarm.drivers.mavlink.codec import StationEncoder
from fullswarm.drivers.mavlink.requests import RESEND_S, Pursuit
from fullswarm.drivers.mavlink.vehicle import Vehicle

STEP_S = 3.0
TEXT_WAIT_S = 0.5
BRAKE_S = 1.5
SETPOINT_S = 0.05
HOLD_AT_S = (0.0, 0.05, 0.1, 0.2, 0.4)
"""When a guardian asks for the holding mode: often enough for a bad link, not so long that it fights a pilot."""
DISARM_AT_S = (1.4, 1.5, 1.6)
"""When it disarms, if the driver is gone: a rover at 1 m/s stands by then."""


def left_armed(vehicle: Vehicle, autopilot: Autopilot, *, by_us: bool) -> bool:
    """Whether the vehicle is still armed from before the link was lost, or from another run of ours.

    One that a failsafe holds is disarmed in any case: PX4 stays in its failsafe until then.
    """
    lost = vehicle.heartbeat is not None and vehicle.heartbeat.status == p.STATUS_CRITICAL
    held = (by_us or lost) and vehicle.mode == autopilot.hold_mode
    return vehicle.armed and (vehicle.mode == autopilot.drive_mode or held)


class Controls:
    """One vehicle's autopilot and the encoder to it: the commands that both procedures below use."""

    def __init__(self, autopilot: Autopilot, encoder: StationEncoder, known: Known) -> None:
        self.autopilot, self.encoder, self._known = autopilot, encoder, known

    def mode(self, mode: int) -> Pursuit:
        """Return the pursuit of a mode."""
        return Pursuit(p.COMMAND_SET_MODE, partial(self.autopilot.set_mode, self.encoder, mode))

    def arm(self, arm: bool, *, repeat_accepted: bool = True) -> Pursuit:
        """Return the pursuit of the armed state."""
        return Pursuit(p.COMMAND_ARM, partial(self.encoder.arm, arm), repeat_accepted=repeat_accepted)

    def stand(self) -> bytes:
        """Return a set-point that moves nothing."""
        return self.autopilot.setpoint(self.encoder, STAND, self._known)

    def stop(self) -> list[bytes]:
        """Return all that stops it, for when its state is unknown."""
        return [
            self.stand(),
            self.autopilot.set_mode(self.encoder, self.autopilot.hold_mode, 0),
            self.encoder.arm(False),
        ]


def stop_plan(controls: Controls, *, drives: bool) -> StopPlan[bytes]:
    """Return what a guardian sends in our place; `drives`: the vehicle takes set-points now."""
    autopilot = controls.autopilot
    stop: list[tuple[float, bytes]] = []
    for number, after_s in enumerate(HOLD_AT_S):
        stop += [(after_s, controls.stand())] if drives else []
        stop.append((after_s, autopilot.set_mode(controls.encoder, autopilot.hold_mode, number)))
    leave = [(after_s, controls.encoder.arm(False, number)) for number, after_s in enumerate(DISARM_AT_S)]
    return StopPlan(tuple(stop), tuple(leave))


class Activation:
    """One attempt: the driving mode seen in a heartbeat, then armed seen in a heartbeat.

    ArduPilot gets no set-point before that: it stores one and drives off the moment it arms. PX4 enters
    its driving mode only after standing set-points for a while, and leaves it when they stop.
    """

    def __init__(self, controls: Controls, vehicle: Vehicle, now_s: float) -> None:
        self._controls, self._vehicle, self._start_s = controls, vehicle, now_s
        autopilot = controls.autopilot
        self._mode_s = now_s + autopilot.stream_s
        self._deadline_s = self._mode_s + STEP_S
        self._setpoint_s = now_s if autopilot.stream_s > 0.0 else math.inf
        self._mode = controls.mode(autopilot.drive_mode)
        # An accepted arm is not repeated: were the pilot to disarm at that moment, it would work against the pilot.
        self._arm = controls.arm(True, repeat_accepted=False)
        self._in_mode = False
        self._refused_s: float | None = None
        self.armed = False
        self.refusal = ""
        self.taken_over = False

    @property
    def arm_may_take_effect(self) -> bool:
        """Whether an arm command is under way that the vehicle has not refused."""
        return self._arm.sent > 0 and not self._arm.refused

    @property
    def next_due_s(self) -> float:
        """When :meth:`tick` has a set-point to send."""
        return self._setpoint_s

    def receive(self, body: p.Body, now_s: float) -> None:
        """Take a message that arrived after the attempt began."""
        if isinstance(body, p.Ack):
            (self._arm if self._in_mode else self._mode).on_ack(body)
        elif isinstance(body, p.Heartbeat):
            self._see(body, now_s)

    def _see(self, heartbeat: p.Heartbeat, now_s: float) -> None:
        autopilot = self._controls.autopilot
        drives = heartbeat.custom_mode == autopilot.drive_mode
        if self._in_mode and not drives:
            self.taken_over = True
            name = autopilot.mode_name(heartbeat.custom_mode)
            self.refusal = self._explain(f"the mode went to {name} while arming")
        elif drives and not self._in_mode and now_s >= self._mode_s:
            self._in_mode, self._deadline_s = True, now_s + STEP_S
        elif self._arm.sent and heartbeat.armed:
            self.armed = True

    def tick(self, now_s: float) -> list[bytes]:
        """Return the frames that are due; sets `refusal` when the attempt is over."""
        if self.armed or self.refusal:
            return []
        frames: list[bytes] = []
        if now_s >= self._setpoint_s:
            self._setpoint_s = now_s + SETPOINT_S
            frames.append(self._controls.stand())
        if now_s < self._mode_s:
            return frames
        name = self._controls.autopilot.mode_name(self._controls.autopilot.drive_mode)
        step, what = (self._arm, "arm") if self._in_mode else (self._mode, f"enter {name}")
        if step.refused:
            self._refused_s = now_s if self._refused_s is None else self._refused_s
            if self._vehicle.texts_since(self._start_s) or now_s - self._refused_s > TEXT_WAIT_S:
                result = p.result_name(step.result or 0)
                self.refusal = self._explain(f"the vehicle refused to {what} ({result})")
            return frames
        if now_s > self._deadline_s:
            self.refusal = self._explain(f"the vehicle did not {what} within {STEP_S:g} s")
            return frames
        return frames + step.tick(now_s)

    def _explain(self, what: str) -> str:
        texts = self._vehicle.texts_since(self._start_s)
        return f"{what}: {'; '.join(dict.fromkeys(texts))}" if texts else what


class StandDown:
    """Zero set-point until standing, then hold, then disarm, each repeated until a heartbeat shows it.

    A vehicle that is in neither the driving nor the holding mode is under another's control and is left alone.
    """

    def __init__(self, controls: Controls, vehicle: Vehicle, now_s: float, *, arm_pending: bool = False) -> None:
        self._controls, self._vehicle, self.start_s = controls, vehicle, now_s
        self._drive_mode, self._hold_mode = controls.autopilot.drive_mode, controls.autopilot.hold_mode
        self._hold = controls.mode(self._hold_mode)
        self._disarm = controls.arm(False)
        self._brake_until_s = now_s + BRAKE_S
        # An arm command on its way can still take effect after the newest heartbeat that showed it disarmed.
        self._not_done_before_s = now_s + (2 * RESEND_S if arm_pending else 0.0)
        self._setpoint_s = now_s
        self.done = False

    def tick(self, now_s: float) -> list[bytes]:
        """Return the frames that are due; sets `done` when the vehicle's state shows it."""
        vehicle = self._vehicle
        drives, armed = vehicle.mode == self._drive_mode, vehicle.armed
        pending = now_s < self._not_done_before_s
        if vehicle.mode not in (self._drive_mode, self._hold_mode):
            self.done = True
            return []
        if not drives and not armed and not pending:
            self.done = True
            return []
        frames: list[bytes] = []
        if drives and (armed or self._controls.autopilot.stream_s) and now_s >= self._setpoint_s:
            self._setpoint_s = now_s + SETPOINT_S
            frames.append(self._controls.stand())
        if armed and drives and self._rolling(now_s):
            return frames
        if drives:
            frames += self._hold.tick(now_s)
        if (armed or pending) and (not drives or self._hold.sent > 1):
            frames += self._disarm.tick(now_s)
        return frames

    def _rolling(self, now_s: float) -> bool:
        speed = self._vehicle.speed_m_s(now_s)
        stands_m_s = self._controls.autopilot.standstill.speed_m_s
        return speed is not None and speed > stands_m_s and now_s < self._brake_until_s
