"""An emulated VESC: speed, duty cycle, current and position control, brakes, timeout, pongs, status messages."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fullswarm.drivers.can import vesc
from fullswarm.drivers.can.protocol import Frame, Wheel
from fullswarm.emulators.can.wheel import BOOT_S, BRAKED_S, DRIVEN_S, STEP_S, STOPS_M, ControllerFaults, Sender, Spin

STATUS_S, SLOW_STATUS_S = 0.02, 0.2
FULL_DUTY_ERPM = 50_000.0
"""No-load speed of the emulated motor at duty cycle 1."""
CURRENT_LIMIT_A = 60.0
"""Greatest motor current, the firmware's default ``l_current_max``; relative currents are shares of it."""
MIN_DUTY, MIN_CURRENT_A = 0.005, 0.05
"""Below these the firmware gives no torque: its defaults ``l_min_duty`` and ``cc_min_current``."""
ACCEL_PER_AMPERE = 0.6
"""What a motor current does to the wheel, (m/s²)/A: 10 A are 6 m/s², less friction."""
POSITION_GAIN_PER_S = 10.0
POSITION_SPEED_M_S = 0.5
_SLOW = (2, 3, 4, 6)
_BRAKES = (vesc.SetBrake, vesc.SetRelativeBrake, vesc.SetHandbrake, vesc.SetRelativeHandbrake)


@dataclass(frozen=True, slots=True)
class _Order:
    """What the newest SET command requests, with relative currents in amperes."""

    message: object = vesc.SetCurrent(0.0)
    amperes: float = 0.0  # motor or brake current


class VescEmulator:
    """One controller.

    Parameters
    ----------
    statuses
        Which status messages are switched on: 1 and 5 at 50 Hz, the others at 5 Hz.
    """

    def __init__(
        self,
        bus: Sender,
        node: int,
        wheel: Wheel,
        *,
        min_erpm: float = 900.0,
        timeout_s: float = vesc.FIRMWARE_TIMEOUT_S,
        statuses: frozenset[int] = frozenset({1, 5}),
        volts: float = 24.0,
    ) -> None:
        self._bus, self.node, self._wheel = bus, node, wheel
        self._min_erpm, self._timeout_s, self.statuses = min_erpm, timeout_s, statuses
        self.volts = volts
        self.spin = Spin()
        self.faults = ControllerFaults()
        self._order = _Order()
        self._zero_m = 0.0
        self._reported: tuple[int, int] = (0, 0)  # ERPM and tachometer
        self._set_s = self._status_s = self._slow_s = -math.inf

    @property
    def driving(self) -> bool:
        """Whether an order turns the motor now, and it has torque."""
        return self.energised and not isinstance(self._order.message, _BRAKES) and not self.faults.estop

    @property
    def energised(self) -> bool:
        """Whether an order regulates or brakes the motor now."""
        return self._order.message != vesc.SetCurrent(0.0)

    def press_estop(self, on: bool) -> None:
        """Press or free the kill switch: the motor loses its torque; no message reports that."""
        self.faults.estop = on

    def reboot(self, now_s: float) -> None:
        """Start anew: silent for a while, motor without torque, tachometer zero."""
        self._order, self._zero_m = _Order(), self.spin.travelled_m
        self.faults.booting_until_s = now_s + BOOT_S

    def receive(self, frame: Frame, now_s: float) -> None:
        """Obey one frame."""
        if not self.faults.receives(now_s) or frame.id & 0xFF not in (self.node, vesc.EVERYBODY):
            return
        message = vesc.decode(frame)
        if isinstance(message, vesc.Ping):
            self._send(message.host, vesc.Pong(self.node), now_s)
        elif message is not None and frame.id >> 8 in vesc.ORDERS:
            self._order = _Order(message, _amperes(message))
            self._set_s = now_s

    def step(self, now_s: float) -> None:
        """Turn the wheel and send the status messages."""
        if now_s - self._set_s > self._timeout_s:
            self._order = _Order()
        self._turn(now_s)
        if not self.faults.stuck_sensor:
            self._reported = round(self._wheel.erpm(self.spin.measured_m_s)), self._tachometer()
        if now_s - self._status_s >= STATUS_S - STEP_S / 2.0:
            self._status_s = now_s
            self._send_statuses(now_s, self.statuses.difference(_SLOW))
        if now_s - self._slow_s >= SLOW_STATUS_S - STEP_S / 2.0:
            self._slow_s = now_s
            self._send_statuses(now_s, self.statuses.intersection(_SLOW))

    def _turn(self, now_s: float) -> None:
        """Turn the wheel as the newest order has it; let it roll out where there is none."""
        spin, wheel, amperes = self.spin, self._wheel, self._order.amperes
        if self.faults.estop:
            spin.step(0.0, None, now_s)
            return
        match self._order.message:
            case vesc.SetErpm(erpm=erpm) if abs(erpm) >= self._min_erpm:
                spin.step(wheel.speed_of_erpm(erpm), DRIVEN_S, now_s)
            case vesc.SetDuty(duty=duty) if abs(duty) >= MIN_DUTY:
                spin.step(wheel.speed_of_erpm(max(-1.0, min(1.0, duty)) * FULL_DUTY_ERPM), DRIVEN_S, now_s)
            case vesc.SetPosition(position_deg=degrees):
                spin.step(self._towards_m_s(degrees), DRIVEN_S, now_s)
            case vesc.SetCurrent() | vesc.SetRelativeCurrent() if abs(amperes) >= MIN_CURRENT_A:
                forwards = math.copysign(1.0, wheel.speed_of_erpm(1.0))
                spin.push(forwards * amperes * ACCEL_PER_AMPERE, abs(wheel.speed_of_erpm(FULL_DUTY_ERPM)), now_s)
            case vesc.SetBrake() | vesc.SetRelativeBrake() | vesc.SetHandbrake() | vesc.SetRelativeHandbrake() if (
                abs(amperes) >= MIN_CURRENT_A
            ):
                spin.step(0.0, BRAKED_S, now_s)
            case _:
                spin.step(0.0, None, now_s)

    def _position_deg(self) -> float:
        """Return the motor's angle within one turn, [0, 360)."""
        return 360.0 * (self._wheel.turns(self.spin.travelled_m - self._zero_m) % 1.0)

    def _towards_m_s(self, degrees: float) -> float:
        """Return the wheel speed with which the position regulator takes the shorter way to an angle of the motor."""
        left_deg = (degrees - self._position_deg() + 180.0) % 360.0 - 180.0
        left_m = self._wheel.metres(left_deg / 360.0)
        speed_m_s = POSITION_GAIN_PER_S * left_m if abs(left_m) > STOPS_M else 0.0
        return max(-POSITION_SPEED_M_S, min(POSITION_SPEED_M_S, speed_m_s))

    def _send_statuses(self, now_s: float, statuses: frozenset[int]) -> None:
        erpm, tachometer = self._reported
        duty = max(-1.0, min(1.0, erpm / FULL_DUTY_ERPM))
        drives = isinstance(self._order.message, vesc.SetCurrent | vesc.SetRelativeCurrent)
        amperes = self._order.amperes if drives and not self.faults.estop else 0.0
        messages: dict[int, object] = {
            1: vesc.Status1(erpm, amperes, duty),
            2: vesc.Status2(0.0, 0.0),
            3: vesc.Status3(0.0, 0.0),
            4: vesc.Status4(35.0, 30.0, 0.5, self._position_deg()),
            5: vesc.Status5(tachometer, self.volts),
            6: vesc.Status6(0.0, 0.0, 0.0, 0.0),
        }
        for status in sorted(statuses):
            if not (self.faults.silent_motion and status in (1, 5)):
                self._send(self.node, messages[status], now_s)

    def _tachometer(self) -> int:
        turns = self._wheel.turns(self.spin.travelled_m - self._zero_m)
        counts = math.floor(turns * self._wheel.pole_pairs * vesc.TACHO_PER_TURN)
        return (counts + 2**31) % 2**32 - 2**31

    def _send(self, address: int, message: object, now_s: float) -> None:
        if self.faults.sends(now_s):
            self._bus.send(vesc.encode(address, message))


def _amperes(message: object) -> float:
    """Return the motor or brake current that an order requests, within the limit; zero for other orders."""
    match message:
        case (
            vesc.SetCurrent(current_a=amperes) | vesc.SetBrake(current_a=amperes) | vesc.SetHandbrake(current_a=amperes)
        ):
            return max(-CURRENT_LIMIT_A, min(CURRENT_LIMIT_A, amperes))
        case (
            vesc.SetRelativeCurrent(share=share)
            | vesc.SetRelativeBrake(share=share)
            | vesc.SetRelativeHandbrake(share=share)
        ):
            return max(-1.0, min(1.0, share)) * CURRENT_LIMIT_A
    return 0.0
