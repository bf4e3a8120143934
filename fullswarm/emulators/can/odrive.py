"""An emulated ODrive axis: states, errors, watchdog (off unless `watchdog_s`), heartbeats, answers to all questions."""

from __future__ import annotations

import math
from dataclasses import replace

from fullswarm.drivers.can import odrive
from fullswarm.drivers.can.odrive import AxisState, Firmware, error_bit
from fullswarm.drivers.can.protocol import Frame, Wheel
from fullswarm.emulators.can.wheel import BOOT_S, DRIVEN_S, STEP_S, STOPS_M, ControllerFaults, Sender, Spin

HEARTBEAT_S = 0.1
COUNTS_PER_TURN = 8192
SERIAL = bytes.fromhex("393538313338")
VERSION = odrive.Version(2, 4, 4, 58, 0, 6, 10)
TORQUE_CONTROL, POSITION_CONTROL = 1, 3
TRAP_TRAJ = 5
"""Input mode of planned moves."""
POSITION_GAIN, CRUISE_TURN_S = 20.0, 2.0
"""The firmware's defaults: ``pos_gain`` in (turn/s)/turn, ``trap_traj.config.vel_limit``."""
ACCEL_PER_NM = 8.0
"""What a motor torque does to the wheel, (m/s²)/Nm, before friction."""
_SETPOINTS = (odrive.SetVelocity, odrive.SetPosition, odrive.SetTorque)


class ODriveEmulator:
    """One axis in velocity, position or torque control.

    Input filters and ramps are not emulated: a set-point acts at once, but for a planned move, which keeps to its
    cruise speed.
    """

    def __init__(
        self,
        bus: Sender,
        node: int,
        wheel: Wheel,
        *,
        firmware: Firmware = "0.6",
        limit_turn_s: float = 2.0,
        watchdog_s: float | None = None,
        volts: float = 24.0,
    ) -> None:
        self._bus, self.node, self._wheel = bus, node, wheel
        self._firmware, self._limit_turn_s, self._watchdog_s = firmware, limit_turn_s, watchdog_s
        self.volts = volts
        self.spin = Spin()
        self.faults = ControllerFaults()
        self.state = AxisState.IDLE
        self.error = self._disarm_reason = 0
        self.cyclic_motion = True  # sends encoder estimates by itself, not only on request
        self.refuses = False  # never enters closed loop, as an axis that is not calibrated
        self._control, self._input = POSITION_CONTROL, odrive.PASSTHROUGH  # as delivered
        self._set = odrive.SetPosition(0.0)  # input position, velocity and torque
        self._position_gain, self._cruise_turn_s = POSITION_GAIN, CRUISE_TURN_S
        self._zero_turn = 0.0
        self._reported = odrive.Encoder(0.0, 0.0)
        self._fed_s = self._beat_s = self._encoder_s = -math.inf

    @property
    def energised(self) -> bool:
        """Whether the axis obeys set-points."""
        return self.state is AxisState.CLOSED_LOOP

    # ------------------------------------------------------------ what happens to it
    def inject(self, error: str) -> None:
        """Raise an error by its name: the axis disarms."""
        self.error |= error_bit(error, self._firmware)
        self._disarm_reason = self.error
        self.drop_out()

    def drop_out(self) -> None:
        """Leave closed loop without an error."""
        self.state, self._set = AxisState.IDLE, odrive.SetPosition(0.0)

    def press_estop(self, on: bool) -> None:
        """Press the button, or free it and clear the error at the controller, as its owner would."""
        self.faults.estop = on
        if on:
            self.inject("ESTOP_REQUESTED")
        else:
            self.error &= ~error_bit("ESTOP_REQUESTED", self._firmware)

    def reboot(self, now_s: float) -> None:
        """Start anew: silent for a while, idle, position zero, no errors but a pressed button."""
        self.error, self._zero_turn = 0, self._turns()
        self._control, self._input = POSITION_CONTROL, odrive.PASSTHROUGH  # as delivered
        self.drop_out()
        self.faults.booting_until_s = now_s + BOOT_S
        if self.faults.estop:
            self.inject("ESTOP_REQUESTED")

    # ------------------------------------------------------------ the bus
    def receive(self, frame: Frame, now_s: float) -> None:
        """Obey one frame; short payloads are accepted as far as they go."""
        if not self.faults.receives(now_s) or frame.extended or frame.id >> 5 != self.node:
            return
        if self._firmware == "0.5":
            self._fed_s = now_s
        if frame.remote:
            self._answer(frame.id & 0x1F, now_s)
        else:
            self._obey(odrive.decode(frame, self._firmware), now_s)

    def _obey(self, message: object, now_s: float) -> None:
        if isinstance(message, _SETPOINTS):
            self._fed_s = now_s
        match message:
            case odrive.SetState(state=state):
                self._request(state, now_s)
            case odrive.SetMode(control=control, input=mode):
                self._control, self._input = control, mode
            case odrive.SetPosition():
                self._set = message
            case odrive.SetVelocity(velocity_turn_s=turn_s, torque_nm=torque_nm):
                self._set = replace(self._set, velocity_turn_s=turn_s, torque_nm=torque_nm)
            case odrive.SetTorque(torque_nm=torque_nm):
                self._set = replace(self._set, torque_nm=torque_nm)
            case odrive.SetPositionGain(gain=gain) if gain >= 0.0:
                self._position_gain = gain
            case odrive.SetTrajectoryVelocity(velocity_turn_s=turn_s) if turn_s > 0.0:
                self._cruise_turn_s = turn_s
            case odrive.SetLimits(velocity_turn_s=turn_s) if turn_s > 0.0:
                self._limit_turn_s = turn_s
            case odrive.SetAbsolutePosition(position_turn=turns):
                self._zero_turn = self._turns() - turns
            case odrive.SetLinearCount(count=count):
                self._zero_turn = self._turns() - count / COUNTS_PER_TURN
            case odrive.ClearErrors():
                self.error = error_bit("ESTOP_REQUESTED", self._firmware) if self.faults.estop else 0
            case odrive.Estop():
                self.inject("ESTOP_REQUESTED")
            case odrive.Reboot():
                self.reboot(now_s)

    def _request(self, state: int, now_s: float) -> None:
        if state == AxisState.CLOSED_LOOP and not self.error and not self.refuses:
            self.state, self._fed_s = AxisState.CLOSED_LOOP, now_s
            # The firmware starts a position loop where the axis stands, not at the set-point of before.
            self._set = replace(self._set, position_turn=self._turns() - self._zero_turn)
        elif state == AxisState.IDLE:
            self.drop_out()
        elif state not in (AxisState.CLOSED_LOOP, AxisState.IDLE) and self._firmware == "0.5":
            self.inject("INVALID_STATE")

    def _answer(self, command: int, now_s: float) -> None:
        layout = odrive.TABLES[self._firmware].by_command.get(command)
        message = self._known(layout.kind) if layout else None
        if message is not None:
            self._send(message, now_s)

    def _known(self, kind: type[object]) -> object | None:
        """Return the answer to a request for a message of this kind; None for one that it only receives."""
        turns, turn_s = self._turns() - self._zero_turn, self._wheel.turns(self.spin.measured_m_s)
        if kind is odrive.Encoder:
            if not self.faults.stuck_sensor:
                self._reported = odrive.Encoder(turns, turn_s)
            return None if self.faults.silent_motion else self._reported
        if kind is odrive.EncoderCount:
            count = math.floor(turns * COUNTS_PER_TURN)
            return odrive.EncoderCount((count + 2**31) % 2**32 - 2**31, count % COUNTS_PER_TURN)
        if kind in (odrive.MotorError, odrive.EncoderError, odrive.SensorlessError, odrive.ControllerError):
            return kind(0)
        amperes = 0.5 + abs(turn_s)
        answers: dict[type[object], object] = {
            odrive.Heartbeat: odrive.Heartbeat(self.error, self.state),
            odrive.Heartbeat05: odrive.Heartbeat05(self.error, self.state),
            odrive.Version: VERSION,
            odrive.Errors: odrive.Errors(self.error, self._disarm_reason),
            odrive.Address: odrive.Address(self.node, SERIAL),
            odrive.Iq: odrive.Iq(0.0, 0.0),
            odrive.Sensorless: odrive.Sensorless(0.0, 0.0),
            odrive.Temperature: odrive.Temperature(35.0, None),
            odrive.BusPower: odrive.BusPower(self.volts, amperes),
            odrive.AdcVoltage: odrive.AdcVoltage(0.0),
            odrive.Torques: odrive.Torques(0.0, 0.0),
            odrive.Powers: odrive.Powers(self.volts * amperes, 0.0),
        }
        return answers.get(kind)

    def step(self, now_s: float) -> None:
        """Turn the wheel and send heartbeat (10 Hz) and encoder estimates (100 Hz)."""
        driving = self.state is AxisState.CLOSED_LOOP
        if driving and self._watchdog_s and now_s - self._fed_s > self._watchdog_s:
            self.inject("WATCHDOG_TIMER_EXPIRED")
            driving = False
        self._turn(driving, now_s)
        if now_s - self._beat_s >= HEARTBEAT_S - STEP_S / 2.0:
            self._beat_s = now_s
            self._answer(1, now_s)
        if self.cyclic_motion and now_s - self._encoder_s >= STEP_S / 2.0:
            self._encoder_s = now_s
            self._answer(9, now_s)

    def _turn(self, driving: bool, now_s: float) -> None:
        """Turn the wheel as mode and set-point have it; an idle axis lets it roll out."""
        if not driving:
            self.spin.step(0.0, None, now_s)
        elif self._control == TORQUE_CONTROL:
            forwards = math.copysign(1.0, self._wheel.metres(1.0))
            accel_m_s2 = forwards * self._set.torque_nm * ACCEL_PER_NM
            self.spin.push(accel_m_s2, abs(self._wheel.metres(self._limit_turn_s)), now_s)
        else:
            self.spin.step(self._wheel.metres(self._regulated_turn_s()), DRIVEN_S, now_s)

    def _regulated_turn_s(self) -> float:
        """Return the speed that the velocity loop is given, within ``vel_limit``; zero where there is none."""
        turn_s, most_turn_s = self._set.velocity_turn_s, self._limit_turn_s
        if self._control == POSITION_CONTROL:
            left_turn = self._set.position_turn - (self._turns() - self._zero_turn)
            if abs(self._wheel.metres(left_turn)) <= STOPS_M:
                left_turn = 0.0
            turn_s += self._position_gain * left_turn
            if self._input == TRAP_TRAJ:
                most_turn_s = min(most_turn_s, self._cruise_turn_s)
        elif self._control != odrive.VELOCITY_CONTROL:
            return 0.0  # voltage control, or a mode that there is not
        return max(-most_turn_s, min(most_turn_s, turn_s))

    def _send(self, message: object, now_s: float) -> None:
        if self.faults.sends(now_s):
            self._bus.send(odrive.encode(self.node, message, self._firmware))

    def _turns(self) -> float:
        return self._wheel.turns(self.spin.travelled_m)
