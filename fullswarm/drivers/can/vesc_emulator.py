"""An emulated VESC in speed control: dead band, brake, timeout, pongs, status messages."""

from __future__ import annotations

import math

from fullswarm.drivers.can import vesc
from fullswarm.drivers.can.protocol import Frame, Wheel
from fullswarm.drivers.can.spin import BOOT_S, BRAKED_S, DRIVEN_S, STEP_S, Mishaps, Sender, Spin

STATUS_S, SLOW_STATUS_S = 0.02, 0.2
_SLOW = (2, 3, 4, 6)
_BRAKES = (vesc.SetBrake, vesc.SetRelativeBrake, vesc.SetHandbrake, vesc.SetRelativeHandbrake)


class VescEmulator:
    """One controller. Currents, duty cycles and positions let the wheel roll: nothing here sends them.

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
        self.mishaps = Mishaps()
        self._erpm = 0
        self._brakes = False
        self._zero_m = 0.0
        self._told: tuple[int, int] = (0, 0)  # ERPM and tachometer
        self._set_s = self._status_s = self._slow_s = -math.inf

    @property
    def driving(self) -> bool:
        """Tell whether the speed is regulated now."""
        return abs(self._erpm) >= self._min_erpm and not self.mishaps.estop

    def press_estop(self, on: bool) -> None:
        """Press or free the kill switch: the motor is let go; no message tells that."""
        self.mishaps.estop = on

    def reboot(self, now_s: float) -> None:
        """Start anew: silent for a while, motor let go, tachometer zero."""
        self._erpm, self._brakes, self._zero_m = 0, False, self.spin.travelled_m
        self.mishaps.booting_until_s = now_s + BOOT_S

    def receive(self, frame: Frame, now_s: float) -> None:
        """Obey one frame."""
        if self.mishaps.deaf(now_s) or frame.id & 0xFF not in (self.node, vesc.EVERYBODY):
            return
        message = vesc.decode(frame)
        if isinstance(message, vesc.Ping):
            self._send(message.host, vesc.Pong(self.node), now_s)
        elif message is not None and frame.id >> 8 in vesc.ORDERS:
            self._erpm = message.erpm if isinstance(message, vesc.SetErpm) else 0
            self._brakes = isinstance(message, _BRAKES)
            self._set_s = now_s

    def step(self, now_s: float) -> None:
        """Turn the wheel and send the status messages."""
        if now_s - self._set_s > self._timeout_s:
            self._erpm, self._brakes = 0, False
        wished_m_s = self._wheel.speed_of_erpm(self._erpm) if self.driving else 0.0
        lag_s = DRIVEN_S if self.driving else BRAKED_S if self._brakes else None
        self.spin.step(wished_m_s, lag_s, now_s)
        if not self.mishaps.stuck_sensor:
            self._told = round(self._wheel.erpm(self.spin.measured_m_s)), self._tachometer()
        if now_s - self._status_s >= STATUS_S - STEP_S / 2.0:
            self._status_s = now_s
            self._tell(now_s, self.statuses.difference(_SLOW))
        if now_s - self._slow_s >= SLOW_STATUS_S - STEP_S / 2.0:
            self._slow_s = now_s
            self._tell(now_s, self.statuses.intersection(_SLOW))

    def _tell(self, now_s: float, statuses: frozenset[int]) -> None:
        erpm, tachometer = self._told
        messages: dict[int, object] = {
            1: vesc.Status1(erpm, 0.0, 0.0),
            2: vesc.Status2(0.0, 0.0),
            3: vesc.Status3(0.0, 0.0),
            4: vesc.Status4(35.0, 30.0, 0.5, 0.0),
            5: vesc.Status5(tachometer, self.volts),
            6: vesc.Status6(0.0, 0.0, 0.0, 0.0),
        }
        for status in sorted(statuses):
            if not (self.mishaps.silent_motion and status in (1, 5)):
                self._send(self.node, messages[status], now_s)

    def _tachometer(self) -> int:
        turns = self._wheel.turns(self.spin.travelled_m - self._zero_m)
        counts = math.floor(turns * self._wheel.pole_pairs * vesc.TACHO_PER_TURN)
        return (counts + 2**31) % 2**32 - 2**31

    def _send(self, address: int, message: object, now_s: float) -> None:
        if not self.mishaps.dumb(now_s):
            self._bus.send(vesc.encode(address, message))
