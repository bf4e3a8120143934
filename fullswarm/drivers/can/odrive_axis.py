"""One ODrive axis as a wheel's codec."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from fullswarm.drivers.can import odrive
from fullswarm.drivers.can.odrive import Firmware
from fullswarm.drivers.can.odrive_states import AxisState, error_bit, error_names, state_name
from fullswarm.drivers.can.protocol import Beat, Frame, Mode, Motion, Power, Report, Version, Want, Wheel

MAX_TURN_S = 1e4
"""No motor turns faster: a larger reported value is noise."""
ESTOP = "ESTOP_REQUESTED"
_OTHER: dict[Firmware, Firmware] = {"0.5": "0.6", "0.6": "0.5"}
_MODES: dict[int, Mode] = {AxisState.IDLE: Mode.IDLE, AxisState.CLOSED_LOOP: Mode.DRIVING}
_HEARD: dict[Firmware, frozenset[int]] = {"0.5": frozenset({0x01, 0x09, 0x17}), "0.6": frozenset({0, 0x01, 0x09, 0x17})}


@dataclass(slots=True)
class OdriveCodec:
    """One axis as a :class:`~fullswarm.drivers.can.protocol.WheelCodec`.

    The axis' watchdog is off as delivered and no CANSimple command switches it on: do it once over USB with
    ``odrv0.axis0.config.watchdog_timeout = 0.5``, ``…enable_watchdog = True``, ``odrv0.save_configuration()``.
    (0.6 could be told through its parameter frames, but by numbers that change with every firmware build: a
    wrong one would write to another parameter.) When on, 0.5 is fed by every frame to the axis, 0.6 by
    set-points, so `keep_alive` is a set-point of zero.
    """

    node: int
    wheel: Wheel
    firmware: Firmware = "0.6"
    limit_turn_s: float = 2.0  # the axis' own vel_limit
    input_mode: int = odrive.PASSTHROUGH
    malformed: int = 0
    told: bool = False  # its version, which only 0.6 does

    @property
    def max_speed_m_s(self) -> float:
        """Return the speed at the axis' ``vel_limit``; it disarms at 1.2 times that."""
        return abs(self.wheel.metres(self.limit_turn_s))

    @property
    def generic_firmware(self) -> str:
        """Return what is known when the axis does not tell: 0.5 cannot."""
        return f"ODrive CANSimple {self.firmware}"

    def quantised(self, speed_m_s: float) -> float:
        """Return `speed_m_s` after its journey through a 32-bit float."""
        (turn_s,) = struct.unpack("<f", struct.pack("<f", self.wheel.turns(speed_m_s)))
        return self.wheel.metres(turn_s)

    def start(self) -> tuple[Frame, ...]:
        """Clear errors, velocity control, zero; 0.6 is asked for its version."""
        return (*self._send(odrive.ClearErrors(), self._mode, odrive.SetVelocity(0.0)), *self.poll(Want.VERSION))

    def engage(self) -> tuple[Frame, ...]:
        """Velocity control at zero, then closed loop. Errors are not cleared here: one may be an e-stop."""
        return self._send(self._mode, odrive.SetVelocity(0.0), odrive.SetState(AxisState.CLOSED_LOOP))

    def drive(self, speed_m_s: float) -> tuple[Frame, ...]:
        """Set the input velocity."""
        return self._send(odrive.SetVelocity(self.wheel.turns(speed_m_s)))

    def release(self) -> tuple[Frame, ...]:
        """Zero and IDLE: the wheel coasts."""
        return self._send(odrive.SetVelocity(0.0), odrive.SetState(AxisState.IDLE))

    def keep_alive(self) -> tuple[Frame, ...]:
        """Set zero, which an idle axis ignores but its watchdog counts."""
        return self._send(odrive.SetVelocity(0.0))

    def poll(self, wants: Want) -> tuple[Frame, ...]:
        """Ask for what does not come by itself; heartbeats always do, a version only from 0.6."""
        kinds: list[type[object]] = []
        if Want.MOTION in wants:
            kinds.append(odrive.Encoder)
        if Want.POWER in wants:
            kinds.append(odrive.BusPower)
        if Want.VERSION in wants and self.firmware == "0.6":
            kinds.append(odrive.Version)
        return tuple(odrive.request(self.node, kind, self.firmware) for kind in kinds)

    def decode(self, frame: Frame) -> Report | None:
        """Return what the axis tells: heartbeat, encoder estimates, bus voltage, version."""
        if frame.extended or frame.remote or frame.id >> 5 != self.node or frame.id & 0x1F not in _HEARD[self.firmware]:
            return None
        report = self._report(odrive.decode(frame, self.firmware))
        self.malformed += report is None
        return report

    def _report(self, message: object) -> Report | None:
        match message:
            case odrive.Encoder(position_turn=turns, velocity_turn_s=turn_s) if abs(turn_s) <= MAX_TURN_S:
                return Motion(self.wheel.metres(turn_s), self.wheel.metres(turns))
            case odrive.Heartbeat(error=error, state=state) | odrive.Heartbeat05(error=error, state=state):
                return self._beat(error, state)
            case odrive.BusPower(volts=volts) if volts >= 0.0:
                return Power(volts)
            case odrive.Version(major=major, minor=minor, revision=revision):
                self.told = True
                return Version(f"ODrive {major}.{minor}.{revision}")
        return None

    def _beat(self, error: int, state: int) -> Beat:
        is_estop = bool(error & error_bit(ESTOP, self.firmware))
        names = error_names(error, self.firmware)
        if not is_estop and not self.told and error & error_bit(ESTOP, _OTHER[self.firmware]):
            # The URL may name the wrong generation, and an e-stop must not be cleared for that.
            is_estop, names = True, f"{names} (or, with firmware={_OTHER[self.firmware]} in its URL, {ESTOP})"
        # An unknown state is as good as a calibration: the wheel does not obey.
        return Beat(_MODES.get(state, Mode.BUSY), state_name(state), names, is_estop)

    @property
    def _mode(self) -> odrive.SetMode:
        return odrive.SetMode(odrive.VELOCITY_CONTROL, self.input_mode)

    def _send(self, *messages: object) -> tuple[Frame, ...]:
        return tuple(odrive.encode(self.node, message, self.firmware) for message in messages)
