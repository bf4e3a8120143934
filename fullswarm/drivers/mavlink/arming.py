"""Into motion and out of it: GUIDED and armed, confirmed by state; zero, HOLD and disarmed, confirmed by state."""

from __future__ import annotations

from functools import partial

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import StationEncoder
from fullswarm.drivers.mavlink.requests import RESEND_S, Pursuit
from fullswarm.drivers.mavlink.vehicle import Vehicle

STEP_S = 3.0
TEXT_WAIT_S = 0.5
BRAKE_S = 1.5
STANDING_M_S = 0.06  # a rover told zero creeps at up to 0.036 m/s
SETPOINT_S = 0.05


class Activation:
    """One attempt: GUIDED seen in a heartbeat, then armed seen in a heartbeat. Sends no set-point.

    A set-point sent before arming is stored by the firmware and drives off the moment it arms.
    """

    def __init__(self, encoder: StationEncoder, vehicle: Vehicle, now_s: float) -> None:
        self._vehicle, self._start_s, self._deadline_s = vehicle, now_s, now_s + STEP_S
        self._mode = Pursuit(p.COMMAND_SET_MODE, partial(encoder.set_mode, p.Mode.GUIDED))
        # An accepted arm is not repeated: were the pilot to disarm at that moment, it would fight him.
        self._arm = Pursuit(p.COMMAND_ARM, partial(encoder.arm, True), repeat_accepted=False)
        self._in_guided = False
        self._refused_s: float | None = None
        self.armed = False
        self.refusal = ""
        self.taken_over = False

    @property
    def arm_may_take_effect(self) -> bool:
        """Whether an arm command is under way that the vehicle has not refused."""
        return self._arm.sent > 0 and not self._arm.refused

    def receive(self, body: p.Body, now_s: float) -> None:
        """Take a message that arrived after the attempt began."""
        if isinstance(body, p.Ack):
            (self._arm if self._in_guided else self._mode).on_ack(body)
        elif isinstance(body, p.Heartbeat):
            self._see(body, now_s)

    def _see(self, heartbeat: p.Heartbeat, now_s: float) -> None:
        guided = heartbeat.custom_mode == p.Mode.GUIDED
        if self._in_guided and not guided:
            self.taken_over = True
            self.refusal = self._explain(f"the mode went to {p.mode_name(heartbeat.custom_mode)} while arming")
        elif guided and not self._in_guided:
            self._in_guided, self._deadline_s = True, now_s + STEP_S
        elif self._arm.sent and heartbeat.armed:
            self.armed = True

    def tick(self, now_s: float) -> list[bytes]:
        """Return the command that is due; sets `refusal` when the attempt is over."""
        if self.armed or self.refusal:
            return []
        step, what = (self._arm, "arm") if self._in_guided else (self._mode, "enter GUIDED")
        if step.refused:
            self._refused_s = now_s if self._refused_s is None else self._refused_s
            if self._vehicle.texts_since(self._start_s) or now_s - self._refused_s > TEXT_WAIT_S:
                result = p.result_name(step.result or 0)
                self.refusal = self._explain(f"the vehicle refused to {what} ({result})")
            return []
        if now_s > self._deadline_s:
            self.refusal = self._explain(f"the vehicle did not {what} within {STEP_S:g} s")
            return []
        return step.tick(now_s)

    def _explain(self, what: str) -> str:
        texts = self._vehicle.texts_since(self._start_s)
        return f"{what}: {'; '.join(dict.fromkeys(texts))}" if texts else what


class StandDown:
    """Zero set-point until standing, then HOLD, then disarm, each repeated until a heartbeat shows it.

    A vehicle that is in neither GUIDED nor HOLD is in somebody else's hands and is left alone.
    """

    def __init__(self, encoder: StationEncoder, vehicle: Vehicle, now_s: float, *, arm_pending: bool = False) -> None:
        self._encoder, self._vehicle, self.start_s = encoder, vehicle, now_s
        self._hold = Pursuit(p.COMMAND_SET_MODE, partial(encoder.set_mode, p.Mode.HOLD))
        self._disarm = Pursuit(p.COMMAND_ARM, partial(encoder.arm, False))
        self._brake_until_s = now_s + BRAKE_S
        # An arm command on its way can still take effect after the newest heartbeat that said disarmed.
        self._not_done_before_s = now_s + (2 * RESEND_S if arm_pending else 0.0)
        self._setpoint_s = now_s
        self.done = False

    def tick(self, now_s: float) -> list[bytes]:
        """Return the frames that are due; sets `done` when the vehicle's state shows it."""
        vehicle = self._vehicle
        guided, armed = vehicle.mode == p.Mode.GUIDED, vehicle.armed
        pending = now_s < self._not_done_before_s
        if vehicle.mode not in (p.Mode.GUIDED, p.Mode.HOLD):
            self.done = True
            return []
        if not guided and not armed and not pending:
            self.done = True
            return []
        frames: list[bytes] = []
        if guided and armed and now_s >= self._setpoint_s:
            self._setpoint_s = now_s + SETPOINT_S
            frames.append(self._encoder.stand())
        if armed and guided and self._rolling(now_s):
            return frames
        if guided:
            frames += self._hold.tick(now_s)
        if (armed or pending) and (not guided or self._hold.sent > 1):
            frames += self._disarm.tick(now_s)
        return frames

    def _rolling(self, now_s: float) -> bool:
        speed = self._vehicle.speed_m_s(now_s)
        return speed is not None and speed > STANDING_M_S and now_s < self._brake_until_s
